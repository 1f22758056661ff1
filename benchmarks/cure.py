"""Curing policies that fail on hidden physics: success before and after each SimOpt iteration.

    python benchmarks/cure.py [--targets drawer-15cm drawer-22cm] [--seeds 0 1 2 3 4] [--out out/cure]

Each run starts from scratch: PPO under the environment's default p(ξ), around nominal; a hidden system that differs;
three measured rollouts an iteration. A run ends when enough of the evaluation episodes succeed, or after the iterations
that its target may take; one that was interrupted goes on where it stopped, and one that is finished is only read.
Prints a table of the runs and one of the targets.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

import simopt_envs  # noqa: F401 - registers the environments
from baselines.commands.demo import TASKS
from baselines.commands.inputs import UPDATES, distribution
from baselines.ppo_torch import TorchPPO
from simopt_envs.adaptation import HiddenSystem, SimOpt
from simopt_envs.adaptation.simulator import EnvSimulator

_CURED = 0.95
"""Success at which a run ends."""


@dataclass(frozen=True)
class Target:
    """A hidden system."""

    env_id: str
    hidden: Mapping[str, float]
    """What differs from nominal."""
    iterations: int
    """Most iterations that a cure may take."""


TARGETS = {
    "drawer-15cm": Target("SimOpt/Drawer-v0", {"cabinet_x": 0.15}, iterations=2),
    "drawer-22cm": Target(*TASKS["drawer"], iterations=3),
}


@dataclass
class Args:
    """Which runs."""

    targets: tuple[str, ...] = tuple(TARGETS)
    """Names of hidden systems."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """One run each."""
    out: Path = Path("out/cure")
    """Holds a folder per run."""
    evaluation_episodes: int = 100
    """Episodes on the hidden system that count successes."""

    def __post_init__(self) -> None:
        for name in self.targets:
            if name not in TARGETS:
                raise ValueError(f"there is no target {name!r}, only {', '.join(TARGETS)}")


def run(name: str, seed: int, args: Args) -> list[dict]:
    """The iterations of one run, as in its ``result.json``."""
    target, folder = TARGETS[name], args.out / f"{name}_seed_{seed}"
    simulator = EnvSimulator(target.env_id)
    loop = SimOpt(
        simulator,
        distribution(target.env_id, simulator.parameters, ()),
        trainer=TorchPPO(),
        real_system=HiddenSystem(target.env_id, target.hidden, noise=0.002),
        updates_per_iteration=UPDATES,
        evaluation_episodes=args.evaluation_episodes,
        seed=seed,
        directory=folder,
    )
    start, shown = time.perf_counter(), next(iter(target.hidden))
    for step in loop.run(target.iterations, resume=True):
        success = step.target_success or 0.0
        estimate = step.distribution.median[list(step.distribution.space.names).index(shown)]
        print(
            f"{name}, seed {seed}, iteration {step.index}: success {success:.2f} ({step.sim_success:.2f} simulated), "
            f"{shown} {estimate:.3g} of {target.hidden[shown]:.3g}, {time.perf_counter() - start:.0f} s",
            flush=True,
        )
        if success >= _CURED:
            break
    return json.loads((folder / "result.json").read_text())["iterations"]


def main(args: Args) -> None:
    print("Noise 2 mm and 2 mrad, 3 measured rollouts an iteration\n")
    runs = {(name, seed): run(name, seed, args) for name in args.targets for seed in args.seeds}
    print("\n| target | seed | success by iteration | PPO steps |\n|---|---|---|---|")
    for (name, seed), iterations in runs.items():
        successes = " → ".join(f"{100 * i['target_success']:.0f} %" for i in iterations)
        steps = sum(i["train_steps"] for i in iterations)
        print(f"| {name} | {seed} | {successes} | {steps:,} |")
    print("\n| target | iterations allowed | before ≤ 5 % | after | median iterations needed |")
    print("|---|---|---|---|---|")
    for name in args.targets:
        target, cures = TARGETS[name], [[i["target_success"] for i in runs[name, seed]] for seed in args.seeds]
        before = sum(c[0] <= 0.05 for c in cures)
        needed = [len(c) - 1 if c[-1] >= _CURED else np.inf for c in cures]
        after = f"≥ {100 * _CURED:.0f} %: {np.isfinite(needed).sum()} of {len(cures)}"
        row = (name, target.iterations, f"{before} of {len(cures)}", after, np.median(needed))
        print("| " + " | ".join(map(str, row)) + " |")


if __name__ == "__main__":
    main(tyro.cli(Args))
