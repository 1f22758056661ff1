"""The audit: each defect is named, and what is merely noisy, quantised or jittered passes."""

from __future__ import annotations

import importlib.util
import os
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from conftest import needs_effects, needs_examples

from simopt_envs.measured import Finding, Recording, audit, audited, inspect_log, load_recording, plots
from simopt_envs.physics.effects import EFFECTS

EXAMPLES = Path(__file__).parents[1] / "simopt_envs" / "measured" / "examples"

ARM = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body>
      <joint name="shoulder" axis="0 1 0" range="-2 2" limited="true" damping="0.05"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5" contype="0" conaffinity="0"/>
      <body pos="0 0 -0.3">
        <joint name="elbow" axis="0 1 0" damping="0.02"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.3" contype="0" conaffinity="0"/>
        <site name="tip" pos="0 0 -0.2"/>
      </body>
    </body>
    <body pos="1 0 0">
      <joint name="rail" type="slide" axis="1 0 0" damping="2"/>
      <geom type="box" size="0.1 0.1 0.1" mass="2" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="shoulder" joint="shoulder" ctrlrange="-2 2" ctrllimited="true"/>
    <motor name="elbow" joint="elbow"/>
    <motor name="rail" joint="rail"/>
  </actuator>
</mujoco>
"""
MODEL = mujoco.MjModel.from_xml_string(ARM)
COUNT = 2 * np.pi / 8192


def good_log() -> Recording:
    """Six seconds at 500 Hz as a decent rig logs them: encoder counts, velocity noise, stamps off by some percent."""
    rng = np.random.default_rng(3)
    data = mujoco.MjData(MODEL)
    rows, commands = [], []
    phases = rng.uniform(0, 2 * np.pi, (3, 4))
    for k in range(3000):
        time, frequencies = 0.002 * k, np.array([0.5, 0.9, 1.3, 2.1])
        waves = np.sin(2 * np.pi * frequencies * time + phases).sum(axis=1)
        data.ctrl[:] = waves * [0.4, 0.12, 4.0]
        commands.append(data.ctrl.copy())
        rows.append(np.concatenate([data.qpos, data.qvel, data.site_xpos[0]]))
        mujoco.mj_step(MODEL, data)
    rows, commands = np.array(rows), np.array(commands)
    columns = {f"ctrl/{name}": commands[:, i] for i, name in enumerate(("shoulder", "elbow", "rail"))}
    for i, name in enumerate(("shoulder", "elbow", "rail")):
        columns[f"qpos/{name}"] = np.round(rows[:, i] / COUNT) * COUNT
        columns[f"qvel/{name}"] = rows[:, 3 + i] + rng.normal(0, 0.01, 3000)
    columns |= {f"site/tip/{axis}": rows[:, 6 + i] for i, axis in enumerate("xyz") if axis != "y"}
    return Recording(0.002 * np.arange(3000) + rng.uniform(-3e-5, 3e-5, 3000), columns, "good")


GOOD = good_log()


def with_columns(**columns: np.ndarray) -> Recording:
    """The good log with columns replaced; ``__`` stands for a slash."""
    return replace(GOOD, columns={**GOOD.columns, **{n.replace("__", "/"): v for n, v in columns.items()}})


def with_rows(rows: np.ndarray) -> Recording:
    return replace(GOOD, time=GOOD.time[rows], columns={n: v[rows] for n, v in GOOD.columns.items()})


def with_time(time: np.ndarray) -> Recording:
    return replace(GOOD, time=time)


def without(*names: str) -> Recording:
    return GOOD.only([n for n in GOOD.columns if n not in names])


def late(name: str, samples: int) -> np.ndarray:
    values = GOOD[name]
    return np.concatenate([np.full(samples, values[0]), values[:-samples]])


def holed(name: str, rows: slice, value: float = np.nan) -> np.ndarray:
    values = GOOD[name].copy()
    values[rows] = value
    return values


def frozen(name: str, row: int) -> np.ndarray:
    return np.where(np.arange(3000) < row, GOOD[name], GOOD[name][row])


def moving(name: str) -> int:
    """A row where the joint moves fast."""
    return int(np.argmax(np.abs(GOOD[name.replace("qpos", "qvel")][1000:2000]))) + 1000


def swapped(first: str, second: str) -> Recording:
    return with_columns(**{first.replace("/", "__"): GOOD[second], second.replace("/", "__"): GOOD[first]})


def test_a_decent_log_is_left_alone():
    assert audit(GOOD, MODEL) == []
    assert audit(GOOD) == []
    assert audited(GOOD, MODEL).warnings == ()


@needs_effects
@pytest.mark.parametrize("width", [1e-12, 0.2])
def test_a_log_is_left_alone_by_a_model_with_a_dead_band(width):
    spec = mujoco.MjSpec.from_string(ARM)
    EFFECTS["deadband"].add(spec, "actuator:shoulder")
    spec.actuator("shoulder.deadband").forcerange = -width, width
    assert audit(GOOD, spec.compile()) == []
    (missing,) = audit(without("ctrl/shoulder"), spec.compile())
    assert (missing.channel, missing.check) == ("ctrl/shoulder", "columns")


def test_a_quick_motion_in_few_samples_is_one_and_noise_is_none():
    time = np.arange(150) * 0.02  # 50 Hz
    rng = np.random.default_rng(0)
    motion = np.sin(2 * np.pi * 1.5 * time) + 1e-3 * rng.standard_normal(150)
    noise = 1e-3 * rng.standard_normal(150)
    assert audit(Recording(time, {"qpos/elbow": motion})) == []
    assert [f.check for f in audit(Recording(time, {"qpos/elbow": noise}))] == ["jumps"]


def test_noise_does_not_jump_and_a_glitch_in_it_does():
    time = np.arange(3000) * 0.02
    noisy = 0.1 * np.sin(0.2 * np.pi * time) + 8e-4 * np.random.default_rng(0).standard_normal(3000)
    assert audit(Recording(time, {"qpos/elbow": noisy})) == []
    noisy[1500] += 0.03
    assert [f.check for f in audit(Recording(time, {"qpos/elbow": noisy}))] == ["jumps"]


def test_a_command_may_be_held_where_a_measurement_must_not():
    time = np.arange(150) * 0.02
    held = np.clip(np.sin(2 * np.pi * time), -0.7, 0.7)
    assert audit(Recording(time, {"ctrl/elbow": held})) == []
    assert [f.check for f in audit(Recording(time, {"qpos/elbow": held}))] == ["saturated"]


DEFECTS: dict[str, tuple[Callable[[], Recording], str, str, str]] = {
    # what: (log, severity, check, message)
    "no samples": (lambda: with_rows(np.arange(0)), "error", "length", "only 0 samples; at least 20"),
    "too few samples": (lambda: with_rows(np.arange(5)), "error", "length", "only 5 samples"),
    "time backward": (
        lambda: with_rows(np.r_[0:2000, 1000:3000]), "error", "time", "backward 1 times, first after row 1999",
    ),
    "time missing": (lambda: with_time(np.where(GOOD.time > 3, np.nan, GOOD.time)), "error", "time", "are not finite"),
    "time stands still": (lambda: with_time(np.zeros(3000)), "error", "time", "all time stamps are 0 s"),
    "duplicates": (
        lambda: with_rows(np.r_[0:2000, 1999:3000]), "warning", "duplicates", "1 repeated .* first in row 2000",
    ),
    "late stamps": (
        lambda: with_time(np.where(np.arange(3000) % 999 == 500, np.roll(GOOD.time, -1) - 1e-5, GOOD.time)),
        "warning", "duplicates", "3 repeated time stamps, or less than 0.1 sample periods before the next, first in",
    ),
    "a clock that was set": (
        lambda: with_time(np.where(np.arange(3000) < 1, 0.0, 1.7e9 + GOOD.time)),
        "error", "gaps", r"jumps by 1.7e\+09 s after row 0, from 0 s: cut",
    ),
    "gap": (lambda: with_rows(np.r_[0:2000, 2100:3000]), "warning", "gaps", "1 gaps .* longest 0.2.* s after row 1999"),
    "jitter": (
        lambda: with_time(GOOD.time + np.random.default_rng(0).uniform(0, 0.001, 3000)),
        "warning", "jitter", "% of the intervals differ by more than 10 % from the median",
    ),
    "time in ms": (lambda: with_time(GOOD.time * 1e3), "error", "units", "the rate is 0.5.* Hz: is time in seconds"),
    "wrong rate": (lambda: with_time(GOOD.time * 2), "warning", "velocity", "rate of the time stamps"),
    "nan": (lambda: with_columns(qpos__elbow=holed("qpos/elbow", np.s_[50:80])), "warning", "missing", "1 % of"),
    "mostly nan": (
        lambda: with_columns(qpos__elbow=holed("qpos/elbow", np.s_[50:2420])), "error", "missing", "79 % of",
    ),
    "all nan": (lambda: with_columns(qpos__elbow=np.full(3000, np.nan)), "error", "missing", "holds no finite value"),
    "infinite": (lambda: with_columns(qpos__elbow=holed("qpos/elbow", np.s_[7:8], np.inf)), "error", "missing", "row"),
    "command nan": (lambda: with_columns(ctrl__elbow=holed("ctrl/elbow", np.s_[7:8])), "error", "missing", "row 7"),
    "constant": (lambda: with_columns(site__tip__x=np.full(3000, 0.1)), "warning", "constant", "constant at 0.1"),
    "frozen": (
        lambda: with_columns(qpos__rail=frozen("qpos/rail", moving("qpos/rail"))), "warning", "constant", "freezes in",
    ),
    "lost rows": (
        lambda: replace(with_rows(np.r_[0:1000, 1050:3000]), time=0.002 * np.arange(2950)),
        "warning", "jumps", "jumps 1 times, first by .* at 2 s: lost rows",
    ),
    "shuffled rows": (
        lambda: replace(with_rows(np.random.default_rng(0).permutation(3000)), time=GOOD.time),
        "warning", "jumps", "is no motion: .* rows out of order",
    ),
    "wrapped angle": (
        lambda: with_columns(qpos__elbow=(GOOD["qpos/elbow"] - GOOD["qpos/elbow"].mean()) % (2 * np.pi)),
        "warning", "jumps", "first by 6.2[78].*: an angle that wraps",
    ),
    "beyond physics": (
        lambda: with_columns(qpos__elbow=1e300 * GOOD["qpos/elbow"]), "error", "units", "no quantity of a robot",
    ),
    "clipped": (
        lambda: with_columns(qpos__elbow=np.minimum(GOOD["qpos/elbow"], np.percentile(GOOD["qpos/elbow"], 80))),
        "warning", "saturated", "where 20 % of its samples lie",
    ),
    "degrees within a range": (
        lambda: with_columns(qpos__shoulder=np.rad2deg(GOOD["qpos/shoulder"])), "error", "units", "it is in degrees",
    ),
    "degrees without a range": (
        lambda: with_columns(qpos__elbow=np.rad2deg(GOOD["qpos/elbow"])), "warning", "velocity", "position is in deg",
    ),
    "degrees without velocity": (
        lambda: replace(without("qvel/elbow"), columns={
            **without("qvel/elbow").columns, "qpos/elbow": np.rad2deg(GOOD["qpos/elbow"])}),
        "warning", "units", "rpm.*: is it in degrees?",
    ),
    "degrees per second": (
        lambda: with_columns(qvel__elbow=np.rad2deg(GOOD["qvel/elbow"])), "warning", "velocity", "degrees per sec",
    ),
    "millimetres": (lambda: with_columns(qpos__rail=1e3 * GOOD["qpos/rail"]), "warning", "units", "in millimetres"),
    "site in millimetres": (
        lambda: with_columns(site__tip__z=1e3 * GOOD["site/tip/z"]), "warning", "units", "in millimetres",
    ),
    "out of range": (
        lambda: with_columns(qpos__shoulder=GOOD["qpos/shoulder"] + 3), "warning", "range", "outside the joint's range",
    ),
    "command out of range": (
        lambda: with_columns(ctrl__shoulder=2 * GOOD["ctrl/shoulder"]), "warning", "range", "the model would clip them",
    ),
    "late velocity": (
        lambda: with_columns(qvel__elbow=late("qvel/elbow", 8)), "warning", "latency", "is 1[567].* ms behind",
    ),
    "negated velocity": (lambda: with_columns(qvel__elbow=-GOOD["qvel/elbow"]), "warning", "velocity", "opposite sign"),
    "swapped velocities": (
        lambda: swapped("qvel/elbow", "qvel/rail"), "warning", "velocity", "that of qpos/rail: are columns swapped",
    ),
    "noise for velocity": (
        lambda: with_columns(qvel__elbow=np.random.default_rng(0).normal(0, 1, 3000)),
        "warning", "velocity", "is not the derivative of qpos/elbow .* leave it out",
    ),
    "late command": (
        lambda: with_columns(ctrl__rail=late("ctrl/rail", 15)), "warning", "latency", "rail precedes it by 3.* ms more",
    ),
    "early command": (
        lambda: with_columns(ctrl__rail=np.roll(GOOD["ctrl/rail"], -15)),
        "warning", "latency", "rail follows it by [23].* ms more",
    ),
    "negated command": (
        lambda: with_columns(ctrl__rail=-GOOD["ctrl/rail"]), "warning", "command", "acts against the motion of rail",
    ),
    "command in mN m": (
        lambda: with_columns(ctrl__elbow=1e3 * GOOD["ctrl/elbow"]), "warning", "units", "needed 0.001.* times",
    ),
    "swapped commands": (
        lambda: swapped("ctrl/elbow", "ctrl/rail"), "warning", "command", "moves with ctrl/rail instead",
    ),
    "missing actuator": (lambda: without("ctrl/rail"), "error", "columns", "the actuator has no command column"),
    "misspelt column": (
        lambda: replace(without("qpos/rail"), columns={
            **without("qpos/rail").columns, "qpos/rial": GOOD["qpos/rail"]}),
        "warning", "columns", "unknown column 'qpos/rial'; did you mean 'qpos/rail'",
    ),
    "foreign log": (
        lambda: Recording(GOOD.time, {"a": GOOD["qpos/rail"]}), "error", "columns", "no measured column names anything",
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", DEFECTS)
def test_a_defect_is_named(what):
    make, severity, check, message = DEFECTS[what]
    log = make()
    findings = audit(log, MODEL)
    named = [f for f in findings if (f.severity, f.check) == (severity, check)]
    assert named, f"found only {[str(f) for f in findings]}"
    assert re.search(message, "; ".join(finding.message for finding in named))
    if severity == "error":
        with pytest.raises(ValueError, match="must not be fitted as it is"):
            audited(log, MODEL)


def test_a_column_that_the_model_does_not_have_is_left_out_whatever_it_holds():
    foreign = replace(GOOD, columns={**GOOD.columns, "stamp": 1.7e18 + GOOD.time, "battery": np.full(3000, np.nan)})
    assert [f.severity for f in audit(foreign, MODEL)] == ["warning", "warning"]
    assert {f.severity for f in audit(foreign)} == {"error"}, "without a model, any column may be a signal"


@pytest.mark.parametrize("rate", [4.0, 5.0, 7.0])
def test_a_slow_log_is_audited(rate):
    assert not [f for f in audit(GOOD.resample(1 / rate), MODEL) if f.severity == "error"]


def test_the_velocities_of_a_floating_body_are_no_derivatives_of_its_position_alone():
    xml = "<mujoco><worldbody><body><freejoint name='base'/><geom size='0.1'/></body></worldbody></mujoco>"
    time = np.arange(500) / 100
    place = np.stack([np.sin((k + 1) * time) for k in range(3)])
    rate = np.stack([(k + 1) * np.cos((k + 1) * time) for k in range(3)])
    turn = np.stack([np.cos(0.5 * time), np.sin(0.5 * time), 0 * time, 0 * time])  # at 1 rad/s about x
    columns = {f"qpos/base/{k}": values for k, values in enumerate([*place, *turn])}
    columns |= {f"qvel/base/{k}": values for k, values in enumerate([*rate, np.ones(500), 0 * time, 0 * time])}
    findings = audit(Recording(time, columns), mujoco.MjModel.from_xml_string(xml))
    assert not [f for f in findings if f.check == "velocity"]


def test_actuators_without_a_name_are_told():
    """Where they share what they act on; a fit would fail later, in words that help nobody."""
    spec = mujoco.MjSpec.from_string(ARM)
    spec.actuators[0].name = ""
    spec.add_actuator(target=spec.actuators[0].target, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    with pytest.raises(ValueError, match=r"the model's actuators 0, 3 have no name, .* give them names in the MJCF"):
        audited(GOOD, spec.compile())


def set_off(seed: int, held: float) -> Recording:
    """Two seconds at 200 Hz of a servo driven arm that stands for so long and then follows a sine, with noise."""
    model = mujoco.MjModel.from_xml_string("""
