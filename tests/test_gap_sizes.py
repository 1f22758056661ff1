"""Sizes of effects by windows of other lengths."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from conftest import needs_effects
from gap_plant import MODEL, record

from simopt_envs.gap import find, find_gap, search
from simopt_envs.gap.fit import Misfit
from simopt_envs.gap.hypothesis import Candidate
from simopt_envs.gap.motion import motion_of
from simopt_envs.gap.plain import plain_parameters
from simopt_envs.gap.predictive import HeldOut
from simopt_envs.gap.recordings import read_windows
from simopt_envs.gap.search import Search
from simopt_envs.gap.sizes import of_best_length
from simopt_envs.gap.thresholds import SHORTER_WINDOWS
from simopt_envs.physics.effects import EFFECTS

pytestmark = needs_effects

DRY = Candidate(EFFECTS["coulomb_friction"], "joint:elbow")
FRICTION = 0.4  # N m


def _friction(v, peak=0.0):
    return np.array([0.0, -(FRICTION + peak * np.exp(-((v[1] / 0.2) ** 2))) * np.tanh(v[1] / 0.005)])


@pytest.fixture(scope="module")
def fitted():
    """The right law fitted, the data, and what fitted it."""
    plain = plain_parameters(mujoco.MjSpec.from_string(MODEL))
    recordings = record(lambda q, v: _friction(v), np.random.default_rng(0))
    data = read_windows(plain.model, recordings)
    search = Search(plain, data, motion_of(plain.model, recordings), (DRY,))
    return search.base((DRY,)), data, search.fit


@pytest.mark.parametrize(
    ("wrong", "tolerance", "stays"), [(1.5, 1.0, False), (1.0, 1.0, True), (1.01, 1.0, True), (1.01, 5.0, False)]
)
def test_shorter_windows_tell_a_size_if_they_predict_what_was_held_out_better(fitted, wrong, tolerance, stays):
    """A size that is 1.5 times too large is told anew, one that is nearly right only if errors count in more anyway."""
    base, data, fit = fitted
    hypothesis, test = base.hypothesis, Misfit(base.hypothesis, data.held_out).with_noise(base.held_out_noise)
    xi = hypothesis.xi(base.fit.u[None])[0]
    xi[hypothesis.columns[DRY]] *= wrong
    u = hypothesis.coordinates(xi)
    counted = tolerance * base.tolerance
    given = replace(base, fit=replace(base.fit, u=u), held_out=HeldOut.of(test, u, counted), tolerance=counted)
    found = of_best_length(given, data, fit)
    assert (found is given) == stays
    (friction,) = hypothesis.values(DRY, hypothesis.xi(found.fit.u[None])[0]).values()
    assert friction == pytest.approx(FRICTION, rel=0.05)
    assert found.excess <= given.excess


def test_fits_to_shorter_windows_are_kept(fitted, tmp_path, monkeypatch):
    """A second search of the same needs none, and tells of as many."""
    base, data, _ = fitted
    shown = []

    def sizes():
        fit = Search(base.hypothesis.plain, data, base.hypothesis.motion, (DRY,), directory=tmp_path).fit
        return of_best_length(base, data, fit, lambda *done: shown.append(done))

    found = sizes()
    monkeypatch.setattr(search, "fit", lambda *_, **__: pytest.fail("a fit is done again"))
    assert sizes().fit.u.tobytes() == found.fit.u.tobytes()
    assert shown == [("fit to shorter windows", i, len(SHORTER_WINDOWS)) for i in range(len(SHORTER_WINDOWS))] * 2


@pytest.mark.parametrize(("peak", "verdict", "times"), [(2.0, "partly", 1), (0.0, "named", 0)])
def test_other_lengths_are_tried_where_no_model_is_right(monkeypatch, peak, verdict, times):
    """A friction with a peak at rest, of which the library knows none here, and one without."""
    tried = []
    monkeypatch.setattr(find, "of_best_length", lambda base, *_: tried.append(base) or base)
    recordings = record(lambda q, v: _friction(v, peak), np.random.default_rng(0), count=2)
    gap = find_gap(mujoco.MjSpec.from_string(MODEL), recordings, effects=[DRY.effect])
    assert (gap.verdict, len(tried)) == (verdict, times)
