"""The Gymnasium environment of a task: one world, any MuJoCo."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from simopt_envs.physics.parameters import Array, ParameterSpace
from simopt_envs.physics.simulation import SingleSimulation
from simopt_envs.tasks.options import episode_parameters, start_qpos
from simopt_envs.tasks.task import Task

_FIRST_WORLD = np.zeros(1, dtype=np.intp)


class TaskEnv(gym.Env[Array, Array]):
    """One world of a task.

    ``reset(options={"parameters": {name: value}})`` sets ξ for that episode, the rest nominal, and
    ``options={"initial_observation": (o,)}`` starts from the state a measured episode started from.
    ``info["parameters"]`` of reset says what is in force, ``info["is_success"]`` of every step whether the task is
    solved.

    Args:
        task: the task.
        render_mode: None, "rgb_array" or "human".

    Raises:
        ValueError: by ``reset``, for an option or parameter it does not know or cannot take.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 1}  # noqa: RUF012 - Gymnasium's own attribute

    def __init__(self, task: Task, render_mode: str | None = None):
        self.task = task
        self.simulation = SingleSimulation(task.make_model(), task.parameters)
        self.parameters: ParameterSpace = task.parameters
        self.observation_space, self.action_space = task.observation_space, task.action_space
        self.observation_names = task.observation_names
        self.discrepancy_weights = task.discrepancy_weights
        self.metadata = self.metadata | {"render_fps": round(1 / self.dt)}
        self.render_mode = render_mode
        self._renderer: Any = None

    @property
    def model(self) -> Any:
        """The ``mujoco.MjModel``, holding the ξ of this episode."""
        return self.simulation.model

    @property
    def data(self) -> Any:
        """The ``mujoco.MjData``."""
        return self.simulation.mj_data

    @property
    def dt(self) -> float:
        """Seconds between two actions."""
        return float(self.simulation.model.opt.timestep * self.task.substeps)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Begin an episode; see the class for the options."""
        xi = episode_parameters(self.parameters, options)
        super().reset(seed=seed)
        drawn = self.task.initial_qpos(self.np_random)
        qpos = start_qpos(self.task, options, drawn)
        self.simulation.write(_FIRST_WORLD, xi[None])
        self.simulation.reset(_FIRST_WORLD, qpos[None], np.zeros((1, self.model.nv)), self.task.hold(qpos[None]))
        if self.render_mode == "human":
            self.render()
        return self.task.observe(self.simulation)[0], {"parameters": self.parameters.as_dict(xi)}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Advance by ``dt``. A world that diverged is truncated, with ``info["diverged"]`` True."""
        actions = np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0)[None]
        diverged = self.simulation.step(self.task.control(self.simulation, actions), self.task.substeps)
        outcome = self.task.evaluate(self.simulation, actions)
        if self.render_mode == "human":
            self.render()
        info: dict[str, Any] = {"is_success": bool(outcome.success[0]), "diverged": bool(diverged[0])}
        info["reward_terms"] = {name: float(term[0]) for name, term in outcome.terms.items()}
        return self.task.observe(self.simulation)[0], float(outcome.reward[0]), False, bool(diverged[0]), info

    def render(self) -> Any:
        """An image (height, width, 3) for "rgb_array"; a window for "human". RuntimeError where OpenGL is missing."""
        if self.render_mode is None:
            return None
        if self._renderer is None:
            from simopt_envs.tasks.rendering import make_renderer

            self._renderer = make_renderer(self.model, self.data, self.task.camera, self.render_mode)
        return self._renderer.render(self.render_mode)

    def close(self) -> None:
        """Close the renderer, if there is one."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
