"""Dry friction of a joint that is larger in one direction."""

from __future__ import annotations

import mujoco
import numpy as np

from simopt_envs.physics.effects.effect import Effect, Motion, Values, object_name
from simopt_envs.physics.effects.joints import add_passive_motor, force_unit, probe_force, scalar_joints
from simopt_envs.physics.parameters import Parameter, Write

_LEAST_DIFFERENCE, _MOST_DIFFERENCE = 0.5, 2.0  # of the level


class AsymmetricFriction(Effect):
    """Coulomb friction whose level differs between the directions, by ``difference``.

    The same as a symmetric friction and a constant force -D/2 (a motor ``NAME.asymmetry`` that cogs with period 0).
    """

    name = "asymmetric_friction"
    law = "f = -(F + D/2 sign(v)) sign(v)"
    extends = "coulomb_friction"

    def places(self, model: mujoco.MjModel) -> tuple[str, ...]:
        """See :meth:`Effect.places`."""
        return scalar_joints(model)

    def add(self, spec: mujoco.MjSpec, place: str) -> None:
        """See :meth:`Effect.add`."""
        joint = object_name(place)
        motor = add_passive_motor(spec, f"{joint}.asymmetry", joint)
        motor.biasprm[2] = np.pi / 2  # A sin(0 q + pi/2) = A

    def parameters(self, model: mujoco.MjModel, place: str) -> tuple[Parameter, ...]:
        """See :meth:`Effect.parameters`."""
        joint = object_name(place)
        unit = force_unit(model, joint)
        friction = Write("dof_frictionloss", joint, operation="add")
        force = Write("actuator_biasprm", f"{joint}.asymmetry", (0,), "add", factor=-0.5)
        return (
            Parameter("frictionloss", unit, 0.0, 0.0, 1e4, "linear", (friction,)),
            Parameter("difference", unit, 0.0, -1e4, 1e4, "linear", (force,)),
        )

    def probes(self, model: mujoco.MjModel, place: str, motion: Motion) -> tuple[dict[str, float], ...]:
        """See :meth:`Effect.probes`."""
        force = probe_force(model, object_name(place), motion)
        return tuple({"frictionloss": force, "difference": difference} for difference in (force, -force))

    def grown(self, model: mujoco.MjModel, place: str, motion: Motion, values: Values) -> tuple[dict[str, float], ...]:
        """See :meth:`Effect.grown`."""
        friction = values["frictionloss"]
        return tuple({"frictionloss": friction, "difference": difference} for difference in (friction, -friction))

    def is_itself(self, model: mujoco.MjModel, place: str, motion: Motion, values: Values) -> bool:
        """A difference below half the level is what a symmetric friction and a constant force are called.

        One above twice the level is what a constant force is called: friction pushes in neither direction.
        """
        level = values["frictionloss"]
        return _LEAST_DIFFERENCE * level < abs(values["difference"]) <= _MOST_DIFFERENCE * level
