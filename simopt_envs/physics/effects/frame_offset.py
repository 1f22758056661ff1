"""A site that is not where the model has it."""

from __future__ import annotations

import mujoco

from simopt_envs.physics.effects.effect import Effect, Motion, object_name
from simopt_envs.physics.effects.readings import sites
from simopt_envs.physics.parameters import Parameter, Write

_WRAPPED = int(mujoco.mjtWrap.mjWRAP_SITE)
_DRIVEN = (int(mujoco.mjtTrn.mjTRN_SITE), int(mujoco.mjtTrn.mjTRN_SLIDERCRANK))
_HELD = int(mujoco.mjtObj.mjOBJ_SITE)


class FrameOffset(Effect):
    """The point that is measured lies beside the model's site, by a vector in the frame of its body (``pos``).

    A site that carries force (in a tendon, a drive or a constraint) is no place for it: moving that changes more than
    what is seen.
    """

    name = "frame_offset"
    law = "p = x + R (s + d)"

    def places(self, model: mujoco.MjModel) -> tuple[str, ...]:
        """See :meth:`Effect.places`."""
        loaded = {int(i) for i in model.wrap_objid[model.wrap_type == _WRAPPED]}
        for kind, ids in zip(model.actuator_trntype, model.actuator_trnid, strict=True):
            loaded |= {int(i) for i in ids} if kind in _DRIVEN else set()
        for kind, *ids in zip(model.eq_objtype, model.eq_obj1id, model.eq_obj2id, strict=True):
            loaded |= {int(i) for i in ids} if kind == _HELD else set()
        return tuple(place for place in sites(model) if model.site(object_name(place)).id not in loaded)

    def parameters(self, model: mujoco.MjModel, place: str) -> tuple[Parameter, ...]:
        """See :meth:`Effect.parameters`."""
        site = object_name(place)
        return tuple(
            Parameter(axis, "m", 0.0, -1.0, 1.0, "linear", (Write("site_pos", site, (i,), "add"),))
            for i, axis in enumerate("xyz")
        )

    def probes(self, model: mujoco.MjModel, place: str, motion: Motion) -> tuple[dict[str, float], ...]:
        """See :meth:`Effect.probes`."""
        return tuple({axis: 0.002} for axis in "xyz")
