"""A spring across two joints."""

from __future__ import annotations

import mujoco

from simopt_envs.physics.effects.effect import Effect, Motion, object_name
from simopt_envs.physics.effects.joints import (
    add_fixed_tendon,
    dof,
    is_slide,
    probe_force,
    reference,
    scalar_joints,
    stiffness_unit,
)
from simopt_envs.physics.parameters import Parameter, Write


class JointCoupling(Effect):
    """A spring across two adjacent joints of a kind, as a hose or a cable makes one (a fixed tendon, ``A+B``).

    It is at rest in the model's reference pose, and each joint feels the other's position.
    """

    name = "joint_coupling"
    law = "f_A = f_B = -k (q_A + q_B)"

    def places(self, model: mujoco.MjModel) -> tuple[str, ...]:
        """``"joint:A+B"`` of every joint A and the next joint B outwards that moves the same way."""
        joints = [object_name(place) for place in scalar_joints(model)]
        return tuple(
            f"joint:{a}+{b}"
            for a in joints
            for b in joints
            if _inner(model, b) == model.joint(a).id and is_slide(model, a) == is_slide(model, b)
        )

    def add(self, spec: mujoco.MjSpec, place: str) -> None:
        """See :meth:`Effect.add`."""
        model = spec.copy().compile()
        a, b = _joints(model, place)
        add_fixed_tendon(spec, f"{a}+{b}", a, b).springlength = [reference(model, a) + reference(model, b)] * 2

    def parameters(self, model: mujoco.MjModel, place: str) -> tuple[Parameter, ...]:
        """See :meth:`Effect.parameters`."""
        unit = stiffness_unit(model, _joints(model, place)[0])
        write = Write("tendon_stiffness", object_name(place), operation="add")
        return (Parameter("stiffness", unit, 0.0, 0.0, 1e5, "linear", (write,)),)

    def probes(self, model: mujoco.MjModel, place: str, motion: Motion) -> tuple[dict[str, float], ...]:
        """See :meth:`Effect.probes`."""
        pair = _joints(model, place)
        force = min(probe_force(model, joint, motion) for joint in pair)
        stretch = sum(float(motion.high[i] - motion.low[i]) for i in (dof(model, joint) for joint in pair))
        return ({"stiffness": force / stretch},)


def _joints(model: mujoco.MjModel, place: str) -> tuple[str, str]:
    """The two joints of a place; their own names may have a "+" too."""
    pair, known = object_name(place), set(map(object_name, scalar_joints(model)))
    splits = ((pair[:i], pair[i + 1 :]) for i, letter in enumerate(pair) if letter == "+")
    return next(split for split in splits if known.issuperset(split))


def _inner(model: mujoco.MjModel, joint: str) -> int:
    """The joint next to this one on the way to the world; -1 if there is none."""
    j = model.joint(joint).id
    body = int(model.jnt_bodyid[j])
    if j > model.body_jntadr[body]:
        return j - 1
    while body := int(model.body_parentid[body]):
        if model.body_jntnum[body]:
            return int(model.body_jntadr[body] + model.body_jntnum[body] - 1)
    return -1
