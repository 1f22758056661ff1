"""The screen: what each candidate would gain on a fitted base if it acted linearly, and where its fit may start."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from simopt_envs.gap.fit import Misfit
from simopt_envs.gap.hypothesis import Candidate, Hypothesis
from simopt_envs.gap.trial import Base
from simopt_envs.measured.windows import Windows
from simopt_envs.physics.parameters import Array

_STEPS = np.array([1.0, 0.3, 0.1, 0.03])  # shares of the screen's step that a fit may start from
_WORTH_A_START = 0.2  # share of the best probe's gain at which a fit may start from another one
_FURTHEST = 20.0  # probes that the screen's step may be long


@dataclass(frozen=True)
class Screened:
    """A candidate that acts linearly.

    Attributes:
        candidate: the effect and its place.
        hypothesis: the base's with the candidate.
        direction: what its best probe changes in the base's residual, plain parameters projected out, (m,).
        gain: in -log p, of the best multiple of that probe.
        starts: u from which a fit may start, some for each promising probe, (n, k, d).
    """

    candidate: Candidate
    hypothesis: Hypothesis
    direction: Array
    gain: float
    starts: Array


def screen(
    base: Base, candidates: Sequence[Candidate], windows: Windows, progress: Callable[[int, int], None]
) -> list[Screened]:
    """The candidates that a base lacks, largest expected gain less the price of their parameters (BIC) first.

    By the gain alone, those that have a shape to choose would crowd out others that need none.

    Args:
        base: what they are added to.
        candidates: some of which the base may have.
        windows: that the base was fitted to.
        progress: is told how many of how many are done.
    """
    lacking = [c for c in candidates if c not in base.hypothesis.candidates]
    price = 0.5 * np.log(base.fit.errors.size)
    found = []
    for done, candidate in enumerate(lacking):
        progress(done, len(lacking))
        found.append(_screen_one(base, candidate, windows))
    return sorted(found, key=lambda s: price * len(s.hypothesis.columns[s.candidate]) - s.gain)


def _screen_one(base: Base, candidate: Candidate, windows: Windows) -> Screened:
    """What a candidate would gain if its best probe acted linearly."""
    plain, motion = base.hypothesis.plain, base.hypothesis.motion
    hypothesis = Hypothesis(plain, [*base.hypothesis.candidates, candidate], motion)
    misfit = Misfit(hypothesis, windows).with_noise(base.noise)
    amounts, neutral = hypothesis.amounts(candidate), hypothesis.neutral()
    probes = hypothesis.probes(candidate)
    probes[:, : len(base.fit.u)] = base.fit.u
    residual, (orthonormal, triangle) = base.fit.residual, base.fit.orthonormal
    found: list[Screened] = []
    without = neutral.copy()
    without[: len(base.fit.u)] = base.fit.u
    errors = misfit.errors(np.concatenate([without[None], probes]))  # a structure alone changes a little
    for probe, change_of_data in zip(probes, errors[1:] - errors[0], strict=True):
        change = np.concatenate([change_of_data.ravel(), np.zeros(len(base.fit.u))])
        absorbed = orthonormal.T @ change
        direction = change - orthonormal @ absorbed
        size, slope = float(direction @ direction), float(direction @ residual)
        step = _clipped(-slope / size if size > 0 else 0.0, probe - neutral, neutral, hypothesis, amounts)
        gain = -step * slope - 0.5 * step**2 * size
        origin, shift = probe.copy(), np.zeros(len(probe))
        shift[: len(base.fit.u)] = -np.linalg.solve(triangle, absorbed)
        origin[amounts], shift[amounts] = neutral[amounts], (probe - neutral)[amounts]
        starts = np.clip(origin + step * _STEPS[:, None] * shift, hypothesis.low, hypothesis.high)
        found.append(Screened(candidate, hypothesis, direction, gain, starts))
    best = max(found, key=lambda s: s.gain)
    promising = [s.starts for s in found if s.gain >= _WORTH_A_START * best.gain]
    return replace(best, starts=np.array(promising))


def _clipped(step: float, shift: Array, neutral: Array, hypothesis: Hypothesis, columns: list[int]) -> float:
    """A step along a shift of some coordinates that stays within their bounds and is not absurdly long."""
    moving = [c for c in columns if shift[c]]
    bounds = np.array([hypothesis.low[moving], hypothesis.high[moving]])
    ends = (bounds - neutral[moving]) / shift[moving]
    smallest, largest = ends.min(axis=0).max(initial=-_FURTHEST), ends.max(axis=0).min(initial=_FURTHEST)
    return float(np.clip(step, smallest, largest))
