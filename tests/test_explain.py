"""``adapt`` of an environment, from the rollouts that it measures to what its model lacks."""

import json
import shutil
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import toy_reach  # noqa: F401 - registers an environment that is none of this package
from conftest import needs_effects
from rich.console import Console

from baselines.cli import main
from baselines.commands import inputs
from baselines.commands.gap import explain
from baselines.commands.gap_demo import _joined
from baselines.logged_system import LoggedSystem
from simopt_envs.adaptation import EnvSimulator
from simopt_envs.distributions import Gaussian
from simopt_envs.gap.environments import environment
from simopt_envs.gap.find import find_gap, solve
from simopt_envs.measured import Finding, Recording, load_recording
from simopt_envs.physics import ModelWriter
from simopt_envs.physics.effects import EFFECTS
from simopt_envs.tasks.effects import with_effects

pytestmark = needs_effects

DRAWER, SWING_PEG = "SimOpt/Drawer-v0", "SimOpt/SwingPeg-v0"
TARGET = {"parameters": {"joint_damping_2": 17.0, "cabinet_x": 0.01}, "noise": 0.002}
BEYOND = {"parameters": {"joint_damping_2": 60.0}, "noise": 0.002}  # where only the cabinet varies
VARY = ("joint_damping_2=0.2", "cabinet_x=0.02")
FEW = [EFFECTS[name] for name in ("viscous_friction", "payload")]


class Wave:
    """Swings the arm in free space, and opens and closes the gripper, as what it sees of the joints tells."""

    def act(self, observations):
        joints = observations[:, :7]
        swing = 0.4 * np.sin(8.0 * joints + 6.0 * joints[:, [3, 0, 1, 2, 6, 4, 5]] + np.arange(7))
        return np.column_stack([swing, np.sin(40.0 * joints[:, 3])])


class Sway:
    """Swings the arm and what hangs from it, by the time alone; no two episodes alike."""

    def __init__(self):
        self.step = 0

    def act(self, observations):
        self.step += 1
        episode = np.arange(len(observations))[:, None]
        return 0.5 * np.sin(0.08 * (2.2 + 0.75 * episode) * self.step + 0.9 * np.arange(7) + 1.7 * episode)


class Untrained:
    """Its policy needs no training, and is interrupted at one of its steps."""

    def __init__(self, interrupted_at=None):
        self.interrupted_at = interrupted_at

    def __call__(self, make_vector_env, policy, rng):
        return Wave()

    def save(self, policy, path):
        Path(path).write_text("")

    def load(self, path):
        return Wave()


