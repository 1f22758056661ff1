"""Where fits of candidates begin, and second thoughts: an effect is held against its rivals beside the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from conftest import needs_effects
from gap_plant import MODEL, Law, halves, record

from simopt_envs.engine import LocalEngine
from simopt_envs.gap import fit as fits
from simopt_envs.gap import screen as screens
from simopt_envs.gap import search as searches
from simopt_envs.gap.explanation import ranked
from simopt_envs.gap.fit import CONFIRMING, DIFFERENCES, Misfit
from simopt_envs.gap.hypothesis import Candidate, Hypothesis
from simopt_envs.gap.motion import motion_of
from simopt_envs.gap.plain import plain_parameters
from simopt_envs.gap.presence import is_there
from simopt_envs.gap.refit import Refit, grown
from simopt_envs.gap.screen import made_by_probes, screen
from simopt_envs.gap.search import Search
from simopt_envs.gap.selection import score_of, worth_of
from simopt_envs.gap.thresholds import EVIDENCE, LARGE, PROBED_LARGER
from simopt_envs.gap.trial import Base
from simopt_envs.physics.effects import EFFECTS
from simopt_envs.physics.parameters import Array

pytestmark = needs_effects

SPRING = Candidate(EFFECTS["joint_spring"], "joint:shoulder")
DRY = Candidate(EFFECTS["coulomb_friction"], "joint:elbow")
COGGING = Candidate(EFFECTS["cogging"], "joint:elbow")
PUSH = Candidate(EFFECTS["actuator_bias"], "actuator:shoulder")
LIMIT = Candidate(EFFECTS["actuator_saturation"], "actuator:elbow")
PLAY = Candidate(EFFECTS["backlash"], "joint:elbow")
PEAKED = Candidate(EFFECTS["stribeck_friction"], "joint:elbow")
ONE_SIDED = Candidate(EFFECTS["asymmetric_friction"], "joint:elbow")


def _search(forces: Law, candidates: Sequence[Candidate], limit: float | None = None) -> Search:
    plain = plain_parameters(mujoco.MjSpec.from_string(MODEL))
    recordings = record(forces, np.random.default_rng(0), limit=limit)
    return Search(plain, halves(plain.model, recordings), motion_of(plain.model, recordings), candidates)


def _off(search: Search, base: Base) -> Array:
    return Misfit(base.hypothesis, search.data.fitted).with_noise(base.noise).off(base.fit.u[None])[0]


def test_only_probes_that_hardly_show_are_tried_larger_too():
    """Of plays of several sizes, those that change all errors together by too little to earn a name."""
    search = _search(lambda q, v: np.zeros(2), (PLAY,))
    hypothesis = Hypothesis(search.plain, (PLAY,), search.motion)
    given, base = hypothesis.probes(PLAY), search.base()
    probed = made_by_probes(hypothesis, base, _off(search, base), search.data.fitted, 1)
    changed = np.linalg.norm(base.noise.whiten(probed.changes).reshape(len(probed.own), -1), axis=1)
    small = changed[: len(given)] < np.sqrt(2 * EVIDENCE)
    assert 0 < small.sum() < len(given)
    amounts = [hypothesis.columns[PLAY].index(i) for i in hypothesis.amounts(PLAY)]
    given = given[:, hypothesis.columns[PLAY]]
    np.testing.assert_allclose(probed.own[: len(given), amounts], given[:, amounts])
    np.testing.assert_allclose(probed.own[len(given) :, amounts], PROBED_LARGER * given[small][:, amounts])
    assert np.all(changed[len(given) :] > 2 * changed[: len(given)][small])


@pytest.mark.parametrize("size", [0.0, 0.2])
def test_what_takes_much_of_held_out_errors_is_fitted_wherever_the_screen_has_it(monkeypatch, size):
    """Dry friction, which the screen is made to have last; without friction the first candidate alone is fitted."""
    monkeypatch.setattr(screens, "REFITTED", 1)
    monkeypatch.setattr(searches, "REFITTED_AT_MOST", 1)
    monkeypatch.setattr(searches, "screen", lambda *given: screen(*given)[::-1])
    search = _search(lambda q, v: np.array([0.0, -size * np.tanh(v[1] / 0.01)]), (SPRING, COGGING, PUSH, DRY))
    base = search.base()
    assert base.excess < LARGE  # or it would be fitted for that
    stage = search.stage(base)
    assert (DRY in stage.trials) == (size > 0)
    if size:
        assert stage.screened[-1].candidate == DRY
    else:
        assert set(stage.trials) == {stage.screened[0].candidate}


@pytest.mark.parametrize(
    ("push", "size", "fitted"),
    [
        (3.0, 0.0, [3]),  # no further effect could be taken: none is tried
        (3.0, 0.3, [3, 2]),  # of three
        (0.5, 0.0, [3, 1]),  # one could be, but little speaks for any
        (0.5, 0.05, [3, 2, 1]),
    ],
)
def test_where_noise_alone_may_be_left_little_is_tried_or_nothing(push, size, fitted):
    """How many candidates are fitted at each stage where a constant force is hidden, and a friction with it or not."""
    search = _search(lambda q, v: np.array([-push, -size * np.tanh(v[1] / 0.01)]), (DRY, COGGING, PUSH))
    found = search.run()
    assert [len(stage.scores) for stage in found.stages] == fitted
    assert {score.candidate for score in found.effects} == ({PUSH, DRY} if size else {PUSH})


@pytest.mark.parametrize(("candidate", "alike"), [(DRY, True), (COGGING, False)])
def test_of_a_model_that_is_built_alike_the_base_is_not_simulated_again(monkeypatch, candidate, alike):
    search = _search(lambda q, v: np.zeros(2), (candidate,))
    base = search.base()
    hypothesis = Hypothesis(search.plain, (candidate,), search.motion)
    assert hypothesis.is_built_as(base.hypothesis) is alike
    given = hypothesis, base, _off(search, base), search.data.fitted, 1
    changes = made_by_probes(*given).changes
    monkeypatch.setattr(Hypothesis, "is_built_as", lambda *_: False)
    np.testing.assert_array_equal(made_by_probes(*given).changes, changes)


@pytest.mark.parametrize("size", [0.0, 0.2])
def test_a_screen_simulates_again_only_what_those_before_promise_something_of(size):
    """Beside a constant force, once that is found: a friction, which other candidates can stand in for, or nothing."""
    search = _search(lambda q, v: np.array([-3.0, -size * np.tanh(v[1] / 0.01)]), (DRY, SPRING, PUSH))
    search._screened(search.base())
    before, base = dict(search._probed), search.base((PUSH,))
    gains = {one.candidate: one.gain for one in search._screened(base)}
    again = {c for c in gains if search._probed[c] is not before[c]}
    assert DRY in again if size else not again
    search._probed.clear()
    for one in search._screened(base):
        assert gains[one.candidate] == pytest.approx(one.gain, rel=0.1, abs=0.5)


def test_the_sensors_noise_is_told_with_what_explains_errors_that_looked_like_it():
    """The elbow's, which friction makes stop and go within a sample."""
    smooth, rough = (
        _search(lambda q, v, size=size: np.array([0.0, -size * np.tanh(v[1] / 0.01)]), (DRY,)).run()
        for size in (0.0, 1.0)
    )
    expected, before, after = (base.sensor_noise for base in (smooth.null, rough.null, rough.final))
    assert before[1] > 1.2 * expected[1]
    np.testing.assert_allclose(after, expected, rtol=0.01)


