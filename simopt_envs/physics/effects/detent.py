"""A catch that holds a joint near one position."""

from __future__ import annotations

import mujoco

from simopt_envs.physics.effects.effect import Effect, Motion, object_name
from simopt_envs.physics.effects.joints import (
    add_fixed_tendon,
    dof,
    force_unit,
    position_unit,
    probe_force,
    reference,
    scalar_joints,
)
from simopt_envs.physics.parameters import Parameter, Write

_FORCE, _WIDTH = 1e-9, 0.01  # as compiled: scaled to what they are to be
# (half of the rest length in widths, stiffness in F / width): together a triangle of force on each side.
_SPRINGS = ((0.0, 2.0), (0.5, -4.0), (1.0, 2.0))


class Detent(Effect):
    """A catch: pulled towards its position within ``width`` of it, hardest (``force``) halfway, free beyond.

    Three springs with dead bands, the fixed tendons ``NAME.detent0`` to ``2``, add up to it.
    """

    name = "detent"
    law = "f = -F sign(x) max(0, 1 - |2 |x| / w - 1|), x = q - q_0"
    shape = ("width", "position")

    def places(self, model: mujoco.MjModel) -> tuple[str, ...]:
        """See :meth:`Effect.places`."""
        return scalar_joints(model)

    def add(self, spec: mujoco.MjSpec, place: str) -> None:
        """See :meth:`Effect.add`."""
        joint = object_name(place)
        for i, (rest, stiffness) in enumerate(_SPRINGS):
            spring = add_fixed_tendon(spec, f"{joint}.detent{i}", joint)
            spring.springlength = [-rest * _WIDTH, rest * _WIDTH]
            spring.stiffness[0] = stiffness * _FORCE / _WIDTH

    def parameters(self, model: mujoco.MjModel, place: str) -> tuple[Parameter, ...]:
        """See :meth:`Effect.parameters`."""
        joint = object_name(place)
        springs = [f"{joint}.detent{i}" for i in range(len(_SPRINGS))]
        unit = position_unit(model, joint)
        force = tuple(Write("tendon_stiffness", s, operation="scale") for s in springs)
        width = tuple(
            write
            for s in springs
            for write in (
                Write("tendon_stiffness", s, operation="scale", power=-1.0),
                Write("tendon_lengthspring", s, operation="scale"),
            )
        )
        position = tuple(Write("tendon_lengthspring", s, operation="add") for s in springs)
        return (
            Parameter("force", force_unit(model, joint), _FORCE, 0.0, 1e4, "linear", force),
            Parameter("width", unit, _WIDTH, 1e-5, 1e1, "log", width),
            Parameter("position", unit, reference(model, joint), -1e2, 1e2, "linear", position),
        )

    def probes(self, model: mujoco.MjModel, place: str, motion: Motion) -> tuple[dict[str, float], ...]:
        """See :meth:`Effect.probes`."""
        joint = object_name(place)
        i, centre, force = dof(model, joint), reference(model, joint), probe_force(model, joint, motion)
        travel = float(motion.high[i] - motion.low[i])
        widths = [part * travel for part in (0.02, 0.06, 0.2)]
        here = tuple({"force": force, "width": width} for width in widths)
        return (*here, {"force": force, "width": widths[1], "position": centre + widths[1] / 2})
