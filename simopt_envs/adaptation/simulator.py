"""The simulation side of the loop, over any environment that has a ``ParameterSpace``."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from threading import Lock
from typing import Any, Literal, Protocol

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv, VectorWrapper
from numpy.typing import NDArray

from simopt_envs.adaptation.protocols import Policy
from simopt_envs.adaptation.rollouts import Rollouts, run_episodes
from simopt_envs.distributions.distribution import Sampler
from simopt_envs.distributions.draws import EpisodeDraws
from simopt_envs.engine import Engine, FailedTasksError, LocalEngine
from simopt_envs.measured.trajectory import Trajectory
from simopt_envs.physics.parameters import Array, ParameterSpace

_MANY = 1024
"""From so many worlds on, to draw ξ for each from a generator of its own takes longer than to simulate them."""
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
            Rollouts with leading axes (n, r). ``success`` is unknown of simulations that go on for longer than the
            measured episodes.
        """
        ...


class EnvSimulator:
    """Simulates in a Gymnasium environment whose ``reset`` takes ``options={"parameters": {name: value}}``.

    To repeat a measured episode it also passes ``options["initial_observation"]``, (o,), and a seed.

    Args:
        env: a registered id or its spec, which may carry arguments, or a function that makes one environment.
        vectorization_mode: how worlds run together. ``"native"``: the id's own vector environment, whose ``reset``
            takes all worlds' parameters as an array (n, d) and which has a ``parameter_source``; ``"sync"``,
            ``"async"``: Gymnasium's, over single environments. None: native where it can be had, else sync.
        num_envs: most worlds that :meth:`rollout` runs at a time.
        engine: does the rollouts, so many worlds a task. Where its tasks run on one thread each, the id's own vector
            environment is made with ``num_threads=1``.
        **options: for the id's own vector environment: ``backend="warp"``, say. With many worlds, their ξ are drawn
            at once.

    Raises:
        ValueError: for an environment without ``parameters``, one whose observation is no Box with one axis, or one
            without a vector environment of its own where that is asked for.
    """

    def __init__(
        self,
        env: str | EnvSpec | Callable[[], gym.Env],
        vectorization_mode: VectorizationMode | None = None,
        num_envs: int = 256,
        engine: Engine | None = None,
        **options: Any,
    ):
        self.num_envs = num_envs
        self.engine: Engine = engine or LocalEngine()
        self._num_threads = self.engine.num_threads
        # The spec, not the id: where a task runs, the id need not be registered.
        self._spec: EnvSpec | None = None
        self._make_env: Callable[[], gym.Env]
        if isinstance(env, str | EnvSpec):
            self._spec = gym.spec(env) if isinstance(env, str) else env
            self._make_env = partial(gym.make, self._spec)
            self.env_id = self._spec.id
        else:
            self._make_env = env
            self.env_id = getattr(env, "__name__", type(env).__name__)
        has_own = self._spec is not None and self._spec.vector_entry_point is not None
        if vectorization_mode == "native" and not has_own:
            raise ValueError(f'{self.env_id} has no vector environment of its own; use "sync" or "async"')
        self.vectorization_mode: VectorizationMode = vectorization_mode or ("native" if has_own else "sync")
        if options and self.vectorization_mode != "native":
            raise ValueError(f"{self.env_id} runs {self.vectorization_mode}: it takes no {', '.join(options)}")
        self._options = options
        self._fall_back = vectorization_mode is None and not options
        self._worlds: VectorEnv | None = None
        self._in_use = Lock()
        self._starts_as_told = False

        single = self._make_env()
        try:
            space = _attribute(single, "parameters")
            if not isinstance(space, ParameterSpace):
                raise ValueError(
                    f"{self.env_id} has no attribute 'parameters' (a ParameterSpace): "
                    "make it with AdaptableEnv, from wrappers"
                )
            observed = single.observation_space
            if not isinstance(observed, spaces.Box) or len(observed.shape) != 1:
                raise ValueError(
                    f"{self.env_id} must observe a Box with one axis, not {observed}: wrap it in FlattenObservation, "
                    "or make it with AdaptableEnv, from wrappers, which flattens dictionaries"
                )
            self.parameters: ParameterSpace = space
            self.discrepancy_weights: Array | None = _attribute(single, "discrepancy_weights")
            channels = [f"observation_{i}" for i in range(observed.shape[0])]
            names = _attribute(single, "observation_names") or channels
            self.observation_names: tuple[str, ...] = tuple(names)
        finally:
            single.close()

    def identity(self) -> dict[str, Any]:
        """What identifies it in a checkpoint."""
        arguments = {} if self._spec is None else self._spec.kwargs
        return {"env_id": self.env_id, **arguments, **self._options}

    def make_vector_env(self, num_envs: int, distribution: Sampler, seed: int) -> VectorEnv:
        """See :meth:`Simulator.make_vector_env`. Worlds that are done are reset in the same step."""
        return self._open(num_envs, AutoresetMode.SAME_STEP, distribution, seed)

    def make_worlds(self, num_envs: int) -> VectorEnv:
        """A vector environment at nominal ξ but for ``reset(options={"parameters": (n, d)})``."""
        return _OnHost(self._open(num_envs, AutoresetMode.NEXT_STEP))

    def require_start(self) -> None:
        """See that an episode can begin at a measured observation, as :meth:`rollout` needs it.

        Raises:
            ValueError: for single environments that ignore ``options["initial_observation"]``.
        """
        if self._starts_as_told or self.vectorization_mode == "native":
            return
        env = self._make_env()
        try:
            shown, drawn = (np.array(env.reset(seed=seed)[0]) for seed in (0, 1))
            begun, _ = env.reset(seed=1, options={"initial_observation": shown})
        finally:
            env.close()
        # Not whether it begins there to the last digit: noise, or other physics, may be in the way of that.
        if np.array_equal(begun, drawn) and not np.array_equal(shown, drawn):
            raise ValueError(
                f"{self.env_id} ignores options['initial_observation'], so its episodes cannot begin as measured ones "
                "did: make it with AdaptableEnv, from wrappers"
            )
        self._starts_as_told = True

    def rollout(
        self, policy: Policy | None, space: ParameterSpace, xi: Array, real: Sequence[Trajectory], seed: int
    ) -> Rollouts:
        """See :meth:`Simulator.rollout`. Where actions are replayed, simulations are as long as their recordings.

        Raises:
            ValueError: see :meth:`require_start`; for recorded actions that are not as many as the environment's.
        """
        self.require_start()
        n, r, lengths = len(xi), len(real), [len(trajectory) for trajectory in real]
        episodes = _Episodes(
            self.parameters.values(dict(zip(space.names, np.transpose(xi), strict=True)), n).repeat(r, axis=0),
            np.tile([trajectory.observations[0] for trajectory in real], (n, 1)),
            np.tile(np.random.SeedSequence(seed).generate_state(r) // 2, n),
            np.tile(lengths, n) if policy is None else np.full(n * r, max(lengths)),
            None if policy is not None else np.tile([_held(t.actions, max(lengths)) for t in real], (n, 1, 1)),
        )
        parts = -(-n * r // self.num_envs)  # whatever the engine, as the results are to be
        size = -(-n * r // parts)
        rows = np.arange(parts * size).reshape(parts, size) % (n * r)  # the last part repeats the first
        rollouts = self._roll_out(policy, [episodes.select(chosen) for chosen in rows])
        return Rollouts.concatenate(rollouts).map(lambda x: x[: n * r].reshape(n, r, *x.shape[1:]))

    def _roll_out(self, policy: Policy | None, parts: list[_Episodes]) -> list[Rollouts]:
        """Rollouts of each part. Episodes that cannot be run, say as they crash their worker, count as diverged."""
        try:
            return self.engine.map(_roll_out, parts, (self, policy))
        except FailedTasksError as error:
            finished = next((part for part in error.results if part is not None), None)
            if finished is None:
                raise error.failures[0] from error
            for i in error.failures:
                error.results[i] = self._one_by_one(policy, parts[i], finished.map(lambda x: x[:1]))
            return error.results

    def _one_by_one(self, policy: Policy | None, episodes: _Episodes, like: Rollouts) -> Rollouts:
        """Rollouts of episodes among which some cannot be run."""
        each = [episodes.select(np.array([i])) for i in range(len(episodes.seeds))]
        try:
            rollouts = self.engine.map(_roll_out, each, (self, policy))
        except FailedTasksError as error:
            rollouts = error.results
            for i, cause in error.failures.items():
                rollouts[i] = _diverged(like)
                warnings.warn(
                    f"an episode cannot be simulated and counts as diverged: seed {episodes.seeds[i]}, "
                    f"ξ {self.parameters.as_dict(episodes.xi[i])}: {type(cause).__name__}: {cause}",
                    RuntimeWarning,
                    stacklevel=4,
                )
        return Rollouts.concatenate(rollouts)

    def __getstate__(self) -> dict[str, Any]:
        """Without what belongs to this process: open worlds, who uses them, and the engine."""
        return self.__dict__ | {"_worlds": None, "_in_use": None, "engine": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__ = state | {"_in_use": Lock()}

    def close(self) -> None:
        """Close the worlds that were kept for the next rollout."""
        worlds, self._worlds = self._worlds, None
        if worlds is not None:
            worlds.close()

    def run(self, policy: Policy | None, episodes: _Episodes) -> Rollouts:
        """Run episodes side by side, in worlds that are kept for the next ones; of several threads, one at a time."""
        with self._in_use:
            size = len(episodes.seeds)
            if self._worlds is None or self._worlds.num_envs != size:
                self.close()
                self._worlds = _OnHost(self._open(size, AutoresetMode.NEXT_STEP, num_threads=self._num_threads))
            if policy is None:
                assert episodes.actions is not None
                policy = _Replay(episodes.actions, self._worlds.single_action_space)
            options = {"parameters": episodes.xi, "initial_observation": episodes.starts}
            try:
                return run_episodes(self._worlds, policy, episodes.steps, seed=episodes.seeds.tolist(), options=options)
            except Exception:
                self.close()  # one of the worlds may be gone
                raise

    def _open(
        self,
        num_envs: int,
        mode: AutoresetMode,
        distribution: Sampler | None = None,
        seed: int = 0,
        num_threads: int = 0,
    ) -> VectorEnv:
        if self.vectorization_mode == "native":
            assert self._spec is not None
            options = self._options | ({"num_threads": num_threads} if num_threads else {})
            try:
                env = gym.make_vec(self._spec, num_envs, "vector_entry_point", autoreset_mode=mode, **options)
            except ImportError:  # MuJoCo too old for it
                if not self._fall_back:
                    raise
                self.vectorization_mode = "sync"
                return self._open(num_envs, mode, distribution, seed, num_threads)
            if distribution is not None:
                draws = EpisodeDraws(self.parameters, distribution, num_envs, at_once=num_envs >= _MANY)
                draws.seed(seed)
                env.unwrapped.parameter_source = draws  # type: ignore[attr-defined]
            return env
        worlds = [partial(_World, self._make_env, i, distribution, seed + i) for i in range(num_envs)]
        vector_env = SyncVectorEnv if self.vectorization_mode == "sync" else AsyncVectorEnv
        return vector_env(worlds, autoreset_mode=mode)


@dataclass(frozen=True)
class _Episodes:
    """k episodes to run side by side.

    Each has its ξ (k, d), first observation (k, o), seed (k,) and most steps (k,), and where no policy acts its actions
    (k, T, a).
    """

    xi: Array
    starts: Array
    seeds: NDArray[np.unsignedinteger]
    steps: NDArray[np.int64]
    actions: Array | None

    def select(self, rows: NDArray[np.intp]) -> _Episodes:
        actions = None if self.actions is None else self.actions[rows]
        return _Episodes(self.xi[rows], self.starts[rows], self.seeds[rows], self.steps[rows], actions)


class _Replay:
    """A policy that repeats the actions (k, T, a) of k episodes, one step after the other, whatever it sees."""

    def __init__(self, actions: Array, space: spaces.Space):
        if actions.shape[2] != np.prod(space.shape or ()):
            raise ValueError(f"the recordings have {actions.shape[2]} actions, but the environment takes {space}")
        whole = np.issubdtype(space.dtype, np.integer)
        self._actions = iter(actions.astype(space.dtype if whole else np.float64).swapaxes(0, 1))
        self._shape = (len(actions), *(space.shape or ()))

    def act(self, observations: Array) -> np.ndarray:
        return next(self._actions).reshape(self._shape)


def _held(actions: Array, steps: int) -> Array:
    """Actions (T, a) of so many steps; the last one is held."""
    return actions[np.minimum(np.arange(steps), len(actions) - 1)]


def _roll_out(episodes: _Episodes, simulator: EnvSimulator, policy: Policy | None) -> Rollouts:
    return simulator.run(policy, episodes)


def _diverged(like: Rollouts) -> Rollouts:
    """Rollouts of the same size that diverged at once."""
    return Rollouts(
        np.full_like(like.observations, np.nan),
        np.full_like(like.actions, np.nan),
        np.zeros_like(like.lengths),
        np.ones_like(like.diverged),
        None if like.success is None else np.zeros_like(like.success),
    )


class _OnHost(VectorWrapper):
    """Brings what a vector environment on a GPU returns into the host's memory; the actions may be there."""

    def reset(self, **arguments: Any) -> tuple[Any, dict[str, Any]]:
        return _on_host(self.env.reset(**arguments))

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        return _on_host(self.env.step(actions))


def _on_host(values: Any) -> Any:
    if isinstance(values, dict):
        return {name: _on_host(value) for name, value in values.items()}
    if isinstance(values, tuple):
        return tuple(map(_on_host, values))
    return values.cpu().numpy() if hasattr(values, "cpu") else values


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
