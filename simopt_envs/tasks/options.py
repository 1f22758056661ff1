"""Reading the ``options`` of a task's ``reset``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from simopt_envs.physics.parameters import Array, ParameterSpace, unknown_name
from simopt_envs.tasks.task import Task

OPTIONS = ("parameters", "initial_observation")


def episode_parameters(space: ParameterSpace, options: dict[str, Any] | None, num_worlds: int | None = None) -> Array:
    """ξ from ``options["parameters"]``, validated; nominal where nothing is said.

    Args:
        space: the task's parameters.
        options: what ``reset`` was given.
        num_worlds: None for one world, (d,); else (n, d), from numbers, one per world, or an (n, d) array.

    Raises:
        ValueError: for an option or a parameter that does not exist, or values that are not valid.
    """
    for name in options or {}:
        if name not in OPTIONS:
            raise ValueError(unknown_name("reset option", name, OPTIONS))
    given = (options or {}).get("parameters")
    if given is None:
        given = {}
    if isinstance(given, Mapping):
        return space.values(given, num_worlds)
    if num_worlds is None:
        raise ValueError(f"options['parameters'] must be a mapping of name to value, got {type(given).__name__}")
    xi = space.validate(given)
    if xi.shape != (num_worlds, len(space)):
        raise ValueError(f"options['parameters'] must have shape {(num_worlds, len(space))}, got {xi.shape}")
    return xi


def start_qpos(task: Task, options: dict[str, Any] | None, drawn: Array) -> Array:
    """The start posture: the one drawn, or the one that ``options["initial_observation"]`` (o,) shows."""
    observation = (options or {}).get("initial_observation")
    if observation is None:
        return drawn
    observation = np.asarray(observation, dtype=np.float64)
    if observation.shape != task.observation_space.shape or not np.isfinite(observation).all():
        raise ValueError(
            f"options['initial_observation'] must be finite and of shape {task.observation_space.shape} per world, "
            f"got {observation}"
        )
    return task.qpos_from_observation(observation)
