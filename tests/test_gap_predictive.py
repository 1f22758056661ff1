"""What a fit leaves uncertain is no gap; what the model lacks is one all the same."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from conftest import needs_effects
from gap_plant import MODEL, halves, record
from scipy.stats import multivariate_normal

from simopt_envs.gap.fit import Fit
from simopt_envs.gap.hypothesis import Candidate
from simopt_envs.gap.motion import motion_of
from simopt_envs.gap.plain import plain_parameters
from simopt_envs.gap.predictive import HeldOut, precision
from simopt_envs.gap.search import Search
from simopt_envs.gap.thresholds import EXPLAINED
from simopt_envs.gap.trial import Base
from simopt_envs.physics.effects import EFFECTS

pytestmark = needs_effects


def fitted(friction: float, windows: int) -> Base:
    """The model, which lacks some friction of the elbow, fitted to so many windows."""
    recordings = record(lambda q, v: np.array([0.0, -friction * np.tanh(v[1] / 0.01)]), np.random.default_rng(0))
    plain = plain_parameters(mujoco.MjSpec.from_string(MODEL))
    data = halves(plain.model, recordings)
    some = replace(data, fitted=data.fitted.select(np.arange(windows)))
    candidates = (Candidate(EFFECTS["coulomb_friction"], "joint:elbow"),)
    return Search(plain, some, motion_of(plain.model, recordings), candidates).base()


@pytest.mark.parametrize(("friction", "explained"), [(0.0, True), (0.4, False)])
def test_what_one_second_tells_of_the_parameters_leaves_the_rest_uncertain(friction, explained):
    base = fitted(friction, windows=2)
    right = EXPLAINED - 1
    assert base.excess > 1.5 * right
    assert (base.unforeseen < right) == explained


def test_surprise_is_that_of_the_predictive_distribution():
    rng = np.random.default_rng(0)
    fitted, held_out = rng.normal(size=(6, 4, 2, 3)), rng.normal(size=(5, 4, 2, 3))
    errors, worth = rng.normal(size=(5, 4, 2)), np.array([1.0, 0.3])
    fit = Fit(np.zeros(3), rng.normal(size=(6, 4, 2)), fitted.reshape(-1, 3), np.array([1.0, 2.0, 100.0]), np.zeros(6))
    known = precision(fit, np.full(3, np.inf), worth)
    each = np.sqrt(worth)[:, None]
    seen, unseen = ((each * jacobian).reshape(-1, 3) for jacobian in (fitted, held_out))
    posterior = np.linalg.inv(seen.T @ seen + np.diag(fit.prior_std**-2.0))
    predictive = multivariate_normal(cov=np.eye(errors.size) + unseen @ posterior @ unseen.T)
    shared = 0.5 * errors.size * np.log(2 * np.pi)
    surprise = HeldOut(errors, held_out, np.zeros(5)).surprise(known, worth, (np.full(3, -np.inf), np.full(3, np.inf)))
    assert surprise == pytest.approx(-predictive.logpdf((each[:, 0] * errors).ravel()) - shared)


def test_what_fitted_data_leave_open_takes_errors_only_as_far_as_bounds_allow():
    nothing = Fit(np.zeros(1), np.zeros((1, 4, 1)), np.zeros((4, 1)), np.array([100.0]), np.zeros(1))
    held_out = HeldOut(np.full((1, 4, 1), 9.0), np.ones((1, 4, 1, 1)), np.zeros(1))  # a u of -9 would undo them
    one, free = np.ones(1), np.array([np.inf])
    anywhere, near, unknown = (-free, free), (-one, one), precision(nothing, free, one)
    assert held_out.excused(unknown, anywhere) == pytest.approx(4 * 81.0, rel=1e-3)
    assert held_out.excused(unknown, near) == pytest.approx(4 * (81.0 - 64.0), rel=1e-3)
    assert held_out.excused(precision(nothing, 2 * one, one), near) < 4 * (81.0 - 64.0)


def test_plain_parameters_are_strained_by_many_a_little_as_by_one_a_lot():
    base = fitted(friction=0.0, windows=2)
    plain = base.hypothesis.num_plain

    def at(*u: float) -> Base:
        return replace(base, fit=replace(base.fit, u=np.array([*u, *np.zeros(plain - len(u))])))

    assert not base.strained
    assert not at(*np.full(plain, 1.0)).strained
    assert not at(*np.full(plain, 1.5)).strained
    assert at(*np.full(plain, 2.5)).strained


def test_nothing_is_excused_where_the_model_does_not_fit_what_was_fitted():
    base = fitted(friction=0.1, windows=8)
    assert base.unforeseen == base.excess > EXPLAINED - 1
