"""``simopt-envs gap``: which physical effect a model lacks."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import gymnasium as gym
import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from baselines.commands.engines import EngineOptions
from baselines.commands.inputs import existing, require_free
from baselines.commands.progress import SECONDS_BETWEEN_LINES
from baselines.commands.recordings import existing_logs
from baselines.commands.runs import interruptible
from simopt_envs.distributions import Gaussian
from simopt_envs.engine import Engine, ThreadEngine
from simopt_envs.measured import load_recording, load_recordings
from simopt_envs.measured.recording import Finding

if TYPE_CHECKING:
    from simopt_envs.gap.search import Progress as Shown

_FITS = ".fits"
_EXPLAINED = "Parameters within p(ξ) explain the measured rollouts: what is left is noise."


@dataclass(frozen=True)
class Gap:
    """Find where a model and recordings disagree, name the missing physical effect, and write the model with it."""

    model: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MODEL.xml|ENV_ID")]
    """MJCF file, or id of an environment: of this package, or one that runs an MJCF file, as Gymnasium's."""
    data: tuple[Path, ...]
    """Recordings; half of them are held out."""
    out: Path
    """Folder for gap.json, report.html, model.repaired.xml, model.diff and plots, and columns.yaml where MJCF cannot
    hold all that was found. The same command goes on from the fits that are finished, if it was stopped."""
    mapping: Path | None = None
    """YAML file that names the columns of foreign logs, and may say what they show, as columns.yaml does."""
    config: Path | None = None
    """YAML file of plain parameters and their priors; by default masses, inertias, armature, damping, gains, latency;
    of an environment of this package the first p(ξ) of adapt."""
    keyframe: str | None = None
    """Where joints start that no column tells of; by default the model's reference, of an environment of this package
    its home."""
    at_rest: tuple[Path, ...] = ()
    """Those of the recordings that begin with everything at rest, joints that no column tells of at that keyframe: a
    rope hangs, a drawer is shut. If they are most, they alone are compared, from there to their ends."""

    where: Annotated[EngineOptions, tyro.conf.arg(name="")] = field(default_factory=EngineOptions)
    """What fits the candidates."""

    def run(self, typed: str) -> None:
        """Find the gap, and print it; ``typed`` is the command line."""
        from simopt_envs.gap import find_gap

        logs = existing_logs(self.data)
        existing(path for path in (self.mapping, self.config) if path is not None)
        if others := set(self.at_rest) - set(self.data):
            raise ValueError(f"--at-rest names {min(others)}, which is none of the recordings of --data")
        recordings = [
            replace(recording, at_rest=log in self.at_rest)
            for log in logs
            for recording in load_recordings(log, self.mapping)
        ]
        if not (self.out / _FITS).exists():  # a run that was stopped goes on, wherever it was
            require_free(self.out)
        engine, console = self.where.make(local=ThreadEngine), Console(highlight=False)
        with interruptible(typed), _shown(console) as show:
            gap = find_gap(
                self.model,
                recordings,
                config=self.config,
                keyframe=self.keyframe,
                progress=show,
                engine=engine,
                directory=self.out / _FITS,
            )
        report = gap.save(self.out) / "report.html"
        shutil.rmtree(self.out / _FITS)
        console.print(f"{gap}\nreport: {report}", markup=False, soft_wrap=True)


