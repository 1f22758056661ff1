"""Under what circumstances each sample of a window was taken: motion, load, contact, commands, time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_opening

from simopt_envs.measured.channels import Channel, actuator_names
from simopt_envs.measured.engines import settle_actuators
from simopt_envs.measured.smoothing import smooth
from simopt_envs.measured.windows import Windows, simulate_windows
from simopt_envs.physics.effects import object_name
from simopt_envs.physics.effects.joints import dof, scalar_joints
from simopt_envs.physics.parameters import Array

Mask = NDArray[np.bool_]

_HELD = 0.05  # of a joint's root-mean-square speed: below it for this long, the joint is held
_HELD_FOR = 0.1  # s
_STEP = 0.1  # of a command's range: what it jumps by in one sample to count as a step
_AT_A_STOP = 0.005  # of a joint's range: so near to an end, it is there
_FEW_SAMPLES = 5  # that a local polynomial needs


@dataclass(frozen=True)
class Circumstances:
    """What the system did at each of S samples of w windows.

    Attributes:
        joints: names of the j hinges and slides.
        actuators: names of the u actuators.
        position, velocity, acceleration: of each joint, (w, S, j).
        load: the force of its drives on each joint, or where it has none, the gravity and inertial force there,
            (w, S, j).
        command: (w, S, u).
        contact: whether anything touches, (w, S).
        stopped: whether each joint is at an end of its range, (w, S, j).
        time: since the first window of the recording [s], (w, S).
        period: seconds between samples.
    """

    joints: tuple[str, ...]
    actuators: tuple[str, ...]
    position: Array
    velocity: Array
    acceleration: Array
    load: Array
    command: Array
    contact: Mask
    stopped: Mask
    time: Array
    period: float

    def held(self) -> Mask:
        """Whether each joint stands still, and not just to turn round, (w, S, j)."""
        still = np.abs(self.velocity) < _HELD * _rms(self.velocity)
        samples = max(2, round(_HELD_FOR / self.period))
        return binary_opening(still, structure=np.ones((1, samples, 1)))

    def direction(self) -> Array:
        """The direction that each joint last moved in, -1 or 1, (w, S, j); where it has not moved yet, that it will."""
        moving = np.abs(self.velocity) >= _HELD * _rms(self.velocity)
        index = np.arange(moving.shape[1])[:, None]
        latest = np.maximum.accumulate(np.where(moving, index, -1), axis=1)
        first = np.argmax(moving, axis=1)[:, None, :]
        sign = np.where(self.velocity < 0, -1.0, 1.0)
        return np.take_along_axis(sign, np.where(latest < 0, first, latest), axis=1)

    def stepped(self) -> Mask:
        """Whether any command jumped at a sample, (w, S)."""
        span = np.ptp(self.command, axis=(0, 1)) if self.command.size else np.zeros(self.command.shape[-1])
        jumps = np.abs(np.diff(self.command, axis=1, prepend=self.command[:, :1]))
        # Where most samples move the command that far, it is fast, not stepped.
        steps = (jumps > _STEP * span) & (span > 0)
        return np.any(steps & (steps.mean(axis=(0, 1)) < 0.5), axis=2)


def circumstances(model: mujoco.MjModel, windows: Windows) -> Circumstances:
    """The circumstances of windows' samples.

    Joints with a column of their own moved as that says, smoothed; the others as the model does from the estimated
    starts.

    Args:
        model: that the windows were cut for.
        windows: w windows of S samples.
    """
    joints = [object_name(place) for place in scalar_joints(model)]
    dofs = [dof(model, joint) for joint in joints]
    coordinates = [int(model.joint(joint).qposadr[0]) for joint in joints]
    qpos, qvel = _simulated_states(model, windows)
    period = float(windows.offsets[1] - windows.offsets[0])
    qacc = np.gradient(qvel, period, axis=1)
    for c, channel in enumerate(windows.channels):
        if channel.kind == "qpos" and channel.index in coordinates:
            d = dofs[coordinates.index(channel.index)]
            for w, measured in enumerate(windows.measured[..., c]):
                if np.isfinite(measured).sum() >= _FEW_SAMPLES <= len(measured):
                    smoothed = smooth(measured, period)
                    known = np.isfinite(measured)
                    qpos[w, known, channel.index] = smoothed.value[known]
                    qvel[w, known, d] = smoothed.velocity[known]
                    qacc[w, known, d] = smoothed.acceleration[known]
    command = np.concatenate([windows.commands, windows.commands[:, -1:]], axis=1)[:, :: windows.stride]
    load, contact = _forces(model, windows, qpos, qvel)
    begins = {
        name: min(t for t, of in zip(windows.start_time, windows.recording, strict=True) if of == name)
        for name in windows.recording
    }
    since = windows.start_time - np.array([begins[name] for name in windows.recording])
    return Circumstances(
        joints=tuple(joints),
        actuators=tuple(actuator_names(model)),
        position=qpos[..., coordinates],
        velocity=qvel[..., dofs],
        acceleration=qacc[..., dofs],
        load=load[..., dofs],
        command=command,
        contact=contact,
        stopped=_at_its_stops(model, joints, qpos[..., coordinates]),
        time=since[:, None] + windows.offsets,
        period=period,
    )


def _simulated_states(model: mujoco.MjModel, windows: Windows) -> tuple[Array, Array]:
    """qpos (w, S, nq) and qvel (w, S, nv); where a simulation diverged, its last state."""
    channels = [Channel(f"qpos/{i}", "qpos", i, -1, "") for i in range(model.nq)]
    channels += [Channel(f"qvel/{i}", "qvel", i, -1, "") for i in range(model.nv)]
    states = simulate_windows(model, replace(windows, channels=tuple(channels)))[0]
    reached = np.isfinite(states).all(axis=2)
    latest = np.maximum.accumulate(np.where(reached, np.arange(states.shape[1]), 0), axis=1)
    states = np.take_along_axis(states, latest[..., None], axis=1)
    return states[..., : model.nq].copy(), states[..., model.nq :].copy()


def _forces(model: mujoco.MjModel, windows: Windows, qpos: Array, qvel: Array) -> tuple[Array, Mask]:
    """The load (w, S, nv), see :class:`Circumstances`, and whether anything touches (w, S)."""
    data = mujoco.MjData(model)
    drive, bias = np.empty((2, *qvel.shape))
    contact = np.empty(qvel.shape[:2], dtype=bool)
    commands = np.concatenate([windows.past_commands, windows.commands, windows.commands[:, -1:]], axis=1)
    past = windows.past_commands.shape[1]
    for at in np.ndindex(contact.shape):
        window, step = at[0], at[1] * windows.stride
        data.qpos[:], data.qvel[:] = qpos[at], qvel[at]
        settle_actuators(model, data, commands[window, step : step + past])
        data.ctrl[:] = commands[window, step + past]
        mujoco.mj_forward(model, data)
        drive[at], bias[at], contact[at] = data.qfrc_actuator, data.qfrc_bias, data.ncon > 0
    return np.where(np.any(drive != 0, axis=(0, 1)), drive, bias), contact


def _at_its_stops(model: mujoco.MjModel, joints: Sequence[str], position: Array) -> Mask:
    """Whether joints at some positions (w, S, j) are at an end of their ranges."""
    ids = [model.joint(joint).id for joint in joints]
    low, high = model.jnt_range[ids].T
    near = _AT_A_STOP * (high - low)
    return (model.jnt_limited[ids] != 0) & ((position < low + near) | (position > high - near))


def _rms(values: Array) -> Array:
    """Over windows and samples, (j,)."""
    return np.sqrt(np.mean(values**2, axis=(0, 1)))
