"""Friction of a joint that grows with the load on its drive."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from simopt_envs.physics.effects.actuators import BRAKE, actuators, driven_joint
from simopt_envs.physics.effects.effect import Effect, Motion, object_name
from simopt_envs.physics.effects.joints import add_fixed_tendon, blank, inertia, is_slide, keep_keyframes, scalar_joints
from simopt_envs.physics.parameters import Array, Parameter, Write

_DRUM = 1.0  # m: its radius; the law does not depend on it
_RAIL = 100.0  # m: half the length of a slide's rail
_SHOE = 0.01  # m: radius
_WEIGHT = 2e-6  # of the caliper, in units of the joint's inertia: nothing ...
_LEAST = 1e-14  # kg: ... but more than what MuJoCo takes for none
_CALIPER = 0.1  # its inertia, in the same units: lighter, it gives more to servos; heavier, fast motion throws it off
_DAMPING = 30.0  # of its motion, in units of its inertia / dt: so that it does not rattle
_STIFFNESS = 1.0  # of the contact, in units of 1/dt^2
_GRIP = 400.0  # 1/s: at less, slow motion creeps; at more, fast motion throws the caliper off, as cones are convex
_NEEDED = int(mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)


class LoadDependentFriction(Effect):
    """Coulomb friction of a joint in proportion to the force of its drives (``coefficient``).

    MuJoCo knows friction under load only between geoms, so the drives press a brake: a caliper ``NAME.brake``, which
    slides on the parent body across the joint's axis, has two shoes about a drum (of a slide: a rail) on the link. The
    drives pull at a tendon that is as long as both joints' positions together, and so act on the joint as before and on
    the caliper with the same force.

    It is an approximation. Against the law integrated finely, what it changes is right to 10 % for a slide, for
    coefficients up to 0.1, and for a hinge at 0.02, and to 40 % for a hinge at 0.1 and 13 rad/s. The caliper gives by
    about 10 dt^2 force / inertia, which a servo takes for motion of its joint, and at rest the brake creeps.
    """

    name = "load_dependent_friction"
    law = "f = -mu |f_drive| sign(v)"

    def places(self, model: mujoco.MjModel) -> tuple[str, ...]:
        """Hinges and slides with a drive that are the only joints of their bodies; none where contacts are off."""
        if model.opt.disableflags & _NEEDED:
            return ()
        driven = {driven_joint(model, object_name(place)) for place in actuators(model)}
        joints = ((place, model.joint(object_name(place))) for place in scalar_joints(model))
        return tuple(place for place, j in joints if j.name in driven and model.body_jntnum[j.bodyid[0]] == 1)

    def add(self, spec: mujoco.MjSpec, place: str) -> None:
        """See :meth:`Effect.add`."""
        joint = object_name(place)
        unfused = spec.copy()
        unfused.compiler.fusestatic = False  # the caliper is put on the spec's parent, a fused model's is another
        model = unfused.compile()
        own, dt, link = inertia(spec, joint), spec.option.timestep, spec.joint(joint).parent
        slides, at_joint = is_slide(model, joint), model.joint(joint).pos
        press, side = _across(model.joint(joint).axis)
        _add_drum(link, joint, press, side, at_joint, slides)
        body = model.jnt_bodyid[model.joint(joint).id]
        anchor = np.zeros(3)
        mujoco.mju_rotVecQuat(anchor, at_joint, model.body_quat[body])
        at = model.body_pos[body] + anchor
        caliper = link.parent.add_body(blank(), name=joint + BRAKE, pos=at, quat=model.body_quat[body])
        weight = max(_WEIGHT * own, _LEAST)
        caliper.explicitinertial, caliper.mass = True, weight
        caliper.ipos, caliper.inertia = np.zeros(3), np.full(3, weight)
        caliper.add_joint(
            blank(),
            name=joint + BRAKE,
            type=mujoco.mjtJoint.mjJNT_SLIDE,
            axis=press,
            armature=_CALIPER * own,
            damping=[_DAMPING * _CALIPER * own / dt, 0, 0],
        )
        for name, end in zip(_shoes(joint), (1.0, -1.0), strict=True):
            caliper.add_geom(
                blank(),
                name=name,
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                size=[_SHOE, 0.0, 0.0],
                pos=end * (_DRUM + _SHOE) * press,
                mass=0.0,
                **_UNSEEN,
            )
            pair = spec.add_pair(blank(), name=name, geomname1=_drum(joint), geomname2=name, condim=3)
            pair.friction, pair.solref = np.zeros(5), [-_STIFFNESS / dt**2, -_GRIP]
            pair.solimp = [0.9999, 0.9999, 0.001, 0.5, 2.0]
        tendon = add_fixed_tendon(spec, joint + BRAKE, joint, joint + BRAKE)
        for drive, compiled in zip(spec.actuators, map(model.actuator, range(model.nactuator)), strict=True):
            if drive.trntype == mujoco.mjtTrn.mjTRN_JOINT and drive.target == joint:
                drive.trntype, drive.target = mujoco.mjtTrn.mjTRN_TENDON, tendon.name
                if drive.inheritrange:
                    drive.inheritrange, drive.ctrlrange = 0, compiled.ctrlrange
        keep_keyframes(spec, model, joint + BRAKE)

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


def _across(axis: Array) -> tuple[Array, Array]:
    """Two unit vectors at right angles to a unit axis and to each other."""
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first /= np.linalg.norm(first)
    return first, np.cross(axis, first)


def _add_drum(link: Any, joint: str, press: Array, side: Array, at: Array, slides: bool) -> None:
    """What the shoes press on: a cylinder about a hinge's axis or a flat rail along a slide's, on the link."""
    axis = np.cross(press, side)
    # Columns: the drum's x, y and z in the frame of the link. A cylinder's axis is z; a rail is thick along z.
    frame = np.column_stack([axis, side, -press] if slides else [press, side, axis])
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, frame.ravel())
    link.add_geom(
        blank(),
        name=_drum(joint),
        type=mujoco.mjtGeom.mjGEOM_BOX if slides else mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=[_RAIL, _DRUM, _DRUM] if slides else [_DRUM, _DRUM, 0.0],
        pos=at,
        quat=quat,
        mass=0.0,
        **_UNSEEN,
    )
