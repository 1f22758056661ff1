"""The scene of the swing-peg task: ``model.xml`` with rope, peg and contacts added."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import as_file, files
from typing import Any

import mujoco
import numpy as np

SEGMENTS = tuple(f"segment{i}" for i in range(1, 9))
WALLS = ("wall_back", "wall_front", "wall_left", "wall_right", "wall_bottom")
# What bends: the rope pivots on a ball joint where the gripper holds it, and on two hinges at each further joint. Two
# hinges lose a direction where they bend by 90 degrees: rare between segments, but not at a gripper that tilts.
BENDING_JOINTS = ("grip", *(f"{link}_{axis}" for link in (*SEGMENTS[1:], "peg") for axis in "xy"))
LENGTH_FACTOR = 2.0  # how far ξ may scale a length, either way

_HOME = (-0.489, -1.052, 0.308, 0.414, -0.365, 1.303, 0.266)  # rad, the gripper pointing down in front of the robot
_ARMATURE = 1e-5  # kg m^2, keeps the joints of the light segments well conditioned


@dataclass(frozen=True)
class Dimensions:
    """Sizes and materials of rope and peg, and how rough the box is; its sizes are in ``model.xml``."""

    rope_width: float = 0.004  # m
    rope_segment_length: float = 0.04  # m
    rope_density: float = 2500.0  # kg/m^3
    rope_bending_stiffness: float = 1e-3  # N m/rad, of each joint
    rope_bending_damping: float = 5e-4  # N m s/rad
    rope_torsion_stiffness: float = 1e-3  # N m/rad, of the whole rope
    rope_torsion_damping: float = 2e-4  # N m s/rad
    rope_friction: float = 0.25
    peg_radius: float = 0.0125  # m
    peg_length: float = 0.10  # m, with its round ends
    peg_density: float = 400.0  # kg/m^3
    peg_friction: float = 0.5
    box_friction: float = 0.5


def make_model(dimensions: Dimensions = Dimensions(), visual: bool = True) -> mujoco.MjModel:
    """Compile the scene; without ``visual`` it lacks what is there only to be seen."""
    return compile_spec(make_spec(dimensions), visual)


def compile_spec(spec: mujoco.MjSpec, visual: bool = True) -> mujoco.MjModel:
    """Compile a spec of the scene; without ``visual`` it lacks what is there only to be seen."""
    spec.compiler.discardvisual = not visual
    model = spec.compile()
    model.geom_rbound *= LENGTH_FACTOR  # bounding spheres of the broad phase: large enough for every ξ
    return model


def make_spec(dimensions: Dimensions = Dimensions()) -> mujoco.MjSpec:
    """The scene, not yet compiled."""
    with as_file(files("simopt_envs.tasks.swingpeg")) as folder:
        spec = mujoco.MjSpec.from_file(str(folder / "model.xml"))
    last_segment = _add_rope(spec, dimensions)
    _add_peg(last_segment, dimensions)
    _add_contacts(spec, dimensions)
    straight = [1.0, *np.zeros(3 + 2 * len(SEGMENTS) + 1)]  # the grip's quaternion and the hinges
    spec.add_key(name="home", qpos=[*_HOME, *straight], ctrl=_HOME)
    return spec


def _add_rope(spec: mujoco.MjSpec, d: Dimensions) -> mujoco.MjsBody:
    """A chain of thin rods along z, from the grip on; returns the last one."""
    area = np.pi * d.rope_width**2 / 4.0
    mass = d.rope_density * area * d.rope_segment_length
    across, along = mass * d.rope_segment_length**2 / 12.0, mass * d.rope_width**2 / 8.0
    link, joint_z = spec.body("gripper"), spec.site("grip").pos[2]
    middle = [0, 0, d.rope_segment_length / 2]
    for name in SEGMENTS:
        link = link.add_body(
            name=name,
            pos=[0, 0, joint_z],
            explicitinertial=True,
            mass=mass,
            ipos=middle,
            inertia=[across, across, along],
        )
        if name == SEGMENTS[0]:
            link.add_joint(name="grip", type=mujoco.mjtJoint.mjJNT_BALL, **_bending(d))
        else:
            _add_bending_hinges(link, d)
        link.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            size=[d.rope_width / 2, d.rope_segment_length / 2, 0],
            pos=middle,
            material="rope",
            **_TOUCHES_NOTHING,
        )
        joint_z = d.rope_segment_length
    return link


def _add_peg(last_segment: mujoco.MjsBody, d: Dimensions) -> None:
    """The peg, its tip along z; it twists against the rope about that axis."""
    peg = last_segment.add_body(name="peg", pos=[0, 0, d.rope_segment_length])
    _add_bending_hinges(peg, d)
    torsion = _elastic(d.rope_torsion_stiffness, d.rope_torsion_damping)
    peg.add_joint(name="peg_torsion", axis=[0, 0, 1], **torsion)
    capsule = {
        "type": mujoco.mjtGeom.mjGEOM_CAPSULE,
        "size": [d.peg_radius, d.peg_length / 2 - d.peg_radius, 0],
        "pos": [0, 0, d.peg_length / 2],
    }
    peg.add_geom(name="peg", density=d.peg_density, material="peg", **capsule, **_TOUCHES_NOTHING)
    peg.add_site(name="peg", group=4, **capsule)


def _add_contacts(spec: mujoco.MjSpec, d: Dimensions) -> None:
    """Peg and rope against the box's walls, nothing else; the friction of a pair is the geometric mean of its two."""
    for geom, friction in (("peg", d.peg_friction), *((name, d.rope_friction) for name in SEGMENTS)):
        mean = np.sqrt(friction * d.box_friction)
        for wall in WALLS:
            spec.add_pair(
                name=f"{geom}_{wall}",
                geomname1=geom,
                geomname2=wall,
                condim=3,
                friction=[mean, mean, 0, 0, 0],
                solref=[0.01, 1],
            )


_TOUCHES_NOTHING = {"contype": 0, "conaffinity": 0}  # but what a pair names


def _add_bending_hinges(link: mujoco.MjsBody, d: Dimensions) -> None:
    for axis, direction in (("x", [1, 0, 0]), ("y", [0, 1, 0])):
        link.add_joint(name=f"{link.name}_{axis}", axis=direction, **_bending(d))


def _bending(d: Dimensions) -> dict[str, Any]:
    return _elastic(d.rope_bending_stiffness, d.rope_bending_damping)


def _elastic(stiffness: float, damping: float) -> dict[str, Any]:
    return {"stiffness": [stiffness, 0, 0], "damping": [damping, 0, 0], "armature": _ARMATURE}
