"""Any MuJoCo environment made ready for the SimOpt loop."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import gymnasium as gym
from gymnasium import spaces
from gymnasium.wrappers import FlattenObservation

from simopt_envs.physics.parameters import Parameter
from wrappers.randomizable import RandomizablePhysics
from wrappers.start import StartFromObservation


@dataclass(frozen=True)
class AdaptableEnv:
    """A function that makes one environment whose physics and first state the loop can set.

    It runs in Gymnasium's own vector environments, and serves simulation and test target alike:

        make_env = AdaptableEnv("FetchPush-v4", ["body_mass of object0"])
        robot = HiddenSystem(make_env, {"body_mass of object0": 3.0})
        loop = SimOpt(EnvSimulator(make_env, "async"), distribution, trainer, robot)

    Attributes:
        env: a registered id, or a function that makes one environment (to run "async", one that can be pickled);
            dictionary observations are flattened.
        parameters: as of :class:`~wrappers.RandomizablePhysics`.
    """

    env: str | Callable[[], gym.Env]
    parameters: Sequence[str | Parameter]

    @property
    def __name__(self) -> str:
        """What checkpoints and results call it."""
        return self.env if isinstance(self.env, str) else getattr(self.env, "__name__", type(self.env).__name__)

    def __call__(self) -> gym.Env:
        """Make one."""
        env = gym.make(self.env) if isinstance(self.env, str) else self.env()
        if isinstance(env.observation_space, spaces.Dict):
            env = FlattenObservation(env)
        return StartFromObservation(RandomizablePhysics(env, self.parameters))
