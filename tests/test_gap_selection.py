"""Which recordings are held out, which of several candidates is called missing, and what the verdict is."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from simopt_envs.adaptation.fitting import Noise
from simopt_envs.gap.fit import Fit
from simopt_envs.gap.hypothesis import Candidate
from simopt_envs.gap.large import of_several_effects
from simopt_envs.gap.predictive import HeldOut
from simopt_envs.gap.presence import is_told_from_none, may_be_itself
from simopt_envs.gap.recordings import split
from simopt_envs.gap.result import judge
from simopt_envs.gap.selection import Score, chosen, is_all, worth_of
from simopt_envs.gap.trial import Base
from simopt_envs.measured import Recording
from simopt_envs.physics.effects import EFFECTS
from simopt_envs.physics.parameters import Array


def _recording(speed: float) -> Recording:
    time = np.linspace(0.0, 2 * np.pi, 629)  # whole periods
    return Recording(time, {"qpos/elbow": np.sin(speed * time)}, f"{speed:g}")


@pytest.mark.parametrize("count", range(3, 10))
def test_what_is_held_out_is_neither_the_fastest_nor_the_slowest(count):
    recordings = [_recording(speed) for speed in np.random.default_rng(count).permutation(count) + 1.0]
    fitted, held_out, warnings = split(recordings)
    speeds = [sorted(float(r.name) for r in half) for half in (fitted, held_out)]
    assert sorted(speeds[0] + speeds[1]) == [*np.arange(1.0, count + 1)]
    assert len(held_out) == count // 2
    assert min(speeds[0]) == 1.0
    assert max(speeds[0]) == count
    assert warnings == ()


def test_of_two_recordings_the_faster_is_fitted():
    (fitted,), (held_out,), _ = split([_recording(1.0), _recording(4.0)])
    assert (fitted.name, held_out.name) == ("4", "1")


def _score(parameters: int, excess: float, nats: float, fitted: float | None = None) -> Score:
    trial: Any = SimpleNamespace(
        fit=SimpleNamespace(u=np.zeros(parameters)),
        excess=excess,
        held_out=SimpleNamespace(errors=np.zeros((12, 50, 10))),
        hypothesis=SimpleNamespace(is_itself=lambda candidate, u: True),
    )
    return Score(
        Candidate(EFFECTS["coulomb_friction"], "joint:elbow"), trial, nats if fitted is None else fitted, nats, 0.0
    )


@pytest.mark.parametrize(
    ("fitted", "held_out", "earned"),
    [
        (8.0, 14.0, True),
        (8.0, 8.0, False),  # less than 20 in all
        (4.0, 19.0, False),  # hardly on the one, and not enough on the other alone
        (-6.0, 57.0, True),  # what no fit saw may tell alone
        (57.0, 4.0, True),  # what was fitted may where the other does not speak against it
        (57.0, -6.0, False),
        (-40.0, 57.0, False),
    ],
)
def test_what_no_fit_saw_may_tell_of_an_effect_alone(fitted, held_out, earned):
    assert _score(1, 0.1, held_out, fitted).earned is earned


@pytest.mark.parametrize(("width", "std", "itself"), [(0.9, 0.1, True), (1.4, 0.3, True), (1.4, 0.1, False)])
def test_an_effect_is_what_its_name_means_if_its_interval_holds_that(width, std, itself):
    """A peak of friction that the fit has made wider than the motion is fast, 1, is one if that is uncertain enough."""
    effect = Candidate(EFFECTS["stribeck_friction"], "joint:elbow")
    hypothesis: Any = SimpleNamespace(
        columns={effect: [1, 2]},
        low=np.array([-np.inf, 0.0, 0.0]),
        high=np.full(3, np.inf),
        is_itself=lambda candidate, u: candidate == effect and u[2] < 1,
    )
    assert may_be_itself(hypothesis, effect, np.array([0.0, 0.5, width]), np.array([9.0, 9.0, std])) is itself


@pytest.mark.parametrize(
    ("size", "pulled", "told"),
    [
        (60.0, 0.0, True),  # more of it would change little, and none of it much
        (60.0, 12.0, False),  # in every other window there seems to be less than none
        (5.0, 0.0, False),  # it changes as much as the way from none would have it: its interval leaves out none
    ],
)
def test_none_of_an_effect_may_be_far_from_one_so_strong_that_more_changes_little(size, pulled, told):
    """A motion that friction makes smaller: the speed that is left goes as 1 / (1 + its size)."""
    effect = Candidate(EFFECTS["viscous_friction"], "joint:elbow")
    motion = 6.0 * np.sin(np.arange(200.0)).reshape(8, 25, 1)
    errors = np.random.default_rng(0).standard_normal(motion.shape)
    errors += pulled / 6 * motion * np.resize([1.0, -1.0], (8, 1, 1))
    slope = -motion.reshape(-1, 1) / (1 + size) ** 2
    fit = Fit(np.array([size]), errors, slope, np.array([1e3]), np.zeros(8))
    none = replace(fit, u=np.zeros(0), errors=errors + motion * size / (1 + size), jacobian=np.zeros((200, 0)))
    hypothesis = SimpleNamespace(neutral=lambda: np.zeros(1), amounts=lambda _: [0], columns={effect: [0]})
    base: Any = SimpleNamespace(hypothesis=hypothesis, to_all=lambda: fit, left=1.0)
    assert is_told_from_none(effect, base, cast(Base, SimpleNamespace(to_all=lambda: none)), parts=1) is told


@pytest.mark.parametrize(
    ("base", "best", "simple", "simple_wins"),
    [
        (1.0, 0.5, 0.55, True),  # 90 % of what the best takes, and it leaves hardly more
        (1.0, 0.5, 0.7, False),  # 60 % of what the best takes
        (124.0, 2.75, 9.4, False),  # 95 %, but it leaves over three times as much
        (124.0, 2.75, 4.0, True),
        (124.0, 0.01, 0.015, False),  # the best is right to what noise is
    ],
)
def test_a_simpler_law_is_as_good_where_it_takes_and_leaves_nearly_as_much(base, best, simple, simple_wins):
    null: Any = SimpleNamespace(excess=base)
    scores = [_score(5, best, 1000.0), _score(4, simple, 900.0)]
    assert chosen(null, null, scores) is scores[simple_wins]


@pytest.mark.parametrize(
    ("best", "simple", "simple_wins"),
    [
        (0.12, 0.41, False),  # it alone makes the model right
        (0.12, 0.21, True),  # both do: nats far fewer than 2 %, and than it leaves, are a matter of the law's form
        (0.02, 0.21, False),  # it leaves a fifth of these: nothing that its form could be blamed for
        (-0.05, 0.03, False),
        (0.31, 0.41, True),  # neither does
    ],
)
def test_a_simpler_law_is_no_other_form_of_one_that_alone_makes_the_model_right(best, simple, simple_wins):
    null: Any = SimpleNamespace(excess=96.0)
    scores = [_score(5, best, 34_000.0), _score(4, simple, 33_850.0)]
    assert chosen(null, null, scores) is scores[simple_wins]


@pytest.mark.parametrize(
    ("left", "after", "taken"),
    [
        (0.147, 0.017, True),  # a friction beside a load takes nine tenths of what that left
        (0.147, 0.08, False),  # half of it may be an error of the first one's form
        (7.0, 1.2, True),
        (7.0, 3.0, False),
        (-0.01, -0.05, False),  # nothing is left
        (0.009, -0.05, False),  # nothing but what noise may leave, of 4000 errors 4 % at most in 19 of 20 cases
        (0.1, -0.05, True),
        (9.0, 0.2, True),  # it makes the model right
    ],
)
def test_a_further_effect_that_takes_most_of_what_is_left_is_no_error_of_form(left, after, taken):
    """It is far less than two per cent of what the first one took."""
    null: Any = SimpleNamespace(excess=389.0)
    base: Any = SimpleNamespace(excess=left, held_out=SimpleNamespace(errors=np.empty((40, 50, 2))))
    score = _score(5, after, 387.0)
    assert chosen(null, base, [score]) is (score if taken else None)


@pytest.mark.parametrize(
    ("removed", "left", "farthest", "whole"),
    [
        (390.0, 0.01, 1.0, True),
        (390.0, 0.07, 1.0, False),  # more than noise may leave of 4000 errors: most of it may be taken
        (2.0, 0.01, 1.0, False),  # two per cent of what was removed may be there
        (390.0, 0.01, 3.6, False),  # a plain parameter speaks for another effect
        (390.0, 0.01, 3.0, False),  # none does alone, but four together
    ],
)
def test_no_further_effect_is_looked_for_where_none_could_be_chosen(removed, left, farthest, whole):
    u, errors = np.array([farthest, 2.0, -farthest, 2.5, 0.3]), np.full((40, 50, 2), np.sqrt(1 + left))
    told = HeldOut(errors, np.zeros((*errors.shape, 5)), np.zeros(40))
    fit = Fit(u, errors, np.zeros((errors.size, 5)), np.ones(5), np.zeros(40))
    hypothesis, noise = (
        SimpleNamespace(num_plain=4, off=lambda u: u),
        Noise.of(np.ones(2), np.zeros((1, *errors.shape))),
    )
    base = Base(cast(Any, hypothesis), fit, told, noise, noise, np.ones(2))
    null: Any = SimpleNamespace(excess=left + removed)
    assert is_all(null, base) is whole
    ended = _score(5, -0.03, 60.0)
    assert not whole or chosen(null, base, [ended]) is None


@pytest.mark.parametrize(("fitted", "simple_wins"), [(15.0, False), (23.0, True)])
def test_a_simpler_law_gives_way_by_all_that_the_data_say(fitted, simple_wins):
    """A spring that earns 25 + 23 nats, its two numbers paid for, and a sensor's scale that earns as many held out."""
    null: Any = SimpleNamespace(excess=0.1)
    scores = [_score(5, 0.0, 23.0, 25.0), _score(4, 0.01, 21.0, fitted)]
    assert chosen(null, null, scores) is scores[simple_wins]


