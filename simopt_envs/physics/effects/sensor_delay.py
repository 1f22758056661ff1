"""A sensor that shows the past."""

from __future__ import annotations

import mujoco

from simopt_envs.physics.effects.effect import Effect, Motion
from simopt_envs.physics.effects.joints import scalar_joints
from simopt_envs.physics.effects.readings import columns, sensors, sites
from simopt_envs.physics.parameters import Parameter, Write


class SensorDelay(Effect):
    """What is recorded is late (``delay``); a servo reads its own encoder without the delay.

    A share of the delay (``lag_share``) is a first-order lag, as of a filter, the rest dead time.
    """

    name = "sensor_delay"
    law = "y(t) = x(t - (1 - s) T), lagging by s T"
    shape = ("lag_share",)
    of_reading = True

    def places(self, model: mujoco.MjModel) -> tuple[str, ...]:
        """See :meth:`Effect.places`."""
        return scalar_joints(model) + sensors(model) + sites(model)

    def parameters(self, model: mujoco.MjModel, place: str) -> tuple[Parameter, ...]:
        """See :meth:`Effect.parameters`."""
        seen = columns(model, place)
        late = tuple(Write("column.delay", column, operation="add") for column in seen)
        lagging = tuple(Write("column.lag_share", column, operation="add") for column in seen)
        return (
            Parameter("delay", "s", 0.0, 0.0, 0.2, "linear", late),
            Parameter("lag_share", "1", 0.0, 0.0, 1.0, "linear", lagging),
        )

    def probes(self, model: mujoco.MjModel, place: str, motion: Motion) -> tuple[dict[str, float], ...]:
        """See :meth:`Effect.probes`."""
        return {"delay": 0.005}, {"delay": 0.005, "lag_share": 1.0}
