"""A drive that answers late."""

from __future__ import annotations

import mujoco

from simopt_envs.physics.effects.actuators import actuators
from simopt_envs.physics.effects.effect import Effect, Motion, object_name
from simopt_envs.physics.parameters import Parameter, Write

LONGEST = 0.1
"""The longest delay of a command that is looked for [s]."""


class ActuatorDelay(Effect):
    """Commands reach the drive later than the model has it (``delay``); a short lag looks the same."""

    name = "actuator_delay"
    law = "u(t) = u_c(t - T)"

    def places(self, model: mujoco.MjModel) -> tuple[str, ...]:
        """See :meth:`Effect.places`."""
        return actuators(model)

    def parameters(self, model: mujoco.MjModel, place: str) -> tuple[Parameter, ...]:
        """See :meth:`Effect.parameters`."""
        write = Write("command.delay", object_name(place), operation="add")
        return (Parameter("delay", "s", 0.0, 0.0, LONGEST, "linear", (write,)),)

    def probes(self, model: mujoco.MjModel, place: str, motion: Motion) -> tuple[dict[str, float], ...]:
        """See :meth:`Effect.probes`."""
        return ({"delay": 0.005},)
