"""Replaying recordings: the simulation is MuJoCo's own, starts are found, and published models give known errors."""

from __future__ import annotations

import importlib.util
import os
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from conftest import needs_effects, needs_examples

from simopt_envs.measured import (
    Recording,
    States,
    Windows,
    WindowSimulator,
    cut_windows,
    engines,
    load_recording,
    replay,
    replay_log,
    simulate_windows,
)
from simopt_envs.measured import windows as windows_module
from simopt_envs.physics import Parameter, ParameterSpace, Write
from simopt_envs.physics.effects import EFFECTS

EXAMPLES = Path(__file__).parents[1] / "simopt_envs" / "measured" / "examples"
needs_data = pytest.mark.skipif(
    not os.environ.get("SIMOPT_DATA") or importlib.util.find_spec("yaml") is None,
    reason="needs pyyaml and the recordings that SIMOPT_DATA names",
)

# A cart with a swinging link: commands with a delay and a filter, position, velocity and acceleration sensors, a site.
CART = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="cart">
      <joint name="slide" type="slide" axis="1 0 0" damping="1" {armature}/>
      <geom type="box" size="0.1 0.1 0.1" mass="1" contype="0" conaffinity="0"/>
      <body name="link" pos="0 0 0.2">
        <joint name="hinge" type="hinge" axis="0 1 0" damping="0.02"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.3" contype="0" conaffinity="0"/>
        <site name="tip" pos="0 0 -0.5"/>
        <site name="middle" pos="0 0 -0.25"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="push" joint="slide" delay="0.006" nsample="5"/>
    <position name="servo" joint="hinge" kp="2" kv="0.1" timeconst="0.02"/>
  </actuator>
  <sensor>
    <gyro name="gyro" site="tip"/>
    <accelerometer name="accelerometer" site="tip"/>
    <framepos name="place" objtype="site" objname="tip"/>
    <framepos name="half" objtype="site" objname="middle"/>
  </sensor>
