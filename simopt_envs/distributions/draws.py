"""Drawing ξ for the episodes of one or many worlds, reproducibly."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from simopt_envs.distributions.distribution import Sampler
from simopt_envs.physics.parameters import Array, ParameterSpace

# Sets the stream of ξ apart from that of an environment seeded with the same number.
_STREAM = (1810, 5687)


class EpisodeDraws:
    """Draws the ξ of each episode of n worlds, each world from a generator of its own.

    A world's draws depend on its seed and on how many episodes it has begun, not on the other worlds.

    Args:
        space: all parameters of the environment; those that the distribution does not name stay nominal.
        distribution: what to draw from. One that has no ``space`` draws all parameters of the environment, in order.
        num_worlds: n.
        at_once: draw for all worlds that begin an episode together, from one generator: fast for thousands of them,
            and each world's draws then depend on the others.

    Raises:
        ValueError: if the distribution names a parameter that the environment does not have.
        TypeError: if the distribution cannot ``sample``.
    """

    def __init__(self, space: ParameterSpace, distribution: Sampler, num_worlds: int = 1, at_once: bool = False):
        self.at_once = at_once
        self.space = space
        self.num_worlds = num_worlds
        self.distribution = distribution
        self._rngs = [np.random.default_rng() for _ in range(num_worlds)]

    @property
    def distribution(self) -> Sampler:
        """What is drawn from; it may be replaced at any time, and counts from the next episode on."""
        return self._distribution

    @distribution.setter
    def distribution(self, distribution: Sampler) -> None:
        if not isinstance(distribution, Sampler):
            raise TypeError(f"a distribution needs a method sample(n, rng), {type(distribution).__name__} has none")
        names = getattr(distribution, "space", self.space).names
        self._columns = [self.space.index(name) for name in names]
        self._distribution = distribution

    def seed(self, seed: int | Sequence[int | None] | None) -> None:
        """Restart the worlds' generators.

        Args:
            seed: a number s, for s + i in world i as in Gymnasium; one number or None per world; None changes nothing.
        """
        if seed is None:
            return
        seeds = [int(seed) + i for i in range(self.num_worlds)] if isinstance(seed, int | np.integer) else list(seed)
        if len(seeds) != self.num_worlds:
            raise ValueError(f"seed must be one number or {self.num_worlds} of them, got {len(seeds)}")
        for world, number in enumerate(seeds):
            if number is not None:
                self._rngs[world] = np.random.default_rng(np.random.SeedSequence(number, spawn_key=_STREAM))

    def __call__(self, worlds: NDArray[np.intp] | Sequence[int]) -> Array:
        """ξ for k worlds that begin an episode, (k, d) in the order of the environment's space.

        Raises:
            ValueError: if the distribution draws a wrong shape or a value that is not valid.
        """
        xi = np.tile(self.space.nominal, (len(worlds), 1))
        if self.at_once:
            xi[:, self._columns] = self._sample(len(worlds), self._rngs[0])
        else:
            for row, world in enumerate(worlds):
                xi[row, self._columns] = self._sample(1, self._rngs[world])[0]
        return self.space.validate(xi)

    def _sample(self, n: int, rng: np.random.Generator) -> Array:
        draw = np.asarray(self._distribution.sample(n, rng), dtype=np.float64)
        if draw.shape != (n, len(self._columns)):
            raise ValueError(
                f"{type(self._distribution).__name__}.sample({n}, rng) must have shape ({n}, {len(self._columns)}), "
                f"a column for each of {', '.join(self.space.names[c] for c in self._columns)}; got {draw.shape}"
            )
        return draw
