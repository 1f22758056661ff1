"""Friction of a joint that grows with its speed."""

from __future__ import annotations

import mujoco

from simopt_envs.physics.effects.effect import Effect, Motion, object_name
from simopt_envs.physics.effects.joints import damping_unit, dof, scalar_joints
from simopt_envs.physics.parameters import Parameter, Write


class ViscousFriction(Effect):
    """A force against the motion in proportion to the speed (``damping``)."""

    name = "viscous_friction"
    law = "f = -d v"

    def places(self, model: mujoco.MjModel) -> tuple[str, ...]:
        """See :meth:`Effect.places`."""
        return scalar_joints(model)

    def parameters(self, model: mujoco.MjModel, place: str) -> tuple[Parameter, ...]:
        """See :meth:`Effect.parameters`."""
        joint = object_name(place)
        write = Write("dof_damping", joint, operation="add")
        return (Parameter("damping", damping_unit(model, joint), 0.0, 0.0, 1e4, "linear", (write,)),)

    def probes(self, model: mujoco.MjModel, place: str, motion: Motion) -> tuple[dict[str, float], ...]:
        """See :meth:`Effect.probes`."""
        i = dof(model, object_name(place))
        return ({"damping": 0.05 * float(motion.force[i] / motion.speed[i])},)
