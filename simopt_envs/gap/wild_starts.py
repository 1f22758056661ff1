"""Windows in which all depends on how exactly they start: they are left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from simopt_envs.gap.explanation import Stage
from simopt_envs.gap.fit import DIFFERENCES, Misfit, fit
from simopt_envs.gap.hypothesis import Hypothesis
from simopt_envs.gap.refit import ITERATIONS
from simopt_envs.gap.thresholds import BENT, LARGE, LEAST_LEFT, OUTLYING, WILD
from simopt_envs.gap.trial import Base, Data, Stretch, afresh, of_median_window
from simopt_envs.measured.recording import Finding
from simopt_envs.measured.windows import Windows
from simopt_envs.physics.parameters import Array


def without_wild_starts(hypothesis: Hypothesis, u: Array, data: Data, scale: Array, beyond: float = 0.0) -> Data:
    """Without the windows in which the start decides: those where its error, beyond the linear, makes more than noise.

    A finger that just catches or just slips leaves hundreds of times the noise in the right model too, and one such
    window would bend all plain parameters. Where it is more than half of the windows, all stay.

    Args:
        hypothesis: by which windows are judged.
        u: its coordinates, (d,).
        data: the windows.
        scale: standard deviation of each channel's noise, (c,).
        beyond: times what it leaves of the median window, that it must leave of one that is left out, or that the start
            could make of it.
    """
    kept = []
    for windows in (data.fitted, data.held_out):
        misfit = Misfit(hypothesis, windows)
        left = np.mean(misfit.with_noise(misfit.noise_at(u, scale)).errors(u[None])[0] ** 2, axis=(1, 2))
        bent = np.mean(misfit.bent_by_starts(u, scale), axis=1)
        wild = (bent > WILD) & (np.maximum(left, bent) > beyond * np.median(left))
        kept.append(~wild if np.mean(wild) <= 0.5 else np.full(len(wild), True))
    return _of_those(data, *kept)


def without_wild_columns(hypothesis: Hypothesis, u: Array, data: Data, scale: Array) -> Data:
    """Without the sites and sensors in which the start decides in most windows, where it is most windows it decides.

    What hangs on more joints than they have columns may start in any way, of which a site tells little: by itself it
    says next to nothing of the model, and what is not linear in it bends all fits to the others.
    """
    both, channels, dofs = (data.fitted, data.held_out), data.fitted.channels, hypothesis.model.dof_jntid
    others = [c.kind not in ("qpos", "qvel") for c in channels]
    if np.sum(~np.isin(dofs, [c.object for c in channels if c.kind == "qpos"])) <= sum(others):
        return data
    bent = np.concatenate([Misfit(hypothesis, windows).bent_by_starts(u, scale) for windows in both])
    wild = (np.median(bent, axis=0) > WILD) & others
    if np.mean(np.mean(bent, axis=1) > WILD) <= 0.5 or not wild.any() or wild.all():
        return data
    names = np.array(data.fitted.names)
    message = "left out, as all depends there on how exactly joints start that no column shows"
    return data.of_columns(names[~wild].tolist(), [Finding.warning(name, "start", message) for name in names[wild]])


def without_starts_told_wild(stage: Stage, data: Data) -> Data:
    """Without those that a candidate tells which explains the median window, where the base is far from that.

    What the candidate leaves of the others then counts little, but a fit to all has been bent by it, so it is fitted
    anew, from where that bent nothing, until it tells of no more. An effect that acts in few windows alone leaves the
    base near to the median one, and so leaves all windows where they are; so does a candidate that would leave out
    more than half of them.
    """
    base = stage.base
    nearest = min((score.trial for score in stage.scores), key=lambda trial: of_median_window(trial.fit.errors))
    if of_median_window(base.fit.errors) < LARGE * max(of_median_window(nearest.fit.errors), 1.0):
        return data
    hypothesis, u, left = nearest.hypothesis, nearest.fit.u, data
    while (fewer := without_wild_starts(hypothesis, u, left, base.sensor_noise, OUTLYING)) is not left:
        left = fewer
        pairs = (data.fitted, left.fitted), (data.held_out, left.held_out)
        if any(2 * len(few) < len(windows) for windows, few in pairs):
            return data
        misfit = Misfit(hypothesis, left.fitted)
        misfit = misfit.with_noise(misfit.noise_at(u, base.sensor_noise))
        u = fit(misfit, afresh(nearest), ITERATIONS, differences=DIFFERENCES[:2]).u
    return left


def as_predicted(base: Base, longer: Data) -> Data | None:
    """Longer windows without those in which a start decides; None where a base is not near enough to the data.

    That may be the start of a short window in them. What uncertain starts do must be linear, as it is not where
    contacts slip, and a model that is far off gets lost on the way.
    """
    kept = [~overlap(windows, longer.wild) for windows in (longer.fitted, longer.held_out)]
    if base.excess >= LARGE:
        return None
    return of_linear_starts(base.hypothesis, base.fit.u, longer, base.sensor_noise, kept)


def of_linear_starts(
    hypothesis: Hypothesis, u: Array, data: Data, scale: Array, kept: Sequence[NDArray[np.bool_]]
) -> Data | None:
    """Windows without those in which a start decides; None where what starts do is not linear in the others.

    Args:
        hypothesis: by which windows are judged.
        u: its coordinates, (d,).
        data: the windows.
        scale: standard deviation of each channel's noise, (c,).
        kept: which windows are asked about, of those fitted and of those held out, (w,) each.
    """
    if np.mean(np.concatenate(kept)) < LEAST_LEFT:
        return None
    for windows, rows in zip((data.fitted, data.held_out), kept, strict=True):
        bent = np.mean(Misfit(hypothesis, windows).bent_by_starts(u, scale), axis=1)
        rows &= bent <= WILD
        if not rows.any() or np.mean(bent[rows]) > BENT:
            return None
    return _of_those(data, *kept) if np.mean(np.concatenate(kept)) >= LEAST_LEFT else None


def _of_those(data: Data, fitted: NDArray[np.bool_], held_out: NDArray[np.bool_]) -> Data:
    """The windows that are told, (w,) of each, and a warning that the others are left out."""
    kept = np.concatenate([fitted, held_out])
    if np.all(kept):
        return data
    message = f"{np.sum(~kept)} of {len(kept)} left out, where all depends on how exactly they start"
    left = data.of_those(fitted, held_out, Finding.warning("windows", "start", message))
    return replace(left, wild=data.wild + data.stretches(~fitted, ~held_out))


def overlap(windows: Windows, stretches: Sequence[Stretch]) -> NDArray[np.bool_]:
    """Which windows share time with any of some stretches of recordings, (w,)."""
    within = np.zeros(len(windows), dtype=bool)
    for name, begin, end in stretches:
        of_it = np.array(windows.recording) == name
        within |= of_it & (windows.start_time < end - 1e-6) & (windows.start_time + windows.seconds > begin + 1e-6)
    return within
