"""What is wrong with a recording, before anything is fitted to it.

Every threshold is a named constant with its reason; a log that is merely noisy, quantised or written by a PC without
real-time clock passes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from simopt_envs.measured.audit_model import LEAST_SAMPLES, against_model
from simopt_envs.measured.channels import model_channels
from simopt_envs.measured.recording import Finding, Recording
from simopt_envs.measured.resample import GAP_PERIODS, REPEATED_PERIODS, Array, repeated, resolution, sample_period
from simopt_envs.measured.smoothing import smooth

JITTER = 0.1  # an interval that differs from the median by more than this share of it is jittered ...
JITTERED_SHARE = 0.01  # ... worth a word where more than this share of them is
PLAUSIBLE_RATES = (2.0, 50_000.0)  # [Hz]: outside it time is hardly in seconds, and no motion in the samples
LARGEST = 1e9  # of any channel
MISSING_SHARE = 0.5  # of a channel: with more samples missing it cannot be interpolated
CLIPPED_SAMPLES = 5  # consecutive samples exactly at an extreme value, which a moving signal does not show ...
CLIPPED_SHARE = 0.002  # ... and at least this share of all
CLIPPED_STEPS = 10  # of the encoder, covered in the 5 samples before: a smooth turn covers at most 8 (see _arrivals)
FROZEN_SAMPLES = 50  # consecutive equal positions that are entered at speed: a sensor that hangs ...
FROZEN_JOLT = 3.0  # ... with this many times the change of speed that the signal shows elsewhere
JUMP = 10.0  # times what is covered in the intervals around and in the median one, between two samples ...
JUMP_SHARE = 0.01  # ... and this share of the range
UNREST = 6.0  # times as far as its largest acceleration takes a position from rest, smoothed as that is, ...
UNREST_NOISE = 5.0  # ... and so many standard deviations of its noise: it was on its way
UNREST_SECONDS = 0.08  # in which that is looked for: at speed it goes farther first, under acceleration later
ROUGH_SHARE = 0.25  # of samples that leap and at once return, as two of three do in noise; a motion turns slowly


def audit(recording: Recording, model: mujoco.MjModel | None = None) -> list[Finding]:
    """Check a recording, and against a model where there is one.

    Without a model: too few samples, time (not finite, backward, duplicate, jittered, gaps, no plausible rate), samples
    that are missing, channels that are constant or clipped, positions that move where all is said to rest. With one:
    columns that it does not know, actuators and joints without a column, values that cannot be in radians or metres or
    within the joint's or actuator's range, velocities that are not the derivatives of their positions, or lag them, and
    commands that lag, scale, oppose or are swapped against the torque that the motion needed.

    Returns:
        What was found, errors first; the recording's own warnings are among them.
    """
    findings = [*recording.warnings, *_time(recording)]
    if not any(finding.severity == "error" for finding in findings):
        known = recording.columns if model is None else model_channels(model)
        compared = recording.only([name for name in recording.columns if name in known])
        of_values = [f for name, values in compared.columns.items() for f in _values(name, compared.time, values)]
        broken = {f.channel for f in of_values if f.severity == "error"}
        findings += [*of_values, *_rest(compared, broken)]
        if model is not None:
            findings += against_model(recording, model, broken)
    return sorted(dict.fromkeys(findings), key=lambda finding: finding.severity != "error")


def audited(recording: Recording, model: mujoco.MjModel | None = None) -> Recording:
    """The recording with the audit's warnings attached; ValueError that lists its errors if there are any."""
    findings = audit(recording, model)
    if errors := [str(finding) for finding in findings if finding.severity == "error"]:
        raise ValueError(f"{recording.name} must not be fitted as it is: " + "; ".join(errors))
    return replace(recording, warnings=tuple(findings))


