"""The Gymnasium environment of a task: one world, any MuJoCo."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import EzPickle

from simopt_envs.physics.parameters import Array, ParameterSpace, unknown_name
from simopt_envs.physics.simulation import SingleSimulation
from simopt_envs.tasks.options import episode_parameters, start_qpos
from simopt_envs.tasks.task import Task

_FIRST_WORLD = np.zeros(1, dtype=np.intp)


class TaskEnv(gym.Env[Array, Array], EzPickle):
    """One world of a task.

    ``reset(options={"parameters": {name: value}})`` sets ξ for that episode, the rest nominal, and
    ``options={"initial_observation": (o,)}`` starts from the state a measured episode started from.
    ``info["parameters"]`` of reset says what is in force, ``info["is_success"]`` of every step whether the task is
    solved.

    A copy, pickled or deep, is a new environment of the same task: it wants a ``reset`` before its first step.

    Args:
        task: the task.
        render_mode: None, "rgb_array" or "human".

    Raises:
        ValueError: for a render mode that there is not; by ``reset``, for an option or parameter it does not know or
            cannot take; by ``step``, for an action that is not finite.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 1}  # noqa: RUF012 - Gymnasium's own attribute

    def __init__(self, task: Task, render_mode: str | None = None):
        EzPickle.__init__(self, task, render_mode)
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(unknown_name("render mode", render_mode, self.metadata["render_modes"]))
        self.task = task
        self.simulation = SingleSimulation(task.make_model(), task.parameters)
        self.parameters: ParameterSpace = task.parameters
        self.observation_space, self.action_space = task.observation_space, task.action_space
        self.observation_names = task.observation_names
        self.discrepancy_weights = task.discrepancy_weights
        self.metadata = self.metadata | {"render_fps": round(1 / self.dt)}
        self.render_mode = render_mode
        self._renderer: Any = None
        self._observation = np.zeros(self.observation_space.shape)

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
        self._observation = self.task.observe(self.simulation)[0]
        return self._observation.copy(), {"parameters": self.parameters.as_dict(xi)}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Advance by ``dt``.

        A world that diverged is truncated, its observation the last valid one, its reward 0, ``info["diverged"]`` True.
        """
        action = np.asarray(action, dtype=np.float64)
        if not np.isfinite(action).all():
            raise ValueError(f"the action is not finite: {action}")
        actions = np.clip(action, -1.0, 1.0)[None]
        diverged = bool(self.simulation.step(self.task.control(self.simulation, actions), self.task.substeps)[0])
        outcome = self.task.evaluate(self.simulation, actions)
        if self.render_mode == "human":
            self.render()
        if not diverged:  # else the state is that of MuJoCo's own reset
            self._observation = self.task.observe(self.simulation)[0]
        info: dict[str, Any] = {"is_success": bool(outcome.success[0]) and not diverged, "diverged": diverged}
        info["reward_terms"] = {name: 0.0 if diverged else float(term[0]) for name, term in outcome.terms.items()}
        reward = 0.0 if diverged else float(outcome.reward[0])
        return self._observation.copy(), reward, False, diverged, info

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