@pytest.fixture(autouse=True)
def workplace(tmp_path, monkeypatch):
    """An empty folder with a target file; nothing is trained, drawn or filmed."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(inputs, "make_trainer", lambda name, on_progress=None: Untrained())
    monkeypatch.setattr("baselines.commands.runs.write_report", lambda directory: directory / "report.html")
    monkeypatch.setattr("baselines.commands.runs.film_policies", lambda *_, **__: None)
    target(TARGET)
    return tmp_path


@pytest.fixture
def few_effects(monkeypatch):
    """A search of seconds, without figures."""
    monkeypatch.setattr("simopt_envs.gap.find_gap", partial(find_gap, effects=FEW))
    monkeypatch.setattr("simopt_envs.gap.find.solve", partial(solve, effects=FEW))
    monkeypatch.setattr("simopt_envs.gap.report.write_report", lambda *_: None)


@pytest.fixture
def asked(monkeypatch):
    """The logs that were handed over, a list for each time; they count as explained."""
    calls = []
    monkeypatch.setattr(
        "baselines.commands.adapt.explain",
        lambda env_id, distributions, logs, *_: calls.append(list(logs)) or "It is noise.",
    )
    return calls


def target(content):
    Path("target.json").write_text(json.dumps(content))


def adapt(*more, vary=VARY):
    small = ("--rollouts", "12", "--evaluation-episodes", "0", "--updates", "1", "--iterations", "1")
    given = ("--target", "target.json", "--out", "out", "--vary", *vary, "--real-rollouts", "2")
    main(["adapt", DRAWER, *given, *small, *more])


def result():
    content = json.loads(Path("out/result.json").read_text())
    for entry in content["iterations"]:
        entry.pop("train_seconds")
    return content


def notes():
    return json.loads(Path("out/details.json").read_text())["notes"]


def test_what_parameters_explain_is_handed_to_nothing(capsys):
    adapt()
    (note,) = notes()
    assert note.startswith("Parameters within p(ξ) explain the measured rollouts")
    assert note in capsys.readouterr().out
    assert not Path("out/gap").exists()
    assert len(list(Path("out/recordings").iterdir())) == 4


def test_what_no_parameter_explains_is_named_once(few_effects, monkeypatch, capsys):
    target(BEYOND)
    adapt("--iterations", "0", vary=("cabinet_x=0.02",))
    found = json.loads(Path("out/gap/gap.json").read_text())
    assert found["effects"][0]["effect"] == "viscous_friction"
    assert found["effects"][0]["where"] == "joint:joint2"
    assert found["effects"][0]["parameters"]["damping"]["value"] == pytest.approx(45.0, rel=0.1)
    assert Path("out/gap/model.repaired.xml").exists()
    assert not Path("out/gap/.fits").exists()
    (note,) = notes()
    assert "viscous_friction at joint:joint2" in note
    printed = capsys.readouterr().out
    assert note in printed
    assert "report: out/gap/report.html" in printed
    (line,) = [line for line in printed.splitlines() if line.startswith("repaired environment: ")]
    repaired = eval(line.removeprefix("repaired environment: "), {"gym": gym, "json": json, "open": open})
    repaired.reset(seed=0)
    assert repaired.unwrapped.model.joint("joint2").damping[0] == pytest.approx(60.0, rel=0.1)

    monkeypatch.setattr("simopt_envs.gap.find.solve", None)  # is not called again
    adapt("--iterations", "0", "--resume", vary=("cabinet_x=0.02",))
    assert notes() == [note]
    assert line in capsys.readouterr().out


def test_a_gap_of_fewer_iterations_is_looked_for_again(asked):
    adapt("--iterations", "0")
    shutil.copytree("out/checkpoints", "out/gap")  # stands for the gap that was found
    Path("out/gap/gap.json").write_text("{}")
    adapt("--resume")
    assert list(map(len, asked)) == [2, 4]
    assert not Path("out/gap").exists()


def test_logs_change_nothing_of_a_run(asked):
    adapt("--no-explain")
    without, asked_without = result(), list(asked)
    assert not Path("out/recordings").exists()
    shutil.rmtree("out")
    adapt()
    assert result() == without
    assert asked_without == []
    assert len(asked) == 1


@pytest.mark.parametrize("when", ["within the rollouts", "before they are a checkpoint"])
def test_a_run_that_was_killed_hands_over_each_rollout_once(when, asked, monkeypatch):
    adapt()
    whole, logs = result(), {path: load_recording(path) for path in asked.pop()}
    shutil.rmtree("out")

    rollout, act, steps = LoggedSystem.rollout, Wave.act, []

    def killed_within(self, observations):
        steps.append(None)
        if len(steps) == 30:
            raise KeyboardInterrupt
        return act(self, observations)

    def killed_after(self, policy, n, rng):
        rollout(self, policy, n, rng)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        if when == "within the rollouts":
            patch.setattr(Wave, "act", killed_within)
        else:
            patch.setattr(LoggedSystem, "rollout", killed_after)
        with pytest.raises(SystemExit):
            adapt()
    assert asked == []
    adapt("--resume")
    assert result() == whole
    assert asked == [list(logs)]
    assert {path.name for path in Path("out/recordings").iterdir()} == {path.name for path in logs}
    for path, log in logs.items():
        np.testing.assert_array_equal(load_recording(path)["qpos/joint2"], log["qpos/joint2"])


def test_too_few_logs_are_said(asked, capsys):
    adapt("--iterations", "0", "--real-rollouts", "1")
    assert "takes two logged rollouts at least, here 1" in capsys.readouterr().out
    shutil.rmtree("out")
    adapt("--no-explain")
    adapt("--resume")  # of rollouts that were not logged
    assert "takes two logged rollouts at least, here 0" in capsys.readouterr().out
    assert asked == []


def test_where_the_workflow_cannot_go_one_line_says_so(asked, monkeypatch, capsys):
    def too_old():
        raise ImportError("physical effects need mujoco >= 4.0, found 3.9.0")

    monkeypatch.setattr("baselines.commands.adapt.require_mujoco", too_old)
    adapt("--iterations", "0")
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "mujoco >= 4.0" in line]
    assert line.startswith("Nothing will look for what p(ξ) cannot explain: ")
    assert not Path("out/recordings").exists()
    assert asked == []


def test_the_gap_command_takes_an_environment(few_effects, tmp_path, capsys):
    load = {"effect": "payload", "where": "body:link7", "parameters": {"mass": 2.5}}
    robot = LoggedSystem(with_effects(DRAWER, [load]), tmp_path / "logs", noise=0.002)
    logs = [str(robot.log(t)) for t in robot.rollout(Wave(), 2, np.random.default_rng(1))]
    main(["gap", DRAWER, "--data", *logs, "--out", "out"])
    assert "payload at body:link7" in capsys.readouterr().out
    found = json.loads(Path("out/gap.json").read_text())
    assert found["effects"][0]["parameters"]["mass"]["value"] == pytest.approx(2.5, rel=0.05)
    repaired, given = mujoco.MjModel.from_xml_path("out/model.repaired.xml"), environment(DRAWER)[0].compile()
    assert repaired.body_subtreemass[0] - given.body_subtreemass[0] == pytest.approx(2.5, rel=0.05)


def test_the_gap_command_is_told_which_recordings_begin_at_rest(monkeypatch, tmp_path, capsys):
    found: list[Recording] = []

    def noted(model, recordings, **_):
        found.extend(recordings)
        raise ValueError("seen")

    monkeypatch.setattr("simopt_envs.gap.find_gap", noted)
    time = 0.01 * np.arange(20)
    logs = [str(Recording(time, {"qpos/a": time}).save(tmp_path / f"run_{i}.csv")) for i in range(3)]
    with pytest.raises(SystemExit):
        main(["gap", DRAWER, "--data", *logs, "--out", "out", "--at-rest", *logs[1:]])
    assert [recording.at_rest for recording in found] == [False, True, True]
    other = str(tmp_path / "other.csv")
    with pytest.raises(SystemExit):
        main(["gap", DRAWER, "--data", *logs, "--out", "out", "--at-rest", other])
    assert f"--at-rest names {other}, which is none of the recordings of --data" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("env_id", "names"),
    [
        (DRAWER, ("joint_gain_2", "drawer_damping", "drawer_mass", "handle_friction", "cabinet_x", "cabinet_z")),
        (SWING_PEG, ("joint_gain_1", "joint_damping_3", "rope_segment_length", "peg_mass", "peg_friction", "hole_y")),
    ],
)
def test_the_model_at_the_median_of_p_is_the_one_that_its_parameters_write(env_id, names):
    space = gym.make(env_id).unwrapped.parameters.subset(names)
    given, _ = environment(env_id)
    rng = np.random.default_rng(3)
    median, other = np.array(
        [
            space.from_unconstrained(space.to_unconstrained(space.nominal) + 0.05 * d)
            for d in rng.standard_normal((2, 6))
        ]
    )
    current = Gaussian(space, space.to_unconstrained(median), 0.01 * np.eye(6))
    spec, plain = environment(env_id, current)
    np.testing.assert_allclose(plain.std, current.std)

    def written(spec, space, xi):
        model = spec.compile()
        ModelWriter(model, space).write_model(xi, model, mujoco.MjData(model))
        return model

    counted = other - np.where(space.nominal == 0, median, 0)  # offsets count from the median
    expected, got = written(given, space, other), written(spec, plain.space, counted)
    for field in (
        "body_pos",
        "body_mass",
        "body_inertia",
        "geom_size",
        "pair_friction",
        "dof_damping",
        "actuator_gainprm",
    ):
        np.testing.assert_allclose(getattr(got, field), getattr(expected, field), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(spec.compile().body_pos, written(given, space, median).body_pos, atol=1e-12)
    assert np.abs(spec.compile().body_pos - expected.body_pos).max() > 1e-4


def test_the_search_starts_from_the_distribution_that_leaves_least(tmp_path, monkeypatch):
    load = {"effect": "payload", "where": "body:link7", "parameters": {"mass": 0.3}}
    robot = LoggedSystem(with_effects(DRAWER, [load]), tmp_path / "logs", noise=0.002)
    logs = [robot.log(trajectory) for trajectory in robot.rollout(Wave(), 2, np.random.default_rng(1))]
    space = gym.make(DRAWER).unwrapped.parameters.subset(["joint_damping_2"])
    first = Gaussian.around_nominal(space, std=0.1)
    bent = Gaussian(space, first.mean - np.log(4.0), [[0.005**2]])
    searched = []

    def search(problem, **_):
        searched.append((problem.given.compile().joint("joint2").damping[0], problem.plain.prior.std[0]))
        raise InterruptedError

    monkeypatch.setattr("simopt_envs.gap.find.solve", search)
    for distributions in ([bent, first], [first, bent]):
        with pytest.raises(InterruptedError):
            explain(DRAWER, distributions, logs, tmp_path / "gap", Console())
        assert searched.pop() == pytest.approx((space.nominal[0], 0.1))


def test_logs_of_episodes_are_read_as_beginning_at_rest(tmp_path, monkeypatch):
    log = Recording(0.01 * np.arange(100), {"qpos/joint1": np.zeros(100)}).save(tmp_path / "log.npz")

    def read(spec, recordings, plain, keyframe):
        assert [recording.at_rest for recording in recordings] == [True, True]
        raise InterruptedError

    monkeypatch.setattr("simopt_envs.gap.find.read", read)
    first = Gaussian.around_nominal(gym.make(DRAWER).unwrapped.parameters.subset(["joint_damping_2"]), std=0.1)
    with pytest.raises(InterruptedError):
        explain(DRAWER, [first], [log, log], tmp_path / "gap", Console())


def test_of_what_was_left_out_nothing_is_said_to_be_noise(tmp_path, monkeypatch):
    log = Recording(0.01 * np.arange(100), {"qpos/joint1": np.zeros(100)}).save(tmp_path / "log.npz")
    warnings = [Finding.warning(f"site/peg/{axis}", "start", "left out, as it hangs") for axis in "xz"]
    warnings.append(Finding.warning("qpos/joint1", "units", "stands still"))
    problem = SimpleNamespace(data=SimpleNamespace(warnings=warnings))
    monkeypatch.setattr("simopt_envs.gap.find.read", lambda *_, **__: problem)
    null = SimpleNamespace(held_out=SimpleNamespace(errors=np.ones((3, 4, 1))))
    monkeypatch.setattr("simopt_envs.gap.find.refitted", lambda *_: null)
    first = Gaussian.around_nominal(gym.make(DRAWER).unwrapped.parameters.subset(["joint_damping_2"]), std=0.1)
    said = explain(DRAWER, [first], [log, log], tmp_path / "gap", Console())
    assert said is not None
    assert said.endswith("what is left is noise. site/peg/x, site/peg/z: left out, as it hangs.")


@pytest.mark.slow
@pytest.mark.parametrize("mass", [0.0, 0.01])
def test_a_knot_in_the_rope_is_told_by_the_peg_that_hangs_from_it(mass, few_effects):
    """What moves unseen is known where episodes begin; half seconds in between, of the arm alone, show nothing."""
    knot = {"effect": "payload", "where": "body:segment4", "parameters": {"mass": mass}}
    robot = LoggedSystem(with_effects(SWING_PEG, [knot] if mass else []), Path("recordings"), noise=0.002)
    logs = [robot.log(trajectory) for trajectory in robot.rollout(Sway(), 6, np.random.default_rng(0))]
    space = EnvSimulator(SWING_PEG).parameters
    prior = inputs.distribution(SWING_PEG, space, ("joint_damping_2=0.05", "rope_bending_damping=0.1"))
    explained = explain(SWING_PEG, [prior], logs, Path("gap"), Console())
    assert (explained is not None) == (mass == 0.0)
    if mass:
        (found,) = json.loads(Path("gap/gap.json").read_text())["effects"]
        assert (found["effect"], found["where"]) == ("payload", "body:segment4")
        assert found["parameters"]["mass"]["value"] == pytest.approx(mass, rel=0.1)


def test_effects_join_xi_with_their_intervals_but_for_what_an_environment_does_not_have():
    entry = {
        "effect": "actuator_delay",
        "where": "actuator:joint2",
        "parameters": {
            "delay": {"value": 0.03, "interval95": [0.02, 0.04]},
            "lag_share": {"value": 0.5, "interval95": [0.1, 0.9]},
        },
    }
    space = EnvSimulator(with_effects(DRAWER, [entry])).parameters
    joined = _joined(Gaussian.around_nominal(space.subset(["cabinet_x"]), std=[0.02]), space, [entry])
    assert joined.space.names == ("cabinet_x", "actuator_delay.joint2.delay")
    assert joined.median[1] == pytest.approx(0.03)
    assert joined.std[1] == pytest.approx(0.01 / 1.96)
