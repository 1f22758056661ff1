"""How well a fit says it knows its parameters."""

from __future__ import annotations

import numpy as np
import pytest

from simopt_envs.gap.fit import Fit

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
        fit = Fit(np.array([u]), errors + jacobian * u, jacobian.reshape(-1, 1), np.array([1e6]))
        found.append(u)
        said.append(fit.variance()[0])
    return float(np.std(found)), float(np.sqrt(np.mean(said)))


def test_errors_that_go_together_within_a_window_count_as_such():
    found, said = _spread(of_window=2.0)
    assert said == pytest.approx(found, rel=0.15)
    assert found > 5 * _spread(of_window=0.0)[0]  # which is what their noise alone would leave


def test_independent_errors_are_worth_what_their_noise_says():
    found, said = _spread(of_window=0.0)
    assert said == pytest.approx(found, rel=0.15)