<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody><body><joint name="arm" axis="0 0 1"/>
<geom size="0.1" pos="0.3 0 0" mass="1"/></body></worldbody>
<actuator><position name="arm" joint="arm" kp="100" kv="10"/></actuator></mujoco>""")
    rng, data, time = np.random.default_rng(seed), mujoco.MjData(model), 0.005 * np.arange(400)
    phase, rows = rng.uniform(0, 6), []
    commands = np.where(time < held, 0.0, 0.5 * np.sin(5 * (time - held) + phase))
    for command in commands:
        rows.append(data.qpos[0])
        data.ctrl[:] = command
        mujoco.mj_step(model, data)
    measured = np.array(rows) + rng.normal(0, 5e-4, 400)
    return Recording(time, {"ctrl/arm": commands, "qpos/arm": measured}, "set off", at_rest=True)


@pytest.mark.parametrize("held", [0.0, 0.02, 0.3])
def test_a_recording_that_begins_at_rest_passes(held):
    """Also where its command jumps as it begins."""
    for seed in range(20):
        assert not [f for f in audit(set_off(seed, held)) if f.check == "rest"], seed


def test_a_short_recording_from_rest_is_audited():
    time = np.arange(400) / 10_000
    assert audit(replace(Recording(time, {"qpos/a": 1e-3 * time**2}), at_rest=True)) == []


def test_a_recording_that_does_not_begin_at_rest_as_it_is_said_to_is_told():
    told = 0
    for seed in range(20):
        recording = set_off(seed, 0.0).select(start=0.4 + 0.02 * seed)
        assert not recording.at_rest  # what is cut off its beginning is no longer known to be at rest
        claimed = replace(recording, at_rest=True)
        told += any(f.check == "rest" for f in audit(claimed))
        assert not [f for f in audit(recording) if f.check == "rest"]
    assert told > 10  # the others turn round, or are no faster than the arm can be from rest
    with pytest.raises(
        ValueError, match=r"qpos/arm: the recording is said to begin at rest, but it moves by .* in its"
    ):
        audited(claimed)


@pytest.mark.parametrize("what", ["nan", "clipped", "late velocity", "missing actuator", "degrees without a range"])
def test_a_defect_of_one_channel_is_not_pinned_on_another(what):
    channel = {"missing actuator": "rail"}.get(what, "elbow")
    assert all(finding.channel.endswith(channel) for finding in audit(DEFECTS[what][0](), MODEL))


def test_warnings_travel_with_the_recording():
    flagged = audited(DEFECTS["gap"][0](), MODEL)
    assert [w.check for w in flagged.warnings] == ["gaps"]
    assert flagged.select(0, 3).resample(0.01).warnings == flagged.warnings
    again = replace(GOOD, warnings=(Finding("warning", "", "rows", "two rows left out"),))
    assert [str(f) for f in audit(again, MODEL)] == ["warning: two rows left out"]


def test_inspecting_never_raises_for_a_bad_log(tmp_path):
    (tmp_path / "arm.xml").write_text(ARM)
    logs = {
        "empty.csv": b"",
        "words.csv": b"a,b\nx,y\n",
        "noise.npz": b"\x00" * 99,
        "no.mat": b"MATLAB",
        "odd.xyz": b"1",
    }
    for name, content in logs.items():
        (tmp_path / name).write_bytes(content)
    for name in [*logs, "missing.csv"]:
        inspection = inspect_log(tmp_path / name, tmp_path / "arm.xml")
        assert not inspection.ok
        assert str(inspection).startswith(f"{name}: error: ")
    with pytest.raises(FileNotFoundError, match="there is no model"):
        inspect_log(tmp_path / "empty.csv", tmp_path / "nowhere.xml")


def test_inspecting_writes_a_table_and_a_plot(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    labels: list[str] = []
    save = plots._save

    def labelled(figure, path):
        labels.extend(axis.get_ylabel() for axis in figure.axes)
        return save(figure, path)

    monkeypatch.setattr(plots, "_save", labelled)
    (tmp_path / "arm.xml").write_text(ARM)
    log = DEFECTS["gap"][0]().save(tmp_path / "run.csv")
    inspection = inspect_log(log, tmp_path / "arm.xml", out=tmp_path / "out")
    assert inspection.ok
    assert "run: 2900 samples" in str(inspection)
    assert "warning: time: 1 gaps" in (tmp_path / "out" / "findings.txt").read_text()
    assert (tmp_path / "out" / "run.png").stat().st_size > 10_000
    assert {"ctrl/elbow", "qvel/elbow\n[rad/s]", "qpos/rail\n[m]", "interval [ms]"} <= {
        label.removesuffix("\n[1]") for label in labels
    }


@needs_examples
@pytest.mark.skipif(
    not os.environ.get("SIMOPT_DATA") or importlib.util.find_spec("yaml") is None,
    reason="needs pyyaml and the recordings that SIMOPT_DATA names",
)
def test_public_logs_of_real_hardware_raise_no_false_alarm():
    """Two of the fourteen were written with stamps that do jitter, by 40 %; nothing else is wrong with them."""
    data = Path(os.environ["SIMOPT_DATA"])
    found = {}
    for folder, pattern in (("emps", "*.mat"), ("double_pendulum", "*.csv"), ("free_swing", "*_data_*.txt")):
        model = mujoco.MjModel.from_xml_path(str(EXAMPLES / f"{folder}.xml"))
        for path in sorted((data / folder).glob(pattern)):
            findings = audit(load_recording(path, EXAMPLES / f"{folder}.yaml"), model)
            found[path.stem] = [finding.check for finding in findings]
    assert len(found) == 14
    assert {name: checks for name, checks in found.items() if checks} == {
        "trajectory_12": ["jitter"],
        "trajectory_13": ["jitter"],
    }
