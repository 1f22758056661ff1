"""Fits of hypotheses: coordinates in which laws are linear, differences that fit an effect's size, ways over walls."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from conftest import needs_effects
from gap_plant import MODEL, record

from simopt_envs.adaptation.fitting import Noise
from simopt_envs.gap import fit as fits
from simopt_envs.gap import looks
from simopt_envs.gap.chart import Chart
from simopt_envs.gap.hypothesis import Candidate, Hypothesis
from simopt_envs.gap.known import completed, of_silent
from simopt_envs.gap.large import of_some_size
from simopt_envs.gap.motion import motion_of
from simopt_envs.gap.plain import plain_parameters
from simopt_envs.gap.recordings import read_windows
from simopt_envs.physics.effects import EFFECTS
from simopt_envs.physics.effects.joint_spring import JointSpring

pytestmark = needs_effects

SPRING = Candidate(EFFECTS["joint_spring"], "joint:shoulder")
STIFFNESS, REST = 12.0, -1.5


@pytest.fixture(scope="module")
def arm():
    """An arm whose shoulder a spring pulls far away, and its windows."""
    plain = plain_parameters(mujoco.MjSpec.from_string(MODEL))
    recordings = record(lambda q, v: np.array([-STIFFNESS * (q[0] - REST), 0.0]), np.random.default_rng(0))
    motion = motion_of(plain.model, recordings)
    hypothesis = Hypothesis(plain, [SPRING], motion)
    return hypothesis, fits.Misfit(hypothesis, read_windows(plain.model, recordings).fitted)


def _at(hypothesis: Hypothesis, stiffness: float, reference: float) -> np.ndarray:
    values = {SPRING.full_name("stiffness"): stiffness, SPRING.full_name("reference"): reference}
    u = hypothesis.coordinates(hypothesis.space.values(values))
    u[: hypothesis.num_plain] = 0.0
    return u


def test_coordinates_of_a_chart_mean_the_same(arm):
    hypothesis, _ = arm
    chart = Chart(hypothesis, range(len(hypothesis.space)))
    u = np.array([_at(hypothesis, 12.0, -1.5), _at(hypothesis, 0.5, 3.0)])
    x = chart.straight(u)
    assert np.all(np.abs(x - u).max(axis=1) > 0.1)
    np.testing.assert_allclose(chart.bent(x), u, rtol=1e-12)
    np.testing.assert_array_equal(Chart(hypothesis, ()).straight(u), u)


def test_derivatives_by_a_chart_are_those_by_u(arm):
    hypothesis, misfit = arm
    u, chart = _at(hypothesis, 12.0, -1.5), Chart(hypothesis, range(len(hypothesis.space)))
    by_x = misfit.jacobian(u, difference=1e-3, chart=chart)
    by_u = misfit.jacobian(u, difference=1e-3)
    np.testing.assert_allclose(chart.by_u(by_x, u), by_u, atol=1e-4 * np.abs(by_u).max())


def test_differences_in_a_shape_shrink_with_the_amount_of_its_effect(arm):
    hypothesis, _ = arm
    _, reference = hypothesis.columns[SPRING]
    weak, strong = (hypothesis.reach(_at(hypothesis, k, -1.5)) for k in (1e-3, 60.0))
    assert weak[reference] == 1.0
    amount = _at(hypothesis, 60.0, -1.5)[hypothesis.columns[SPRING][0]]
    assert strong[reference] == pytest.approx(1 / amount)
    assert np.all(np.delete(strong, reference) == 1.0)


@pytest.mark.parametrize(("levers", "right"), [(("reference",), True), ((), False)])
def test_a_spring_that_is_taken_for_a_stiffer_one_is_found(arm, monkeypatch, levers, right):
    """A spring of thrice the stiffness that pulls as hard in the middle; in its own coordinates the fit ends early."""
    monkeypatch.setattr(JointSpring, "levers", levers)
    hypothesis, misfit = arm
    start = _at(hypothesis, 3 * STIFFNESS, 0.3 + (REST - 0.3) / 3)
    misfit = misfit.with_noise(misfit.noise_at(start, np.array([5e-4, 5e-4, 1e-3, 1e-3, 1e-3])))
    found = fits.fit(misfit, start, 5, differences=(0.3,))
    stiffness = hypothesis.values(SPRING, hypothesis.xi(found.u[None])[0])["stiffness"]
    assert (stiffness == pytest.approx(STIFFNESS, rel=0.05)) == right, stiffness


def test_a_large_effect_is_tried_in_each_shape_at_the_size_that_this_needs(arm):
    hypothesis, misfit = arm
    found = of_some_size(misfit, SPRING, hypothesis.neutral())
    nearest, *others = (hypothesis.values(SPRING, xi) for xi in hypothesis.xi(found))
    assert len({spring["reference"] for spring in (nearest, *others)}) == 3
    # The true one rests far below where the arm moves; one that rests nearer must be stiffer to pull as hard.
    assert all(REST < nearest["reference"] < other["reference"] for other in others)
    assert nearest["stiffness"] > STIFFNESS


@pytest.mark.parametrize("times", [3, 0])
def test_a_fit_looks_beyond_a_wall(monkeypatch, times):
    """Errors that fall by steps of 2, but for a wall from 10 to 14, as of a window in which something catches."""
    monkeypatch.setattr(fits, "_LOOKS", times)
    bounds = np.full(1, 100.0)
    hypothesis: Any = SimpleNamespace(num_plain=0, low=-bounds, high=bounds, prior_std=bounds, products=[], columns={})
    hypothesis.reach, hypothesis.neutral = np.ones_like, lambda: np.zeros(1)
    misfit = object.__new__(fits.Misfit)
    misfit.hypothesis, misfit.noise = hypothesis, Noise.of(np.ones(1), np.zeros((1, 1, 20, 1)))
    samples = np.linspace(-1.0, 1.0, 20)

    def errors(u: np.ndarray) -> np.ndarray:
        wall = np.where((u > 10) & (u < 14), 3.0, 0.0)
        return (300 * np.exp(-u / 2) * samples + wall).reshape(-1, 1, 20, 1)

    monkeypatch.setattr(misfit, "errors", errors)
    (end,) = fits.fit(misfit, np.array([4.0]), 20).u
    assert (end > 14) == (times > 0), end


def test_a_fit_looks_at_other_sizes_with_all_else_where_it_then_belongs():
    """Here p belongs at 2 a and a at 8, of which the derivative by a tells nothing."""
    bounds = np.full(2, 30.0)
    hypothesis: Any = SimpleNamespace(low=-bounds, high=bounds, prior_std=bounds, products=[], columns={SPRING: [1]})
    hypothesis.amounts, hypothesis.neutral = lambda _: [1], lambda: np.zeros(2)

    def residual(x: np.ndarray) -> np.ndarray:
        return np.array([10 * (x[0] - 2 * x[1]), x[1] - 8])

    rows = np.array([[10.0, 0.0], [0.0, 0.0]])
    ahead = looks.of_other_sizes(np.array([2.0, 1.0]), rows, residual, Chart(hypothesis, ()), hypothesis)
    np.testing.assert_allclose(ahead, [[10.0, 5.0], [6.0, 3.0], [3.4, 1.7]])


def test_derivatives_are_taken_once_at_each_place(arm, monkeypatch):
    """They cost two simulations a coordinate; those where a fit ends are part of what it returns."""
    hypothesis, misfit = arm
    start = _at(hypothesis, STIFFNESS, REST)
    misfit = misfit.with_noise(misfit.noise_at(start, np.array([5e-4, 5e-4, 1e-3, 1e-3, 1e-3])))
    taken, take = [], fits.Misfit.jacobian

    def noted(self: fits.Misfit, u: np.ndarray, columns: Any, difference: float, chart: Chart) -> np.ndarray:
        taken.append((difference, *u))
        return take(self, u, columns, difference, chart)

    monkeypatch.setattr(fits.Misfit, "jacobian", noted)
    found = fits.fit(misfit, start, 5, differences=(0.3, 0.1))
    assert len(taken) == len(set(taken)) >= 2
    assert (0.1, *found.u) in taken


def test_derivatives_from_before_tell_what_a_step_changed():
    """And nothing new of what lies across it, in coordinates that the data tell alike."""
    rng = np.random.default_rng(0)
    rows, step, changed = rng.normal(size=(8, 3)) * [1.0, 10.0, 100.0], rng.normal(size=3), rng.normal(size=8)
    derivatives = fits._Derivatives(lambda _: rows)
    assert derivatives.after_step(np.zeros(3), np.zeros(8)) is rows
    assert derivatives.are_taken(np.zeros(3))
    after = derivatives.after_step(step, changed)
    np.testing.assert_allclose(after @ step, changed, rtol=1e-12)
    weights = np.sum(rows**2, axis=0)
    across = np.cross(weights * step, rng.normal(size=3))
    np.testing.assert_allclose(after @ across, rows @ across, rtol=1e-9)
    assert not derivatives.are_taken(step)
    assert derivatives.taken(step) is rows


def test_a_fit_takes_derivatives_where_those_from_before_gain_no_more():
    """Along the bent valley of Rosenbrock's function to its end, with a few of the derivatives that steps need."""
    hypothesis: Any = SimpleNamespace(
        num_plain=0, low=np.full(2, -9.0), high=np.full(2, 9.0), prior_std=np.full(2, np.inf), products=[]
    )
    taken, tried = [], []

    def residual(x: np.ndarray) -> np.ndarray:
        tried.append(x)
        return np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])

    def take(x: np.ndarray) -> np.ndarray:
        taken.append(tuple(x))
        return np.array([[-20 * x[0], 10.0], [-1.0, 0.0]])

    derivatives = fits._Derivatives(take)
    end = fits._descended(np.array([-1.2, 1.0]), residual, derivatives, Chart(hypothesis, ()), 50)
    np.testing.assert_allclose(end, 1.0, atol=1e-2)
    assert taken[-1] == tuple(end)
    assert len(set(taken)) == len(taken) < len(tried) / 2


