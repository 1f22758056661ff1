"""The environments of the experiments, by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from types import MappingProxyType
from typing import Any

import gymnasium as gym

import simopt_envs  # noqa: F401 - registers the environments
from baselines.commands import inputs
from simopt_envs.adaptation import EnvSimulator
from simopt_envs.adaptation.first import FIRST_STD
from simopt_envs.distributions import Gaussian
from wrappers import AdaptableEnv

DRAWER, PEG, PENDULUM = "SimOpt/Drawer-v0", "SimOpt/SwingPeg-v0", "InvertedPendulum-v5"
_BALANCED_STEPS = 100
_TINY = 1e-6


class Survival(gym.Wrapper):
    """Success is that the episode has not terminated, for tasks such as balancing."""

    def step(self, action: Any) -> Any:
        """As the environment's, with ``info["is_success"]``."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated, {**info, "is_success": not terminated}


def _pendulum() -> gym.Env:
    return Survival(gym.make(PENDULUM, max_episode_steps=_BALANCED_STEPS))


ENVIRONMENTS: Mapping[str, str | AdaptableEnv] = {
    DRAWER: DRAWER,
    PEG: PEG,
    PENDULUM: AdaptableEnv(_pendulum, ["actuator_gain of slide", "body_mass of *", "dof_damping of *"]),
}


@cache
def simulator(env: str) -> EnvSimulator:
    """The simulation of an environment."""
    return EnvSimulator(ENVIRONMENTS[env])


@dataclass(frozen=True)
class Randomization:
    """A Gaussian p(ξ) with independent parameters.

    Attributes:
        env: of which environment.
        std: name or pattern -> standard deviation, relative for logarithmic parameters; a later one counts.
        centre: name -> value, where the median is not nominal.
    """

    env: str
    std: Mapping[str, float]
    centre: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def default(cls, env: str, wider: Mapping[str, float] = MappingProxyType({})) -> Randomization:
        """What ``simopt-envs adapt`` starts with, some of it wider."""
        return cls(env, {**FIRST_STD[env], **wider})

    @classmethod
    def none(cls, env: str) -> Randomization:
        """As good as no randomization, at nominal."""
        return cls(env, {simulator(env).parameters.names[0]: _TINY})

    @classmethod
    def exactly(cls, env: str, values: Mapping[str, float]) -> Randomization:
        """As good as no randomization, at these values and else at nominal."""
        return cls(env, dict.fromkeys(values, _TINY), values)

    def gaussian(self) -> Gaussian:
        """The distribution.

        Raises:
            ValueError: for a name or pattern that the environment does not have.
        """
        space = simulator(self.env).parameters
        p = inputs.distribution(self.env, space, [f"{name}={std}" for name, std in self.std.items()])
        centre = p.space.to_unconstrained(p.space.values(self.centre))
        return Gaussian(p.space, centre, p.covariance)


def partway(env: str, hidden: Mapping[str, float], share: float) -> dict[str, float]:
    """Values that lie on the way from nominal to hidden ones, which they reach where the share is 1."""
    space = simulator(env).parameters.subset(list(hidden))
    nominal, far = (space.to_unconstrained(x) for x in (space.nominal, space.values(hidden)))
    return space.as_dict(space.from_unconstrained(nominal + share * (far - nominal)))
