"""PPO from scratch on the drawer: steps and seconds to a policy, and how often it succeeds.

    python benchmarks/ppo.py [--seeds 0 1 2]

The cabinet's place varies by σ 2 cm, the drawer's physics with it. Success is that of the policy without exploration
noise over 200 episodes drawn likewise.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial

import numpy as np
import tyro

import simopt_envs  # noqa: F401 - registers the environments
from baselines.commands.inputs import distribution
from baselines.ppo_torch import TorchPPO
from simopt_envs.adaptation import EnvSimulator


@dataclass
class Args:
    """What to train."""

    env_id: str = "SimOpt/Drawer-v0"
    """An environment with a default distribution."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """One training each."""


def main(args: Args) -> None:
    simulator = EnvSimulator(args.env_id)
    p = distribution(args.env_id, simulator.parameters, ())
    print("| seed | steps | wall s | CPU s | success |\n|---|---|---|---|---|")
    for seed in args.seeds:
        wall, cpu = time.perf_counter(), time.process_time()
        worlds_of = partial(simulator.make_vector_env, distribution=p, seed=seed)
        policy = TorchPPO()(worlds_of, None, np.random.default_rng(seed))
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        worlds = simulator.make_vector_env(200, p, 1000 + seed)
        observation, _ = worlds.reset(seed=1000 + seed)
        for _ in range(50):
            observation, *_, info = worlds.step(policy.act(observation))
        success = np.mean(info["final_info"]["is_success"])
        print(f"| {seed} | {policy.steps_trained:,} | {wall:.0f} | {cpu:.0f} | {100 * success:.0f} % |", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Args))
