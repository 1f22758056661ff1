"""What the effects of actuators share: which drives there are, their gears, units and forces."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from simopt_envs.physics.effects.effect import Motion, object_name
from simopt_envs.physics.effects.joints import force_unit, scalar_joints
from simopt_envs.physics.parameters import Array, Parameter
from simopt_envs.physics.writer import actuator_rows

DEADBAND = ".deadband"
"""What the name of the second actuator of a drive with a dead band ends in."""
BRAKE = ".brake"
"""What the name of the tendon ends in through which a drive moves a joint, and presses a brake on it."""
_LINEAR = ("actuator_gainprm", "actuator_biasprm")
_AFFINE_GAINS = (int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE))
_AFFINE_BIASES = (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE))


def actuators(model: mujoco.MjModel) -> tuple[str, ...]:
    """``"actuator:NAME"`` of every named actuator with one command, less those that a dead band adds."""
    drives = (model.actuator(int(i)).name for i in np.flatnonzero(actuator_rows(model, "ctrl")[1] == 1))
    return tuple(f"actuator:{name}" for name in drives if name and not name.endswith(DEADBAND))


def affine_drives(model: mujoco.MjModel) -> tuple[str, ...]:
    """``"actuator:NAME"`` of every named drive whose force is ``gain * u + bias``: motors and servos."""
    drives = ((place, model.actuator(object_name(place))) for place in actuators(model))
    return tuple(
        place for place, drive in drives if drive.gaintype[0] in _AFFINE_GAINS and drive.biastype[0] in _AFFINE_BIASES
    )


def affine_bias(model: mujoco.MjModel) -> Array:
    """The constant of each actuator's bias, and what it has per length and per velocity, (nactuator, 3).

    None where it is of another law, as of muscles, which keep other numbers there.
    """
    affine = model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_AFFINE)
    return np.where(affine[:, None], model.actuator_biasprm[:, :3], 0.0)


def driven_joint(model: mujoco.MjModel, actuator: str) -> str | None:
    """The hinge or slide that a drive moves; None where it moves something else, a tendon or a site."""
    drive = model.actuator(actuator)
    if drive.trntype[0] == int(mujoco.mjtTrn.mjTRN_JOINT):
        joint = str(model.joint(drive.trnid[0]).name)
    elif drive.trntype[0] == int(mujoco.mjtTrn.mjTRN_TENDON) and model.tendon(drive.trnid[0]).name.endswith(BRAKE):
        joint = str(model.tendon(drive.trnid[0]).name).removesuffix(BRAKE)
    else:
        return None
    return joint if f"joint:{joint}" in scalar_joints(model) else None


def gear(model: mujoco.MjModel, actuator: str) -> float:
    """Force along the joint that a drive moves, per force of the drive; 1 where it moves something else."""
    return 1.0 if driven_joint(model, actuator) is None else float(model.actuator(actuator).gear[0])


def drive_unit(model: mujoco.MjModel, actuator: str) -> str:
    """N or N m, of the joint that a drive moves; N where it moves something else."""
    joint = driven_joint(model, actuator)
    return "N" if joint is None else force_unit(model, joint)


def moments(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
    """The moment arms by which the first output of each actuator acts on degrees of freedom, (nactuator, nv)."""
    arms: Array = np.zeros((len(data.moment_rownnz), model.nv))
    mujoco.mju_sparse2dense(arms, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    return arms[actuator_rows(model, "out")[0]]


def drive_force(model: mujoco.MjModel, actuator: str, motion: Motion) -> float:
    """Root mean square of the force of a drive [N, N m], from that of what it moves, times its :func:`gear`."""
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    arm = np.abs(moments(model, data)[model.actuator(actuator).id])
    moved = arm > 0
    return float(np.max(motion.force[moved] / arm[moved], initial=0.0)) * abs(gear(model, actuator))


def command_sources(model: mujoco.MjModel) -> NDArray[np.intp]:
    """Whose command each control is, (nu,): the part that a dead band adds gets that of its drive."""
    sources, (first, _) = np.arange(model.nu), actuator_rows(model, "ctrl")
    for drive in map(object_name, actuators(model)):
        if (part := _added_part(model, drive)) is not None:
            own, added = (first[model.actuator(name).id] for name in (drive, part))
            sources[added] = own
    return sources


def on_all_parts(model: mujoco.MjModel, parameter: Parameter) -> Parameter:
    """The parameter, where it scales or delays a drive with a dead band, on both actuators of that drive."""
    added = tuple(
        replace(write, object=part)
        for write in parameter.writes
        if write.object is not None
        and (write.field == "actuator_delay" or (write.field in _LINEAR and write.operation == "scale"))
        and (part := _added_part(model, write.object)) is not None
    )
    return replace(parameter, writes=parameter.writes + added) if added else parameter


def _added_part(model: mujoco.MjModel, drive: str) -> str | None:
    """The actuator that a dead band adds to a drive, if it has one."""
    part = drive + DEADBAND
    return part if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, part) >= 0 else None
