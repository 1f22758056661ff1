"""From time stamps as they came to a uniform grid, and from noisy samples to states with a standard error.

Everything here is zero-phase: no function delays a signal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import interpolate, signal

Array = NDArray[np.float64]

GAP_PERIODS = 5.0
"""An interval longer than this many sample periods is a gap: signals are not interpolated across it."""

_PASS_BAND = 0.8  # of the new Nyquist frequency: leaves the filter room to fall before frequencies fold back
_ORDER = 3  # of the local polynomials: position, velocity, acceleration and jerk
_NOISE_MARGIN = 1.05
_STANDING_SHARE = 0.05  # of the samples equal to the one before: the mark of a coarse encoder
_WINDOWS = (5, 7, 9, 13, 17, 23, 31, 43, 61, 85, 121, 171, 241)  # candidate widths in samples, a factor of sqrt 2 apart


def sample_period(time: Array) -> float:
    """Median interval of the time stamps [s]; duplicates and backward steps are left out."""
    intervals = np.diff(time)
    forward = intervals[intervals > 0]
    if not len(forward):
        raise ValueError(f"a sample period needs two increasing time stamps, got {len(time)} without any")
    return float(np.median(forward))


def longest_interval(time: Array, start: float, end: float) -> float:
    """Longest interval between stamps that overlaps start to end [s]; infinite where the stamps do not cover them."""
    tolerance = 1e-3 * sample_period(time)
    first = np.searchsorted(time, start + tolerance, side="right") - 1
    last = np.searchsorted(time, end - tolerance)
    if first < 0 or last >= len(time):
        return np.inf
    return float(np.diff(time[first : last + 1]).max(initial=0.0))


def resolution(values: Array) -> float:
    """Smallest step between two values that occur in a signal: an encoder's count. 0 for a constant signal."""
    distinct = np.unique(values[np.isfinite(values)])
    steps = np.diff(distinct)
    steps = steps[steps > 1e-9 * (distinct[-1] - distinct[0])] if len(steps) else steps  # less is rounding
    return float(steps.min(initial=np.inf)) if len(steps) else 0.0


def hold(time: Array, values: Array, at: Array) -> Array:
    """Zero-order hold: the last value at or before each instant, the first one before that.

    Args:
        time: increasing stamps, (T,).
        values: (T,).
        at: instants, (n,). A stamp later than its instant by less than 0.1 % of the period counts as reached.
    """
    tolerance = 1e-3 * sample_period(time)
    return values[np.clip(np.searchsorted(time, at + tolerance, side="right") - 1, 0, len(time) - 1)]


def band_limited(time: Array, values: Array, at: Array) -> Array:
    """Sample a signal on a uniform grid, its frequencies above the grid's Nyquist frequency removed first.

    Between its samples the signal is a cubic spline. NaN samples are left out; the result is NaN where the nearest
    samples on both sides are more than ``GAP_PERIODS`` periods apart, and beyond the ends of the data.

    Args:
        time: increasing stamps, (T,), jittered as they may be.
        values: (T,).
        at: a uniform grid, (n,), n >= 1.
    """
    good = np.isfinite(values)
    if good.sum() < 4:
        return np.full(len(at), np.nan)
    period = sample_period(time)
    time, values = time[good], values[good]
    spline = interpolate.CubicSpline(time, values)
    step = (at[-1] - at[0]) / (len(at) - 1) if len(at) > 1 else period
    oversampling = int(np.ceil(step / period - 1e-3))
    if oversampling <= 1:
        resampled = spline(np.clip(at, time[0], time[-1]))
    else:
        fine = at[0] + step / oversampling * np.arange((len(at) - 1) * oversampling + 1)
        low_pass = signal.butter(4, _PASS_BAND / oversampling, output="sos")
        filtered = signal.sosfiltfilt(
            low_pass, spline(np.clip(fine, time[0], time[-1])), padlen=min(15 * oversampling, len(fine) - 1)
        )
        resampled = filtered[::oversampling]
    after = np.searchsorted(time, at - 1e-3 * period)
    before = np.searchsorted(time, at + 1e-3 * period, side="right") - 1
    inside = (after < len(time)) & (before >= 0)
    width = time[np.minimum(after, len(time) - 1)] - time[np.maximum(before, 0)]
    return np.where(inside & (width <= GAP_PERIODS * period), resampled, np.nan)


@dataclass(frozen=True)
class Smoothed:
    """A smoothed signal and its derivatives, with what their noise is.

    Attributes:
        value, velocity, acceleration: (T,), NaN where the signal was.
        noise: standard deviation of one sample around the smooth signal.
        value_error, velocity_error: standard errors of each smoothed value and velocity, (T,): larger near the ends,
            where there is less on one side to smooth with.
    """

    value: Array
    velocity: Array
    acceleration: Array
    noise: float
    value_error: Array
    velocity_error: Array


def smooth(values: Array, period: float) -> Smoothed:
    """Zero-phase smoothing with local cubic polynomials (Savitzky and Golay 1964) on a uniform grid.

    The window is the widest that leaves the residual at the noise floor: within 5 % of the least noise that any width
    finds, or of the rounding noise where the signal often stands on one count of an encoder. No cut-off needs choosing,
    and a slow climb from count to count is smoothed across them. The standard errors follow from the noise and the
    norms of the filters.

    Args:
        values: (T,), T >= 5; NaN samples are interpolated for the filter and NaN again afterwards.
        period: sample period [s].
    """
    if len(values) < _WINDOWS[0]:
        raise ValueError(f"smoothing needs at least {_WINDOWS[0]} samples, got {len(values)}")
    missing = ~np.isfinite(values)
    if missing.all():
        raise ValueError("smoothing needs finite samples, got none")
    index = np.arange(len(values))
    filled = np.interp(index, index[~missing], values[~missing]) if missing.any() else values
    noises = {}
    for window in (w for w in _WINDOWS if w <= len(values)):
        residual = (filled - signal.savgol_filter(filled, window, _ORDER))[~missing]
        leverage = signal.savgol_coeffs(window, _ORDER)[window // 2]
        noises[window] = float(np.sqrt(np.mean(residual**2) / (1 - leverage)))
    stands = np.mean(np.diff(values) == 0) > _STANDING_SHARE
    floor = _NOISE_MARGIN * max(min(noises.values()), resolution(values) / np.sqrt(12) if stands else 0.0)
    window, noise = max((item for item in noises.items() if item[1] <= floor), default=(_WINDOWS[0], floor))
    value, velocity, acceleration = (
        np.where(missing, np.nan, signal.savgol_filter(filled, window, _ORDER, deriv=d, delta=period)) for d in range(3)
    )
    value_error, velocity_error = (noise * _filter_norms(len(values), window, d, period) for d in range(2))
    return Smoothed(value, velocity, acceleration, noise, value_error, velocity_error)


def _filter_norms(samples: int, window: int, derivative: int, period: float) -> Array:
    """Norm of the filter that gives each of the smoothed samples, (T,); near the ends the polynomial is of the end."""

    def norm(position: int) -> float:
        weights = signal.savgol_coeffs(window, _ORDER, derivative, period, pos=position, use="dot")
        return float(np.linalg.norm(weights))

    half = window // 2
    norms = np.full(samples, norm(half))
    norms[:half] = [norm(position) for position in range(half)]
    norms[samples - half :] = norms[:half][::-1]
    return norms
