"""ξ: the named physical parameters of a simulation, with units, nominal values and bounds.

A :class:`Parameter` says what a number means and which places of a MuJoCo model it writes; a
:class:`ParameterSpace` is an ordered set of them. Neither holds a model:
:class:`~simopt_envs.physics.writer.ModelWriter` binds a space to one.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Operation = Literal["set", "scale", "add"]
Coordinate = Literal["log", "linear"]


@dataclass(frozen=True)
class Write:
    """One place in a MuJoCo model that a parameter writes, and how.

    Attributes:
        field: the ``MjModel`` field, ``"dof_damping"``, or an option, ``"opt.gravity"``.
        object: name of the joint, body, geom, ... whose rows are written. None for options.
        index: columns within a row, ``(0, 1)`` of ``pair_friction``; None writes the whole row.
        operation: ``"set"`` writes the value, ``"scale"`` multiplies the remembered nominal by
            (value / the parameter's baseline) ** power, ``"add"`` adds factor * value to it. Several parameters may
            write the same place: it is set first, then scaled, then shifted, always from the model as it was compiled.
        power: exponent of ``"scale"``: a rod's mass goes with the second power of its width.
        factor: of ``"add"``: a force at a joint is a gear's ratio times smaller at its motor.
    """

    field: str
    object: str | None = None
    index: tuple[int, ...] | None = None
    operation: Operation = "set"
    power: float = 1.0
    factor: float = 1.0


@dataclass(frozen=True)
class Parameter:
    """A named physical quantity of a simulation.

    Attributes:
        name: unique name, ``"drawer_damping"``.
        unit: its unit, ``"N s/m"``; ``"1"`` for a factor.
        nominal: the value that stands for the model as written.
        low, high: inclusive bounds of what is physically valid.
        coordinate: ``"log"`` for scale-like quantities (> 0), ``"linear"`` for offsets.
        writes: the places in the model that it writes.
        description: one line for people.
        baseline: the value at which ``"scale"`` leaves the model as compiled; None for the nominal.
    """

    name: str
    unit: str
    nominal: float
    low: float
    high: float
    coordinate: Coordinate = "log"
    writes: tuple[Write, ...] = ()
    description: str = ""
    baseline: float | None = None

    def __post_init__(self) -> None:
        """Raise ValueError where the numbers contradict one another."""
        if self.coordinate not in ("log", "linear"):
            raise ValueError(f"parameter {self.name!r}: coordinate {self.coordinate!r} is not 'log' or 'linear'")
        if not self.low <= self.nominal <= self.high:
            raise ValueError(
                f"parameter {self.name!r}: nominal {self.nominal:g} {self.unit} is not within"
                f" [{self.low:g}, {self.high:g}]"
            )
        if self.coordinate == "log" and self.low <= 0:
            raise ValueError(f"parameter {self.name!r}: a log coordinate needs low > 0, got {self.low:g} {self.unit}")
        if self.neutral == 0 and any(w.operation == "scale" for w in self.writes):
            raise ValueError(f"parameter {self.name!r}: a nominal of 0 cannot be scaled")

    @property
    def neutral(self) -> float:
        """What ``"scale"`` counts from."""
        return self.nominal if self.baseline is None else self.baseline


class ParameterSpace:
    """An ordered, immutable set of parameters; arrays of values follow its order.

    Every array argument has the parameters as its last axis: (d,) or (n, d).
    """

    def __init__(self, parameters: Iterable[Parameter]):
        self.parameters: tuple[Parameter, ...] = tuple(parameters)
        self.names: tuple[str, ...] = tuple(p.name for p in self.parameters)
        self.units: tuple[str, ...] = tuple(p.unit for p in self.parameters)
        if len(set(self.names)) != len(self.names):
            twice = sorted({n for n in self.names if self.names.count(n) > 1})
            raise ValueError(f"parameter names must be unique; {', '.join(twice)} given more than once")
        self.nominal: Array = _constant(p.nominal for p in self.parameters)
        self.low: Array = _constant(p.low for p in self.parameters)
        self.high: Array = _constant(p.high for p in self.parameters)
        self.is_log: NDArray[np.bool_] = np.array([p.coordinate == "log" for p in self.parameters], dtype=bool)
        self._index = {name: i for i, name in enumerate(self.names)}

    def __len__(self) -> int:
        return len(self.parameters)

    def __iter__(self) -> Iterator[Parameter]:
        return iter(self.parameters)

    def __contains__(self, name: object) -> bool:
        return name in self._index

    def __getitem__(self, name: str) -> Parameter:
        return self.parameters[self.index(name)]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ParameterSpace) and self.parameters == other.parameters

    def __hash__(self) -> int:
        return hash(self.parameters)

    def __repr__(self) -> str:
        rows = (f"  {p.name} = {p.nominal:g} {p.unit} in [{p.low:g}, {p.high:g}]" for p in self.parameters)
        return "ParameterSpace(\n" + "\n".join(rows) + "\n)"

    def index(self, name: str) -> int:
        """Position of a parameter; ValueError with the nearest names if there is none so called."""
        if name not in self._index:
            raise ValueError(unknown_name("parameter", name, self.names))
        return self._index[name]

    def subset(self, names: Sequence[str]) -> ParameterSpace:
        """The space of the named parameters alone, in the order given."""
        if isinstance(names, str):
            raise TypeError(f"subset takes a list of names, got the string {names!r}")
        return ParameterSpace(self[name] for name in names)

    def to_unconstrained(self, x: ArrayLike) -> Array:
        """Physical values -> coordinates: the logarithm of log quantities, the others as they are."""
        x = self._last_axis(x, "values")
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.is_log, np.log(x), x)

    def from_unconstrained(self, z: ArrayLike) -> Array:
        """Coordinates -> physical values; the inverse of :meth:`to_unconstrained`.

        Bounds do not enter: it is the distributions that keep them, by drawing again what falls outside.
        """
        z = self._last_axis(z, "coordinates")
        with np.errstate(over="ignore"):
            return np.where(self.is_log, np.exp(z), z)

    def contains(self, x: ArrayLike) -> NDArray[np.bool_]:
        """Whether each vector of values lies within the bounds, (d,) -> () or (n, d) -> (n,)."""
        x = self._last_axis(x, "values")
        return np.all((x >= self.low) & (x <= self.high), axis=-1)

    def validate(self, x: ArrayLike) -> Array:
        """The values as an array; ValueError naming the first that is not finite or out of bounds."""
        x = self._last_axis(x, "values")
        wrong = ~(np.isfinite(x) & (x >= self.low) & (x <= self.high))
        if wrong.any():
            where = tuple(np.argwhere(wrong)[0])
            p, value = self.parameters[where[-1]], x[where]
            problem = "is not finite" if not np.isfinite(value) else "is out of bounds"
            world = f" (world {where[0]})" if x.ndim > 1 else ""
            raise ValueError(
                f"parameter {p.name!r}{world} {problem}: got {value:g} {p.unit}, expected {p.low:g} to {p.high:g}"
            )
        return x

    def values(self, named: Mapping[str, ArrayLike], num_worlds: int | None = None) -> Array:
        """Named values -> a validated array, the rest nominal.

        Args:
            named: name -> number, or (num_worlds,) numbers.
            num_worlds: None for one vector (d,), else n for (n, d).

        Raises:
            ValueError: for an unknown name, a wrong shape, a value not finite or out of bounds.
        """
        x = np.array(self.nominal if num_worlds is None else np.tile(self.nominal, (num_worlds, 1)))
        for name, value in named.items():
            column = x[..., self.index(name)]
            value = np.asarray(value, dtype=np.float64)
            if value.ndim and value.shape != column.shape:
                raise ValueError(
                    f"parameter {name!r}: got shape {value.shape}, expected a number"
                    + ("" if num_worlds is None else f" or one per world, ({num_worlds},)")
                )
            x[..., self.index(name)] = value
        return self.validate(x)

    def as_dict(self, x: ArrayLike) -> dict[str, float]:
        """One vector of values (d,) as name -> number."""
        return {name: float(v) for name, v in zip(self.names, self._last_axis(x, "values"), strict=True)}

    def _last_axis(self, x: ArrayLike, what: str) -> Array:
        x = np.asarray(x, dtype=np.float64)
        if x.ndim == 0 or x.shape[-1] != len(self):
            raise ValueError(
                f"{what} must have the {len(self)} parameters as last axis ({', '.join(self.names)}),"
                f" got shape {x.shape}"
            )
        return x


def unknown_name(kind: str, name: Any, valid: Iterable[str]) -> str:
    """The message for a name that does not exist: the nearest ones, and all of them."""
    valid = list(valid)
    close = difflib.get_close_matches(str(name), valid, n=3)
    hint = f"; did you mean {', '.join(map(repr, close))}?" if close else "."
    return f"unknown {kind} {name!r}{hint} Valid names: {', '.join(valid)}"


def _constant(values: Iterable[float]) -> Array:
    array = np.array(list(values), dtype=np.float64)
    array.flags.writeable = False
    return array
