"""Motions that a system's actuators can make within what was recorded of them: commands to try in simulation."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import mujoco
import numpy as np
from scipy.signal import sawtooth, square

from simopt_envs.measured.channels import actuator_names
from simopt_envs.measured.recording import Recording
from simopt_envs.physics.parameters import Array

_SECONDS = 3.0  # of a motion, at most
_FASTER = 1.5  # times its fastest recorded change, that a command may change by
_SAMPLES = 10.0  # of a recording that a period has at least
_POSES, _TRAVEL = 4, 0.7  # to hold, and the share of a hold's time that it takes to get there
_APART = np.pi * (3 - np.sqrt(5))  # rad, the golden angle: phases of actuators and of poses that never go together

_LARGE, _SMALL = 1.0, 0.3  # shares of the range of the commands
_SLOW, _FAST = (0.25, 1.0), (1.0, 3.0)  # from and to, times the rate of the recorded commands


def _reversals(phase: Array) -> Array:
    return np.asarray(sawtooth(phase + np.pi / 2, 0.5))


def _steps(phase: Array) -> Array:
    return np.asarray(square(phase))


def _sines(phase: Array) -> Array:
    return np.asarray(np.mean([np.sin(rate * phase + rate) for rate in (0.4, 1.0, 1.45)], axis=0))


_MOTIONS: dict[str, tuple[float, tuple[float, float], Callable[[Array], Array]]] = {
    "a slow sweep": (_LARGE, _SLOW, np.sin),
    "a fast sweep": (_LARGE, _FAST, np.sin),
    "reversals": (_LARGE, _FAST, _reversals),
    "steps": (_LARGE, _SLOW, _steps),
    "small steps": (_SMALL, _SLOW, _steps),
    "slow sums of sines": (_LARGE, _SLOW, _sines),
    "small slow sums of sines": (_SMALL, _SLOW, _sines),
    "fast sums of sines": (_LARGE, _FAST, _sines),
    "small fast sums of sines": (_SMALL, _FAST, _sines),
}


def excitations(model: mujoco.MjModel, recordings: Sequence[Recording], period: float) -> Iterator[Recording]:
    """Commands ``ctrl/<actuator>``, one every period [s], each a recording named after its motion.

    Sweeps, reversals at constant speed, steps and sums of sines, slow and fast, large and small, and holds at several
    poses. They begin with the first recording's first command, keep within the range of all that was commanded and the
    model's ``ctrlrange``, and change by little more than commands ever did. None where no command ever moved.
    """
    names = [f"ctrl/{name}" for name in actuator_names(model)]
    low, high = np.array([_range(model, i, recordings, name) for i, name in enumerate(names)]).reshape(-1, 2).T
    if np.all(low == high):
        return
    fastest = _FASTER * np.array([_fastest(recordings, name, period) for name in names])
    first = np.clip([recordings[0][name][0] for name in names], low, high)
    seconds = min(_SECONDS, max(recording.duration for recording in recordings))
    time = np.float64(period) * np.arange(round(seconds / period) + 1)
    share = time / time[-1]
    rates = [np.clip(_rate(recordings, name), 1 / seconds, 1 / (_SAMPLES * period)) for name in names]

    def commands(motion: str, shapes: list[Array]) -> Recording:
        wanted = 0.5 * (low + high) + 0.5 * (high - low) * np.transpose(shapes)
        sent = [first]
        for target in wanted[1:]:
            sent.append(sent[-1] + np.clip(target - sent[-1], -fastest, fastest))
        return Recording(time, dict(zip(names, np.transpose(sent), strict=True)), motion)

    for motion, (amplitude, (start, end), wave) in _MOTIONS.items():
        cycles = seconds * (start * share + 0.5 * (end - start) * share**2)
        phases = [2 * np.pi * rate * cycles + i * _APART for i, rate in enumerate(rates)]
        yield commands(motion, [amplitude * wave(phase) for phase in phases])
    yield commands("holds", [_holds(share, i) for i in range(len(names))])


def _range(model: mujoco.MjModel, actuator: int, recordings: Sequence[Recording], name: str) -> tuple[float, float]:
    """Of the commands that were recorded, within the actuator's own."""
    values = np.concatenate([recording[name] for recording in recordings])
    if model.actuator_ctrllimited[actuator]:
        values = np.clip(values, *model.actuator_ctrlrange[actuator])
    return float(values.min()), float(values.max())


def _fastest(recordings: Sequence[Recording], name: str, period: float) -> float:
    """The most that a recorded command changed by in a period."""
    return max(float(np.abs(np.diff(r.resample(period)[name])).max(initial=0.0)) for r in recordings)


def _rate(recordings: Sequence[Recording], name: str) -> float:
    """How often commands go up and down again [1/s]: what they travel, by twice their range."""
    travelled = sum(float(np.abs(np.diff(recording[name])).sum()) for recording in recordings)
    span = max(float(np.ptp(recording[name])) for recording in recordings)
    return travelled / (2 * span * sum(recording.duration for recording in recordings)) if span else 0.0


def _holds(share: Array, actuator: int) -> Array:
    """Poses held one after another, (T,), for shares of the time."""
    poses = np.sin((np.arange(_POSES + 1) + actuator) * _APART)
    at = np.minimum(share * _POSES, _POSES - 1e-9)
    before = at.astype(np.intp)
    return poses[before] + (poses[before + 1] - poses[before]) * np.minimum((at - before) / _TRAVEL, 1.0)