@pytest.mark.parametrize(
    ("null", "final", "outliers", "verdict"),
    [
        ([1.5, 6.2, 1.5, 1.5], [1.0, 5.7, 1.0, 1.0], 0, "partly"),  # something else happens in one
        ([1.1, 6.2, 1.1, 1.1], [1.0, 5.7, 1.0, 1.0], 0, "unexplained"),  # the gap is of that one
        ([2.5, 6.2, 2.5, 2.5], [2.0, 5.7, 2.0, 2.0], 0, "unexplained"),
        ([2.5, 6.2, 2.5, 2.5], [1.5, 2.0, 1.5, 1.5], 0, "partly"),
        ([1.5, 6.2, 1.5, 1.5], [1.0, 1.2, 1.0, 1.0], 0, "named"),
        ([1.5, 6.2, 1.5, 1.5], [1.0, 1.2, 1.0, 1.0], 1, "partly"),  # of a fifth window, nothing explains much
    ],
)
def test_an_effect_that_makes_most_windows_right_explains_a_part(null, final, outliers, verdict):
    assert judge(_explanation(null, null, final, final, outliers)) == verdict


@pytest.mark.parametrize(
    ("fitted", "held_out", "verdict"),
    [
        (4.0, 8.5, "partly"),  # its form fits the motions held out less well
        (9.5, 6.0, "unexplained"),  # it happens to fit these alone
    ],
)
def test_what_effects_explain_is_told_from_all_recordings(fitted, held_out, verdict):
    explanation = _explanation([10.0] * 6, [10.0] * 4, [fitted] * 6, [held_out] * 4)
    assert judge(explanation) == verdict


