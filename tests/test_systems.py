"""Systems and simulators: what they hide, what they measure, and that all ways to run worlds agree."""

import copy

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from toy_reach import GOAL, SPACE, STEPS, PushPolicy, ReachEnv, parameter_array

from simopt_envs.adaptation import EnvSimulator, HiddenSystem, RecordedSystem
from simopt_envs.distributions import Gaussian
from simopt_envs.engine import ThreadEngine
from simopt_envs.measured.trajectory import Trajectory
from simopt_envs.physics import ParameterSpace
from wrappers import RandomizablePhysics

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


def test_the_identity_tells_arguments_and_names_of_parameters_apart():
    stormy = copy.deepcopy(gym.spec("Toy/Reach-v0"))
    stormy.kwargs["disturbance"] = 4.0

    class Renamed(ReachEnv):
        parameters = ParameterSpace([SPACE["drag"], SPACE["force"], SPACE["gain"]])  # the same numbers

    Renamed.__name__ = "ReachEnv"
    for one, other in (("Toy/Reach-v0", stormy), (ReachEnv, Renamed)):
        assert HiddenSystem(one, {}).identity() != HiddenSystem(other, {}).identity()
    assert "4.0" not in str(HiddenSystem(stormy, {}).identity())


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


def test_channels_of_unequal_probability_drop_out_independently():
    system = HiddenSystem(ReachEnv, {}, dropout={"position": 0.2, "velocity": 0.4})
    lost = np.concatenate(
        [np.isnan(t.observations[1:]) for t in system.rollout(PushPolicy(), 50, np.random.default_rng(0))]
    )
    np.testing.assert_allclose(lost.mean(axis=0), [0.2, 0.4], atol=0.04)
    assert lost.all(axis=1).mean() == pytest.approx(0.2 * 0.4, abs=0.02)


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


@pytest.mark.parametrize(
    "space", [spaces.Dict({"state": ReachEnv.observation_space}), spaces.Box(-1.0, 1.0, ()), spaces.Discrete(3)]
)
def test_an_environment_whose_observation_is_no_vector(space):
    class Odd(ReachEnv):
        observation_space = space

    with pytest.raises(ValueError, match=r"a Box with one axis, not .* FlattenObservation, .* AdaptableEnv"):
        EnvSimulator(Odd)


class Forgetful(ReachEnv):
    """Begins where it likes."""

    def reset(self, *, seed=None, options=None):
        return super().reset(seed=seed, options={"parameters": (options or {}).get("parameters", {})})


def pendulum():
    return RandomizablePhysics(gym.make("InvertedPendulum-v5"), ["actuator_gain of slide"])


@pytest.mark.parametrize("make_env", [Forgetful, pendulum])
def test_an_environment_that_does_not_begin_where_it_is_told(make_env):
    simulator = EnvSimulator(make_env, "sync")
    channels = len(simulator.observation_names)
    real = [Trajectory(np.zeros((3, channels)), np.zeros((2, 1)))]
    with pytest.raises(ValueError, match=r"ignores options\['initial_observation'\].*AdaptableEnv"):
        simulator.rollout(None, simulator.parameters, simulator.parameters.nominal[None], real, 0)


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


class Crashing(ReachEnv):
    def step(self, action):
        if self.xi[0, 1] > 2.0:
            raise RuntimeError("crashed")
        return super().step(action)


@pytest.mark.filterwarnings("ignore::UserWarning")  # Gymnasium prints what its worker raised
@pytest.mark.parametrize("mode", ["sync", "async"])
def test_worlds_that_crashed_are_not_used_again(mode):
    policy, xi = PushPolicy(), np.array([[2.5], [0.1], [0.2], [0.3]])
    real = HiddenSystem(ReachEnv, {}).rollout(policy, 1, np.random.default_rng(0))
    simulator = EnvSimulator(Crashing, mode, num_envs=2)
    with pytest.warns(RuntimeWarning, match=r"counts as diverged: .*'force': 2\.5.*crashed"):
        rollouts = simulator.rollout(policy, FORCE, xi, real, 0)
    simulator.close()
    assert rollouts.diverged[:, 0].tolist() == [True, False, False, False]
    expected = EnvSimulator(ReachEnv).rollout(policy, FORCE, xi, real, 0)
    np.testing.assert_array_equal(rollouts.observations[1:], expected.observations[1:])


