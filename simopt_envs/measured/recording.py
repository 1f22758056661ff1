"""What a real system left behind: time stamps and columns named after the model."""

from __future__ import annotations

import csv
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import Literal

import numpy as np

from simopt_envs.measured.resample import (
    GAP_PERIODS,
    MOST_GAP,
    Array,
    band_limited,
    hold,
    longest_interval,
    repeated,
    sample_period,
)
from simopt_envs.physics.parameters import unknown_name

SUFFIXES = (".csv", ".parquet", ".npz")
"""The formats a recording can be saved in."""


@dataclass(frozen=True)
class Finding:
    """One thing the audit, or a reader, has to say about a recording.

    Attributes:
        severity: ``"error"``: the recording must not be fitted as it is; ``"warning"``: look at it.
        channel: the column it is about, ``""`` for the recording as a whole.
        check: what was checked, ``"units"``, ``"gaps"``, ...
        message: what was found, with numbers, and what to do.
    """

    severity: Literal["error", "warning"]
    channel: str
    check: str
    message: str

    @classmethod
    def error(cls, channel: str, check: str, message: str) -> Finding:
        """A finding that stops."""
        return cls("error", channel, check, message)

    @classmethod
    def warning(cls, channel: str, check: str, message: str) -> Finding:
        """A finding that travels with the recording into every report."""
        return cls("warning", channel, check, message)

    def __str__(self) -> str:
        return f"{self.severity}: {self.channel + ': ' if self.channel else ''}{self.message}"


