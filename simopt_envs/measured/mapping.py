"""How a foreign log names and scales its columns, written down in YAML."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from simopt_envs.measured.resample import Array
from simopt_envs.physics.parameters import unknown_name

UNITS: Mapping[str, float] = {
    "1": 1.0,
    **{"rad": 1.0, "deg": math.pi / 180, "mrad": 1e-3, "rev": 2 * math.pi},
    **{"rad/s": 1.0, "deg/s": math.pi / 180, "rpm": 2 * math.pi / 60},
    **{"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "m/s": 1.0, "mm/s": 1e-3},
    **{"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    **{"N": 1.0, "kN": 1e3, "N m": 1.0, "Nm": 1.0, "mN m": 1e-3, "mNm": 1e-3},
    **{"m/s^2": 1.0, "g": 9.80665},
}
"""What one of each unit is in MuJoCo's."""


@dataclass(frozen=True)
class Source:
    """Where a column comes from: ``offset + scale * unit * value``.

    Attributes:
        column: its name in the log.
        scale: factor, 35.15 N/V.
        offset: added last, in the unit of the result.
        unit: what the log is in, one of ``UNITS``.
    """

    column: str
    scale: float = 1.0
    offset: float = 0.0
    unit: str = "1"

    def __post_init__(self) -> None:
        """Raise ValueError for an unknown unit or numbers that are not finite."""
        if self.unit not in UNITS:
            raise ValueError(unknown_name(f"unit of {self.column!r}:", self.unit, UNITS))
        if not (math.isfinite(self.scale) and math.isfinite(self.offset)) or self.scale == 0:
            raise ValueError(
                f"column {self.column!r}: scale {self.scale:g} and offset {self.offset:g} must be finite, scale not 0"
            )

    def read(self, log: Mapping[str, Array]) -> Array:
        """The converted values; ValueError with the nearest names if the log has no such column."""
        if self.column not in log:
            raise ValueError(unknown_name("column of the log", self.column, log))
        return self.offset + self.scale * UNITS[self.unit] * log[self.column]


@dataclass(frozen=True)
class Shown:
    """What a column shows of what it stands for, ``scale * true(t - delay) + bias``, as a gap search may find it.

    Attributes:
        scale: factor.
        bias: in the unit of the result.
        delay: dead time and lag together [s].
        lag_share: of the delay, that of a first-order lag. Undone as if it were dead time, too: to do so in full would
            add noise in proportion to it.
    """

    scale: float = 1.0
    bias: float = 0.0
    delay: float = 0.0
    lag_share: float = 0.0

    def __post_init__(self) -> None:
        """Raise ValueError for a scale of 0."""
        if self.scale == 0:
            raise ValueError("a column whose scale is 0 shows nothing")

    def meant(self, time: Array, values: Array) -> Array:
        """What is true where a column shows values (T,) at some times (T,); NaN where it shows that only later."""
        true = (values - self.bias) / self.scale
        known = np.isfinite(true) & np.isfinite(time)
        if not self.delay or known.sum() < 2 or (np.diff(time[known]) <= 0).any():  # the audit tells of such stamps
            return true
        late = CubicSpline(time[known], true[known], extrapolate=False)(time + self.delay)
        return np.where(known, late, np.nan)


