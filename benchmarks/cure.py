"""Curing a drawer policy of a cabinet that stands elsewhere: success before and after each SimOpt iteration.

    python benchmarks/cure.py [--shifts 0.15 0.22] [--seeds 0 1 2 3 4] [--out out/cure]

Each run starts from scratch: PPO under a cabinet at its nominal place (σ 2 cm, other physics varied too), a hidden
system whose cabinet is shifted, three measured rollouts an iteration. A run ends when it succeeds in 95 % of the
evaluation episodes, or after the iterations that its shift may take; one that was interrupted goes on where it stopped,
and one that is finished is only read. Prints a table of the runs and one of the targets.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

import simopt_envs  # noqa: F401 - registers the environments
from baselines.commands.inputs import UPDATES, distribution
from baselines.ppo_torch import TorchPPO
from simopt_envs.adaptation import HiddenSystem, SimOpt
from simopt_envs.adaptation.simulator import EnvSimulator

ENV_ID = "SimOpt/Drawer-v0"
ALLOWED = {0.15: 2, 0.22: 3}  # iterations that a shift may take
CURED = 0.95  # a run stops at this success


@dataclass
class Args:
    """Which runs."""

    shifts: tuple[float, ...] = (0.15, 0.22)
    """Of the hidden cabinet along x, in m."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """One run each."""
    out: Path = Path("out/cure")
    """Holds a folder per run."""
    evaluation_episodes: int = 100
    """Episodes on the hidden system that count successes."""


def run(shift: float, seed: int, args: Args) -> list[dict]:
    """The iterations of one run, as in its ``result.json``, with the estimate of the shift and wall seconds added."""
    folder = args.out / f"shift_{100 * shift:.0f}_seed_{seed}"
    simulator = EnvSimulator(ENV_ID)
    loop = SimOpt(
        simulator,
        distribution(ENV_ID, simulator.parameters, ()),
        trainer=TorchPPO(),
        real_system=HiddenSystem(ENV_ID, parameters={"cabinet_x": shift}, noise=0.002),
        updates_per_iteration=UPDATES,
        evaluation_episodes=args.evaluation_episodes,
        seed=seed,
        directory=folder,
    )
    start = time.perf_counter()
    column = list(loop.distribution.space.names).index("cabinet_x")
    for step in loop.run(ALLOWED.get(shift, 3), resume=True):
        mean, std = step.distribution.mean[column], step.distribution.std[column]
        print(
            f"shift {100 * shift:.0f} cm, seed {seed}, iteration {step.index}: success {step.target_success:.2f}, "
            f"cabinet_x {100 * mean:.1f} ± {100 * std:.1f} cm, {time.perf_counter() - start:.0f} s",
            flush=True,
        )
        if step.target_success >= CURED:
            break
    return json.loads((folder / "result.json").read_text())["iterations"]


def main(args: Args) -> None:
    print(f"{ENV_ID}, noise 2 mm and 2 mrad, 3 measured rollouts an iteration\n")
    runs = {(shift, seed): run(shift, seed, args) for shift in args.shifts for seed in args.seeds}
    print("\n| shift | seed | success by iteration | PPO steps |\n|---|---|---|---|")
    for (shift, seed), iterations in runs.items():
        successes = " → ".join(f"{100 * i['target_success']:.0f} %" for i in iterations)
        steps = sum(i["train_steps"] for i in iterations)
        print(f"| {100 * shift:.0f} cm | {seed} | {successes} | {steps:,} |")
    print("\n| shift | iterations allowed | before ≤ 5 % | after ≥ 95 % | median iterations needed |")
    print("|---|---|---|---|---|")
    for shift in args.shifts:
        cures = [[i["target_success"] for i in runs[shift, seed]] for seed in args.seeds]
        before = sum(c[0] <= 0.05 for c in cures)
        needed = [len(c) - 1 if c[-1] >= CURED else np.inf for c in cures]
        after, n = np.isfinite(needed).sum(), len(cures)
        row = (f"{100 * shift:.0f} cm", ALLOWED.get(shift, 3), f"{before} of {n}", f"{after} of {n}", np.median(needed))
        print("| " + " | ".join(map(str, row)) + " |")


if __name__ == "__main__":
    main(tyro.cli(Args))