@pytest.mark.parametrize("push", [0.0, 2.0])
def test_what_errors_are_counted_in_is_what_is_left_of_them_counted_so(push):
    """Of a model that is far off, starts do not explain most of it; of a right one noise alone is left."""
    search = _search(lambda q, v: np.array([push, 0.0]), (PUSH,))
    base = search.base()
    tolerance = search._tolerance_of(base)
    assert np.all(tolerance == 1) == (push == 0), tolerance
    misfit = Misfit(base.hypothesis, search.data.held_out)
    counted = misfit.with_noise(misfit.noise_at(base.fit.u, tolerance * base.sensor_noise))
    left = 1 / np.sqrt(worth_of(tolerance * counted.errors(base.fit.u[None])[0]))
    assert left == pytest.approx(tolerance, rel=0.08)
    beside_sensors_noise = 1 / np.sqrt(worth_of(base.held_out.errors))
    assert np.any(beside_sensors_noise < 0.9 * tolerance) == (push > 0), (beside_sensors_noise, tolerance)


def test_a_fit_does_not_end_in_the_period_that_its_best_start_is_near():
    """Cogging with 21 periods per radian: of all probes' starts, the nearest to the data leads to 22."""
    hidden = lambda q, v: np.array([0.0, -0.5 * np.tanh(v[1] / 0.01) - 0.1 * np.sin(21 * q[1] + 1.0)])  # noqa: E731
    search = _search(hidden, (DRY, COGGING))
    (score,) = search.stage(search.base((DRY,))).scores
    hypothesis, u = score.trial.hypothesis, score.trial.fit.u
    assert hypothesis.values(COGGING, hypothesis.xi(u[None])[0])["periods"] == pytest.approx(21.0, rel=0.02)


