"""ξ of the drawer task: the paper's 26 dimensions in MuJoCo's quantities, the cabinet's place, and more."""

from __future__ import annotations

import mujoco

from simopt_envs.physics.parameters import Parameter, ParameterSpace, Write
from simopt_envs.tasks.arm import arm_parameters, scale_parameter

_FINGERS = ("finger_left", "finger_right")
_GRIPS = ("left_handle", "right_handle")
_CABINET_REACH = {"x": 0.25, "y": 0.1, "z": 0.1}  # m, how far the cabinet may stand from its nominal place


def drawer_parameters(model: mujoco.MjModel) -> ParameterSpace:
    """The parameters, their nominals read from the model."""
    slide = model.joint("drawer")
    return ParameterSpace(
        [
            *arm_parameters(model),
            Parameter(
                "gripper_gain",
                "1",
                1.0,
                0.1,
                10.0,
                writes=(
                    Write("actuator_gainprm", "gripper", (0,), "scale"),
                    Write("actuator_biasprm", "gripper", (1,), "scale"),
                ),
                description="factor on the stiffness of the gripper's servo",
            ),
            scale_parameter(
                "gripper_damping",
                "N s/m",
                model.joint(_FINGERS[0]).damping[0],
                tuple(Write("dof_damping", finger) for finger in _FINGERS),
                "viscous damping of each finger",
            ),
            scale_parameter(
                "drawer_stiffness",
                "N/m",
                slide.stiffness[0],
                (Write("jnt_stiffness", "drawer", (0,)),),
                "spring that pulls the drawer shut",
            ),
            scale_parameter(
                "drawer_damping",
                "N s/m",
                slide.damping[0],
                (Write("dof_damping", "drawer", (0,)),),
                "viscous damping of the drawer",
            ),
            scale_parameter(
                "drawer_friction",
                "N",
                slide.frictionloss[0],
                (Write("dof_frictionloss", "drawer"),),
                "Coulomb friction of the drawer",
            ),
            scale_parameter(
                "drawer_mass",
                "kg",
                model.body("drawer").mass[0],
                (Write("body_mass", "drawer", operation="scale"), Write("body_inertia", "drawer", operation="scale")),
                "mass of the drawer, its inertia with it",
            ),
            scale_parameter(
                "handle_friction",
                "1",
                model.pair(_GRIPS[0]).friction[0],
                tuple(Write("pair_friction", pair, (0, 1)) for pair in _GRIPS),
                "coefficient of sliding friction between fingers and handle",
            ),
            *(
                Parameter(
                    f"cabinet_{axis}",
                    "m",
                    0.0,
                    -reach,
                    reach,
                    "linear",
                    (Write("body_pos", "cabinet", ("xyz".index(axis),), "add"),),
                    f"offset of the cabinet from its nominal place along {axis}",
                )
                for axis, reach in _CABINET_REACH.items()
            ),
        ]
    )
