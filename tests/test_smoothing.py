"""Positions and velocities from noisy samples, and how wrong they may be."""

import numpy as np
import pytest
from scipy.signal import savgol_filter

from simopt_envs.measured.resample import resolution
from simopt_envs.measured.smoothing import _filtered, smooth, smooth_with_rate

PERIOD = 0.002


def test_smoothing_finds_velocity_and_how_wrong_it_may_be():
    rng = np.random.default_rng(1)
    time = np.arange(3000) / 500
    position, velocity = np.sin(4 * time), 4 * np.cos(4 * time)
    smoothed = smooth(position + rng.normal(0, 1e-3, 3000), 1 / 500)
    assert smoothed.noise == pytest.approx(1e-3, rel=0.1)
    inside = slice(100, -100)
    error = np.std(smoothed.velocity[inside] - velocity[inside])
    assert error < np.std(np.gradient(position + rng.normal(0, 1e-3, 3000), 1 / 500) - velocity) / 20
    assert 0.7 < error / smoothed.velocity_error[100] < 1.5
    assert 0.7 < np.std(smoothed.value[inside] - position[inside]) / smoothed.value_error[100] < 1.5


def test_smoothing_sees_across_the_counts_of_an_encoder():
    time = np.arange(5000) / 1000
    count = 2 * np.pi / 4000
    rounded = np.round(0.3 * np.sin(time) / count) * count
    assert resolution(rounded) == pytest.approx(count)
    smoothed = smooth(rounded, 1e-3)
    assert smoothed.noise == pytest.approx(count / np.sqrt(12), rel=0.15)
    assert np.std(smoothed.velocity - 0.3 * np.cos(time)) < 0.02  # a difference quotient: 0.7


def test_smoothing_leaves_missing_samples_missing():
    values = np.sin(np.arange(200) / 20)
    values[50:55] = np.nan
    smoothed = smooth(values, 0.05)
    np.testing.assert_array_equal(np.isnan(smoothed.velocity), np.isnan(values))
    with pytest.raises(ValueError, match="at least 5 samples, got 3"):
        smooth(np.zeros(3), 0.1)


def motion(rng, samples=2000, jerk=2000.0):
    """Position and velocity under a jerk that is white noise, pulled back to rest."""
    state, path = np.zeros(3), np.empty((samples, 2))
    for t in range(samples):
        path[t] = state[:2]
        pull = jerk * rng.standard_normal() - 30 * state[2] - 300 * state[1] - 1000 * state[0]
        state += PERIOD * np.array([state[1] + PERIOD * state[2] / 2, state[2], pull])
    return path.T


def test_two_measurements_of_one_motion_tell_more_than_either():
    rng = np.random.default_rng(0)
    value_errors, rate_errors, gains = [], [], []
    for _ in range(20):
        position, velocity = motion(rng)
        noisy, rate = position + 3e-4 * rng.standard_normal(2000), velocity + 0.03 * rng.standard_normal(2000)
        both, alone = smooth_with_rate(noisy, rate, PERIOD), smooth(noisy, PERIOD)
        assert both.noise == pytest.approx(3e-4, rel=0.1)
        value_errors.append((both.value - position) / both.value_error)
        rate_errors.append((both.velocity - velocity) / both.velocity_error)
        gains.append([np.std(both.velocity - velocity), np.std(alone.velocity - velocity)])
    both, alone = np.mean(gains, axis=0)
    assert both < 0.7 * alone
    assert both < 0.7 * 0.03
    for errors in map(np.array, (value_errors, rate_errors)):
        assert np.std(errors) == pytest.approx(1, abs=0.1)
        assert np.std(errors[:, [0, -1]]) == pytest.approx(1, abs=0.35)  # of 40: at the ends, where least is known


def test_a_velocity_that_lags_counts_for_little():
    rng = np.random.default_rng(1)
    position, velocity = motion(rng)
    noisy, rate = position + 3e-4 * rng.standard_normal(2000), velocity + 0.03 * rng.standard_normal(2000)
    late = np.concatenate([np.full(10, rate[0]), rate[:-10]])
    error = {
        name: np.std(smooth_with_rate(noisy, measured, PERIOD).velocity - velocity)
        for name, measured in (("right", rate), ("late", late))
    }
    assert error["late"] < 2 * error["right"]
    assert np.std(late - velocity) > 5 * error["right"]


def test_what_was_not_measured_counts_for_nothing():
    rng = np.random.default_rng(2)
    position, velocity = motion(rng)
    holed, rate = position + 1e-4 * rng.standard_normal(2000), velocity + 0.03 * rng.standard_normal(2000)
    holed[500:510], rate[::3] = np.nan, np.nan
    smoothed = smooth_with_rate(holed, rate, PERIOD)
    np.testing.assert_array_equal(np.isnan(smoothed.value), np.isnan(holed))
    assert np.std(smoothed.velocity - velocity) < 0.02
    assert smoothed.value_error[505] > 1.2 * smoothed.value_error[1500]
    for unknown in (np.full(2000, np.nan), np.zeros(2000)):
        np.testing.assert_array_equal(smooth_with_rate(holed, unknown, PERIOD).velocity, smooth(holed, PERIOD).velocity)
    with pytest.raises(ValueError, match="at least 5 samples, got 3"):
        smooth_with_rate(np.zeros(3), np.zeros(3), PERIOD)


@pytest.mark.parametrize("window", [5, 23, 61])
@pytest.mark.parametrize("derivative", [0, 1, 2])
def test_filters_are_those_of_savitzky_and_golay_to_the_ends(window, derivative):
    values = np.random.default_rng(0).standard_normal(61).cumsum()
    expected = savgol_filter(values, window, 3, deriv=derivative)
    np.testing.assert_allclose(_filtered(values, window, derivative), expected, rtol=1e-9, atol=1e-9)
