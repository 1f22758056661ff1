"""``simopt-envs demo``: the whole loop on a task of this package, from nothing to a report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from baselines.commands import inputs
from baselines.commands.gap_demo import GapDemo
from baselines.commands.progress import Display
from baselines.commands.runs import control_period, run_loop
from simopt_envs.adaptation import EnvSimulator, HiddenSystem, SimOpt
from simopt_envs.adaptation.records import Iteration
from simopt_envs.report import Details

TASKS: Mapping[str, tuple[str, Mapping[str, float]]] = {
    "drawer": ("SimOpt/Drawer-v0", {"cabinet_x": 0.22}),
    # A rope that is longer than thought, an arm that is softer and in one joint slower, a peg that grips.
    "swing-peg": (
        "SimOpt/SwingPeg-v0",
        {"rope_segment_length": 0.05, "action_scaling_2": 1.8, "peg_friction": 0.75}
        | {f"joint_gain_{joint}": 0.85 for joint in range(1, 5)},
    ),
}
"""By name: the environment, and what the hidden system differs in."""

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

    task: Literal["drawer", "swing-peg", "gap"] = "drawer"
    """The task; gap: a drawer whose robot has an effect that no ξ holds, and that the gap workflow must name first."""
    out: Path | None = None
    """Folder for result.json, checkpoints, plots, film and report.html; out/demo-TASK by default."""
    seed: int = 0
    """Seed of everything random."""

    def run(self, typed: str) -> None:
        """Train, adapt and report; ``typed`` is the command line."""
        out = self.out or Path(f"out/demo-{self.task}")
        if self.task == "gap":
            GapDemo(out, self.seed, typed).run()
            return
        inputs.require_free(out, resume=True)
        env_id, hidden = TASKS[self.task]
        simulator, display = EnvSimulator(env_id), Display()
        distribution = inputs.distribution(env_id, simulator.parameters, ())
        loop = SimOpt(
            simulator,
            distribution,
            inputs.make_trainer("torch", display.training),
            HiddenSystem(env_id, hidden, noise=0.002),
            updates_per_iteration=inputs.UPDATES,
            seed=self.seed,
            directory=out,
            on_event=display.event,
        )
        nominal = simulator.parameters.as_dict(simulator.parameters.nominal)
        display.say(f"{env_id}: p(ξ) over {len(distribution.space)} parameters, all around their nominal values.")
        display.say("The target, which stands for a robot, differs by what the loop cannot read:")
        for name, value in hidden.items():
            display.say(f"  {name} {value:g} {simulator.parameters[name].unit}, nominally {nominal[name]:g}")
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
            display.say(f"{name}: hidden {value:.3f}, adapted {estimate[name]:.3f} {simulator.parameters[name].unit}")
