"""The vector environment of a task: n worlds stepped together on all cores or on a GPU, a ξ per world."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from simopt_envs.physics.arrays import namespace, to_numpy
from simopt_envs.physics.parameters import Array, ParameterSpace, unknown_name
from simopt_envs.physics.simulation import BatchSimulation, Simulation
from simopt_envs.tasks.options import episode_parameters, start_qpos
from simopt_envs.tasks.task import Task

Worlds = NDArray[np.intp]
Backend = Literal["mujoco", "warp"]

_HORIZON = 50  # steps of the two tasks' episodes


class TaskVectorEnv(gym.vector.VectorEnv[Any, Any, Any]):
    """n worlds of a task, on the threads of MuJoCo or on MuJoCo Warp.

    World i, seeded with s + i, goes through what the single environment seeded so goes through. ``reset`` takes the
    options of :class:`~simopt_envs.tasks.env.TaskEnv`: parameter values are numbers or one per world, or an (n, d)
    array; ``initial_observation`` is (n, o); ``reset_mask`` (n,) resets some worlds only. ``info["parameters"]`` of
    ``reset`` and of every step is (n, d), in the order of ``parameters.names``.

    A world that diverges ends its episode: truncated, its observation the last valid one, its reward 0,
    ``info["diverged"]`` True. ``diverged_count`` counts them.

    With the backend "warp" observations, rewards, flags and their infos are torch tensors on the device, in single
    precision, and actions may be; ``info["parameters"]`` remains an array. ``final_obs`` then is one tensor (n, o), of
    which ``_final_obs`` tells the rows that count.

    Args:
        task: the task.
        num_envs: n.
        max_episode_steps: steps after which an episode is truncated; -1 for no limit, None for the tasks' 50.
        autoreset_mode: when a world that is done is reset, as Gymnasium defines it.
        num_threads: of "mujoco"; 0 for one per core.
        backend: "mujoco", or "warp" for MuJoCo Warp.
        device: of "warp": "cuda:0", "cpu", ...; None for the first GPU, or the CPU where there is none.
        render_mode: None, as it does not render; there for callers that always name one.

    Raises:
        ValueError: for an argument that is out of range; by ``reset``, for an option or parameter it does not know or
            cannot take; by ``step``, for actions of another shape or that are not finite.

    Attributes:
        parameter_source: called with the ids (k,) of worlds that begin an episode without explicit parameters, at
            ``reset`` and at every autoreset; returns their ξ, (k, d). None: nominal.
    """

    def __init__(
        self,
        task: Task,
        num_envs: int = 1,
        max_episode_steps: int | None = _HORIZON,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        num_threads: int = 0,
        backend: Backend = "mujoco",
        device: str | None = None,
        render_mode: None = None,
    ):
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {num_envs}")
        max_episode_steps = _HORIZON if max_episode_steps is None else max_episode_steps
        if max_episode_steps < 1 and max_episode_steps != -1:
            raise ValueError(f"max_episode_steps must be at least 1, or -1 for no limit, got {max_episode_steps}")
        if render_mode is not None:
            raise ValueError(
                f"the native vector environment does not render: render_mode must be None, got {render_mode!r}; "
                'use vectorization_mode="sync"'
            )
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.task = task
        self.num_envs = num_envs
        self.max_episode_steps = max_episode_steps
        self.simulation = _simulation(task, num_envs, num_threads, backend, device)
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
        self._steps = self.simulation.asarray(np.zeros(num_envs, dtype=np.int64))
        self._done = self.simulation.asarray(np.zeros(num_envs, dtype=bool))
        self._observation = self.simulation.asarray(np.zeros((num_envs, *task.observation_space.shape)))

    @property
    def dt(self) -> float:
        """Seconds between two actions."""
        return float(self.simulation.model.opt.timestep * self.task.substeps)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in every world, or in those of ``options["reset_mask"]``; see the class."""
        options = dict(options or {})
        mask = options.pop("reset_mask", None)
        worlds = np.arange(self.num_envs) if mask is None else np.flatnonzero(mask)
        explicit = episode_parameters(self.parameters, options, self.num_envs)
        given = options.get("parameters") is not None
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int | np.integer) else seed
        if seeds is not None:
            if len(seeds) != self.num_envs:
                raise ValueError(f"seed must be one number or {self.num_envs} of them, got {len(seeds)}")
            for world in worlds.tolist():
                if seeds[world] is not None:
                    self._rngs[world] = np_random(seeds[world])[0]
        self._begin(worlds, explicit[worlds] if given else None, options.get("initial_observation"))
        return deepcopy(self._observation), {"parameters": self._xi.copy()}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Advance every world by ``dt``; worlds that are done are reset as ``autoreset_mode`` says."""
        xp = namespace(self._observation)
        actions = self.simulation.asarray(actions)
        if actions.shape != self.action_space.shape:
            raise ValueError(f"actions must have shape {self.action_space.shape}, got {actions.shape}")
        if not xp.isfinite(actions).all():
            world = _which(~xp.isfinite(actions).all(axis=1))[0]
            raise ValueError(f"the action of world {world} is not finite: {actions[world]}")
        actions = xp.clip(actions, -1.0, 1.0)
        beginning = self._done  # with NEXT_STEP, these worlds spend this step on their reset
        if self.autoreset_mode is AutoresetMode.DISABLED and beginning.any():
            raise RuntimeError(f"worlds {_which(beginning).tolist()} are done; reset them (options['reset_mask'])")

        diverged = self.simulation.step(self.task.control(self.simulation, actions), self.task.substeps) & ~beginning
        observation = self.task.observe(self.simulation)
        outcome = self.task.evaluate(self.simulation, actions)
        running = ~(diverged | beginning)
        reward = xp.where(running, outcome.reward, 0.0)
        success = outcome.success & running
        self._observation = xp.where(diverged[:, None], self._observation, observation)
        self._steps += 1
        self.diverged_count += int(diverged.sum())

        over = (self._steps >= self.max_episode_steps) & (self.max_episode_steps != -1)
        truncated = (diverged | over) & ~beginning
        info: dict[str, Any] = {
            "is_success": success,
            "diverged": diverged,
            "reward_terms": {name: xp.where(running, term, 0.0) for name, term in outcome.terms.items()},
        }
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            self._autoreset_now(truncated, info)
        else:
            self._begin(_which(beginning))
            self._done = deepcopy(truncated)
        info["parameters"] = self._xi.copy()
        return deepcopy(self._observation), reward, xp.zeros_like(truncated), truncated, info

    def _autoreset_now(self, done: Any, info: dict[str, Any]) -> None:
        """SAME_STEP: keep the final observations and infos of the worlds that are done, then reset them."""
        worlds = _which(done)
        if not len(worlds):
            return
        info["final_obs"], info["_final_obs"] = deepcopy(self._observation), done
        if isinstance(done, np.ndarray):  # as Gymnasium has it
            final = np.full(self.num_envs, None, dtype=object)
            for world in worlds:
                final[world] = self._observation[world].copy()
            info["final_obs"] = final
        info["final_info"] = {
            "is_success": info["is_success"],
            "_is_success": done,
            "diverged": info["diverged"],
            "_diverged": done,
            "parameters": self._xi.copy(),
            "_parameters": done,
        }
        info["_final_info"] = done
        self._begin(worlds)

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


def _simulation(task: Task, num_envs: int, num_threads: int, backend: Backend, device: str | None) -> Simulation:
    model = task.make_model(visual=False)
    if backend == "mujoco":
        return BatchSimulation(model, task.parameters, num_envs, num_threads)
    if backend == "warp":
        from simopt_envs.physics.warp_simulation import WarpSimulation

        return WarpSimulation(model, task.parameters, num_envs, device)
    raise ValueError(unknown_name("backend", backend, ("mujoco", "warp")))


def _which(mask: Any) -> Worlds:
    """The worlds that a mask picks."""
    return np.flatnonzero(to_numpy(mask))
