"""ξ of the swing-peg task: the paper's 35 dimensions in MuJoCo's quantities, the hole's place, and latency.

As in the paper ``peg_mass`` and ``peg_density`` are one quantity, written twice: no measurement tells them apart.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco

from simopt_envs.physics.parameters import Parameter, ParameterSpace, Write
from simopt_envs.tasks.arm import arm_parameters, scale_parameter
from simopt_envs.tasks.swingpeg.model import BENDING_JOINTS, LENGTH_FACTOR, SEGMENTS, WALLS, Dimensions

_HOLE_REACH = 0.1  # m, how far the hole may lie from its nominal place along each axis
_ROPE_FACTOR = 50.0  # how far a rope's stiffness and damping may lie from nominal; the paper's moved as far
_LINKS = (*SEGMENTS, "peg")  # what a joint of the rope holds


def swingpeg_parameters(model: mujoco.MjModel) -> ParameterSpace:
    """The parameters, their nominals those of the model and of its :class:`Dimensions`."""
    d = Dimensions()
    return ParameterSpace(
        [
            *arm_parameters(model),
            scale_parameter(
                "rope_torsion_stiffness",
                "N m/rad",
                d.rope_torsion_stiffness,
                (Write("jnt_stiffness", "peg_torsion", (0,)),),
                "torsional stiffness of the whole rope",
                factor=_ROPE_FACTOR,
            ),
            scale_parameter(
                "rope_torsion_damping",
                "N m s/rad",
                d.rope_torsion_damping,
                (Write("dof_damping", "peg_torsion", (0,)),),
                "torsional damping of the whole rope",
                factor=_ROPE_FACTOR,
            ),
            scale_parameter(
                "rope_bending_stiffness",
                "N m/rad",
                d.rope_bending_stiffness,
                tuple(Write("jnt_stiffness", joint, (0,)) for joint in BENDING_JOINTS),
                "bending stiffness of each of the rope's joints",
                factor=_ROPE_FACTOR,
            ),
            scale_parameter(
                "rope_bending_damping",
                "N m s/rad",
                d.rope_bending_damping,
                tuple(Write("dof_damping", joint) for joint in BENDING_JOINTS),
                "bending damping of each of the rope's joints",
                factor=_ROPE_FACTOR,
            ),
            scale_parameter(
                "rope_width",
                "m",
                d.rope_width,
                tuple(
                    write
                    for name in SEGMENTS
                    for write in (
                        *_material(name, 2),
                        Write("body_inertia", name, (2,), "scale", power=2),  # about the rope: width to the fourth
                        Write("geom_size", name, (0,), "scale"),
                    )
                ),
                "diameter of the rope, its mass with it",
                factor=LENGTH_FACTOR,
            ),
            scale_parameter(
                "rope_segment_length",
                "m",
                d.rope_segment_length,
                tuple(
                    write
                    for name in SEGMENTS
                    for write in (
                        *_material(name, 1),
                        Write("body_inertia", name, (0, 1), "scale", power=2),  # across the rope: length cubed
                        Write("body_ipos", name, (2,), "scale"),
                        Write("geom_pos", name, (2,), "scale"),
                        Write("geom_size", name, (1,), "scale"),
                    )
                )
                + tuple(Write("body_pos", name, (2,), "scale") for name in _LINKS[1:]),
                f"length of each of the rope's {len(SEGMENTS)} segments, its mass with it",
                factor=LENGTH_FACTOR,
            ),
            scale_parameter(
                "rope_friction",
                "1",
                d.rope_friction,
                _friction(SEGMENTS, WALLS),
                "sliding friction of the rope; a contact has the geometric mean of its two partners'",
            ),
            scale_parameter(
                "rope_density",
                "kg/m^3",
                d.rope_density,
                tuple(write for name in SEGMENTS for write in _material(name, 1)),
                "density of the rope",
            ),
            scale_parameter(
                "peg_scale",
                "1",
                1.0,
                (
                    *_material("peg", 3),
                    Write("body_inertia", "peg", operation="scale", power=2),  # size to the fifth
                    Write("body_ipos", "peg", operation="scale"),
                    Write("geom_pos", "peg", operation="scale"),
                    Write("geom_size", "peg", operation="scale"),
                    Write("site_pos", "peg", operation="scale"),
                    Write("site_size", "peg", operation="scale"),
                ),
                "size of the peg in all directions, its mass with it",
                factor=LENGTH_FACTOR,
            ),
            scale_parameter(
                "peg_friction",
                "1",
                d.peg_friction,
                _friction(["peg"], WALLS),
                "sliding friction of the peg; a contact has the geometric mean of its two partners'",
            ),
            scale_parameter("peg_mass", "1", 1.0, _material("peg", 1), "factor on the peg's mass"),
            scale_parameter("peg_density", "kg/m^3", d.peg_density, _material("peg", 1), "density of the peg"),
            scale_parameter(
                "box_scale",
                "1",
                1.0,
                tuple(Write(field, wall, operation="scale") for wall in WALLS for field in ("geom_pos", "geom_size"))
                + tuple(Write(field, "hole", operation="scale") for field in ("site_pos", "site_size")),
                "size of the box and of its hole in all directions, about the hole's mouth",
                factor=LENGTH_FACTOR,
            ),
            scale_parameter(
                "box_friction",
                "1",
                d.box_friction,
                _friction(_LINKS, WALLS),
                "sliding friction of the box; a contact has the geometric mean of its two partners'",
            ),
            *(
                Parameter(
                    f"hole_{axis}",
                    "m",
                    0.0,
                    -_HOLE_REACH,
                    _HOLE_REACH,
                    "linear",
                    (Write("body_pos", "box", (i,), "add"),),
                    f"offset of the hole from its nominal place along {axis}",
                )
                for i, axis in enumerate("xyz")
            ),
        ]
    )


def _material(body: str, power: float) -> tuple[Write, ...]:
    """A body's mass, and its inertia with it."""
    return tuple(Write(field, body, operation="scale", power=power) for field in ("body_mass", "body_inertia"))


def _friction(geoms: Sequence[str], walls: Sequence[str]) -> tuple[Write, ...]:
    """One partner's share of the friction of every pair: the square root, as in their geometric mean."""
    return tuple(Write("pair_friction", f"{g}_{w}", (0, 1), "scale", power=0.5) for g in geoms for w in walls)
