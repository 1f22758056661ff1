"""Reading recordings from the files that robots and data sets leave."""

from __future__ import annotations

import csv
import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from simopt_envs.measured.mapping import LogMapping, Source
from simopt_envs.measured.recording import Finding, Recording
from simopt_envs.measured.resample import Array

# LeRobot's bookkeeping beside the signals of a frame.
_LEROBOT_INDICES = ("frame_index", "episode_index", "index", "task_index")


@dataclass(frozen=True)
class _Table:
    """A log as it is.

    Attributes:
        name: of the log.
        columns: name -> numbers, (T,).
        warnings: what was wrong with reading them.
        words: name -> first cell or type, of columns that hold no numbers: a mode, a comment, a date.
    """

    name: str
    columns: Mapping[str, Array]
    warnings: tuple[Finding, ...] = ()
    words: Mapping[str, str] = field(default_factory=dict)


def load_recording(
    path: str | Path, mapping: LogMapping | str | Path | None = None, episode: int | None = None
) -> Recording:
    """Read the one recording of a file, or one episode of a data set; see :func:`load_recordings`.

    Raises:
        ValueError: also if there are several episodes and none is named.
    """
    recordings = load_recordings(path, mapping)
    if episode is None and len(recordings) > 1:
        raise ValueError(f"{path} holds {len(recordings)} episodes: name one, episode=0 to {len(recordings) - 1}")
    if episode is not None and not 0 <= episode < len(recordings):
        raise ValueError(f"{path} has no episode {episode}, only 0 to {len(recordings) - 1}")
    return recordings[episode or 0]


def load_recordings(path: str | Path, mapping: LogMapping | str | Path | None = None) -> list[Recording]:
    """Read all recordings of a file or data set.

    Args:
        path: a ``.csv`` or ``.txt``, ``.parquet``, ``.npz`` or ``.mat`` file, the folder of a LeRobot or Minari data
            set, or ``minari:ID`` for an installed one.
        mapping: the mapping, or its YAML file; None for columns that already have a recording's names.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is empty, damaged, of an unknown kind, or lacks a column that the mapping names.
        ImportError: if the package that reads the format is missing.
    """
    mapping = LogMapping.from_yaml(mapping) if isinstance(mapping, str | Path) else mapping
    recordings = [_recording(table, mapping) for table in _tables(path, mapping)]
    if not recordings:
        raise ValueError(f"{path} holds no episode")
    return recordings


def _recording(table: _Table, mapping: LogMapping | None) -> Recording:
    warnings = table.warnings
    sources = [Source("time")] if mapping is None else [mapping.time, *(mapping.columns or {}).values()]
    for source in sources:
        if source is not None and source.column in table.words:
            first = table.words[source.column]
            raise ValueError(f"{table.name}: column {source.column!r} holds no numbers ({first} ...)")
    if mapping is not None:
        time, columns = mapping.apply(table.columns)
    else:
        if "time" not in table.columns:
            raise ValueError(
                f"{table.name}: no column 'time' among {', '.join(table.columns)}; a mapping can name another column"
                " or give a sample_rate"
            )
        time, columns = table.columns["time"], {n: v for n, v in table.columns.items() if n != "time"}
    if not len(time):
        raise ValueError(f"{table.name}: the log is empty")
    recording = Recording(time, columns, table.name, warnings)
    if mapping is not None and mapping.time is not None and mapping.sample_rate is not None and len(time) > 1:
        _check_rate(recording, mapping.sample_rate)
    return recording


def _check_rate(recording: Recording, sample_rate: float) -> None:
    """ValueError where the stamps are not at the rate that the mapping declares."""
    median = float(np.median(np.diff(recording.time)))
    if abs(median * sample_rate - 1) > 0.05:
        raise ValueError(
            f"{recording.name}: wrong rate: the median interval of the time stamps is {median:.6g} s, the mapping"
            f" declares {sample_rate:g} Hz, which is {1 / sample_rate:.6g} s"
        )


def _tables(path: str | Path, mapping: LogMapping | None) -> Iterator[_Table]:
    if str(path).startswith("minari:"):
        yield from _minari(str(path).removeprefix("minari:"), mapping)
        return
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"there is no recording {path}")
    if path.is_dir():
        if (path / "meta" / "info.json").exists():
            for file in sorted((path / "data").rglob("*.parquet")):
                yield from _parquet(file, mapping)
        elif (path / "data" / "metadata.json").exists():
            yield from _minari(path, mapping)
        else:
            raise ValueError(f"{path} is neither a LeRobot (meta/info.json) nor a Minari (data/metadata.json) data set")
        return
    suffix = path.suffix.lower()
    if suffix not in _READERS:
        raise ValueError(f"{path.name}: unknown kind of recording; known are {', '.join(_READERS)}")
    if path.stat().st_size == 0:
        raise ValueError(f"{path.name}: the file is empty")
    yield from _READERS[suffix](path, mapping)


