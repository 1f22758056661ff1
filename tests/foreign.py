"""What foreign environments the driver is tried on, what is hidden in them, and policies that show it."""

from dataclasses import dataclass
from functools import partial

import gymnasium as gym
import numpy as np

from simopt_envs.physics import Parameter, Write
from wrappers import AdaptableEnv


@dataclass(frozen=True)
class Scene:
    """An environment with one hidden quantity.

    Attributes:
        make_env: makes it.
        name: the hidden parameter.
        value: its true value.
        policy: what moves the robot.
        weights: of the observed channels in the discrepancy; None: all alike.
    """

    make_env: AdaptableEnv
    name: str
    value: float
    policy: object
    weights: tuple[float, ...] | None = None


class Lean:
    """Leans on the observed state through a fixed random matrix: any motion shows how heavy things are."""

    def __init__(self, observation_size, action_size):
        self.matrix = 0.3 * np.random.default_rng(0).standard_normal((observation_size, action_size))

    def act(self, observations):
        return np.clip(1.0 + observations @ self.matrix, -1.0, 1.0)


class Push:
    """Fetch: pushes the puck, which slides on."""

    def act(self, observations):
        actions = np.zeros((len(observations), 4))
        actions[:, :2] = np.clip(5 * (observations[:, 9:12] - observations[:, 6:9])[:, :2], -1, 1)
        return actions


class Reach:
    """robosuite's Panda: moves its gripper to the cube."""

    def act(self, observations):
        actions = np.zeros((len(observations), 7))
        actions[:, :3] = np.clip(5 * (observations[:, 25:28] - observations[:, 14:17]), -1, 1)
        return actions


def hopper() -> Scene:
    return Scene(AdaptableEnv("Hopper-v5", ["body_mass of torso"]), "body_mass of torso", 6.0, Lean(11, 3))


def fetch_slide() -> Scene:
    friction = Parameter(
        "puck_friction",
        "1",
        0.1,
        0.01,
        1.0,
        writes=tuple(Write("geom_friction", geom, (0,)) for geom in ("object0", "table0")),
        description="between puck and table; a contact takes the larger of the two",
    )
    make = partial(gym.make, "gymnasium_robotics:FetchSlide-v4", max_episode_steps=30)
    return Scene(AdaptableEnv(make, [friction]), "puck_friction", 0.3, Push(), (1.0,) * 3 + (0.0,) * 28)


def robosuite_lift() -> Scene:
    friction = Parameter(
        "joint_friction",
        "N m",
        0.1,
        0.01,
        10.0,
        writes=tuple(Write("dof_frictionloss", f"robot0_joint{i}") for i in range(1, 8)),
        description="of every joint of the arm",
    )
    make = partial(gym.make, "SimOpt/RobosuiteLift-v0", max_episode_steps=25)
    return Scene(AdaptableEnv(make, [friction]), "joint_friction", 1.0, Reach())
