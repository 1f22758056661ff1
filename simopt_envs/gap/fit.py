"""Fits of a hypothesis to windows of recordings: multiple shooting, with the errors of the starts marginalised.

A fit makes 1/2 |C^(-1/2) (simulated - measured)|² + 1/2 |u / prior std|² small, C = diag(σ²) + S P₀ Sᵀ with the noise σ
of the sensors and the covariance S P₀ Sᵀ that uncertain starts leave in a window.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from mujoco import minimize

from simopt_envs.adaptation.fitting import Noise
from simopt_envs.gap.chart import Chart
from simopt_envs.gap.hypothesis import Hypothesis
from simopt_envs.gap.known import completed, to_take
from simopt_envs.gap.looks import along_uncertain, of_other_sizes
from simopt_envs.measured.replay import start_curvature, start_sensitivity
from simopt_envs.measured.windows import Windows
from simopt_envs.physics.parameters import Array

# Of a unit of u, to both sides, one after another. Contacts and dry friction make predictions kink: derivatives over
# less tell of one kink and lead a fit astray, those over much lead it across them and past where laws bend.
DIFFERENCES = (1.0, 0.3, 0.1)
CONFIRMING = (0.3, 0.01)
"""The same, over which derivatives must confirm what a fit says that it knows: coarse ones, as fine ones are rough
where things touch, and elsewhere fine ones, as coarse ones are bent."""
_ROUGH = 3.0  # times as unlike as another
_KINK = 6.0  # medians: four standard deviations
_LEAST_GAIN = 1e-4  # share of the loss that a step takes away, below which a fit has arrived
_LEAST_COARSE_GAIN = 1e-3  # the same, over a difference that a finer one follows
_LOOKS = 3  # at most
_WORTH_GOING = 1.0  # nats
_DIVERGED = 30.0  # the error, in units of noise, of a sample that a simulation did not reach


@dataclass(frozen=True)
class Fit:
    """Where a fit ended.

    Attributes:
        u: coordinates of ξ, (d,).
        errors: whitened errors of the data there, (w, S, c); 0 where nothing was measured.
        jacobian: their derivative by u, (w S c, d).
        prior_std: of u, (d,).
        log_det: of the covariance that errors are whitened by, (w,).
    """

    u: Array
    errors: Array
    jacobian: Array
    prior_std: Array
    log_det: Array

    @property
    def loss(self) -> float:
        """-log p(u | data), up to a constant."""
        squares = float(np.sum(self.errors**2)) + float(np.sum((self.u / self.prior_std) ** 2))
        return 0.5 * (squares + float(np.sum(self.log_det)))

    @property
    def rows(self) -> Array:
        """The Jacobian of errors and prior, (m + d, d)."""
        return np.vstack([self.jacobian, np.diag(1 / self.prior_std)])

    @property
    def residual(self) -> Array:
        """Errors and prior, (m + d,)."""
        return np.concatenate([self.errors.ravel(), self.u / self.prior_std])

    @cached_property
    def orthonormal(self) -> tuple[Array, Array]:
        """The QR decomposition of :attr:`rows`."""
        orthonormal, triangle = np.linalg.qr(self.rows)
        return orthonormal, triangle

    def variance(self, others: Sequence[Array], mean_square: float = 1.0, parts: int = 1) -> Array:
        """Of u, (d,): of the Gauss-Newton Hessian or, where that is more, of how far stretches of data pull it apart.

        The latter (White 1980, clustered by stretch) holds where errors are not what their noise says: those that a
        wrong law, or a start, leaves in a stretch go together.

        Args:
            others: Jacobians over other differences; what one of them denies of this one tells nothing, but for those
                that differ by much more than another does.
            mean_square: of whitened errors.
            parts: stretches in a window.
        """
        rows = self.rows
        inverse = np.asarray(np.linalg.pinv(rows.T @ rows, hermitian=True), dtype=np.float64)
        jacobian = self.jacobian.reshape(*self.errors.shape, len(self.u))
        pulls = by_part(np.einsum("wscd,wsc->wsd", jacobian, self.errors), parts)
        apart = pulls.T @ pulls * len(pulls) / max(len(pulls) - 1, 1) + np.diag(self.prior_std**-2.0)
        unlike = [self._unlike(other) for other in others]
        asked = [other for other, much in zip(others, unlike, strict=True) if much <= _ROUGH * min(unlike)]
        confirmed = [mean_square * np.diag(self._confirmed(other)) for other in asked]
        return np.max([*confirmed, np.diag(inverse @ apart @ inverse)], axis=0)

    def _unlike(self, other: Array) -> float:
        """How much a Jacobian over other differences differs, in coordinates in which all is known alike."""
        return float(np.linalg.norm(np.linalg.solve(self.orthonormal[1].T, (other - self.jacobian).T)))

    def _confirmed(self, other: Array) -> Array:
        """Covariance of u, (d, d), if the data tell only what the Jacobian over other differences agrees on.

        Contacts and dry friction make derivatives rough, and what is not straight bends them. By that alone the columns
        of parameters that are one in the data differ, and each would seem to be known; but over other differences they
        differ in another way.
        """
        whiten = np.linalg.inv(self.orthonormal[1]).T  # in the coordinates it leads to, all is known to a variance of 1
        both = self.jacobian.T @ other
        share, axes = np.linalg.eigh(whiten @ (both + both.T) @ whiten.T / 2)
        known = (axes * np.clip(share, 0.0, 1.0)) @ axes.T + (whiten * self.prior_std**-2.0) @ whiten.T
        return np.asarray(whiten.T @ np.linalg.solve(known, whiten))


def by_part(values: Array, parts: int) -> Array:
    """Sums over the samples of each of the parts of equal length of each window, (w, S, ...) -> (w parts, ...)."""
    first = np.arange(parts) * values.shape[1] // parts
    return np.add.reduceat(values, first, axis=1).reshape(-1, *values.shape[2:])


class Misfit:
    """Whitened errors of a hypothesis on windows.

    Args:
        hypothesis: what is simulated.
        windows: what it is compared with.
        num_threads: that simulate; 0 for one per core.

    Attributes:
        noise: that errors are counted in: 1 in all channels, until :meth:`with_noise`.
    """

    def __init__(self, hypothesis: Hypothesis, windows: Windows, num_threads: int = 0):
        self.hypothesis = hypothesis
        self.noise = Noise.of(np.ones(len(windows.channels)), np.zeros((1, *windows.measured.shape)))
        self._simulate = hypothesis.simulator(windows, num_threads)
        self._measured = windows.measured
        self._counted = np.isfinite(windows.measured)
        self._least_noise = windows.least_noise()

    def with_noise(self, noise: Noise) -> Misfit:
        """The same with another noise, and the worlds that are there."""
        other = object.__new__(Misfit)
        other.__dict__.update(self.__dict__, noise=noise)
        return other

    def with_own_noise(self, u: Array) -> Misfit:
        """The same with its own starts' noise at u (d,) in those windows in which the data are likelier in that.

        It holds to first order alone: an uncertain start in a play makes less of a window than it says.
        """
        own = self.with_noise(self.noise_at(u, self.noise.scale))
        there, here = (np.sum(m.errors(u[None])[0] ** 2, axis=(1, 2)) + m.noise.log_det for m in (own, self))
        return self.with_noise(self.noise.replaced(there < here, own.noise))

    def simulated(self, u: Array) -> Array:
        """(n, d) -> (n, w, S, c)."""
        return self._simulate(self.hypothesis.xi(u))

    def off(self, u: Array) -> Array:
        """Simulated less measured, (n, d) -> (n, w, S, c); 0 where nothing was measured."""
        errors = self.simulated(u) - self._measured
        diverged = np.isnan(errors) & self._counted
        return np.where(diverged, _DIVERGED * self.noise.scale, np.where(self._counted, errors, 0.0))

    def errors(self, u: Array) -> Array:
        """Whitened errors, (n, d) -> (n, w, S, c)."""
        return self.noise.whiten(self.off(u))

    def best(self, starts: Array) -> Array:
        """The start (d,), of several (k, d), from which a fit has the least left to do."""
        return starts[np.argmin(self.losses(starts))]

    def losses(self, u: Array) -> Array:
        """-log p(u | data) of each u (n, d), up to a constant, (n,)."""
        different, of = np.unique(u, axis=0, return_inverse=True)  # many tries end at the same bound
        data = np.sum(self.errors(different) ** 2, axis=(1, 2, 3))[of]
        return 0.5 * (data + np.sum((u / self.hypothesis.prior_std) ** 2, axis=1))

    def jacobian(
        self,
        u: Array,
        columns: Sequence[int] | None = None,
        difference: float = DIFFERENCES[-1],
        chart: Chart | None = None,
    ) -> Array:
        """Derivative of the whitened errors by all of u (d,), or some, (m, k), from both sides where bounds allow.

        Args:
            u: where.
            columns: by which of its coordinates.
            difference: that it is taken over.
            chart: in whose coordinates it is taken instead.
        """
        chart = Chart(self.hypothesis, ()) if chart is None else chart
        columns, x = range(len(u)) if columns is None else columns, chart.straight(u)
        ends = np.tile(x, (2, len(columns), 1))
        both = np.array([[-difference], [difference]]) * chart.reach(u)[columns]
        reached = np.clip(x[columns] + both, chart.low[columns], chart.high[columns])
        ends[:, np.arange(len(columns)), columns] = reached
        below, above = self.errors(chart.bent(ends.reshape(-1, len(x)))).reshape(2, len(columns), -1)
        return ((above - below) / np.diff(reached, axis=0).T).T

    def noise_at(self, u: Array, scale: Array) -> Noise:
        """The noise of sensors of a scale (c,) with what uncertain starts leave at u (d,)."""
        starts = start_sensitivity(self.hypothesis.model, self._simulate, self.hypothesis.xi(u[None]))
        return Noise.of(scale, np.where(self._counted, np.nan_to_num(starts), 0.0))

    def bent_by_starts(self, u: Array, scale: Array) -> Array:
        """What uncertain starts make of windows beyond the linear, and so not in the noise, at u (d,), (w, c).

        Mean squares in a noise (c,), infinite where a simulation ran away. Over two standard errors as well as over
        one: something, as a finger that catches, may happen beyond the first.
        """
        model, xi = self.hypothesis.model, self.hypothesis.xi(u[None])
        changes = [start_curvature(model, self._simulate, xi, errors=errors) for errors in (1.0, 2.0)]
        made = np.where(self._counted, np.sum((np.array(changes) / scale) ** 2, axis=1), 0.0)
        return np.nan_to_num(np.max(np.mean(made, axis=2), axis=0), nan=np.inf)

    def noise_floor(self, u: Array) -> Array:
        """Standard deviation of the part of the errors at u (d,) that one sample does not share with the next, (c,).

        The second difference of errors in a row holds little of what a model lacks, which changes from sample to
        sample by little; differences far beyond the others are kinks and do not count. Of an encoder that stands on one
        count most of the time all would be such: it is off by its rounding at least.
        """
        errors = np.where(self._counted, self.simulated(u[None])[0] - self._measured, np.nan)
        second = np.abs(np.diff(errors, n=2, axis=1)).reshape(-1, errors.shape[-1])
        kink = second > _KINK * np.nanmedian(second, axis=0)
        told = np.sqrt(np.nanmean(np.where(kink, np.nan, second) ** 2, axis=0) / 6.0)
        return np.maximum(told, self._least_noise)


class _HalfSquares(minimize.Norm):
    """1/2 |r|² and its derivatives, summed without BLAS: what that gives depends on how many threads it has."""

    def value(self, r: Array) -> np.float64:
        return np.float64(0.5 * np.sum(r**2))

    def grad_hess(self, r: Array, proj: Array) -> tuple[Array, Array]:
        columns = np.ascontiguousarray(proj.T)
        return np.einsum("im,mk->ik", columns, r), np.einsum("im,jm->ij", columns, columns)


class _NothingLeft(Exception):
    """Ends a fit at some coordinates."""


def fit(
    misfit: Misfit,
    start: Array,
    iterations: int,
    known: Array | None = None,
    differences: Sequence[float] = DIFFERENCES,
) -> Fit:
    """The most probable u.

    Where it ends, it looks along what the data know least of the effects, near and far, and at other sizes of each, and
    goes on where that is better: something that catches in one window, at some values alone, makes a wall that no small
    step gets over.

    Args:
        misfit: of a hypothesis.
        start: u to begin from, (d,).
        iterations: of Gauss-Newton with Levenberg's damping, at most.
        known: the Jacobian by the first k of u, (m, k), where it is known well enough from a fit nearby: it saves the
            most of the work; NaN by what is to be taken, see :func:`of_silent`. None to take all by differences. Of all
            of u, where a fit leads is told and no more: the Jacobian returned is that.
        differences: over which derivatives are taken, one after another; from a start that is a fit, fine ones do.
    """
    hypothesis = misfit.hypothesis
    fresh = to_take(known, len(start))
    chart = Chart(hypothesis, fresh)
    of_effects = [i for i in fresh if i >= hypothesis.num_plain]

    def residual(columns: Array) -> Array:
        u = chart.bent(columns.T)
        return np.hstack([misfit.errors(u).reshape(len(u), -1), columns.T * chart.pull]).T

    def jacobian(x: Array, difference: float) -> Array:
        data = completed(known, len(x), lambda columns: misfit.jacobian(chart.bent(x), columns, difference, chart))
        return np.vstack([data, np.diag(chart.pull)])

    x = chart.straight(np.clip(start, hypothesis.low, hypothesis.high))
    few = 0 < len(fresh) == len(of_effects) < len(start)
    for difference in differences:
        least = _LEAST_GAIN if difference == differences[-1] else _LEAST_COARSE_GAIN
        derivatives = _Derivatives(partial(jacobian, difference=difference), few)
        x = _descended(x, residual, derivatives, chart, iterations, least)
    rows = derivatives.taken(x)
    for _ in range(_LOOKS if of_effects and differences[-1] == DIFFERENCES[-1] else 0):
        ahead = along_uncertain(x, rows, of_effects)
        if not few:
            ahead = np.vstack([ahead, of_other_sizes(x, rows, residual, chart, hypothesis)])
        losses = misfit.losses(chart.bent(np.vstack([x, ahead])))
        best = int(np.argmin(losses))
        if losses[best] > losses[0] - _WORTH_GOING:
            break
        x = ahead[best - 1]
        x = _descended(x, residual, derivatives, chart, iterations)
        rows = derivatives.taken(x)
    u = chart.bent(x)
    errors = misfit.errors(u[None])[0]
    return Fit(u, errors, chart.by_u(rows[: errors.size], u), hypothesis.prior_std, misfit.noise.log_det)


class _Derivatives:
    """Of a residual by x, (m, d): by differences, which cost the most of a fit, or from before, after a step.

    Args:
        take: them by differences at some x.
        few: whether so few are to be taken that each step has its own.
    """

    def __init__(self, take: Callable[[Array], Array], few: bool = False):
        self._take, self._few, self._rows, self._taken_at = take, few, np.empty(0), np.empty(0)
        self._before: tuple[Array, Array] | None = None

    def taken(self, x: Array) -> Array:
        """By differences at x, once where they are asked for again: at the end of a fit they are there."""
        if not self.are_taken(x):
            self._rows, self._taken_at = self._take(x), x.copy()
        return self._rows

    def are_taken(self, x: Array) -> bool:
        """Whether what is there was taken at x."""
        return np.array_equal(x, self._taken_at)

    def forget(self) -> None:
        """Take them anew where they are next asked for."""
        self._before = None

    def after_step(self, x: Array, residual: Array) -> Array:
        """What was there with what the step to x then changed of a residual (m,) along it (Broyden 1965)."""
        if self._few or self._before is None:
            self.taken(x)
        else:
            step, missed = x - self._before[0], residual - self._before[1]
            missed -= np.einsum("md,d->m", self._rows, step)
            along = step * np.sum(self._rows**2, axis=0)  # in coordinates that the data tell alike
            self._rows, self._taken_at = self._rows + np.outer(missed, along / (along @ step)), np.empty(0)
        self._before = x.copy(), residual.copy()
        return self._rows


def _descended(
    x: Array,
    residual: Callable[[Array], Array],
    derivatives: _Derivatives,
    chart: Chart,
    iterations: int,
    least: float = _LEAST_GAIN,
) -> Array:
    """Where steps downhill lead, with derivatives over one difference: to where those taken there gain no more.

    Where a finer difference follows, they are not taken there once more to see: from there on, it takes its own.
    """

    def stop(trace: Sequence[minimize.IterLog]) -> None:
        # MuJoCo's own test is of steps relative to the length of x: far from 0, where effects are large, it ends early.
        if trace[-1].reduction < least * trace[-1].objective:
            raise _NothingLeft(trace[-1].candidate, trace)

    x = np.clip(x, chart.low, chart.high)
    while iterations > 0:
        derivatives.forget()
        try:
            x, trace = minimize.least_squares(
                x,
                residual,
                bounds=[chart.low, chart.high],
                jacobian=lambda x, r: derivatives.after_step(np.ravel(x), np.ravel(r)),
                norm=_HalfSquares(),
                x_scale="jac",  # damping relative to what the data say of each coordinate
                mu_max=1e4,
                mu_factor=10.0,
                max_iter=iterations,
                verbose=minimize.Verbosity.SILENT,
                iter_callback=stop,
            )
        except _NothingLeft as end:
            x, trace = end.args
        x = np.ravel(x)
        if derivatives.are_taken(x) or least > _LEAST_GAIN:
            break
        iterations -= len(trace)  # derivatives from before damp steps that those taken would not
    return x