def test_a_fit_goes_on_from_elsewhere_only_if_that_ends_better():
    """Of cogging with 21 periods per radian, from near 30."""
    hidden = lambda q, v: np.array([0.0, -0.5 * np.tanh(v[1] / 0.01) - 0.1 * np.sin(21 * q[1] + 1.0)])  # noqa: E731
    search = _search(hidden, (DRY, COGGING))
    base = search.base((DRY,))
    (screened,) = search._screened(base)
    hypothesis = screened.hypothesis

    def with_periods(periods: float) -> np.ndarray:
        values = {"amplitude": 0.1, "periods": periods, "phase": 1.0}
        xi = hypothesis.space.values({COGGING.full_name(name): value for name, value in values.items()})
        return np.concatenate([base.fit.u, hypothesis.coordinates(xi)[len(base.fit.u) :]])

    def periods_from(*others: np.ndarray) -> float:
        refit = Refit(screened, near=with_periods(30.0), others=others)
        (trial,) = search.trials(base, [refit]).values()
        return hypothesis.values(COGGING, hypothesis.xi(trial.fit.u[None])[0])["periods"]

    assert periods_from(with_periods(21.0)) == pytest.approx(21.0, rel=0.02)
    assert periods_from() == pytest.approx(29.3, rel=0.01)
    assert periods_from(with_periods(40.0)) == pytest.approx(29.3, rel=0.01)


@pytest.mark.parametrize("factor", [1, 30])
def test_a_candidate_that_is_fitted_further_has_the_noise_of_its_own_starts_where_that_is_likelier(monkeypatch, factor):
    """By a factor too large, as where a small play lets uncertain starts run away to first order, it is not."""
    search = _search(lambda q, v: np.array([0.0, -0.5 * np.tanh(v[1] / 0.01)]), (DRY,))
    base = search.base()
    (screened,) = search._screened(base)
    (first,) = search.trials(base, [Refit(screened)]).values()
    sensitivity = fits.start_sensitivity
    monkeypatch.setattr(fits, "start_sensitivity", lambda *of: factor * sensitivity(*of))
    (trial,) = search.trials(base, [Refit(screened, near=first.fit.u)]).values()
    np.testing.assert_array_equal(first.fit.log_det, base.noise.log_det)
    own_windows = 0
    for windows, noise, u, told in (
        (search.data.fitted, base.noise, first.fit.u, trial.fit),
        (search.data.held_out, base.held_out_noise, trial.fit.u, trial.held_out),
    ):
        misfit = Misfit(trial.hypothesis, windows).with_noise(noise)
        own = misfit.with_noise(misfit.noise_at(u, noise.scale))
        of_base, of_own = (np.sum(m.errors(u[None])[0] ** 2, axis=(1, 2)) + m.noise.log_det for m in (misfit, own))
        expected = np.where(of_own < of_base, own.noise.log_det, noise.log_det)
        np.testing.assert_allclose(told.log_det, expected, rtol=1e-12)
        own_windows += int(np.sum(of_own < of_base))
    assert own_windows > 4 if factor == 1 else own_windows <= 4, own_windows
    gain = 0.5 * (np.sum(base.fit.errors**2) - np.sum(trial.fit.errors**2))
    score = score_of(base, DRY, trial, np.ones(len(base.tolerance)))
    price = 0.5 * np.log(base.fit.errors.size)
    of_starts = 0.5 * float(np.sum(base.fit.log_det) - np.sum(trial.fit.log_det))
    assert score.fitted == pytest.approx(gain + of_starts + score.of_prior - price)


