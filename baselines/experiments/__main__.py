"""The command line: ``python -m baselines.experiments [QUESTION ...] [--quick] [--engine ray]``."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from baselines.commands.engines import EngineOptions
from baselines.experiments import ablations, iterations, learned_distribution, randomization, robots, update_rules
from baselines.experiments.cell import Store
from baselines.experiments.document import Question, write_document
from baselines.experiments.runner import run_cells
from baselines.experiments.workspace import SMOKE, Effort, Workspace
from simopt_envs.physics.parameters import unknown_name

QUESTIONS: dict[str, Question] = {
    module.QUESTION.name: module.QUESTION
    for module in (randomization, learned_distribution, iterations, robots, update_rules, ablations)
}


@dataclass(frozen=True)
class Experiments:
    """The paper's questions, answered by running them. What is finished is not run again."""

    questions: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[QUESTION ...]")] = ()
    """Some of randomization, learned_distribution, iterations, robots, update_rules, ablations; all by default."""
    quick: bool = False
    """Only a part: fewer seeds and conditions."""
    out: Path = Path("out/experiments")
    """Folder for policies and runs of SimOpt. The machines of a Ray cluster must share it, and that of the pages."""
    docs: Path | None = None
    """Folder for the pages and figures and, in cells, the results that they are made of: docs/experiments, or with
    --quick or --smoke OUT/docs."""
    report: bool = False
    """Run nothing; write the pages of what is finished."""
    smoke: bool = False
    """Spend next to nothing on each cell, to see that all of them run; the figures then mean nothing."""

    where: Annotated[EngineOptions, tyro.conf.arg(name="")] = field(default_factory=EngineOptions)
    """What runs the cells."""

    def __post_init__(self) -> None:
        for name in self.questions:
            if name not in QUESTIONS:
                raise ValueError(unknown_name("question", name, QUESTIONS))

    def run(self) -> int:
        """Run and write; the exit code."""
        effort = SMOKE if self.smoke else Effort()
        out = self.out.resolve()  # workers have another working directory
        docs = self.docs or (out / "docs" if self.quick or self.smoke else Path("docs/experiments"))
        store = Store(docs.resolve() / "cells", effort)
        chosen = [QUESTIONS[name] for name in self.questions or QUESTIONS]
        failed = []
        if not self.report:
            cells = [cell for question in chosen for cell in question.cells() if cell.quick or not self.quick]
            failed = run_cells(cells, store, lambda tell: Workspace(out, effort, tell), engine=self.where.make())
        for question in chosen:
            page = write_document(question, store, docs)
            print(f"{question.name}: {page or 'nothing is finished yet'}")
        return 1 if failed else 0


def main() -> None:
    """Run what the command line says."""
    try:
        sys.exit(tyro.cli(Experiments, prog="python -m baselines.experiments").run())
    except KeyboardInterrupt as interrupt:
        print(f"\n{interrupt}", file=sys.stderr)
        sys.exit(130)
    except (ValueError, ImportError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
