"""One candidate fitted: from what the screen found, from afar at the size that it needs, or on from an earlier fit."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simopt_envs.adaptation.checkpoint import Result
from simopt_envs.gap.fit import DIFFERENCES, Fit, Misfit, fit
from simopt_envs.gap.hypothesis import Candidate
from simopt_envs.gap.known import of_silent
from simopt_envs.gap.large import SECONDS, best_of_each, of_some_size
from simopt_envs.gap.plain import SPEAKS_FOR
from simopt_envs.gap.predictive import HeldOut
from simopt_envs.gap.screen import Screened
from simopt_envs.gap.thresholds import FAR, LARGE
from simopt_envs.gap.trial import Base, Trial
from simopt_envs.measured.windows import Windows
from simopt_envs.physics.effects import object_name
from simopt_envs.physics.parameters import Array

ITERATIONS = 20
"""Of a fit, at most, over each difference."""


@dataclass(frozen=True, repr=False)
class Refit:
    """A task: to fit a candidate.

    Attributes:
        screened: the candidate.
        far: coordinates of the base (d,) from which the candidate is fitted too, at the size that it then needs.
        near: where an earlier fit ended, (d,), which this one goes on from with all derivatives taken.
        others: coordinates, (d,), that it may go on from as well, if a coarse fit from there ends better.
    """

    screened: Screened
    far: tuple[Array, ...] = ()
    near: Array | None = None
    others: tuple[Array, ...] = ()

    @property
    def starts(self) -> tuple[Array, ...]:
        """All coordinates that it begins with."""
        return (self.screened.starts, *self.far) if self.near is None else (self.near, *self.others)

    def __repr__(self) -> str:
        return str(self.screened.candidate)


def fitted(refit: Refit, base: Base, windows: Windows, held_out: Windows, num_threads: int) -> Result:
    """The fit of a candidate, and its errors on what was held out."""
    hypothesis = refit.screened.hypothesis

    def on(rows: NDArray[np.intp]) -> Misfit:
        return Misfit(hypothesis, windows.select(rows), num_threads).with_noise(base.noise.select(rows))

    misfit, test = (Misfit(hypothesis, some, num_threads) for some in (windows, held_out))
    misfit, test = misfit.with_noise(base.noise), test.with_noise(base.held_out_noise)
    foreseen: Array | None
    if refit.near is None:
        found, foreseen = _first(refit, base, misfit, on, windows.seconds), base.held_out.jacobian
    else:
        found = _further(refit, base, refit.near, misfit, on)
        foreseen = _silent(base, base.held_out.jacobian)
        test = test.with_own_noise(found.u)
    told = HeldOut.of(test, found.u, base.tolerance, foreseen)
    return {**vars(found), **{f"held_out_{name}": array for name, array in vars(told).items()}}


def _first(refit: Refit, base: Base, misfit: Misfit, on: Callable[[NDArray[np.intp]], Misfit], seconds: float) -> Fit:
    """From what the screen found, with derivatives by what the base has known from there.

    Where the base is far from the data or from its priors, the candidate is fitted at the size that it would need, too:
    with what speaks for it taken away, and with all plain parameters at their priors' means; derivatives by these are
    taken once, there. A base that an effect has bent is the end of a valley that leads away from the right one.

    Starts are told apart by those windows alone of which the base leaves the most, then fitted to all. Where that led
    to what is farther from all windows than a start was, the candidate is fitted from that start, too.
    """
    hypothesis, of_base, base_jacobian = misfit.hypothesis, range(len(base.fit.u)), base.fit.jacobian
    num_windows = len(base.fit.errors)
    rows = base.worst(num_windows / 2)
    half = on(rows)
    starts = best_of_each(half, refit.screened.starts)
    known = base_jacobian.reshape(num_windows, -1, len(of_base))[rows].reshape(-1, len(of_base))
    coarse = [_coarsely(half, u, known) for u in starts]
    for afar in refit.far:
        neutral = np.concatenate([afar, hypothesis.neutral()[len(afar) :]])
        far = of_some_size(on(base.worst(SECONDS / seconds)), refit.screened.candidate, neutral)
        known = half.jacobian(far[0], of_base, DIFFERENCES[0])
        coarse += [_coarsely(half, u, known) for u in far]
    direct = misfit.best(starts)
    losses = misfit.losses(np.array([*coarse, direct]))
    best = int(np.argmin(losses[:-1]))
    known = base_jacobian if best < len(starts) else misfit.jacobian(coarse[best], of_base, DIFFERENCES[0])
    found = fit(misfit, coarse[best], ITERATIONS, known=known, differences=DIFFERENCES[1:])
    if losses[-1] < losses[best]:
        other = fit(misfit, direct, ITERATIONS, known=base_jacobian, differences=DIFFERENCES[1:])
        found = min(found, other, key=lambda one: one.loss)
    return found


def _further(refit: Refit, base: Base, near: Array, misfit: Misfit, on: Callable[[NDArray[np.intp]], Misfit]) -> Fit:
    """On from another fit, with all derivatives taken that show anything in the data.

    Errors are counted in the noise of its own where they are likelier in that: what uncertain starts leave depends on
    the model, as friction brings them to rest.
    """
    others: list[Array] = []
    if refit.others:
        half = on(base.worst(len(base.fit.errors) / 2))
        of_base = range(len(base.fit.u))
        others = [_coarsely(half, u, half.jacobian(u, of_base, DIFFERENCES[0])) for u in refit.others]
    start = misfit.best(np.array([near, *others]))
    known = _silent(base, base.fit.jacobian)
    return fit(misfit.with_own_noise(start), start, ITERATIONS, known=known, differences=DIFFERENCES[1:])


def _silent(base: Base, jacobian: Array) -> Array | None:
    """What of a base's Jacobian (..., d) need not be taken; where an effect has bent that, it tells of elsewhere."""
    bent = base.excess >= LARGE or base.strained
    return None if bent else of_silent(jacobian, base.hypothesis.num_plain)


