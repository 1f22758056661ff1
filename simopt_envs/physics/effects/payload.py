"""A load that the model does not know of."""

from __future__ import annotations

import mujoco
import numpy as np

from simopt_envs.physics.effects.effect import Effect, Motion, object_name
from simopt_envs.physics.parameters import Array, Parameter, Write


class Payload(Effect):
    """A point mass on a moving body (a body ``NAME.payload`` welded to it).

    It sits at the site farthest from the body's frame, a tool's tip; without a site, at the centre of mass. Bodies
    welded to a body count as part of it. Bodies that can carry a tool come first: those with a site, then the last of
    each chain.
    """

    name = "payload"
    law = "m -> m + M at the tip"

    def places(self, model: mujoco.MjModel) -> tuple[str, ...]:
        """See :meth:`Effect.places`."""
        moving = [i for i in range(model.nbody) if model.body_dofnum[i] and model.body(i).name]
        carriers = set(model.body_weldid[model.site_bodyid])
        inner = set(model.body_weldid[model.body_parentid[moving]])
        moving.sort(key=lambda i: (i not in carriers, i in inner))
        return tuple(f"body:{model.body(i).name}" for i in moving)

    def add(self, spec: mujoco.MjSpec, place: str) -> None:
        """See :meth:`Effect.add`."""
        body = object_name(place)
        at = _place_of_load(spec.compile(), body)
        load = spec.body(body).add_body(name=f"{body}.payload", pos=at)
        load.fuse = not spec.compiler.fusestatic  # its mass has to stay its own
        load.explicitinertial = True
        load.mass, load.ipos, load.iquat, load.inertia = 0.0, np.zeros(3), (1, 0, 0, 0), np.zeros(3)

    def parameters(self, model: mujoco.MjModel, place: str) -> tuple[Parameter, ...]:
        """See :meth:`Effect.parameters`."""
        write = Write("body_mass", f"{object_name(place)}.payload", operation="add")
        return (Parameter("mass", "kg", 0.0, 0.0, 1e3, "linear", (write,)),)

    def probes(self, model: mujoco.MjModel, place: str, motion: Motion) -> tuple[dict[str, float], ...]:
        """See :meth:`Effect.probes`."""
        return ({"mass": 0.05 * float(model.body(object_name(place)).subtreemass[0])},)


def _place_of_load(model: mujoco.MjModel, body: str) -> Array:
    """The farthest site of a body and of those welded to it, or its centre of mass, in its frame (3,) [m]."""
    i = model.body(body).id
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    sites = data.site_xpos[model.body_weldid[model.site_bodyid] == i]
    if not len(sites):
        return np.array(model.body_ipos[i])
    local = (sites - data.xpos[i]) @ data.xmat[i].reshape(3, 3)
    return local[np.argmax(np.linalg.norm(local, axis=1))]
