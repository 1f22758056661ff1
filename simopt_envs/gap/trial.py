"""What a search compares: hypotheses fitted to windows, and what they say of windows that no fit saw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear
from scipy.stats import chi2

from simopt_envs.adaptation.fitting import Noise
from simopt_envs.gap.fit import CONFIRMING, Fit, Misfit
from simopt_envs.gap.hypothesis import Hypothesis
from simopt_envs.gap.predictive import HeldOut, precision
from simopt_envs.gap.thresholds import CONFIDENT, EXPLAINED, FAR, WINDOW
from simopt_envs.measured.recording import Finding, Recording
from simopt_envs.measured.windows import Windows
from simopt_envs.physics.parameters import Array

Stretch = tuple[str, float, float]
"""Of a recording, by its name, from when to when [s]."""


@dataclass(frozen=True)
class Data:
    """Windows of recordings to fit, and of recordings that no fit sees.

    Attributes:
        fitted, held_out: the windows.
        fitted_recordings, held_out_recordings: what they are cut from.
        warnings: of the recordings' audit.
        wild: the windows left out as all depends on how exactly they start: the recording, and from when to when [s].
        outliers: the same of those left out as something happened in them that no candidate explains.
    """

    fitted: Windows
    held_out: Windows
    fitted_recordings: tuple[Recording, ...]
    held_out_recordings: tuple[Recording, ...]
    warnings: tuple[Finding, ...] = ()
    wild: tuple[Stretch, ...] = ()
    outliers: tuple[Stretch, ...] = ()

    @property
    def seconds(self) -> float:
        """Length of a window."""
        return self.fitted.seconds

    @property
    def parts(self) -> int:
        """How many times as long as the shortest a window is."""
        return max(1, round(self.seconds / WINDOW))

    def of_those(self, fitted: NDArray[np.bool_], held_out: NDArray[np.bool_], warning: Finding) -> Self:
        """The windows that are told, (w,) of each, and a warning that the others are left out."""
        few = [
            windows if rows.all() else windows.select(np.flatnonzero(rows))
            for windows, rows in self._of_each(fitted, held_out)
        ]
        return replace(self, fitted=few[0], held_out=few[1], warnings=(*self.warnings, warning))

    def of_columns(self, names: Sequence[str], warnings: Sequence[Finding]) -> Self:
        """Compared in some columns alone, and warnings that the others are left out."""
        few = [windows.of_columns(names) for windows in (self.fitted, self.held_out)]
        return replace(self, fitted=few[0], held_out=few[1], warnings=(*self.warnings, *warnings))

    def stretches(self, fitted: NDArray[np.bool_], held_out: NDArray[np.bool_]) -> tuple[Stretch, ...]:
        """Where the windows are that are told, (w,) of each."""
        return tuple(
            (windows.recording[i], float(windows.start_time[i]), float(windows.start_time[i] + windows.seconds))
            for windows, rows in self._of_each(fitted, held_out)
            for i in np.flatnonzero(rows)
        )

    def _of_each(self, *rows: NDArray[np.bool_]) -> list[tuple[Windows, NDArray[np.bool_]]]:
        return list(zip((self.fitted, self.held_out), rows, strict=True))


@dataclass(frozen=True)
class Trial:
    """A hypothesis fitted, and what it says of the recordings that were held out.

    Attributes:
        hypothesis: plain parameters and effects.
        fit: of the fitted windows.
        held_out: its errors there.
    """

    hypothesis: Hypothesis
    fit: Fit
    held_out: HeldOut

    def precision(self, weight: Array) -> Array:
        """Of u by the windows fitted, (d, d), each channel's squared errors counted by a weight, (c,)."""
        return precision(self.fit, self.hypothesis.high - self.hypothesis.low, weight)

    @property
    def within(self) -> tuple[Array, Array]:
        """How far u may go down and up from where the fit ended, (d,) each."""
        return self.hypothesis.low - self.fit.u, self.hypothesis.high - self.fit.u

    @property
    def excess(self) -> float:
        """Mean square of the whitened held-out errors above that of noise alone, which is 1."""
        return float(np.mean(self.held_out.errors**2)) - 1.0

    def held_against(self, rows: NDArray[np.intp]) -> Self:
        """The same, of some of the windows held out."""
        return replace(self, held_out=self.held_out.select(rows))


def afresh(trial: Trial) -> Array:
    """A trial's coordinates (d,), its plain parameters at their priors' means."""
    return np.where(np.arange(len(trial.fit.u)) < trial.hypothesis.num_plain, 0.0, trial.fit.u)


