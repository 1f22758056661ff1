"""How far one machine's cores, a cluster's or a GPU carry the simulated rollouts of an update, and a gap search.

    python benchmarks/scaling.py ray                          # 9600 rollouts by Ray against the default, same cores
    python benchmarks/scaling.py gap --model MODEL --data RECORDINGS...  # a search by threads and Ray, same cores
    python benchmarks/scaling.py warp --device cuda:0         # control steps/s, drawer and swing-peg, a ξ per world
    python benchmarks/scaling.py iteration --device cuda:0    # a SimOpt iteration, 9600 worlds at once

docs/scaling.md says what the figures mean.
"""

from __future__ import annotations

import os
import pickle
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import gymnasium as gym
import numpy as np
import torch
import tyro

import simopt_envs  # noqa: F401 - registers the environments
from baselines.commands.inputs import distribution
from baselines.ppo_torch import PPOConfig, TorchPolicy, TorchPPO
from simopt_envs.adaptation import REPS, Discrepancy, EnvSimulator, HiddenSystem, Rollouts, SimOpt
from simopt_envs.engine import Engine, LocalEngine, RayEngine, ThreadEngine
from simopt_envs.gap import find_gap

DRAWER, SWING_PEG = "SimOpt/Drawer-v0", "SimOpt/SwingPeg-v0"
HIDDEN = {"cabinet_x": 0.15}
REAL = 3  # measured episodes, each repeated by every ξ
STEPS = 50
PAPER_MINUTES = {DRAWER: 22, SWING_PEG: 7}  # of an iteration on 64 V100 GPUs with 150 agents each


class Mortal:
    """A policy that kills the first worker it comes to act in."""

    def __init__(self, policy: TorchPolicy, marker: Path):
        self.policy, self.marker = policy, marker

    def act(self, observations: np.ndarray) -> np.ndarray:
        """As the policy, if still alive."""
        if not self.marker.exists():
            self.marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return self.policy.act(observations)


