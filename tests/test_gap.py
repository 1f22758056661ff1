"""The gap workflow on a system whose hidden law shares no code with the library."""

from __future__ import annotations

import json
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from conftest import needs_effects
from gap_plant import MODEL, record

from simopt_envs.distributions import Gaussian
from simopt_envs.gap import find, find_gap
from simopt_envs.measured import Recording, cut_windows, simulate_windows
from simopt_envs.physics import Parameter, ParameterSpace, Write
from simopt_envs.physics.effects import EFFECTS

pytestmark = needs_effects


FEW = [
    EFFECTS[name]
    for name in (
        "coulomb_friction",
        "viscous_friction",
        "quadratic_drag",
        "actuator_delay",
        "actuator_bias",
        "payload",
        "gravity_compensation",
        "sensor_bias",
        "joint_spring",
    )
]


def spec() -> mujoco.MjSpec:
    return mujoco.MjSpec.from_string(MODEL)


@pytest.fixture(scope="module")
def friction_gap():
    recordings = record(lambda q, v: np.array([0.0, -0.4 * np.tanh(v[1] / 0.01)]), np.random.default_rng(1))
    return find_gap(spec(), recordings, effects=FEW)


def test_hidden_friction_is_named_at_its_joint_with_its_size(friction_gap):
    assert friction_gap.verdict == "named"
    (named,) = friction_gap.effects
    assert (named.candidate.effect.name, named.candidate.place) == ("coulomb_friction", "joint:elbow")
    assert named.parameters["frictionloss"].value == pytest.approx(0.4, rel=0.05)
    errors = friction_gap.errors
    assert errors.after < 1.1 * errors.noise_floor < errors.refit < errors.before


def test_candidates_are_screened_by_their_gain_less_the_price_of_their_parameters():
    recordings = record(lambda q, v: np.zeros(2), np.random.default_rng(6), count=2, seconds=1.0)
    effects = [EFFECTS[name] for name in ("coulomb_friction", "viscous_friction", "cogging", "actuator_bias")]
    stage = find_gap(spec(), recordings, effects=effects).explanation.stages[0]
    price = 0.5 * np.log(stage.base.fit.errors.size)
    gains = np.array([one.gain for one in stage.screened])
    parameters = np.array([len(one.hypothesis.columns[one.candidate]) for one in stage.screened])
    assert np.all(np.diff(gains - price * parameters) <= 0)
    assert np.any(np.diff(gains) > 0)  # by the gain alone they would stand otherwise


def test_a_right_model_with_wrong_plain_parameters_lacks_nothing():
    gap = find_gap(spec(), record(lambda q, v: np.zeros(2), np.random.default_rng(2)), effects=FEW)
    assert gap.verdict == "none"
    assert gap.effects == ()
    assert gap.errors.refit < 1.1 * gap.errors.noise_floor < gap.errors.before


def test_a_model_that_was_repaired_is_searched_again_but_for_what_it_has():
    repaired = spec()
    EFFECTS["cogging"].add(repaired, "joint:shoulder")
    (motor,) = (actuator for actuator in repaired.actuators if actuator.name == "shoulder.cogging")
    motor.biasprm[:3] = 2.0, 8.0, 0.5
    effects = [*FEW[:2], EFFECTS["cogging"]]

    def law(q, v):
        return np.array([2.0 * np.sin(8.0 * q[0] + 0.5), -0.4 * np.tanh(v[1] / 0.01)])

    gap = find_gap(repaired, record(law, np.random.default_rng(1)), effects=effects)
    (named,) = gap.effects
    assert (named.candidate.effect.name, named.candidate.place) == ("coulomb_friction", "joint:elbow")
    assert named.parameters["frictionloss"].value == pytest.approx(0.4, rel=0.05)
    assert [w.message for w in gap.warnings if w.check == "effects"] == [
        "the model has cogging at joint:shoulder already: not looked for again"
    ]
    assert gap.spec.compile().nactuator == 3


def test_the_constant_force_of_a_drive_is_told_from_friction():
    recordings = record(lambda q, v: np.array([0.4, 0.0]), np.random.default_rng(3))
    gap = find_gap(spec(), recordings, effects=FEW)
    first = gap.effects[0]
    alike = {first.candidate.effect.name, *(p.candidate.effect.name for p in first.partners)}
    assert "actuator_bias" in alike
    assert "coulomb_friction" not in {named.candidate.effect.name for named in gap.effects}


def test_the_repaired_model_is_plain_mujoco_and_predicts_what_the_workflow_says(friction_gap, tmp_path):
    folder = friction_gap.save(tmp_path / "out")
    repaired = mujoco.MjModel.from_xml_path(str(folder / "model.repaired.xml"))
    assert repaired.joint("elbow").frictionloss[0] > 0.1
    windows = cut_windows(repaired, friction_gap.data.held_out_recordings, friction_gap.data.seconds)
    # MJCF has no delay below one timestep, and six digits: the same to a fraction of the noise.
    error = simulate_windows(repaired, windows)[0] - friction_gap.errors.simulated[2]
    assert np.sqrt(np.mean(error[..., :2] ** 2)) < 4e-3  # of a spread of 0.4 rad
    changed = [line for line in (folder / "model.diff").read_text().splitlines() if line.startswith("+ ")]
    assert any("frictionloss" in line for line in changed)
    assert len(changed) <= 6


