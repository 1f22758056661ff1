"""The uniform distribution of ξ: plain domain randomization."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from simopt_envs.physics.parameters import Array, ParameterSpace


class Uniform:
    """Independent parameters, each uniform over an interval of its unconstrained coordinate.

    So scale-like quantities are log-uniform: from half to twice the nominal, either side is as likely.

    Args:
        space: the d parameters.
        low, high: (d,) physical ends of the intervals, within the parameters' bounds.

    Raises:
        ValueError: for ends of a wrong shape, not finite, out of bounds, or an interval without width.
    """

    kind = "uniform"

    def __init__(self, space: ParameterSpace, low: ArrayLike, high: ArrayLike):
        self.space = space
        self.low: Array = space.validate(low)
        self.high: Array = space.validate(high)
        if self.low.ndim != 1 or self.high.ndim != 1:
            raise ValueError(
                f"low and high must have shape ({len(space)},), got {self.low.shape} and {self.high.shape}"
            )
        for name, a, b in zip(space.names, self.low, self.high, strict=True):
            if not a < b:
                raise ValueError(f"parameter {name!r}: low must be less than high, got {a:g} and {b:g}")
        self._z_low = space.to_unconstrained(self.low)
        self._z_width = space.to_unconstrained(self.high) - self._z_low

    @property
    def mean(self) -> Array:
        """(d,), unconstrained."""
        return self._z_low + self._z_width / 2

    @property
    def covariance(self) -> Array:
        """(d, d), unconstrained."""
        return np.diag(self._z_width**2 / 12)

    def sample(self, n: int, rng: np.random.Generator) -> Array:
        """Draw n vectors of physical values, (n, d)."""
        z = self._z_low + self._z_width * rng.random((n, len(self.space)))
        return np.clip(self.space.from_unconstrained(z), self.low, self.high)  # exp(log(x)) may round past x

    def log_prob(self, x: ArrayLike) -> Array:
        """Log density, over unconstrained coordinates, of physical values (n, d) -> (n,)."""
        x = np.asarray(x, dtype=np.float64)
        self.space.to_unconstrained(x)  # explains a wrong shape
        inside = ((x >= self.low) & (x <= self.high)).all(axis=-1)
        return np.where(inside, -self.entropy(), -np.inf)

    def entropy(self) -> float:
        """Differential entropy over unconstrained coordinates, in nats."""
        return float(np.sum(np.log(self._z_width)))

    def kl(self, other: Uniform) -> float:
        """KL(self || other) in nats; infinite unless the other's box holds this one.

        Raises:
            TypeError: if the other is not a Uniform.
            ValueError: if it is one over other parameters.
        """
        if not isinstance(other, Uniform):
            raise TypeError(f"the KL divergence of a Uniform needs a Uniform, got {type(other).__name__}")
        if other.space != self.space:
            raise ValueError(f"the KL divergence needs equal spaces, got {self.space.names} and {other.space.names}")
        if (self.low < other.low).any() or (self.high > other.high).any():
            return float("inf")
        return other.entropy() - self.entropy()

    def to_dict(self) -> dict[str, Any]:
        """A description made of what JSON holds."""
        return {
            "kind": self.kind,
            "parameters": list(self.space.names),
            "low": self.low.tolist(),
            "high": self.high.tolist(),
        }

    @classmethod
    def from_dict(cls, description: dict[str, Any], space: ParameterSpace) -> Self:
        """The Uniform that :meth:`to_dict` described, over the parameters of ``space`` that it names."""
        return cls(space.subset(description["parameters"]), description["low"], description["high"])
