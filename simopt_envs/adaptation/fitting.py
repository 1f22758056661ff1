"""Updates of p(ξ) by fits to recordings: least squares and CMA-ES, each with a Laplace covariance.

Rules that weigh draws (:mod:`simopt_envs.adaptation.updates`) work with any simulator and cost. Where recordings are
replayed, more is known: every error of every sample, and what it would be for another ξ. The rules here find the most
probable ξ of

    log p(ξ | data) = -1/2 Σ |C^(-1/2) (simulated - measured)|² + log p(ξ),

and take the inverse of its Gauss-Newton Hessian there for the covariance. C holds what the errors of the estimated
starts leave in a window, and other errors whose size is found by fitting a few times (:class:`Noise`). The errors
within a window go together, so that S samples say less than S independent numbers; that size counts for it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from typing import Any

import mujoco
import numpy as np
from mujoco import minimize
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import qr, solve_triangular

from simopt_envs.adaptation.updates import UpdateResult
from simopt_envs.distributions.gaussian import Gaussian
from simopt_envs.measured.replay import start_sensitivity
from simopt_envs.measured.windows import Windows, WindowSimulator
from simopt_envs.physics.parameters import Array

_DIFFERENCE = 1e-3  # of the prior's standard deviation: well above the tolerance of MuJoCo's constraint solver
_DIVERGED = 10.0  # the error of a sample that the simulation did not reach, in standard deviations of its channel
_NOISE_ITERATIONS = 10
_UNTOLD = 0.5  # a direction whose variance the data leave above this share of the prior's is one they hardly tell
_NAMED = 0.25  # in such a direction parameters below this share of the largest are not named


@dataclass(frozen=True)
class Noise:
    """What errors in windows a right model may leave: those of its starts, and others of one size per channel.

    Attributes:
        scale: (c,), what one of the others is divided by.
        basis: (w, S c, k), orthonormal, in units of the scale: the errors that wrong starts make.
        shrink: (w, k), how much of those is taken out, within [0, 1].
    """

    scale: Array
    basis: Array
    shrink: Array

    @classmethod
    def of(cls, scale: Array, starts: Array) -> Noise:
        """From a scale (c,) and the columns (k, w, S, c) of a root of the covariance that uncertain starts leave."""
        columns = np.moveaxis((starts / scale).reshape(*starts.shape[:2], -1), 0, -1)
        basis, size, _ = np.linalg.svd(columns, full_matrices=False)
        return cls(scale, basis, 1 - 1 / np.sqrt(1 + size**2))

    @property
    def log_det(self) -> Array:
        """Of each window's covariance, in units of the scale, (w,)."""
        return -2 * np.sum(np.log1p(-self.shrink), axis=1)

    def select(self, rows: NDArray[np.intp]) -> Noise:
        """That of some windows, in the order given."""
        return Noise(self.scale, self.basis[rows], self.shrink[rows])

    def replaced(self, rows: NDArray[np.bool_], other: Noise) -> Noise:
        """This noise, but another of the same scale in some windows, (w,)."""
        width = max(noise.shrink.shape[1] for noise in (self, other))

        def widened(values: Array) -> Array:  # by directions in which nothing is taken out
            return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, width - values.shape[-1])])

        basis = np.where(rows[:, None, None], widened(other.basis), widened(self.basis))
        shrink = np.where(rows[:, None], widened(other.shrink), widened(self.shrink))
        return Noise(self.scale, basis, shrink)

    def whiten(self, errors: Array) -> Array:
        """Errors (n, w, S, c) -> independent ones of variance 1, (n, w, S, c)."""
        flat = (errors / self.scale).reshape(*errors.shape[:2], -1)
        made_by_starts = np.einsum("wmk,nwm->nwk", self.basis, flat)
        return (flat - np.einsum("wmk,nwk->nwm", self.basis, self.shrink * made_by_starts)).reshape(errors.shape)


