"""The model and p(ξ) of a registered environment, as a gap search takes them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

from simopt_envs.adaptation.first import FIRST_STD, first_distribution
from simopt_envs.distributions import Gaussian
from simopt_envs.physics import Parameter, ParameterSpace
from simopt_envs.physics.spec_writer import write_spec

HOME = "home"
"""Keyframe of the model of an environment of this package where its joints are when an episode begins."""


def model_of(env_id: str) -> tuple[mujoco.MjSpec, Gaussian | None]:
    """The model of any environment; with it, of one of this package, the first p(ξ) of adapt.

    Raises:
        ValueError: where it runs no MJCF file that can be told.
    """
    env: Any = gym.make(env_id).unwrapped
    env.close()
    file = getattr(env, "fullpath", None)  # Gymnasium's name for it, and gymnasium-robotics'
    return environment(env_id) if file is None else (mujoco.MjSpec.from_file(file), None)


def environment(env_id: str, current: Gaussian | None = None) -> tuple[mujoco.MjSpec, Gaussian]:
    """The model of an environment of this package, and p(ξ) as plain parameters.

    Recordings hold what the drives were commanded, so that parameters of what the task makes of actions say nothing.

    Args:
        env_id: the environment.
        current: p(ξ), whose median the model then has; None for the first p(ξ) of adapt, around nominal.

    Raises:
        ValueError: for an environment without a task, or without a first p(ξ) where that is wanted.
    """
    env = gym.make(env_id)
    task: Any = getattr(env.unwrapped, "task", None)
    env.close()
    if not hasattr(task, "make_spec"):
        raise ValueError(f"{env_id} has no task with a model to repair; give its MJCF file")
    space: ParameterSpace = task.parameters
    if current is None and env_id not in FIRST_STD:
        raise ValueError(f"{env_id} has no first p(ξ); give p(ξ) of its plain parameters")
    prior = first_distribution(space, FIRST_STD[env_id]) if current is None else current
    mechanical = [p.name for p in prior.space if any(write.field != "numeric_data" for write in p.writes)]
    spec, plain = task.make_spec(), prior.marginal(mechanical)
    return spec, plain if current is None else _moved(spec, plain)


def _moved(spec: mujoco.MjSpec, prior: Gaussian) -> Gaussian:
    """Put the median of p(ξ) into a spec, in place; p(ξ) with parameters that count from there.

    Where joints that no column tells of start is estimated with the model as given: a drawer seen by its handle is not
    where it was if the cabinet is not.
    """
    median = np.clip(prior.median, prior.space.low, prior.space.high)
    write_spec(spec, spec.compile(), prior.space, median)

    def from_there(parameter: Parameter, value: float) -> Parameter:
        if any(write.operation == "add" for write in parameter.writes):
            return replace(parameter, nominal=0.0, low=parameter.low - value, high=parameter.high - value)
        return replace(parameter, nominal=value, baseline=None)

    space = ParameterSpace(map(from_there, prior.space, median.tolist()))
    return Gaussian(space, space.to_unconstrained(space.nominal), prior.covariance)