def test_threads_get_the_same_rollouts():
    policy, xi = PushPolicy(), np.linspace(-1.0, 1.0, 24)[:, None]
    real = HiddenSystem(ReachEnv, {}).rollout(policy, 1, np.random.default_rng(0))
    local, threads = (
        EnvSimulator(ReachEnv, num_envs=3, engine=engine).rollout(policy, FORCE, xi, real, 0)
        for engine in (None, ThreadEngine())
    )
    np.testing.assert_array_equal(threads.observations, local.observations)


class Steps(ReachEnv):
    """Pushes or pulls."""

    action_space = spaces.Discrete(2)

    def step(self, action):
        assert self.action_space.contains(action)
        return super().step(np.array([2.0 * action - 1.0]))


class Towards:
    """For either action space: one number per world, where that is discrete."""

    def __init__(self, discrete):
        self.discrete = discrete

    def act(self, observations):
        pushes = observations[:, 0] < GOAL
        return pushes.astype(int) if self.discrete else 2.0 * pushes[:, None] - 1.0


@pytest.mark.parametrize(("make_env", "discrete"), [("Toy/Reach-v0", False), (ReachEnv, False), (Steps, True)])
def test_without_a_policy_the_recorded_actions_are_replayed(make_env, discrete):
    real = HiddenSystem(make_env, {"force": 0.4}).rollout(Towards(discrete), 2, np.random.default_rng(0))
    assert real[0].actions.shape == (STEPS, 1)
    real[1] = Trajectory(real[1].observations[:8], real[1].actions[:7])  # the recorder was stopped
    simulator = EnvSimulator(make_env, num_envs=3)
    rollouts = simulator.rollout(None, FORCE, np.array([[0.4], [-0.4]]), real, 0)
    assert rollouts.lengths.tolist() == [[STEPS, 7]] * 2
    for j, trajectory in enumerate(real):
        steps = len(trajectory)
        np.testing.assert_allclose(rollouts.observations[0, j, : steps + 1], trajectory.observations, atol=1e-12)
        for i in range(2):
            np.testing.assert_array_equal(rollouts.actions[i, j, :steps], trajectory.actions)
    assert np.abs(rollouts.observations[1, 0] - real[0].observations).max() > 0.1
    wide = [Trajectory(real[0].observations, np.zeros((STEPS, 2)))]
    with pytest.raises(ValueError, match="the recordings have 2 actions, but the environment takes"):
        simulator.rollout(None, FORCE, np.array([[0.4]]), wide, 0)


def test_a_policy_of_too_few_actions():
    class One:
        def act(self, observations):
            return np.zeros((1, 1))

    with pytest.raises(ValueError, match=r"one action for each of 3 observations, got shape \(1, 1\)"):
        HiddenSystem("Toy/Reach-v0", {}).rollout(One(), 3, np.random.default_rng(0))


class Quitter(ReachEnv):
    """Ends as soon as the mass is at the goal, if a force helps; succeeds until then."""

    def step(self, action):
        observation, reward, _, truncated, _ = super().step(action)
        terminated = bool(observation[0] > GOAL and self.xi[0, 1] > 0.0)
        return observation, reward, terminated, truncated, {"is_success": not terminated}


def test_the_success_of_simulations_that_were_cut_off_is_unknown():
    policy = PushPolicy()
    [whole] = HiddenSystem(ReachEnv, {}).rollout(policy, 1, np.random.default_rng(0))
    real = [Trajectory(whole.observations[:31], whole.actions[:30])]
    rollouts = EnvSimulator(Quitter).rollout(policy, FORCE, np.array([[0.0], [2.0]]), real, 0)
    np.testing.assert_array_equal(rollouts.success, [[np.nan], [0.0]])
    assert [rollouts.trajectory(i, 0).success for i in range(2)] == [None, False]
    assert rollouts.success_rate() == 0.0
    assert rollouts.map(lambda x: x[:1]).success_rate() is None
    full = EnvSimulator(Quitter).rollout(policy, FORCE, np.array([[0.0], [2.0]]), [whole], 0)
    assert full.success_rate() == 0.5


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
