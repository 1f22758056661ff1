"""``simopt-envs gap``: which physical effect a model lacks."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import gymnasium as gym
import mujoco
import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from baselines.commands.engines import EngineOptions
from baselines.commands.inputs import distribution, existing, require_free
from baselines.commands.parameter_file import read_parameters
from baselines.commands.recordings import existing_logs
from simopt_envs.distributions import Gaussian
from simopt_envs.physics import ParameterSpace

HOME = "home"
"""Keyframe of an environment's model where its joints are when an episode begins."""
_FITS = ".fits"


@dataclass(frozen=True)
class Gap:
    """Find where a model and recordings disagree, name the missing physical effect, and write the model with it."""

    model: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MODEL.xml|ENV_ID")]
    """MJCF file, or id of an environment of this package."""
    data: tuple[Path, ...]
    """Recordings; half of them are held out."""
    out: Path
    """Folder for gap.json, report.html, model.repaired.xml, model.diff and plots. The same command goes on from the
    fits that are finished, if it was stopped."""
    mapping: Path | None = None
    """YAML file that names the columns of foreign logs."""
    config: Path | None = None
    """YAML file of plain parameters and their priors; by default masses, inertias, armature, damping, gains, latency;
    of an environment the first p(ξ) of adapt."""
    keyframe: str | None = None
    """Where joints start that no column tells of; by default the model's reference, of an environment its home."""

    where: Annotated[EngineOptions, tyro.conf.arg(name="")] = field(default_factory=EngineOptions)
    """What fits the candidates."""

    def run(self, typed: str) -> None:
        """Find the gap, and print it; ``typed`` is the command line."""
        from simopt_envs.gap import find_gap

        logs = existing_logs(self.data)
        existing(path for path in (self.mapping, self.config) if path is not None)
        require_free(self.out, resume=False)
        model: str | mujoco.MjSpec = self.model
        keyframe, plain = self.keyframe, None
        if self.model in gym.registry:
            model, plain = environment(self.model)
            keyframe = keyframe or HOME
        if self.config is not None:
            plain = read_parameters(self.config)
        engine, console = self.where.make(), Console(highlight=False)
        with Progress(
            TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=console, transient=True
        ) as bar:
            task = bar.add_task("reading", total=None)

            def show(what: str, done: int, total: int) -> None:
                bar.update(task, description=what, completed=done, total=total)

            gap = find_gap(
                model,
                logs,
                plain=plain,
                mapping=self.mapping,
                keyframe=keyframe,
                progress=show,
                engine=engine,
                directory=self.out / _FITS,
            )
        console.print(str(gap))
        console.print(f"report: {gap.save(self.out) / 'report.html'}")
        shutil.rmtree(self.out / _FITS)


def environment(env_id: str) -> tuple[mujoco.MjSpec, Gaussian]:
    """The model of an environment of this package, and its first p(ξ) as plain parameters.

    Recordings hold what the drives were commanded, so that parameters of what the task makes of actions say nothing.

    Raises:
        ValueError: for an environment without a task, or without a first p(ξ).
    """
    env = gym.make(env_id)
    task: Any = getattr(env.unwrapped, "task", None)
    env.close()
    if not hasattr(task, "make_spec"):
        raise ValueError(f"{env_id} has no task with a model to repair; give its MJCF file")
    space: ParameterSpace = task.parameters
    prior = distribution(env_id, space, ())
    mechanical = [p.name for p in prior.space if any(write.field != "numeric_data" for write in p.writes)]
    return task.make_spec(), prior.marginal(mechanical)