@dataclass(frozen=True)
class LogMapping:
    """A foreign log's columns in the names and units of a recording.

    Attributes:
        columns: recording column -> source; every other column of the log is left out. None for all, as they are.
        time: source of the time stamps; None for a file without any, which then needs ``sample_rate``.
        sample_rate: samples per second [Hz]; beside time stamps, the rate that they are checked against.
        start, end: the log is trimmed to start <= time < end [s]; None for all of it.
        header_lines: lines at the top of a text file to skip, those before the line of names where there is one.
        column_names: names of a text file's columns where it has no line of names.
        shown: recording column -> what it shows, which is undone. A repaired model has a file of it where MJCF cannot
            hold what was found.
    """

    columns: Mapping[str, Source] | None
    time: Source | None = field(default_factory=lambda: Source("time"))
    sample_rate: float | None = None
    start: float | None = None
    end: float | None = None
    header_lines: int = 0
    column_names: tuple[str, ...] | None = None
    shown: Mapping[str, Shown] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Raise ValueError where time can come from nowhere."""
        if self.time is None and self.sample_rate is None:
            raise ValueError("a mapping needs time stamps or a sample_rate")
        if self.sample_rate is not None and not self.sample_rate > 0:
            raise ValueError(f"sample_rate must be positive, got {self.sample_rate:g} Hz")
        if self.columns is not None and not self.columns:
            raise ValueError("a mapping needs at least one column")

    @classmethod
    def from_yaml(cls, path: str | Path) -> LogMapping:
        """Read a mapping; see ``docs/measured.md`` for the keys.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: for a key, a unit or a value that is not understood.
        """
        try:
            import yaml
        except ImportError:
            raise ImportError('reading a mapping needs pyyaml: pip install "simopt-envs[measured]"') from None
        if not Path(path).is_file():
            raise FileNotFoundError(f"there is no file {path}")
        try:
            content = yaml.safe_load(Path(path).read_text())
        except yaml.YAMLError as error:
            raise ValueError(f"{path} is not YAML: {error}") from None
        try:
            return cls.from_dict(content)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None

    @classmethod
    def from_dict(cls, content: Any) -> LogMapping:
        """The same from the parsed content."""
        keys = ("columns", "shown")
        if not isinstance(content, Mapping) or not any(key in content for key in keys):
            raise ValueError("a mapping has a key 'columns', or 'shown', with recording columns as keys")
        for key in keys:
            if key in content and not isinstance(content[key], Mapping):
                raise ValueError(f"{key!r} has recording columns as keys, got {content[key]!r}")
        valid = [f.name for f in fields(cls)]
        for key in content:
            if key not in valid:
                raise ValueError(unknown_name("key", key, valid))
        rate = content.get("sample_rate")
        # A file of bare values at a fixed rate has no column of time stamps, unless the mapping names one.
        time = content.get("time", None if rate is not None else "time")
        names = content.get("column_names")
        return cls(
            columns={str(name): _source(name, entry) for name, entry in content["columns"].items()}
            if "columns" in content
            else None,
            time=None if time is None else _source("time", time),
            sample_rate=None if rate is None else _number("sample_rate", rate),
            start=None if "start" not in content else _number("start", content["start"]),
            end=None if "end" not in content else _number("end", content["end"]),
            header_lines=int(_number("header_lines", content.get("header_lines", 0))),
            column_names=None if names is None else tuple(map(str, names)),
            shown={str(name): _shown(name, entry) for name, entry in content.get("shown", {}).items()},
        )

    def apply(self, log: Mapping[str, Array]) -> tuple[Array, dict[str, Array]]:
        """Time stamps and columns of a log; ValueError if it lacks a column that is mapped."""
        if self.columns is None:
            stamps = None if self.time is None else self.time.column
            columns = {name: values for name, values in log.items() if name != stamps}
        else:
            columns = {name: source.read(log) for name, source in self.columns.items()}
        if self.time is not None:
            time = self.time.read(log)
        else:
            assert self.sample_rate is not None
            time = np.arange(len(next(iter(columns.values())))) / self.sample_rate
        for name, values in columns.items():
            if len(values) != len(time):
                raise ValueError(f"column {name!r} has {len(values)} values, expected one for each of {len(time)} rows")
        for name, shown in self.shown.items():
            if name not in columns:
                raise ValueError(unknown_name("column that is shown", name, columns))
            columns[name] = shown.meant(time, columns[name])
        if self.start is None and self.end is None:
            return time, columns
        # Stamps that are not finite are kept for the audit to find.
        before = time < (-np.inf if self.start is None else self.start)
        keep = ~(before | (time >= (np.inf if self.end is None else self.end)))
        if not keep.any():
            raise ValueError(
                f"nothing is left between start {self.start} and end {self.end}: the log spans"
                f" {np.nanmin(time, initial=np.inf):g} to {np.nanmax(time, initial=-np.inf):g} s"
            )
        return time[keep], {name: values[keep] for name, values in columns.items()}


def _source(name: str, entry: Any) -> Source:
    if isinstance(entry, str | int):
        return Source(str(entry))
    if not isinstance(entry, Mapping) or "from" not in entry:
        raise ValueError(f"column {name!r}: expected a name or {{from: name, scale:, offset:, unit:}}, got {entry!r}")
    valid = ("from", "scale", "offset", "unit")
    for key in entry:
        if key not in valid:
            raise ValueError(unknown_name(f"key of column {name!r}:", key, valid))
    numbers = {key: _number(f"{key} of {name!r}", entry[key]) for key in ("scale", "offset") if key in entry}
    return Source(str(entry["from"]), unit=str(entry.get("unit", "1")), **numbers)


def _shown(name: str, entry: Any) -> Shown:
    valid = [f.name for f in fields(Shown)]
    if not isinstance(entry, Mapping) or not entry:
        raise ValueError(f"column {name!r}: expected some of {', '.join(valid)}, got {entry!r}")
    for key in entry:
        if key not in valid:
            raise ValueError(unknown_name(f"key of column {name!r}:", key, valid))
    return Shown(**{key: _number(f"{key} of {name!r}", value) for key, value in entry.items()})


def _number(what: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{what} must be a number, got {value!r}")
    return float(value)
