"""Means over seeds, with 95 % bootstrap intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simopt_envs.physics.parameters import Array

FEWEST_SEEDS = 5
"""From which a bootstrap over seeds may tell two things apart: where there is no difference, three seeds agree on its
sign one time in four, five one time in sixteen."""
_DRAWS = 10_000


@dataclass(frozen=True)
class Estimate:
    """A mean over seeds.

    Attributes:
        mean: of the seeds.
        low, high: its 95 % interval; NaN where there is none.
        seeds: how many.
    """

    mean: float
    low: float
    high: float
    seeds: int

    def above(self, other: Estimate) -> bool:
        """Whether the whole interval lies above the other's."""
        return self.low > other.high

    def text(self, scale: float = 1.0, digits: int = 1) -> str:
        """As "mean [low, high]", or the mean alone where there is no interval."""
        mean, low, high = (f"{scale * x:.{digits}f}" for x in (self.mean, self.low, self.high))
        return mean if np.isnan(self.low) else f"{mean} [{low}, {high}]"

    @property
    def percent(self) -> str:
        """A share as text."""
        return f"{100 * self.mean:.0f} % [{100 * self.low:.0f}, {100 * self.high:.0f}]"


def mean_of(values: Sequence[float]) -> Estimate:
    """The mean of a number per seed, and the percentile bootstrap over seeds (from two seeds on).

    Raises:
        ValueError: for no values.
    """
    x = _per_seed(values)
    low, high = _interval(_resampled(x, _rng()).mean(axis=1)) if len(x) > 1 else (np.nan, np.nan)
    return Estimate(float(x.mean()), low, high, len(x))


def success_of(rates: Sequence[float], episodes: int) -> Estimate:
    """The mean of a success rate per seed, by a bootstrap of two levels.

    Seeds are drawn with replacement, and each one's true rate from what its episodes tell: Beta(s + 1/2, f + 1/2) for s
    successes and f failures (Jeffreys). So five seeds of 100 % each do not claim that failures are impossible, and one
    seed has an interval too, that of its episodes.

    Args:
        rates: one per seed.
        episodes: that each one was counted over.
    """
    x, rng = _per_seed(rates), _rng()
    successes = episodes * _resampled(x, rng)
    return Estimate(
        float(x.mean()), *_interval(rng.beta(successes + 0.5, episodes - successes + 0.5).mean(axis=1)), len(x)
    )


def _per_seed(values: Sequence[float]) -> Array:
    x = np.asarray(values, dtype=np.float64)
    if x.ndim != 1 or not len(x):
        raise ValueError(f"a mean over seeds needs a number per seed, got {values}")
    return x


def _rng() -> np.random.Generator:
    return np.random.default_rng(0)  # the same results always give the same interval


def _resampled(x: Array, rng: np.random.Generator) -> Array:
    return rng.choice(x, (_DRAWS, len(x)))


def _interval(means: Array) -> tuple[float, float]:
    low, high = np.quantile(means, [0.025, 0.975])
    return float(low), float(high)
