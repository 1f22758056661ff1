"""``simopt-envs report``, ``inspect`` and ``replay``: looking at what is there."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from baselines.commands.inputs import require_free
from baselines.commands.recordings import existing_logs


@dataclass(frozen=True)
class Report:
    """Write report.html and the plots of a run again from what is in its folder."""

    directory: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR")]
    """Folder of a run."""

    def run(self, typed: str) -> None:
        """Write the report; ``typed`` is the command line."""
        from simopt_envs.report import write_report

        print(write_report(self.directory))


@dataclass(frozen=True)
class Inspect:
    """Audit a recording: what is in it, and what is wrong with it. Exit code 1 if something is."""

    log: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="LOG")]
    """Recording: CSV, Parquet, NPZ, MAT, the folder of a data set, or minari:ID."""
    model: Path | None = None
    """MJCF file to check names, ranges and units against."""
    mapping: Path | None = None
    """YAML file that names the columns of a foreign log."""
    out: Path | None = None
    """Folder for a plot of each recording and findings.txt."""

    def run(self, typed: str) -> None:
        """Print the audit; ``typed`` is the command line."""
        from simopt_envs.measured import inspect_log

        existing_logs([self.log])
        if self.out is not None:
            require_free(self.out)
        inspection = inspect_log(self.log, self.model, self.mapping, self.out)
        print(inspection)
        if not inspection.ok:
            sys.exit(1)


@dataclass(frozen=True)
class Replay:
    """Run recorded commands through a model and show how far its motion is from the measured one."""

    model: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MODEL.xml")]
    """MJCF file."""
    data: tuple[Path, ...]
    """Recordings."""
    out: Path
    """Folder for errors.csv, summary.txt and plots."""
    mapping: Path | None = None
    """YAML file that names the columns of foreign logs."""
    window: float | None = None
    """Seconds of each stretch that starts from a measured state; each recording as a whole by default."""
    keyframe: str | None = None
    """Where joints start that no column tells of; the model's reference by default."""

    def run(self, typed: str) -> None:
        """Replay and print the errors; ``typed`` is the command line."""
        from simopt_envs.measured import replay_log

        require_free(self.out)
        print(replay_log(self.model, existing_logs(self.data), self.mapping, self.out, self.window, self.keyframe))
