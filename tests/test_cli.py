"""The command line: what it does, and that every mistake of a user is one clear line before any work."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from toy_reach import LeanTrainer

from baselines.cli import main
from baselines.commands import inputs
from baselines.commands.inputs import make_trainer
from simopt_envs.tasks.drawer import DrawerTask
from simopt_envs.tasks.env import TaskEnv

ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
TARGET = {"parameters": {"force": 0.6, "gain": 1.3}, "noise": {"position": 0.005}}
VARY = ("--vary", "gain=0.2", "force=0.3")
SMALL = ("--rollouts", "60", "--evaluation-episodes", "10", "--updates", "2", "--iterations", "1")
PENDULUM = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="rod">
      <joint name="hinge" axis="0 1 0" damping="0.02" frictionloss="{friction}"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="0.5"/>
    </body>
  </worldbody>
  <actuator><motor name="drive" joint="hinge"/></actuator>
</mujoco>
"""
XI = """
parameters:
  - {name: friction, field: dof_frictionloss, object: hinge, unit: N m, nominal: 0.03, bounds: [0.001, 1], std: 0.5}
  - {name: mass, field: [body_mass, body_inertia], object: rod, unit: kg, nominal: 0.5, bounds: [0.1, 2], std: 0.1,
     operation: scale}
"""