def _text(path: Path, mapping: LogMapping | None) -> Iterator[_Table]:
    """Text with one row a line, separated by commas, semicolons, tabs or blanks; decimal commas where commas do not."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise ValueError(f"{path.name} is not UTF-8 text") from None
    lines = "\n".join(lines[mapping.header_lines if mapping else 0 :]).strip().splitlines()
    if not lines:
        raise ValueError(f"{path.name}: the file holds no line of data")
    delimiter = _delimiter(lines[0], len(mapping.column_names or ()) if mapping else 0)
    if delimiter:
        rows = list(csv.reader(lines, delimiter=delimiter, skipinitialspace=True))
    else:
        rows = [line.split() for line in lines]
    if mapping and mapping.column_names:
        names = list(mapping.column_names)
    elif np.isnan(_numbers(rows[0], delimiter)).any():
        names = [cell.strip() for cell in rows.pop(0)]
    else:
        raise ValueError(f"{path.name} has no line of column names; give column_names in a mapping")
    if not rows:
        raise ValueError(f"{path.name} holds no row of data")
    names, rows = _without_empty_end(names, rows)
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        raise ValueError(f"{path.name}: column {twice[0]!r} appears more than once")
    warnings = []
    broken = [i for i, row in enumerate(rows) if len(row) != len(names)]
    if len(broken) == len(rows):
        raise ValueError(f"{path.name}: no row has the {len(names)} values that its columns need")
    if broken:
        # Where rows are counted for want of time stamps, a broken one must keep its place.
        counted = mapping is not None and mapping.time is None
        whole = [row if len(row) == len(names) else [""] * len(names) for row in rows]
        rows = whole if counted else [row for row in rows if len(row) == len(names)]
        message = (
            f"{len(broken)} of {len(whole)} rows {'read as missing' if counted else 'left out'}: they do not have"
            f" {len(names)} values; the first is data row {broken[0] + 1}"
        )
        warnings.append(Finding.warning("", "rows", message))
    columns, words = {}, {}
    for name, cells in zip(names, zip(*rows, strict=True), strict=True):
        values = _numbers(cells, delimiter)
        text = [cell for cell, value in zip(cells, values, strict=True) if np.isnan(value) and _is_word(cell)]
        if text and np.isnan(values).all():
            words[name] = repr(text[0])
            continue
        if text:
            message = f"{len(text)} cells are no numbers and read as missing, the first is {text[0]!r}"
            warnings.append(Finding.warning(name, "cells", message))
        columns[name] = values
    yield _Table(path.stem, columns, tuple(warnings), words)


def _delimiter(line: str, columns: int) -> str | None:
    """What separates the cells of the first line, None for blanks.

    Of comma, semicolon and tab it is the one that gives as many columns as there are, where that is known (else 0), or
    the most.
    """
    found = max(",;\t", key=lambda mark: (line.count(mark) + 1 == columns, line.count(mark)))
    return found if found in line else None


def _without_empty_end(names: list[str], rows: list[list[str]]) -> tuple[list[str], list[list[str]]]:
    """Without nameless last columns that hold nothing, as of lines that all end in commas."""
    width = len(names)
    while names and not names[-1] and not any(row[len(names) - 1] for row in rows if len(row) == width):
        names = names[:-1]
    return names, [row[: len(names)] if len(row) == width else row for row in rows]


def _numbers(cells: Sequence[str], delimiter: str | None) -> Array:
    """The numbers in some cells, NaN where there is none.

    Commas are decimal where they separate no columns, unless a cell has a point: then they may group thousands.
    """
    if delimiter != "," and not any("." in cell for cell in cells):
        cells = [cell.replace(",", ".") for cell in cells]
    return np.array([_number(cell) for cell in cells])


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return np.nan


def _is_word(cell: str) -> bool:
    return cell.strip().lower() not in ("", "nan", "na", "null", "none")


def _npz(path: Path, mapping: LogMapping | None) -> Iterator[_Table]:
    arrays = {}
    with _decoding(path), np.load(path, allow_pickle=False) as archive:
        for name in archive.files:
            with _decoding(f"array {name!r}"):
                arrays[name] = archive[name]
    words = {
        name: repr(str(array.flat[0])) for name, array in arrays.items() if array.size and array.dtype.kind in "MSU"
    }
    yield _Table(path.stem, _flatten(arrays), words=words)


def _mat(path: Path, mapping: LogMapping | None) -> Iterator[_Table]:
    from scipy.io import loadmat

    with _decoding(path):
        content = loadmat(path)
    numeric = {
        n: np.asarray(v) for n, v in content.items() if not n.startswith("__") and np.asarray(v).dtype.kind in "fiub"
    }
    columns = {n: v.T if v.ndim == 2 and v.shape[0] == 1 else v for n, v in numeric.items() if v.size > 1}
    yield _Table(
        path.stem, _flatten({n: v[:, 0] if v.ndim == 2 and v.shape[1] == 1 else v for n, v in columns.items()})
    )


def _parquet(path: Path, mapping: LogMapping | None) -> Iterator[_Table]:
    try:
        from pyarrow import parquet
    except ImportError:
        raise ImportError('reading Parquet needs pyarrow: pip install "simopt-envs[measured]"') from None
    with _decoding(path):
        table = parquet.read_table(path)
        arrays = {name: _arrow_values(table[name]) for name in table.column_names}
    words = {name: str(table[name].type) for name, values in arrays.items() if values is None}
    numeric = {name: values for name, values in arrays.items() if values is not None}
    episodes = numeric.get("episode_index")
    if episodes is None:
        yield _Table(path.stem, _flatten(numeric), words=words)
        return
    if "time" not in numeric and "timestamp" in numeric:
        numeric["time"] = numeric["timestamp"]  # its own name stays for a mapping
        if mapping is None:
            del numeric["timestamp"]
    columns = _flatten({n: v for n, v in numeric.items() if n not in _LEROBOT_INDICES}, _lerobot_names(path))
    for episode in np.unique(episodes):
        of_episode = episodes == episode
        yield _Table(f"episode_{int(episode):06d}", {n: v[of_episode] for n, v in columns.items()})


def _arrow_values(column: Any) -> np.ndarray | None:
    """A numeric column (T,), or a column of equally long lists (T, k); None for anything else."""
    import pyarrow as pa

    kind = column.type
    if pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
        rows = column.to_pylist()
        widths = {len(row) for row in rows if row is not None}
        if len(widths) != 1:
            return None
        missing = [None] * widths.pop()
        try:
            return np.array([missing if row is None else row for row in rows], dtype=np.float64)
        except (TypeError, ValueError):
            return None
    if pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_boolean(kind):
        return column.cast(pa.float64(), safe=False).to_numpy()  # ns since 1970 round to 0.3 us
    return None


def _lerobot_names(path: Path) -> dict[str, list[str]]:
    """Names of the numbers in each list column, from ``meta/info.json`` of the data set that the file lies in."""
    info = next((p / "meta" / "info.json" for p in path.parents if (p / "meta" / "info.json").exists()), None)
    if info is None:
        return {}
    names = {}
    for feature, description in json.loads(info.read_text()).get("features", {}).items():
        entries = description.get("names")
        if isinstance(entries, dict):  # {"motors": [...]}, {"axes": [...]}
            entries = next((v for v in entries.values() if isinstance(v, list)), None)
        if isinstance(entries, list):
            names[feature] = [str(entry) for entry in entries]
    return names


def _minari(source: str | Path, mapping: LogMapping | None) -> Iterator[_Table]:
    try:
        import minari
    except ImportError:
        raise ImportError("reading a Minari data set needs minari: pip install minari") from None
    if mapping is None or mapping.sample_rate is None:
        raise ValueError("a Minari data set has no time stamps: give its sample_rate and columns in a mapping")
    with _decoding(source):
        dataset = minari.MinariDataset(source / "data") if isinstance(source, Path) else minari.load_dataset(source)
        episodes = list(dataset.iterate_episodes())
    for episode in episodes:
        # Nothing follows the last observation: the last action holds.
        actions = {n: np.concatenate([v, v[-1:]]) for n, v in _leaves("action", episode.actions).items()}
        yield _Table(f"episode_{episode.id:06d}", _flatten(_leaves("observation", episode.observations) | actions))


def _leaves(name: str, values: Any) -> dict[str, np.ndarray]:
    """Arrays of a nested dictionary or tuple space, names joined by slashes."""
    if isinstance(values, Mapping):
        return {k: v for key, value in values.items() for k, v in _leaves(f"{name}/{key}", value).items()}
    if isinstance(values, tuple):
        return {k: v for i, value in enumerate(values) for k, v in _leaves(f"{name}/{i}", value).items()}
    array = np.asarray(values)
    return {name: array[:, None] if array.ndim == 1 else array}


def _flatten(arrays: Mapping[str, np.ndarray], names: Mapping[str, list[str]] | None = None) -> dict[str, Array]:
    """Columns (T,) from arrays (T,) or (T, k): ``name/0`` ... or ``name/<entry>`` where the entries have names."""
    columns: dict[str, Array] = {}
    for name, array in arrays.items():
        if array.dtype.kind not in "fiub" or array.ndim == 0:
            continue
        if array.ndim == 1 or (name == "time" and array.size == len(array)):
            columns[name] = array.astype(np.float64).reshape(-1)
            continue
        flat = array.reshape(len(array), -1).astype(np.float64)
        entries = (names or {}).get(name, [])
        if len(entries) != flat.shape[1]:
            entries = [str(k) for k in range(flat.shape[1])]
        columns.update({f"{name}/{entry}": flat[:, k] for k, entry in enumerate(entries)})
    return columns


@contextmanager
def _decoding(source: str | Path) -> Iterator[None]:
    """Turns whatever a format's library raises on a damaged file into one ValueError that names the file."""
    try:
        yield
    except ImportError:
        raise
    except Exception as error:
        raise ValueError(f"{source} cannot be read: {type(error).__name__}: {error}") from error


_READERS: dict[str, Callable[[Path, LogMapping | None], Iterator[_Table]]] = {
    ".csv": _text,
    ".txt": _text,
    ".parquet": _parquet,
    ".npz": _npz,
    ".mat": _mat,
}
