"""How a system moved in its recordings: the ranges, speeds and forces that effects are first tried at."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from simopt_envs.measured.channels import actuator_names
from simopt_envs.measured.engines import settle_actuators
from simopt_envs.measured.recording import Recording
from simopt_envs.measured.states import estimate_states
from simopt_envs.physics.effects import Motion
from simopt_envs.physics.effects.joints import SCALAR_JOINTS

_SAMPLES = 50  # of each recording
_LEAST = 1e-6  # share of the largest: a joint that never moved has a range and a speed


def motion_of(model: mujoco.MjModel, recordings: Sequence[Recording], keyframe: str | None = None) -> Motion:
    """The motion in recordings, from their estimated states.

    The force on a degree of freedom is what its drives, gravity and its own inertia make, root of the sum of squares.
    """
    qpos, qvel, ctrl = [], [], []
    for recording in recordings:
        grid = recording.resample(recording.period)
        samples = np.unique(np.linspace(0, len(grid) - 1, _SAMPLES).astype(np.intp))
        joints = [grid[name][samples] for name in grid.signals if name.startswith("qpos/")]
        samples = samples[np.isfinite(np.array(joints).reshape(-1, len(samples))).all(axis=0)]
        states = estimate_states(model, grid, samples, keyframe)
        qpos.append(states.qpos)
        qvel.append(states.qvel)
        commands = [grid[f"ctrl/{name}"][samples] for name in actuator_names(model)]
        ctrl.append(np.stack(commands, axis=-1) if commands else np.empty((len(samples), 0)))
    positions, velocities, controls = map(np.concatenate, (qpos, qvel, ctrl))
    data = mujoco.MjData(model)
    forces = np.empty_like(velocities)
    inertia = np.empty_like(velocities)
    for i, (position, velocity, control) in enumerate(zip(positions, velocities, controls, strict=True)):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = position, velocity, control
        settle_actuators(model, data, np.tile(control, (_longest_buffer(model), 1)))
        mujoco.mj_forward(model, data)
        forces[i] = np.hypot(data.qfrc_actuator, data.qfrc_bias)
        full = np.empty((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        inertia[i] = np.diag(full)
    coordinates = np.array([_from_reference(model, q) for q in positions])
    spread = np.maximum(coordinates.std(axis=0), 1e-9)
    speed = np.sqrt(np.mean(velocities**2, axis=0))
    accelerating = inertia.mean(axis=0) * speed**2 / spread
    force = np.hypot(np.sqrt(np.mean(forces**2, axis=0)), accelerating)
    low, travel = coordinates.min(axis=0), np.ptp(coordinates, axis=0)
    return Motion(
        low=low,
        high=low + np.maximum(travel, _LEAST * travel.max(initial=1.0)),
        speed=np.maximum(speed, _LEAST * speed.max(initial=1.0)),
        force=np.maximum(force, _LEAST * force.max(initial=1.0)),
        command=controls.std(axis=0),
    )


def _longest_buffer(model: mujoco.MjModel) -> int:
    return max(1, int(np.max(model.actuator_history[:, 0], initial=0)))


def _from_reference(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Where a posture is along each degree of freedom; for hinges and slides their coordinate."""
    out = np.zeros(model.nv)
    for j in range(model.njnt):
        if model.jnt_type[j] in SCALAR_JOINTS:
            out[model.jnt_dofadr[j]] = qpos[model.jnt_qposadr[j]]
    return out
