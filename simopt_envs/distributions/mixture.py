"""Mixtures: p(ξ) with several modes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import logsumexp

from simopt_envs.distributions.distribution import Distribution
from simopt_envs.distributions.gaussian import Gaussian
from simopt_envs.distributions.uniform import Uniform
from simopt_envs.physics.parameters import Array, ParameterSpace, unknown_name

_MONTE_CARLO_DRAWS = 20_000


class Mixture:
    """A weighted mixture of distributions over one space.

    Moments and densities are exact. Entropy and KL have no closed form: they are means over 20 000 draws of a
    generator seeded the same each time, so that they are reproducible, with an error of about 1 % of a nat.

    Args:
        weights: (k,), > 0; they are normalised to sum to 1.
        components: k distributions over equal spaces.

    Raises:
        ValueError: for weights that are not positive and finite, or components over different spaces.
    """

    kind = "mixture"

    def __init__(self, weights: ArrayLike, components: Sequence[Distribution]):
        weights = np.array(weights, dtype=np.float64)
        if not components or weights.shape != (len(components),):
            raise ValueError(f"a mixture needs one weight per component, got {weights.shape} for {len(components)}")
        if not (np.isfinite(weights) & (weights > 0)).all():
            raise ValueError(f"mixture weights must be positive and finite, got {weights}")
        if any(c.space != components[0].space for c in components):
            raise ValueError(f"components must share one space, got {[c.space.names for c in components]}")
        self.weights: Array = weights / weights.sum()
        self.components: tuple[Distribution, ...] = tuple(components)
        self.space: ParameterSpace = components[0].space

    @property
    def mean(self) -> Array:
        """(d,), unconstrained."""
        return np.einsum("k,ki->i", self.weights, [c.mean for c in self.components])

    @property
    def covariance(self) -> Array:
        """(d, d), unconstrained: the mean of the components' covariances plus the covariance of their means."""
        shifts = np.array([c.mean for c in self.components]) - self.mean
        within = np.einsum("k,kij->ij", self.weights, [c.covariance for c in self.components])
        return within + np.einsum("k,ki,kj->ij", self.weights, shifts, shifts)

    def sample(self, n: int, rng: np.random.Generator) -> Array:
        """Draw n vectors of physical values, (n, d)."""
        counts = rng.multinomial(n, self.weights)
        draws = [c.sample(int(count), rng) for c, count in zip(self.components, counts, strict=True)]
        return rng.permutation(np.concatenate(draws))

    def log_prob(self, x: ArrayLike) -> Array:
        """Log density, over unconstrained coordinates, of physical values (n, d) -> (n,)."""
        terms = np.stack([c.log_prob(x) for c in self.components])
        return logsumexp(terms, axis=0, b=self.weights.reshape(-1, *[1] * (terms.ndim - 1)))

    def entropy(self) -> float:
        """Differential entropy over unconstrained coordinates, in nats, by Monte Carlo."""
        return float(-np.mean(self.log_prob(self._reference_draws())))

    def kl(self, other: Distribution) -> float:
        """KL(self || other) in nats, by Monte Carlo; the other may be of any kind.

        Raises:
            ValueError: if the other is over other parameters.
        """
        if other.space != self.space:
            raise ValueError(f"the KL divergence needs equal spaces, got {self.space.names} and {other.space.names}")
        x = self._reference_draws()
        return float(np.mean(self.log_prob(x) - other.log_prob(x)))

    def to_dict(self) -> dict[str, Any]:
        """A description made of what JSON holds."""
        return {
            "kind": self.kind,
            "weights": self.weights.tolist(),
            "components": [c.to_dict() for c in self.components],
        }

    @classmethod
    def from_dict(cls, description: dict[str, Any], space: ParameterSpace) -> Self:
        """The Mixture that :meth:`to_dict` described, over the parameters of ``space`` that it names."""
        components = [distribution_from_dict(component, space) for component in description["components"]]
        return cls(description["weights"], components)

    def _reference_draws(self) -> Array:
        return self.sample(_MONTE_CARLO_DRAWS, np.random.default_rng(0))


_KINDS: dict[str, type[Gaussian] | type[Uniform] | type[Mixture]] = {
    kind.kind: kind for kind in (Gaussian, Uniform, Mixture)
}


def distribution_from_dict(description: dict[str, Any], space: ParameterSpace) -> Distribution:
    """The distribution of any kind that a ``to_dict`` described.

    Args:
        description: what ``to_dict`` gave, perhaps by way of JSON.
        space: a space with at least the parameters that it names.

    Raises:
        ValueError: for an unknown kind, a missing entry, or a parameter that the space does not have.
    """
    kind = description.get("kind")
    if kind not in _KINDS:
        raise ValueError(unknown_name("kind of distribution", kind, _KINDS))
    try:
        return _KINDS[kind].from_dict(description, space)
    except KeyError as missing:
        raise ValueError(f"the description of a {kind} distribution lacks {missing}") from None