def explain(
    env_id: str,
    distributions: Sequence[Gaussian],
    logs: Sequence[Path],
    folder: Path,
    console: Console,
    engine: Engine | None = None,
) -> str | None:
    """Find what an environment's model lacks, if p(ξ) leaves more of the logs of its episodes than noise.

    It does where the plain parameters, refitted under p(ξ), leave more in the median window held out: where fingers
    touch or slip is so delicate that single windows go far astray even for the right model. Of several p(ξ) that all
    leave more, the one that leaves least goes into the search: SimOpt may have bent p(ξ) in vain.

    Args:
        env_id: an environment of this package.
        distributions: p(ξ), each of which may explain the logs.
        logs: of :class:`~baselines.logged_system.LoggedSystem`, two at least; episodes begin at rest.
        folder: for ``gap.json``, ``report.html`` and the repaired model, if more than noise is left. What is there
            already is kept, and a search that was stopped goes on from its finished fits.
        console: shows the progress.
        engine: fits the candidates; threads of this process by default.

    Returns:
        A sentence that noise is all that is left, and which columns could not be compared; None where more is left.

    Raises:
        ValueError: for logs that cannot be read as recordings of the environment.
    """
    from simopt_envs.gap.environments import HOME, environment
    from simopt_envs.gap.find import read, refitted, solve
    from simopt_envs.gap.thresholds import EXPLAINED
    from simopt_envs.gap.trial import of_median_window

    if (folder / "gap.json").exists() and not (folder / _FITS).exists():
        return None
    recordings = [replace(load_recording(log), at_rest=True) for log in logs]
    with _shown(console) as show:
        tried = []
        for distribution in distributions:
            spec, plain = environment(env_id, distribution)
            problem = read(spec, recordings, plain, keyframe=HOME)
            null = refitted(problem, show)
            tried.append((of_median_window(null.held_out.errors), problem, null))
            if tried[-1][0] < EXPLAINED:
                return _EXPLAINED + _not_compared(problem.data.warnings)
        _, problem, null = min(tried, key=lambda one: one[0])
        gap = solve(problem, progress=show, engine=engine, directory=folder / _FITS, null=null)
    gap.save(folder)
    shutil.rmtree(folder / _FITS)
    return None


def _not_compared(warnings: Sequence[Finding]) -> str:
    """Windows and columns that were left out, of which nothing is known, as sentences."""
    channels: dict[str, list[str]] = {}
    for warning in warnings:
        if warning.check == "start":
            channels.setdefault(warning.message, []).append(warning.channel)
    return "".join(f" {', '.join(names)}: {message}." for message, names in channels.items())


def told(folder: Path) -> str:
    """``named: coulomb_friction at joint:joint4 (frictionloss 13)``: the answer of the ``gap.json`` in a folder."""
    found = json.loads((folder / "gap.json").read_text())
    return f"{found['verdict']}: {'; '.join(map(told_effect, found['effects'])) or found['unexplained']}"


def told_effect(entry: Mapping[str, Any]) -> str:
    """``coulomb_friction at joint:joint4 (frictionloss 13)``: an entry of the effects in ``gap.json``."""
    values = {k: v["value"] if isinstance(v, Mapping) else v for k, v in entry["parameters"].items()}
    numbers = ", ".join(f"{name} {value:.3g}" for name, value in values.items())
    return f"{entry['effect']} at {entry['where']} ({numbers})"


def ways_on(env_id: str, folder: Path) -> list[str]:
    """What to open and to type after what :func:`explain` has put into a folder."""
    effects = json.loads((folder / "gap.json").read_text())["effects"]
    lines = [f"report: {folder / 'report.html'}"]
    if effects:
        try:
            gym.make(env_id, effects=effects).close()
        except ValueError as obstacle:
            lines.append(f"repaired model: {folder / 'model.repaired.xml'}; {obstacle}")
        else:
            read = f'json.load(open("{folder / "gap.json"}"))["effects"]'
            lines.append(f'repaired environment: gym.make("{env_id}", effects={read})')
    return lines


@contextmanager
def _shown(console: Console) -> Iterator[Shown]:
    """A bar for what a search tells of its progress; lines where that is no terminal."""
    columns = TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn()
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task, last_line = bar.add_task("reading", total=None), time.monotonic()

        def show(what: str, done: int, total: int) -> None:
            nonlocal last_line
            bar.update(task, description=what, completed=done, total=total)
            if not console.is_terminal and time.monotonic() - last_line > SECONDS_BETWEEN_LINES:
                last_line = time.monotonic()
                line = f"looking for what is missing: {what} {done} of {total}"
                console.print(line, markup=False, soft_wrap=True)

        yield show
