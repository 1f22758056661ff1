"""A drive that gives no more than so much."""

from __future__ import annotations

import mujoco
import numpy as np

from simopt_envs.physics.effects.actuators import actuators, drive_force, drive_unit, gear
from simopt_envs.physics.effects.effect import Effect, Motion, object_name
from simopt_envs.physics.parameters import Parameter, Write

UNLIMITED = 1e6
"""The force of a drive that stands for no limit [N, N m]."""


class ActuatorSaturation(Effect):
    """The force of a drive is clipped (``forcerange``), counted behind its gear.

    Where the model has a limit it is that limit, so that neutral is the model as given; else neutral stands for none.
    """

    name = "actuator_saturation"
    law = "f = clip(f_drive, -L, L)"
    shape = ("limit",)

    def places(self, model: mujoco.MjModel) -> tuple[str, ...]:
        """See :meth:`Effect.places`."""
        return actuators(model)

    def add(self, spec: mujoco.MjSpec, place: str) -> None:
        """See :meth:`Effect.add`."""
        drive, model = spec.actuator(object_name(place)), spec.copy().compile()
        if not model.actuator(drive.name).forcelimited[0]:
            drive.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
            drive.forcerange = (-UNLIMITED, UNLIMITED)

    def parameters(self, model: mujoco.MjModel, place: str) -> tuple[Parameter, ...]:
        """See :meth:`Effect.parameters`."""
        drive = object_name(place)
        limit = float(np.abs(model.actuator(drive).forcerange).max()) * abs(gear(model, drive))
        write = Write("actuator_forcerange", drive, operation="scale")
        return (Parameter("limit", drive_unit(model, drive), limit, 1e-9 * limit, 10 * limit, "log", (write,)),)

    def probes(self, model: mujoco.MjModel, place: str, motion: Motion) -> tuple[dict[str, float], ...]:
        """Limits below the greatest force, which is one to three times the root mean square.

        And far below: what a servo asks for where it is held back, and cannot follow, has no bound.
        """
        force = drive_force(model, object_name(place), motion)
        return tuple({"limit": part * force} for part in (0.03, 0.1, 0.3, 0.7, 1.0, 1.4, 2.0, 3.0))