class WindowMisfit:
    """How far a model's windows are from the measured ones, for a fit.

    Its coordinates u count the prior's standard deviations from the prior's mean, so that steps in all are alike.

    Args:
        model: the model.
        windows: of recordings.
        prior: p(ξ) before the data.
        num_threads: 0 for one per core.

    Attributes:
        rollouts: windows simulated so far.
    """

    def __init__(self, model: mujoco.MjModel, windows: Windows, prior: Gaussian, num_threads: int = 0):
        self.prior, self.rollouts = prior, 0
        self._model, self._windows = model, windows
        self._simulator = WindowSimulator(model, windows, prior.space, num_threads)
        space = prior.space
        self.bounds = [self.coordinates(space.to_unconstrained(bound)) for bound in (space.low, space.high)]
        self._counted = np.isfinite(windows.measured)
        self._prior_root = np.linalg.cholesky(prior.correlation)

    def xi(self, u: Array) -> Array:
        """Coordinates (..., d) -> physical values, within the bounds."""
        space = self.prior.space
        return np.clip(space.from_unconstrained(self.prior.mean + self.prior.std * u), space.low, space.high)

    def coordinates(self, z: Array) -> Array:
        """Unconstrained coordinates of the space -> u."""
        return (z - self.prior.mean) / self.prior.std

    def errors(self, u: Array) -> Array:
        """Simulated minus measured, (n, d) -> (n, w, S, c); 0 where nothing was measured."""
        self.rollouts += len(u) * len(self._windows)
        errors = self._simulator(self.xi(u)) - self._windows.measured
        diverged = np.isnan(errors) & self._counted
        return np.where(diverged, _DIVERGED * self._windows.channel_scale(), np.where(self._counted, errors, 0.0))

    def noise(self, u: Array) -> Noise:
        """The noise that makes the errors at u (d,) plausible.

        The scale is the root of the mean square, times the root of the number of samples that say as much as one
        independent number: as many as the means of the windows vary more than those of independent errors would.
        """
        errors = self.errors(u[None])
        starts = start_sensitivity(self._model, self._simulator, self.xi(u[None]))
        self.rollouts += (len(starts) + 1) * len(self._windows)
        starts = np.where(self._counted, np.nan_to_num(starts), 0.0)
        least = self._windows.least_noise()
        scale = np.maximum(self._rms(errors[0]), least)
        for _ in range(_NOISE_ITERATIONS):  # the larger the scale, the less is laid to the starts
            white = Noise.of(scale, starts).whiten(errors)[0]
            scale = np.maximum(scale * self._rms(white), least)
        samples, of_means = white.shape[1], np.sqrt(np.mean(white.mean(axis=1) ** 2, axis=0))
        alike = np.sqrt(samples) * np.divide(of_means, self._rms(white), out=np.zeros_like(scale), where=of_means > 0)
        return Noise.of(scale * np.clip(alike, 1, np.sqrt(samples)), starts)

    def _rms(self, errors: Array) -> Array:
        """Root of the mean square over the measured samples of each channel, (w, S, c) -> (c,)."""
        return np.sqrt(np.mean(errors**2, axis=(0, 1), where=self._counted))

    def residuals(self, u: Array, noise: Noise) -> Array:
        """Of the data, then of the prior, (n, d) -> (n, m); half their sum of squares is -log p(ξ | data)."""
        data = noise.whiten(self.errors(u)).reshape(len(u), -1)
        return np.hstack([data, solve_triangular(self._prior_root, u.T, lower=True).T])

    def laplace(self, u: Array) -> Gaussian:
        """The Gaussian at u (d,) with the inverse Gauss-Newton Hessian there for covariance."""
        noise = self.noise(u)
        inside = np.clip(u, self.bounds[0] + _DIFFERENCE, self.bounds[1] - _DIFFERENCE)
        step = _DIFFERENCE * np.eye(len(u))
        forward, backward = np.split(self.residuals(np.concatenate([inside + step, inside - step]), noise), 2)
        jacobian = (forward - backward) / (2 * _DIFFERENCE)
        covariance = np.linalg.inv(jacobian @ jacobian.T)
        std = self.prior.std
        return Gaussian(self.prior.space, self.prior.mean + std * u, np.outer(std, std) * covariance)


@dataclass(frozen=True)
class WindowFit(ABC):
    """A fit to windows, which is also an :class:`~simopt_envs.adaptation.updates.Update`.

    As an update it ignores the draws, and starts from its prior each time: one update is the whole fit.

    Attributes:
        misfit: to be made small.
        rounds: fits, each with the noise that the one before left.
    """

    misfit: WindowMisfit
    rounds: int = 3

    def identity(self) -> dict[str, Any]:
        """What identifies it in a checkpoint; the simulator and the real system tell of the rest."""
        settings = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "misfit"}
        return {"type": type(self).__name__, **settings}

    def fit(self, rng: np.random.Generator) -> Gaussian:
        """p(ξ | data)."""
        u = np.zeros(len(self.misfit.prior.mean))
        for _ in range(self.rounds):
            u = self.minimise(self.misfit.noise(u), u, rng)
        return self.misfit.laplace(u)

    @abstractmethod
    def minimise(self, noise: Noise, u: Array, rng: np.random.Generator) -> Array:
        """The u (d,) of the least sum of squared residuals, from a start (d,)."""

    def __call__(
        self,
        distribution: Gaussian,
        xi: ArrayLike,
        costs: ArrayLike,
        rng: np.random.Generator,
        std_floor: ArrayLike | None = None,
    ) -> UpdateResult:
        """See :meth:`Update.__call__`; no draw is weighed, and the covariance is what the data say, without a floor."""
        posterior, draws = self.fit(rng), len(np.asarray(xi))
        relevance = np.clip(1 - (posterior.std / self.misfit.prior.std) ** 2, 0, 1)
        weights = np.full(draws, 1 / draws)
        return UpdateResult(posterior, posterior.kl(distribution), float(draws), weights, relevance)


