"""One candidate fitted: from what the screen found, from afar at the size that it needs, or on from an earlier fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simopt_envs.adaptation.checkpoint import Result
from simopt_envs.gap.fit import DIFFERENCES, Fit, Misfit, fit
from simopt_envs.gap.large import of_some_size
from simopt_envs.gap.predictive import HeldOut
from simopt_envs.gap.screen import Screened
from simopt_envs.gap.trial import Base
from simopt_envs.measured.windows import Windows
from simopt_envs.physics.parameters import Array

ITERATIONS = 10
"""Of a fit, at most, over each difference."""

_FITTED_COARSELY = 3  # probes, those of the best starts


@dataclass(frozen=True, repr=False)
class Refit:
    """A task: to fit a candidate.

    Attributes:
        screened: the candidate.
        far: coordinates of the base (d,) from which the candidate is fitted too, at the size that it then needs.
        near: where an earlier fit ended, (d,), which this one goes on from with all derivatives taken.
    """

    screened: Screened
    far: tuple[Array, ...] = ()
    near: Array | None = None

    @property
    def starts(self) -> tuple[Array, ...]:
        """All coordinates that it begins with."""
        return (self.screened.starts, *self.far) if self.near is None else (self.near,)

    def __repr__(self) -> str:
        return str(self.screened.candidate)


def fitted(refit: Refit, base: Base, windows: Windows, held_out: Windows, num_threads: int) -> Result:
    """The fit of a candidate, and its errors on what was held out; near the base, its derivatives are taken as known.

    Where the base is far from the data or from its priors, the candidate is fitted at the size that it would need, too:
    with what speaks for it taken away, and with all plain parameters at their priors' means. A base that an effect has
    bent is the end of a valley that leads away from the right one. A fit that goes on from another takes them all.
    """
    screened, hypothesis = refit.screened, refit.screened.hypothesis
    misfit = Misfit(hypothesis, windows, num_threads).with_noise(base.noise)
    if refit.near is None:
        fits = [_fitted_from(misfit, _of_each_probe(misfit, screened.starts), base.fit.jacobian)]
        for u in refit.far:
            start = np.concatenate([u, hypothesis.neutral()[len(u) :]])
            fits.append(fit(misfit, of_some_size(misfit, screened.candidate, start), ITERATIONS))
        found = min(fits, key=lambda f: f.loss)
    else:
        found = fit(misfit, refit.near, ITERATIONS, differences=DIFFERENCES[1:])
    test = Misfit(hypothesis, held_out, num_threads).with_noise(base.held_out_noise)
    known = base.held_out.jacobian if refit.near is None else None
    told = HeldOut.of(test, found.u, base.tolerance, known)
    return {**vars(found), "held_out": told.errors, "held_out_jacobian": told.jacobian}


def _fitted_from(misfit: Misfit, starts: Array, known: Array) -> Fit:
    """The fit from that of some starts (k, d) which leads nearest, coarsely, as starts alone tell little."""
    coarse = [fit(misfit, start, ITERATIONS, known=known, differences=DIFFERENCES[:1]) for start in starts]
    best = min(coarse, key=lambda f: f.loss)
    return fit(misfit, best.u, ITERATIONS, known=known, differences=DIFFERENCES[1:])


def _of_each_probe(misfit: Misfit, starts: Array) -> Array:
    """The best starts of the probes that have the best ones, (k, d), of those of all probes, (n, steps, d)."""
    losses = misfit.losses(np.concatenate(starts)).reshape(starts.shape[:2])
    best = starts[np.arange(len(starts)), np.argmin(losses, axis=1)]
    return best[np.argsort(losses.min(axis=1), kind="stable")[:_FITTED_COARSELY]]
