"""Logs of real hardware, damaged in the ways that logs get damaged: what an audit must not let pass in silence."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.io import loadmat, savemat

Columns = dict[str, np.ndarray]
_SEED = 0


@dataclass(frozen=True)
class DamagedLog:
    """A damaged log.

    Attributes:
        example: whose model and mapping it is for, ``"emps"``.
        damage: what was done to it.
        path: the file.
    """

    example: str
    damage: str
    path: Path


def write_damaged_logs(data: Path, folder: Path) -> Iterator[DamagedLog]:
    """Write the damaged logs into a folder.

    Args:
        data: holds the folders emps, double_pendulum and free_swing.
        folder: where to write.
    """
    pendulum = data / "double_pendulum" / "trajectory_04.csv"
    with pendulum.open() as file:
        names = file.readline().strip().split(",")
    table = np.loadtxt(pendulum, delimiter=",", skiprows=1)
    tables = {
        "double_pendulum": (dict(zip(names, table.T, strict=True)), _csv, ".csv", _PENDULUM),
        "emps": (
            {k: v.ravel() for k, v in loadmat(data / "emps" / "DATA_EMPS.mat").items() if k in ("t", "qm", "vir")},
            _mat,
            ".mat",
            _EMPS,
        ),
        "free_swing": (
            {"angle": np.loadtxt(data / "free_swing" / "pendulum_free_swing_data_01.txt", skiprows=2)},
            _swing_text,
            ".txt",
            _SWING,
        ),
    }
    for example, (columns, encode, suffix, damages) in tables.items():
        whole = encode(columns)
        contents: dict[str, bytes] = {what: encode(damage(dict(columns))) for what, damage in damages.items()}
        contents |= {what: damage(whole) for what, damage in _FILE_DAMAGES.items()}
        if suffix != ".mat":
            contents |= {what: damage(whole) for what, damage in _TEXT_DAMAGES.items()}
        for what, content in contents.items():
            path = folder / f"{example}_{what.replace(' ', '_')}{suffix}"
            path.write_bytes(content)
            yield DamagedLog(example, what, path)


def _csv(columns: Columns) -> bytes:
    text = io.StringIO()
    np.savetxt(text, np.stack(list(columns.values()), axis=-1), "%.9g", ",", header=",".join(columns), comments="")
    return text.getvalue().encode()


def _mat(columns: Columns) -> bytes:
    file = io.BytesIO()
    savemat(file, {name: values[:, None] for name, values in columns.items()})
    return file.getvalue()


def _swing_text(columns: Columns) -> bytes:
    text = io.StringIO()
    np.savetxt(text, columns["angle"], "%.9g", header="log\nangle [deg]", comments="")
    return text.getvalue().encode()


def _changed(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Columns], Columns]:
    return lambda columns: columns | {name: change(columns[name].copy())}


def _rows(choose: Callable[[int], np.ndarray], keep: str | None = None) -> Callable[[Columns], Columns]:
    """Only some rows, in some order; of the column ``keep`` the first ones as they are."""

    def damage(columns: Columns) -> Columns:
        rows = choose(len(next(iter(columns.values()))))
        return {name: values[: len(rows)] if name == keep else values[rows] for name, values in columns.items()}

    return damage


def _swapped(first: str, second: str) -> Callable[[Columns], Columns]:
    return lambda columns: columns | {first: columns[second], second: columns[first]}


def _without(name: str) -> Callable[[Columns], Columns]:
    return lambda columns: {n: v for n, v in columns.items() if n != name}


def _set(start: float, end: float, value: float) -> Callable[[np.ndarray], np.ndarray]:
    """A stretch, in shares of the length, overwritten."""

    def change(values: np.ndarray) -> np.ndarray:
        values[int(start * len(values)) : max(int(end * len(values)), int(start * len(values)) + 1)] = value
        return values

    return change


def _frozen(values: np.ndarray) -> np.ndarray:
    """Held from its fastest moment in the middle half on."""
    quarter = len(values) // 4
    row = quarter + int(np.argmax(np.abs(np.diff(values[quarter:-quarter]))))
    values[row:] = values[row]
    return values


def _late(samples: int) -> Callable[[np.ndarray], np.ndarray]:
    return lambda values: np.concatenate([np.full(samples, values[0]), values[:-samples]])


def _clipped(values: np.ndarray) -> np.ndarray:
    return np.minimum(values, np.percentile(values, 80))


def _of_rows(time: str | None) -> Mapping[str, Callable[[Columns], Columns]]:
    """Rows lost, repeated and out of order."""
    rng = np.random.default_rng(_SEED)
    return {
        "too few rows": _rows(lambda n: np.arange(7) + n // 2),
        "lost rows without stamps": _rows(lambda n: np.r_[: n // 3, n // 3 + n // 20 : n], keep=time),
        "shuffled rows": _rows(rng.permutation, keep=time),
    }


def _of_time(time: str) -> Mapping[str, Callable[[Columns], Columns]]:
    rng = np.random.default_rng(_SEED)
    return {
        "backward time": _rows(lambda n: np.r_[: n // 2, n // 3 : n]),
        "reversed time": _changed(time, lambda t: t[::-1]),
        "time stands still": _changed(time, lambda t: np.zeros_like(t)),
        "time missing": _changed(time, _set(0.5, 0.6, np.nan)),
        "no time column": _without(time),
        "time in milliseconds": _changed(time, lambda t: 1e3 * t),
        "wrong rate": _changed(time, lambda t: 2 * t),
        "repeated stamps": _rows(lambda n: np.r_[: n // 2, n // 2 - 1 : n]),
        "a gap": _rows(lambda n: np.r_[: n // 3, n // 3 + n // 10 : n]),
        "jittered stamps": _changed(time, lambda t: t + rng.uniform(0, 0.5 * float(np.median(np.diff(t))), len(t))),
    }


def _of_position(name: str) -> Mapping[str, Callable[[Columns], Columns]]:
    return {
        "position NaN": _changed(name, _set(0.4, 0.45, np.nan)),
        "position all NaN": _changed(name, _set(0, 1, np.nan)),
        "position infinite": _changed(name, _set(0.4, 0.4, np.inf)),
        "position constant": _changed(name, lambda q: np.full_like(q, 0.2)),
        "position freezes": _changed(name, _frozen),
        "position clipped": _changed(name, _clipped),
        "position beyond physics": _changed(name, lambda q: 1e300 * q),
        "position jumps": _changed(name, lambda q: q + np.where(np.arange(len(q)) > len(q) // 2, 3 * np.ptp(q), 0)),
    }


def _of_command(name: str) -> Mapping[str, Callable[[Columns], Columns]]:
    return {
        "command NaN": _changed(name, _set(0.4, 0.4, np.nan)),
        "command constant": _changed(name, lambda u: np.zeros_like(u)),
        "missing actuator": _without(name),
    }


_PENDULUM: Mapping[str, Callable[[Columns], Columns]] = {
    **_of_time("time"),
    **_of_rows("time"),
    **_of_position("pos_meas2"),
    **_of_command("tau_meas2"),
    "degrees": _changed("pos_meas2", np.rad2deg),
    "degrees per second": _changed("vel_meas2", np.rad2deg),
    "velocity negated": _changed("vel_meas1", np.negative),
    "velocity late": _changed("vel_meas2", _late(10)),
    "velocities swapped": _swapped("vel_meas1", "vel_meas2"),
    "positions swapped": _swapped("pos_meas1", "pos_meas2"),
    "position missing": _without("pos_meas1"),
    "angle wraps": _changed("pos_meas1", lambda q: (q - q.mean()) % (2 * np.pi)),
}
_EMPS: Mapping[str, Callable[[Columns], Columns]] = {
    **_of_time("t"),
    **_of_rows("t"),
    **_of_position("qm"),
    **_of_command("vir"),
    "millimetres": _changed("qm", lambda q: 1e3 * q),
    "columns swapped": _swapped("qm", "vir"),
    "position shorter": lambda columns: columns | {"qm": columns["qm"][:-100]},
}
_SWING: Mapping[str, Callable[[Columns], Columns]] = {**_of_rows(None), **_of_position("angle")}
_FILE_DAMAGES: Mapping[str, Callable[[bytes], bytes]] = {
    "empty file": lambda content: b"",
    "another kind of file": lambda content: bytes(range(256)) * 20,
}
_TEXT_DAMAGES: Mapping[str, Callable[[bytes], bytes]] = {
    "header alone": lambda content: b"\n".join(content.split(b"\n")[:2]),
    "broken rows": lambda content: content.replace(b"1", b"1,,,x", 4000),
    "words in cells": lambda content: content[:1000] + content[1000:].replace(b"0.", b"n/a ", 60),
}