def noise_alone(trial: Trial) -> float:
    """The excess that noise alone leaves at most, in 39 of 40 cases."""
    return CONFIDENT * float(np.sqrt(2 / trial.held_out.errors.size))


def of_median_window(errors: Array) -> float:
    """Mean square of the whitened errors (w, S, c) of the median window: noise alone leaves 1."""
    return float(np.median(np.mean(errors**2, axis=(1, 2))))


@dataclass(frozen=True)
class Base(Trial):
    """A trial that others are compared with, and the noise they are all fitted in.

    Attributes:
        noise, held_out_noise: at its ξ.
        tolerance: how many times the sensors' noise that noise is, (c,): what even the best model leaves, where it
            leaves more. Fits in units of less would count priors for nothing.
    """

    noise: Noise
    held_out_noise: Noise
    tolerance: Array

    def held_against(self, rows: NDArray[np.intp]) -> Self:
        """The same, of some of the windows held out."""
        return replace(super().held_against(rows), held_out_noise=self.held_out_noise.select(rows))

    def worst(self, count: float) -> NDArray[np.intp]:
        """About so many of the windows fitted, at least one: those of which it leaves the most, in their order."""
        left = np.sum(self.fit.errors**2, axis=(1, 2))
        return np.sort(np.argsort(-left, kind="stable")[: max(1, round(count))])

    @property
    def sensor_noise(self) -> Array:
        """Standard deviation of each channel's noise, (c,)."""
        return self.noise.scale / self.tolerance

    @property
    def excess_everywhere(self) -> float:
        """The excess of the windows held out and that of those fitted, together: either alone is of few motions."""
        return self.excess + float(np.mean((self.tolerance * self.fit.errors) ** 2)) - 1.0

    @property
    def strained(self) -> bool:
        """Whether its plain parameters, all together, are as improbable as one alone that speaks for an effect."""
        plain = self.fit.u[: self.hypothesis.num_plain]
        return bool(chi2.sf(plain @ plain, len(plain)) < chi2.sf(FAR**2, 1))

    @property
    def unforeseen(self) -> float:
        """The excess in units of the predictive distribution, to first order; the verdict is on it.

        It is the excess itself where the model does not fit what was fitted either, or where errors are counted in more
        than the sensors' noise: that no parameter's uncertainty excuses.
        """
        if np.any(self.tolerance > 1) or np.mean(self.fit.errors**2) > EXPLAINED:
            return self.excess
        every = np.ones(len(self.tolerance))
        return self.excess - self.held_out.excused(self.precision(every), self.within) / self.held_out.errors.size

    def spread(self, data: Data) -> Array:
        """Standard deviation of u, (d,), by the windows that were fitted."""
        return np.sqrt(self.fit.variance(self._others(data.fitted, self.noise), self.left, data.parts))

    def to_all(self) -> Fit:
        """The fit to the windows fitted and those held out together, to first order."""
        weight = 1 / self.tolerance
        errors = np.concatenate([self.fit.errors, weight * self.held_out.errors])
        of_held_out = weight[:, None] * self.held_out.jacobian
        jacobian = np.concatenate([self.fit.jacobian, of_held_out.reshape(-1, len(self.fit.u))])
        fit = replace(self.fit, errors=errors, jacobian=jacobian)
        u = fit.u + lsq_linear(fit.rows, -fit.residual, self.within, method="bvls").x
        return replace(fit, u=u, errors=errors + (jacobian @ (u - fit.u)).reshape(errors.shape))

    def by_all(self, data: Data) -> tuple[Array, Array]:
        """u by the windows fitted and those held out together, and its spread, (d,)."""
        both = (data.fitted, self.noise), (data.held_out, self.held_out_noise)
        others = [np.concatenate(some) for some in zip(*(self._others(*one) for one in both), strict=True)]
        fit = self.to_all()
        return fit.u, np.sqrt(fit.variance(others, self.left, data.parts))

    @property
    def left(self) -> float:
        """Mean square of the whitened held-out errors, at least that of noise."""
        return max(1.0, float(np.mean((self.held_out.errors / self.tolerance) ** 2)))

    def _others(self, windows: Windows, noise: Noise) -> list[Array]:
        """Jacobians on some windows over other differences than the fit's."""
        misfit = Misfit(self.hypothesis, windows).with_noise(noise)
        return [misfit.jacobian(self.fit.u, difference=difference) for difference in CONFIRMING]
