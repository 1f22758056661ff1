"""What p(ξ) must be able to do."""

from __future__ import annotations

from typing import Any, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from simopt_envs.physics.parameters import Array, ParameterSpace


@runtime_checkable
class Sampler(Protocol):
    """The least a distribution needs: enough for the wrappers, which only draw."""

    def sample(self, n: int, rng: np.random.Generator) -> Array:
        """Draw n vectors of physical values, (n, d)."""
        ...


class Distribution(Sampler, Protocol):
    """p(ξ) over a :class:`ParameterSpace`.

    ``sample`` gives physical values, all valid. Everything else speaks of unconstrained coordinates
    (:meth:`ParameterSpace.to_unconstrained`): the logarithm of scale-like quantities, offsets as they are.
    """

    @property
    def space(self) -> ParameterSpace:
        """The parameters, in the order of every array's last axis."""
        ...

    @property
    def mean(self) -> Array:
        """(d,), unconstrained."""
        ...

    @property
    def covariance(self) -> Array:
        """(d, d), unconstrained."""
        ...

    def log_prob(self, x: ArrayLike) -> Array:
        """Log density, over unconstrained coordinates, of physical values (n, d) -> (n,)."""
        ...

    def entropy(self) -> float:
        """Differential entropy over unconstrained coordinates, in nats."""
        ...

    def kl(self, other: Self) -> float:
        """KL(self || other), in nats."""
        ...

    def to_dict(self) -> dict[str, Any]:
        """A description made of what JSON holds."""
        ...

    @classmethod
    def from_dict(cls, description: dict[str, Any], space: ParameterSpace) -> Self:
        """The distribution that ``to_dict`` described, over the parameters of that space that it names."""
        ...
