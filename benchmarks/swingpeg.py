"""The swing-peg task in figures: it is learned, it needs a swing, it depends on the physics, and it is stable.

    python benchmarks/swingpeg.py [--policy policy.pt] [--out out/swingpeg]

* Training: PPO from scratch with modest randomization: steps, seconds. Skipped where ``--policy`` names a file.
* Slow replay: the joint trajectories of successful episodes, tracked by a stiff arm at the speed of the recording
  (control) and four times slower.
* Success curves: success at nominal physics but for one parameter, over that parameter's bounds.
* Stability: episodes of random actions under the initial distribution at three times its standard deviation.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import tyro
from gymnasium.vector import AutoresetMode, VectorEnv
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.interpolate import CubicSpline

import simopt_envs  # noqa: F401 - registers the environments
from baselines.commands.inputs import distribution
from baselines.ppo_torch import TorchPolicy, TorchPPO
from simopt_envs.distributions import Gaussian
from simopt_envs.physics import ParameterSpace
from simopt_envs.physics.simulation import SingleSimulation
from simopt_envs.report.figures import BLUE, GREY, save_figure, styled
from simopt_envs.tasks.arm import JOINTS
from simopt_envs.tasks.env import TaskEnv
from simopt_envs.tasks.swingpeg import make_env
from wrappers import DistributionVectorWrapper

Array = NDArray[np.float64]
ENV_ID = "SimOpt/SwingPeg-v0"
HORIZON = 50
COLUMNS = 6  # of panels in the figure


@dataclass
class Args:
    """What to measure."""

    policy: Path | None = None
    """A trained policy; without it one is trained."""
    out: Path = Path("out/swingpeg")
    """Holds the policy and the figures."""
    seed: int = 0
    """Of everything random."""
    values: int = 9
    """Values of each parameter in its success curve."""
    episodes: int = 32
    """Episodes for each value."""
    random_episodes: int = 10_000
    """Episodes of the stability run."""


def make_vector_env(num_envs: int, widening: float = 1.0) -> VectorEnv:
    """Worlds with a ξ drawn at every episode from the default p(ξ), its standard deviations times ``widening``."""
    env: Any = gym.make_vec(ENV_ID, num_envs=num_envs, autoreset_mode=AutoresetMode.SAME_STEP)
    p = distribution(ENV_ID, env.unwrapped.parameters, ())
    return DistributionVectorWrapper(env, Gaussian(p.space, p.mean, widening**2 * p.covariance))


def success(policy: TorchPolicy, parameters: Array, seed: int) -> NDArray[np.bool_]:
    """Whether an episode with each ξ (n, d) ends in success, (n,); one that diverges does not."""
    env = gym.make_vec(ENV_ID, num_envs=len(parameters), autoreset_mode=AutoresetMode.NEXT_STEP)
    observation, _ = env.reset(seed=seed, options={"parameters": parameters})
    diverged = np.zeros(len(parameters), dtype=bool)
    for _ in range(HORIZON):
        observation, *_, info = env.step(policy.act(observation))
        diverged |= info["diverged"]
    return info["is_success"] & ~diverged


def train(args: Args) -> tuple[TorchPolicy, dict[str, float]]:
    """A policy, and what it took."""
    wall, cpu = time.perf_counter(), time.process_time()
    trainer = TorchPPO(checkpoint=args.out / "policy.pt")
    policy = trainer(make_vector_env, None, np.random.default_rng(args.seed))
    seconds = {"wall_seconds": time.perf_counter() - wall, "cpu_seconds": time.process_time() - cpu}
    return policy, {"steps": policy.steps_trained, **seconds}


def joint_trajectories(policy: TorchPolicy, env: TaskEnv, episodes: int, seed: int) -> list[Array]:
    """Joint positions at every control step of the successful ones of some episodes, each (HORIZON + 1, 7)."""
    successful = []
    for episode in range(episodes):
        observation, _ = env.reset(seed=seed + episode)
        joints = [observation[: len(JOINTS)]]
        for _ in range(HORIZON):
            observation, *_, info = env.step(policy.act(observation[None])[0])
            joints.append(observation[: len(JOINTS)])
        if info["is_success"]:
            successful.append(np.array(joints))
    return successful


def replayed(env: TaskEnv, joints: Array, slowdown: float) -> bool:
    """Whether a joint trajectory, passed ``slowdown`` times slower, ends in success.

    The arm tracks it with servos 25 times as stiff as its own, without delay, and fed the joints' velocities.
    """
    model = env.task.make_model(visual=False)
    servos = [model.actuator(name).id for name in JOINTS]
    model.actuator_gainprm[servos, 0] *= 25.0
    model.actuator_biasprm[servos, 1] *= 25.0
    model.actuator_forcelimited[servos] = 0
    model.actuator_ctrllimited[servos] = 0
    model.actuator_delay[servos] = 0.0
    lag = model.dof_damping[: len(JOINTS)] / model.actuator_gainprm[servos, 0]
    path = CubicSpline(np.arange(len(joints)) * env.dt * slowdown, joints, bc_type="clamped")
    simulation = SingleSimulation(model, env.parameters)
    qpos = env.task.qpos_from_observation(joints[0])
    simulation.reset(np.zeros(1, dtype=np.intp), qpos[None], np.zeros((1, model.nv)), env.task.hold(qpos[None]))
    while simulation.mj_data.time < path.x[-1]:
        ctrl = path(simulation.mj_data.time) + lag * path(simulation.mj_data.time, 1)
        simulation.step(ctrl[None], 1)
    return bool(env.task.evaluate(simulation, np.zeros((1, len(JOINTS)))).success[0])


def success_curves(policy: TorchPolicy, env: TaskEnv, args: Args) -> dict[str, tuple[Array, Array]]:
    """Parameter -> (values over its bounds, success at each)."""
    space = env.parameters
    curves = {}
    for i, name in track(list(enumerate(space.names)), description="success curves"):
        low, nominal, high = (space.to_unconstrained(x)[i] for x in (space.low, space.nominal, space.high))
        below, above = np.linspace(low, nominal, args.values // 2 + 1), np.linspace(nominal, high, args.values // 2 + 1)
        coordinates = np.tile(space.to_unconstrained(space.nominal), (2 * len(below) - 1, 1))
        coordinates[:, i] = [*below, *above[1:]]
        xi = np.clip(space.from_unconstrained(coordinates), space.low, space.high)
        succeeded = success(policy, np.repeat(xi, args.episodes, axis=0), args.seed)
        curves[name] = (xi[:, i], succeeded.reshape(len(xi), -1).mean(axis=1))
    return curves


@styled
def curves_figure(curves: Mapping[str, tuple[Array, Array]], space: ParameterSpace) -> Figure:
    """A panel for each parameter: success over its bounds, a line at its nominal value."""
    rows = -(-len(curves) // COLUMNS)
    figure = Figure(figsize=(11.0, 1.7 * rows), layout="constrained")
    panels = figure.subplots(rows, COLUMNS, sharey=True, squeeze=False).flat
    for (name, (values, rates)), axis in zip(curves.items(), panels, strict=False):
        parameter = space[name]
        axis.axvline(parameter.nominal, color=GREY, linewidth=0.8, linestyle=":")
        axis.plot(values, rates, color=BLUE, marker=".")
        axis.set_title(name if parameter.unit == "1" else f"{name}\n[{parameter.unit}]", size=8)
        axis.set_xscale(parameter.coordinate)
        axis.set_xticks(values[[0, -1]], [f"{value:.3g}" for value in values[[0, -1]]])
        axis.minorticks_off()
        axis.yaxis.set_major_formatter(PercentFormatter(1.0))
    for axis in panels:
        axis.set_axis_off()
    return figure


def diverged_episodes(args: Args, num_envs: int = 500) -> int:
    """How many of the episodes of random actions diverge."""
    env: Any = make_vector_env(num_envs, widening=3.0)
    env.reset(seed=args.seed)
    rng = np.random.default_rng(args.seed)
    for _ in track(range(args.random_episodes // num_envs * HORIZON), description="random actions"):
        env.step(rng.uniform(-1.0, 1.0, env.action_space.shape))
    return int(env.unwrapped.diverged_count)


def main(args: Args) -> None:
    """Measure everything, print it, write ``figures.json`` and a picture of the success curves."""
    console = Console()
    args.out.mkdir(parents=True, exist_ok=True)
    figures: dict[str, object] = {}
    if args.policy is None:
        policy, figures["training"] = train(args)
    else:
        policy = TorchPPO().load(args.policy)
    env = make_env()
    nominal = np.tile(env.parameters.nominal, (200, 1))
    figures["success_at_nominal"] = float(success(policy, nominal, args.seed + 1).mean())

    trajectories = joint_trajectories(policy, env, 40, args.seed + 1000)
    figures["replays"] = len(trajectories)
    for slowdown in (1.0, 2.0, 4.0):
        figures[f"success_{slowdown:g}x_slower"] = float(np.mean([replayed(env, t, slowdown) for t in trajectories]))
    figures["random_episodes"] = args.random_episodes
    figures["diverged"] = diverged_episodes(args)
    console.print(figures)

    curves = success_curves(policy, env, args)
    figures["curves"] = {name: {"value": v.tolist(), "success": s.tolist()} for name, (v, s) in curves.items()}
    table = Table("parameter", "success over its bounds, low to high", "best", "worst", title="Success curves")
    for name, (_, rates) in curves.items():
        table.add_row(name, " ".join(f"{100 * r:3.0f}" for r in rates), f"{rates.max():.0%}", f"{rates.min():.0%}")
    console.print(table)
    decisive = [name for name, (_, rates) in curves.items() if rates.max() >= 0.9 and rates.min() <= 0.5]
    console.print(f"{len(decisive)} parameters take success from 90 % or more to 50 % or less: {', '.join(decisive)}")
    save_figure(curves_figure({n: curves[n] for n in decisive}, env.parameters), args.out / "success_curves.png")
    (args.out / "figures.json").write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(tyro.cli(Args))
