"""A run on disk: what identifies it, and the result of every phase, each written whole or not at all."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import is_dataclass
from pathlib import Path
from types import FunctionType
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

Content = Mapping[str, ArrayLike]
Result = dict[str, np.ndarray]
_RUN, _PHASES = "run.json", "checkpoints"


def identity(component: Any) -> Any:
    """What identifies a part of a run, made of what JSON holds: a run may be resumed only with the same parts.

    A component can say it by a method ``identity()``. Otherwise it is its type (a function's or class's name), and the
    fields of it and of its public attributes, as far as they are dataclasses. Of a model it is a digest.
    """
    if isinstance(component, np.ndarray | np.generic):
        return component.tolist()
    if isinstance(component, Mapping):
        return {str(name): identity(value) for name, value in component.items()}
    if isinstance(component, mujoco.MjModel):
        saved = np.empty(mujoco.mj_sizeModel(component), dtype=np.uint8)
        mujoco.mj_saveModel(component, None, saved)
        return hashlib.sha256(saved.tobytes()).hexdigest()[:16]
    if isinstance(component, list | tuple):
        return [identity(item) for item in component]
    if component is None or isinstance(component, bool | int | float | str):
        return component
    if isinstance(component, FunctionType | type):
        return f"{component.__module__}.{component.__qualname__}"
    if callable(getattr(component, "identity", None)):
        return identity(component.identity())
    public = {name: value for name, value in getattr(component, "__dict__", {}).items() if not name.startswith("_")}
    if not is_dataclass(component):
        public = {name: value for name, value in public.items() if is_dataclass(value)}
    kind = type(component)
    return {"type": f"{kind.__module__}.{kind.__qualname__}", **{k: identity(v) for k, v in public.items()}}


def digest(*content: Any) -> str:
    """A short hash of what identifies some things."""
    return hashlib.sha256(json.dumps(identity(content)).encode()).hexdigest()[:16]


class Checkpoint:
    """The phases of a run, computed once and kept.

    Args:
        directory: where the run lives; None keeps nothing.
        settings: what identifies the run, made of what JSON holds.
        resume: go on with the run in the directory, if there is one.

    Raises:
        FileExistsError: if the directory holds a run and ``resume`` is False; nothing is written.
        ValueError: if it holds a run of other settings, naming those that differ; nothing is written.
    """

    def __init__(self, directory: Path | None, settings: Mapping[str, Any], resume: bool):
        self.directory = directory
        if directory is None:
            return
        run = directory / _RUN
        if not (resume and run.exists()):
            present = [name for name in (_RUN, _PHASES, "result.json") if (directory / name).exists()]
            if present:
                raise FileExistsError(
                    f"{directory} holds a run already ({', '.join(present)}); resume it, or choose another folder"
                )
        settings = json.loads(json.dumps(settings))  # as it will be read
        if run.exists():
            differing = list(_differences(json.loads(run.read_text()), settings))
            if differing:
                raise ValueError(f"{directory} holds a run with other settings: " + "; ".join(differing))
        else:
            directory.mkdir(parents=True, exist_ok=True)
            write_json(run, settings)
        (directory / _PHASES).mkdir(exist_ok=True)
        for hidden in (directory / _PHASES).glob(".*"):
            if hidden.is_dir():  # an unfinished phase; no file of the file manager's
                shutil.rmtree(hidden)

    def folder(self, phase: str) -> Path:
        """Where a finished phase's files are."""
        assert self.directory is not None
        return self.directory / _PHASES / phase

    def has(self, phase: str) -> bool:
        """Whether a phase is finished and on disk."""
        return self.directory is not None and self.folder(phase).exists()

    def phase(self, phase: str, compute: Callable[[], Content], save: Callable[[Path], None] | None = None) -> Result:
        """The result of a phase: from disk, or computed and then written.

        Args:
            phase: its name.
            compute: what it consists of.
            save: called after ``compute`` with a folder for further files.
        """
        if self.has(phase):
            with np.load(self.folder(phase) / "result.npz", allow_pickle=False) as stored:
                return dict(stored)
        result = {name: np.asarray(value) for name, value in compute().items()}
        if self.directory is not None:
            unfinished = self.directory / _PHASES / f".{phase}"
            unfinished.mkdir()
            np.savez(unfinished / "result.npz", **result)  # type: ignore[arg-type]
            if save is not None:
                save(unfinished)
            for file in unfinished.iterdir():
                _flush(file)
            unfinished.rename(self.folder(phase))
            _flush(self.directory / _PHASES)
        return result

    def write_result(self, result: Mapping[str, Any]) -> None:
        """Replace ``result.json``."""
        if self.directory is not None:
            write_json(self.directory / "result.json", result)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Replace a file at once by standard JSON; ValueError for a number that is not finite."""
    unfinished = path.with_name(f".{path.name}")
    unfinished.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")
    _flush(unfinished)
    unfinished.replace(path)
    _flush(path.parent)


def _flush(path: Path) -> None:
    """Have a file or folder reach the disk before what follows."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _differences(was: Any, now: Any, where: str = "") -> Iterator[str]:
    """Where two JSON values differ, "a.b: 1 before, 2 now"."""
    if isinstance(was, dict) and isinstance(now, dict):
        for key in sorted(was.keys() | now.keys()):
            yield from _differences(was.get(key), now.get(key), f"{where}.{key}" if where else key)
    elif was != now:
        yield f"{where} was {json.dumps(was)}, is now {json.dumps(now)}"
