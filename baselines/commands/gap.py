"""``simopt-envs gap``: which physical effect a model lacks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from baselines.commands.inputs import existing, require_free
from baselines.commands.parameter_file import read_parameters
from baselines.commands.recordings import existing_logs


@dataclass(frozen=True)
class Gap:
    """Find where a model and recordings disagree, name the missing physical effect, and write the model with it."""

    model: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MODEL.xml")]
    """MJCF file."""
    data: tuple[Path, ...]
    """Recordings; half of them are held out."""
    out: Path
    """Folder for gap.json, report.html, model.repaired.xml, model.diff and plots."""
    mapping: Path | None = None
    """YAML file that names the columns of foreign logs."""
    config: Path | None = None
    """YAML file of plain parameters and their priors; masses, inertias, armature, damping, gains, latency by default."""
    keyframe: str | None = None
    """Where joints start that no column tells of; the model's reference by default."""

    def run(self, typed: str) -> None:
        """Find the gap, and print it; ``typed`` is the command line."""
        from simopt_envs.gap import find_gap

        logs = existing_logs(self.data)
        existing(path for path in (self.mapping, self.config) if path is not None)
        require_free(self.out, resume=False)
        plain = None if self.config is None else read_parameters(self.config)
        console = Console(highlight=False)
        with Progress(
            TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=console, transient=True
        ) as bar:
            task = bar.add_task("reading", total=None)

            def show(what: str, done: int, total: int) -> None:
                bar.update(task, description=what, completed=done, total=total)

            gap = find_gap(self.model, logs, plain=plain, mapping=self.mapping, keyframe=self.keyframe, progress=show)
        console.print(str(gap))
        console.print(f"report: {gap.save(self.out) / 'report.html'}")
