"""What the effects of joints share: which joints there are, their units, and what is put on or behind them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from simopt_envs.physics.effects.effect import Motion, object_name
from simopt_envs.physics.parameters import Parameter

_LEAST_ROTOR = 0.1  # of the inertia along a joint that belongs to its motor, at least
_LEAST_STAGE = 1e-3  # and to every joint behind it, so that the mass matrix is regular
_BEARING = ".bearing"  # what the name of the tendon ends in that has what resists a link behind a transmission
_RESISTS = {f"dof_{quantity}": f"tendon_{quantity}" for quantity in ("damping", "dampingpoly", "frictionloss")}
_TENDON = mujoco.mjtObj.mjOBJ_TENDON
_MOST_DOFS = 6  # of a body, that MuJoCo takes

SCALAR_JOINTS = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
"""Those whose one number's rate is their velocity."""


def scalar_joints(model: mujoco.MjModel) -> tuple[str, ...]:
    """``"joint:NAME"`` of every named hinge and slide."""
    names = (model.joint(i).name for i in range(model.njnt) if model.jnt_type[i] in SCALAR_JOINTS)
    return tuple(f"joint:{name}" for name in names if name)


def dof(model: mujoco.MjModel, joint: str) -> int:
    """The degree of freedom of a hinge or slide."""
    return int(model.jnt_dofadr[model.joint(joint).id])


def is_slide(model: mujoco.MjModel, joint: str) -> bool:
    """Whether a joint slides."""
    return bool(model.joint(joint).type[0] == int(mujoco.mjtJoint.mjJNT_SLIDE))


def force_unit(model: mujoco.MjModel, joint: str) -> str:
    """N or N m."""
    return "N" if is_slide(model, joint) else "N m"


def position_unit(model: mujoco.MjModel, joint: str) -> str:
    """Metres or radians, as m or rad."""
    return "m" if is_slide(model, joint) else "rad"


def speed_unit(model: mujoco.MjModel, joint: str) -> str:
    """m/s or rad/s."""
    return "m/s" if is_slide(model, joint) else "rad/s"


def damping_unit(model: mujoco.MjModel, joint: str) -> str:
    """N s/m or N m s/rad."""
    return "N s/m" if is_slide(model, joint) else "N m s/rad"


def stiffness_unit(model: mujoco.MjModel, joint: str) -> str:
    """N/m or N m/rad."""
    return "N/m" if is_slide(model, joint) else "N m/rad"


def inertia_unit(model: mujoco.MjModel, joint: str) -> str:
    """Kilograms or kilogram square metres, as kg or kg m2."""
    return "kg" if is_slide(model, joint) else "kg m2"


def reference(model: mujoco.MjModel, joint: str) -> float:
    """Where the joint is in the model's reference pose [rad, m]."""
    return float(model.qpos0[model.jnt_qposadr[model.joint(joint).id]])


def probe_force(model: mujoco.MjModel, joint: str, motion: Motion) -> float:
    """A force along the joint that would just show in the recordings [N m, N]: a twentieth of what moves it."""
    return 0.05 * float(motion.force[dof(model, joint)])


def blank() -> Any:
    """Defaults of no model: what is added to one must not inherit the damping, gears or limits of its classes."""
    return mujoco.MjSpec().default


def add_fixed_tendon(spec: mujoco.MjSpec, name: str, *joints: str) -> Any:
    """A tendon whose length is the sum of the joints' positions."""
    tendon = spec.add_tendon(blank(), name=name)
    for joint in joints:
        tendon.wrap_joint(joint, 1.0)
    return tendon


def add_passive_motor(spec: mujoco.MjSpec, name: str, joint: str, lugre: Sequence[float] = (0.0,) * 5) -> Any:
    """A motor without windings or command: its ``biasprm`` are cogging (A, n, phase), then friction (Fc, Fs, vs).

    It comes after the model's own actuators and takes no control. What it does counts towards the joint's
    ``actuatorfrcrange``, if there is one.

    Args:
        spec: changed in place.
        name: of the new actuator.
        joint: that it acts on.
        lugre: bristle stiffness and damping, Fc, Fs and vs of LuGre friction (Canudas de Wit et al. 1995), if any.
    """
    motor = spec.add_actuator(blank(), name=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=joint)
    motor.set_to_dcmotor([0.0, 0.0], 1.0, lugre=list(lugre), ctrlspec=int(mujoco.mjtCtrlInput.mjINPUT_NONE))
    return motor


