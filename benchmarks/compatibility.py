"""Which environments work with which parts of this package: really run, for a few seconds each.

    python benchmarks/compatibility.py

Writes docs/compatibility.md. As no single set of packages holds all environments (see the README), run it once in each
of the two: a run replaces its own section and leaves the other as it is.
"""

from __future__ import annotations

import re
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

import gymnasium as gym
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table
from stable_baselines3 import PPO

import simopt_envs  # noqa: F401 - registers the environments
from baselines.ppo_sb3 import SB3
from baselines.ppo_torch import PPOConfig, TorchPPO
from simopt_envs.adaptation import EnvSimulator, HiddenSystem, SimOpt, Trainer
from simopt_envs.distributions import Gaussian
from wrappers import AdaptableEnv, DistributionWrapper

STEPS, WORLDS = 16, 2
TORCH_PPO = TorchPPO(PPOConfig(num_envs=WORLDS, num_steps=STEPS, iterations=1, warm_start_iterations=1, minibatches=2))
SB3_PPO = SB3(PPO, total_timesteps=STEPS * WORLDS, num_envs=WORLDS, n_steps=STEPS, batch_size=STEPS, n_epochs=1)
PACKAGES = ("mujoco", "gymnasium", "gymnasium-robotics", "robosuite", "stable-baselines3", "torch")


@dataclass(frozen=True)
class Case:
    """An environment, and what is random in it.

    Attributes:
        env_id: its id.
        parameter: ξ.
        package: the package it needs.
    """

    env_id: str
    parameter: str
    package: str = "gymnasium"

    def make_env(self) -> str | Callable[[], gym.Env]:
        """What the loop takes: our own by id, others made ready, with episodes of a few steps."""
        if self.package == "simopt_envs":
            return self.env_id
        prefix = "gymnasium_robotics:" if self.package == "gymnasium_robotics" else ""
        return AdaptableEnv(partial(gym.make, prefix + self.env_id, max_episode_steps=STEPS), [self.parameter])


CASES = (
    Case("SimOpt/Drawer-v0", "drawer_damping", "simopt_envs"),
    Case("SimOpt/SwingPeg-v0", "peg_mass", "simopt_envs"),
    Case("Hopper-v5", "body_mass of torso"),
    Case("HalfCheetah-v5", "geom_friction of ffoot"),
    Case("Ant-v5", "dof_armature of hip_1"),
    Case("InvertedPendulum-v5", "actuator_gain of slide"),
    Case("Pusher-v5", "body_mass of object"),
    Case("FetchPush-v4", "body_mass of object0", "gymnasium_robotics"),
    Case("FetchSlide-v4", "dof_damping of object0:joint", "gymnasium_robotics"),
    Case("SimOpt/RobosuiteLift-v0", "body_mass of cube_main", "robosuite"),
    Case("SimOpt/RobosuiteDoor-v0", "dof_damping of Door_hinge", "robosuite"),
)


def wrapper(case: Case) -> None:
    """Each episode has another ξ, tells it, and a seed brings the same ones back."""
    make_env = case.make_env()
    env = gym.make(make_env) if isinstance(make_env, str) else make_env()
    space = env.get_wrapper_attr("parameters").subset([case.parameter])
    env = DistributionWrapper(env, Gaussian.around_nominal(space, 0.2))

    def drawn() -> list[float]:
        values = [env.reset(seed=3)[1]["parameters"][case.parameter]]
        for _ in range(2):
            observation, *_ = env.step(env.action_space.sample())
            assert np.isfinite(observation).all()
            values.append(env.reset()[1]["parameters"][case.parameter])
        return values

    first = drawn()
    assert len(set(first)) == len(first)
    assert drawn() == first
    env.close()


def trainer(train: Trainer, case: Case) -> None:
    """A short training over worlds with random ξ, and its policy acts."""
    simulator, distribution = prepared(case)
    make_vector_env = partial(simulator.make_vector_env, distribution=distribution, seed=0)
    policy = train(make_vector_env, None, np.random.default_rng(0))
    actions = policy.act(np.zeros((3, len(simulator.observation_names))))
    assert len(actions) == 3
    assert np.isfinite(actions).all()