</mujoco>
"""


def cart(armature: str = "") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(CART.format(armature=armature))


def record(model: mujoco.MjModel, steps: int = 1500, period: int = 1) -> tuple[Recording, np.ndarray, np.ndarray]:
    """Simulate with plain mj_step; returns the recording, every ``period`` steps, and its exact states."""
    from simopt_envs.measured.channels import model_channels, read_channels

    data, scratch = mujoco.MjData(model), mujoco.MjData(model)
    channels = [c for c in model_channels(model).values() if c.kind != "ctrl"]
    rows, commands, states = [], [], []
    data.qpos[:] = 0.3
    for k in range(steps):
        if k % period == 0:
            time = k * model.opt.timestep
            command = [3 * np.sin(5 * time) * (time % 1 > 0.3), 0.5 * np.sign(np.sin(3 * time))]
        data.ctrl[:] = command
        scratch.qpos[:], scratch.qvel[:], scratch.act[:], scratch.ctrl[:] = data.qpos, data.qvel, data.act, data.ctrl
        scratch.history[:], scratch.time = data.history, data.time
        mujoco.mj_forward(model, scratch)
        fields = {kind: getattr(scratch, kind) for kind in ("qpos", "qvel", "sensordata", "site_xpos")}
        rows.append(read_channels(channels, fields))
        states.append(np.concatenate([data.qpos, data.qvel]))
        commands.append(command)
        mujoco.mj_step(model, data)
    columns = {f"ctrl/{name}": np.array(commands)[::period, i] for i, name in enumerate(("push", "servo"))}
    columns |= {c.name: np.array(rows)[::period, i] for i, c in enumerate(channels)}
    exact = np.array(states)[::period]
    return Recording(model.opt.timestep * np.arange(steps)[::period], columns), exact[:, :2], exact[:, 2:]


def exact_starts(windows: Windows, qpos: np.ndarray, qvel: np.ndarray, period: float = 0.002) -> States:
    rows = np.round(windows.start_time / period).astype(int)
    zero = np.zeros((len(rows), 2))
    return States(qpos[rows], qvel[rows], zero, zero, zero)


def centred(qvel: np.ndarray) -> np.ndarray:
    """The velocity of the positions at a sample: q_{k+1} = q_k + h v_{k+1}, so between v_k and v_{k+1}."""
    return 0.5 * (qvel[:-1] + qvel[1:])


def without(recording: Recording, *prefixes: str) -> Recording:
    return recording.only([name for name in recording.columns if not name.startswith(prefixes)])


ENGINES = [engines.RolloutEngine]
if importlib.util.find_spec("mujoco.batch"):
    ENGINES.append(engines.BatchEngine)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_whole_recording_is_repeated_to_the_last_bit_but_rounding(engine):
    """From the exact start every channel agrees, sensors and sites not a step late."""
    model = cart()
    recording, qpos, qvel = record(model)
    windows = cut_windows(model, recording)
    starts = exact_starts(windows, qpos, qvel)
    simulated = engine(model, ParameterSpace(()), windows, 1).run(np.zeros((1, 0)), starts, windows.commands)[0]
    # The recording began with an empty delay and a filter at zero, a window with settled ones: the same at its start,
    # where the commands were 0 and 0.
    assert windows.names[:2] == ("qpos/slide", "qvel/slide")
    np.testing.assert_allclose(simulated, windows.measured, atol=1e-9)


@pytest.mark.parametrize("engine", ENGINES)
def test_delayed_commands_of_before_a_window_still_act_in_it(engine):
    model = cart()
    model.actuator_dyntype[1] = mujoco.mjtDyn.mjDYN_NONE  # a filter's state is an estimate, a delay's is known
    recording, qpos, qvel = record(model)
    windows = cut_windows(model, recording, 0.1)
    starts = exact_starts(windows, qpos, qvel)
    run = engine(model, ParameterSpace(()), windows, 1).run
    np.testing.assert_allclose(run(np.zeros((1, 0)), starts, windows.commands)[0], windows.measured, atol=1e-9)
    forgotten = replace(windows, past_commands=0 * windows.past_commands)
    run = engine(model, ParameterSpace(()), forgotten, 1).run
    assert np.abs(run(np.zeros((1, 0)), starts, windows.commands)[0] - windows.measured)[..., :4].max() > 1e-3


@pytest.mark.parametrize("engine", ENGINES)
def test_an_integrated_setpoint_begins_where_the_joint_is_from_any_start(engine):
    """A servo told to stand still holds a cart wherever it is; one that remembered the windows' start would pull."""
    servo = '<intvelocity name="push" joint="slide" kp="50" kv="20" actrange="-9 9"/>'
    driven = CART.replace('<motor name="push" joint="slide" delay="0.006" nsample="5"/>', servo)
    model = mujoco.MjModel.from_xml_string(driven.format(armature=""))
    time = 0.002 * np.arange(200)
    columns = dict.fromkeys(("ctrl/push", "ctrl/servo", "qpos/slide", "qpos/hinge"), 0.0 * time)
    windows = cut_windows(model, Recording(time, columns), 0.2)
    moved = replace(windows.starts, qpos=windows.starts.qpos + np.array([0.5, 0.0]))
    simulated = engine(model, ParameterSpace(()), windows, 1).run(np.zeros((1, 0)), moved, windows.commands)[0]
    np.testing.assert_allclose(simulated[..., windows.names.index("qpos/slide")], 0.5, atol=1e-3)


@pytest.mark.parametrize("engine", ENGINES)
def test_many_parameter_vectors_at_once_are_each_as_alone(engine):
    model = cart()
    recording, *_ = record(model, 600)
    space = ParameterSpace(
        [
            Parameter("damping", "N s/m", 1.0, 0.1, 10, writes=(Write("dof_damping", "slide"),)),
            Parameter("mass", "kg", 0.3, 0.1, 1, writes=(Write("body_mass", "link"),)),
        ]
    )
    windows = cut_windows(model, recording, 0.2)
    xi = np.array([[1.0, 0.3], [5.0, 0.3], [1.0, 0.6]])
    starts = windows.starts.select(np.tile(np.arange(len(windows)), len(xi)))
    together = engine(model, space, windows, 2).run(xi, starts, np.tile(windows.commands, (len(xi), 1, 1)))
    assert together.shape == (3, len(windows), 101, len(windows.channels))
    for row, predicted in zip(xi, together, strict=True):
        alone = cart()
        alone.dof_damping[0] = row[0]
        alone.body("link").mass[:] = row[1]
        mujoco.mj_setConst(alone, mujoco.MjData(alone))
        np.testing.assert_allclose(predicted, simulate_windows(alone, windows)[0], atol=1e-9)


def test_a_simulator_gives_the_same_whatever_it_ran_before(monkeypatch):
    model = cart()
    windows = cut_windows(model, record(model, 600)[0], 0.2)
    space = ParameterSpace([Parameter("damping", "N s/m", 1.0, 0.1, 10, writes=(Write("dof_damping", "slide"),))])
    xi = np.linspace(1, 9, 5)[:, None]
    simulator = WindowSimulator(model, windows, space)
    first = simulator(xi)
    np.testing.assert_array_equal(simulator(xi[::-1]), first[::-1])
    np.testing.assert_array_equal(simulator(xi[2]), first[2:3])
    monkeypatch.setattr(windows_module, "_NUMBERS_AT_ONCE", 1)  # one vector at a time
    np.testing.assert_array_equal(WindowSimulator(model, windows, space)(xi), first)
    with pytest.raises(ValueError, match=r"'damping'.* is out of bounds: got 20"):
        simulator([[20.0]])


