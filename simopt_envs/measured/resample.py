"""From time stamps as they came to a uniform grid, without delaying a signal."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import interpolate, signal

Array = NDArray[np.float64]

GAP_PERIODS = 5.0
"""An interval longer than this many sample periods is a gap: signals are not interpolated across it."""

REPEATED_PERIODS = 0.1
"""A stamp less than this many sample periods before the next repeats it: a logger wrote late. Between the two a spline
would turn noise into a leap."""

MOST_GAP = 100.0
"""A recording that lasts this many times as long as its samples is all but gap: a clock was set, or two were joined."""

_STANDING_SHARE = 0.05  # of the samples equal to the one before: the mark of a coarse encoder
_PASS_BAND = 0.8  # of the new Nyquist frequency: leaves the filter room to fall before frequencies fold back


def sample_period(time: Array) -> float:
    """Median interval of the time stamps [s]; duplicates and backward steps are left out."""
    intervals = np.diff(time)
    forward = intervals[intervals > 0]
    if not len(forward):
        raise ValueError(f"a sample period needs two increasing time stamps, got {len(time)} without any")
    return float(np.median(forward))


def repeated(time: Array) -> NDArray[np.bool_]:
    """Which stamps (T,) of time that never runs backward repeat the next one, or all but do."""
    intervals = np.diff(time)
    least = REPEATED_PERIODS * sample_period(time) if (intervals > 0).any() else 0.0
    return np.append((intervals <= 0) | (intervals < least), False)


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


def rounding_noise(values: Array) -> float:
    """Standard deviation of what rounding is off by, of a signal that often stands on one count; else 0.

    Where it stands, samples in a row differ by nothing, and tell of no noise.
    """
    stands = np.mean(np.diff(values) == 0) > _STANDING_SHARE
    return resolution(values) / np.sqrt(12) if stands else 0.0


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
