"""How much of a recording is predicted in one go, and what errors in parts of it tell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from conftest import needs_effects
from gap_plant import MODEL, record
from hanging import LOOSE, a_rope, drive, hanging, part, swing
from scipy.ndimage import gaussian_filter1d

from simopt_envs.gap import find, find_gap, wild_starts
from simopt_envs.gap.fit import Misfit, by_part
from simopt_envs.gap.hypothesis import Candidate, Hypothesis
from simopt_envs.gap.motion import motion_of
from simopt_envs.gap.outliers import without_outliers
from simopt_envs.gap.plain import Plain, plain_parameters
from simopt_envs.gap.recordings import longer_windows, read_windows
from simopt_envs.gap.search import Search
from simopt_envs.gap.thresholds import LARGE, WILD
from simopt_envs.gap.trial import Base, Data
from simopt_envs.gap.wild_starts import as_predicted, without_wild_starts
from simopt_envs.measured import Recording, WindowSimulator, cut_windows
from simopt_envs.measured.replay import start_curvature
from simopt_envs.measured.windows import Windows
from simopt_envs.physics.effects import EFFECTS

BIAS = Candidate(EFFECTS["actuator_bias"], "actuator:hinge")


def of_rods(upright: int) -> tuple[Data, Hypothesis]:
    """Of four rods; one that hangs goes on as it began, one that stands falls this way or that by what is not seen."""
    plain = plain_parameters(mujoco.MjSpec.from_string(LOOSE.format(gravity=-9.81)))
    recordings = swing(plain.model, [0.0] * upright + hanging(4 - upright), np.random.default_rng(0))
    windows = cut_windows(plain.model, recordings, 2.0, history=0.2)
    data = Data(windows, windows, tuple(recordings), tuple(recordings))
    return data, Hypothesis(plain, (), motion_of(plain.model, recordings))


def of_pushed_rods(starts: Sequence[float], push: float = -0.1) -> tuple[Plain, Windows, tuple[Recording, ...]]:
    """The model without the push, a window of 1 s for each start, and the recordings."""
    plain = plain_parameters(mujoco.MjSpec.from_string(LOOSE.format(gravity=-9.81)))
    recordings = swing(plain.model, starts, np.random.default_rng(0), push)
    recordings = [part(r, r.time < 1.001) for r in recordings]
    return plain, cut_windows(plain.model, recordings, 1.0, history=0.2), tuple(recordings)


def predicted(gravity: float, starts: Sequence[float], wild: tuple[tuple[str, float, float], ...] = ()) -> Data | None:
    """Of recordings of rods, what the right model predicts as a whole."""
    plain = plain_parameters(mujoco.MjSpec.from_string(LOOSE.format(gravity=gravity)))
    recordings = swing(plain.model, starts, np.random.default_rng(0))
    data = replace(read_windows(plain.model, recordings), wild=wild)
    base = Search(plain, data, motion_of(plain.model, recordings), ()).base()
    return as_predicted(base, longer_windows(plain.model, data)[0])


def test_errors_are_summed_over_the_parts_of_each_window():
    values = np.arange(2 * 7 * 3.0).reshape(2, 7, 3)
    summed = by_part(values, 3)
    assert summed.shape == (6, 3)
    np.testing.assert_allclose(summed[:3].sum(axis=0), values[0].sum(axis=0))
    np.testing.assert_allclose(summed[0], values[0, :2].sum(axis=0))
    np.testing.assert_allclose(by_part(values, 1), values.sum(axis=1))


@pytest.mark.parametrize(("gravity", "bends"), [(0.0, False), (-9.81, True)])
def test_uncertain_starts_act_linearly_unless_motion_runs_apart(gravity, bends):
    model = mujoco.MjModel.from_xml_string(LOOSE.format(gravity=gravity))
    time = np.linspace(0.0, 2.0, 201)
    angle = 0.1 * np.random.default_rng(0).standard_normal(201)  # upright, whence it falls to either side
    windows = cut_windows(model, Recording(time, {"ctrl/hinge": np.zeros(201), "qpos/hinge": angle}))
    curvature = start_curvature(model, WindowSimulator(model, windows))
    largest = float(np.abs(curvature).max())
    assert largest > 0.1 if bends else largest < 1e-6


@needs_effects
@pytest.mark.parametrize(("stop", "bends"), [(1.5, True), (3.0, False)])
def test_what_happens_within_two_standard_errors_of_a_start_makes_it_decide(stop, bends):
    spec, error = mujoco.MjSpec.from_string(LOOSE.format(gravity=0.0)), 1e-3
    spec.compiler.degree = False
    spec.joint("hinge").limited, spec.joint("hinge").range = True, [-1.0, stop * error]
    plain, time, zeros = plain_parameters(spec), np.linspace(0.0, 1.0, 101), np.zeros(101)
    recordings = [Recording(time, {"ctrl/hinge": zeros, "qpos/hinge": zeros})]
    windows = cut_windows(plain.model, recordings, 0.5, history=0.2)
    none = np.zeros_like(windows.starts.qpos)
    starts = replace(windows.starts, qpos=none, qvel=none, qpos_error=none + error, qvel_error=none)
    hypothesis = Hypothesis(plain, (), motion_of(plain.model, recordings))
    misfit = Misfit(hypothesis, replace(windows, starts=starts))
    bent = misfit.bent_by_starts(hypothesis.neutral(), np.full(1, 0.01 * error))
    assert np.all(bent > WILD) if bends else np.all(bent < 1e-6)


@needs_effects
def test_longer_windows_are_whole_recordings_of_at_most_four_seconds_their_halves_and_thirds():
    model = mujoco.MjModel.from_xml_string(MODEL)
    recordings = record(lambda q, v: np.zeros(2), np.random.default_rng(0), count=4, seconds=6.0)
    data = read_windows(model, recordings)
    longer = longer_windows(model, data)
    assert [d.seconds for d in longer] == pytest.approx([3.0, 1.5, 1.0])
    assert [d.parts for d in longer] == [6, 3, 2]
    assert [24 * len(d.fitted) for d in longer] == [len(data.fitted) * n for n in (4, 8, 12)]
    one = longer_windows(model, read_windows(model, [part(r, r.time < 3.51) for r in recordings]))
    assert [d.seconds for d in one] == pytest.approx([3.5, 1.74, 1.16])


@needs_effects
def test_an_encoder_that_stands_on_one_count_is_as_noisy_as_its_rounding():
    count, rng = 2 * np.pi / 4096, np.random.default_rng(0)
    plain = plain_parameters(mujoco.MjSpec.from_string(MODEL))
    still = [replace(r, time=10 * r.time) for r in record(lambda q, v: np.zeros(2), rng)]  # slow beside its samples
    joints = ("qpos/shoulder", "qpos/elbow")
    logs = []
    for log in (r.resample(0.02) for r in still):
        smooth = {name: count * np.round(gaussian_filter1d(log[name], 25) / count) for name in joints}
        logs.append(replace(log, columns={**log.columns, **smooth}).only([*log.commands, *joints]))
    windows = read_windows(plain.model, logs).fitted
    assert windows.rounding == pytest.approx(count / np.sqrt(12))
    hypothesis = Hypothesis(plain, (), motion_of(plain.model, logs))
    floor = Misfit(hypothesis, windows).noise_floor(hypothesis.neutral())
    assert np.all((floor >= 0.99 * windows.rounding) & (floor < 3 * windows.rounding))


@needs_effects
def test_a_joint_whose_position_no_column_tells_is_told():
    model = mujoco.MjModel.from_xml_string(MODEL)
    seen = [r.only([*r.commands, "qpos/shoulder"]) for r in record(lambda q, v: np.zeros(2), np.random.default_rng(0))]
    told = [w.message for w in read_windows(model, seen).warnings if w.channel == "qpos/elbow"]
    assert told == ["no column tells where it is: it starts at the model's reference"]


@needs_effects
def test_recordings_with_gaps_and_short_ones_stay_in_short_windows():
    model = mujoco.MjModel.from_xml_string(MODEL)
    recordings = record(lambda q, v: np.zeros(2), np.random.default_rng(0), count=4, seconds=3.0)
    assert not longer_windows(model, read_windows(model, [part(r, r.time < 0.81) for r in recordings]))
    torn = [part(r, (r.time < 1.5) | (r.time > 2.0)) for r in recordings]
    assert not longer_windows(model, read_windows(model, torn))


@needs_effects
@pytest.mark.parametrize(("torque", "seconds"), [(0.0, 2.0), (0.01, 2.0), (8.0, 0.5)])
def test_whole_recordings_are_fitted_where_the_model_is_near(torque, seconds):
    recordings = record(lambda q, v: np.array([0.0, -torque * np.tanh(v[1] / 0.01)]), np.random.default_rng(1))
    plain = plain_parameters(mujoco.MjSpec.from_string(MODEL))
    data = read_windows(plain.model, recordings)
    motion, longer = motion_of(plain.model, recordings), longer_windows(plain.model, data)
    friction = Candidate(EFFECTS["coulomb_friction"], "joint:elbow")
    assert Search(plain, data, motion, (friction,), longer=longer).run().data.seconds == pytest.approx(seconds)


@needs_effects
@pytest.mark.parametrize(
    ("gravity", "starts", "left"),
    [
        (0.0, [0.0] * 4, 4),
        (-9.81, hanging(4), 4),
        (-9.81, [0.0, *hanging(11)], 11),
        (-9.81, [0.0, *hanging(3)], None),
        (-9.81, [1.0, 1.01, 1.02, 1.03], None),
    ],
)
def test_long_windows_are_those_in_which_starts_act_linearly_if_they_are_most(gravity, starts, left):
    """Nothing holds a rod: no start is forgotten. But only from upright one decides, and far from rest it bends."""
    whole = predicted(gravity, starts)
    assert (whole and len(whole.fitted) + len(whole.held_out)) == left
    assert whole is None or ("left out" in str(whole.warnings)) == (left < len(starts))


@needs_effects
@pytest.mark.parametrize(("begin", "left"), [(1.5, 11), (2.0, 12)])
def test_no_long_window_holds_a_short_one_that_was_left_out(begin, left):
    whole = predicted(-9.81, hanging(12), wild=(("run_3", begin, begin + 0.5),))
    assert whole is not None
    assert len(whole.fitted) + len(whole.held_out) == left
    assert ("run_3" in whole.fitted.recording + whole.held_out.recording) == (left == 12)


@needs_effects
@pytest.mark.parametrize(("rate", "seconds"), [(0.0, 2.0), (0.03, 1.0), (0.1, 0.5)])
def test_the_longest_windows_are_fitted_in_which_errors_do_not_add_up_to_large_ones(rate, seconds):
    """A rod in space whose sensor drifts [rad/s], this way or that for half a second each."""
    plain, rng = plain_parameters(mujoco.MjSpec.from_string(LOOSE.format(gravity=0.0))), np.random.default_rng(0)
    recordings = swing(plain.model, [0.0] * 4, rng)
    for recording in recordings:
        recording.columns["qpos/hinge"] += np.cumsum(0.01 * rate * np.repeat(rng.choice([-1.0, 1.0], 5), 50)[:201])
    data = read_windows(plain.model, recordings)
    motion, longer = motion_of(plain.model, recordings), longer_windows(plain.model, data)
    friction = Candidate(EFFECTS["coulomb_friction"], "joint:hinge")
    search = Search(plain, data, motion, (friction,), longer=longer)
    assert search.base().excess < LARGE
    assert search.run().data.seconds == pytest.approx(seconds)


@needs_effects
@pytest.mark.parametrize(("upright", "kept", "told"), [(0, 4, 0), (1, 3, 1), (3, 4, 0)])
def test_windows_whose_start_decides_are_left_out_unless_most_are_such(upright, kept, told):
    data, hypothesis = of_rods(upright)
    found = without_wild_starts(hypothesis, hypothesis.neutral(), data, np.array([1e-3]))
    assert (len(found.held_out), len(found.warnings)) == (kept, told)
    assert found.fitted.recording == data.fitted.recording[4 - kept :]


def of_a_rope(links: int) -> tuple[mujoco.MjSpec, list[Recording]]:
    """A cart that is driven to and fro, from which a rope hangs whose tip alone is seen, going round in big swings."""
    spec, time = a_rope(links, 1e-4), 0.02 * np.arange(101)
    return spec, drive(spec.compile(), [0.2 * np.sin((i + 2) * time) for i in range(4)], 8.0, [1e-4] * 4)


@needs_effects
@pytest.mark.parametrize(("links", "left"), [(1, 4), (4, 2)])
def test_sites_whose_start_decides_in_most_windows_are_left_out(links, left):
    """Of one link the tip tells all; of four it does not tell how they are folded, nor so where it will be."""
    spec, recordings = of_a_rope(links)
    problem = find.read(spec, recordings)
    assert len(problem.data.fitted.names) == left
    assert bool(problem.longer) == (left == 4), "what hangs loose is no better known in longer windows"
    told = [warning.channel for warning in problem.data.warnings if "left out" in str(warning)]
    assert told == ([] if left == 4 else ["site/tip/x", "site/tip/z"])


@needs_effects
def test_a_site_that_tells_all_joints_stays_though_most_windows_are_such(monkeypatch):
    monkeypatch.setattr(wild_starts, "WILD", 0.0)
    assert len(find.read(*of_a_rope(1)).data.fitted.names) == 4


@needs_effects
@pytest.mark.parametrize(("bent", "far", "left_out"), [(3, None, None), (3, 0, 0), (3, 1, None), (30, None, 0)])
def test_a_window_whose_start_decides_is_left_out_only_where_it_is_or_may_be_far_from_the_data(bent, far, left_out):
    data, hypothesis = of_rods(upright=1)
    u, misfit = hypothesis.neutral(), Misfit(hypothesis, data.fitted)
    scale = np.sqrt(misfit.bent_by_starts(u, np.ones(1))[0] / bent)
    simulated = misfit.simulated(u[None])[0]
    measured = simulated + scale * np.random.default_rng(0).standard_normal(simulated.shape)
    if far is not None:
        measured[far] += 100 * scale * np.linspace(0.0, 1.0, measured.shape[1])[:, None] ** 2
    near = replace(data, fitted=replace(data.fitted, measured=measured))
    found = without_wild_starts(hypothesis, u, near, scale, beyond=5.0)
    assert found.fitted.recording == tuple(f"run_{i}" for i in range(4) if i != left_out)


@needs_effects
@pytest.mark.parametrize(("push", "kept"), [(-0.2, 3), (0.0, 4)])
def test_a_search_leaves_out_a_window_that_bends_the_fits_of_what_explains_the_others(push, kept):
    """Nothing explains the first rod, which stands. Without a push, the model as given explains the others."""
    plain, windows, recordings = of_pushed_rods([0.0, 3.0, 3.1, 3.2], push)
    measured = windows.measured.copy()
    measured[0] += np.linspace(0.0, 1.0, measured.shape[1])[:, None] ** 2
    windows = replace(windows, measured=measured)
    data = Data(windows, windows, recordings, recordings)
    found = Search(plain, data, motion_of(plain.model, recordings), (BIAS,)).run()
    assert (len(found.data.fitted), len(found.data.held_out)) == (kept, kept)
    if push:
        (size,) = found.final.hypothesis.values(BIAS, found.final.hypothesis.xi(found.final.fit.u[None])[0]).values()
        assert size == pytest.approx(push, abs=0.002)


@needs_effects
@pytest.mark.parametrize(
    ("base", "candidate", "left_out"),
    [
        ([1.3, 9.0, 1.2, 1.3], [1.0, 8.5, 1.0, 1.0], [1]),
        ([1.3, 9.0, 1.2, 1.3], [1.0, 4.0, 1.0, 1.0], []),  # it takes most of it
        ([1.3, 4.0, 1.2, 1.3], [1.0, 3.9, 1.0, 1.0], [1]),  # in its last half alone
        ([1.3, 1.9, 1.2, 1.3], [1.0, 1.9, 1.0, 1.0], []),  # it makes the model right, to what noise is
        ([2.3, 9.0, 2.2, 2.3], [2.0, 8.5, 2.0, 2.0], []),  # it does not explain the others either
        ([9.0, 9.0, 9.0, 1.3], [8.5, 8.5, 8.5, 1.0], []),
    ],
)
def test_a_window_is_an_outlier_where_the_candidate_that_explains_the_others_takes_little_of_it(
    base, candidate, left_out
):
    """Windows of 1 s; what a mean square is above 1.5 is of their last half."""

    def trial(mean_squares: list[float]) -> Any:
        squares = np.minimum(mean_squares, 1.5)[:, None, None] * np.ones((1, 100, 2))
        squares[:, 50:] += 2 * np.maximum(np.array(mean_squares) - 1.5, 0.0)[:, None, None]
        errors = np.sqrt(squares)
        fit = SimpleNamespace(errors=np.ones_like(errors))
        return SimpleNamespace(fit=fit, held_out=SimpleNamespace(errors=errors), excess=np.mean(squares) - 1)

    _, windows, recordings = of_pushed_rods([0.0, 3.0, 3.1, 3.2])
    data = Data(windows, windows, recordings, recordings)
    stage: Any = SimpleNamespace(base=trial(base), scores=[SimpleNamespace(trial=trial(candidate))])
    found = without_outliers(stage, data)
    assert found.fitted is data.fitted
    assert found.held_out.recording == tuple(f"run_{i}" for i in range(4) if i not in left_out)
    assert [name for name, _, _ in found.outliers] == [f"run_{i}" for i in left_out]
    assert len(found.warnings) == len(left_out)


@needs_effects
@pytest.mark.parametrize(("stop", "kept"), [(2, 2), (1, 4)])
def test_a_search_never_leaves_out_more_than_half_of_its_windows_however_often_a_candidate_tells(
    stop, kept, monkeypatch
):
    def one_fewer(hypothesis: Hypothesis, u: np.ndarray, data: Data, *_: object) -> Data:
        rows = np.arange(1, len(data.fitted))
        fewer = replace(data, fitted=data.fitted.select(rows), held_out=data.held_out.select(rows))
        return fewer if len(data.fitted) > stop else data

    plain, windows, recordings = of_pushed_rods([3.0, 3.1, 3.2, 3.3])
    data = Data(windows, windows, recordings, recordings)
    monkeypatch.setattr("simopt_envs.gap.wild_starts.without_wild_starts", one_fewer)
    found = Search(plain, data, motion_of(plain.model, recordings), (BIAS,)).run()
    assert (len(found.data.fitted), len(found.data.held_out)) == (kept, kept)


@needs_effects
@pytest.mark.parametrize("of_fitted", [False, True])
def test_fits_stand_where_none_of_the_windows_left_out_was_fitted(of_fitted, monkeypatch):
    plain, windows, recordings = of_pushed_rods([3.0, 3.1, 3.2, 3.3])
    rows = np.array([0, 1, 3])
    fewer = windows.select(rows)
    data = Data(windows, windows, recordings, recordings)
    left = replace(data, fitted=fewer if of_fitted else windows, held_out=fewer)
    null = []
    for found in (data, left):
        monkeypatch.setattr("simopt_envs.gap.search.without_starts_told_wild", lambda *_, found=found: found)
        null.append(Search(plain, data, motion_of(plain.model, recordings), (BIAS,)).run().null)
    assert len(null[1].held_out_noise.shrink) == len(null[1].held_out.errors) == 3
    assert np.array_equal(null[1].fit.u, null[0].fit.u) is not of_fitted
    assert np.array_equal(null[1].held_out.errors, null[0].held_out.errors[rows]) is not of_fitted


@needs_effects
def test_a_search_needs_something_to_look_for():
    recordings = record(lambda q, v: np.zeros(2), np.random.default_rng(1))
    with pytest.raises(ValueError, match="no effect can act"):
        find_gap(mujoco.MjSpec.from_string(MODEL), recordings, effects=[EFFECTS["contact_friction"]])


def test_windows_keep_off_both_ends_of_a_recording():
    recordings = record(lambda q, v: np.zeros(2), np.random.default_rng(0), seconds=2.3)
    data = read_windows(mujoco.MjModel.from_xml_string(MODEL), recordings)
    for windows in (data.fitted, data.held_out):
        np.testing.assert_allclose(windows.start_time, np.tile([0.14, 0.64, 1.14, 1.64], 2))


@pytest.mark.parametrize(("count", "rows"), [(0.4, [2]), (2.0, [2, 3]), (9.0, [0, 1, 2, 3])])
def test_starts_are_told_apart_by_the_windows_that_a_base_leaves_most_of(count, rows):
    base: Any = SimpleNamespace(fit=SimpleNamespace(errors=np.array([1.0, 0.5, -4.0, 2.0]).reshape(4, 1, 1)))
    np.testing.assert_array_equal(Base.worst(base, count), rows)
