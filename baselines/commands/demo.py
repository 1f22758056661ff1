"""``simopt-envs demo``: the whole loop on a task of this package, from nothing to a report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from baselines.commands import inputs
from baselines.commands.progress import Display
from baselines.commands.runs import control_period, run_loop
from simopt_envs.adaptation import EnvSimulator, HiddenSystem, SimOpt
from simopt_envs.report import Details

_ENOUGH = 0.95


@dataclass(frozen=True)
class _Task:
    """What a demo shows.

    Attributes:
        env_id: the environment.
        hidden: physical values of the target, which the loop cannot read.
        iterations: at most so many, fewer if the target is solved before.
        training: arguments of PPO that differ from its defaults.
        updates: of p(ξ), per iteration.
    """

    env_id: str
    hidden: Mapping[str, float]
    iterations: int
    training: Mapping[str, Any] = field(default_factory=dict)
    updates: int = inputs.UPDATES


TASKS = {
    "drawer": _Task("SimOpt/Drawer-v0", {"cabinet_x": 0.22}, iterations=3),
    "swing-peg": _Task(
        "SimOpt/SwingPeg-v0",
        {
            "rope_segment_length": 0.044,
            "joint_gain_2": 1.15,
            "joint_gain_4": 1.15,
            "action_scaling_2": 1.8,
            "peg_friction": 1.5,
        },
        iterations=2,
        training={
            "num_envs": 64,
            "minibatches": 5,
            "iterations": 250,
            "warm_start_iterations": 100,
            "success_stop": 0.97,
        },
        updates=15,
    ),
}


@dataclass(frozen=True)
class Demo:
    """Train a policy, watch it fail on a system with hidden physics, adapt the simulation, watch it succeed.

    Run again, it goes on where it was, or shows what is there.
    """

    task: Literal["drawer", "swing-peg"] = "drawer"
    """The task."""
    out: Path = Path("out/demo")
    """Folder for result.json, checkpoints, plots, film and report.html."""
    seed: int = 0
    """Seed of everything random."""

    def run(self, typed: str) -> None:
        """Train, adapt and report; ``typed`` is the command line."""
        inputs.require_free(self.out, resume=True)
        task = TASKS[self.task]
        env_id, simulator, display = task.env_id, EnvSimulator(task.env_id), Display()
        distribution = inputs.distribution(env_id, simulator.parameters, ())
        loop = SimOpt(
            simulator,
            distribution,
            inputs.make_trainer("torch", display.training, **task.training),
            HiddenSystem(env_id, task.hidden, noise=0.002),
            updates_per_iteration=task.updates,
            seed=self.seed,
            directory=self.out,
            on_event=display.event,
        )
        hidden = ", ".join(
            f"{name} {value:+g} {simulator.parameters[name].unit}" for name, value in task.hidden.items()
        )
        display.say(f"{env_id}: p(ξ) over {len(distribution.space)} parameters, all around their nominal values.")
        display.say(f"The target, which stands for a robot, differs by what the loop cannot read: {hidden}.")
        last = run_loop(
            loop,
            task.iterations,
            display,
            Details(typed, env_id, control_period(env_id), task.hidden),
            typed,
            resume=True,
            film=env_id,
            enough=lambda step: step.target_success is not None and step.target_success >= _ENOUGH,
        )
        estimate = dict(zip(last.distribution.space.names, last.distribution.median, strict=True))
        for name, value in task.hidden.items():
            display.say(f"{name}: hidden {value:+.3f}, adapted {estimate[name]:+.3f} {simulator.parameters[name].unit}")
