"""A drive that answers late."""

from __future__ import annotations

import mujoco

from simopt_envs.physics.effects.actuators import actuators
from simopt_envs.physics.effects.effect import Effect, Motion, object_name
from simopt_envs.physics.parameters import Parameter, Write

LONGEST = 0.1
"""The longest delay of a command that is looked for [s]."""


class ActuatorDelay(Effect):
    """Commands reach the drive later than the model has it (``delay``).

    A share of the delay (``lag_share``) is a first-order lag, as of a filter or a current loop, the rest dead time.
    """

    name = "actuator_delay"
    law = "u(t) = u_c(t - (1 - s) T), lagging by s T"
    shape = ("lag_share",)

    def places(self, model: mujoco.MjModel) -> tuple[str, ...]:
        """See :meth:`Effect.places`."""
        return actuators(model)

    def parameters(self, model: mujoco.MjModel, place: str) -> tuple[Parameter, ...]:
        """See :meth:`Effect.parameters`."""
        drive = object_name(place)
        late = Write("command.delay", drive, operation="add")
        lagging = Write("command.lag_share", drive, operation="add")
        return (
            Parameter("delay", "s", 0.0, 0.0, LONGEST, "linear", (late,)),
            Parameter("lag_share", "1", 0.0, 0.0, 1.0, "linear", (lagging,)),
        )

    def probes(self, model: mujoco.MjModel, place: str, motion: Motion) -> tuple[dict[str, float], ...]:
        """See :meth:`Effect.probes`."""
        return {"delay": 0.005}, {"delay": 0.005, "lag_share": 1.0}
