"""The vector environment of a task: n worlds stepped together on all cores, a ξ per world."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from simopt_envs.physics.parameters import Array, ParameterSpace
from simopt_envs.physics.simulation import BatchSimulation
from simopt_envs.tasks.options import episode_parameters, start_qpos
from simopt_envs.tasks.task import Task

Worlds = NDArray[np.intp]


class TaskVectorEnv(gym.vector.VectorEnv[Array, Array, NDArray[Any]]):
    """n worlds of a task over :class:`BatchSimulation`.

    World i, seeded with s + i, goes through what the single environment seeded so goes through. ``reset`` takes the
    options of :class:`~simopt_envs.tasks.env.TaskEnv`: parameter values are numbers or one per world, or an (n, d)
    array; ``initial_observation`` is (n, o); ``reset_mask`` (n,) resets some worlds only. ``info["parameters"]`` of
    ``reset`` and of every step is (n, d), in the order of ``parameters.names``.

    A world that diverges ends its episode: truncated, its observation the last valid one, its reward 0,
    ``info["diverged"]`` True. ``diverged_count`` counts them.

    Args:
        task: the task.
        num_envs: n.
        max_episode_steps: steps after which an episode is truncated.
        autoreset_mode: when a world that is done is reset, as Gymnasium defines it.
        num_threads: 0 for one per core.

    Attributes:
        parameter_source: called with the ids (k,) of worlds that begin an episode without explicit parameters, at
            ``reset`` and at every autoreset; returns their ξ, (k, d). None: nominal.
    """

    def __init__(
        self,
        task: Task,
        num_envs: int = 1,
        max_episode_steps: int = 50,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        num_threads: int = 0,
    ):
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {num_envs}")
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.task = task
        self.num_envs = num_envs
        self.max_episode_steps = max_episode_steps
        self.simulation = BatchSimulation(task.make_model(visual=False), task.parameters, num_envs, num_threads)
        self.parameters: ParameterSpace = task.parameters
        self.parameter_source: Callable[[Worlds], Array] | None = None
        self.discrepancy_weights = task.discrepancy_weights
        self.single_observation_space, self.single_action_space = task.observation_space, task.action_space
        self.observation_space = batch_space(task.observation_space, num_envs)
        self.action_space = batch_space(task.action_space, num_envs)
        self.metadata = {
            "render_modes": [],
            "render_fps": round(1 / self.dt),
            "autoreset_mode": self.autoreset_mode,
        }
        self.diverged_count = 0
        self._rngs = [np_random(None)[0] for _ in range(num_envs)]
        self._xi = np.tile(self.parameters.nominal, (num_envs, 1))
        self._steps = np.zeros(num_envs, dtype=np.int64)
        self._done = np.zeros(num_envs, dtype=bool)
        self._observation: Array = np.zeros((num_envs, *task.observation_space.shape))

    @property
    def dt(self) -> float:
        """Seconds between two actions."""
        return float(self.simulation.model.opt.timestep * self.task.substeps)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin an episode in every world, or in those of ``options["reset_mask"]``; see the class."""
        options = dict(options or {})
        mask = options.pop("reset_mask", None)
        worlds = np.arange(self.num_envs) if mask is None else np.flatnonzero(mask)
        explicit = episode_parameters(self.parameters, options, self.num_envs)
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int | np.integer) else seed
        if seeds is not None:
            if len(seeds) != self.num_envs:
                raise ValueError(f"seed must be one number or {self.num_envs} of them, got {len(seeds)}")
            for world in worlds.tolist():
                if seeds[world] is not None:
                    self._rngs[world] = np_random(seeds[world])[0]
        self._begin(worlds, explicit[worlds] if "parameters" in options else None, options.get("initial_observation"))
        return self._observation.copy(), {"parameters": self._xi.copy()}

    def step(
        self, actions: Array
    ) -> tuple[Array, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Advance every world by ``dt``; worlds that are done are reset as ``autoreset_mode`` says."""
        actions = np.clip(np.asarray(actions, dtype=np.float64), -1.0, 1.0)
        if actions.shape != self.action_space.shape:
            raise ValueError(f"actions must have shape {self.action_space.shape}, got {actions.shape}")
        beginning = self._done.copy()  # with NEXT_STEP, these worlds spend this step on their reset
        if self.autoreset_mode is AutoresetMode.DISABLED and beginning.any():
            raise RuntimeError(
                f"worlds {np.flatnonzero(beginning).tolist()} are done; reset them (options['reset_mask'])"
            )

        diverged = self.simulation.step(self.task.control(self.simulation, actions), self.task.substeps) & ~beginning
        observation = self.task.observe(self.simulation)
        outcome = self.task.evaluate(self.simulation, actions)
        running = ~(diverged | beginning)
        reward = np.where(running, outcome.reward, 0.0)
        success = outcome.success & running
        observation[diverged] = self._observation[diverged]
        self._observation = observation
        self._steps += 1
        self.diverged_count += int(diverged.sum())

        terminated = np.zeros(self.num_envs, dtype=bool)
        truncated = (diverged | (self._steps >= self.max_episode_steps)) & ~beginning
        info: dict[str, Any] = {
            "is_success": success,
            "diverged": diverged,
            "reward_terms": {name: np.where(running, term, 0.0) for name, term in outcome.terms.items()},
        }
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            self._autoreset_now(truncated, info)
        else:
            self._begin(np.flatnonzero(beginning))
            self._done = truncated.copy()
        info["parameters"] = self._xi.copy()
        return self._observation.copy(), reward, terminated, truncated, info

    def _autoreset_now(self, done: NDArray[np.bool_], info: dict[str, Any]) -> None:
        """SAME_STEP: keep the final observations and infos of the worlds that are done, then reset them."""
        if not done.any():
            return
        final = np.full(self.num_envs, None, dtype=object)
        for world in np.flatnonzero(done):
            final[world] = self._observation[world].copy()
        info["final_obs"], info["_final_obs"] = final, done
        info["final_info"] = {
            "is_success": info["is_success"],
            "_is_success": done,
            "diverged": info["diverged"],
            "_diverged": done,
            "parameters": self._xi.copy(),
            "_parameters": done,
        }
        info["_final_info"] = done
        self._begin(np.flatnonzero(done))

    def _begin(self, worlds: Worlds, xi: Array | None = None, initial_observation: Array | None = None) -> None:
        """Start an episode in some worlds."""
        if not len(worlds):
            return
        if xi is None and self.parameter_source is not None:
            xi = self.parameters.validate(self.parameter_source(worlds))
        qpos = np.stack([self.task.initial_qpos(self._rngs[world]) for world in worlds])
        if initial_observation is not None:
            for row, world in enumerate(worlds):
                qpos[row] = start_qpos(self.task, {"initial_observation": initial_observation[world]}, qpos[row])
        self._xi[worlds] = self.parameters.nominal if xi is None else xi
        self.simulation.write(worlds, self._xi[worlds])
        self.simulation.reset(worlds, qpos, np.zeros((len(worlds), self.simulation.model.nv)), self.task.hold(qpos))
        self._observation[worlds] = self.task.observe(self.simulation)[worlds]
        self._steps[worlds] = 0
        self._done[worlds] = False