def keep_keyframes(spec: mujoco.MjSpec, before: mujoco.MjModel, joint: str) -> None:
    """Let the keyframes of a spec have a joint that was added to its model at its reference, all else where it was.

    MuJoCo puts what they lack at their ends, wherever the joint is.
    """
    after = spec.copy().compile()
    at, of_speed = after.jnt_qposadr[after.joint(joint).id], dof(after, joint)
    for key, qpos, qvel in zip(spec.keys, before.key_qpos, before.key_qvel, strict=True):
        if len(key.qpos):
            key.qpos = np.insert(qpos, at, after.qpos0[at])
        if len(key.qvel):
            key.qvel = np.insert(qvel, of_speed, 0.0)


def inertia(spec: mujoco.MjSpec, joint: str) -> float:
    """Inertia along the joint in the model's reference pose [kg m2, kg]."""
    model = spec.copy().compile()
    return float(model.dof_M0[dof(model, joint)])


def outermost_joints(model: mujoco.MjModel) -> tuple[str, ...]:
    """``"joint:NAME"`` of the hinges and slides that a coaxial joint can be put behind: the last of their bodies.

    A body that its joints move in six ways, as a loose object, can have no more.
    """
    joints = zip(model.body_jntadr, model.body_jntnum, model.body_dofnum, strict=True)
    last = {int(adr + num) - 1 for adr, num, dofs in joints if 0 < dofs < _MOST_DOFS}
    return tuple(place for place in scalar_joints(model) if model.joint(object_name(place)).id in last)


def add_link_joint(spec: mujoco.MjSpec, joint: str, name: str) -> Any:
    """A joint on the axis of another, which is then the motor and its encoder; the link is where their sum is.

    A joint's damping and friction are between its bodies, so that they go to the link: to a tendon ``NAME.bearing``,
    whose length is that sum (:func:`on_bearing`). Its armature and its drives are the motor's, and so are its spring
    and its stops (``range``), which act on what the encoder shows.

    A motor without inertia would be thrown about by the smallest force between it and the link, so where the model
    gives it (almost) none, the new joint has some: it counts only while motor and link move against each other.
    """
    motor, total, model = spec.joint(joint), inertia(spec, joint), spec.copy().compile()
    at, axis = model.joint(joint).pos, model.joint(joint).axis  # the spec's are in the frame that the joint may be in
    link = motor.parent.add_joint(blank(), name=name, type=motor.type, pos=at, axis=axis)
    bearing = spec.tendon(joint + _BEARING)
    if bearing is None:
        bearing = add_fixed_tendon(spec, joint + _BEARING, joint)
        bearing.damping, motor.damping = np.array(motor.damping), np.zeros(len(motor.damping))
        bearing.frictionloss, motor.frictionloss = motor.frictionloss, 0.0
        bearing.solref_friction, bearing.solimp_friction = motor.solref_friction, motor.solimp_friction
    bearing.wrap_joint(name, 1.0)
    link.armature = max(_LEAST_ROTOR * total - motor.armature, _LEAST_STAGE * total)
    if motor.type == mujoco.mjtJoint.mjJNT_SLIDE:
        # Without effect on a slide, except that MuJoCo no longer takes the mass matrix of its body for diagonal, as it
        # does for slides along its axes.
        link.pos = at + 1.0
    keep_keyframes(spec, model, name)
    return link


def on_bearing(model: mujoco.MjModel, parameter: Parameter) -> Parameter:
    """The parameter, where it writes damping or friction of a joint with a transmission, as it is the link's."""
    writes = tuple(
        replace(write, field=_RESISTS[write.field], object=f"{write.object}{_BEARING}")
        if write.field in _RESISTS and mujoco.mj_name2id(model, _TENDON, f"{write.object}{_BEARING}") >= 0
        else write
        for write in parameter.writes
    )
    return replace(parameter, writes=writes)