def _explanation(
    fitted: list[float], held_out: list[float], then_fitted: list[float], then: list[float], outliers: int = 0
) -> Any:
    """Of a gap of which one effect takes some: mean squares of each window's errors, without it and then with it."""

    def errors(mean_squares: list[float]) -> Array:
        return np.sqrt(mean_squares)[:, None, None] * np.ones((1, 26, 2))

    def base(fitted: list[float], held_out: list[float]) -> Base:
        fit: Any = SimpleNamespace(errors=errors(fitted) / 2)  # counted in twice the sensors' noise
        of_held_out: Any = SimpleNamespace(errors=errors(held_out))
        unused: Any = None
        return Base(unused, fit, of_held_out, unused, unused, tolerance=np.full(2, 2.0))

    data: Any = SimpleNamespace(outliers=outliers * (("a recording", 0.5, 1.0),))
    return SimpleNamespace(null=base(fitted, held_out), final=base(then_fitted, then), effects=("one",), data=data)


def test_what_errors_are_worth_is_what_is_left_where_that_is_more_than_noise():
    noise = np.random.default_rng(0).normal(size=(8, 26, 2))
    assert worth_of(noise) == pytest.approx([1.0, 1.0], rel=0.2)
    assert worth_of(noise * np.array([1.0, 20.0])) == pytest.approx([1.0, 20.0**-2], rel=0.2)
    alike = np.repeat(noise[:, :1], 26, axis=1)
    assert worth_of(20 * alike) == pytest.approx(1 / (26 * 400 * np.mean(noise[:, 0] ** 2, axis=0)))


@pytest.mark.parametrize(
    ("ordered", "fitted"),
    [
        ("gggpgfs", "gggpf"),  # one that acts alike at all places leaves room for others
        ("gpfs", "gpf"),
        ("gggg", "ggg"),
    ],
)
def test_candidates_of_several_effects_are_fitted_at_the_size_they_need(ordered, fitted):
    names = {"g": "gravity_compensation", "p": "payload", "f": "coulomb_friction", "s": "joint_spring"}
    candidates = [Candidate(EFFECTS[names[letter]], f"place:{i}") for i, letter in enumerate(ordered)]
    chosen_ones = of_several_effects(candidates)
    assert [c.effect.name for c in chosen_ones] == [names[letter] for letter in fitted]
    assert chosen_ones == [c for c in candidates if c in chosen_ones]
