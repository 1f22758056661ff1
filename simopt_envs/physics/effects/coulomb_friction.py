"""Dry friction of a joint."""

from __future__ import annotations

import mujoco

from simopt_envs.physics.effects.effect import Effect, Motion, object_name
from simopt_envs.physics.effects.joints import dof, force_unit, scalar_joints
from simopt_envs.physics.parameters import Parameter, Write


class CoulombFriction(Effect):
    """A force of constant size against the motion, which also holds the joint at rest (``frictionloss``)."""

    name = "coulomb_friction"
    law = "f = -F sign(v)"

    def places(self, model: mujoco.MjModel) -> tuple[str, ...]:
        """See :meth:`Effect.places`."""
        return scalar_joints(model)

    def parameters(self, model: mujoco.MjModel, place: str) -> tuple[Parameter, ...]:
        """See :meth:`Effect.parameters`."""
        joint = object_name(place)
        write = Write("dof_frictionloss", joint, operation="add")
        return (Parameter("frictionloss", force_unit(model, joint), 0.0, 0.0, 1e4, "linear", (write,)),)

    def probes(self, model: mujoco.MjModel, place: str, motion: Motion) -> tuple[dict[str, float], ...]:
        """See :meth:`Effect.probes`."""
        return ({"frictionloss": 0.05 * float(motion.force[dof(model, object_name(place))])},)
