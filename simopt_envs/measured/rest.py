"""What drives were told before a recording that begins at rest: to hold the system where it is."""

from __future__ import annotations

import mujoco
import numpy as np

from simopt_envs.measured.resample import Array

_FIXED = int(mujoco.mjtGain.mjGAIN_FIXED)
_LINEAR = int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)
_INTEGRATES = int(mujoco.mjtDyn.mjDYN_INTEGRATOR)


def holding_commands(model: mujoco.MjModel, qpos: Array, first: Array) -> Array:
    """The commands that hold the model at rest in a posture (nq,), in least squares, (nu,).

    Of motors and servos; of other drives, and of those that could not hold it, the first command of the recording
    ``first`` (nu,), which then tells most of those before.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    data.qacc[:] = 0.0
    mujoco.mj_inverse(model, data)
    moment = np.zeros((model.nu, model.nv))
    mujoco.mju_sparse2dense(moment, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    needed = np.linalg.lstsq(moment.T, data.qfrc_inverse, rcond=None)[0]
    gain = model.actuator_gainprm[:, 0]
    bias = np.where(
        model.actuator_biastype == _LINEAR[1],
        model.actuator_biasprm[:, 0] + model.actuator_biasprm[:, 1] * data.actuator_length,
        0.0,
    )
    told = (model.actuator_gaintype == _FIXED) & np.isin(model.actuator_biastype, _LINEAR) & (gain != 0)
    told &= model.actuator_dyntype != _INTEGRATES
    limited = model.actuator_forcelimited.astype(bool)
    low, high = model.actuator_forcerange.T
    told &= ~limited | ((needed >= low) & (needed <= high))
    return np.where(told, (needed - bias) / np.where(gain == 0, 1.0, gain), first)