def _coarsely(misfit: Misfit, start: Array, known: Array) -> Array:
    """Where a coarse fit leads, (d,), from one of several starts, which alone tell little of that."""
    return fit(misfit, start, ITERATIONS, known=known, differences=DIFFERENCES[:1]).u


def extended(candidate: Candidate, trials: Collection[Candidate]) -> Candidate | None:
    """The one of some trials that a candidate extends, if any."""
    ones = (c for c in trials if c.effect.name == candidate.effect.extends and c.place == candidate.place)
    return next(ones, None)


def grown(screened: Screened, trials: Mapping[Candidate, Trial]) -> tuple[Array, ...]:
    """Where a candidate's fit may go on from that of the one that it extends."""
    smaller = extended(screened.candidate, trials)
    if smaller is None:
        return ()
    return tuple(screened.hypothesis.grown(trials[smaller].hypothesis, trials[smaller].fit.u))


def spoken_for(base: Base, candidates: Sequence[Candidate]) -> dict[Candidate, Array]:
    """The candidates that plain parameters far outside their priors speak for; a linear screen cannot tell them.

    Each with the base's coordinates (d,), but those parameters at their priors' means.
    """
    hypothesis = base.hypothesis
    off = hypothesis.off(base.fit.u)
    back: dict[Candidate, Array] = {}
    for i in np.flatnonzero(np.abs(off[: hypothesis.num_plain]) > FAR):
        kind, _, name = hypothesis.space.names[i].partition(".")
        for c in candidates:
            if c.effect.name == SPEAKS_FOR.get(kind) and name in ("", object_name(c.place)):
                back.setdefault(c, off.copy())[i] = 0.0
    return {candidate: hypothesis.at(values) for candidate, values in back.items()}