def test_columns_may_be_in_any_order():
    model = cart()
    recording, *_ = record(model, 600)
    turned = replace(recording, columns=dict(reversed(recording.columns.items())))
    both = cut_windows(model, [recording, turned], seconds=0.5)
    np.testing.assert_array_equal(*np.split(both.measured, 2))


def test_the_error_shows_the_wrong_model_and_not_the_right_one():
    right, wrong = cart(), cart('armature="0.5"')
    recording, *_ = record(right, 3000, period=5)  # logged at 100 Hz, five steps of the model
    good, bad = replay(right, recording, seconds=0.5), replay(wrong, recording, seconds=0.5)
    slide = good.windows.names.index("qpos/slide")
    assert good.windows.stride == 5
    assert good.normalised_rmse[0, slide] < 0.02
    assert bad.normalised_rmse[0, slide] > 10 * good.normalised_rmse[0, slide]
    growing = bad.rmse_by_horizon[0, :, slide]
    assert growing[-1] > 5 * growing[5]
    # Without velocities measured, what is left of the right model's error is mostly that of its starts.
    blind = replay(right, without(recording, "qvel", "sensor", "site"), seconds=0.5)
    assert 0.1 < blind.rmse[0, 0] / blind.start_rmse[0] < 10


def test_windows_leave_out_gaps_and_missing_starts():
    model = cart()
    recording, *_ = record(model, 2000)
    rows = np.delete(np.arange(2000), np.s_[700:760])
    holed = Recording(recording.time[rows], {n: v[rows] for n, v in recording.columns.items()})
    np.testing.assert_allclose(cut_windows(model, recording, 0.5).start_time, np.arange(7) * 0.5)
    np.testing.assert_allclose(cut_windows(model, holed, 0.5).start_time, [0, 0.5, 2.0, 2.5, 3.0])
    np.testing.assert_allclose(cut_windows(model, recording, 0.5, step=0.25).start_time, np.arange(14) * 0.25)
    centred = cut_windows(model, recording, 0.5, centred=True)  # of 0.498 s that are left over, a half at either end
    np.testing.assert_allclose(centred.start_time, 0.248 + np.arange(7) * 0.5)
    values = recording["qpos/slide"].copy()
    values[995:1010] = np.nan  # the start of the window at 2 s
    missing = replace(recording, columns={**recording.columns, "qpos/slide": values})
    np.testing.assert_allclose(cut_windows(model, missing, 0.5).start_time, [0, 0.5, 1, 1.5, 2.5, 3])
    several = cut_windows(model, [replace(recording, name="a"), replace(recording, name="b")], 1.0)
    assert several.recording == ("a",) * 3 + ("b",) * 3


@needs_effects
def test_a_drive_with_a_dead_band_needs_no_more_columns_than_one_without():
    recording, *_ = record(cart(), 300)
    spec = mujoco.MjSpec.from_string(CART.format(armature=""))
    EFFECTS["deadband"].add(spec, "actuator:servo")
    loose, firm = (cut_windows(model, recording) for model in (spec.compile(), cart()))
    np.testing.assert_array_equal(loose.commands, firm.commands[..., [0, 1, 1]])
    np.testing.assert_allclose(simulate_windows(spec.compile(), loose), simulate_windows(cart(), firm), atol=1e-9)


def test_what_cannot_be_replayed_is_refused():
    model = cart()
    recording, *_ = record(model, 300)
    with pytest.raises(ValueError, match="no command column for the actuators servo; it has ctrl/push"):
        cut_windows(model, without(recording, "ctrl/servo"))
    nameless = CART.format(armature="").replace(
        "</actuator>", '<motor joint="hinge"/><motor joint="hinge"/></actuator>'
    )
    with pytest.raises(ValueError, match=r"the model's actuators 2, 3 have no name; .* give them names in the MJCF"):
        cut_windows(mujoco.MjModel.from_xml_string(nameless), recording)
    with pytest.raises(ValueError, match="no column of recording names anything in the model"):
        cut_windows(model, recording.only(["ctrl/push", "ctrl/servo"]))
    with pytest.raises(ValueError, match=r"no whole window of 5 s .* the longest lasts 0\.598 s"):
        cut_windows(model, recording, 5.0)
    for seconds in (0.0, -1.0, 0.0005):
        with pytest.raises(ValueError, match=rf"windows of {seconds:g} s hold no two samples that are 0\.002 s apart"):
            cut_windows(model, recording, seconds)
    with pytest.raises(ValueError, match="unknown keyframe 'home': the model has none"):
        cut_windows(model, recording, keyframe="home")
    broken = recording["ctrl/push"].copy()
    broken[5] = np.nan
    with pytest.raises(ValueError, match="command ctrl/push has values that are not finite"):
        cut_windows(model, replace(recording, columns={**recording.columns, "ctrl/push": broken}))
    with pytest.raises(ValueError, match="compared in different columns"):
        cut_windows(model, [recording, without(recording, "qvel")])


