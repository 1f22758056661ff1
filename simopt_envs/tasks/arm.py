"""A seven-joint arm commanded by joint velocities, as both tasks use it."""

from __future__ import annotations

import mujoco
import numpy as np

from simopt_envs.physics.parameters import Array, Parameter, Write
from simopt_envs.physics.simulation import Simulation

JOINTS = tuple(f"joint{i}" for i in range(1, 8))
_LONGEST_LATENCY = 0.04  # s; the actuators' command buffers hold 44 (Panda) and 42 ms (YuMi)


class VelocityArm:
    """Turns velocity commands into targets of the joints' position servos.

    A target lies ``action_scaling * action * dt`` ahead of where the joint is, so the velocity reached depends on the
    servo's gain, on damping and on load, as it does on a compliant robot.

    Args:
        model: has joints and position servos ``joint1`` ... ``joint7``, each servo with a command buffer of at least
            40 ms, and custom numbers ``action_scaling`` [rad/s], one per joint.
        dt: seconds between two actions.
    """

    def __init__(self, model: mujoco.MjModel, dt: float):
        self.dt = dt
        self.qpos = np.array([model.joint(name).qposadr[0] for name in JOINTS])
        self.ctrl = np.array([model.actuator(name).id for name in JOINTS])
        start = model.numeric_adr[model.numeric("action_scaling").id]
        self._scaling = slice(start, start + len(JOINTS))

    def positions(self, simulation: Simulation) -> Array:
        """Joint positions [rad], (n, 7)."""
        return simulation.data("qpos")[:, self.qpos]

    def targets(self, simulation: Simulation, action: Array) -> Array:
        """Velocity commands (n, 7) in [-1, 1] -> servo targets [rad], (n, 7)."""
        scaling = simulation.model_field("numeric_data")[:, self._scaling]
        return self.positions(simulation) + scaling * action * self.dt


def arm_parameters(model: mujoco.MjModel) -> list[Parameter]:
    """The arm's part of ξ: servo gains, joint dampings, action scalings and the latency of its commands."""
    gains = [
        Parameter(
            f"joint_gain_{i}",
            "1",
            1.0,
            0.1,
            10.0,
            writes=(
                Write("actuator_gainprm", name, (0,), "scale"),
                Write("actuator_biasprm", name, (1,), "scale"),
            ),
            description=f"factor on the stiffness of joint {i}'s servo (the inverse of its compliance)",
        )
        for i, name in enumerate(JOINTS, 1)
    ]
    dampings = [
        scale_parameter(
            f"joint_damping_{i}",
            "N m s/rad",
            model.joint(name).damping[0],
            (Write("dof_damping", name),),
            f"viscous damping of joint {i}",
        )
        for i, name in enumerate(JOINTS, 1)
    ]
    scalings = [
        scale_parameter(
            f"action_scaling_{i}",
            "rad/s",
            model.numeric("action_scaling").data[i - 1],
            (Write("numeric_data", "action_scaling", (i - 1,)),),
            f"velocity that an action of 1 commands at joint {i}",
            factor=4.0,
        )
        for i in range(1, 8)
    ]
    latency = Parameter(
        "latency",
        "s",
        float(model.actuator_delay[model.actuator(JOINTS[0]).id]),
        0.0,
        _LONGEST_LATENCY,
        "linear",
        tuple(Write("actuator_delay", name) for name in JOINTS),
        "time from a command to the servos acting on it",
    )
    return [*gains, *dampings, *scalings, latency]


def scale_parameter(
    name: str, unit: str, nominal: float, writes: tuple[Write, ...], description: str, factor: float = 10.0
) -> Parameter:
    """A scale-like parameter, bounded by a factor to either side of its nominal."""
    nominal = float(nominal)
    return Parameter(name, unit, nominal, nominal / factor, nominal * factor, writes=writes, description=description)