@pytest.mark.parametrize(("difference", "right"), [(0.5, ONE_SIDED), (0.0, DRY)])
def test_an_effect_gives_way_to_the_rival_that_explains_more_beside_the_others(difference, right):
    """Friction of the elbow that differs between the directions, or does not, and a spring at the shoulder."""
    hidden = lambda q, v: np.array([-3.0 * q[0], -0.5 * np.tanh(v[1] / 0.01) - difference / 2])  # noqa: E731
    search = _search(hidden, (SPRING, DRY, ONE_SIDED))
    stages = [search.stage(search.base())]
    final, effects = search._revised(search.base((DRY, SPRING)), stages)
    assert {*final.hypothesis.candidates} == {right, SPRING} == {score.candidate for score in effects}
    assert effects[0].total > effects[1].total
    assert stages[1].base.hypothesis.candidates == (SPRING,)
    assert {score.candidate for score in stages[1].scores} == {DRY, ONE_SIDED}


@pytest.mark.parametrize(("stiffness", "kept"), [(3.0, SPRING), (0.3, PUSH)])
def test_far_from_the_data_what_is_taken_is_held_against_its_rivals_anew(stiffness, kept):
    """A constant force was taken for a spring at the shoulder; near the data the first fits are believed."""
    search = _search(lambda q, v: np.array([-stiffness * (q[0] - 2.0), 0.0]), (SPRING, PUSH))
    stage = search.stage(search.base())
    (push,) = (score.trial for score in stage.scores if score.candidate == PUSH)
    base = search._contested([stage], search._sharpened(push), PUSH)
    assert (stage.base.excess > LARGE) == (stiffness > 1)
    assert base.hypothesis.candidates == (kept,)


@pytest.mark.parametrize("friction", [0.5, 0.0])
def test_an_effect_is_there_if_its_interval_leaves_out_none_of_it(friction):
    search = _search(lambda q, v: np.array([0.0, -friction * np.tanh(v[1] / 0.01)]), (DRY,))
    base = search.base((DRY,))
    assert is_there(base.hypothesis, DRY, *base.by_all(search.data)) == (friction > 0)


@pytest.mark.parametrize("friction", [0.02, 0.0])
def test_windows_that_no_fit_saw_may_tell_that_an_effect_is_there(friction):
    """In those fitted the elbow moves so little that they leave it open."""
    search = _search(lambda q, v: np.array([0.0, -friction * np.tanh(v[1] / 0.01)]), (DRY,))
    fitted = search.data.fitted
    travel = np.ptp(fitted.measured[:, :, fitted.names.index("qpos/elbow")], axis=1)
    search.data = replace(search.data, fitted=fitted.select(np.sort(np.argsort(travel)[:6])))
    base = search.base((DRY,))
    assert not is_there(base.hypothesis, DRY, base.fit.u, base.spread(search.data))
    assert is_there(base.hypothesis, DRY, *base.by_all(search.data)) == (friction > 0)


