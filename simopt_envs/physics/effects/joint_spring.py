"""A spring on a joint."""

from __future__ import annotations

import mujoco

from simopt_envs.physics.effects.effect import Effect, Motion, Values, object_name
from simopt_envs.physics.effects.joints import (
    add_fixed_tendon,
    dof,
    position_unit,
    probe_force,
    reference,
    scalar_joints,
    stiffness_unit,
)
from simopt_envs.physics.parameters import Parameter, Write

_LEAST_CHANGE = 0.5  # of the force, as a share of the largest, over the motion


class JointSpring(Effect):
    """A spring that pulls a joint towards a rest position, beside the model's own (a fixed tendon, ``NAME.spring``)."""

    name = "joint_spring"
    law = "f = -k (q - q_ref)"
    shape = levers = ("reference",)

    def places(self, model: mujoco.MjModel) -> tuple[str, ...]:
        """See :meth:`Effect.places`."""
        return scalar_joints(model)

    def add(self, spec: mujoco.MjSpec, place: str) -> None:
        """See :meth:`Effect.add`."""
        joint = object_name(place)
        add_fixed_tendon(spec, f"{joint}.spring", joint)

    def parameters(self, model: mujoco.MjModel, place: str) -> tuple[Parameter, ...]:
        """See :meth:`Effect.parameters`."""
        joint = object_name(place)
        stiffness = Write("tendon_stiffness", f"{joint}.spring", operation="add")
        rest = Write("tendon_lengthspring", f"{joint}.spring")
        unit = position_unit(model, joint)
        return (
            Parameter("stiffness", stiffness_unit(model, joint), 0.0, 0.0, 1e5, "linear", (stiffness,)),
            Parameter("reference", unit, reference(model, joint), -1e2, 1e2, "linear", (rest,)),
        )

    def probes(self, model: mujoco.MjModel, place: str, motion: Motion) -> tuple[dict[str, float], ...]:
        """See :meth:`Effect.probes`."""
        joint = object_name(place)
        i = dof(model, joint)
        low, high = float(motion.low[i]), float(motion.high[i])
        stiffness = probe_force(model, joint, motion) / (high - low)
        return tuple({"stiffness": stiffness, "reference": rest} for rest in (low, (low + high) / 2, high))

    def is_itself(self, model: mujoco.MjModel, place: str, motion: Motion, values: Values) -> bool:
        """A spring that rests far from where its joint moves is a constant force, bent a little."""
        i = dof(model, object_name(place))
        low, high = float(motion.low[i]), float(motion.high[i])
        farthest = max(abs(low - values["reference"]), abs(high - values["reference"]))
        return high - low > _LEAST_CHANGE * farthest
