"""Weight that something unmodelled carries."""

from __future__ import annotations

import mujoco

from simopt_envs.physics.effects.effect import Effect, Motion, object_name
from simopt_envs.physics.parameters import Parameter, Write


class GravityCompensation(Effect):
    """A part of the weight of a body, and of all bodies that it carries, is cancelled (``gravcomp``).

    A spring, a counterweight or a controller does so. Less than nothing is cancelled where a controller, which the
    model takes for exact, compensates too little.
    """

    name = "gravity_compensation"
    law = "f = -c m g at the centre of mass"

    def places(self, model: mujoco.MjModel) -> tuple[str, ...]:
        """See :meth:`Effect.places`."""
        if not model.opt.gravity.any():
            return ()
        moving = (model.body(i) for i in range(model.nbody) if model.body_dofnum[i])
        return tuple(f"body:{body.name}" for body in moving if body.name)

    def add(self, spec: mujoco.MjSpec, place: str) -> None:
        """See :meth:`Effect.add`."""
        body = spec.body(object_name(place))
        for i, below in enumerate(body.find_all(mujoco.mjtObj.mjOBJ_BODY)):
            below.name = below.name or f"{body.name}.{i}"  # a parameter writes by name

    def parameters(self, model: mujoco.MjModel, place: str) -> tuple[Parameter, ...]:
        """See :meth:`Effect.parameters`."""
        root = model.body(object_name(place)).id
        writes = tuple(
            Write("body_gravcomp", model.body(i).name, operation="add")
            for i in range(root, model.nbody)
            if _carries(model, root, i)
        )
        return (Parameter("fraction", "1", 0.0, -2.0, 2.0, "linear", writes),)

    def probes(self, model: mujoco.MjModel, place: str, motion: Motion) -> tuple[dict[str, float], ...]:
        """See :meth:`Effect.probes`."""
        return ({"fraction": 0.02},)


def _carries(model: mujoco.MjModel, root: int, body: int) -> bool:
    """Whether a body is in the subtree of another."""
    while body > root:
        body = int(model.body_parentid[body])
    return body == root