def test_a_simulation_that_diverges_counts_as_infinitely_wrong():
    model = cart()
    recording, *_ = record(model, 300)
    wild = replace(recording, columns={**recording.columns, "ctrl/push": recording["ctrl/push"] + 1e14})
    result = replay(model, wild)
    assert np.isnan(result.simulated[0, 0, -1]).all()
    assert np.isinf(result.rmse).all()
    assert np.isfinite(replay(model, recording).rmse).all()


def test_files_are_written(tmp_path):
    pytest.importorskip("matplotlib")
    (tmp_path / "cart.xml").write_text(CART.format(armature=""))
    recording, *_ = record(cart(), 600)
    log = recording.save(tmp_path / "run.csv")
    result = replay_log(tmp_path / "cart.xml", [log], out=tmp_path / "out", seconds=0.5)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"summary.txt", "errors.csv", "error.png", "run.png"}
    table = np.genfromtxt(tmp_path / "out" / "errors.csv", delimiter=",", names=True)
    assert table["horizon"][-1] == pytest.approx(0.5)
    np.testing.assert_allclose(table["qposslide"], result.rmse_by_horizon[0, :, 0])
    log = without(recording, "ctrl/push").save(tmp_path / "short.csv")
    with pytest.raises(ValueError, match="must not be fitted as it is: error: ctrl/push: the actuator has no command"):
        replay_log(tmp_path / "cart.xml", [log])


# --- real systems, against published numbers --------------------------------------------------------------------------


def example(name: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(EXAMPLES / f"{name}.xml"))


@needs_examples
@needs_data
def test_double_pendulum_published_models_give_the_known_errors():
    """0.5 s on runs 4 to 6: 0.107, 0.183 rad without friction and 0.037, 0.059 with the published one."""
    folder = Path(os.environ["SIMOPT_DATA"]) / "double_pendulum"
    runs = [load_recording(folder / f"trajectory_0{k}.csv", EXAMPLES / "double_pendulum.yaml") for k in (4, 5, 6)]
    rigid = example("double_pendulum")
    full = example("double_pendulum")
    full.dof_frictionloss[:], full.dof_damping[:] = (0.093, 0.078), 0.001
    np.testing.assert_allclose(replay(rigid, runs, seconds=0.5).rmse[0, :2], [0.107, 0.183], rtol=0.05)
    np.testing.assert_allclose(replay(full, runs, seconds=0.5).rmse[0, :2], [0.037, 0.059], rtol=0.05)


@needs_examples
@needs_data
def test_emps_published_model_follows_the_whole_recording():
    """Mass, friction and offset as published keep within 10 mm for 24.8 s; the mass alone drifts off by metres."""
    data = Path(os.environ["SIMOPT_DATA"]) / "emps" / "DATA_EMPS.mat"
    recording = load_recording(data, EXAMPLES / "emps.yaml")
    rigid, full = example("emps"), example("emps")
    full.dof_damping[:], full.dof_frictionloss[:], full.actuator_biasprm[0, 0] = 203.5034, 20.3935, 3.1648
    assert replay(rigid, recording).rmse[0, 0] > 1.0
    result = replay(full, recording)
    assert result.rmse[0, 0] < 0.010
    assert result.start_rmse[0] < 0.001


@needs_examples
@needs_data
def test_free_swing_repeats_the_frequency_of_the_nominal_link():
    folder = Path(os.environ["SIMOPT_DATA"]) / "free_swing"
    runs = [
        load_recording(folder / f"pendulum_free_swing_data_0{k}.txt", EXAMPLES / "free_swing.yaml") for k in (1, 2, 3)
    ]
    assert replay(example("free_swing"), runs, seconds=0.6).normalised_rmse[0, 0] < 0.2
    twice = example("free_swing")
    twice.opt.gravity[2] *= 2
    assert replay(twice, runs, seconds=0.6).normalised_rmse[0, 0] > 0.8
