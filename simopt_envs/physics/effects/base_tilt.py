"""A base that does not stand upright."""

from __future__ import annotations

import mujoco
import numpy as np

from simopt_envs.physics.effects.effect import Effect, Motion
from simopt_envs.physics.parameters import Parameter, Write


class BaseTilt(Effect):
    """Gravity points elsewhere than the model has it: turned about x and y by small angles.

    To first order in the angles, so that gravity grows by half their square: 0.5 % at 0.1 rad. The place is the body
    that all moving parts of the first mechanism hang from.
    """

    name = "base_tilt"
    law = "g = g_0 + (x, y, 0) x g_0"

    def places(self, model: mujoco.MjModel) -> tuple[str, ...]:
        """See :meth:`Effect.places`."""
        if not model.nv or not model.opt.gravity.any():
            return ()
        base = model.body_rootid[model.dof_bodyid[0]]
        return (f"body:{model.body(base).name or 'world'}",)

    def parameters(self, model: mujoco.MjModel, place: str) -> tuple[Parameter, ...]:
        """See :meth:`Effect.parameters`."""
        return tuple(
            Parameter(name, "rad", 0.0, -0.3, 0.3, "linear", _turn(axis, np.array(model.opt.gravity)))
            for name, axis in (("x", (1.0, 0.0, 0.0)), ("y", (0.0, 1.0, 0.0)))
        )

    def probes(self, model: mujoco.MjModel, place: str, motion: Motion) -> tuple[dict[str, float], ...]:
        """See :meth:`Effect.probes`."""
        return ({"x": 0.01}, {"y": 0.01})


def _turn(axis: tuple[float, float, float], gravity: np.ndarray) -> tuple[Write, ...]:
    """What turns gravity about an axis by a small angle."""
    change = np.cross(axis, gravity)
    return tuple(Write("opt.gravity", None, (int(i),), "add", factor=float(change[i])) for i in np.flatnonzero(change))