@dataclass
class Ray:
    """Rollouts by Ray on this machine, against the default on the same cores; and with a worker killed."""

    rollouts: int = 9600
    """Of one update."""
    workers: int = os.cpu_count() or 1
    """As many as the default has threads."""
    repetitions: int = 3
    """Of each measurement, taken in turn; the best counts, as what else runs can only slow it down."""

    def run(self) -> None:
        """Measure and print."""
        import ray

        ray.init(num_cpus=self.workers, include_dashboard=False, log_to_driver=False)
        policy = _policy()
        measured = HiddenSystem(DRAWER, HIDDEN).rollout(policy, REAL, np.random.default_rng(0))
        simulators = {"default": _simulator(LocalEngine()), "Ray": _simulator(RayEngine())}
        p = distribution(DRAWER, simulators["default"].parameters, ())
        xi = p.sample(self.rollouts // REAL, np.random.default_rng(0))
        seconds, results = dict.fromkeys(simulators, np.inf), {}
        for _ in range(self.repetitions):
            for name, simulator in simulators.items():
                start = time.perf_counter()
                results[name] = simulator.rollout(policy, p.space, xi, measured, 0)
                seconds[name] = min(seconds[name], time.perf_counter() - start)
        n = len(xi) * REAL
        print(f"{DRAWER}, {n} rollouts, {self.workers} cores\n\n| | seconds | rollouts/s |\n|---|---|---|")
        for name, best in seconds.items():
            print(f"| {name} | {best:.1f} | {n / best:.0f} |")
        print(f"\nRay ÷ default: {seconds['default'] / seconds['Ray']:.2f}")
        print(f"same bit by bit: {_same(*results.values())}")
        with TemporaryDirectory() as folder:
            mortal, marker = Mortal(policy, Path(folder) / "killed"), Path(folder) / "killed"
            killed = _simulator(RayEngine()).rollout(mortal, p.space, xi, measured, 0)
            print(f"one worker killed ({marker.exists()}), same bit by bit: {_same(results['default'], killed)}")

        rollouts = results["default"]
        cost = Discrepancy().for_channels(simulators["Ray"].observation_names, simulators["Ray"].discrepancy_weights)
        received = pickle.dumps(rollouts, protocol=5)
        serial = {
            "take in the results": _timed(lambda: Rollouts.concatenate([pickle.loads(received)])),
            "discrepancy": _timed(lambda: cost(rollouts, measured)),
            "REPS step": _timed(lambda: REPS()(p, xi, cost(rollouts, measured), np.random.default_rng(0))),
        }
        print(f"\nbytes per rollout: {xi[0].nbytes + 88} to a worker, {len(received) / n:.0f} back;", end=" ")
        print(f"{len(pickle.dumps(policy))} for the policy, once per worker")
        print("the driver's own: " + ", ".join(f"{what} {1e3 * best:.0f} ms" for what, best in serial.items()))


@dataclass
class Gap:
    """A gap search by threads, the default, and by Ray, against one candidate after the other on the same cores."""

    model: Path
    """MJCF."""
    data: tuple[Path, ...]
    """Recordings, two at least."""

    def run(self) -> None:
        """Measure and print."""
        seconds, found = {}, []
        for engine in (LocalEngine(), ThreadEngine(), RayEngine()):
            gap = find_gap(self.model, self.data, engine=engine)
            seconds[type(engine).__name__] = gap.seconds
            found.append(gap.to_dict() | {"seconds": 0.0})
        print(f"{gap}\n{os.cpu_count()} cores\n\n| | seconds | ÷ one after the other |\n|---|---|---|")
        for name, taken in seconds.items():
            print(f"| {name} | {taken:.1f} | {taken / seconds['LocalEngine']:.2f} |")
        print(f"\nsame bit by bit: {all(one == found[0] for one in found)}")


@dataclass
class Warp:
    """Control steps per second with a ξ per world, whole episodes with their resets, policy excluded."""

    worlds: tuple[int, ...] = (8192, 16384)
    """Worlds at once."""
    device: str = "cuda:0"
    """Warp's device; cpu works, slowly."""
    cpu_worlds: int = 256
    """Of the CPU's own vector environment, on all cores."""
    episodes: int = 2
    """Timed, after one that compiles the kernels."""

    def run(self) -> None:
        """Measure and print."""
        cores = len(os.sched_getaffinity(0))  # that this process may use, which MuJoCo's own default does not ask
        print(f"{cores} CPU cores, Warp on {self.device}\n")
        print("| | worlds | control steps/s | ÷ CPU | begin an episode [s] | diverged |\n|---|---|---|---|---|---|")
        for env_id in (DRAWER, SWING_PEG):
            cpu = self._rate(env_id, self.cpu_worlds, {"num_threads": cores}, None, "CPU")
            for worlds in self.worlds:
                self._rate(env_id, worlds, {"backend": "warp", "device": self.device}, cpu, self.device)

    def _rate(self, env_id: str, worlds: int, options: dict[str, Any], cpu: float | None, name: str) -> float:
        simulator = EnvSimulator(env_id, **options)
        p = distribution(env_id, simulator.parameters, ())
        env = simulator.make_vector_env(worlds, p, seed=0)
        observation, _ = env.reset(seed=0)
        action: Any = np.random.default_rng(0).uniform(-0.5, 0.5, env.action_space.shape).astype(np.float32)
        if isinstance(observation, torch.Tensor):
            action = torch.as_tensor(action, device=observation.device)
        begin = _timed(lambda: env.reset(), 2)
        rates = []
        for _ in range(self.episodes + 1):
            start = time.perf_counter()
            for _ in range(STEPS):
                _, reward, *_ = env.step(action)
            float(reward.sum())  # waits for the device
            rates.append(worlds * STEPS / (time.perf_counter() - start))
        rate = max(rates[1:])
        ratio = "1" if cpu is None else f"{rate / cpu:.2f}"
        diverged = env.unwrapped.diverged_count  # type: ignore[attr-defined]
        print(f"| {env_id} {name} | {worlds} | {rate:,.0f} | {ratio} | {begin:.2f} | {diverged} |", flush=True)
        env.close()
        return rate


@dataclass
class Iteration:
    """One iteration of the loop on one device: three updates of 9600 rollouts each, then further training."""

    env_id: str = DRAWER
    """The task."""
    device: str = "cuda:0"
    """Warp's device."""
    rollouts: int = 9600
    """Of one update, all at once."""
    worlds: int = 8192
    """That PPO trains in."""
    iterations: int = 60
    """Of PPO's first training; a further one may take half as many."""

    def run(self) -> None:
        """Measure and print."""
        simulator = EnvSimulator(self.env_id, num_envs=self.rollouts, backend="warp", device=self.device)
        config = replace(
            PPOConfig(), num_envs=self.worlds, iterations=self.iterations, warm_start_iterations=self.iterations // 2
        )
        begun: dict[tuple[int, str], float] = {}

        def show(event: Any) -> None:
            now = time.perf_counter()
            if event.status == "started":
                begun[event.iteration, event.phase] = now
            else:
                seconds = now - begun[event.iteration, event.phase]
                print(f"iteration {event.iteration}, {event.phase}: {seconds:.1f} s", flush=True)

        loop = SimOpt(
            simulator,
            distribution(self.env_id, simulator.parameters, ()),
            TorchPPO(config),
            HiddenSystem(self.env_id, HIDDEN if self.env_id == DRAWER else {"hole_x": 0.05}, noise=0.002),
            simulated_rollouts=self.rollouts,
            real_rollouts=REAL,
            on_event=show,
        )
        start = last = time.perf_counter()
        for step in loop.run(1):
            last, start = time.perf_counter(), last
            print(f"iteration {step.index}: {last - start:.0f} s, success on the target {step.target_success:.0%}")
        print(f"the paper's, on 64 GPUs with 150 agents each: {PAPER_MINUTES[self.env_id]} min")


def _policy() -> TorchPolicy:
    """An untrained one, as costly to run as a trained one."""
    space: Any = gym.make(DRAWER).action_space
    generator = torch.Generator().manual_seed(0)
    return TorchPolicy(10, space.low.tolist(), space.high.tolist(), PPOConfig().hidden, 0.0, generator)


def _simulator(engine: Engine) -> EnvSimulator:
    return EnvSimulator(DRAWER, engine=engine)


def _timed(function: Callable[[], object], repetitions: int = 3) -> float:
    """Seconds, the best of some."""
    seconds = []
    for _ in range(repetitions):
        start = time.perf_counter()
        function()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def _same(a: Rollouts, b: Rollouts) -> bool:
    return all(
        np.array_equal(getattr(a, field), getattr(b, field), equal_nan=field in ("observations", "actions"))
        for field in ("observations", "actions", "lengths", "diverged", "success")
    )


if __name__ == "__main__":
    tyro.cli(Ray | Gap | Warp | Iteration).run()
