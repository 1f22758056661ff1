"""Real systems: an environment whose ξ is hidden, and recordings. A robot is any class with ``rollout``."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import VectorEnv
from numpy.typing import ArrayLike

from simopt_envs.adaptation.checkpoint import digest
from simopt_envs.adaptation.protocols import Policy
from simopt_envs.adaptation.rollouts import Rollouts, run_episodes
from simopt_envs.adaptation.simulator import EnvSimulator, VectorizationMode
from simopt_envs.measured.trajectory import Trajectory
from simopt_envs.physics.parameters import Array, unknown_name

PerChannel = float | Sequence[float] | Mapping[str, float]


class HiddenSystem:
    """An environment that plays the robot: it can be run and measured, and its ξ cannot be read.

    Args:
        env: a registered id or its spec, which may carry arguments, or a function that makes one environment.
        parameters: name -> value of what differs from nominal; it is kept where only this system's episodes see it.
        noise: standard deviation of the sensor noise, in each channel's unit: a number for all channels, one per
            channel, or by name; a name may be a pattern such as ``"handle_*"``.
        dropout: probability that a channel is not measured at a step, in the same forms. Channels of equal
            probability drop out together, as a tracker loses all coordinates of an object, and independently of the
            others. The policy then goes on seeing the last value, and the trajectory holds NaN. The first observation
            is always measured.
        vectorization_mode: see :class:`EnvSimulator`.

    Raises:
        ValueError: for unknown names, values that are not valid, negative noise, or probabilities outside [0, 1).
    """

    _MOST_WORLDS = 128

    def __init__(
        self,
        env: str | EnvSpec | Callable[[], gym.Env],
        parameters: Mapping[str, float],
        noise: PerChannel = 0.0,
        dropout: PerChannel = 0.0,
        vectorization_mode: VectorizationMode | None = None,
    ):
        simulator = EnvSimulator(env, vectorization_mode)
        xi = simulator.parameters.values(parameters)
        self.observation_names = simulator.observation_names
        self.noise = _per_channel("noise", noise, self.observation_names)
        self.dropout = _per_channel("dropout", dropout, self.observation_names)
        if (self.dropout >= 1).any():
            raise ValueError(f"dropout must be a probability below 1, got {dropout}")
        # Of effects, too, which are arguments of the environment.
        hidden = digest(simulator.identity(), dict(zip(simulator.parameters.names, xi.tolist(), strict=True)))

        def make_worlds(n: int) -> tuple[VectorEnv, dict[str, Any]]:
            return simulator.make_worlds(n), {"parameters": np.tile(xi, (n, 1))}

        self._make_worlds = make_worlds
        self._identity = {"env_id": simulator.env_id, "parameters_sha256": hidden}

    def __repr__(self) -> str:
        return f"HiddenSystem({self._identity['env_id']!r}, parameters=<hidden>)"

    def identity(self) -> dict[str, Any]:
        """What identifies it in a checkpoint: of the environment's arguments and ξ a digest."""
        return {**self._identity, "noise": self.noise.tolist(), "dropout": self.dropout.tolist()}

    def rollout(self, policy: Policy, n: int, rng: np.random.Generator) -> list[Trajectory]:
        """Run n episodes and return what the sensors measured."""
        rollouts = self._run(policy, n, rng)
        return [rollouts.trajectory(i) for i in range(n)]

    def evaluate(self, policy: Policy, episodes: int, rng: np.random.Generator) -> float | None:
        """The share of so many episodes that end in success; None where the environment reports no ``is_success``."""
        sizes = [min(self._MOST_WORLDS, episodes - start) for start in range(0, episodes, self._MOST_WORLDS)]
        return Rollouts.concatenate([self._run(policy, size, rng) for size in sizes]).success_rate()

    def _run(self, policy: Policy, n: int, rng: np.random.Generator) -> Rollouts:
        env, options = self._make_worlds(n)
        seeds = rng.integers(2**31, size=n).tolist()
        first = True
        distinct = np.unique(self.dropout[self.dropout > 0])
        group = np.searchsorted(distinct, self.dropout)  # of those that drop out together; where none does, any

        def measure(observation: Array) -> Array:
            nonlocal first
            lost = rng.random((n, max(len(distinct), 1)))[:, group] < self.dropout
            measured = observation + self.noise * rng.standard_normal(observation.shape)
            measured = measured if first else np.where(lost, np.nan, measured)
            first = False
            return measured

        try:
            return run_episodes(env, policy, seed=seeds, options=options, sensor=measure)
        finally:
            env.close()


class RecordedSystem:
    """Episodes that were measured before, whatever policy asks for them.

    Simulations replay their actions, also where a policy is trained under the p(ξ) that they lead to; the policy that
    they were measured with acts in the simulations where SimOpt is given it, and no trainer.

    Args:
        trajectories: the recorded episodes, or windows of a long recording.

    Raises:
        ValueError: for none, or for trajectories of different channels.
    """

    needs_policy = False
    """So the loop may run without one."""

    def __init__(self, trajectories: Sequence[Trajectory]):
        self.trajectories = tuple(trajectories)
        if not self.trajectories:
            raise ValueError("a RecordedSystem needs at least one trajectory")
        shapes = {(t.observations.shape[1], t.actions.shape[1]) for t in self.trajectories}
        if len(shapes) > 1:
            raise ValueError(f"the trajectories differ in (observed channels, actions): {sorted(shapes)}")

    def identity(self) -> dict[str, Any]:
        """What identifies it in a checkpoint: a digest of the data."""
        digest = hashlib.sha256()
        for trajectory in self.trajectories:
            digest.update(np.ascontiguousarray(trajectory.observations).tobytes())
            digest.update(np.ascontiguousarray(trajectory.actions).tobytes())
        return {"trajectories": len(self.trajectories), "sha256": digest.hexdigest()}

    def rollout(self, policy: Policy | None, n: int, rng: np.random.Generator) -> list[Trajectory]:
        """n of the recorded episodes, drawn without replacement; all of them where there are no more."""
        if n >= len(self.trajectories):
            return list(self.trajectories)
        return [self.trajectories[i] for i in np.sort(rng.choice(len(self.trajectories), n, replace=False))]


def _per_channel(what: str, given: PerChannel, names: Sequence[str]) -> Array:
    """One number >= 0 per channel from any of the forms."""
    values = np.zeros(len(names))
    if isinstance(given, Mapping):
        for pattern, value in given.items():
            matching = [fnmatchcase(name, pattern) for name in names]
            if not any(matching):
                raise ValueError(unknown_name(f"observed channel in {what}", pattern, names))
            values[matching] = value
    else:
        array: ArrayLike = np.asarray(given, dtype=np.float64)
        if np.shape(array) not in ((), (len(names),)):
            raise ValueError(f"{what} must be a number or one per observed channel, {len(names)}, got {given}")
        values[:] = array
    if not (np.isfinite(values) & (values >= 0)).all():
        raise ValueError(f"{what} must be finite and >= 0, got {given}")
    return values
