"""How well a fit says it knows its parameters."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from simopt_envs.gap.fit import DIFFERENCES, Fit, Misfit
from simopt_envs.physics.parameters import Array

_WINDOWS, _SAMPLES = 24, 26
_TRIALS = 400


def _spread(of_window: float) -> tuple[float, float]:
    """Standard deviation of a fitted slope over many data, and what fits say of it.

    Errors are of variance 1 by their noise; those of a window share another error besides.
    """
    rng = np.random.default_rng(0)
    jacobian = rng.normal(size=(_WINDOWS, 1, 1)) + 0.3 * rng.normal(size=(_WINDOWS, _SAMPLES, 1))
    found, said = [], []
    for _ in range(_TRIALS):
        errors = rng.normal(size=(_WINDOWS, _SAMPLES, 1)) + of_window * rng.normal(size=(_WINDOWS, 1, 1))
        u = -np.sum(jacobian * errors) / np.sum(jacobian**2)
        fit = Fit(np.array([u]), errors + jacobian * u, jacobian.reshape(-1, 1), np.array([1e6]), np.zeros(_WINDOWS))
        found.append(u)
        said.append(fit.variance([fit.jacobian])[0])
    return float(np.std(found)), float(np.sqrt(np.mean(said)))


def test_errors_that_go_together_within_a_window_count_as_such():
    found, said = _spread(of_window=2.0)
    assert said == pytest.approx(found, rel=0.15)
    assert found > 5 * _spread(of_window=0.0)[0]  # which is what their noise alone would leave


def test_independent_errors_are_worth_what_their_noise_says():
    found, said = _spread(of_window=0.0)
    assert said == pytest.approx(found, rel=0.15)


class _TwoAsOne(Misfit):
    """Errors that two parameters change alike, but for some roughness."""

    def __init__(self, roughness: float):
        rng = np.random.default_rng(0)
        self._slope = rng.normal(size=(_WINDOWS, _SAMPLES, 1))
        self._rough = roughness * rng.normal(size=(2, _WINDOWS, _SAMPLES, 1))
        self._waves = rng.uniform(100.0, 1000.0, size=(2, _WINDOWS, _SAMPLES, 1))
        self.hypothesis: Any = SimpleNamespace(
            products=[], reach=np.ones_like, low=np.full(2, -9.0), high=np.full(2, 9.0), prior_std=np.ones(2)
        )

    def errors(self, u: Array) -> Array:
        each = u[:, :, None, None, None]
        return np.sum(self._slope * each + self._rough * np.sin(self._waves * each), axis=1)


@pytest.mark.parametrize(("roughness", "once_enough"), [(0.0, True), (0.02, False)])
def test_what_is_rough_in_a_prediction_tells_no_two_parameters_apart(roughness, once_enough):
    misfit, at = _TwoAsOne(roughness), np.zeros(2)
    *_, other, small = (misfit.jacobian(at, [0, 1], difference) for difference in DIFFERENCES)
    found = Fit(at, np.zeros((_WINDOWS, _SAMPLES, 1)), small, np.ones(2), np.zeros(_WINDOWS))
    assert found.variance([other]) == pytest.approx(0.5, rel=0.1)  # their sum alone is known
    assert (found.variance([small])[0] > 0.45) == once_enough


def test_what_other_differences_confirm_is_known_as_well_as_without():
    jacobian = np.random.default_rng(0).normal(size=(_WINDOWS * _SAMPLES, 3))
    fit = Fit(np.zeros(3), np.zeros((_WINDOWS, _SAMPLES, 1)), jacobian, np.array([1.0, 1.0, 100.0]), np.zeros(_WINDOWS))
    np.testing.assert_allclose(fit.variance([jacobian]), np.diag(np.linalg.inv(fit.rows.T @ fit.rows)), rtol=1e-6)


def test_two_free_parameters_that_are_one_in_the_data_are_as_unknown_as_they_are_free():
    """Their sum is known to a millionth, either not at all."""
    column = 1e5 * np.random.default_rng(0).normal(size=(_WINDOWS * _SAMPLES, 1))
    jacobian, free = np.hstack([column, column]), np.full(2, 100.0)
    fit = Fit(np.zeros(2), np.zeros((_WINDOWS, _SAMPLES, 1)), jacobian, free, np.zeros(_WINDOWS))
    assert fit.variance([jacobian]) == pytest.approx(free**2 / 2, rel=0.1)


@pytest.mark.parametrize(("roughness", "asked"), [(0.2, True), (10.0, False)])
def test_derivatives_that_are_much_rougher_than_others_are_not_asked(roughness, asked):
    rng = np.random.default_rng(0)
    jacobian, small, large = rng.normal(size=(3, _WINDOWS * _SAMPLES, 2))
    fit = Fit(np.zeros(2), np.zeros((_WINDOWS, _SAMPLES, 1)), jacobian, np.ones(2), np.zeros(_WINDOWS))
    near, other = 0.7 * jacobian + 0.1 * small, 0.5 * jacobian + roughness * large
    assert np.all((fit.variance([near, other]) > fit.variance([near])) == asked)
