"""From noisy samples on a uniform grid to positions, velocities and accelerations with standard errors.

Everything here is zero-phase: no function delays a signal.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy import linalg, optimize, signal

from simopt_envs.measured.resample import Array, rounding_noise

_ORDER = 3  # of the local polynomials: position, velocity, acceleration and jerk
_NOISE_MARGIN = 1.05
_WINDOWS = (5, 7, 9, 13, 17, 23, 31, 43, 61, 85, 121, 171, 241)  # candidate widths in samples, a factor of sqrt 2 apart
_LEAST_NOISE = 1e-7  # of a signal's standard deviation: less is not told from none
_ONE_SIDED = np.array([-1.5, 2.0, -0.5])  # the rate at the first of three samples
_THIRD_DIFFERENCE = np.array([-1.0, 3.0, -3.0, 1.0])


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
    filled = _filled(values)
    noises = {}
    for window in (w for w in _WINDOWS if w <= len(values)):
        residual = (filled - _filtered(filled, window))[~missing]
        leverage = _weights(window, 0)[window // 2, window // 2]
        noises[window] = float(np.sqrt(np.mean(residual**2) / (1 - leverage)))
    floor = _NOISE_MARGIN * max(min(noises.values()), rounding_noise(values))
    window, noise = max((item for item in noises.items() if item[1] <= floor), default=(_WINDOWS[0], floor))
    value, velocity, acceleration = (
        np.where(missing, np.nan, _filtered(filled, window, d) / period**d) for d in range(3)
    )
    value_error, velocity_error = (noise * _filter_norms(len(values), window, d) / period**d for d in range(2))
    return Smoothed(value, velocity, acceleration, noise, value_error, velocity_error)


@cache
def _weights(window: int, derivative: int) -> Array:
    """What each of a window's samples counts in the filtered value at each, (window, window), of a period of 1."""
    return np.array(
        [signal.savgol_coeffs(window, _ORDER, derivative, pos=position, use="dot") for position in range(window)]
    )


def _filtered(values: Array, window: int, derivative: int = 0) -> Array:
    """As by :func:`scipy.signal.savgol_filter`, with weights that are computed once: (T,), by samples.

    Near the ends, the polynomial is that of the first or last window.
    """
    weights, half = _weights(window, derivative), window // 2
    first = np.sum(weights[:half] * values[:window], axis=1)
    last = np.sum(weights[-half:] * values[-window:], axis=1)
    return np.concatenate([first, np.correlate(values, weights[half]), last])


def _filter_norms(samples: int, window: int, derivative: int) -> Array:
    """Norm of the filter that gives each of the smoothed samples, (T,), of a period of 1."""
    weights, half = _weights(window, derivative), window // 2
    norms = np.linalg.norm(weights, axis=1)
    return np.concatenate([norms[:half], np.full(samples - 2 * half, norms[half]), norms[-half:]])


def _filled(values: Array) -> Array:
    """With straight lines where NaN was."""
    index, missing = np.arange(len(values)), np.isnan(values)
    return np.interp(index, index[~missing], values[~missing]) if missing.any() else values


def smooth_with_rate(position: Array, velocity: Array, period: float) -> Smoothed:
    """Zero-phase smoothing of a position whose velocity was measured too.

    The most probable motion where both err independently and the jerk is white noise, the sizes of the three being
    those that make the measurements most probable: a smoothing spline (Wahba 1978) with two kinds of data. So a
    velocity that lags or is noisy counts for little, and neither a cut-off nor a weight needs choosing.

    Args:
        position: (T,), T >= 5; NaN samples count for nothing, and are NaN again afterwards.
        velocity: (T,); NaN samples count for nothing.
        period: sample period [s].

    Returns:
        Of the position. A motion that stands still, or whose velocity is nowhere measured, is smoothed without it.
    """
    if len(position) < _WINDOWS[0]:
        raise ValueError(f"smoothing needs at least {_WINDOWS[0]} samples, got {len(position)}")
    known = np.isfinite(position).any() and np.isfinite(velocity[1:-1]).any()
    if not known or np.nanstd(position) == 0 or np.nanstd(velocity[1:-1]) == 0:
        return smooth(position, period)
    unit = float(np.nanstd(position))
    motion = _Motion(position / unit, velocity * period / unit)
    of_position = np.std(np.diff(_filled(position), 3)) / 20**0.5 / unit  # were it all noise
    of_velocity = np.std(np.diff(_filled(velocity), 2)) / 6**0.5 * period / unit
    start = np.log(np.maximum([of_position, of_velocity, of_position], _LEAST_NOISE))
    found = optimize.minimize(motion.improbability, start, method="Nelder-Mead", options={"xatol": 0.01, "fatol": 0.01})
    sizes = np.maximum(found.x, np.log(_LEAST_NOISE))
    value, root = motion.most_probable(sizes)
    variance = _band_of_inverse(root)
    velocity_variance = np.empty(len(value))
    velocity_variance[1:-1] = (variance[0, 2:] + variance[0, :-2] - 2 * variance[2, :-2]) / 4
    velocity_variance[0] = _variance(_ONE_SIDED, variance[:, :3])
    velocity_variance[-1] = _variance(-_ONE_SIDED[::-1], variance[:, -3:])
    rate = np.gradient(value, edge_order=2)
    return Smoothed(
        np.where(np.isfinite(position), unit * value, np.nan),
        unit / period * rate,
        unit / period**2 * np.gradient(rate, edge_order=2),
        unit * float(np.exp(sizes[0])),
        unit * np.sqrt(variance[0]),
        unit / period * np.sqrt(velocity_variance),
    )


