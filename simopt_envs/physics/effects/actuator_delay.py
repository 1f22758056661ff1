"""A drive that answers late."""

from __future__ import annotations

import mujoco

from simopt_envs.physics.effects.actuators import actuators
from simopt_envs.physics.effects.effect import Effect, Motion, object_name
from simopt_envs.physics.parameters import Parameter, Write

LONGEST = 0.1
"""The longest delay of a command that buffers are made for [s]."""


class ActuatorDelay(Effect):
    """Commands reach the drive later than the model has it (``delay``); a short lag looks the same."""

    name = "actuator_delay"
    law = "u(t) = u_c(t - T)"

    def places(self, model: mujoco.MjModel) -> tuple[str, ...]:
        """See :meth:`Effect.places`."""
        return actuators(model)

    def add(self, spec: mujoco.MjSpec, place: str) -> None:
        """See :meth:`Effect.add`."""
        add_history(spec, object_name(place))

    def parameters(self, model: mujoco.MjModel, place: str) -> tuple[Parameter, ...]:
        """See :meth:`Effect.parameters`."""
        write = Write("actuator_delay", object_name(place), operation="add")
        return (Parameter("delay", "s", 0.0, 0.0, LONGEST, "linear", (write,)),)

    def probes(self, model: mujoco.MjModel, place: str, motion: Motion) -> tuple[dict[str, float], ...]:
        """See :meth:`Effect.probes`."""
        return ({"delay": 0.01},)


def add_history(spec: mujoco.MjSpec, actuator: str) -> None:
    """Give an actuator a buffer of past commands, long enough for the longest delay, where it has none."""
    drive = spec.actuator(actuator)
    steps = int(LONGEST / spec.option.timestep) + 2
    drive.nsample = max(drive.nsample, steps)
    drive.interp = max(drive.interp, 1)  # linear, so that a delay may end between two steps
    drive.delay = max(drive.delay, 1e-9)  # a delay of 0 has no buffer
