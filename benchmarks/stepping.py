"""How fast the native vector environment steps: against raw C stepping, and against one process per environment.

    python benchmarks/stepping.py [--env-id SimOpt/Drawer-v0]

All figures are ratios taken in one run. Two comparisons:

* MuJoCo steps per CPU-second of the vector environment, a ξ per world, over those of a loop around ``mj_step`` through
  the same worlds: same models, initial states and commands, and without MuJoCo's profiler, too. What is missing to 1
  is observation, reward and Python.
* Control steps per second over those of Gymnasium's AsyncVectorEnv and Stable-Baselines3's SubprocVecEnv, with the
  number of workers that suits them best.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from typing import Any, cast

import gymnasium as gym
import mujoco
import numpy as np
import tyro
from stable_baselines3.common.vec_env import SubprocVecEnv

import simopt_envs  # noqa: F401 - registers the environments
from simopt_envs.distributions import Gaussian
from simopt_envs.physics.profiler import PROFILER_RESTS
from wrappers import DistributionVectorWrapper

STEPS = 50


@dataclass
class Args:
    """What to measure."""

    env_id: str = "SimOpt/Drawer-v0"
    """A task of this package."""
    repetitions: int = 5
    """Of each measurement; the best counts, as what else runs can only slow it down."""


def randomized(env_id: str, num_envs: int) -> gym.vector.VectorEnv:
    env = gym.make_vec(env_id, num_envs=num_envs, autoreset_mode="Disabled")
    space = cast(Any, env.unwrapped).parameters
    varied = space.subset([p.name for p in space if p.coordinate == "log"])
    return DistributionVectorWrapper(env, Gaussian.around_nominal(varied, 0.1))


def batched_and_raw(env_id: str, num_envs: int) -> tuple[float, float]:
    """MuJoCo steps per CPU-second: of the vector environment, and of mj_step through the same worlds."""
    env = randomized(env_id, num_envs)
    env.reset(seed=0)
    inner = cast(Any, env.unwrapped)
    substeps, simulation = inner.task.substeps, inner.simulation
    worlds = [simulation.world(i) for i in range(num_envs)]
    actions = np.random.default_rng(0).uniform(-1, 1, (STEPS, *inner.action_space.shape))
    commands = []
    start = time.process_time()
    for action in actions:
        env.step(action)
    batched = time.process_time() - start
    env.reset(seed=0)
    for action in actions:
        env.step(action)
        commands.append(simulation.data("ctrl").copy())
    finals = [simulation.world(i)[1].qpos for i in range(num_envs)]

    start = time.process_time()
    for i, (model, data) in enumerate(worlds):
        for command in commands:
            data.ctrl[:] = command[i]
            with PROFILER_RESTS:
                mujoco.mj_step(model, data, substeps)
    raw = time.process_time() - start
    for (_, data), final in zip(worlds, finals, strict=True):
        np.testing.assert_allclose(data.qpos, final, atol=1e-9)  # the same worlds indeed
    total = num_envs * STEPS * substeps
    return total / batched, total / raw


def control_rate(env: Any, num_envs: int, action_shape: tuple[int, ...]) -> float:
    """Control steps per second of a vector environment."""
    action = np.random.default_rng(0).uniform(-1, 1, (num_envs, *action_shape)).astype(np.float32)
    env.reset()
    start = time.perf_counter()
    for _ in range(STEPS):
        env.step(action)
    return num_envs * STEPS / (time.perf_counter() - start)


def best(env: Any, num_envs: int, shape: tuple[int, ...], repetitions: int) -> float:
    rate = max(control_rate(env, num_envs, shape) for _ in range(repetitions))
    env.close()
    return rate


def main(args: Args) -> None:
    print(f"{args.env_id}, {os.cpu_count()} cores, mujoco {mujoco.__version__}\n")
    print("| worlds | vector env, MuJoCo steps / CPU-s | raw mj_step / CPU-s | ratio |\n|---|---|---|---|")
    for num_envs in (64, 128, 256):
        pairs = [batched_and_raw(args.env_id, num_envs) for _ in range(args.repetitions)]
        batched, raw = np.max(pairs, axis=0)
        print(f"| {num_envs} | {batched:,.0f} | {raw:,.0f} | {np.median([b / r for b, r in pairs]):.2f} |")

    shape = cast(gym.spaces.Box, gym.make(args.env_id).action_space).shape
    native = best(randomized_autoreset(args.env_id), 128, shape, args.repetitions)
    rows = [("native vector env", 128, native)]
    for workers in (2, 4, 8):
        makers = [lambda: gym.make(args.env_id)] * workers
        rows.append(
            ("AsyncVectorEnv", workers, best(gym.vector.AsyncVectorEnv(makers), workers, shape, args.repetitions))
        )
        rows.append(("SubprocVecEnv", workers, best(SubprocVecEnv(makers), workers, shape, args.repetitions)))
    print("\n| | worlds | control steps / s | native ÷ this |\n|---|---|---|---|")
    for name, count, rate in rows:
        print(f"| {name} | {count} | {rate:,.0f} | {native / rate:.1f} |")


def randomized_autoreset(env_id: str) -> gym.vector.VectorEnv:
    return gym.make_vec(env_id, num_envs=128)


if __name__ == "__main__":
    main(tyro.cli(Args))
