"""Where a misfit may enter a model: a force on a joint, or an offset of a column's reading.

The whitened errors e of windows are linear in both where they are small; a carrier holds how, as normal equations.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from simopt_envs.adaptation.fitting import Noise
from simopt_envs.gap.hypothesis import Hypothesis
from simopt_envs.measured.windows import Windows
from simopt_envs.physics.effects import object_name
from simopt_envs.physics.effects.joints import dof, force_unit, scalar_joints
from simopt_envs.physics.parameters import Array

_STRETCHES = 10  # of a window, on each of which a force is constant
_PULSE = 0.02  # of a joint's force in the recordings: small enough to act linearly
_MOST_STRETCHES = 50  # for readings
_MOTOR = "missing force on "


@dataclass(frozen=True)
class Residual:
    """What a fitted model leaves of some windows.

    Attributes:
        windows: w of them.
        errors: whitened, simulated minus measured, (w, S, c).
        noise: that they are whitened with.
    """

    windows: Windows
    errors: Array
    noise: Noise


@dataclass(frozen=True, eq=False)
class Carrier:
    """Where the misfit may enter, piecewise constant on k stretches of each window.

    With J (m, k) the whitened errors that units of it make, and e (m,) those that there are:

    Attributes:
        name: ``"force on elbow"`` or ``"reading of qpos/elbow"``.
        unit: of the curve.
        of: the joint, empty for readings.
        information: Jᵀ J, one (w, k, k) for each set of windows.
        slope: Jᵀ e, one (w, k) for each set of windows.
    """

    name: str
    unit: str
    of: str
    information: tuple[Array, ...]
    slope: tuple[Array, ...]


def forces(hypothesis: Hypothesis, u: Array, residuals: Sequence[Residual]) -> list[Carrier]:
    """A force on each joint: the hypothesis with one more motor there, whose command is a pulse in each stretch.

    Args:
        hypothesis: plain parameters and effects.
        u: their fitted coordinates, (d,).
        residuals: what it leaves.
    """
    plain = hypothesis.plain
    places = scalar_joints(plain.model)
    joints = [object_name(place) for place in places]
    spec = plain.spec.copy()
    for joint in joints:
        motor = spec.add_actuator(name=f"{_MOTOR}{joint}", target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_motor()
    driven = Hypothesis(replace(plain, spec=spec, model=spec.compile()), hypothesis.candidates, hypothesis.motion)
    sizes = [_PULSE * float(hypothesis.motion.force[dof(plain.model, joint)]) for joint in joints]
    # One list of (information, slope), joint by joint, for each set of windows.
    parts = [_pulsed(driven, u, residual, sizes) for residual in residuals]
    return [
        Carrier(
            f"force on {joint}",
            force_unit(plain.model, joint),
            joint,
            tuple(part[j][0] for part in parts),
            tuple(part[j][1] for part in parts),
        )
        for j, joint in enumerate(joints)
    ]


def _pulsed(driven: Hypothesis, u: Array, residual: Residual, sizes: Sequence[float]) -> list[tuple[Array, Array]]:
    """Information (w, k, k) and slope (w, k) of a force on each joint."""
    windows, joints = residual.windows, len(sizes)
    w, steps = windows.commands.shape[:2]
    k = min(_STRETCHES, len(windows.offsets) - 1)
    active = np.arange(k)[:, None] == np.arange(steps) * k // steps
    errors = residual.errors.reshape(w, -1)
    found = []
    for j, size in enumerate(sizes):  # one joint at a time, as every pulse is a world for each window
        pulses = np.zeros((k + 1, steps, joints))  # the last is none
        pulses[:k, :, j] = size * active
        commands = np.concatenate([np.tile(windows.commands, (k + 1, 1, 1)), np.repeat(pulses, w, axis=0)], axis=2)
        simulate = driven.simulator(_repeated(windows, commands, joints))
        simulated = simulate(driven.xi(u[None]))[0].reshape(k + 1, *windows.measured.shape)
        change = np.where(np.isfinite(windows.measured), np.nan_to_num(simulated[:k] - simulated[k]), 0.0)
        jacobian = np.moveaxis(residual.noise.whiten(change).reshape(k, w, -1), 0, -1) / size
        found.append((np.swapaxes(jacobian, 1, 2) @ jacobian, np.einsum("wmk,wm->wk", jacobian, errors)))
    return found


def _repeated(windows: Windows, commands: Array, new: int) -> Windows:
    """Windows as often as there are commands (n w, N, nu + new) for them."""
    times = len(commands) // len(windows)
    past = np.concatenate([windows.past_commands, np.zeros((*windows.past_commands.shape[:2], new))], axis=2)
    return replace(
        windows,
        start_time=np.tile(windows.start_time, times),
        recording=windows.recording * times,
        measured=np.tile(windows.measured, (times, 1, 1)),
        commands=commands,
        past_commands=np.tile(past, (times, 1, 1)),
        starts=windows.starts.select(np.tile(np.arange(len(windows)), times)),
    )


def readings(residuals: Sequence[Residual]) -> Iterator[Carrier]:
    """An offset of each column's reading: whitening W makes Wᵀ W of the units, and Wᵀ e of the errors."""
    for c, channel in enumerate(residuals[0].windows.channels):
        information, slope = [], []
        for residual in residuals:
            noise, shape = residual.noise, residual.errors.shape
            counted = np.isfinite(residual.windows.measured[..., c])
            units = counted[..., None] * stretches(shape[1], min(shape[1], _MOST_STRETCHES)) / noise.scale[c]
            basis = noise.basis.reshape(*shape, -1)[..., c, :]
            seen = np.einsum("wsk,wsm->wmk", units, basis)
            information.append(
                np.swapaxes(units, 1, 2) @ units
                - np.einsum("wmk,wm,wml->wkl", seen, noise.shrink * (2 - noise.shrink), seen)
            )
            twice = noise.whiten((residual.errors * noise.scale)[None])[0, ..., c]
            slope.append(np.einsum("wsk,ws->wk", units, twice))
        yield Carrier(f"reading of {channel.name}", channel.unit, "", tuple(information), tuple(slope))


def stretches(samples: int, k: int) -> Array:
    """Which of k stretches each sample is in, (S, k) of 0 and 1."""
    stretch = np.minimum(np.arange(samples) * k // max(samples - 1, 1), k - 1)
    return (stretch[:, None] == np.arange(k)).astype(np.float64)