def test_the_files_say_what_the_contract_promises(friction_gap, tmp_path):
    found = json.loads((friction_gap.save(tmp_path / "out") / "gap.json").read_text())
    assert set(found) >= {"verdict", "effects", "candidates", "gap", "localisation", "model", "diff"}
    assert found["gap"]["metric"] == "normalised RMSE"
    assert found["gap"]["interval95"][0] <= found["gap"]["after"] <= found["gap"]["interval95"][1]
    estimate = found["effects"][0]["parameters"]["frictionloss"]
    assert estimate["interval95"][0] < estimate["value"] < estimate["interval95"][1]
    assert estimate["unit"] == "N m"
    held_out = [candidate["evidence"]["held_out"] for candidate in found["candidates"]]
    assert held_out[0] == max(held_out)


def test_a_sensor_that_was_not_recorded_is_no_candidate():
    recordings = record(lambda q, v: np.zeros(2), np.random.default_rng(5), count=2, seconds=1.0)
    joints = [replace(r, columns={n: v for n, v in r.columns.items() if not n.startswith("site")}) for r in recordings]

    def tried(data):
        gap = find_gap(spec(), data, effects=[EFFECTS["sensor_delay"]])
        return {screened.candidate.place for screened in gap.explanation.stages[0].screened}

    assert tried(joints) == {"joint:shoulder", "joint:elbow"}
    assert tried(recordings) == {"joint:shoulder", "joint:elbow", "site:tip"}


def test_what_cannot_be_searched_is_said_before_any_work():
    recordings = record(lambda q, v: np.zeros(2), np.random.default_rng(4), count=2, seconds=1.0)
    with pytest.raises(ValueError, match="at least one recording"):
        find_gap(spec(), [])
    with pytest.raises(FileNotFoundError, match=r"nothing\.xml"):
        find_gap("nothing.xml", recordings)
    xi = ParameterSpace([Parameter("m", "1", 1.0, 0.1, 9.0, "log", (Write("body_mass", "lower", operation="scale"),))])
    with pytest.raises(ValueError, match=r"as p\(ξ\) or by xi.yaml, not both"):
        find_gap(spec(), recordings, plain=Gaussian.around_nominal(xi, 0.1), config="xi.yaml")
    with pytest.raises(FileNotFoundError, match=r"no parameter file xi\.yaml"):
        find_gap(spec(), recordings, config="xi.yaml")
    other = replace(recordings[1], columns={n: v for n, v in recordings[1].columns.items() if n != "qpos/elbow"})
    with pytest.raises(ValueError, match="different columns"):
        find_gap(spec(), [recordings[0], other])
    broken = replace(recordings[0], columns={**recordings[0].columns, "ctrl/elbow": np.full(51, np.nan)})
    with pytest.raises(ValueError, match="ctrl/elbow"):
        find_gap(spec(), [broken, recordings[1]])


def test_a_model_of_which_nothing_may_be_refitted_is_refused():
    body = "<body><joint name='hinge'/><geom size='0.1'/></body>"
    xml = f"<mujoco><option integrator='RK4'/><worldbody>{body}</worldbody></mujoco>"
    time = np.arange(200) / 100
    log = Recording(time, {"qpos/hinge": 0.1 * np.sin(time)})
    with pytest.raises(ValueError, match="nothing of the model may be refitted"):
        find_gap(mujoco.MjSpec.from_string(xml), [log, log])


def test_a_column_that_shows_nothing_and_a_recording_with_a_twin_are_no_obstacle():
    """One recording of each half: a bootstrap over recordings alone would be sure of what it says."""
    logs = record(lambda q, v: np.zeros(2), np.random.default_rng(3), count=2)
    logs = [replace(r, columns={**r.columns, "site/tip/y": np.zeros(len(r))}, name="log") for r in logs]
    effects = [EFFECTS["coulomb_friction"]]
    gap = find_gap(spec(), logs, effects=effects)
    assert gap.verdict == "none"
    assert {r.name for r in (*gap.data.fitted_recordings, *gap.data.held_out_recordings)} == {"log", "log (2)"}
    low, high = gap.errors.interval95
    assert low < 0.98 * gap.errors.after < gap.errors.after < 0.98 * high


def test_a_recording_that_is_given_twice_counts_once():
    logs = record(lambda q, v: np.zeros(2), np.random.default_rng(3), count=2)
    data = find.read(spec(), [*logs, replace(logs[0], name="again")]).data
    assert {r.name for r in (*data.fitted_recordings, *data.held_out_recordings)} == {"run_0", "run_1"}
    assert "warning: again: the same as run_0: it counts once (run_0)" in map(str, data.warnings)


def test_one_recording_is_split_in_time_and_said_to_be(friction_gap):
    (one,) = record(lambda q, v: np.zeros(2), np.random.default_rng(5), count=1, seconds=4.0)
    gap = find_gap(spec(), [one], effects=FEW[:2])
    assert any("one recording only" in str(warning) for warning in gap.warnings)
    assert gap.data.fitted_recordings[0].time[-1] < gap.data.held_out_recordings[0].time[0]
