"""Friction of a joint that grows with the load on it."""

from __future__ import annotations

import mujoco
import numpy as np

from simopt_envs.physics.effects.effect import Effect, Motion, object_name
from simopt_envs.physics.effects.joints import add_link_joint, blank, dof, outermost_joints
from simopt_envs.physics.parameters import Parameter, Write

_ARM = 0.1  # m: of the brake's drum; the law does not depend on it
_RAIL = 100.0  # m: half the length of a slide's rail
_SHOE_MASS = 3e-5  # of the link's: lighter ones give under the load, heavier ones rattle
_SHOE_RADIUS = 0.01  # m
_GRIP = 200.0  # 1/s: at less, slow motion creeps; at more, fast motion spreads the shoes (MuJoCo's cones are convex)
_DAMPING = 0.6  # of the link against the motor, in units of inertia / timestep: against rattling
_NEEDED = int(
    mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_EQUALITY | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
)


class LoadDependentFriction(Effect):
    """Coulomb friction in proportion to the torque that a joint's gear transmits (``coefficient``).

    MuJoCo knows friction under load only between geoms, so the gear is a brake that the load presses on: motor and
    link are joints NAME and ``NAME.load`` on one axis, and what they turn against each other presses one of two shoes
    on a drum (of a slide: a rail) on the parent body. Sliding there is the motion of NAME; the pressure is the load.

    It is an approximation, made for coefficients up to about 0.1. Against the law integrated finely, at 2 ms, its
    effect on a loaded arm was right to 7 % up to 6 rad/s and, at 13 rad/s, 3 % too large for 0.05, 18 % for 0.1 and
    60 % for 0.2. The brake gives by about 4 dt^2 load / inertia, and at rest it creeps.
    """

    name = "load_dependent_friction"
    law = "f = -mu |f_load| sign(v)"

    def places(self, model: mujoco.MjModel) -> tuple[str, ...]:
        """Hinges and slides that are the last joints of their bodies; none where constraints or contacts are off."""
        return () if model.opt.disableflags & _NEEDED else outermost_joints(model)

    def add(self, spec: mujoco.MjSpec, place: str) -> None:
        """See :meth:`Effect.add`."""
        joint = object_name(place)
        model = spec.copy().compile()
        motor = spec.joint(joint)
        link, body, dt = add_link_joint(spec, joint, f"{joint}.load"), motor.parent, spec.option.timestep
        slides = motor.type == mujoco.mjtJoint.mjJNT_SLIDE
        lever = 1.0 if slides else _ARM  # of the load, where it presses
        inertia = float(model.dof_M0[dof(model, joint)])
        link.damping[0] = _DAMPING * inertia / dt
        _add_drum(spec, model, joint, slides)
        hard = [0.9999, 0.9999, 0.001, 0.5, 2.0]
        anchor = model.jnt_pos[model.joint(joint).id]
        press, _ = _across(model.joint(joint).axis)
        for name, side in zip(_shoes(joint), (1.0, -1.0), strict=True):
            shoe = body.add_body(blank(), name=name, pos=anchor)
            shoe.add_joint(blank(), name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=side * press)
            shoe.add_geom(
                blank(),
                name=name,
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                size=[_SHOE_RADIUS, 0.0, 0.0],
                pos=side * (_ARM + _SHOE_RADIUS) * press,
                mass=_SHOE_MASS * inertia / lever**2,
                **_UNSEEN,
            )
            pair = spec.add_pair(blank(), name=name, geomname1=_drum(joint), geomname2=name, condim=3)
            pair.friction, pair.solimp, pair.solref = np.zeros(5), hard, [-0.25 / dt**2, -_GRIP]
            coupling = spec.add_equality(blank(), name=name, type=mujoco.mjtEq.mjEQ_JOINT, name1=name, name2=link.name)
            coupling.objtype, coupling.solimp, coupling.solref = mujoco.mjtObj.mjOBJ_JOINT, hard, [2 * dt, 1.0]
            coupling.data[:5] = [0.0, side * lever, 0.0, 0.0, 0.0]

    def parameters(self, model: mujoco.MjModel, place: str) -> tuple[Parameter, ...]:
        """See :meth:`Effect.parameters`."""
        writes = tuple(Write("pair_friction", name, (0, 1), "add") for name in _shoes(object_name(place)))
        return (Parameter("coefficient", "1", 0.0, 0.0, 0.3, "linear", writes),)

    def probes(self, model: mujoco.MjModel, place: str, motion: Motion) -> tuple[dict[str, float], ...]:
        """See :meth:`Effect.probes`."""
        return ({"coefficient": 0.05},)


_UNSEEN = {"contype": 0, "conaffinity": 0, "rgba": [0.0, 0.0, 0.0, 0.0]}


def _shoes(joint: str) -> tuple[str, str]:
    return f"{joint}.shoe0", f"{joint}.shoe1"


def _drum(joint: str) -> str:
    return f"{joint}.drum"


def _across(axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors at right angles to an axis and to each other."""
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first /= np.linalg.norm(first)
    return first, np.cross(axis, first)


def _add_drum(spec: mujoco.MjSpec, model: mujoco.MjModel, joint: str, slides: bool) -> None:
    """What the shoes press on: a cylinder about a hinge's axis or a flat rail along a slide's, on the parent body."""
    body, j = spec.joint(joint).parent, model.joint(joint).id
    b = model.jnt_bodyid[j]
    axis, anchor = model.jnt_axis[j], np.zeros(3)
    press, side = _across(axis)
    mujoco.mju_rotVecQuat(anchor, model.jnt_pos[j], model.body_quat[b])
    # Columns: the drum's x, y and z in the frame of the body. A cylinder's axis is z; a rail is thick along z.
    frame = np.column_stack([axis, side, -press] if slides else [press, side, axis])
    frame[:, 0] *= np.linalg.det(frame)
    quat, in_body = np.empty(4), np.empty(4)
    mujoco.mju_mat2Quat(in_body, frame.ravel())
    mujoco.mju_mulQuat(quat, model.body_quat[b], in_body)
    body.parent.add_geom(
        blank(),
        name=_drum(joint),
        type=mujoco.mjtGeom.mjGEOM_BOX if slides else mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=[_RAIL, _ARM, _ARM] if slides else [_ARM, _ARM, 0.0],
        pos=model.body_pos[b] + anchor,
        quat=quat,
        mass=0.0,
        **_UNSEEN,
    )
