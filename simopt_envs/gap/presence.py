"""Whether an effect that was added is there by its interval, and is what its name means."""

from __future__ import annotations

import numpy as np

from simopt_envs.gap.fit import by_part
from simopt_envs.gap.hypothesis import Candidate, Hypothesis
from simopt_envs.gap.thresholds import CONFIDENT
from simopt_envs.gap.trial import Base
from simopt_envs.physics.parameters import Array


def is_there(
    hypothesis: Hypothesis, effect: Candidate, u: Array, spread: Array, smaller: Candidate | None = None
) -> bool:
    """Whether an effect's interval leaves out that there is none of it; a limit, without an amount, that it is none.

    With a smaller one, which it extends: none of what it adds to that.
    """
    off = np.abs(u - hypothesis.neutral()) > CONFIDENT * spread
    columns = hypothesis.amounts(effect) or hypothesis.columns[effect]
    if smaller is not None:
        columns = [i for i in hypothesis.added(effect, smaller) if i in columns]
    return bool(np.any(off[columns]))


def is_told_from_none(effect: Candidate, base: Base, without: Base, parts: int) -> bool:
    """Whether all windows tell an effect, which is needed, from none of it, though its interval holds none.

    Of an effect so strong that more of it, or less, changes little, as of what locks a joint, the slope where its fit
    ended tells nothing of how far none is (Hauck and Donner 1977). The way there does: by how much the errors change
    along it, and how far stretches of data pull apart what is best on it. Where that slope alone leaves none out,
    derivatives that others do not confirm are what widens the interval, and False.

    Args:
        effect: that the base has.
        base: with it.
        without: a base without it, in the same noise.
        parts: stretches in a window.
    """
    fit, none = base.to_all(), without.to_all()
    spread = np.sqrt(np.diag(np.linalg.pinv(fit.rows.T @ fit.rows, hermitian=True)))
    if is_there(base.hypothesis, effect, fit.u, spread):
        return False
    lost = none.errors - fit.errors
    squares, pulls = float(np.sum(lost**2)), by_part(np.sum(lost * fit.errors, axis=2), parts)
    apart = float(np.sum(pulls**2)) * len(pulls) / max(len(pulls) - 1, 1)
    return bool(squares + float(np.sum(pulls)) > CONFIDENT * np.sqrt(max(base.left * squares, apart)))


def may_be_itself(hypothesis: Hypothesis, effect: Candidate, u: Array, spread: Array) -> bool:
    """Whether an effect is what its name means at some end of its parameters' intervals, if not where the fit ended.

    What data tell little of, as how wide a friction's peak is, may end a little beyond.
    """
    steps = CONFIDENT * np.diag(spread)[hypothesis.columns[effect]]
    ends = np.clip(np.concatenate([u[None], u - steps, u + steps]), hypothesis.low, hypothesis.high)
    return any(hypothesis.is_itself(effect, end) for end in ends)