@dataclass(frozen=True)
class LeastSquares(WindowFit):
    """Levenberg-Marquardt with bounds (``mujoco.minimize``), all differences simulated at once.

    Attributes:
        iterations: at most, of each round.
    """

    iterations: int = 30

    def minimise(self, noise: Noise, u: Array, rng: np.random.Generator) -> Array:
        """See :meth:`WindowFit.minimise`."""
        best, _ = minimize.least_squares(
            u,
            lambda columns: self.misfit.residuals(columns.T, noise).T,
            bounds=self.misfit.bounds,
            eps=_DIFFERENCE,
            xtol=1e-4,
            max_iter=self.iterations,
            verbose=minimize.Verbosity.SILENT,
        )
        return best


@dataclass(frozen=True)
class CMAES(WindowFit):
    """Covariance matrix adaptation evolution strategy (Hansen 2016, by ``pycma``): no derivative is needed.

    Attributes:
        evaluations: ξ that each round may try.
        step: first standard deviation, as a share of the prior's.

    Raises:
        ImportError: without pycma.
    """

    evaluations: int = 1000
    step: float = 0.5

    def __post_init__(self) -> None:
        _import_cma()

    def minimise(self, noise: Noise, u: Array, rng: np.random.Generator) -> Array:
        """See :meth:`WindowFit.minimise`."""
        options = {
            "bounds": [list(bound) for bound in self.misfit.bounds],
            "maxfevals": self.evaluations,
            "tolfun": 1e-3,  # of -log p
            "randn": lambda *shape: rng.standard_normal(shape),
            "seed": np.nan,  # leaves NumPy's global generator alone
            "verbose": -9,
        }
        strategy = _import_cma().CMAEvolutionStrategy(u, self.step, options)
        while not strategy.stop():
            tried = strategy.ask()
            residuals = self.misfit.residuals(np.array(tried), noise)
            strategy.tell(tried, 0.5 * np.einsum("nm,nm->n", residuals, residuals))
        return np.asarray(strategy.result.xbest)


def untold_combinations(prior: Gaussian, posterior: Gaussian) -> list[str]:
    """The combinations of parameters that the data leave nearly as uncertain as the prior did, in words.

    They are the directions in which the variance is still more than half the prior's, that is where the data say less
    than the prior. Several such directions are turned so that each names as few parameters as possible.
    """
    root = np.linalg.cholesky(prior.correlation)
    relative = posterior.covariance / np.outer(prior.std, prior.std)
    white = solve_triangular(root, solve_triangular(root, relative, lower=True).T, lower=True)
    variances, vectors = np.linalg.eigh(white)
    untold = root @ vectors[:, variances > _UNTOLD]
    count = untold.shape[1]
    if not count:
        return []
    # Any basis of them is as good: take the one in which each moves one parameter that the others leave alone.
    pivots = qr(untold.T, pivoting=True, mode="r")[1][:count]
    basis = untold @ np.linalg.inv(untold[pivots])
    return [_in_words(prior, column, int(pivot)) for column, pivot in zip(basis.T, pivots, strict=True)]


def _in_words(prior: Gaussian, direction: Array, pivot: int) -> str:
    """The direction (d,), in the prior's standard deviations, with 1 for the pivot."""
    names = prior.space.names
    others = [i for i in np.argsort(-np.abs(direction)) if i != pivot and abs(direction[i]) > _NAMED]
    if not others:
        return f"The data say hardly anything about {names[pivot]}."
    steps = prior.std * direction
    moved = [f"{names[i]} by {_change(prior, i, steps[i])}" for i in (pivot, *others)]
    return f"The data hardly tell apart: {', '.join(moved)}, all at once."


def _change(prior: Gaussian, i: int, step: float) -> str:
    if prior.space.is_log[i]:
        return f"{100 * np.expm1(step):+.2g} %"
    return f"{step:+.2g} {prior.space.units[i]}"


def _import_cma() -> Any:
    try:
        import cma
    except ImportError:
        raise ImportError('CMA-ES needs pycma: pip install "simopt-envs[cma]"') from None
    return cma