class _Motion:
    """Positions x (T,) given measured ones, measured changes of them per sample, and a jerk that is white noise.

    Sizes (3,) are the logarithms of three standard deviations: of positions', of velocities' errors, and of third
    differences of x.
    """

    def __init__(self, position: Array, velocity: Array):
        self._weights = np.isfinite(position).astype(np.float64), np.isfinite(velocity[1:-1]).astype(np.float64)
        self._measured = np.nan_to_num(position), np.nan_to_num(velocity[1:-1])

    def most_probable(self, sizes: Array) -> tuple[Array, Array]:
        """x, and the Cholesky factor of its precision in lower banded form (4, T); LinAlgError where it has none."""
        of_position, of_velocity, of_jerk = np.exp(-2 * sizes)
        positions, velocities = of_position * self._weights[0], of_velocity * self._weights[1]
        precision = np.zeros((4, len(positions)))
        precision[0] = positions
        precision[0, 2:] += velocities / 4
        precision[0, :-2] += velocities / 4
        precision[2, :-2] -= velocities / 4
        for i, first in enumerate(_THIRD_DIFFERENCE):
            for d, second in enumerate(_THIRD_DIFFERENCE[i:]):
                precision[d, i : len(positions) - 3 + i] += of_jerk * first * second
        right = positions * self._measured[0]
        right[2:] += velocities * self._measured[1] / 2
        right[:-2] -= velocities * self._measured[1] / 2
        root = linalg.cholesky_banded(precision, lower=True)
        return linalg.cho_solve_banded((root, True), right), root

    def improbability(self, sizes: Array) -> float:
        """-log p(measured | sizes), up to a constant; infinite where rounding errors take over."""
        sizes = np.maximum(sizes, np.log(_LEAST_NOISE))
        try:
            x, root = self.most_probable(sizes)
        except linalg.LinAlgError:
            return np.inf
        errors = (
            self._weights[0] * (x - self._measured[0]),
            self._weights[1] * ((x[2:] - x[:-2]) / 2 - self._measured[1]),
            np.diff(x, 3),
        )
        counts = np.array([self._weights[0].sum(), self._weights[1].sum(), len(x) - 3])
        squares = np.array([np.sum(error**2) for error in errors]) * np.exp(-2 * sizes)
        return float(0.5 * squares.sum() + np.log(root[0]).sum() + counts @ sizes)


def _band_of_inverse(root: Array) -> Array:
    """The inverse of a banded matrix near its diagonal, of its Cholesky factor (b, T), both in lower banded form.

    Takahashi's recursion, from the last row to the first.
    """
    width, size = root.shape
    inverse = np.zeros((width, size + width))
    for i in range(size - 1, -1, -1):
        below = root[1:, i] / root[0, i]
        for d in range(width - 1, -1, -1):
            near = [inverse[abs(d - k), i + min(d, k)] for k in range(1, width)]
            inverse[d, i] = (root[0, i] ** -2 if d == 0 else 0.0) - below @ near
    return inverse[:, :size]


def _variance(weights: Array, band: Array) -> float:
    """Of a weighted sum (3,) of what has a covariance in lower banded form (b, 3)."""
    upper = np.diag(band[0]) + np.diag(2 * band[1, :2], 1) + np.diag(2 * band[2, :1], 2)
    return float(weights @ upper @ weights)
