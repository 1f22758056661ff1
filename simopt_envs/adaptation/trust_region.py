"""Fitting a Gaussian to weighted draws without believing them more than they deserve.

A weighted fit by moments is degenerate in high dimension: with 100 draws that weigh like 20, a covariance of 26
parameters is noise, and repeating it makes every spread collapse whether or not the cost depends on that parameter.
Two safeguards keep the fit sound:

* **Relevance.** Under the hypothesis that the weights have nothing to do with a parameter, the change of its weighted
  moments has a variance that is known exactly (:func:`moment_scores`). How far the changes of all parameters exceed it
  tells, by empirical Bayes, how much of each is signal (:func:`relevance`). A parameter is believed to that degree,
  and the rest of its spread is kept as it was.
* **Trust region.** Of the way from the old Gaussian to that fit, as much is gone as keeps KL(new || old) <= epsilon,
  along the maximisers of ``sum_j w_j log N(z_j) - lambda * KL(old || N)``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solve
from scipy.optimize import bisect
from scipy.special import expit, logit

from simopt_envs.distributions.gaussian import Gaussian
from simopt_envs.physics.parameters import Array

_FLOOR_OF_WIDTH = 1e-3


@dataclass(frozen=True)
class Fit:
    """A fitted Gaussian.

    Attributes:
        distribution: the new Gaussian.
        kl: KL(new || old), in nats.
        relevance: (d,), within [0, 1]: how far each parameter's change was taken for signal.
    """

    distribution: Gaussian
    kl: float
    relevance: Array


def fit_gaussian(old: Gaussian, z: Array, weights: Array, epsilon: float, std_floor: ArrayLike | None = None) -> Fit:
    """Fit a Gaussian to weighted draws of ``old``, within a trust region around it.

    Args:
        old: the Gaussian that was drawn from.
        z: (n, d), the draws, unconstrained.
        weights: (n,), not negative, with sum 1.
        epsilon: bound of KL(new || old), in nats.
        std_floor: a number or (d,): no standard deviation falls below it, unless it was below before. None: a
            thousandth of the width of the parameter's bounds.
    """
    floor = np.minimum(_std_floor(old, std_floor), old.std)
    to_z = _whitening(old)
    white = solve(to_z, (z - old.mean).T).T
    believed = relevance(moment_scores(white, weights))
    mean = believed * (weights @ white)
    centred = white - weights @ white
    covariance = np.outer(believed, believed) * (centred.T * weights @ centred) + np.diag(1 - believed**2)

    def blend(fraction: float) -> tuple[Array, Array]:
        """Mean and covariance, whitened, at fraction = 1 / (1 + lambda) of the way to the fit."""
        new_mean = fraction * mean
        towards_fit = covariance + np.outer(mean - new_mean, mean - new_mean)
        towards_old = np.eye(len(mean)) + np.outer(new_mean, new_mean)
        new_covariance = fraction * towards_fit + (1 - fraction) * towards_old
        missing = floor**2 - np.einsum("ij,jk,ik->i", to_z, new_covariance, to_z)
        if (missing > 0).any():
            from_z = np.linalg.inv(to_z)
            new_covariance = new_covariance + (from_z * np.maximum(missing, 0)) @ from_z.T
        return new_mean, new_covariance

    def excess(fraction: float) -> float:
        return _kl_from_standard(*blend(fraction)) - epsilon

    fraction = 1.0 if excess(1.0) <= 0 else float(bisect(excess, 0.0, 1.0, xtol=1e-13))
    new_mean, new_covariance = blend(fraction)
    new = Gaussian(old.space, old.mean + to_z @ new_mean, _symmetric(to_z @ new_covariance @ to_z.T))
    return Fit(new, max(new.kl(old), 0.0), believed)


def moment_scores(white: Array, weights: Array) -> Array:
    """How much weighting changes the mean and the spread of each coordinate, in units of chance.

    If the weights were dealt out to the draws at random, the weighted mean of any function f of the draws would vary
    around the plain mean with variance ``(sum_j w_j^2 - 1 / n) var(f)``, var being the sample variance.

    Args:
        white: (n, d), draws with about unit variance.
        weights: (n,), with sum 1.

    Returns:
        (d,): squared scores of mean and of spread, summed; by chance about chi-squared with 2 degrees of freedom.
    """
    n = len(white)
    excess = float(np.sum(weights**2) - 1 / n)
    if excess < 1e-12:  # equal weights say nothing
        return np.zeros(white.shape[1])
    scores = np.zeros(white.shape[1])
    for f in (white, (white - white.mean(axis=0)) ** 2):
        variance = excess * f.var(axis=0, ddof=1)
        change = weights @ f - f.mean(axis=0)
        scores += np.divide(change**2, variance, out=np.zeros_like(change), where=variance > 0)
    return scores


def relevance(scores: Array, iterations: int = 100) -> Array:
    """How much of each coordinate's change is signal, (d,) -> (d,) within [0, 1].

    Empirical Bayes with two groups: an unknown share of the coordinates carries a signal of unknown size on top of
    unit noise in both moments, the others noise alone. Expectation maximisation finds share and size; the result is the
    posterior shrinkage of each coordinate. So one strong parameter among many is told from the rest, and many
    weak ones are recognised together, without a threshold to choose.

    Args:
        scores: what :func:`moment_scores` gave.
        iterations: of expectation maximisation.
    """
    share, size = 0.5, 3.0  # of the informative group: its prior probability, its signal-to-noise variance
    for _ in range(iterations):
        kept = size / (1 + size)
        informative = expit(logit(share) - np.log1p(size) + scores / 2 * kept)
        share = (informative.sum() + 0.5) / (len(scores) + 1)  # + 0.5: Jeffreys prior, so that it never is 0 or 1
        size = max(float(informative @ scores / (2 * informative.sum())) - 1, 0.0)
    return informative * (size / (1 + size))


def _whitening(old: Gaussian) -> Array:
    """The matrix A with ``z = mean + A white``, the one that keeps each white coordinate nearest its parameter.

    Zero-phase (ZCA-cor) whitening; the Cholesky factor would depend on the order of the parameters.
    """
    eigenvalues, vectors = np.linalg.eigh(old.correlation)
    return old.std[:, None] * (vectors * np.sqrt(eigenvalues)) @ vectors.T


def _std_floor(old: Gaussian, std_floor: ArrayLike | None) -> Array:
    if std_floor is not None:
        floor = np.asarray(std_floor, dtype=np.float64)
        if floor.shape not in ((), old.mean.shape) or not (floor >= 0).all():
            raise ValueError(f"std_floor must be a number or {old.mean.shape}, not negative, got {std_floor}")
        return floor
    space = old.space
    width = space.to_unconstrained(space.high) - space.to_unconstrained(space.low)
    return np.where(np.isfinite(width), _FLOOR_OF_WIDTH * width, 0.0)


def _kl_from_standard(mean: Array, covariance: Array) -> float:
    """KL(N(mean, covariance) || N(0, I)); infinite for a singular covariance."""
    sign, log_determinant = np.linalg.slogdet(covariance)
    if sign <= 0:
        return np.inf
    return float(0.5 * (np.trace(covariance) + mean @ mean - len(mean) - log_determinant))


def _symmetric(matrix: Array) -> Array:
    return (matrix + matrix.T) / 2
