"""Writing ξ into MuJoCo models: one vector into one model, or a vector per world into many."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from simopt_envs.physics.parameters import Array, ParameterSpace, Write, unknown_name

# MjModel fields are named after the kind of object that owns their rows.
_OBJECT_OF_FIELD = {
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "jnt": mujoco.mjtObj.mjOBJ_JOINT,
    "dof": mujoco.mjtObj.mjOBJ_JOINT,
    "qpos0": mujoco.mjtObj.mjOBJ_JOINT,
    "qpos_spring": mujoco.mjtObj.mjOBJ_JOINT,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "site": mujoco.mjtObj.mjOBJ_SITE,
    "pair": mujoco.mjtObj.mjOBJ_PAIR,
    "eq": mujoco.mjtObj.mjOBJ_EQUALITY,
    "tendon": mujoco.mjtObj.mjOBJ_TENDON,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
    "sensor": mujoco.mjtObj.mjOBJ_SENSOR,
    "numeric": mujoco.mjtObj.mjOBJ_NUMERIC,
}
_COUNT = {
    mujoco.mjtObj.mjOBJ_BODY: "nbody",
    mujoco.mjtObj.mjOBJ_JOINT: "njnt",
    mujoco.mjtObj.mjOBJ_GEOM: "ngeom",
    mujoco.mjtObj.mjOBJ_SITE: "nsite",
    mujoco.mjtObj.mjOBJ_PAIR: "npair",
    mujoco.mjtObj.mjOBJ_EQUALITY: "neq",
    mujoco.mjtObj.mjOBJ_TENDON: "ntendon",
    mujoco.mjtObj.mjOBJ_ACTUATOR: "nactuator" if hasattr(mujoco.MjModel, "nactuator") else "nu",
    mujoco.mjtObj.mjOBJ_SENSOR: "nsensor",
    mujoco.mjtObj.mjOBJ_NUMERIC: "nnumeric",
}
# Fields of actuators with a row for each command or output, where the others have one for each actuator.
_OF_SEVERAL: dict[str, Literal["ctrl", "out"]] = {
    **dict.fromkeys(("actuator_ctrllimited", "actuator_ctrlrange"), "ctrl"),
    **dict.fromkeys(("actuator_acc0", "actuator_gear", "actuator_length0", "actuator_lengthrange"), "out"),
}
# MuJoCo lists the fields that mj_setConst reads from 4.0 on; before that it is run after every write.
_SETCONST_INPUTS: frozenset[str] | None = (
    frozenset(mujoco.MjModel._setconst_inputs) if hasattr(mujoco.MjModel, "_setconst_inputs") else None
)


@dataclass(frozen=True)
class _FieldPlan:
    """How one field's written elements follow from ξ."""

    elements: NDArray[np.intp]  # (m,) flat positions in the field
    nominal: Array  # (m,) the model as compiled
    set_columns: tuple[tuple[NDArray[np.intp], int], ...]  # (positions among the m, parameter)
    scale_columns: tuple[tuple[NDArray[np.intp], int, float, float], ...]  # (positions, parameter, neutral, power)
    add_columns: tuple[tuple[NDArray[np.intp], int, float], ...]  # (positions, parameter, factor)

    def values(self, xi: Array) -> Array:
        """ξ (n, d) -> the elements (n, m)."""
        out = np.tile(self.nominal, (len(xi), 1))
        for at, p in self.set_columns:
            out[:, at] = xi[:, p, None]
        for at, p, neutral, power in self.scale_columns:
            out[:, at] *= (xi[:, p, None] / neutral) ** power
        for at, p, factor in self.add_columns:
            out[:, at] += factor * xi[:, p, None]
        return out


class ModelWriter:
    """Writes values of a space into a model's fields, always from the nominals of the model as compiled.

    Args:
        model: the model whose nominal values are remembered, now; it is not changed.
        space: the parameters.

    Raises:
        ValueError: if a parameter names a field or an object that the model does not have, or if two set the same
            place.
    """

    def __init__(self, model: mujoco.MjModel, space: ParameterSpace):
        self.space = space
        self._plans = dict(_plans(model, space))

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the model fields that are written."""
        return tuple(self._plans)

    @property
    def needs_set_const(self) -> bool:
        """Whether constants derived from a written field must be recomputed (``mj_setConst``)."""
        if _SETCONST_INPUTS is None:
            return bool(self._plans)
        return any(field in _SETCONST_INPUTS or field.startswith("opt.") for field in self._plans)

    def write(
        self, xi: Array, rows: Callable[[str], np.ndarray], worlds: NDArray[np.intp] | slice = slice(None)
    ) -> None:
        """Write ξ into per-world model fields.

        Args:
            xi: values, (k, d).
            rows: field name -> its live per-world array, (n, ...).
            worlds: the k worlds among the n.
        """
        for field, plan in self._plans.items():
            array = rows(field)
            flat = array.reshape(len(array), -1)
            if not np.shares_memory(flat, array):
                raise RuntimeError(f"model field {field} is not contiguous and cannot be written in place")
            world_ids = np.arange(len(array))[worlds]
            flat[world_ids[:, None], plan.elements] = plan.values(xi)

    def write_model(self, xi: Array, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Write one vector (d,) into one model and recompute what depends on it; ``data`` serves as scratch."""
        self.write(np.asarray(xi)[None], lambda field: model_field(model, field)[None])
        if self.needs_set_const:
            mujoco.mj_setConst(model, data)


