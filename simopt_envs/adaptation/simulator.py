"""The simulation side of the loop, over any environment that has a ``ParameterSpace``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Literal, Protocol

import gymnasium as gym
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv

from simopt_envs.adaptation.protocols import Policy
from simopt_envs.adaptation.rollouts import Rollouts, run_episodes
from simopt_envs.distributions.distribution import Sampler
from simopt_envs.distributions.draws import EpisodeDraws
from simopt_envs.measured.trajectory import Trajectory
from simopt_envs.physics.parameters import Array, ParameterSpace

VectorizationMode = Literal["native", "sync", "async"]


class Simulator(Protocol):
    """A simulation whose physics are set by ξ.

    Attributes:
        parameters: all its parameters; p(ξ) may be over some of them, the rest stay nominal.
        discrepancy_weights: (o,), weights of the observed channels that suit it, or None.
        observation_names: (o,), names of the observed channels.
    """

    parameters: ParameterSpace
    discrepancy_weights: Array | None
    observation_names: tuple[str, ...]

    def make_vector_env(self, num_envs: int, distribution: Sampler, seed: int) -> VectorEnv:
        """A vector environment in which every episode of every world has its own ξ ~ p(ξ)."""
        ...

    def rollout(
        self, policy: Policy | None, space: ParameterSpace, xi: Array, real: Sequence[Trajectory], seed: int
    ) -> Rollouts:
        """Repeat each of r measured episodes with each of n ξ.

        Args:
            policy: the one that the episodes were measured with; it acts on the simulation's observations (closed
                loop). None where the recorded actions are replayed.
            space: what the columns of ``xi`` are; parameters outside it are nominal.
            xi: physical values, (n, d).
            real: the r episodes; each simulation starts from the first observation of its own.
            seed: the j-th episode is seeded alike for all ξ (common random numbers).

        Returns:
            Rollouts with leading axes (n, r).
        """
        ...


class EnvSimulator:
    """Simulates in a Gymnasium environment whose ``reset`` takes ``options={"parameters": {name: value}}``.

    To repeat a measured episode it also passes ``options["initial_observation"]``, (o,), and a seed.

    Args:
        env: a registered id, or a function that makes one environment.
        vectorization_mode: how worlds run together. ``"native"``: the id's own vector environment, whose ``reset``
            takes all worlds' parameters as an array (n, d) and which has a ``parameter_source``; ``"sync"``,
            ``"async"``: Gymnasium's, over single environments. None: native where it can be had, else sync.
        num_envs: most worlds that :meth:`rollout` runs at a time.

    Raises:
        ValueError: for an environment without ``parameters``, or without a vector environment of its own where that
            is asked for.
    """

    def __init__(
        self,
        env: str | Callable[[], gym.Env],
        vectorization_mode: VectorizationMode | None = None,
        num_envs: int = 256,
    ):
        self.env_id = env if isinstance(env, str) else getattr(env, "__name__", type(env).__name__)
        self.num_envs = num_envs
        self._make_env: Callable[[], gym.Env] = partial(gym.make, env) if isinstance(env, str) else env
        has_own = isinstance(env, str) and gym.spec(env).vector_entry_point is not None
        if vectorization_mode == "native" and not has_own:
            raise ValueError(f'{self.env_id} has no vector environment of its own; use "sync" or "async"')
        self.vectorization_mode: VectorizationMode = vectorization_mode or ("native" if has_own else "sync")
        self._fall_back = vectorization_mode is None
        self._worlds: VectorEnv | None = None

        single = self._make_env()
        try:
            space = _attribute(single, "parameters")
            if not isinstance(space, ParameterSpace):
                raise ValueError(
                    f"{self.env_id} has no attribute 'parameters' (a ParameterSpace): "
                    "make it one of RandomizablePhysics, from wrappers"
                )
            self.parameters: ParameterSpace = space
            self.discrepancy_weights: Array | None = _attribute(single, "discrepancy_weights")
            channels = range(int(np.prod(single.observation_space.shape or ())))
            names = _attribute(single, "observation_names") or [f"observation_{i}" for i in channels]
            self.observation_names: tuple[str, ...] = tuple(names)
        finally:
            single.close()

    def identity(self) -> dict[str, Any]:
        """What identifies it in a checkpoint."""
        return {"env_id": self.env_id}

    def make_vector_env(self, num_envs: int, distribution: Sampler, seed: int) -> VectorEnv:
        """See :meth:`Simulator.make_vector_env`. Worlds that are done are reset in the same step."""
        return self._open(num_envs, AutoresetMode.SAME_STEP, distribution, seed)

    def make_worlds(self, num_envs: int) -> VectorEnv:
        """A vector environment at nominal ξ but for ``reset(options={"parameters": (n, d)})``."""
        return self._open(num_envs, AutoresetMode.NEXT_STEP)

    def rollout(
        self, policy: Policy | None, space: ParameterSpace, xi: Array, real: Sequence[Trajectory], seed: int
    ) -> Rollouts:
        """See :meth:`Simulator.rollout`."""
        if policy is None:
            raise ValueError("closed-loop rollouts need a policy")
        n, r = len(xi), len(real)
        parameters = self.parameters.values(dict(zip(space.names, np.transpose(xi), strict=True)), n).repeat(r, axis=0)
        starts = np.tile([trajectory.observations[0] for trajectory in real], (n, 1))
        seeds = np.tile(np.random.SeedSequence(seed).generate_state(r) // 2, n)
        parts = -(-n * r // self.num_envs)
        size = -(-n * r // parts)
        if self._worlds is None or self._worlds.num_envs != size:
            self.close()
            self._worlds = self.make_worlds(size)
        rollouts = [
            run_episodes(
                self._worlds,
                policy,
                max(map(len, real)),
                seed=seeds[chosen].tolist(),
                options={"parameters": parameters[chosen], "initial_observation": starts[chosen]},
            )
            for chosen in np.arange(parts * size).reshape(parts, size) % (n * r)  # the last part repeats the first
        ]
        return Rollouts.concatenate(rollouts).map(lambda x: x[: n * r].reshape(n, r, *x.shape[1:]))

    def close(self) -> None:
        """Close the worlds that were kept for the next rollout."""
        if self._worlds is not None:
            self._worlds.close()
            self._worlds = None

    def _open(
        self, num_envs: int, mode: AutoresetMode, distribution: Sampler | None = None, seed: int = 0
    ) -> VectorEnv:
        if self.vectorization_mode == "native":
            try:
                env = gym.make_vec(self.env_id, num_envs, "vector_entry_point", autoreset_mode=mode)
            except ImportError:  # MuJoCo too old for it
                if not self._fall_back:
                    raise
                self.vectorization_mode = "sync"
                return self._open(num_envs, mode, distribution, seed)
            if distribution is not None:
                draws = EpisodeDraws(self.parameters, distribution, num_envs)
                draws.seed(seed)
                env.unwrapped.parameter_source = draws  # type: ignore[attr-defined]
            return env
        worlds = [partial(_World, self._make_env, i, distribution, seed + i) for i in range(num_envs)]
        vector_env = SyncVectorEnv if self.vectorization_mode == "sync" else AsyncVectorEnv
        return vector_env(worlds, autoreset_mode=mode)


class _World(gym.Wrapper):
    """One world of a Gymnasium vector environment: picks its own of the options that speak of all worlds."""

    def __init__(self, make_env: Callable[[], gym.Env], index: int, distribution: Sampler | None, seed: int):
        super().__init__(make_env())
        self._index = index
        self._space: ParameterSpace = self.get_wrapper_attr("parameters")
        self._draws = None
        if distribution is not None:
            self._draws = EpisodeDraws(self._space, distribution)
            self._draws.seed(seed)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        own = {name: value[self._index] for name, value in (options or {}).items()}
        if "parameters" in own or self._draws is not None:
            xi = own["parameters"] if self._draws is None else self._draws([0])[0]
            own["parameters"] = self._space.as_dict(xi)
        return self.env.reset(seed=seed, options=own)


def _attribute(env: gym.Env, name: str) -> Any:
    return env.get_wrapper_attr(name) if env.has_wrapper_attr(name) else None
