"""Systems and simulators: what they hide, what they measure, and that all ways to run worlds agree."""

import numpy as np
import pytest
from toy_reach import GOAL, SPACE, STEPS, PushPolicy, ReachEnv, parameter_array

from simopt_envs.adaptation import EnvSimulator, HiddenSystem, RecordedSystem
from simopt_envs.distributions import Gaussian
from simopt_envs.measured.trajectory import Trajectory

FORCE = SPACE.subset(["force"])


class Recorder(PushPolicy):
    """Remembers what it was shown."""

    def __init__(self):
        super().__init__(lean=-0.5)
        self.seen = []

    def act(self, observations):
        self.seen.append(observations.copy())
        return super().act(observations)


def test_hidden_parameters_act_and_do_not_show():
    system = HiddenSystem("Toy/Reach-v0", {"force": 0.512345})
    trajectories = system.rollout(PushPolicy(lean=-0.512345), 2, np.random.default_rng(0))
    assert abs(trajectories[0].observations[-1, 0] - GOAL) < 0.05
    assert [t.success for t in trajectories] == [True, True]
    assert len(trajectories[0]) == STEPS
    assert system.evaluate(PushPolicy(lean=-0.512345), 150, np.random.default_rng(0)) == 1.0
    assert system.evaluate(PushPolicy(lean=0.0), 150, np.random.default_rng(0)) == 0.0
    assert "0.512" not in repr(system) + str(vars(system)) + str(system.identity())
    assert system.identity() != HiddenSystem("Toy/Reach-v0", {"force": 0.5}).identity()


def test_noise_and_dropout():
    noise, policy = {"position": 0.01, "vel*": 0.0}, Recorder()
    system = HiddenSystem(ReachEnv, {}, noise=noise, dropout={"velocity": 0.25})
    [trajectory] = system.rollout(policy, 1, np.random.default_rng(0))
    [exact] = HiddenSystem(ReachEnv, {}).rollout(policy, 1, np.random.default_rng(0))
    assert trajectory.observations.shape == exact.observations.shape
    lost = np.isnan(trajectory.observations)
    assert not lost[:, 0].any()
    assert not lost[0].any()
    assert 0.1 < lost[:, 1].mean() < 0.45
    seen = np.concatenate(policy.seen[:STEPS])
    kept = ~lost[:-1, 1]
    np.testing.assert_array_equal(seen[kept], trajectory.observations[:-1][kept])
    after = np.flatnonzero(lost[:-1, 1])
    np.testing.assert_array_equal(seen[after, 1], seen[after - 1, 1])  # the policy goes on with the last value


def test_channels_of_equal_probability_drop_out_together():
    [trajectory] = HiddenSystem(ReachEnv, {}, dropout=0.3).rollout(PushPolicy(), 1, np.random.default_rng(0))
    lost = np.isnan(trajectory.observations)
    assert lost.any()
    np.testing.assert_array_equal(lost[:, 0], lost[:, 1])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"parameters": {"forse": 0.1}}, "did you mean 'force'"),
        ({"parameters": {"force": 99.0}}, "out of bounds"),
        ({"parameters": {}, "noise": {"handle": 0.1}}, "unknown observed channel in noise 'handle'"),
        ({"parameters": {}, "noise": [0.1]}, "one per observed channel, 2"),
        ({"parameters": {}, "noise": -0.1}, "noise must be finite and >= 0"),
        ({"parameters": {}, "dropout": 1.0}, "below 1"),
    ],
)
def test_bad_hidden_systems(arguments, message):
    with pytest.raises(ValueError, match=message):
        HiddenSystem("Toy/Reach-v0", **arguments)


def test_an_environment_without_parameters():
    with pytest.raises(ValueError, match="no attribute 'parameters'"):
        EnvSimulator("Pendulum-v1")
    with pytest.raises(ValueError, match="no vector environment of its own"):
        EnvSimulator(ReachEnv, "native")


@pytest.mark.parametrize(("mode", "num_envs"), [("native", 256), ("native", 4), ("sync", 5), ("async", 3)])
def test_rollouts_repeat_the_measured_episodes(mode, num_envs):
    """At the true ξ each simulated rollout is the measured one; all ways to run the worlds agree."""
    policy = PushPolicy(lean=-0.2)
    real = HiddenSystem("Toy/Reach-v0", {"force": 0.6}).rollout(policy, 3, np.random.default_rng(0))
    simulator = EnvSimulator("Toy/Reach-v0", mode, num_envs)
    rollouts = simulator.rollout(policy, FORCE, np.array([[0.6], [0.1]]), real, seed=0)
    simulator.close()
    assert rollouts.observations.shape == (2, 3, STEPS + 1, 2)
    assert not rollouts.diverged.any()
    for j, trajectory in enumerate(real):
        np.testing.assert_allclose(rollouts.observations[0, j], trajectory.observations, atol=1e-12)
        np.testing.assert_allclose(rollouts.actions[0, j], trajectory.actions, atol=1e-12)
        assert np.abs(rollouts.observations[1, j] - trajectory.observations).max() > 0.05


def test_training_worlds_draw_the_same_parameters_however_they_run():
    distribution = Gaussian.around_nominal(SPACE.subset(["force", "gain"]), std=[0.5, 0.2])
    drawn = {}
    for mode in ("native", "sync", "async"):
        env = EnvSimulator("Toy/Reach-v0", mode).make_vector_env(3, distribution, seed=7)
        _, info = env.reset(seed=0)
        first = parameter_array(info)
        for _ in range(STEPS):
            _, _, _, truncated, info = env.step(np.zeros((3, 1)))
        assert truncated.all()
        drawn[mode] = [first, parameter_array(info)]
        env.close()
    np.testing.assert_allclose(drawn["sync"], drawn["native"])
    np.testing.assert_allclose(drawn["async"], drawn["native"])
    begun, after_reset = drawn["native"]
    assert len(np.unique([begun[:, 1], after_reset[:, 1]])) == 6
    np.testing.assert_array_equal(begun[:, 2], 1.0)  # the drag, which p(ξ) does not speak of


def test_recorded_system():
    trajectories = [Trajectory(np.full((4, 2), float(i)), np.zeros((3, 1))) for i in range(5)]
    system = RecordedSystem(trajectories)
    assert len(system.rollout(None, 9, np.random.default_rng(0))) == 5
    chosen = {t.observations[0, 0] for t in system.rollout(None, 3, np.random.default_rng(0))}
    assert len(chosen) == 3
    assert system.identity() != RecordedSystem(trajectories[:4]).identity()
    with pytest.raises(ValueError, match="at least one"):
        RecordedSystem([])
    with pytest.raises(ValueError, match="differ"):
        RecordedSystem([trajectories[0], Trajectory(np.zeros((4, 3)), np.zeros((3, 1)))])
