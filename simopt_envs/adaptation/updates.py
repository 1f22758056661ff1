"""Updates of p(ξ) from the costs of its draws (line 8 of the paper's Algorithm 1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq
from scipy.special import rel_entr, softmax

from simopt_envs.adaptation.trust_region import fit_gaussian
from simopt_envs.distributions.gaussian import Gaussian
from simopt_envs.physics.parameters import Array


@dataclass(frozen=True)
class UpdateResult:
    """What an update made of n draws and their costs.

    Attributes:
        distribution: the new p(ξ).
        kl: realised KL(new || old), in nats.
        effective_sample_size: ``1 / sum(weights**2)``: how many draws of equal weight say as much.
        weights: (n,), with sum 1; 0 for draws whose cost is not finite.
        relevance: (d,), within [0, 1]: how far the costs speak about each parameter;
            see :mod:`simopt_envs.adaptation.trust_region`.
        temperature: of the weights, in units of the cost; None where a rule has none.
    """

    distribution: Gaussian
    kl: float
    effective_sample_size: float
    weights: Array
    relevance: Array
    temperature: float | None = None


class Update(Protocol):
    """A rule that moves p(ξ) towards ξ of low cost."""

    def __call__(
        self,
        distribution: Gaussian,
        xi: ArrayLike,
        costs: ArrayLike,
        rng: np.random.Generator,
        std_floor: ArrayLike | None = None,
    ) -> UpdateResult:
        """Update a distribution.

        Args:
            distribution: the old p(ξ).
            xi: draws of it, physical values, (n, d).
            costs: their costs, (n,); a draw whose cost is not finite does not count.
            rng: for rules that draw.
            std_floor: a number or (d,), unconstrained: no standard deviation falls below it, unless it was below
                before. None: a thousandth of the width of the parameter's bounds.

        Raises:
            ValueError: for wrong shapes, or if no cost is finite.
        """
        ...


@dataclass(frozen=True)
class REPS:
    """Relative entropy policy search (Peters et al. 2010), the paper's rule.

    The weights minimise the expected cost while their KL divergence from equal weights is at most epsilon; a Gaussian
    is then fitted to the weighted draws such that the divergence of the *fitted* Gaussian from the old one obeys the
    bound too.

    Attributes:
        epsilon: KL bound of a step, in nats.
        minimum_temperature: of the weights, in units of the cost.
    """

    epsilon: float = 1.0
    minimum_temperature: float = 0.001

    def __post_init__(self) -> None:
        """Raise ValueError for numbers that make no sense."""
        _require_positive(epsilon=self.epsilon, minimum_temperature=self.minimum_temperature)

    def __call__(
        self,
        distribution: Gaussian,
        xi: ArrayLike,
        costs: ArrayLike,
        rng: np.random.Generator,
        std_floor: ArrayLike | None = None,
    ) -> UpdateResult:
        """See :meth:`Update.__call__`."""
        z, costs, valid = _valid_draws(distribution, xi, costs)
        temperature = reps_temperature(costs, self.epsilon, self.minimum_temperature)
        weights = softmax(-costs / temperature)
        return _result(distribution, z, weights, valid, self.epsilon, std_floor, temperature)


@dataclass(frozen=True)
class CEM:
    """The cross-entropy method: the best draws weigh alike, the others nothing.

    It looks at the order of the costs alone, so outliers and the cost's scale do not matter.

    Attributes:
        elite_fraction: share of the draws that count, rounded up.
        epsilon: KL bound of a step, in nats.
    """

    elite_fraction: float = 0.2
    epsilon: float = 1.0

    def __post_init__(self) -> None:
        """Raise ValueError for numbers that make no sense."""
        _require_positive(epsilon=self.epsilon, elite_fraction=self.elite_fraction)
        if self.elite_fraction > 1:
            raise ValueError(f"elite_fraction must be at most 1, got {self.elite_fraction}")

    def __call__(
        self,
        distribution: Gaussian,
        xi: ArrayLike,
        costs: ArrayLike,
        rng: np.random.Generator,
        std_floor: ArrayLike | None = None,
    ) -> UpdateResult:
        """See :meth:`Update.__call__`."""
        z, costs, valid = _valid_draws(distribution, xi, costs)
        last_elite = np.sort(costs)[int(np.ceil(self.elite_fraction * len(costs))) - 1]
        elite = costs <= last_elite  # all that tie with the last: equal costs leave the distribution as it is
        return _result(distribution, z, elite / elite.sum(), valid, self.epsilon, std_floor)


def reps_temperature(costs: Array, epsilon: float, minimum: float) -> float:
    """The temperature that minimises the dual of REPS, not less than a minimum.

    The dual ``g(t) = t epsilon + t log mean exp(-costs / t)`` is convex, and its derivative is epsilon minus the KL
    divergence of the weights ``exp(-costs / t)`` from equal ones, which falls with t: so its minimum is where the
    divergence equals epsilon.

    Args:
        costs: (n,), finite.
        epsilon: KL bound, in nats.
        minimum: least temperature, in units of the cost.
    """

    def excess(log_temperature: float) -> float:
        weights = softmax(-costs / np.exp(log_temperature))
        return float(np.sum(rel_entr(weights, 1 / len(costs)))) - epsilon

    if excess(np.log(minimum)) <= 0:
        return minimum
    enough = np.ptp(costs) / np.sqrt(8 * epsilon)  # by Hoeffding's lemma the divergence is at most epsilon there
    return float(np.exp(brentq(excess, np.log(minimum), np.log(enough) + 1e-6, xtol=1e-12)))


def _valid_draws(distribution: Gaussian, xi: ArrayLike, costs: ArrayLike) -> tuple[Array, Array, Array]:
    """Coordinates and costs of the draws whose cost is finite, and which of all these are."""
    xi, costs = np.asarray(xi, dtype=np.float64), np.asarray(costs, dtype=np.float64)
    if costs.ndim != 1 or xi.shape != (len(costs), len(distribution.space)):
        raise ValueError(
            f"an update needs xi (n, {len(distribution.space)}) and costs (n,), got {xi.shape} and {costs.shape}"
        )
    valid = np.isfinite(costs)
    if not valid.any():
        raise ValueError(f"none of the {len(costs)} costs is finite: no simulated rollout can be compared")
    z = distribution.space.to_unconstrained(xi[valid])
    if not np.isfinite(z).all():
        raise ValueError("xi holds values that are not valid physics (not finite, or not positive where they must be)")
    return z, costs[valid], valid


def _result(
    old: Gaussian,
    z: Array,
    weights: Array,
    valid: Array,
    epsilon: float,
    std_floor: ArrayLike | None,
    temperature: float | None = None,
) -> UpdateResult:
    fit = fit_gaussian(old, z, weights, epsilon, std_floor)
    all_weights = np.zeros(len(valid))
    all_weights[valid] = weights
    return UpdateResult(
        fit.distribution, fit.kl, float(1 / np.sum(weights**2)), all_weights, fit.relevance, temperature
    )


def _require_positive(**numbers: float) -> None:
    for name, number in numbers.items():
        if not (np.isfinite(number) and number > 0):
            raise ValueError(f"{name} must be positive and finite, got {number}")
