"""Samples per second of Stable-Baselines3's PPO over the native vector environment, and over its own SubprocVecEnv.

    python benchmarks/sb3_throughput.py

Both run the whole loop, rollouts and updates, on the same task with the same numbers and take turns, so that a busy
machine slows both. SubprocVecEnv is given the number of processes that suits it best of those tried.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import gymnasium as gym
import numpy as np
import tyro
from gymnasium.vector import AutoresetMode
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

import simopt_envs  # noqa: F401 - registers the environments
from baselines.ppo_sb3 import PPO_DEFAULTS
from baselines.ppo_torch import one_torch_thread
from baselines.sb3_vec_env import SB3VecEnv

BATCH = 6400


@dataclass(frozen=True)
class Args:
    """What to measure."""

    env_id: str = "SimOpt/Drawer-v0"
    """A task of this package."""
    native_envs: int = 128
    """Worlds of the native vector environment."""
    subprocess_envs: tuple[int, ...] = (os.cpu_count() or 1, 2 * (os.cpu_count() or 1), 4 * (os.cpu_count() or 1))
    """Processes of SubprocVecEnv, tried one after another."""
    iterations: int = 3
    """Of PPO, 6400 samples each, in one turn."""
    turns: int = 3
    """Of each contender; the median counts."""


def native(args: Args) -> VecEnv:
    mode = AutoresetMode.SAME_STEP
    return SB3VecEnv(gym.make_vec(args.env_id, args.native_envs, "vector_entry_point", autoreset_mode=mode))


def subprocesses(args: Args, num_envs: int) -> VecEnv:
    return SubprocVecEnv([partial(make_env, args.env_id)] * num_envs)


def make_env(env_id: str) -> gym.Env:
    return gym.make(f"simopt_envs:{env_id}")  # imports the package: it runs in a process of its own


def samples_per_second(make: Callable[[], VecEnv], iterations: int) -> float:
    """Of the whole loop; making the worlds and a first iteration are not counted."""
    env = make()
    settings = {**PPO_DEFAULTS, "n_steps": BATCH // env.num_envs, "target_kl": None, "device": "cpu", "seed": 0}
    model = PPO("MlpPolicy", env, **settings)
    model.learn(BATCH)
    start, steps = time.perf_counter(), model.num_timesteps
    model.learn(iterations * BATCH, reset_num_timesteps=False)
    seconds = time.perf_counter() - start
    env.close()
    return (model.num_timesteps - steps) / seconds


def main(args: Args) -> None:
    contenders: dict[str, Callable[[], VecEnv]] = {f"native, {args.native_envs} worlds": partial(native, args)}
    for num_envs in args.subprocess_envs:
        contenders[f"SubprocVecEnv, {num_envs} processes"] = partial(subprocesses, args, num_envs)
    rates: dict[str, list[float]] = {name: [] for name in contenders}
    with one_torch_thread():
        for _ in range(args.turns):
            for name, make in contenders.items():
                rates[name].append(samples_per_second(make, args.iterations))
    medians = {name: float(np.median(measured)) for name, measured in rates.items()}
    first, *others = medians
    print(f"{args.env_id}: PPO of Stable-Baselines3, {os.cpu_count()} cores, median of {args.turns} turns\n")
    print("| worlds | samples/s | native is faster by |\n|---|---|---|")
    for name, rate in medians.items():
        print(f"| {name} | {rate:.0f} | {medians[first] / rate:.2f} |")
    print(f"\nnative ÷ best SubprocVecEnv: {medians[first] / max(medians[name] for name in others):.2f}")


if __name__ == "__main__":
    main(tyro.cli(Args))
