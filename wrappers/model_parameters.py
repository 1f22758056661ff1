"""Parameters of any MuJoCo model, chosen by short texts such as ``"body_mass of *"``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase

import mujoco
import numpy as np

from simopt_envs.physics.parameters import Parameter, ParameterSpace, Write, unknown_name
from simopt_envs.physics.writer import field_elements, model_field

_BOUND = 10.0  # ready parameters may take a tenth to ten times their nominal value
_KINDS = {  # first word of a quantity -> kind of object, its MuJoCo type, how many there are
    "body": ("body", mujoco.mjtObj.mjOBJ_BODY, "nbody"),
    "dof": ("joint", mujoco.mjtObj.mjOBJ_JOINT, "njnt"),
    "jnt": ("joint", mujoco.mjtObj.mjOBJ_JOINT, "njnt"),
    "geom": ("geom", mujoco.mjtObj.mjOBJ_GEOM, "ngeom"),
    "tendon": ("tendon", mujoco.mjtObj.mjOBJ_TENDON, "ntendon"),
    "actuator": (
        "actuator",
        mujoco.mjtObj.mjOBJ_ACTUATOR,
        "nactuator" if hasattr(mujoco.MjModel, "nactuator") else "nu",
    ),
}


@dataclass(frozen=True)
class _Quantity:
    """What a ready kind of parameter scales; its value is the first element of the first field.

    Attributes:
        fields: model fields, and the columns of each (None: all), which are scaled together.
        unit: its unit, for hinges where it is a joint's.
        slide_unit: its unit for slide joints, where that differs.
    """

    fields: tuple[tuple[str, tuple[int, ...] | None], ...]
    unit: str
    slide_unit: str | None = None


_QUANTITIES = {
    "body_mass": _Quantity((("body_mass", None), ("body_inertia", None)), "kg"),
    "body_inertia": _Quantity((("body_inertia", None),), "kg m^2"),
    "dof_damping": _Quantity((("dof_damping", None),), "N m s/rad", "N s/m"),
    "dof_armature": _Quantity((("dof_armature", None),), "kg m^2", "kg"),
    "dof_frictionloss": _Quantity((("dof_frictionloss", None),), "N m", "N"),
    "jnt_stiffness": _Quantity((("jnt_stiffness", None),), "N m/rad", "N/m"),
    "geom_friction": _Quantity((("geom_friction", (0,)),), "1"),
    "tendon_stiffness": _Quantity((("tendon_stiffness", None),), "N/m"),
    "tendon_damping": _Quantity((("tendon_damping", None),), "N s/m"),
    "tendon_frictionloss": _Quantity((("tendon_frictionloss", None),), "N"),
    "actuator_gain": _Quantity((("actuator_gainprm", (0,)),), "1"),
}


def model_parameters(model: mujoco.MjModel, parameters: Iterable[str | Parameter]) -> ParameterSpace:
    """A space of physical parameters of a model.

    A text names a quantity and the objects that have it, by name or pattern: ``"body_mass of torso"``,
    ``"dof_damping of joint hip"``, ``"geom_friction of *foot*"``; ``"gravity"`` stands alone. Each object matched
    becomes one parameter, named by that text with its own name. Its value is the model's own number (the mass in kg),
    its bounds are a tenth and ten times that, its coordinate is logarithmic. A body's inertia goes with its mass, a
    servo's feedback with its gain; ``geom_friction`` is the sliding friction alone. Patterns pass over objects without
    a name and values that are zero in the model: a zero cannot be scaled and needs a :class:`Parameter` that sets it.

    Args:
        model: the model, at nominal.
        parameters: such texts, or full :class:`Parameter` objects for anything else.

    Raises:
        ValueError: for a quantity or an object that does not exist, with the nearest that do; for a pattern that
            matches nothing, or a named value that is zero.
    """
    found: dict[str, Parameter] = {}
    for item in parameters:
        for parameter in [item] if isinstance(item, Parameter) else _from_text(model, item):
            found.setdefault(parameter.name, parameter)  # patterns may overlap
    return ParameterSpace(found.values())


def _from_text(model: mujoco.MjModel, text: str) -> Iterator[Parameter]:
    if text == "gravity":
        gravity = float(np.linalg.norm(model.opt.gravity))
        yield _scaled(text, "m/s^2", gravity, [Write("opt.gravity", operation="scale")])
        return
    quantity_name, _, target = text.partition(" of ")
    if quantity_name not in _QUANTITIES:
        raise ValueError(unknown_name("quantity", quantity_name, [*_QUANTITIES, "gravity"]))
    kind, names = _objects(model, quantity_name)
    pattern = target.removeprefix(f"{kind} ")
    if not pattern:
        raise ValueError(f'{text!r} names no object; write "{quantity_name} of NAME" or "{quantity_name} of *"')
    matched = [pattern] if pattern in names else [name for name in names if fnmatchcase(name, pattern)]
    if not matched:
        raise ValueError(unknown_name(kind, pattern, names))
    parameters = [
        parameter
        for name in matched
        if (parameter := _of_object(model, text.removesuffix(pattern) + name, quantity_name, name)) is not None
    ]
    if not parameters:
        raise ValueError(
            f"{text!r} cannot be scaled: it is zero in the model for {', '.join(matched)}; "
            f'give a Parameter with Write("{_QUANTITIES[quantity_name].fields[0][0]}", NAME, operation="set") instead'
        )
    yield from parameters


def _of_object(model: mujoco.MjModel, parameter: str, quantity_name: str, name: str) -> Parameter | None:
    """The parameter of one object, or None where its value is zero."""
    quantity = _QUANTITIES[quantity_name]
    writes = [Write(field, name, index, "scale") for field, index in quantity.fields]
    nominal = _first_value(model, writes[0])
    if quantity_name == "actuator_gain":
        # A servo feeds back with minus its gain: gain * ctrl - gain * (position, or velocity).
        feedback = model.actuator(name).biasprm[1:3]
        servo = tuple(i for i, value in enumerate(feedback, start=1) if value == -nominal)
        writes += [Write("actuator_biasprm", name, servo, "scale")] if servo else []
    is_slide = quantity.slide_unit is not None and int(model.joint(name).type[0]) == int(mujoco.mjtJoint.mjJNT_SLIDE)
    unit = quantity.slide_unit if is_slide and quantity.slide_unit else quantity.unit
    return _scaled(parameter, unit, abs(nominal), writes) if nominal else None


def _scaled(name: str, unit: str, nominal: float, writes: Iterable[Write]) -> Parameter:
    if nominal == 0:
        raise ValueError(f"{name!r} cannot be scaled: it is zero in the model")
    return Parameter(name, unit, nominal, nominal / _BOUND, nominal * _BOUND, "log", tuple(writes))


def _first_value(model: mujoco.MjModel, write: Write) -> float:
    return float(model_field(model, write.field).ravel()[field_elements(model, write)[0]])


def _objects(model: mujoco.MjModel, quantity: str) -> tuple[str, list[str]]:
    """The kind of object that has a quantity, and the names of those in the model."""
    kind, obj, count = _KINDS[quantity.split("_")[0]]
    names = (mujoco.mj_id2name(model, obj, i) for i in range(getattr(model, count)))
    return kind, [name for name in names if name]
