"""ξ of any MuJoCo model, declared in YAML."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from simopt_envs.distributions.gaussian import Gaussian
from simopt_envs.physics import Parameter, ParameterSpace, Write
from simopt_envs.physics.parameters import unknown_name

_REQUIRED = ("name", "field", "unit", "nominal", "bounds", "std")
_OPTIONAL = ("object", "operation", "coordinate", "index", "power", "description")


def read_parameters(path: Path) -> Gaussian:
    """The first p(ξ) over parameters of any MuJoCo model, declared in YAML.

    A list under ``parameters``; each entry has ``name``, ``field`` of the model (or several that are written alike) and
    the ``object`` that owns the row, ``unit``, ``nominal``, ``bounds: [low, high]`` and ``std`` (relative for log
    coordinates). It may have ``operation`` (set, scale, add), ``coordinate`` (log, linear), ``index`` (columns of the
    field), ``power`` (of a scale) and ``description``.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: for an entry that lacks something, has a key that does not exist, or contradicts itself.
        ImportError: without PyYAML.
    """
    try:
        import yaml
    except ImportError:
        raise ImportError('reading YAML needs PyYAML: pip install "simopt-envs[measured]"') from None
    try:
        content = yaml.safe_load(read_text(path, "parameter file"))
    except yaml.YAMLError as error:
        raise ValueError(f"{path} is not valid YAML: {error}") from None
    entries = content.get("parameters") if isinstance(content, dict) else None
    if not isinstance(entries, list) or not entries:
        raise ValueError(f"{path} must hold a list under the key 'parameters'")
    parameters, stds = [], []
    for i, entry in enumerate(entries):
        try:
            parameters.append(_parameter(entry))
            stds.append(_number(entry, "std"))
        except ValueError as error:
            name = entry.get("name") if isinstance(entry, dict) else None
            raise ValueError(f"{path}, parameter {name or i + 1}: {error}") from None
    return Gaussian.around_nominal(ParameterSpace(parameters), stds)


def read_text(path: Path, what: str) -> str:
    """Content of a file; FileNotFoundError saying what it would have been."""
    if not path.is_file():
        raise FileNotFoundError(f"there is no {what} {path}")
    return path.read_text(encoding="utf-8")


def is_number(value: Any) -> bool:
    """Whether a value read from JSON or YAML is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _parameter(entry: Any) -> Parameter:
    if not isinstance(entry, dict):
        raise ValueError(f"must be a mapping with {', '.join(_REQUIRED)}, got {entry!r}")
    for key in entry:
        if key not in _REQUIRED + _OPTIONAL:
            raise ValueError(unknown_name("key", key, _REQUIRED + _OPTIONAL))
    if missing := [key for key in _REQUIRED if key not in entry]:
        raise ValueError(f"lacks {', '.join(missing)}")
    bounds = entry["bounds"]
    if not (isinstance(bounds, list) and len(bounds) == 2 and all(map(is_number, bounds))):
        raise ValueError(f"bounds must be [low, high], got {bounds!r}")
    operation = entry.get("operation", "set")
    if operation not in ("set", "scale", "add"):
        raise ValueError(unknown_name("operation", operation, ("set", "scale", "add")))
    index = entry.get("index")
    columns = None if index is None else tuple(index if isinstance(index, list) else [index])
    fields = entry["field"] if isinstance(entry["field"], list) else [entry["field"]]
    power = _number(entry, "power") if "power" in entry else 1.0
    return Parameter(
        name=str(entry["name"]),
        unit=str(entry["unit"]),
        nominal=_number(entry, "nominal"),
        low=float(bounds[0]),
        high=float(bounds[1]),
        coordinate=entry.get("coordinate", "linear" if operation == "add" else "log"),
        writes=tuple(Write(str(field), entry.get("object"), columns, operation, power) for field in fields),
        description=entry.get("description", ""),
    )


def _number(entry: Mapping[str, Any], key: str) -> float:
    if not is_number(entry[key]):
        raise ValueError(f"{key} must be a number, got {entry[key]!r}")
    return float(entry[key])
