"""The sizes of effects where no model is right: they are then of what a fit weighs, and that depends on the windows.

Short windows weigh forces, as regressions on accelerations do, long ones the motion that these add up to. Where laws
are of the right form that makes no difference, and long windows tell more.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from simopt_envs.gap.fit import DIFFERENCES, Fit, Misfit
from simopt_envs.gap.hypothesis import Hypothesis
from simopt_envs.gap.predictive import HeldOut
from simopt_envs.gap.thresholds import EVIDENCE, SHORTER_WINDOWS
from simopt_envs.gap.trial import Base, Data
from simopt_envs.gap.wild_starts import overlap
from simopt_envs.measured.windows import Windows, cut_windows
from simopt_envs.physics.effects.actuator_delay import LONGEST
from simopt_envs.physics.parameters import Array

FitAll = Callable[[Misfit, Array, Sequence[float]], Fit]
"""Fits all parameters from a start, over differences: :meth:`Search.fit`."""

_ROUNDS = 2  # fits, each in what the one before left


def of_best_length(
    base: Base,
    data: Data,
    fit: FitAll,
    progress: Callable[[str, int, int], None] = lambda *_: None,
    keyframe: str | None = None,
) -> Base:
    """A base, or the same with the ξ that shorter windows give, if that predicts what was held out better.

    By as many nats as are evidence for an effect, as shorter windows tell less of a law of the right form. Where errors
    count in what even the best model leaves, no law is, and any better is enough.

    Args:
        base: fitted to the data.
        data: in whose windows held out all are compared.
        fit: a search's.
        progress: is told of it.
        keyframe: where joints without a column start.
    """
    hypothesis = base.hypothesis
    misfit = Misfit(hypothesis, data.fitted).with_noise(base.noise)
    test = Misfit(hypothesis, data.held_out).with_noise(base.held_out_noise)
    found = [base.fit.u]
    for i, seconds in enumerate(SHORTER_WINDOWS):
        progress("fit to shorter windows", i, len(SHORTER_WINDOWS))
        windows = _shorter(hypothesis, data, seconds, keyframe)
        if windows is not None:
            found.append(_fitted(base, windows, fit))
    left = 0.5 * np.sum(test.errors(np.array(found)) ** 2, axis=(1, 2, 3))
    best = int(np.argmin(left))
    if best == 0 or (left[0] - left[best] < EVIDENCE and np.all(base.tolerance == 1)):
        return base
    u = found[best]
    there = Fit(u, misfit.errors(u[None])[0], misfit.jacobian(u), base.fit.prior_std, misfit.noise.log_det)
    return replace(base, fit=there, held_out=HeldOut.of(test, u, base.tolerance))


def _shorter(hypothesis: Hypothesis, data: Data, seconds: float, keyframe: str | None) -> Windows | None:
    """The recordings that were fitted in shorter windows, without stretches that were left out; None if they are not.

    A window must hold more samples than its start has numbers.
    """
    model, recordings = hypothesis.plain.model, data.fitted_recordings
    if seconds >= data.seconds or seconds <= 2 * model.nv * float(data.fitted.offsets[1]):
        return None
    windows = cut_windows(model, recordings, seconds, keyframe=keyframe, history=2 * LONGEST, centred=True)
    kept = np.flatnonzero(~overlap(windows, (*data.wild, *data.outliers)))
    return windows.of_columns(data.fitted.names).select(kept)


def _fitted(base: Base, windows: Windows, fit: FitAll) -> Array:
    """u (d,) fitted to some windows, errors counted in what is left of them."""
    misfit, u = Misfit(base.hypothesis, windows), base.fit.u
    for _ in range(_ROUNDS):
        left = misfit.with_noise(misfit.noise_at(u, base.sensor_noise)).errors(u[None])[0]
        scale = base.sensor_noise * np.maximum(1.0, np.sqrt(np.mean(left**2, axis=(0, 1))))
        u = fit(misfit.with_noise(misfit.noise_at(u, scale)), u, DIFFERENCES[1:]).u
    return u
