"""What drives were told before a recording that begins at rest: to hold the system where it is."""

from __future__ import annotations

import mujoco
import numpy as np

from simopt_envs.measured.channels import commanded_actuators
from simopt_envs.measured.resample import Array
from simopt_envs.physics.effects.actuators import affine_bias, command_sources, moments

_FIXED = int(mujoco.mjtGain.mjGAIN_FIXED)
_LINEAR = int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)
_INTEGRATES = int(mujoco.mjtDyn.mjDYN_INTEGRATOR)


def holding_commands(model: mujoco.MjModel, qpos: Array, first: Array) -> Array:
    """The commands that hold the model at rest in a posture (nq,), in least squares, (nu,).

    Of motors and servos; of other drives, and of those that could not hold it, the first command of the recording
    ``first`` (nu,), which then tells most of those before. Of a drive with a dead band, as if it had none.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    data.qacc[:] = 0.0
    mujoco.mj_inverse(model, data)
    sources, arms = command_sources(model), moments(model, data)
    commanded = np.array(commanded_actuators(model), dtype=np.intp)
    own = np.flatnonzero(sources == np.arange(len(sources)))
    drives = commanded[own]
    others = np.setdiff1d(np.arange(len(arms)), commanded)  # as cogging, which acts whatever is told
    held = data.qfrc_inverse - arms[others].T @ data.actuator_force[others]
    needed = np.linalg.lstsq(arms[drives].T, held, rcond=None)[0]
    gain, (offset, stiffness, _) = model.actuator_gainprm[:, 0], affine_bias(model).T
    bias = (offset + stiffness * data.actuator_length)[drives]
    told = (model.actuator_gaintype == _FIXED) & np.isin(model.actuator_biastype, _LINEAR) & (gain != 0)
    told &= model.actuator_dyntype != _INTEGRATES
    low, high = model.actuator_forcerange[drives].T
    enough = (model.actuator_forcelimited[drives] == 0) | ((needed >= low) & (needed <= high))
    commands = first.copy()
    commands[own] = np.where(
        told[drives] & enough, (needed - bias) / np.where(gain == 0, 1.0, gain)[drives], first[own]
    )
    return commands[sources]
