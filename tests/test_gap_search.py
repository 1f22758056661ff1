"""Where fits of candidates begin, and second thoughts: an effect is held against its rivals beside the others."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
import pytest
from conftest import needs_effects
from gap_plant import MODEL, Law, record

from simopt_envs.gap.hypothesis import Candidate, Hypothesis
from simopt_envs.gap.motion import motion_of
from simopt_envs.gap.plain import plain_parameters
from simopt_envs.gap.recordings import read_windows
from simopt_envs.gap.search import Search, _is_there
from simopt_envs.gap.thresholds import LARGE
from simopt_envs.physics.effects import EFFECTS

pytestmark = needs_effects

SPRING = Candidate(EFFECTS["joint_spring"], "joint:shoulder")
DRY = Candidate(EFFECTS["coulomb_friction"], "joint:elbow")
COGGING = Candidate(EFFECTS["cogging"], "joint:elbow")
PUSH = Candidate(EFFECTS["actuator_bias"], "actuator:shoulder")
LIMIT = Candidate(EFFECTS["actuator_saturation"], "actuator:elbow")
ONE_SIDED = Candidate(EFFECTS["asymmetric_friction"], "joint:elbow")


def _search(forces: Law, candidates: Sequence[Candidate], limit: float | None = None) -> Search:
    plain = plain_parameters(mujoco.MjSpec.from_string(MODEL))
    recordings = record(forces, np.random.default_rng(0), limit=limit)
    return Search(plain, read_windows(plain.model, recordings), motion_of(plain.model, recordings), candidates)


def test_a_fit_does_not_end_in_the_period_that_its_best_start_is_near():
    """Cogging with 21 periods per radian: of all probes' starts, the nearest to the data leads to 22."""
    hidden = lambda q, v: np.array([0.0, -0.5 * np.tanh(v[1] / 0.01) - 0.1 * np.sin(21 * q[1] + 1.0)])  # noqa: E731
    search = _search(hidden, (DRY, COGGING))
    (score,) = search.stage(search.base((DRY,))).scores
    hypothesis, u = score.trial.hypothesis, score.trial.fit.u
    assert hypothesis.values(COGGING, hypothesis.xi(u[None])[0])["periods"] == pytest.approx(21.0, rel=0.02)


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
    assert _is_there(base, DRY, base.spread(search.data)) == (friction > 0)


@pytest.mark.parametrize("limit", [1.2, 5.0])
def test_a_limit_is_there_where_it_acts(limit):
    """Of a limit, unlike a friction, there is no amount that could be none; the elbow's drive gives 3 N m at most."""
    search = _search(lambda q, v: np.zeros(2), (LIMIT,), limit)
    hypothesis = Hypothesis(search.plain, (LIMIT,), search.motion)
    start = hypothesis.coordinates(hypothesis.space.values({LIMIT.full_name("limit"): limit}))
    start[: hypothesis.num_plain] = 0.0
    base = search.base((LIMIT,), start)
    assert _is_there(base, LIMIT, base.spread(search.data)) == (limit < 3)
