"""Cells, the units that experiments are made of, and their results on disk."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from simopt_envs.adaptation.checkpoint import write_json

if TYPE_CHECKING:
    from baselines.experiments.workspace import Effort, Workspace

Result = dict[str, Any]
"""What a cell found, made of what JSON holds."""
Results = Mapping[str, Mapping[int, Result]]
"""Condition -> seed -> result, of the cells that are finished."""


class Settings(Protocol):
    """What a cell does: a frozen dataclass of numbers, texts, and collections and dataclasses of these."""

    def run(self, seed: int, workspace: Workspace) -> Result:
        """Do it. The result depends on the settings, the seed and the workspace's effort alone."""
        ...


@dataclass(frozen=True)
class Cell:
    """One condition of a question with one seed.

    Attributes:
        question: its name.
        condition: its name within the question, also that of a file.
        seed: of everything random.
        settings: what to do.
        quick: whether it belongs to the quick set.
    """

    question: str
    condition: str
    seed: int
    settings: Settings
    quick: bool = False

    def __str__(self) -> str:
        return f"{self.question}/{self.condition}-{self.seed}"


class Store:
    """Results on disk, a file for each cell: ``FOLDER/QUESTION/CONDITION-SEED.json``.

    A result counts only for the settings and the effort that it was made with. Which version of the code made it is
    not looked at.

    Args:
        folder: where they are.
        effort: what the cells may spend.
    """

    def __init__(self, folder: Path, effort: Effort):
        self.folder, self._effort = folder, described(effort)

    def path(self, cell: Cell) -> Path:
        """The file of a cell."""
        return self.folder / cell.question / f"{cell.condition}-{cell.seed}.json"

    def load(self, cell: Cell) -> Result | None:
        """The result of a cell; None where there is none."""
        record = self._record(cell)
        return None if record is None else record["result"]

    def seconds(self, cells: Iterable[Cell]) -> float:
        """How long those of the cells that are finished took, together."""
        return sum(record["seconds"] for record in map(self._record, cells) if record is not None)

    def save(self, cell: Cell, result: Result, seconds: float) -> None:
        """Write a result, all of it or nothing."""
        path = self.path(cell)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, {**self._made_with(cell), "seconds": round(seconds, 1), "result": result})

    def results(self, cells: Iterable[Cell]) -> dict[str, dict[int, Result]]:
        """Of those of the cells that are finished."""
        results: dict[str, dict[int, Result]] = {}
        for cell in cells:
            result = self.load(cell)
            if result is not None:
                results.setdefault(cell.condition, {})[cell.seed] = result
        return results

    def _record(self, cell: Cell) -> dict[str, Any] | None:
        path = self.path(cell)
        if not path.exists():
            return None
        record = json.loads(path.read_text(encoding="utf-8"))
        made_with = self._made_with(cell)
        return record if {key: record[key] for key in made_with} == made_with else None

    def _made_with(self, cell: Cell) -> dict[str, Any]:
        return {"settings": described(cell.settings), "seed": cell.seed, "effort": self._effort}


def described(settings: Any) -> dict[str, Any]:
    """A dataclass as JSON will hold it, with the name of its type."""
    return {"kind": type(settings).__name__, **json.loads(json.dumps(asdict(settings)))}


def digest(content: Any) -> str:
    """A name for what JSON holds, made of its content."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]
