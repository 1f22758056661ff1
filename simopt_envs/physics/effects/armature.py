"""Inertia of a joint's drive."""

from __future__ import annotations

import mujoco

from simopt_envs.physics.effects.effect import Effect, Motion, object_name
from simopt_envs.physics.effects.joints import dof, inertia_unit, scalar_joints
from simopt_envs.physics.parameters import Parameter, Write


class Armature(Effect):
    """Extra inertia along a joint, as of a rotor behind a gear (``armature``)."""

    name = "armature"
    law = "f = -J dv/dt"

    def places(self, model: mujoco.MjModel) -> tuple[str, ...]:
        """See :meth:`Effect.places`."""
        return scalar_joints(model)

    def parameters(self, model: mujoco.MjModel, place: str) -> tuple[Parameter, ...]:
        """See :meth:`Effect.parameters`."""
        joint = object_name(place)
        write = Write("dof_armature", joint, operation="add")
        return (Parameter("armature", inertia_unit(model, joint), 0.0, 0.0, 1e3, "linear", (write,)),)

    def probes(self, model: mujoco.MjModel, place: str, motion: Motion) -> tuple[dict[str, float], ...]:
        """See :meth:`Effect.probes`."""
        return ({"armature": 0.05 * float(model.dof_M0[dof(model, object_name(place))])},)