def _time(recording: Recording) -> Iterator[Finding]:
    time = recording.time
    if len(time) < LEAST_SAMPLES:
        yield Finding.error("", "length", f"only {len(time)} samples; at least {LEAST_SAMPLES} are needed")
        return
    if broken := int((~np.isfinite(time)).sum()):
        yield Finding.error(
            "time", "time", f"{broken} time stamps are not finite, the first in row {_first(~np.isfinite(time))}"
        )
        return
    intervals = np.diff(time)
    if (backward := intervals < 0).any():
        row = _first(backward)
        yield Finding.error(
            "time",
            "time",
            f"time runs backward {backward.sum()} times, first after row {row} ({time[row]:g} to {time[row + 1]:g} s)",
        )
        return
    if (same := intervals == 0).all():
        yield Finding.error("time", "time", f"all time stamps are {time[0]:g} s")
        return
    period, again = recording.period, repeated(time)[:-1]
    if again.any():
        near = "" if same[again].all() else f", or less than {REPEATED_PERIODS:g} sample periods before the next"
        yield Finding.warning(
            "time",
            "duplicates",
            f"{again.sum()} repeated time stamps{near}, first in row {_first(again) + 1}; the last sample of each is"
            " used",
        )
    if not PLAUSIBLE_RATES[0] <= 1 / period <= PLAUSIBLE_RATES[1]:
        yield Finding.error("time", "units", f"the rate is {1 / period:g} Hz: is time in seconds?")
    off = np.abs(intervals / period - 1)
    gaps, row = intervals > GAP_PERIODS * period, int(np.argmax(intervals))
    if recording.is_all_but_gap:
        told = f"time jumps by {intervals[row]:.4g} s after row {row}, from {time[row]:.10g} s: cut the recording there"
        yield Finding.error("time", "gaps", told)
        return
    if gaps.any():
        yield Finding.warning(
            "time",
            "gaps",
            f"{gaps.sum()} gaps of more than {GAP_PERIODS:g} sample periods, {intervals[gaps].sum():.4g} s together,"
            f" the longest {intervals[row]:.4g} s after row {row} ({time[row]:.4g} s); windows that hold one are left"
            " out",
        )
    jittered = (off > JITTER) & ~gaps & ~again
    if jittered.mean() > JITTERED_SHARE:
        yield Finding.warning(
            "time",
            "jitter",
            f"{100 * jittered.mean():.1f} % of the intervals differ by more than {100 * JITTER:g} % from the median"
            f" {1e3 * period:.4g} ms (shortest {1e3 * intervals[~again].min():.4g}, longest"
            f" {1e3 * intervals[~gaps].max():.4g} ms); signals are resampled",
        )


def _values(name: str, time: Array, values: Array) -> Iterator[Finding]:
    finite = np.isfinite(values)
    missing = float(1 - finite.mean())
    if missing == 1:
        yield Finding.error(name, "missing", "holds no finite value")
        return
    if (largest := float(np.abs(values[finite]).max())) > LARGEST:
        yield Finding.error(name, "units", f"reaches {largest:.3g}: no quantity of a robot")
        return
    if missing:
        message = f"{100 * missing:.3g} % of the samples are not finite, the first in row {_first(~finite)}"
        severe = name.startswith("ctrl/") or missing > MISSING_SHARE or np.isinf(values).any()
        yield (Finding.error if severe else Finding.warning)(name, "missing", message)
        if severe:
            return
    time, good = time[finite], values[finite]
    if np.ptp(good) == 0:
        what = "the command never changes" if name.startswith("ctrl/") else "a sensor that is stuck or not connected?"
        yield Finding.warning(name, "constant", f"constant at {good[0]:g}: {what}")
        return
    # Where values are hardly quantised, a part of their range counts as one step.
    step = max(resolution(good), 1e-4 * float(np.ptp(good)))
    for extreme in () if name.startswith("ctrl/") else (good.max(), good.min()):  # commands are held as one likes
        share = float(np.mean(good == extreme))
        arrivals = _arrivals(time, good, good == extreme, CLIPPED_SAMPLES)
        # A motion against a stop arrives at speed now and then; one that is cut off does most times.
        if share >= CLIPPED_SHARE and len(arrivals) and np.median(arrivals) > CLIPPED_STEPS * step:
            yield Finding.warning(
                name, "saturated", f"clipped at {extreme:g}, where {100 * share:.2g} % of its samples lie"
            )
            return
    if name.startswith(("qpos/", "site/")) and len(good) > FROZEN_SAMPLES:
        yield from _jumps(name, time, good, step)
        held = np.concatenate([[False], np.diff(good) == 0])
        arrivals = _arrivals(time, good, held | np.append(held[1:], False), FROZEN_SAMPLES)
        usual = float(np.percentile(np.abs(good[10:] - 2 * good[5:-5] + good[:-10]), 99))
        if arrivals.max(initial=0.0) > max(CLIPPED_STEPS * step, FROZEN_JOLT * usual):
            yield Finding.warning(name, "constant", f"freezes in full motion for {FROZEN_SAMPLES} samples or more")