def driver(case: Case) -> None:
    """One iteration of SimOpt against a hidden ξ."""
    simulator, distribution = prepared(case)
    robot = HiddenSystem(case.make_env(), {case.parameter: float(1.3 * distribution.space.nominal[0])})
    loop = SimOpt(
        simulator,
        distribution,
        TORCH_PPO,
        robot,
        simulated_rollouts=6,
        real_rollouts=1,
        updates_per_iteration=1,
        evaluation_episodes=0,
    )
    *_, last = loop.run(1)
    simulator.close()
    assert np.isfinite(last.distribution.mean).all()
    assert np.isfinite(last.costs).all()


def prepared(case: Case) -> tuple[EnvSimulator, Gaussian]:
    simulator = EnvSimulator(case.make_env(), num_envs=WORLDS)
    return simulator, Gaussian.around_nominal(simulator.parameters.subset([case.parameter]), 0.2)


COLUMNS: dict[str, Callable[[Case], None]] = {
    "wrapper": wrapper,
    "SB3 PPO": partial(trainer, SB3_PPO),
    "torch PPO": partial(trainer, TORCH_PPO),
    "driver": driver,
}


def outcome(check: Callable[[Case], None], case: Case) -> str:
    """Whether a check passes, and if not, the kind of error."""
    try:
        check(case)
    except Exception as error:
        traceback.print_exc()
        return f"fail: {type(error).__name__}"
    return "pass"


def installed() -> str:
    """The packages that matter and their versions."""
    found = []
    for package in PACKAGES:
        try:
            found.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            continue
    return ", ".join(found)


def replace_section(text: str, title: str, section: str) -> str:
    """The text with its section under the title "## ..." replaced, or with one more at its end."""
    pattern = re.compile(rf"## {re.escape(title)}\n.*?(?=\n## |\Z)", re.DOTALL)
    section = f"## {title}\n\n{section.rstrip()}\n"
    return pattern.sub(lambda _: section, text) if pattern.search(text) else f"{text.rstrip()}\n\n{section}"


INTRODUCTION = """# Compatibility

Each cell was run by `python benchmarks/compatibility.py`, with ξ ~ p(ξ) over the parameter named:

* **wrapper**: `DistributionWrapper` draws another ξ each episode, tells it, and repeats the sequence for a seed.
* **SB3 PPO**, **torch PPO**: a short training over worlds of random ξ by `baselines.ppo_sb3`, `baselines.ppo_torch`.
* **driver**: one iteration of `SimOpt`, with training, against an environment whose ξ is hidden.
"""


@dataclass
class Args:
    """Where to write."""

    out: Path = Path(__file__).parent.parent / "docs" / "compatibility.md"
    """The page."""


def main(args: Args) -> int:
    """Run every environment that is installed; the number of failures."""
    console = Console()
    title = "Robotics environment" if find_spec("robosuite") else "Default environment"
    table = Table("environment", "ξ", *COLUMNS, "seconds", title=title)
    rows = [f"{installed()}\n", f"| environment | ξ | {' | '.join(COLUMNS)} |", "|---" * (2 + len(COLUMNS)) + "|"]
    failures = 0
    for case in CASES:
        if find_spec(case.package) is None or (case.package == "simopt_envs" and case.env_id not in gym.registry):
            continue
        start = time.perf_counter()
        outcomes = [outcome(check, case) for check in COLUMNS.values()]
        failures += sum(result != "pass" for result in outcomes)
        rows.append(f"| `{case.env_id}` | `{case.parameter}` | {' | '.join(outcomes)} |")
        table.add_row(case.env_id, case.parameter, *outcomes, f"{time.perf_counter() - start:.1f}")
    console.print(table)
    text = args.out.read_text() if args.out.exists() else INTRODUCTION
    args.out.write_text(replace_section(text, title, "\n".join(rows)))
    return failures


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args)) > 0)
