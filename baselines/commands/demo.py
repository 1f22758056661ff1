"""``simopt-envs demo``: the whole loop on a task of this package, from nothing to a report."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from baselines.commands import inputs
from baselines.commands.progress import Display
from baselines.commands.runs import control_period, run_loop
from simopt_envs.adaptation import EnvSimulator, HiddenSystem, SimOpt
from simopt_envs.adaptation.records import Iteration
from simopt_envs.report import Details

_TASKS = {"drawer": ("SimOpt/Drawer-v0", {"cabinet_x": 0.22})}
_ITERATIONS = 3
_ENOUGH = 0.95


def _cured(step: Iteration) -> bool:
    """Whether the policy works and p(ξ) has arrived: a policy may work before that, by luck."""
    return (step.target_success or 0.0) >= _ENOUGH and step.verdict.label != "unexplained"


@dataclass(frozen=True)
class Demo:
    """Train a policy, watch it fail on a system with hidden physics, adapt the simulation, watch it succeed.

    Run again, it goes on where it was, or shows what is there.
    """

    task: Literal["drawer"] = "drawer"
    """The task."""
    out: Path = Path("out/demo")
    """Folder for result.json, checkpoints, plots, film and report.html."""
    seed: int = 0
    """Seed of everything random."""

    def run(self, typed: str) -> None:
        """Train, adapt and report; ``typed`` is the command line."""
        inputs.require_free(self.out, resume=True)
        env_id, hidden = _TASKS[self.task]
        simulator, display = EnvSimulator(env_id), Display()
        distribution = inputs.distribution(env_id, simulator.parameters, ())
        loop = SimOpt(
            simulator,
            distribution,
            inputs.make_trainer("torch", display.training),
            HiddenSystem(env_id, hidden, noise=0.002),
            updates_per_iteration=inputs.UPDATES,
            seed=self.seed,
            directory=self.out,
            on_event=display.event,
        )
        named = ", ".join(f"{name} {value:+g} {simulator.parameters[name].unit}" for name, value in hidden.items())
        display.say(f"{env_id}: p(ξ) over {len(distribution.space)} parameters, all around their nominal values.")
        display.say(f"The target, which stands for a robot, differs by what the loop cannot read: {named}.")
        last = run_loop(
            loop,
            _ITERATIONS,
            display,
            Details(typed, env_id, control_period(env_id), hidden),
            typed,
            resume=True,
            film=env_id,
            enough=_cured,
        )
        estimate = dict(zip(last.distribution.space.names, last.distribution.median, strict=True))
        for name, value in hidden.items():
            display.say(f"{name}: hidden {value:+.3f}, adapted {estimate[name]:+.3f} {simulator.parameters[name].unit}")
