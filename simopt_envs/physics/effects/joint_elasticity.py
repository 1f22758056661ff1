"""A gear or belt that gives."""

from __future__ import annotations

from collections.abc import Mapping

import mujoco

from simopt_envs.physics.effects.effect import Effect, Motion, Values, object_name
from simopt_envs.physics.effects.joints import (
    add_link_joint,
    dof,
    inertia,
    outermost_joints,
    probe_force,
    stiffness_unit,
)
from simopt_envs.physics.parameters import Array, Parameter, Write

_RIGID = 1e3  # stiffness that counts as infinite, in units of inertia / timestep^2


class JointElasticity(Effect):
    """A spring between the motor of a joint, where its encoder is, and the link (a joint ``NAME.link``).

    The joint's own spring and stops stay on the motor's side, which the encoder sees.

    The spring is damped by its stiffness times one timestep. Damping is integrated implicitly, and that much of it
    makes the whole spring implicit: -k (q + dt v) is the force at the end of the step, stable for any k.
    """

    name = "joint_elasticity"
    law = "f = -k (q_link - q_motor)"
    reciprocal = ("stiffness",)

    def places(self, model: mujoco.MjModel) -> tuple[str, ...]:
        """Hinges and slides that are the last joints of their bodies; none under RK4, where damping is explicit."""
        if model.opt.integrator == int(mujoco.mjtIntegrator.mjINT_RK4):
            return ()
        return outermost_joints(model)

    def add(self, spec: mujoco.MjSpec, place: str) -> None:
        """See :meth:`Effect.add`."""
        joint = object_name(place)
        stiffness = _RIGID * inertia(spec, joint) / spec.option.timestep**2
        link = add_link_joint(spec, joint, f"{joint}.link")
        link.stiffness[0] = stiffness
        link.damping[0] = stiffness * spec.option.timestep

    def parameters(self, model: mujoco.MjModel, place: str) -> tuple[Parameter, ...]:
        """See :meth:`Effect.parameters`."""
        link = f"{object_name(place)}.link"
        writes = tuple(Write(field, link, operation="scale") for field in ("jnt_stiffness", "dof_damping"))
        rigid = float(model.jnt_stiffness[model.joint(link).id])
        return (Parameter("stiffness", stiffness_unit(model, link), rigid, 1e-9 * rigid, rigid, "log", writes),)

    def probes(self, model: mujoco.MjModel, place: str, motion: Motion) -> tuple[dict[str, float], ...]:
        """See :meth:`Effect.probes`."""
        joint = object_name(place)
        i = dof(model, joint)
        travel = float(motion.high[i] - motion.low[i])
        return tuple({"stiffness": probe_force(model, joint, motion) / (part * travel)} for part in (2e-4, 1e-3))

    def rest(self, place: str, values: Values, loads: Mapping[str, Array]) -> dict[str, Array]:
        """See :meth:`Effect.rest`."""
        joint = object_name(place)
        return {f"{joint}.link": loads[joint] / values["stiffness"]}
