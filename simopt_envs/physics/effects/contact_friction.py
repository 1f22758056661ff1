"""Contacts of a geom that are slipperier or rougher than the model has them."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np

from simopt_envs.physics.effects.effect import Effect, Motion, object_name
from simopt_envs.physics.parameters import Parameter, Write


class ContactFriction(Effect):
    """The sliding friction coefficient of all contacts of a geom is scaled.

    MuJoCo takes the larger coefficient of the two geoms in contact, so that lowering one may do nothing. The geom
    therefore gets a contact pair with each geom that it can touch, with the parameters that their contact has.
    """

    name = "contact_friction"
    law = "mu -> s mu"

    def places(self, model: mujoco.MjModel) -> tuple[str, ...]:
        """See :meth:`Effect.places`."""
        geoms = (model.geom(i) for i in range(model.ngeom))
        return tuple(
            f"geom:{geom.name}"
            for geom in geoms
            if geom.name and (any(_pairs(model, geom.id)) or any(True for _ in _partners(model, geom.id)))
        )

    def add(self, spec: mujoco.MjSpec, place: str) -> None:
        """See :meth:`Effect.add`."""
        name = object_name(place)
        model = spec.compile()
        geoms = {geom.id: geom for geom in spec.geoms}
        for i, pair in enumerate(spec.pairs):
            pair.name = pair.name or f"{pair.geomname1}+{pair.geomname2}.{i}"  # a parameter writes by name
        for i in _partners(model, model.geom(name).id):
            geoms[i].name = geoms[i].name or f"geom.{i}"
            pair = spec.add_pair(name=f"{name}+{geoms[i].name}", geomname1=name, geomname2=geoms[i].name)
            _mix(pair, model, model.geom(name).id, i)

    def parameters(self, model: mujoco.MjModel, place: str) -> tuple[Parameter, ...]:
        """See :meth:`Effect.parameters`."""
        pairs = _pairs(model, model.geom(object_name(place)).id)
        writes = tuple(Write("pair_friction", model.pair(i).name, (0, 1), "scale") for i in pairs)
        return (Parameter("scale", "1", 1.0, 0.01, 100.0, "log", writes),)

    def probes(self, model: mujoco.MjModel, place: str, motion: Motion) -> tuple[dict[str, float], ...]:
        """See :meth:`Effect.probes`."""
        return ({"scale": 0.9},)


def _pairs(model: mujoco.MjModel, geom: int) -> list[int]:
    """The contact pairs that a geom is in."""
    return [i for i in range(model.npair) if geom in (model.pair_geom1[i], model.pair_geom2[i])]


def _mix(pair: mujoco.MjsPair, model: mujoco.MjModel, a: int, b: int) -> None:
    """Give a pair what MuJoCo makes of two geoms (its documentation, Computation, Contact parameters)."""
    pair.margin = model.geom_margin[a] + model.geom_margin[b]
    pair.gap = model.geom_gap[a] + model.geom_gap[b]
    above = np.sign(model.geom_priority[a] - model.geom_priority[b])
    ids = {0: [a, b], 1: [a], -1: [b]}[int(above)]
    pair.condim = model.geom_condim[ids].max()
    pair.friction = model.geom_friction[ids].max(axis=0)[[0, 0, 1, 2, 2]]
    mix = np.maximum(model.geom_solmix[ids], mujoco.mjMINVAL)
    pair.solimp = np.average(model.geom_solimp[ids], axis=0, weights=mix)
    solref = model.geom_solref[ids]
    pair.solref = np.average(solref, axis=0, weights=mix) if (solref[:, 0] > 0).all() else solref.min(axis=0)


def _partners(model: mujoco.MjModel, geom: int) -> Iterator[int]:
    """The geoms that MuJoCo's filters let a geom touch, less those that it has a pair with."""
    paired = {int(i) for pair in _pairs(model, geom) for i in (model.pair_geom1[pair], model.pair_geom2[pair])}
    for other in range(model.ngeom):
        if other != geom and other not in paired and _can_touch(model, geom, other):
            yield other


def _can_touch(model: mujoco.MjModel, a: int, b: int) -> bool:
    """MuJoCo's filters of the contacts it looks for itself: bits, rigid groups, parents and children, exclusions."""
    bits = (model.geom_contype[a] & model.geom_conaffinity[b]) | (model.geom_contype[b] & model.geom_conaffinity[a])
    bodies = [int(model.geom_bodyid[i]) for i in (a, b)]
    groups = [int(model.body_weldid[body]) for body in bodies]
    above = [int(model.body_weldid[model.body_parentid[group]]) for group in groups]
    adjacent = all(groups) and (groups[0] == above[1] or groups[1] == above[0])
    if model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT):
        adjacent = False
    excluded = {(bodies[0] << 16) + bodies[1], (bodies[1] << 16) + bodies[0]} & set(model.exclude_signature.tolist())
    return bool(bits) and groups[0] != groups[1] and not adjacent and not excluded