@pytest.fixture(autouse=True)
def workplace(tmp_path, monkeypatch):
    """An empty folder with a target file, a model with a log and a parameter file; training takes no time."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(inputs, "make_trainer", lambda name, on_progress=None: LeanTrainer())
    (tmp_path / "target.json").write_text(json.dumps(TARGET))
    (tmp_path / "arm.xml").write_text(PENDULUM.format(friction=0.001))
    (tmp_path / "xi.yaml").write_text(XI)
    real = mujoco.MjModel.from_xml_string(PENDULUM.format(friction=0.08))
    data, rows = mujoco.MjData(real), []
    for t in range(800):
        data.ctrl[0] = 0.5 * np.sin(1.7 * t * 0.005) + 0.4 * np.sin(5.3 * t * 0.005)
        rows.append((data.time, data.ctrl[0], data.qpos[0]))
        mujoco.mj_step(real, data)
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header="time,ctrl/drive,qpos/hinge", comments="")
    return tmp_path


@pytest.fixture
def without_report(monkeypatch):
    """Drawing takes seconds."""
    monkeypatch.setattr("baselines.commands.runs.write_report", lambda directory: directory / "report.html")


def adapt(*more):
    main(["adapt", "Toy/Reach-v0", "--target", "target.json", "--out", "out", *VARY, *SMALL, *more])


def refused(capsys, *argv):
    """Run a command that must be refused; its one line."""
    with pytest.raises(SystemExit) as end:
        main([str(a) for a in argv])
    assert end.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith("simopt-envs: error: ")
    assert error.count("\n") == 1
    return error


def test_adapt_to_a_hidden_system(workplace, capsys):
    adapt("--seed", "3")
    out = capsys.readouterr().out
    result = json.loads((workplace / "out" / "result.json").read_text())
    assert result["env_id"] == "Toy/Reach-v0"
    assert result["seed"] == 3
    assert result["parameter_names"] == ["gain", "force"]
    before, after = result["iterations"]
    assert before["mean"] == [0.0, 0.0]
    assert before["std"] == [0.2, 0.3]
    assert after["discrepancy"]["min"] < before["discrepancy"]["min"]
    assert abs(after["median"]["force"] - 0.6) < abs(before["median"]["force"] - 0.6)
    assert "iteration 1: training the policy" in out
    assert re.search(
        rf"^ +1 +{after['target_success']:.0%} .*force {after['median']['force']:.3g} N", out, re.MULTILINE
    )
    assert "hidden truth" in (workplace / "out" / "report.html").read_text()
    details = json.loads((workplace / "out" / "details.json").read_text())
    assert details["command"].startswith("simopt-envs adapt Toy/Reach-v0 --target target.json")
    assert "does not render" in details["notes"][0]


def test_resume_goes_on_and_ends_in_the_same_result(workplace, without_report):
    adapt()
    whole = json.loads((workplace / "out" / "result.json").read_text())
    (workplace / "out").rename("whole")
    adapt("--iterations", "0")
    adapt("--resume")
    resumed = json.loads((workplace / "out" / "result.json").read_text())
    for entry in (*whole["iterations"], *resumed["iterations"]):
        entry.pop("train_seconds")
    assert resumed == whole


def test_interrupted_runs_say_how_to_go_on(workplace, capsys, monkeypatch):
    class Interrupted(LeanTrainer):
        def __call__(self, make_vector_env, policy, rng):
            raise KeyboardInterrupt

    monkeypatch.setattr(inputs, "make_trainer", lambda name, on_progress=None: Interrupted())
    with pytest.raises(SystemExit) as end:
        adapt()
    assert end.value.code == 130
    error = capsys.readouterr().err.strip()
    assert error.count("\n") == 0
    typed = error.split("go on with: simopt-envs ")[1]
    assert typed.startswith("adapt Toy/Reach-v0")
    assert typed.endswith("--resume")
    monkeypatch.setattr(inputs, "make_trainer", lambda name, on_progress=None: LeanTrainer())
    with pytest.raises(SystemExit) as other_trainer:
        main(typed.split())  # the interrupted run was another trainer's: refused, not mixed
    assert other_trainer.value.code == 2


def test_adapt_a_model_to_recordings(workplace, capsys):
    files = ("--data", "log.csv", "--parameters", "xi.yaml", "--out", "out")
    main(["adapt", "arm.xml", *files, "--iterations", "2", "--rollouts", "400"])
    result = json.loads((workplace / "out" / "result.json").read_text())
    before, after = result["iterations"][0], result["iterations"][-1]
    assert after["median"]["friction"] == pytest.approx(0.08, rel=0.15)
    assert before["median"]["friction"] == pytest.approx(0.03)
    assert (workplace / "out" / "report.html").exists()
    said = " ".join(capsys.readouterr().out.split())
    assert "simopt-envs gap arm.xml --data log.csv --out out/gap" in said
    assert json.loads((workplace / "out" / "details.json").read_text())["channel_units"] == {"qpos/hinge": "rad"}


def test_what_to_type_next_is_quoted(workplace, capsys, without_report):
    (workplace / "log.csv").rename("my log.csv")
    files = ("--data", "my log.csv", "--parameters", "xi.yaml", "--out", "my out")
    main(["adapt", "arm.xml", *files, "--iterations", "0", "--rollouts", "9", "--real-rollouts", "3"])
    assert "simopt-envs gap arm.xml --data 'my log.csv' --out 'my out/gap'" in capsys.readouterr().out


def test_a_film_of_other_policies_is_not_left(workplace, without_report):
    adapt("--iterations", "0")
    (workplace / "out" / "film.png").write_bytes(b"")
    adapt("--iterations", "0", "--resume")
    assert (workplace / "out" / "film.png").exists()
    adapt("--resume")  # the toy cannot be filmed
    assert not (workplace / "out" / "film.png").exists()


def test_gap_prints_what_it_saved_as_it_is(workplace, capsys, monkeypatch):
    class Found:
        def save(self, folder):
            (folder / ".fits").mkdir(parents=True, exist_ok=True)
            (folder / "saved").touch()
            return folder

        def __str__(self):
            assert (workplace / "out" / "saved").exists()
            return f"named [bold]{'long ' * 40}"

    monkeypatch.setattr("simopt_envs.gap.find_gap", lambda *_, **__: Found())
    main(["gap", "arm.xml", "--data", "log.csv", "--out", "out"])
    assert capsys.readouterr().out == f"named [bold]{'long ' * 40}\nreport: out/report.html\n"
    assert not (workplace / "out" / ".fits").exists()


def test_a_gap_that_is_interrupted_goes_on_with_the_same_command(workplace, capsys, monkeypatch):
    def find_gap(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("simopt_envs.gap.find_gap", find_gap)
    with pytest.raises(SystemExit):
        main(["gap", "arm.xml", "--data", "log.csv", "--out", "my out"])
    typed = "simopt-envs gap arm.xml --data log.csv --out 'my out'"
    assert capsys.readouterr().err.endswith(f"interrupted; go on with: {typed}\n")


def test_ctrl_c_ends_the_program_before_threads_can_outlive_python(capsys, monkeypatch):
    def interrupted(arguments):
        raise KeyboardInterrupt

    ended: list[int] = []
    monkeypatch.setattr("baselines.cli._run", interrupted)
    monkeypatch.setattr(os, "_exit", ended.append)
    for argv, left in (([], []), (None, [130])):
        with pytest.raises(SystemExit) as end:
            main(argv)
        assert end.value.code == 130
        assert ended == left
        assert capsys.readouterr().err == "\nsimopt-envs: interrupted\n"


def test_inspect_and_replay(workplace, capsys):
    main(["inspect", "log.csv", "--model", "arm.xml", "--out", "looked"])
    assert "800 samples" in capsys.readouterr().out
    assert (workplace / "looked" / "findings.txt").exists()
    main(["replay", "arm.xml", "--data", "log.csv", "--out", "replayed", "--window", "0.5"])
    assert "qpos/hinge" in capsys.readouterr().out
    assert (workplace / "replayed" / "errors.csv").exists()
    text = (workplace / "log.csv").read_text().splitlines()
    (workplace / "backwards.csv").write_text("\n".join([*text[:100], *text[50:100], *text[100:]]))
    with pytest.raises(SystemExit) as end:
        main(["inspect", "backwards.csv"])
    assert end.value.code == 1  # looked at, and found wanting


def test_report_is_written_again(workplace, capsys):
    adapt()
    page = workplace / "out" / "report.html"
    content = page.read_bytes()
    page.unlink()
    main(["report", "out"])
    assert page.read_bytes() == content


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ("{", "target.json is not valid JSON"),
        ("[1]", "must hold an object"),
        ({"paramters": {"force": 1.0}}, "unknown key 'paramters'; did you mean 'parameters'"),
        ({"noise": 0.1}, "lacks the key 'parameters'"),
        ({"parameters": [1, 2]}, "must be an object of name to number"),
        ({"parameters": {"forse": 0.6}}, "unknown parameter 'forse'; did you mean 'force'"),
        ({"parameters": {"force": "0.6"}}, r"parameters\['force'\] must be a number, got '0.6'"),
        ({"parameters": {"force": True}}, "must be a number, got True"),
        ('{"parameters": {"force": NaN}}', "must be a number, got nan"),
        ({"parameters": {"force": 99}}, "'force' is out of bounds: got 99 N, expected -3 to 3"),
        ({"parameters": {}, "noise": -0.1}, "noise must be finite and >= 0"),
        ({"parameters": {}, "noise": {"positon": 0.1}}, "'positon'; did you mean 'position'"),
        ({"parameters": {}, "noise": "much"}, "'noise' must be a number, got 'much'"),
        ({"parameters": {}, "dropout": 1.5}, "dropout must be a probability"),
    ],
)
def test_target_files_with_mistakes(workplace, capsys, target, message):
    (workplace / "target.json").write_text(target if isinstance(target, str) else json.dumps(target))
    line = refused(capsys, "adapt", "Toy/Reach-v0", "--target", "target.json", "--out", "out", *VARY)
    assert re.search(message, line), line
    assert not (workplace / "out").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((), "say what varies with --vary NAME=STD ...; Toy/Reach-v0 has gain, force, drag"),
        (("--vary", "gian=0.1"), "unknown parameter 'gian'; did you mean 'gain'"),
        (("--vary", "gain"), "NAME=STD, such as cabinet_x=0.02, got 'gain'"),
        (("--vary", "gain=much"), "got 'gain=much'"),
        (("--vary", "gain=0"), "std must be positive and finite"),
        (("--vary", "gain=nan"), "std must be positive and finite"),
        ((*VARY, "--iterations", "-1"), "iterations must be >= 0, got -1"),
        ((*VARY, "--updates", "0"), "updates_per_iteration must be at least 1, got 0"),
        ((*VARY, "--rollouts", "5"), "simulated_rollouts must be at least 6, got 5"),
        ((*VARY, "--seed", "-1"), "seed must be at least 0, got -1"),
        ((*VARY, "--epsilon", "0"), "epsilon must be positive and finite"),
        ((*VARY, "--target", "nowhere.json"), "there is no target file nowhere.json"),
        ((*VARY, "--data", "log.csv"), "--data belongs to the model form of adapt"),
        ((*VARY, "--keyframe", "home"), "--keyframe belongs to the model form of adapt"),
    ],
)
def test_options_with_mistakes(workplace, capsys, options, message):
    line = refused(capsys, "adapt", "Toy/Reach-v0", "--target", "target.json", "--out", "out", *options)
    assert message in line
    assert not (workplace / "out").exists()


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (("adapt", "Toy/Reech-v0", "--target", "target.json"), "environment `reech` doesn't exist in namespace toy"),
        (("adapt", "Pendulum-v1", "--target", "target.json"), "Pendulum-v1 has no attribute 'parameters'"),
        (("adapt", "Toy/Reach-v0"), "needs --target target.json"),
        (("adapt", "nowhere.xml", "--data", "log.csv", "--parameters", "xi.yaml"), "there is no model nowhere.xml"),
        (("adapt", "arm.xml", "--parameters", "xi.yaml"), "needs --data LOG"),
        (("adapt", "arm.xml", "--data", "log.csv"), "--parameters xi.yaml"),
        (("adapt", "arm.xml", "--data", "nowhere.csv", "--parameters", "xi.yaml"), "there is no file nowhere.csv"),
        (("adapt", "arm.xml", "--data", "log.csv", "--parameters", "no.yaml"), "there is no parameter file no.yaml"),
        (("adapt", "arm.xml", "--data", "log.csv", "--parameters", "xi.yaml", *VARY), "--vary belongs to"),
        (
            ("adapt", "arm.xml", "--data", "log.csv", "--parameters", "xi.yaml", "--window", "60"),
            "no whole window of 60 s",
        ),
        (
            ("adapt", "arm.xml", "--data", "log.csv", "--parameters", "xi.yaml", "--window", "0"),
            "windows of 0 s hold no two samples that are 0.005 s apart",
        ),
        (
            ("adapt", "arm.xml", "--data", "log.csv", "--parameters", "xi.yaml", "--keyframe", "nope"),
            "unknown keyframe 'nope': the model has none",
        ),
        (("replay", "arm.xml", "--data", "log.csv", "--mapping", "nowhere.yaml"), "there is no file nowhere.yaml"),
        (("replay", "arm.xml", "--data", "nowhere.csv"), "there is no file nowhere.csv"),
    ],
)
def test_systems_and_files_that_are_not_there(workplace, capsys, argv, message):
    assert message.lower() in refused(capsys, *argv, "--out", "out").lower()
    assert not (workplace / "out").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("field:", "feild:"), "parameter friction: unknown key 'feild'; did you mean 'field'"),
        (("dof_frictionloss", "dof_friction"), "unknown model field 'dof_friction'; did you mean 'dof_frictionloss'"),
        (("object: hinge", "object: hing"), "'hing'; did you mean 'hinge'"),
        (("nominal: 0.03", "nominal: 3"), "nominal 3 N m is not within [0.001, 1]"),
        (("nominal: 0.03", "nominal: some"), "nominal must be a number, got 'some'"),
        (("bounds: [0.001, 1]", "bounds: 1"), "bounds must be [low, high], got 1"),
        (("bounds: [0.001, 1]", "bounds: [0, 1]"), "a log coordinate needs low > 0"),
        ((", std: 0.5", ""), "parameter friction: lacks std"),
        (("operation: scale", "operation: scales"), "did you mean 'scale'"),
        (("name: mass", "name: friction"), "parameter names must be unique"),
        (("parameters:", "parameter:"), "must hold a list under the key 'parameters'"),
        (("parameters:", "parameters: ["), "is not valid YAML"),
    ],
)
def test_parameter_files_with_mistakes(workplace, capsys, change, message):
    (workplace / "xi.yaml").write_text(XI.replace(*change))
    line = refused(capsys, "adapt", "arm.xml", "--data", "log.csv", "--parameters", "xi.yaml", "--out", "out")
    assert message in line
    assert not (workplace / "out").exists()


def test_folders_that_hold_something_are_left_alone(workplace, capsys, without_report):
    arguments = ("adapt", "Toy/Reach-v0", "--target", "target.json", "--out", "out", *VARY, *SMALL)
    main(list(arguments))
    before = {path: path.read_bytes() for path in (workplace / "out").rglob("*") if path.is_file()}
    assert "out is not empty" in refused(capsys, *arguments)
    assert "epsilon was 1.0, is now 0.5" in refused(capsys, *arguments, "--epsilon", "0.5", "--resume")
    assert "not empty" in refused(capsys, "replay", "arm.xml", "--data", "log.csv", "--out", "out")
    assert {path: path.read_bytes() for path in (workplace / "out").rglob("*") if path.is_file()} == before
    (workplace / "notes").mkdir()
    (workplace / "notes" / "thesis.tex").write_text("")
    for resume in ((), ("--resume",)):
        assert "notes is not empty (thesis.tex)" in refused(capsys, *arguments, "--out", "notes", *resume)
    assert "is a file" in refused(capsys, *arguments, "--out", "target.json")
    assert "notes is not empty" in refused(capsys, "demo", "--out", "notes")
    assert [p.name for p in (workplace / "notes").iterdir()] == ["thesis.tex"]


def test_report_of_nothing(capsys):
    assert "holds no result.json" in refused(capsys, "report", ".")


@pytest.mark.parametrize(
    ("package", "trainer", "extra"), [("stable_baselines3", "sb3", "sb3"), ("torch", "torch", "torch")]
)
def test_missing_packages_are_named(workplace, capsys, monkeypatch, package, trainer, extra):
    monkeypatch.setattr(inputs, "make_trainer", make_trainer)
    for module in ("baselines.ppo_sb3", "baselines.ppo_torch", "baselines.sb3_vec_env"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    monkeypatch.setitem(sys.modules, package, None)
    arguments = ("adapt", "Toy/Reach-v0", "--target", "target.json", "--out", "out", *VARY)
    assert f'pip install "simopt-envs[{extra}]"' in refused(capsys, *arguments, "--trainer", trainer)
    assert not (workplace / "out").exists()


def test_drawer_defaults_name_parameters_that_exist():
    space = TaskEnv(DrawerTask()).parameters
    distribution = inputs.distribution("SimOpt/Drawer-v0", space, ())
    assert distribution.marginal(["cabinet_x"]).std == pytest.approx(0.02)
    np.testing.assert_allclose(distribution.median, distribution.space.nominal, rtol=1e-14)


def test_patterns_choose_parameters():
    space = TaskEnv(DrawerTask()).parameters
    distribution = inputs.distribution("", space, ("joint_gain_*=0.1", "latency=0.001", "joint_gain_2=0.3"))
    assert distribution.space.names == (*(f"joint_gain_{i}" for i in range(1, 8)), "latency")
    np.testing.assert_allclose(distribution.std, [0.1, 0.3, 0.1, 0.1, 0.1, 0.1, 0.1, 0.001])


@pytest.mark.parametrize(
    ("argv", "code", "said"),
    [
        (("--help",), 0, "adapt"),
        (("adapt", "Nowhere-v0", "--out", "out"), 2, "simopt-envs: error: "),
        (("dance",), 2, "dance"),
    ],
)
def test_as_a_program(argv, code, said):
    done = subprocess.run(
        [sys.executable, "-m", "baselines.cli", *argv], capture_output=True, text=True, env=ENVIRONMENT
    )
    assert done.returncode == code
    assert said in done.stdout + done.stderr
    assert "Traceback" not in done.stderr
