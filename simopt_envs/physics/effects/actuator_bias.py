"""A drive that pushes without being told to."""

from __future__ import annotations

import mujoco
import numpy as np

from simopt_envs.physics.effects.actuators import affine_drives, drive_force, drive_unit, gear
from simopt_envs.physics.effects.effect import Effect, Motion, object_name
from simopt_envs.physics.parameters import Parameter, Write


class ActuatorBias(Effect):
    """A constant force on what the drive moves, counted behind its gear."""

    name = "actuator_bias"
    law = "f = f_drive + B"

    def places(self, model: mujoco.MjModel) -> tuple[str, ...]:
        """See :meth:`Effect.places`."""
        return affine_drives(model)

    def add(self, spec: mujoco.MjSpec, place: str) -> None:
        """See :meth:`Effect.add`."""
        drive = spec.actuator(object_name(place))
        if drive.biastype == mujoco.mjtBias.mjBIAS_NONE:
            drive.biastype, drive.biasprm = mujoco.mjtBias.mjBIAS_AFFINE, np.zeros_like(drive.biasprm)

    def parameters(self, model: mujoco.MjModel, place: str) -> tuple[Parameter, ...]:
        """See :meth:`Effect.parameters`."""
        drive = object_name(place)
        write = Write("actuator_biasprm", drive, (0,), "add", factor=1 / gear(model, drive))
        return (Parameter("force", drive_unit(model, drive), 0.0, -1e4, 1e4, "linear", (write,)),)

    def probes(self, model: mujoco.MjModel, place: str, motion: Motion) -> tuple[dict[str, float], ...]:
        """See :meth:`Effect.probes`."""
        return ({"force": 0.05 * drive_force(model, object_name(place), motion)},)
