"""From SimOpt's rollouts on a hidden system to what the gap workflow reads: logs, the model, plain parameters."""

import numpy as np
import pytest
from conftest import needs_batch

from baselines.commands.gap import environment
from baselines.logged_system import LoggedSystem
from simopt_envs.adaptation import HiddenSystem
from simopt_envs.measured import load_recording
from simopt_envs.tasks.effects import with_effects

DRAWER = "SimOpt/Drawer-v0"
COLUMNS = ("qpos/joint*", "qpos/finger_*", "site/handle/*")
LOAD = {"effect": "payload", "where": "body:link7", "parameters": {"mass": 2.5}}


class Reach:
    """Moves as fast as what it sees of the second joint tells."""

    def act(self, observations):
        return np.tile(0.5 + observations[:, 1:2], (1, 8)).clip(-1, 1)


@needs_batch
def test_rollouts_are_those_of_the_hidden_system_and_their_logs_show_them(tmp_path):
    robot = LoggedSystem(with_effects(DRAWER, [LOAD]), tmp_path, COLUMNS, {}, per_step=5)
    rolled = robot.rollout(Reach(), 2, np.random.default_rng(1))
    hidden = HiddenSystem(with_effects(DRAWER, [LOAD]), {}).rollout(Reach(), 2, np.random.default_rng(1))
    without = HiddenSystem(DRAWER, {}).rollout(Reach(), 2, np.random.default_rng(1))
    assert robot.evaluate(Reach(), 3, np.random.default_rng(1)) == 0.0
    logs = [load_recording(path) for path in robot.logs()]
    assert len(logs) == 2
    for real, same, other, log in zip(rolled, hidden, without, logs, strict=True):
        np.testing.assert_allclose(real.observations, same.observations, atol=1e-9)
        assert np.abs(real.observations - other.observations).max() > 0.01
        for channel, column in ((1, "qpos/joint2"), (8, "site/handle/y")):
            np.testing.assert_allclose(log[column][::5], real.observations[:, channel], atol=1e-9)
        assert "qpos/drawer" not in log.columns
        assert log.period == pytest.approx(0.012)


@pytest.mark.parametrize(("env_id", "kept"), [(DRAWER, "cabinet_x"), ("SimOpt/SwingPeg-v0", "joint_gain_1")])
def test_an_environments_model_and_the_plain_parameters_that_its_logs_tell_of(env_id, kept):
    spec, plain = environment(env_id)
    assert spec.compile().nu >= 7
    assert kept in plain.space
    assert not [name for name in plain.space.names if name.startswith("action_scaling")]


def test_an_environment_without_a_task_is_told():
    with pytest.raises(ValueError, match=r"CartPole-v1 has no task with a model to repair"):
        environment("CartPole-v1")
