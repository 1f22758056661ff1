"""Drag of a joint that grows with the square of its speed."""

from __future__ import annotations

import mujoco

from simopt_envs.physics.effects.effect import Effect, Motion, object_name
from simopt_envs.physics.effects.joints import dof, is_slide, probe_force, scalar_joints
from simopt_envs.physics.parameters import Parameter, Write


class QuadraticDrag(Effect):
    """A force against the motion in proportion to the square of the speed: air, oil, a fan."""

    name = "quadratic_drag"
    law = "f = -c |v| v"

    def places(self, model: mujoco.MjModel) -> tuple[str, ...]:
        """See :meth:`Effect.places`."""
        return scalar_joints(model)

    def parameters(self, model: mujoco.MjModel, place: str) -> tuple[Parameter, ...]:
        """See :meth:`Effect.parameters`."""
        joint = object_name(place)
        unit = "N s2/m2" if is_slide(model, joint) else "N m s2/rad2"
        write = Write("dof_dampingpoly", joint, (0,), "add")  # MuJoCo's polynomials of speed are odd: |v| v
        return (Parameter("drag", unit, 0.0, 0.0, 1e4, "linear", (write,)),)

    def probes(self, model: mujoco.MjModel, place: str, motion: Motion) -> tuple[dict[str, float], ...]:
        """See :meth:`Effect.probes`."""
        joint = object_name(place)
        return ({"drag": probe_force(model, joint, motion) / float(motion.speed[dof(model, joint)]) ** 2},)