@pytest.mark.parametrize("dropped", [frozenset(), frozenset({DRY})])
@pytest.mark.parametrize(("around_rest", "right"), [(-0.5, DRY), (1.5, PEAKED)])
def test_an_effect_gives_way_to_the_one_that_it_extends_if_what_it_adds_is_not_there(around_rest, right, dropped):
    """Less friction of the elbow at low speed, or more, and a spring; by its gain, the one extended was no rival.

    Or it was one, and gave way when the spring was missing yet.
    """

    def hidden(q: np.ndarray, v: np.ndarray) -> np.ndarray:
        friction = (0.5 + around_rest * np.exp(-((v[1] / 0.3) ** 2))) * np.tanh(v[1] / 0.01)
        return np.array([-3.0 * q[0], -friction])

    search = _search(hidden, (SPRING, DRY, PEAKED))
    stage = search.stage(search.base())
    without = ranked(stage.base, stage.screened, {c: trial for c, trial in stage.trials.items() if c != DRY})
    final, effects = search._revised(search.base((PEAKED, SPRING)), [without], dropped)
    assert {*final.hypothesis.candidates} == {right, SPRING} == {score.candidate for score in effects}


def test_friction_that_turns_out_alike_in_both_directions_gives_way_to_coulomb_friction():
    """It was taken while a spring was missing, which made up a difference."""
    search = _search(lambda q, v: np.array([-3.0 * q[0], -0.5 * np.tanh(v[1] / 0.01)]), (SPRING, DRY, ONE_SIDED))
    final, effects = search._revised(search.base((ONE_SIDED, SPRING)), [search.stage(search.base())])
    assert {*final.hypothesis.candidates} == {DRY, SPRING} == {score.candidate for score in effects}


@pytest.mark.parametrize(("push", "friction"), [(0.0, 0.0), (2.0, 0.5)])
def test_what_did_well_beside_an_effect_that_goes_takes_its_place(push, friction):
    """Part of a cogging's period is no cogging; a push does as much, and a friction then shows as well. Or nothing."""
    bent = Candidate(EFFECTS["cogging"], "joint:shoulder")
    search = _search(lambda q, v: np.array([push, -friction * np.tanh(v[1] / 0.01)]), (bent, PUSH, DRY))
    stage = search.stage(search.base())
    hypothesis = Hypothesis(search.plain, (bent,), search.motion)
    part = {"amplitude": push, "periods": 0.2, "phase": np.pi / 2}
    start = hypothesis.coordinates(hypothesis.space.values({bent.full_name(n): x for n, x in part.items()}))
    start[: hypothesis.num_plain] = 0.0
    final, effects = search._revised(search.base((bent,), start), [stage])
    expected = {c for c, size in ((PUSH, push), (DRY, friction)) if size}
    assert {*final.hypothesis.candidates} == expected == {score.candidate for score in effects}


@pytest.mark.parametrize("limit", [1.2, 5.0])
def test_a_limit_is_there_where_it_acts(limit):
    """Of a limit, unlike a friction, there is no amount that could be none; the elbow's drive gives 3 N m at most."""
    search = _search(lambda q, v: np.zeros(2), (LIMIT,), limit)
    hypothesis = Hypothesis(search.plain, (LIMIT,), search.motion)
    start = hypothesis.coordinates(hypothesis.space.values({LIMIT.full_name("limit"): limit}))
    start[: hypothesis.num_plain] = 0.0
    base = search.base((LIMIT,), start)
    assert is_there(base.hypothesis, LIMIT, *base.by_all(search.data)) == (limit < 3)


@pytest.mark.parametrize(("friction", "limit"), [(0.3, None), (0.0, 1.2)])
def test_a_limit_promises_nothing_that_only_its_opposite_would_give(friction, limit):
    """Of dry friction, less than no limit at all would explain much, to first order."""
    search = _search(lambda q, v: np.array([0.0, -friction * np.tanh(v[1] / 0.01)]), (LIMIT,), limit)
    (screened,) = screen(search.base(), (LIMIT,), search.data.fitted, LocalEngine(), lambda *_: None, {})
    assert (screened.gain > EVIDENCE) == (limit is not None), screened.gain


