"""``adapt MODEL.xml``: every update rule, what is held out, and what the result says of both."""

import json

import mujoco
import numpy as np
import pytest

from baselines.cli import main
from baselines.commands.recordings import existing_logs, read_split

PENDULUM = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="rod">
      <joint name="hinge" axis="0 1 0" damping="0.02" frictionloss="{friction}" armature="0.01"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="0.5"/>
    </body>
  </worldbody>
  <actuator><motor name="drive" joint="hinge"/></actuator>
</mujoco>
"""
XI = """
parameters:
  - {name: friction, field: dof_frictionloss, object: hinge, unit: N m, nominal: 0.03, bounds: [0.001, 1], std: 0.5}
  - {name: rotor, field: dof_armature, object: hinge, unit: kg m^2, nominal: 0.01, bounds: [0.001, 0.1], std: 0.2}
  - {name: shell, field: body_inertia, index: [0, 1], object: rod, unit: kg m^2, nominal: 0.0038, bounds: [0.0001, 0.1],
     std: 0.5}
"""


def write_log(path, seed):
    model = mujoco.MjModel.from_xml_string(PENDULUM.format(friction=0.08))
    data, rows, (a, b) = mujoco.MjData(model), [], np.random.default_rng(seed).uniform(1, 6, 2)
    for t in range(1200):
        data.ctrl[0] = 0.5 * np.sin(a * t * 0.005) + 0.4 * np.sin(b * t * 0.005)
        rows.append((data.time, data.ctrl[0], data.qpos[0]))
        mujoco.mj_step(model, data)
    np.savetxt(path, rows, delimiter=",", header="time,ctrl/drive,qpos/hinge", comments="")


@pytest.fixture(autouse=True)
def workplace(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("baselines.commands.runs.write_report", lambda directory: directory / "report.html")
    (tmp_path / "arm.xml").write_text(PENDULUM.format(friction=0.001))
    (tmp_path / "xi.yaml").write_text(XI)
    write_log(tmp_path / "run_1.csv", 0)
    write_log(tmp_path / "run_2.csv", 1)
    return tmp_path


def adapt(*more):
    main(
        [
            "adapt",
            "arm.xml",
            "--data",
            "run_1.csv",
            "--parameters",
            "xi.yaml",
            "--out",
            "out",
            "--rollouts",
            "40",
            *more,
        ]
    )
    with open("out/result.json") as file:
        return json.load(file)


def test_a_fit_says_what_it_is_worth_and_what_it_leaves_open(capsys):
    result = adapt("--update", "least-squares", "--held-out", "run_2.csv")
    assert result["iterations"][1]["median"]["friction"] == pytest.approx(0.08, rel=0.05)
    assert len(result["iterations"]) == 2
    held_out = result["held_out"]
    assert held_out["recordings"] == ["run_2"]
    assert held_out["channels"] == ["qpos/hinge"]
    assert held_out["after"][0] < 0.1 * held_out["before"][0]
    (untold,) = result["untold"]
    assert "rotor" in untold
    assert "shell" in untold
    printed = capsys.readouterr().out
    assert untold in printed
    assert "Held out (run_2;" in printed
    with open("out/details.json") as file:
        assert untold in json.load(file)["notes"]


def test_rules_that_weigh_draws_say_it_too():
    result = adapt("--iterations", "1", "--updates", "3", "--rollouts", "900")
    assert result["held_out"]["recordings"] == ["run_1"]  # its last quarter
    assert result["held_out"]["after"][0] < result["held_out"]["before"][0]
    assert "rotor" in result["untold"][0]


def test_cma_es(capsys):
    pytest.importorskip("cma")
    result = adapt("--update", "cmaes")
    assert result["iterations"][1]["median"]["friction"] == pytest.approx(0.08, rel=0.05)


def test_nothing_held_out_is_said(capsys):
    result = adapt("--update", "least-squares", "--held-out-fraction", "0")
    assert "held_out" not in result
    assert "Nothing was held out" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--held-out", "run_1.csv"), "run_1.csv is both to be fitted and held out"),
        (("--held-out", "run_3.csv"), "there is no file run_3.csv"),
        (("--held-out-fraction", "1.5"), "the fraction held out must be in [0, 1), got 1.5"),
    ],
)
def test_what_cannot_be_held_out(options, message, capsys):
    with pytest.raises(SystemExit):
        adapt(*options)
    assert message in capsys.readouterr().err


def test_the_parts_do_not_touch(workplace):
    model = mujoco.MjModel.from_xml_path("arm.xml")
    (fitted,), (held_out,) = read_split(model, [workplace / "run_1.csv"], [], 0.25, 0.5)
    assert held_out.time[0] - fitted.time[-1] == pytest.approx(0.505)
    (whole,), none = read_split(model, [workplace / "run_1.csv"], [], 0.25, 2.0)
    assert len(whole) == 1200
    assert none == []


def test_an_installed_data_set_is_no_missing_file(workplace):
    assert existing_logs(["minari:D4RL/door/human-v2"]) == ["minari:D4RL/door/human-v2"]
    with pytest.raises(FileNotFoundError, match=r"no file minari\.csv"):
        existing_logs([workplace.relative_to(workplace) / "minari.csv"])
