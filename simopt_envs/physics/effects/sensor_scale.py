"""A sensor that shows a multiple of what it should."""

from __future__ import annotations

import mujoco

from simopt_envs.physics.effects.effect import Effect, Motion
from simopt_envs.physics.effects.joints import scalar_joints
from simopt_envs.physics.effects.readings import columns, sensors, sites
from simopt_envs.physics.parameters import Parameter, Write


class SensorScale(Effect):
    """What is recorded is scaled, positions and velocities alike, or a site; a servo reads its own encoder unscaled."""

    name = "sensor_scale"
    law = "y = s x"
    of_reading = True

    def places(self, model: mujoco.MjModel) -> tuple[str, ...]:
        """See :meth:`Effect.places`."""
        return scalar_joints(model) + sensors(model) + sites(model)

    def parameters(self, model: mujoco.MjModel, place: str) -> tuple[Parameter, ...]:
        """See :meth:`Effect.parameters`."""
        writes = tuple(Write("column.scale", column, operation="scale") for column in columns(model, place))
        return (Parameter("scale", "1", 1.0, 0.01, 100.0, "log", writes),)

    def probes(self, model: mujoco.MjModel, place: str, motion: Motion) -> tuple[dict[str, float], ...]:
        """See :meth:`Effect.probes`."""
        return ({"scale": 1.02},)
