"""How far simulated rollouts are from measured ones, and how much of that is measurement noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter1d

from simopt_envs.adaptation.rollouts import Rollouts
from simopt_envs.measured.trajectory import Trajectory
from simopt_envs.physics.parameters import Array


@dataclass(frozen=True)
class Discrepancy:
    """The cost of ξ: Eq. 4 of Chebotar et al. 2019, averaged over the measured rollouts.

    D = l1 Σ_t |W d_t|_1 + l2 Σ_t ||W d_t||_2^2, where d is the difference between the simulated and the measured
    observations after a Gaussian filter over time.

    * A measured value that is missing (NaN) counts for nothing, in the filter and in the sums.
    * Episodes of unequal lengths are compared over the steps that both have; the sum is then scaled to the measured
      length, so that a simulation does not gain by ending early.
    * A simulation that diverged costs infinity.

    Attributes:
        weights: W, one per observed channel. None: those that the simulator states, else ones.
        l1: weight of the absolute values.
        l2: weight of the squares.
        filter_std: standard deviation of the filter in steps; 0 for none.
        filter_truncate: the filter ends at so many standard deviations.
        previous_step_weights: weights of the observations one step before, as further channels of each step (the
            paper's swing-peg task); None for none.

    Raises:
        ValueError: for weights that are negative, not finite or all zero.
    """

    weights: Sequence[float] | None = None
    l1: float = 0.5
    l2: float = 1.0
    filter_std: float = 5.0
    filter_truncate: float = 4.0
    previous_step_weights: Sequence[float] | None = None

    def __post_init__(self) -> None:
        for name in ("weights", "previous_step_weights"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, tuple(_non_negative(name, getattr(self, name)).tolist()))
        _non_negative("l1 and l2", [self.l1, self.l2])
        if not (np.isfinite(self.filter_std) and self.filter_std >= 0 and self.filter_truncate > 0):
            raise ValueError(
                f"filter_std must be >= 0 and filter_truncate > 0, got {self.filter_std} and {self.filter_truncate}"
            )

    def for_channels(self, names: Sequence[str], default: ArrayLike | None) -> Discrepancy:
        """With ``weights`` filled in, for an observation of these channels; ValueError where their number differs."""
        complete = self
        if self.weights is None:
            stated = np.ones(len(names)) if default is None else np.asarray(default, dtype=np.float64)
            complete = replace(self, weights=tuple(stated.tolist()))
        for given in (complete.weights, complete.previous_step_weights):
            if given is not None and len(given) != len(names):
                raise ValueError(
                    f"discrepancy weights must be one per observed channel, {len(names)} ({', '.join(names)}),"
                    f" got {len(given)}"
                )
        return complete

    def __call__(self, simulated: Rollouts, real: Sequence[Trajectory]) -> Array:
        """Costs (n,) of n ξ from rollouts with leading axes (n, r) and the r measured episodes they repeat."""
        total = np.zeros(len(simulated.observations))
        for j, trajectory in enumerate(real):
            total += self._costs(simulated.observations[:, j], simulated.lengths[:, j], trajectory.observations)
        return np.where(simulated.diverged.any(axis=1), np.inf, total / len(real))

    def _costs(self, simulated: Array, lengths: NDArray[np.int64], real: Array) -> Array:
        """Costs (n,) of n simulated (n, T' + 1, o) against one measured (T + 1, o) episode."""
        costs = np.empty(len(simulated))
        ends = np.minimum(lengths + 1, len(real))
        for end in np.unique(ends):
            episodes, measured = simulated[ends == end, :end], real[:end]
            counted = np.isfinite(measured)
            valid = np.all(np.isfinite(episodes), axis=(1, 2), keepdims=True)
            difference = np.where(counted & valid, episodes - measured, 0.0)
            costs[ends == end] = np.where(
                valid[:, 0, 0], self.of_difference(difference, counted) * len(real) / end, np.inf
            )
        return costs

    def of_difference(self, difference: Array, counted: NDArray[np.bool_]) -> Array:
        """The cost (n,) of finite differences (n, T + 1, o), of which those of ``counted`` (T + 1, o) count."""
        smooth = np.where(counted, self._filter(difference, counted), 0.0)
        weights = np.ones(difference.shape[-1]) if self.weights is None else np.array(self.weights)
        cost = self._weigh(smooth, weights)
        if self.previous_step_weights is not None:
            cost += self._weigh(smooth[:, :-1], np.array(self.previous_step_weights))
        return cost

    def _filter(self, difference: Array, counted: NDArray[np.bool_]) -> Array:
        """Normalised convolution: the weighted mean of the differences that count."""
        if self.filter_std == 0:
            return difference
        smooth, mass = (
            gaussian_filter1d(x, self.filter_std, axis=-2, mode="constant", truncate=self.filter_truncate)
            for x in (np.where(counted, difference, 0.0), counted.astype(np.float64))
        )
        return smooth / np.maximum(mass, np.finfo(np.float64).tiny)

    def _weigh(self, smooth: Array, weights: Array) -> Array:
        weighted = np.abs(smooth) * weights
        return self.l1 * weighted.sum(axis=(1, 2)) + self.l2 * np.square(weighted).sum(axis=(1, 2))

    def of_noise(self, real: Sequence[Trajectory], rng: np.random.Generator, draws: int = 200) -> Array:
        """Costs (draws,) that a perfect simulation would have: those of the measurement noise alone.

        The noise of each channel is estimated from the trajectories (:func:`noise_std`), drawn anew and sent through
        the same filter and weights. The simulation starts from the first measured observation and keeps its error.
        """
        std = noise_std(real)
        total = np.zeros(draws)
        for trajectory in real:
            noise = std * rng.standard_normal((draws, *trajectory.observations.shape))
            total += self.of_difference(noise - noise[:, :1], np.isfinite(trajectory.observations))
        return total / len(real)

    def of_motion(self, real: Sequence[Trajectory]) -> float:
        """The cost of the crudest model: nothing moves from the first observation on."""
        total = 0.0
        for trajectory in real:
            counted = np.isfinite(trajectory.observations)
            motion = np.where(counted, trajectory.observations - trajectory.observations[0], 0.0)
            total += float(self.of_difference(motion[None], counted)[0])
        return total / len(real)


def noise_std(real: Sequence[Trajectory]) -> Array:
    """Standard deviation (o,) of the noise that is independent from step to step, from the trajectories alone.

    Third differences over time remove the smooth motion and scale white noise by √20; the median of their absolute
    values is not misled by the few that a contact makes large.
    """
    third = np.concatenate([np.diff(trajectory.observations, 3, axis=0) for trajectory in real])
    finite = np.isfinite(third)
    size = np.array([np.median(np.abs(x[f])) if f.any() else 0.0 for x, f in zip(third.T, finite.T, strict=True)])
    return size / (0.6745 * np.sqrt(20.0))


@dataclass(frozen=True)
class Verdict:
    """Whether some ξ that p(ξ) reaches explains the measured rollouts.

    Attributes:
        label: "explained": the best ξ drawn is as close as noise allows. "uninformative": so is nearly every ξ drawn,
            and these rollouts cannot tell them apart. "unexplained": none is; either p(ξ) has not arrived yet or, if
            it no longer moves, the real system does what no ξ can express.
        best: lowest cost of a ξ drawn.
        noise: cost of the measurement noise alone, its 95 % quantile; 0 where motion is too quick to tell noise from.
        motion: cost of a model in which nothing moves.
        threshold: costs up to here count as explained.
    """

    label: Literal["explained", "unexplained", "uninformative"]
    best: float
    noise: float
    motion: float
    threshold: float

    def __str__(self) -> str:
        noise = f"{self.noise:.3g}" if self.noise else "unknown"
        return (
            f"{self.label}: best cost {self.best:.3g}, explained up to {self.threshold:.3g}"
            f" (noise alone {noise}, no motion {self.motion:.3g})"
        )


def judge(
    discrepancy: Discrepancy,
    costs: Array,
    real: Sequence[Trajectory],
    rng: np.random.Generator,
    noise_factor: float = 3.0,
    motion_fraction: float = 0.01,
) -> Verdict:
    """Compare the costs (n,) of ξ drawn from p(ξ) with those of noise alone and of no motion at all.

    Args:
        discrepancy: what the costs were measured by.
        costs: of the ξ drawn; infinite where the simulation diverged.
        real: the measured episodes.
        rng: draws noise.
        noise_factor: a cost up to so many times that of noise is explained: a finite number of draws never hits the
            best ξ, and a policy in closed loop reacts to the noise.
        motion_fraction: so is a cost up to this fraction of that of no motion, which matters where there is no noise.
    """
    least, noise = np.quantile(discrepancy.of_noise(real, rng), [0.01, 0.95]).tolist()
    motion = discrepancy.of_motion(real)
    if least > motion:  # measurements with such noise would hardly differ so little: it was quick motion
        noise = 0.0
    threshold = max(noise_factor * noise, motion_fraction * motion)
    finite = costs[np.isfinite(costs)]
    best = float(finite.min(initial=np.inf))
    if best > threshold:
        label: Literal["explained", "unexplained", "uninformative"] = "unexplained"
    elif np.quantile(finite, 0.95) <= noise_factor * noise:
        label = "uninformative"
    else:
        label = "explained"
    return Verdict(label, best, noise, motion, threshold)


def _non_negative(name: str, values: ArrayLike) -> Array:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 1 or not (np.isfinite(array) & (array >= 0)).all() or not array.any():
        raise ValueError(f"{name} must be numbers >= 0, not all zero, got {array}")
    return array
