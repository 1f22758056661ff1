"""A drive that is stronger or weaker than the model has it."""

from __future__ import annotations

import mujoco

from simopt_envs.physics.effects.actuators import affine_drives
from simopt_envs.physics.effects.effect import Effect, Motion, object_name
from simopt_envs.physics.parameters import Parameter, Write


class ActuatorGain(Effect):
    """All that a drive produces is scaled; of a servo, its stiffness and its damping alike."""

    name = "actuator_gain"
    law = "f = s (k_p (u - q) - k_v v)"

    def places(self, model: mujoco.MjModel) -> tuple[str, ...]:
        """See :meth:`Effect.places`."""
        return affine_drives(model)

    def parameters(self, model: mujoco.MjModel, place: str) -> tuple[Parameter, ...]:
        """See :meth:`Effect.parameters`."""
        fields = ("actuator_gainprm", "actuator_biasprm")
        writes = tuple(Write(field, object_name(place), (0, 1, 2), "scale") for field in fields)
        return (Parameter("scale", "1", 1.0, 0.01, 100.0, "log", writes),)

    def probes(self, model: mujoco.MjModel, place: str, motion: Motion) -> tuple[dict[str, float], ...]:
        """See :meth:`Effect.probes`."""
        return ({"scale": 1.05},)
