"""Adapting to recordings: their commands replayed in a model, window by window."""

from __future__ import annotations

from collections.abc import Sequence
from threading import Lock
from typing import Any

import mujoco
import numpy as np
from gymnasium.vector import VectorEnv

from simopt_envs.adaptation.checkpoint import digest
from simopt_envs.adaptation.protocols import Policy
from simopt_envs.adaptation.rollouts import Rollouts
from simopt_envs.distributions.distribution import Sampler
from simopt_envs.engine import Engine, LocalEngine
from simopt_envs.measured.trajectory import Trajectory
from simopt_envs.measured.windows import Windows, WindowSimulator
from simopt_envs.physics.parameters import Array, ParameterSpace

_XI_PER_TASK = 64


def window_trajectories(windows: Windows) -> list[Trajectory]:
    """The windows as trajectories, for :class:`RecordedSystem`; those that begin with a missing value left out.

    Observations are the compared channels, actions the commands at their sampling rate.
    """
    return [
        Trajectory(measured, commands[:: windows.stride])
        for measured, commands in zip(windows.measured, windows.commands, strict=True)
        if np.isfinite(measured[0]).all()
    ]


class ReplaySimulator:
    """Runs a model through windows of recordings, from the states estimated at their starts. There is no policy.

    Args:
        model: the model; it is not changed.
        parameters: ξ.
        windows: those that the real system's trajectories come from (:func:`window_trajectories`).
        engine: does the replays, 64 ξ a task.

    Attributes:
        discrepancy_weights: (c,), the inverse of each channel's standard deviation, so that units do not matter.
    """

    def __init__(
        self, model: mujoco.MjModel, parameters: ParameterSpace, windows: Windows, engine: Engine | None = None
    ):
        self.parameters = parameters
        self.observation_names = windows.names
        scale = windows.channel_scale()
        self.discrepancy_weights: Array | None = 1 / np.where(scale > 0, scale, 1.0)
        self.engine: Engine = engine or LocalEngine()
        self._model, self._windows, self._num_threads = model, windows, self.engine.num_threads
        looks = zip(windows.measured, windows.commands[:, :: windows.stride], strict=True)
        self._index = {_key(measured, commands): i for i, (measured, commands) in enumerate(looks)}
        self._simulator: tuple[tuple[int, ...], ParameterSpace, WindowSimulator] | None = None
        self._in_use = Lock()

    def identity(self) -> dict[str, Any]:
        """What identifies it in a checkpoint."""
        parameters = {"parameters": self.parameters.names, "parameters_digest": digest(tuple(self.parameters))}
        windows = {"windows": len(self._windows), "starts_digest": digest(self._windows.starts)}
        return {**parameters, "model_digest": digest(self._model), **windows}

    def make_vector_env(self, num_envs: int, distribution: Sampler, seed: int) -> VectorEnv:
        """There is nothing to train in.

        Raises:
            ValueError: always.
        """
        raise ValueError("recordings are replayed without a policy: give SimOpt trainer=None")

    def rollout(
        self, policy: Policy | None, space: ParameterSpace, xi: Array, real: Sequence[Trajectory], seed: int
    ) -> Rollouts:
        """Replay the windows that the r trajectories ``real`` are, for n ξ; leading axes (n, r).

        Raises:
            ValueError: for a trajectory that is none of the windows.
        """
        chosen = tuple(map(self._find, real))
        tasks = np.split(xi, range(_XI_PER_TASK, len(xi), _XI_PER_TASK))
        observations = np.concatenate(self.engine.map(_replay, tasks, (self, chosen, space)))
        n, r, samples = observations.shape[:3]
        actions = np.broadcast_to(np.stack([t.actions for t in real]), (n, r, *real[0].actions.shape))
        diverged = np.asarray(np.isnan(observations).any(axis=(2, 3)))
        return Rollouts(observations, actions, np.full((n, r), samples - 1), diverged, None)

    def __getstate__(self) -> dict[str, Any]:
        """Without what belongs to this process: the simulator, who uses it, and the engine."""
        return self.__dict__ | {"_simulator": None, "_in_use": None, "engine": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__ = state | {"_in_use": Lock()}

    def _find(self, trajectory: Trajectory) -> int:
        index = self._index.get(_key(trajectory.observations, trajectory.actions))
        if index is None:
            raise ValueError("a trajectory to replay is none of the simulator's windows")
        return index

    def _simulate(self, xi: Array, chosen: tuple[int, ...], space: ParameterSpace) -> Array:
        """Some windows for ξ (n, d); of several threads, one at a time.

        Their simulator is kept, as updates come several on the same windows.
        """
        with self._in_use:
            if self._simulator is None or self._simulator[:2] != (chosen, space):
                windows = self._windows.select(np.array(chosen))
                self._simulator = chosen, space, WindowSimulator(self._model, windows, space, self._num_threads)
            return self._simulator[2](xi)


def _key(observations: Array, actions: Array) -> tuple[bytes, bytes]:
    """What a window is found by: a joint that sticks looks the same under many a command."""
    return observations.tobytes(), actions.tobytes()


def _replay(xi: Array, simulator: ReplaySimulator, chosen: tuple[int, ...], space: ParameterSpace) -> Array:
    return simulator._simulate(xi, chosen, space)