def test_a_fit_takes_no_derivatives_where_all_are_known(arm, monkeypatch):
    """It goes on from a fit nearby to about where one that takes them ends."""
    hypothesis, misfit = arm
    start = _at(hypothesis, STIFFNESS, REST)
    misfit = misfit.with_noise(misfit.noise_at(start, np.array([5e-4, 5e-4, 1e-3, 1e-3, 1e-3])))
    right = fits.fit(misfit, start, 20, differences=(0.1,))
    off = np.clip(right.u + 0.1, hypothesis.low, hypothesis.high)
    monkeypatch.setattr(fits.Misfit, "jacobian", None)
    found = fits.fit(misfit, off, 20, right.jacobian, (0.1,))
    assert misfit.losses(off[None])[0] > 20 * right.loss
    assert found.loss == pytest.approx(right.loss, abs=0.5)


def test_a_fit_takes_no_derivatives_by_plain_parameters_that_hardly_show(arm, monkeypatch):
    """It ends where one ends that takes all of them."""
    hypothesis, misfit = arm
    start = _at(hypothesis, STIFFNESS, REST)
    misfit = misfit.with_noise(misfit.noise_at(start, np.array([5e-2, 5e-2, 1e-1, 1e-1, 1e-1])))
    off = np.clip(start + 0.1, hypothesis.low, hypothesis.high)
    right = fits.fit(misfit, off, 20, differences=(0.1,))
    known = of_silent(misfit.jacobian(off), hypothesis.num_plain)
    silent = np.isfinite(known).all(axis=0)
    assert 0 < np.sum(silent) < hypothesis.num_plain
    taken = set()
    jacobian = fits.Misfit.jacobian
    monkeypatch.setattr(fits.Misfit, "jacobian", lambda m, u, c, *more: taken.update(c) or jacobian(m, u, c, *more))
    found = fits.fit(misfit, off, 20, known, (0.1,))
    assert taken == set(np.flatnonzero(~silent))
    assert found.loss == pytest.approx(right.loss, abs=0.05)
    np.testing.assert_allclose(found.u, right.u, atol=0.05)


def test_the_shape_of_an_effect_is_taken_though_it_does_not_show():
    """Where there is none of it, it does not, and may where there is some."""
    jacobian = np.array([[1.0, 0.1, 0.0], [2.0, 0.1, 0.0]])
    np.testing.assert_array_equal(of_silent(jacobian, 2), [[np.nan, 0.1, np.nan], [np.nan, 0.1, np.nan]])
    taken = completed(of_silent(jacobian, 2), 4, lambda columns: np.tile(columns, (2, 1)))
    np.testing.assert_array_equal(taken, [[0, 0.1, 2, 3], [0, 0.1, 2, 3]])
    np.testing.assert_array_equal(completed(None, 2, lambda columns: np.tile(columns, (2, 1))), [[0, 1], [0, 1]])