@pytest.mark.parametrize("limit", [0.4, 1.0, 1.2, 1.5])
def test_what_no_motion_tells_is_known_as_well_as_the_priors_say(limit):
    """Of all masses, dampings, servos and a limit, each larger by the same factor, though noise is small."""
    search = _search(lambda q, v: np.zeros(2), (LIMIT,), limit)
    hypothesis = Hypothesis(search.plain, (LIMIT,), search.motion)
    start = hypothesis.coordinates(hypothesis.space.values({LIMIT.full_name("limit"): limit}))
    start[: hypothesis.num_plain] = 0.0
    misfit = Misfit(hypothesis, search.data.fitted)
    misfit = misfit.with_noise(misfit.noise_at(start, np.full(5, 1e-4)))

    def larger(factor: float) -> np.ndarray:
        xi = hypothesis.xi(start[None])[0]
        for i, (kind, _, place) in enumerate(name.partition(".") for name in hypothesis.space.names):
            if kind == "armature":  # what is added to that of the model
                xi[i] += (factor - 1) * search.plain.model.joint(place).armature[0]
            elif kind not in ("command_latency", "integration_lead"):
                xi[i] *= factor
        return hypothesis.coordinates(xi)

    errors = misfit.errors(np.array([start, larger(1.05)]))
    np.testing.assert_allclose(errors[0], errors[1], atol=1e-6)
    along = larger(1.001) - larger(0.999)
    by_priors = abs(along[-1]) / np.linalg.norm(along / hypothesis.prior_std)
    own, *others = (misfit.jacobian(start, difference=d) for d in (DIFFERENCES[-1], *CONFIRMING))
    fit = fits.Fit(start, np.zeros(errors[0].shape), own, hypothesis.prior_std, np.zeros(len(errors[0])))
    assert np.sqrt(fit.variance(others)[-1]) == pytest.approx(by_priors, rel=0.1)
    assert np.sqrt(fit.variance([own])[-1]) < 0.5 * by_priors  # by derivatives that nothing confirms


def test_a_peak_of_friction_is_looked_for_from_where_the_fit_of_friction_without_one_ended():
    search = _search(lambda q, v: np.array([0.0, -0.5 * np.tanh(v[1] / 0.01)]), (DRY, PEAKED, SPRING))
    base = search.base()
    stage = search.stage(base)
    peaked, spring = (next(s for s in stage.screened if s.candidate == c) for c in (PEAKED, SPRING))
    starts, of_dry = np.array(grown(peaked, stage.trials)), stage.trials[DRY].fit.u
    np.testing.assert_array_equal(starts[:, : len(base.fit.u)], np.tile(of_dry[: len(base.fit.u)], (len(starts), 1)))
    values = [peaked.hypothesis.values(PEAKED, xi) for xi in peaked.hypothesis.xi(starts)]
    assert [v["frictionloss"] for v in values] == pytest.approx([0.5] * len(values), rel=0.05)
    assert {round(v["breakaway"] / v["frictionloss"], 6) for v in values} == {1.0, 3.0}
    assert len({v["velocity"] for v in values}) == 3
    assert grown(spring, stage.trials) == ()


def test_from_another_fit_of_the_base_the_best_candidates_go_on_from_where_they_ended():
    """They are fitted even where the screen, from there, would not have them fitted."""
    search = _search(lambda q, v: np.array([-3.0 * q[0], -0.5 * np.tanh(v[1] / 0.01)]), (SPRING, DRY))
    base = search.base()
    stage = search.stage(base)
    done = {DRY: stage.trials[DRY]}
    assert set(search._in_full(base, stage.screened, done, done)) == {DRY}
    assert set(search._in_full(base, stage.screened, done, done, stage)) == {DRY, SPRING}