def _rest(recording: Recording, broken: set[str]) -> Iterator[Finding]:
    """Positions that are on their way at the first sample, where the recording is said to begin at rest."""
    if not recording.at_rest:
        return
    grid = recording.resample(recording.period)
    for name in grid.signals:
        if not name.startswith(("qpos/", "site/")) or name in broken:
            continue
        smoothed = smooth(grid[name], grid.period)
        moved = (grid[name] - grid[name][0])[: max(3, round(UNREST_SECONDS / grid.period))]
        after = grid.period * np.arange(len(moved))
        from_rest = 0.5 * UNREST * np.nanmax(np.abs(smoothed.acceleration)) * after**2
        if np.any(np.abs(moved) > from_rest + UNREST_NOISE * np.sqrt(2) * smoothed.noise):
            told = f"it moves by {moved[-1]:.3g} in its first {after[-1]:.3g} s, faster than its accelerations allow"
            yield Finding.error(name, "rest", f"the recording is said to begin at rest, but {told}")


def _jumps(name: str, time: Array, values: Array, step: float) -> Iterator[Finding]:
    """Positions that jump between two samples, against what they cover in the intervals around."""
    moved, intervals = np.diff(values), np.diff(time)
    padded = np.pad(np.abs(moved), 3, mode="edge")
    around = np.median([padded[k : k + len(moved)] for k in (0, 1, 2, 4, 5, 6)], axis=0)
    usual = np.maximum(around, np.median(np.abs(moved)))
    least = max(CLIPPED_STEPS * step, JUMP_SHARE * float(np.ptp(values)))
    jumps = (np.abs(moved) > np.maximum(least, JUMP * usual)) & (intervals <= GAP_PERIODS * sample_period(time))
    leaps = np.where(np.abs(moved) > least, np.sign(moved), 0.0)
    rough = float(np.mean(leaps[1:] * leaps[:-1] < 0))
    if rough > ROUGH_SHARE:
        yield Finding.warning(
            name, "jumps", f"is no motion: {100 * rough:.0f} % of its steps turn back; noise, or rows out of order?"
        )
    elif jumps.any():
        row = _first(jumps)
        turn = abs(abs(moved[row]) / (2 * np.pi) - 1) < 0.05
        hint = "an angle that wraps around?" if turn else "lost rows, or a glitch?"
        yield Finding.warning(
            name, "jumps", f"jumps {jumps.sum()} times, first by {moved[row]:.4g} at {time[row + 1]:.4g} s: {hint}"
        )


def _arrivals(time: Array, values: Array, held: NDArray[np.bool_], least: int) -> Array:
    """How far a signal came in the 5 samples before each stretch of at least so many held ones.

    A smooth turn that stays within one step q of the encoder for L samples has covered at most q ((1 + 10/L)^2 - 1),
    3 q for L = 10 and 8 q for L = 5; a signal that is cut off comes at speed. Stretches after a gap do not count.
    """
    across = GAP_PERIODS * 5 * sample_period(time)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], held.astype(int), [0]])))
    return np.array(
        [
            abs(values[start] - values[start - 5])
            for start, end in zip(edges[::2], edges[1::2], strict=True)
            if end - start >= least and start >= 5 and time[start] - time[start - 5] < across
        ]
    )


def _first(where: NDArray[np.bool_]) -> int:
    return int(np.argmax(where))