@dataclass(frozen=True)
class Recording:
    """A log of a real system.

    Columns: ``ctrl/<actuator>`` commands, ``qpos/<joint>`` and ``qvel/<joint>`` joint positions and velocities,
    ``sensor/<name>`` (``/0``, ``/1`` ... where it has several numbers) and ``site/<name>/x|y|z``. Units are MuJoCo's:
    metre, radian, newton, second. A command in row k holds until row k + 1.

    Attributes:
        time: stamps [s], (T,), as they were logged; the audit checks them.
        columns: name -> values, (T,); NaN where a sample is missing.
        name: what to call it in tables and plots.
        warnings: what is known to be wrong with it; carried along by every method.
        at_rest: whether it begins with everything at rest, and joints without a column at the model's reference or
            keyframe: what a rope or a drawer then does is known, though nothing shows it.
    """

    time: Array
    columns: Mapping[str, Array]
    name: str = "recording"
    warnings: tuple[Finding, ...] = field(default=())
    at_rest: bool = False

    def __post_init__(self) -> None:
        """Raise ValueError where the columns are not as long as the time stamps."""
        time = np.asarray(self.time, dtype=np.float64)
        columns = {name: np.asarray(values, dtype=np.float64) for name, values in self.columns.items()}
        if time.ndim != 1:
            raise ValueError(f"{self.name}: time must have shape (T,), got {time.shape}")
        for name, values in columns.items():
            if values.shape != time.shape:
                raise ValueError(f"{self.name}: column {name!r} has shape {values.shape}, time has {time.shape}")
        object.__setattr__(self, "time", time)
        object.__setattr__(self, "columns", columns)

    def __len__(self) -> int:
        return len(self.time)

    def __getitem__(self, column: str) -> Array:
        if column not in self.columns:
            raise ValueError(f"{self.name}: {unknown_name('column', column, self.columns)}")
        return self.columns[column]

    @property
    def commands(self) -> tuple[str, ...]:
        """Names of the command columns."""
        return tuple(name for name in self.columns if name.startswith("ctrl/"))

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of the measured columns, all but the commands."""
        return tuple(name for name in self.columns if not name.startswith("ctrl/"))

    @property
    def period(self) -> float:
        """Median interval between samples [s]."""
        return sample_period(self.time)

    @property
    def duration(self) -> float:
        """Seconds from the first to the last sample."""
        return float(self.time[-1] - self.time[0]) if len(self) else 0.0

    @property
    def is_all_but_gap(self) -> bool:
        """Whether it has far fewer samples than its duration and rate ask for."""
        return self.duration > 0 and self.duration > MOST_GAP * len(self) * self.period

    def select(self, start: float | None = None, end: float | None = None) -> Recording:
        """The samples with start <= time < end [s], stamps unchanged; ValueError if there is none."""
        low, high = -np.inf if start is None else start, np.inf if end is None else end
        keep = (self.time >= low) & (self.time < high)
        if not keep.any():
            raise ValueError(
                f"{self.name}: no sample in [{low:g}, {high:g}) s; it spans {self.time[0]:g} to {self.time[-1]:g} s"
            )
        return self._rows(keep)

    def only(self, columns: Sequence[str]) -> Recording:
        """The recording with these columns alone; ValueError for one that it does not have."""
        return replace(self, columns={name: self[name] for name in columns})

    def in_order(self) -> Recording:
        """Without repeated time stamps, see :data:`REPEATED_PERIODS`, the last sample of each kept.

        Raises:
            ValueError: where time is not finite or runs backward.
        """
        intervals = np.diff(self.time)
        if not np.isfinite(self.time).all() or (intervals < 0).any():
            raise ValueError(
                f"{self.name}: time must be finite and never run backward; the audit says where it does not"
            )
        again = repeated(self.time)
        return self._rows(~again) if again.any() else self

    def resample(self, period: float) -> Recording:
        """The recording on a uniform grid from its first stamp to its last.

        Commands are held (zero-order), signals are band-limited first; inside gaps signals are NaN.

        Args:
            period: of the grid [s].

        Raises:
            ValueError: for a period that is not positive, time that runs backward, or a recording that is all but gap.
        """
        if not period > 0:
            raise ValueError(f"the resampling period must be positive, got {period:g} s")
        source = self.in_order()
        if source.is_all_but_gap:
            raise ValueError(f"{self.name}: {len(source)} samples in {self.duration:.4g} s: cut it where time jumps")
        grid = source.time[0] + period * np.arange(int(source.duration / period * (1 + 1e-9)) + 1)
        columns = {
            name: (hold if name.startswith("ctrl/") else band_limited)(source.time, values, grid)
            for name, values in source.columns.items()
        }
        return replace(self, time=grid, columns=columns)

    def split(self, fraction: float = 0.7, guard: float = 0.5) -> tuple[Recording, Recording]:
        """Cut in time into a part to fit and a later part held out.

        Args:
            fraction: of the duration that is to be fitted, in (0, 1).
            guard: seconds between the two that neither holds, so that the held-out part does not begin in the
                very motion that was fitted.

        Raises:
            ValueError: if nothing would be left of one of them.
        """
        if not 0 < fraction < 1 or guard < 0:
            raise ValueError(f"a split needs 0 < fraction < 1 and guard >= 0, got {fraction:g} and {guard:g} s")
        cut = self.time[0] + fraction * self.duration
        return self.select(end=cut), self.select(start=cut + guard)

    def windows(self, seconds: float, step: float | None = None) -> Iterator[Recording]:
        """Consecutive stretches of a length, one every ``step`` seconds (the length by default).

        Stretches that run past the end or hold a gap in time are left out.
        """
        if not seconds > 0 or (step is not None and not step > 0):
            raise ValueError(f"windows need a positive length and step, got {seconds:g} s and {step} s")
        step = seconds if step is None else step
        source, slack = self.in_order(), 0.5 * self.period
        for k in range(math.floor((source.duration - seconds + slack) / step) + 1):
            start = source.time[0] + k * step
            end = min(start + seconds, source.time[-1])
            if longest_interval(source.time, start, end) <= GAP_PERIODS * source.period:
                yield source._rows((source.time >= start - slack) & (source.time <= end + slack))

    def save(self, path: str | Path) -> Path:
        """Write ``.csv``, ``.parquet`` or ``.npz``, whichever the path ends in."""
        path = Path(path)
        if path.suffix not in SUFFIXES:
            raise ValueError(f"a recording is saved as one of {', '.join(SUFFIXES)}, got {path.name!r}")
        table = {"time": self.time, **self.columns}
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".npz":
            np.savez_compressed(path, **table)  # type: ignore[arg-type]
        elif path.suffix == ".csv":
            with path.open("w", newline="") as file:
                writer = csv.writer(file)
                writer.writerow(table)
                writer.writerows(zip(*(values.tolist() for values in table.values()), strict=True))
        else:
            try:
                from pyarrow import parquet
                from pyarrow import table as arrow_table
            except ImportError:
                raise ImportError('writing Parquet needs pyarrow: pip install "simopt-envs[measured]"') from None
            parquet.write_table(arrow_table(table), path)
        return path

    def _rows(self, keep: np.ndarray) -> Recording:
        time = self.time[keep]
        from_start = bool(len(time)) and time[0] == self.time[0]
        columns = {name: values[keep] for name, values in self.columns.items()}
        return replace(self, time=time, columns=columns, at_rest=self.at_rest and from_start)


def with_distinct_names(recordings: Iterable[Recording]) -> list[Recording]:
    """The recordings, those with the name of an earlier one numbered: what tells windows apart are names."""
    named: dict[str, Recording] = {}
    for recording in recordings:
        names = (f"{recording.name} ({k})" if k > 1 else recording.name for k in count(1))
        name = next(name for name in names if name not in named)
        named[name] = replace(recording, name=name)
    return list(named.values())


def warnings_of(recordings: Iterable[Recording]) -> tuple[Finding, ...]:
    """What recordings warn of; of the same channel and check in several, the first and how many more there are."""
    found: dict[tuple[str, str, int], list[tuple[str, Finding]]] = {}
    for recording in recordings:
        seen: Counter[tuple[str, str]] = Counter()
        for warning in recording.warnings:
            key = warning.channel, warning.check
            found.setdefault((*key, seen[key]), []).append((recording.name, warning))
            seen[key] += 1
    return tuple(_placed(*alike) for alike in found.values())


def _placed(first: tuple[str, Finding], *others: tuple[str, Finding]) -> Finding:
    """A finding with where it is from, and how many others are like it."""
    name, finding = first
    more = f"; {len(others)} more like it" if others else ""
    return replace(finding, message=f"{finding.message} ({name}{more})")
