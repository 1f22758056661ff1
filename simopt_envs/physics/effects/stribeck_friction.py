"""Friction of a joint that is larger near rest."""

from __future__ import annotations

import mujoco

from simopt_envs.physics.effects.effect import Effect, Motion, Values, object_name
from simopt_envs.physics.effects.joints import (
    add_passive_motor,
    dof,
    force_unit,
    inertia,
    probe_force,
    scalar_joints,
    speed_unit,
)
from simopt_envs.physics.parameters import Parameter, Write

_STIFFNESS = 0.05  # of bristles, in units of inertia / timestep^2: MuJoCo integrates them explicitly
_PEAKS = (1.0, 3.0)  # times the Coulomb friction


class StribeckFriction(Effect):
    """Coulomb friction with a peak ``breakaway`` on top of it around speed 0, ``velocity`` wide.

    The peak is LuGre friction of a motor ``NAME.stribeck`` without a Coulomb part: at rest it holds as bristles do, by
    giving way a little.
    """

    name = "stribeck_friction"
    law = "f = -(F + B exp(-(v/vs)^2)) sign(v)"
    shape = ("velocity",)
    extends = "coulomb_friction"

    def places(self, model: mujoco.MjModel) -> tuple[str, ...]:
        """See :meth:`Effect.places`."""
        return scalar_joints(model)

    def add(self, spec: mujoco.MjSpec, place: str) -> None:
        """See :meth:`Effect.add`."""
        joint = object_name(place)
        bristles = _STIFFNESS * inertia(spec, joint) / spec.option.timestep**2
        add_passive_motor(spec, f"{joint}.stribeck", joint, (bristles, 0.0, 0.0, 0.0, 0.1))

    def parameters(self, model: mujoco.MjModel, place: str) -> tuple[Parameter, ...]:
        """See :meth:`Effect.parameters`."""
        joint = object_name(place)
        unit, peak = force_unit(model, joint), f"{joint}.stribeck"
        friction = Write("dof_frictionloss", joint, operation="add")
        breakaway = Write("actuator_biasprm", peak, (4,), "add")
        velocity = Write("actuator_biasprm", peak, (5,))
        return (
            Parameter("frictionloss", unit, 0.0, 0.0, 1e4, "linear", (friction,)),
            Parameter("breakaway", unit, 0.0, 0.0, 1e4, "linear", (breakaway,)),
            Parameter("velocity", speed_unit(model, joint), 0.1, 1e-4, 1e2, "log", (velocity,)),
        )

    def probes(self, model: mujoco.MjModel, place: str, motion: Motion) -> tuple[dict[str, float], ...]:
        """See :meth:`Effect.probes`."""
        joint = object_name(place)
        force, speed = probe_force(model, joint, motion), float(motion.speed[dof(model, joint)])
        return tuple(
            {"frictionloss": force, "breakaway": force, "velocity": fraction * speed} for fraction in (0.05, 0.2, 0.6)
        )

    def grown(self, model: mujoco.MjModel, place: str, motion: Motion, values: Values) -> tuple[dict[str, float], ...]:
        """See :meth:`Effect.grown`. A fit of a small peak finds a wide one: a high, narrow one is far from there."""
        friction = values["frictionloss"]
        velocities = [probe["velocity"] for probe in self.probes(model, place, motion)]
        return tuple(
            {"frictionloss": friction, "breakaway": share * friction, "velocity": velocity}
            for velocity in velocities
            for share in _PEAKS
        )

    def is_itself(self, model: mujoco.MjModel, place: str, motion: Motion, values: Values) -> bool:
        """A peak as wide as the motion is fast is no peak: it bends the friction of a joint that never leaves it."""
        return values["velocity"] < float(motion.speed[dof(model, object_name(place))])
