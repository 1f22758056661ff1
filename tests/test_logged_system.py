"""From SimOpt's rollouts on a hidden system to what the gap workflow reads: logs, the model, plain parameters."""

import numpy as np
import pytest
import toy_reach  # noqa: F401 - registers an environment that is none of this package
from conftest import needs_batch, needs_effects

from baselines.logged_system import LoggedSystem
from simopt_envs.adaptation import HiddenSystem
from simopt_envs.gap import find
from simopt_envs.gap.environments import environment
from simopt_envs.measured import load_recording
from simopt_envs.tasks.effects import with_effects

DRAWER = "SimOpt/Drawer-v0"
LOAD = {"effect": "payload", "where": "body:link7", "parameters": {"mass": 2.5}}


class Reach:
    """Moves as fast as what it sees of the second joint tells."""

    def __init__(self, actions=8):
        self.actions = actions

    def act(self, observations):
        return np.tile(0.5 + observations[:, 1:2], (1, self.actions)).clip(-1, 1)


@needs_batch
def test_rollouts_are_those_of_the_hidden_system_and_their_logs_show_them(tmp_path):
    noise = {"joint*": 0.01, "handle_*": 0.004}
    robot = LoggedSystem(with_effects(DRAWER, [LOAD]), tmp_path, noise=noise)
    hidden, without = HiddenSystem(with_effects(DRAWER, [LOAD]), {}, noise), HiddenSystem(DRAWER, {}, noise)
    rolled, same, other = (system.rollout(Reach(), 2, np.random.default_rng(1)) for system in (robot, hidden, without))
    assert robot.identity() == hidden.identity()
    assert robot.evaluate(Reach(), 3, np.random.default_rng(1)) == 0.0
    assert sorted(tmp_path.iterdir()) == sorted(map(robot.log, rolled))
    for real, as_hidden, as_other in zip(rolled, same, other, strict=True):
        np.testing.assert_array_equal(real.observations, as_hidden.observations)
        assert np.abs(real.observations - as_other.observations).max() > 0.01
        log = load_recording(robot.log(real))
        assert log.period == pytest.approx(0.012)
        for channel, column, std in ((1, "qpos/joint2", 0.01), (8, "site/handle/y", 0.004)):
            apart = log[column][::5] - real.observations[:, channel]  # two sensors' noise
            assert 0.6 * std < apart.std() / np.sqrt(2) < 1.4 * std


def test_a_log_holds_what_a_robot_knows_of_itself_and_what_its_policy_sees(tmp_path):
    for env_id, actions, (*fingers, site) in (
        (DRAWER, 8, ("finger_left", "finger_right", "handle")),
        ("SimOpt/SwingPeg-v0", 7, ("peg",)),
    ):
        robot = LoggedSystem(env_id, tmp_path)
        (rolled,) = robot.rollout(Reach(actions), 1, np.random.default_rng(2))
        log = load_recording(robot.log(rolled))
        joints = [*(f"joint{i}" for i in range(1, 8)), *fingers]
        assert set(log.signals) == {*(f"qpos/{name}" for name in joints), *(f"site/{site}/{axis}" for axis in "xyz")}
        apart = log["qpos/joint3"][::5] - rolled.observations[:, 2]  # of a target without noise
        assert 0.6e-3 < apart.std() < 1.4e-3


def test_an_environment_of_others_has_no_log(tmp_path):
    with pytest.raises(ValueError, match="Toy/Reach-v0 is no environment of this package"):
        LoggedSystem("Toy/Reach-v0", tmp_path)


@pytest.mark.parametrize(("env_id", "kept"), [(DRAWER, "cabinet_x"), ("SimOpt/SwingPeg-v0", "joint_gain_1")])
def test_an_environments_model_and_the_plain_parameters_that_its_logs_tell_of(env_id, kept):
    spec, plain = environment(env_id)
    assert spec.compile().nu >= 7
    assert kept in plain.space
    assert not [name for name in plain.space.names if name.startswith("action_scaling")]


@needs_batch
@needs_effects
def test_a_gap_search_takes_an_environment_by_its_id(tmp_path):
    robot = LoggedSystem(DRAWER, tmp_path)
    logs = [robot.log(rolled) for rolled in robot.rollout(Reach(), 2, np.random.default_rng(1))]
    found, (_, plain) = find.read(DRAWER, logs), environment(DRAWER)
    assert {*plain.space.names} <= {*found.plain.prior.space.names}
    assert found.keyframe == "home"


def test_an_environment_without_a_task_is_told():
    with pytest.raises(ValueError, match=r"CartPole-v1 has no task with a model to repair"):
        environment("CartPole-v1")
