"""Writing ξ into an ``MjSpec``, so that a model whose parameters were fitted can be saved as MJCF."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from simopt_envs.physics.parameters import Array, ParameterSpace, Write, unknown_name
from simopt_envs.physics.writer import ModelWriter, field_elements, model_field


@dataclass(frozen=True)
class _Row:
    """A row of a model's field that differs from the model as compiled.

    Attributes:
        values: the row as written.
        change: by how much it differs.
        model: the model as written.
    """

    field: str
    object: str
    values: Array
    change: Array
    model: mujoco.MjModel


def write_spec(spec: mujoco.MjSpec, model: mujoco.MjModel, space: ParameterSpace, xi: ArrayLike) -> None:
    """Put values of parameters into a spec, in place; it then compiles to what a ``ModelWriter`` makes of its model.

    Only what differs from the model as compiled is written, so that the saved MJCF differs in few lines.

    Args:
        spec: the spec, compiled.
        model: what it compiled to.
        space: the parameters.
        xi: their values, (d,).

    Raises:
        ValueError: if a parameter writes a field that a spec cannot hold; nothing has been written then. Also if the
            spec's compiler does not keep what was written (the length of a capsule ``fromto`` its ends), naming it.
    """
    writer = ModelWriter(model, space)
    for field in writer.fields:
        if not (field in _WRITERS or field.startswith("opt.")):
            raise ValueError(unknown_name("model field that a spec can hold", field, [*_WRITERS, "opt.*"]))
    written = copy.copy(model)
    writer.write_model(np.asarray(xi, dtype=np.float64), written, mujoco.MjData(written))
    places = dict.fromkeys((write.field, write.object) for p in space for write in p.writes)
    for field, name in places:
        row = field_elements(model, Write(field, name))
        values = model_field(written, field).ravel()[row].astype(np.float64)
        change = values - model_field(model, field).ravel()[row]
        if change.any():
            if name is None:
                setattr(spec.option, field.removeprefix("opt."), values)
            else:
                _WRITERS[field](spec, _Row(field, name, values, change, written))
    compiled = spec.compile()
    for field, name in places:
        row = field_elements(model, Write(field, name))
        kept, meant = (model_field(m, field).ravel()[row] for m in (compiled, written))
        if not np.allclose(kept, meant, rtol=1e-9, atol=1e-12):
            raise ValueError(f"the model's compiler overrides what was written to {field} of {name}")


def keep_inertias(spec: mujoco.MjSpec) -> None:
    """Let a spec keep the masses and inertias that are written into it, in place; it compiles to the same model.

    A compiler that infers all of them from geoms (``inertiafromgeom="true"``, as in many of Gymnasium's models), scales
    them to a mass of all (``settotalmass``), or keeps them from being small or impossible (``boundmass``,
    ``boundinertia``, ``balanceinertia``), overrides what is written.
    """
    compiler, kinds = spec.compiler, mujoco.mjtInertiaFromGeom
    inferred = compiler.inertiafromgeom == kinds.mjINERTIAFROMGEOM_TRUE
    changed = max(compiler.settotalmass, compiler.boundmass, compiler.boundinertia, compiler.balanceinertia) > 0
    if not (inferred or changed):
        return
    model = spec.compile()
    for body in spec.bodies:
        if body.explicitinertial or (changed and model.body_mass[body.id]):
            _set_inertial(body, model)
    compiler.settotalmass, compiler.boundmass, compiler.boundinertia, compiler.balanceinertia = -1, 0, 0, False
    if inferred:
        compiler.inertiafromgeom = kinds.mjINERTIAFROMGEOM_AUTO


_Writer = Callable[[mujoco.MjSpec, _Row], None]
_TURNING = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_BALL)


def _attribute(kind: str, attribute: str, columns: slice = slice(None)) -> _Writer:
    """Writes a row to an attribute of the element of its name, or to some columns of it."""

    def write(spec: mujoco.MjSpec, row: _Row) -> None:
        element = getattr(spec, kind)(row.object)
        value = getattr(element, attribute)
        if np.ndim(value) == 0:
            setattr(element, attribute, float(row.values[0]))
        else:
            value = np.array(value, dtype=np.float64)
            value[columns] = row.values[: len(value[columns])]  # a ball's three axes share an attribute
            setattr(element, attribute, value)

    return write


def _position(attribute: str) -> _Writer:
    """Writes a joint's position, in degrees where the spec counts angles in them."""

    def write(spec: mujoco.MjSpec, row: _Row) -> None:
        joint = spec.joint(row.object)
        in_degrees = joint.type in _TURNING and joint.compiler.degree
        values = np.degrees(row.values) if in_degrees else row.values
        setattr(joint, attribute, values if attribute == "range" else float(values[0]))

    return write


def _range(spec: mujoco.MjSpec, row: _Row) -> None:
    """Moves a joint's limits; drives that took their range of commands from them keep it."""
    _position("range")(spec, row)
    for drive in spec.actuators:
        if drive.inheritrange and drive.target == row.object:
            drive.inheritrange = 0
            drive.ctrlrange = row.model.actuator(drive.id).ctrlrange


def _inertial(spec: mujoco.MjSpec, row: _Row) -> None:
    """Writes mass, centre of mass and inertia of a body together: geoms no longer tell them."""
    keep_inertias(spec)
    _set_inertial(spec.body(row.object), row.model)


def _set_inertial(body: Any, model: mujoco.MjModel) -> None:
    """Gives a body of a compiled spec the inertial that a model of it has there."""
    source = model.body(body.id)
    body.explicitinertial = True
    body.mass = float(source.mass[0])
    body.ipos, body.iquat, body.inertia = source.ipos, source.iquat, source.inertia
    body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    body.fullinertia = np.array([np.nan, 0, 0, 0, 0, 0])


def _place(kind: str) -> _Writer:
    """Moves an element by what it moves in its body's frame; the spec counts in the frame that the element is in."""

    def write(spec: mujoco.MjSpec, row: _Row) -> None:
        element = getattr(spec, kind)(row.object)
        moved = _rotation(spec, element.frame).T @ row.change
        if np.isfinite(getattr(element, "fromto", np.nan)).all():  # its ends, which tell where it is
            element.fromto = element.fromto + np.tile(moved, 2)
        else:
            element.pos = element.pos + moved

    return write


def _rotation(spec: mujoco.MjSpec, frame: Any) -> Array:
    """From a frame of a spec, which may lie in another, to the body's: (3, 3)."""
    if frame is None:
        return np.eye(3)
    quaternion = np.array(frame.quat)
    if frame.alt.type != mujoco.mjtOrientation.mjORIENTATION_QUAT:
        compiler = frame.compiler
        quaternion = np.array(spec.resolve_orientation(compiler.degree, compiler.eulerseq, frame.alt))
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return _rotation(spec, frame.frame) @ matrix.reshape(3, 3)


def _same(kind: str, *attributes: str) -> dict[str, _Writer]:
    """The fields that are named after a kind of element and its attribute."""
    return {f"{kind}_{attribute}": _attribute(kind, attribute) for attribute in attributes}


def _polynomial(kind: str, field: str, attribute: str) -> dict[str, _Writer]:
    """A field and its higher orders, which are one attribute of a spec."""
    return {
        field: _attribute(kind, attribute, slice(0, 1)),
        f"{field}poly": _attribute(kind, attribute, slice(1, None)),
    }


_WRITERS: dict[str, _Writer] = {
    **dict.fromkeys(("body_mass", "body_inertia", "body_ipos"), _inertial),
    **_same("body", "gravcomp"),
    "dof_armature": _attribute("joint", "armature"),
    "dof_frictionloss": _attribute("joint", "frictionloss"),
    **_polynomial("joint", "dof_damping", "damping"),
    **_polynomial("joint", "jnt_stiffness", "stiffness"),
    "jnt_springyield": _attribute("joint", "springyield"),
    "jnt_range": _range,
    "qpos0": _position("ref"),
    "qpos_spring": _position("springref"),
    **_same("actuator", "gainprm", "biasprm", "dynprm", "forcerange", "ctrlrange", "gear", "delay", "armature"),
    **_polynomial("actuator", "actuator_damping", "damping"),
    **_same("tendon", "frictionloss", "armature", "range", "springyield"),
    **_polynomial("tendon", "tendon_stiffness", "stiffness"),
    **_polynomial("tendon", "tendon_damping", "damping"),
    "tendon_lengthspring": _attribute("tendon", "springlength"),
    **_same("geom", "size", "friction", "solref", "solimp"),
    **_same("site", "size"),
    **_same("pair", "friction", "solref", "solimp"),
    "eq_data": _attribute("equality", "data"),
    **{f"{kind}_pos": _place(kind) for kind in ("body", "geom", "site")},
    "numeric_data": _attribute("numeric", "data"),
}
