"""The gap workflow on an environment that is not of this package, from its recorded episodes to its repair."""

from functools import partial

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from conftest import needs_effects

from baselines.cli import main
from simopt_envs.gap import find_gap
from simopt_envs.measured.channels import actuator_names, model_channels
from simopt_envs.physics.effects import EFFECTS
from wrappers import RecordEpisodes

REACHER, FRICTION = "Reacher-v5", 0.3
FEW = [EFFECTS[name] for name in ("coulomb_friction", "viscous_friction")]
DRIVES = """
<mujoco>
  <worldbody>
    <body><joint name="hip"/><geom size="0.1"/><body><joint name="knee"/><geom size="0.1"/></body></body>
    <body><joint name="wheel"/><geom size="0.1"/></body>
  </worldbody>
  <tendon><fixed name="cable"><joint joint="knee" coef="1"/></fixed></tendon>
  <actuator>{}</actuator>
</mujoco>
"""


@pytest.mark.parametrize(
    ("actuators", "names"),
    [
        ('<motor joint="hip"/><motor name="shin" joint="knee"/><motor tendon="cable"/>', ["hip", "shin", "cable"]),
        ('<motor joint="hip"/><motor joint="hip"/><motor joint="wheel"/>', ["", "", "wheel"]),  # whose would it be?
        ('<motor name="hip" joint="knee"/><motor joint="hip"/>', ["hip", ""]),
        ("", []),
    ],
)
def test_an_actuator_without_a_name_is_called_as_what_it_alone_acts_on(actuators, names):
    model = mujoco.MjModel.from_xml_string(DRIVES.format(actuators))
    assert actuator_names(model) == names
    assert [n for n in model_channels(model) if n.startswith("ctrl/")] == [f"ctrl/{name}" for name in names if name]


def test_an_actuator_that_acts_on_something_else_stays_without_a_name():
    """As kinds of transmission that are newer than this code do."""
    model = mujoco.MjModel.from_xml_string(DRIVES.format('<motor joint="hip"/>'))
    model.actuator_trntype[0] = int(mujoco.mjtTrn.mjTRN_UNDEFINED)
    assert actuator_names(model) == [""]


@needs_effects
def test_an_actuator_of_several_commands_is_refused():
    model = mujoco.MjModel.from_xml_string(DRIVES.format('<motor joint="hip"/><pid name="servo" joint="knee"/>'))
    with pytest.raises(ValueError, match="actuator 'servo' takes 2 commands, expected one"):
        actuator_names(model)


@needs_effects
def test_an_actuator_that_takes_no_command_is_passed_over():
    spec = mujoco.MjSpec.from_string(DRIVES.format('<motor joint="hip"/>'))
    EFFECTS["cogging"].add(spec, "joint:hip")
    spec.add_actuator(name="later", target="knee", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    assert actuator_names(spec.compile()) == ["hip", "later"]


@needs_effects
def test_the_part_that_a_dead_band_adds_is_commanded_as_its_drive():
    spec = mujoco.MjSpec.from_string(DRIVES.format('<motor name="hip" joint="hip"/><motor joint="wheel"/>'))
    EFFECTS["deadband"].add(spec, "actuator:hip")
    model = spec.compile()
    assert actuator_names(model) == ["hip", "wheel", "hip"]
    commands = [channel for channel in model_channels(model).values() if channel.kind == "ctrl"]
    assert [(channel.name, channel.index) for channel in commands] == [("ctrl/hip", 0), ("ctrl/wheel", 1)]


@needs_effects
def test_from_episodes_of_gymnasiums_reacher_to_its_repair(tmp_path, monkeypatch, capsys):
    """Its actuators have no names, and its model lacks the friction that the recorded one has in its second joint."""
    monkeypatch.setattr("simopt_envs.gap.find_gap", partial(find_gap, effects=FEW))
    monkeypatch.setattr("simopt_envs.gap.report.write_report", lambda *_: None)
    hidden = mujoco.MjSpec.from_file(gym.make(REACHER).unwrapped.fullpath)
    hidden.joint("joint1").frictionloss = FRICTION
    (tmp_path / "hidden.xml").write_text(hidden.to_xml())
    robot = RecordEpisodes(
        gym.make(REACHER, xml_file=str(tmp_path / "hidden.xml"), max_episode_steps=150),
        tmp_path / "logs",
        columns=["qpos/joint*"],
        noise={"qpos/*": 1e-3},
    )
    rng, time = np.random.default_rng(0), 0.02 * np.arange(150)[:, None, None]
    for episode in range(8):
        robot.reset(seed=episode)
        frequency, phase = rng.uniform(0.15, 1.5, (4, 2)), rng.uniform(0, 2 * np.pi, (4, 2))
        for action in np.sin(2 * np.pi * frequency * time + phase).sum(axis=1) * [0.016, 0.008]:
            robot.step(action.astype(np.float32))
    main(["gap", REACHER, "--data", *map(str, robot.recordings), "--out", str(tmp_path / "gap")])
    assert "named\n  coulomb_friction at joint:joint1" in capsys.readouterr().out
    repaired = gym.make(REACHER, xml_file=str(tmp_path / "gap" / "model.repaired.xml")).unwrapped.model
    assert repaired.joint("joint1").frictionloss[0] == pytest.approx(FRICTION, rel=0.05)
    assert repaired.joint("joint0").frictionloss[0] == 0


@needs_effects
def test_an_environment_without_an_mjcf_file_is_told(tmp_path, capsys):
    log = tmp_path / "log.csv"
    log.write_text("time,qpos/a\n0,0\n0.1,0\n")
    with pytest.raises(SystemExit):
        main(["gap", "CartPole-v1", "--data", str(log), str(log), "--out", str(tmp_path / "gap")])
    assert "CartPole-v1 has no task with a model to repair; give its MJCF file" in capsys.readouterr().err
