"""The recordings of a gap search: which are fitted, which are held out, and the windows of both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import mujoco
import numpy as np

from simopt_envs.gap.thresholds import FROM_REST, LEAST_LEFT, LONG_WINDOW, WINDOW
from simopt_envs.gap.trial import Data
from simopt_envs.measured.audit import audited
from simopt_envs.measured.channels import model_channels
from simopt_envs.measured.recording import Finding, Recording, warnings_of, with_distinct_names
from simopt_envs.measured.replay import unseen_joints
from simopt_envs.measured.windows import Windows, cut_windows
from simopt_envs.physics.effects.actuator_delay import LONGEST

_GUARD = 0.5  # seconds between what is fitted of a single recording and what is held out
_FITTED = 0.6  # share of a single recording that is fitted
_JERK = 0.1  # s from rest on, in which what sets off jerks: no smoothed position shows that


def of_one_system(model: mujoco.MjModel, recordings: Sequence[Recording]) -> list[Recording]:
    """The recordings, each audited, with what the audit found attached and the model's columns alone.

    One that is there twice counts once: what was fitted must not be held out.

    Raises:
        ValueError: without recordings, where the audit found an error, or where recordings are of different models.
    """
    if not recordings:
        raise ValueError("a gap search needs at least one recording")
    known = model_channels(model)
    first, *others = (known.keys() & recording.columns for recording in recordings)
    for recording, columns in zip(recordings[1:], others, strict=True):
        if only := first ^ columns:
            raise ValueError(
                f"{recording.name} and {recordings[0].name} have different columns ({', '.join(sorted(only))} in one of"
                " them alone): are they of the same system?"
            )
    logs: list[Recording] = []
    for recording in with_distinct_names(recordings):
        log = audited(recording, model).only([name for name in recording.columns if name in known])
        twin = next((i for i, other in enumerate(logs) if _are_same(log, other)), None)
        if twin is None:
            logs.append(log)
        else:
            told = Finding.warning(log.name, "recordings", f"the same as {logs[twin].name}: it counts once")
            logs[twin] = replace(logs[twin], warnings=(*logs[twin].warnings, told))
    return logs


def _are_same(one: Recording, other: Recording) -> bool:
    """Whether two recordings of the same columns hold the same samples."""
    columns = ((values, other[name]) for name, values in one.columns.items())
    return all(np.array_equal(*both, equal_nan=True) for both in ((one.time, other.time), *columns))


def under_way(recordings: Sequence[Recording]) -> list[Recording]:
    """The recordings without how they set off from rest, as far as they are long enough: smoothed states err there."""
    return [r.select(start=r.time[0] + _JERK) if r.at_rest and r.duration >= WINDOW + _JERK else r for r in recordings]


def split(recordings: Sequence[Recording]) -> tuple[list[Recording], list[Recording], tuple[Finding, ...]]:
    """The recordings to fit and those held out, and a warning where that could not be done by recording.

    In the order of how fast they move, the fastest and the slowest are fitted, so that what is held out lies within
    what was fitted: much of what a model may lack shows at speed alone, or where things stick.
    """
    if len(recordings) == 1:
        fitted, held_out = recordings[0].split(_FITTED, _GUARD)
        only = Finding.warning(
            recordings[0].name, "held-out", "one recording only: its later part is held out, in the same motion"
        )
        return [fitted], [replace(held_out, name=f"{held_out.name} (later part)")], (only,)
    ordered = sorted(recordings, key=_liveliness, reverse=True)
    within = np.linspace(1, len(ordered) - 2, len(ordered) // 2).round().astype(int).tolist()
    ends = [i for i in range(len(ordered)) if i not in within]
    return [ordered[i] for i in ends], [ordered[i] for i in within], ()


def read_windows(model: mujoco.MjModel, recordings: Sequence[Recording], keyframe: str | None = None) -> Data:
    """Windows of audited recordings, half of them held out; the last field tells of what the audit found.

    What windows leave over is left at both ends: smoothed positions tell least there of how a state was, and a robot
    that sets off where its recording begins would seem to be on its way already.

    Raises:
        ValueError: where no window fits.
    """
    fitted, held_out, warnings = split(recordings)
    seconds = min(WINDOW, *(recording.duration for recording in (*fitted, *held_out)))
    cut = partial(cut_windows, model, seconds=seconds, keyframe=keyframe, history=2 * LONGEST, centred=True)
    both = cut(fitted), cut(held_out)
    warnings = (*warnings, *warnings_of(recordings), *unseen_joints(model, both[0].starts))
    return Data(*both, tuple(fitted), tuple(held_out), warnings)


def whole_from_rest(model: mujoco.MjModel, recordings: Sequence[Recording], keyframe: str | None = None) -> Data | None:
    """Those recordings that begin at rest, each in one window from there, half of them held out.

    None where such windows, of ``LONG_WINDOW`` at most, are fewer than two or hold less than ``FROM_REST`` of all.
    """
    resting = [recording for recording in recordings if recording.at_rest]
    seconds = min((LONG_WINDOW, *(recording.duration for recording in resting)))
    if len(resting) < 2 or len(resting) * seconds < FROM_REST * sum(recording.duration for recording in recordings):
        return None
    fitted, held_out, warnings = split(resting)

    def cut(some: Sequence[Recording]) -> Windows:
        beginnings = [recording.select(end=recording.time[0] + seconds + recording.period / 2) for recording in some]
        return cut_windows(model, beginnings, keyframe=keyframe, history=2 * LONGEST)

    try:
        parts = cut(fitted), cut(held_out)
    except ValueError:  # all of one half have gaps
        return None
    return Data(*parts, tuple(fitted), tuple(held_out), warnings + warnings_of(recordings))


def longer_windows(model: mujoco.MjModel, data: Data, keyframe: str | None = None) -> tuple[Data, ...]:
    """The same recordings in longer windows, the longest first: whole ones, their halves, and thirds.

    Of a recording longer than ``LONG_WINDOW``, equal parts of it count as whole. Left out is what is not twice as long
    as recordings are cut already, and of which gaps leave too little. There are none where columns were left out:
    what moves unseen makes more of the others, too, the longer it does.
    """
    period = float(data.fitted.offsets[1])
    shortest = min(r.duration for r in (*data.fitted_recordings, *data.held_out_recordings))
    samples = int(shortest / period + 1e-6)
    samples //= int(np.ceil(samples * period / LONG_WINDOW))

    def longer(windows: Windows, recordings: Sequence[Recording], seconds: float) -> Windows | None:
        try:
            cut = cut_windows(model, recordings, seconds, keyframe=keyframe, history=2 * LONGEST)
        except ValueError:
            return None
        return cut if len(cut) * seconds >= LEAST_LEFT * len(windows) * data.seconds else None

    known = model_channels(model)
    if len(data.fitted.channels) < sum(name in known for name in data.fitted_recordings[0].signals):
        return ()
    found = []
    for seconds in (samples // parts * period for parts in (1, 2, 3)):
        if seconds >= 2 * data.seconds:
            fitted = longer(data.fitted, data.fitted_recordings, seconds)
            held_out = longer(data.held_out, data.held_out_recordings, seconds)
            if fitted is not None and held_out is not None:
                found.append(replace(data, fitted=fitted, held_out=held_out))
    return tuple(found)


def _liveliness(recording: Recording) -> float:
    """Root mean square rate of a recording's signals, each by its own spread [1/s]."""
    rates = []
    for name in recording.signals:
        values = recording[name]
        spread = np.nanstd(values)
        if spread > 0:
            rates.append(np.nanmean(np.diff(values) ** 2) / spread**2)
    return float(np.sqrt(np.mean(rates)) / recording.period) if rates else 0.0
