"""One update of p(ξ) from 9600 simulated rollouts, the paper's number, and from fewer.

    python benchmarks/update.py --policy out/demo/checkpoints/000_train/policy

A policy trained at the nominal cabinet is measured three times on a system whose cabinet stands 15 cm off; p(ξ) is
then updated a few times on these same rollouts. Shows the seconds of an update and how far the mean of cabinet_x came,
by the number of simulated rollouts an update takes.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

import simopt_envs  # noqa: F401 - registers the environments
from baselines.commands.inputs import distribution
from baselines.ppo_torch import TorchPPO
from simopt_envs.adaptation import REPS, Discrepancy, HiddenSystem
from simopt_envs.adaptation.simulator import EnvSimulator

ENV_ID = "SimOpt/Drawer-v0"
SHIFT = 0.15


@dataclass
class Args:
    """What to measure."""

    policy: Path = Path("out/demo/checkpoints/000_train/policy")
    """A policy trained at the nominal cabinet: `make demo` leaves one there."""
    rollouts: tuple[int, ...] = (120, 240, 480, 960, 9600)
    """Simulated rollouts of an update."""
    updates: int = 4
    """On the same measured rollouts."""
    seeds: int = 3
    """Repetitions; the largest number is run once."""


def main(args: Args) -> None:
    simulator = EnvSimulator(ENV_ID)
    policy = TorchPPO().load(args.policy)
    measured = HiddenSystem(ENV_ID, parameters={"cabinet_x": SHIFT}, noise=0.002)
    cost = Discrepancy().for_channels(simulator.observation_names, simulator.discrepancy_weights)
    print(f"{ENV_ID}, cabinet off by {100 * SHIFT:.0f} cm, {args.updates} updates; median of the seeds\n")
    print("| rollouts an update | cabinet_x after each update [cm] | seconds an update |\n|---|---|---|")
    for number in args.rollouts:
        means, seconds = [], []
        for seed in range(1 if number == max(args.rollouts) else args.seeds):
            rng = np.random.default_rng(seed)
            p = distribution(ENV_ID, simulator.parameters, ())
            column = list(p.space.names).index("cabinet_x")
            real = measured.rollout(policy, 3, rng)
            std_floor = 0.5 * p.std  # what the loop keeps while it searches
            path = []
            for _ in range(args.updates):
                start = time.perf_counter()
                xi = p.sample(number // 3, rng)
                rollouts = simulator.rollout(policy, p.space, xi, real, int(rng.integers(2**31)))
                p = REPS()(p, xi, cost(rollouts, real), rng, std_floor).distribution
                seconds.append(time.perf_counter() - start)
                path.append(100 * p.mean[column])
            means.append(path)
        steps = " → ".join(f"{x:.1f}" for x in np.median(means, axis=0))
        print(f"| {number} | {steps} | {np.median(seconds):.1f} |", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Args))
