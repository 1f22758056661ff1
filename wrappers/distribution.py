"""ξ ~ p(ξ) at each episode of an environment, single or vector."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import VectorEnv, VectorWrapper

from simopt_envs.distributions.distribution import Sampler
from simopt_envs.distributions.draws import EpisodeDraws
from simopt_envs.physics.parameters import ParameterSpace


class DistributionWrapper(gym.Wrapper, RecordConstructorArgs):
    """Draws the physics of each episode from a distribution.

    Every ``reset`` draws, also one without seed or options, as autoreset calls it. A seeded reset makes the whole
    sequence of draws reproducible; the draws take nothing from the environment's own random stream.
    ``options["parameters"]`` of a reset overrides single values of its draw. ``info["parameters"]`` of reset says what
    is in force.

    Args:
        env: an environment with ``parameters``: one of this package, or
            :class:`~wrappers.randomizable.RandomizablePhysics`, perhaps wrapped further.
        distribution: anything with ``sample(n, rng)`` that gives physical values, (n, d). Its ``space`` says of which
            parameters, the rest stay nominal; without one it draws all of the environment's, in order.

    Raises:
        TypeError: for an environment without ``parameters`` or a distribution without ``sample``.
        ValueError: if the distribution names a parameter that the environment does not have.
    """

    def __init__(self, env: gym.Env, distribution: Sampler):
        # As it is: a user's own may hold a lock or a socket, which cannot be copied.
        RecordConstructorArgs.__init__(self, _disable_deepcopy=True, distribution=distribution)
        super().__init__(env)
        self._draws = EpisodeDraws(_parameters(env), distribution)

    @property
    def distribution(self) -> Sampler:
        """What is drawn from. It may be replaced at any time, and counts from the next episode on."""
        return self._draws.distribution

    @distribution.setter
    def distribution(self, distribution: Sampler) -> None:
        self._draws.distribution = distribution

    def set_distribution(self, distribution: Sampler) -> None:
        """Replace the distribution; for vector environments, whose ``call`` or ``env_method`` reaches methods."""
        self.distribution = distribution

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode with physics of its own."""
        self._draws.seed(seed)
        drawn = self._draws.space.as_dict(self._draws([0])[0])
        given = (options or {}).get("parameters") or {}
        return self.env.reset(seed=seed, options={**(options or {}), "parameters": {**drawn, **given}})


class DistributionVectorWrapper(VectorWrapper, RecordConstructorArgs):
    """Draws the physics of each episode of each world from a distribution.

    Over the native vector environments it draws here, also at autoreset. Over Gymnasium's ``SyncVectorEnv`` and
    ``AsyncVectorEnv``, whose sub-environments must be wrapped in :class:`DistributionWrapper`, it hands the
    distribution to these. Either way, world i of a reset with seed s draws what a :class:`DistributionWrapper` reset
    with seed s + i draws.

    Args:
        env: the vector environment.
        distribution: see :class:`DistributionWrapper`.

    Raises:
        TypeError: for a vector environment that can take ξ in neither way.
        ValueError: if the distribution names a parameter that the environment does not have.
    """

    def __init__(self, env: VectorEnv, distribution: Sampler):
        RecordConstructorArgs.__init__(self, _disable_deepcopy=True, distribution=distribution)
        super().__init__(env)
        base: Any = env.unwrapped
        self._draws: EpisodeDraws | None = None
        if hasattr(base, "parameter_source"):
            self._draws = EpisodeDraws(base.parameters, distribution, env.num_envs)
            base.parameter_source = self._draws
        self.distribution = distribution

    @property
    def distribution(self) -> Sampler:
        """What is drawn from. It may be replaced at any time, and counts from each world's next episode on."""
        return self._distribution

    @distribution.setter
    def distribution(self, distribution: Sampler) -> None:
        if self._draws is not None:
            self._draws.distribution = distribution
        else:
            self._hand_to_sub_environments(distribution)
        self._distribution = distribution

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in every world, or in those of ``options["reset_mask"]``."""
        if self._draws is not None:
            options = dict(options or {})
            mask = options.get("reset_mask")
            worlds = np.arange(self.num_envs) if mask is None else np.flatnonzero(mask)
            self._draws.seed(_seeds_of(worlds, seed, self.num_envs))
            given = options.get("parameters")
            if given is None or isinstance(given, Mapping):
                space = self._draws.space
                xi = np.tile(space.nominal, (self.num_envs, 1))
                xi[worlds] = self._draws(worlds)
                options["parameters"] = {**dict(zip(space.names, xi.T, strict=True)), **(given or {})}
        return self.env.reset(seed=seed, options=options)  # type: ignore[arg-type]  # Gymnasium takes lists as well

    def _hand_to_sub_environments(self, distribution: Sampler) -> None:
        try:
            self.env.unwrapped.call("set_distribution", distribution)  # type: ignore[attr-defined]
        except AttributeError:
            raise TypeError(
                f"{self.env} takes no distribution: it must be a native vector environment of this package, or a Sync- "
                "or AsyncVectorEnv whose sub-environments are wrapped in DistributionWrapper"
            ) from None


def _seeds_of(
    worlds: np.ndarray, seed: int | Sequence[int | None] | None, num_worlds: int
) -> Sequence[int | None] | None:
    """The seeds as given, but for worlds that are not reset: these keep their generators."""
    if seed is None or len(worlds) == num_worlds:
        return seed  # type: ignore[return-value]
    seeds = [seed + i for i in range(num_worlds)] if isinstance(seed, int | np.integer) else seed
    return [seeds[i] if i in worlds else None for i in range(num_worlds)]


def _parameters(env: gym.Env) -> ParameterSpace:
    space = env.get_wrapper_attr("parameters") if env.has_wrapper_attr("parameters") else None
    if not isinstance(space, ParameterSpace):
        raise TypeError(
            f"{env} has no 'parameters' (a ParameterSpace) to draw; "
            "wrap it in RandomizablePhysics(env, parameters) first"
        )
    return space