def model_field(model: mujoco.MjModel, field: str) -> np.ndarray:
    """A model's field by name, ``"opt."`` for the options; ValueError if there is none."""
    owner = model.opt if field.startswith("opt.") else model
    array = getattr(owner, field.removeprefix("opt."), None)
    if not isinstance(array, np.ndarray):
        valid = [f for f in dir(owner) if not f.startswith("_") and isinstance(getattr(owner, f), np.ndarray)]
        raise ValueError(unknown_name("model field", field, valid))
    return array


def actuator_rows(model: mujoco.MjModel, what: Literal["ctrl", "out"]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Of each actuator's commands or outputs the first, and how many there are; one each in older MuJoCo."""
    first = getattr(model, f"actuator_{what}adr", np.arange(model.nu))
    count = getattr(model, f"actuator_{what}num", np.ones(model.nu))
    return first.astype(np.intp), count.astype(np.intp)


def field_elements(model: mujoco.MjModel, write: Write) -> NDArray[np.intp]:
    """Flat positions, within its field, of the elements that a write touches.

    Raises:
        ValueError: for a field, an object or a column that the model does not have.
    """
    array = model_field(model, write.field)
    if write.field.startswith("opt."):
        rows = np.arange(array.size)[None]
    else:
        rows = np.arange(array.size).reshape(array.shape[0], -1)[_object_rows(model, write)]
    if write.index is None:
        return rows.ravel()
    # A scalar field of a joint or numeric spans rows, not columns: the index then picks among the rows.
    rows = rows.T if rows.shape[1] == 1 else rows
    if max(write.index) >= rows.shape[1]:
        owner = "" if write.object is None else f" of {write.object!r}"
        raise ValueError(f"{write.field}{owner} has {rows.shape[1]} columns, index {write.index} is outside")
    return rows[:, list(write.index)].ravel()


def _object_rows(model: mujoco.MjModel, write: Write) -> slice:
    """The rows of a field that belong to the object a write names."""
    kind = write.field if write.field in _OBJECT_OF_FIELD else write.field.split("_")[0]
    if kind not in _OBJECT_OF_FIELD:
        raise ValueError(unknown_name("kind of model field", write.field, _OBJECT_OF_FIELD))
    if write.object is None:
        raise ValueError(f"a write to {write.field} needs the name of the object that owns the row")
    obj = _OBJECT_OF_FIELD[kind]
    i = mujoco.mj_name2id(model, obj, write.object)
    if i < 0:
        names = _object_names(model, obj, int(getattr(model, _COUNT[obj])))
        raise ValueError(unknown_name(obj.name.removeprefix("mjOBJ_").lower(), write.object, names))
    if kind == "dof":
        start, end = _span(model.jnt_dofadr, i, model.nv)
    elif kind in ("qpos0", "qpos_spring"):
        start, end = _span(model.jnt_qposadr, i, model.nq)
    elif kind == "numeric" and write.field == "numeric_data":
        start = int(model.numeric_adr[i])
        end = start + int(model.numeric_size[i])
    elif write.field in _OF_SEVERAL:
        first, count = actuator_rows(model, _OF_SEVERAL[write.field])
        start, end = int(first[i]), int(first[i] + count[i])
    else:
        start, end = i, i + 1
    return slice(start, end)


def _span(addresses: np.ndarray, i: int, total: int) -> tuple[int, int]:
    return int(addresses[i]), int(addresses[i + 1]) if i + 1 < len(addresses) else total


def _object_names(model: mujoco.MjModel, obj: mujoco.mjtObj, count: int) -> list[str]:
    names = (mujoco.mj_id2name(model, obj, i) for i in range(count))
    return [name for name in names if name is not None]


def _plans(model: mujoco.MjModel, space: ParameterSpace) -> Iterator[tuple[str, _FieldPlan]]:
    """Group the writes of all parameters by field."""
    writes = [(p, i, w) for i, p in enumerate(space) for w in p.writes]
    for field in dict.fromkeys(w.field for _, _, w in writes):
        places = [(p, i, w, field_elements(model, w)) for p, i, w in writes if w.field == field]
        elements = np.unique(np.concatenate([e for *_, e in places]))
        at = [(p, i, w, np.searchsorted(elements, e)) for p, i, w, e in places]
        sets = [(a, i) for _, i, w, a in at if w.operation == "set"]
        written = np.concatenate([a for a, _ in sets]) if sets else np.empty(0, dtype=np.intp)
        if len(np.unique(written)) != len(written):
            names = ", ".join(space.names[i] for _, i in sets)
            raise ValueError(f"several parameters set the same element of {field}: some of {names}")
        yield (
            field,
            _FieldPlan(
                elements=elements,
                nominal=model_field(model, field).ravel()[elements].astype(np.float64),
                set_columns=tuple(sets),
                scale_columns=tuple((a, i, p.neutral, w.power) for p, i, w, a in at if w.operation == "scale"),
                add_columns=tuple((a, i, w.factor) for _, i, w, a in at if w.operation == "add"),
            ),
        )
