"""Episodes that begin where a measured one did."""

from importlib.util import find_spec

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import NormalizeObservation

from wrappers import AdaptableEnv, RandomizablePhysics, StartFromObservation

IDS = ["InvertedPendulum-v5", "Hopper-v5", "HalfCheetah-v5", "Pusher-v5"]
ROBOTICS = ["gymnasium_robotics:FetchPush-v4", "gymnasium_robotics:FetchSlide-v4"]
ROBOSUITE = ["SimOpt/RobosuiteDoor-v0", "SimOpt/RobosuiteLift-v0"]


def make(env_id):
    library = "gymnasium_robotics" if env_id in ROBOTICS else "robosuite" if env_id in ROBOSUITE else "gymnasium"
    if find_spec(library) is None:
        pytest.skip(f"{library} is in the robotics environment")
    return AdaptableEnv(env_id, ["body_mass of *"])()


def motion(env, observation, steps=8):
    env.action_space.seed(0)
    return np.array([observation, *(env.step(env.action_space.sample())[0] for _ in range(steps))])


@pytest.mark.parametrize("env_id", [*IDS, *ROBOTICS, *ROBOSUITE])
def test_repeats_an_episode_from_its_first_observation(env_id):
    env = make(env_id)
    episode = motion(env, env.reset(seed=7)[0])
    other = motion(env, env.reset(seed=2)[0])
    again = motion(env, env.reset(seed=2, options={"initial_observation": episode[0]})[0])
    np.testing.assert_allclose(again, episode, atol=1e-8)
    assert np.abs(other - episode).max() > 1e-3
    np.testing.assert_allclose(motion(env, env.reset(seed=2)[0]), other, atol=1e-12)  # nothing is left of it
    env.close()


@pytest.mark.parametrize("env_id", [*IDS, *ROBOTICS, *ROBOSUITE])
def test_measurement_noise_finds_a_start_nearby(env_id):
    env = make(env_id)
    rng = np.random.default_rng(0)
    for seed in range(5):
        exact = env.reset(seed=seed)[0]
        noisy = exact + 1e-3 * rng.standard_normal(exact.shape)
        episode = motion(env, env.reset(seed=99, options={"initial_observation": noisy})[0], 3)
        assert np.linalg.norm(episode[0] - exact) < 1.01 * np.linalg.norm(noisy - exact)
        assert not any(warning.number for warning in env.unwrapped.data.warning)  # such as a world that diverged
    env.close()


def test_what_is_not_observed_stays_as_drawn():
    env = make("Hopper-v5")
    env.reset(seed=7)
    observation = env.reset(seed=2)[0]
    drawn = env.unwrapped.data.qpos.copy()
    env.reset(seed=2, options={"initial_observation": observation + 1e-3})
    assert env.unwrapped.data.qpos[0] == pytest.approx(drawn[0], abs=1e-12)
    np.testing.assert_allclose(env.unwrapped.data.qpos[1:], drawn[1:] + 1e-3, atol=1e-12)


def test_it_sees_through_wrappers_that_transform():
    plain = gym.make("Hopper-v5")
    scaled = gym.wrappers.TransformObservation(plain, lambda x: 3 * x, plain.observation_space)
    env = StartFromObservation(scaled)
    target = env.reset(seed=7)[0]
    np.testing.assert_allclose(env.reset(options={"initial_observation": target})[0], target, atol=1e-12)


def test_it_goes_with_parameters():
    env = make("Hopper-v5")
    target = env.reset(seed=7)[0]
    options = {"parameters": {"body_mass of torso": 6.0}, "initial_observation": target}
    observation, info = env.reset(seed=1, options=options)
    np.testing.assert_allclose(observation, target, atol=1e-12)
    assert info["parameters"]["body_mass of torso"] == 6.0


def test_the_environments_own_stream_is_untouched():
    env, plain = StartFromObservation(gym.make("Hopper-v5")), gym.make("Hopper-v5")
    np.testing.assert_array_equal(env.reset(seed=5)[0], plain.reset(seed=5)[0])
    np.testing.assert_array_equal(env.reset()[0], plain.reset()[0])
    unseeded = [StartFromObservation(gym.make("Hopper-v5")).reset()[0] for _ in range(2)]
    assert not np.array_equal(*unseeded)


@pytest.mark.parametrize("wrong", [[0.0, 0.0], [np.nan] * 11])
def test_wrong_observations_are_refused(wrong):
    with pytest.raises(ValueError, match=r"finite and of shape \(11,\)"):
        make("Hopper-v5").reset(options={"initial_observation": wrong})


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (lambda: gym.make("CartPole-v1"), "MuJoCo 'model'"),
        (lambda: NormalizeObservation(gym.make("Hopper-v5")), "not a function of its state"),
        (lambda: gym.wrappers.FrameStackObservation(gym.make("Hopper-v5"), 2), "one axis"),
    ],
)
def test_environments_it_cannot_start_are_refused(env, message):
    with pytest.raises(TypeError, match=message):
        StartFromObservation(env())


def test_an_adaptable_env_has_the_name_of_what_it_makes():
    assert AdaptableEnv("Hopper-v5", ["gravity"]).__name__ == "Hopper-v5"
    assert AdaptableEnv(pendulum, ["gravity"]).__name__ == "pendulum"
    env = AdaptableEnv(pendulum, ["gravity"])()
    assert isinstance(env, StartFromObservation)
    assert isinstance(env.env, RandomizablePhysics)


def pendulum():
    return gym.make("InvertedPendulum-v5")
