"""robosuite's Door and Lift as Gymnasium environments."""

import sys
from importlib.util import find_spec

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv

import simopt_envs  # noqa: F401 - registers the environments
from wrappers import RandomizablePhysics

IDS = ["SimOpt/RobosuiteDoor-v0", "SimOpt/RobosuiteLift-v0"]
needs_robosuite = pytest.mark.skipif(not find_spec("robosuite"), reason="robosuite is in the robotics environment")
each_task = pytest.mark.parametrize("env_id", IDS)


def test_without_robosuite_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "robosuite", None)
    with pytest.raises(ImportError, match=r'RobosuiteLift-v0 needs robosuite: pip install "simopt-envs\[robotics\]"'):
        gym.make("SimOpt/RobosuiteLift-v0")


@pytest.fixture(scope="module")
def envs():
    made = {env_id: gym.make(env_id) for env_id in IDS}
    yield made
    for env in made.values():
        env.close()


def motion(env, seed, steps=6):
    observations = [env.reset(seed=seed)[0]]
    env.action_space.seed(0)
    observations += [env.step(env.action_space.sample())[0] for _ in range(steps)]
    return np.array(observations)


@needs_robosuite
@each_task
@pytest.mark.filterwarnings("ignore:.*infinity:UserWarning")
def test_gymnasium_finds_no_fault(envs, env_id):
    check_env(envs[env_id].unwrapped, skip_render_check=True)


@needs_robosuite
@each_task
def test_a_seed_gives_the_same_episode_whatever_came_before(envs, env_id):
    env, other = envs[env_id], gym.make(env_id)
    first = motion(env, 3)
    motion(env, 4)
    env.reset()
    np.testing.assert_array_equal(motion(env, 3), first)
    np.testing.assert_array_equal(motion(other, 3), first)
    assert np.abs(motion(env, 4)[0] - first[0]).max() > 1e-3
    following = env.reset()[0]
    motion(other, 4)
    np.testing.assert_array_equal(other.reset()[0], following)
    other.close()


@needs_robosuite
@each_task
def test_observations_are_what_the_space_says_and_show_the_present(envs, env_id):
    env = envs[env_id]
    observation, _ = env.reset(seed=0)
    assert observation.dtype == env.observation_space.dtype == np.float64
    assert env.action_space.shape == (7,)
    for _ in range(3):
        observation, reward, *_ = env.step(env.action_space.sample())
        np.testing.assert_array_equal(observation[:7], env.unwrapped.data.qpos[:7])
        np.testing.assert_array_equal(observation[7:14], env.unwrapped.data.qvel[:7])
        assert isinstance(reward, float)


@needs_robosuite
@each_task
def test_episodes_end_at_the_horizon_and_tell_of_success(envs, env_id):
    env = gym.make(env_id, max_episode_steps=4)
    assert envs[env_id].spec.max_episode_steps == 500
    env.reset(seed=0)
    ends = [env.step(np.zeros(7, np.float32))[2:] for _ in range(4)]
    assert [truncated for _, truncated, _ in ends] == [False, False, False, True]
    assert not any(terminated or info["is_success"] for terminated, _, info in ends)
    env.close()


@needs_robosuite
def test_success_is_an_open_door(envs):
    env = envs["SimOpt/RobosuiteDoor-v0"]
    env.reset(seed=0)
    qpos, qvel = env.unwrapped.data.qpos.copy(), env.unwrapped.data.qvel.copy()
    qpos[env.unwrapped.model.joint("Door_hinge").qposadr] = 0.35
    env.unwrapped.set_state(qpos, qvel)
    assert env.step(np.zeros(7, np.float32))[-1]["is_success"]


@needs_robosuite
@each_task
def test_a_reset_keeps_the_model(envs, env_id):
    model = envs[env_id].unwrapped.model
    envs[env_id].reset(seed=0)
    assert envs[env_id].unwrapped.model is model
    assert envs[env_id].unwrapped._robosuite.sim.model._model is model


@needs_robosuite
@pytest.mark.parametrize(
    ("env_id", "name"),
    [
        ("SimOpt/RobosuiteDoor-v0", "dof_damping of Door_hinge"),
        ("SimOpt/RobosuiteDoor-v0", "dof_frictionloss of robot0_joint2"),
        ("SimOpt/RobosuiteLift-v0", "body_mass of cube_main"),
        ("SimOpt/RobosuiteLift-v0", "geom_friction of cube_g0"),
        ("SimOpt/RobosuiteLift-v0", "body_mass of robot0_link5"),
    ],
)
def test_its_physics_can_be_randomized(envs, env_id, name):
    env = RandomizablePhysics(envs[env_id], [name])
    value = 3 * env.parameters.nominal[0]
    plain = motion(env, 5)
    _, info = env.reset(seed=5, options={"parameters": {name: value}})
    assert info["parameters"] == {name: value}
    quantity, _, owner = name.partition(" of ")
    kind = {"dof": "joint", "body": "body", "geom": "geom"}[quantity.split("_")[0]]
    written = getattr(getattr(env.unwrapped.model, kind)(owner), quantity.split("_")[1])
    assert np.ravel(written)[0] == pytest.approx(value)
    np.testing.assert_array_equal(motion(env, 5), plain)  # and back


@needs_robosuite
def test_it_runs_in_gymnasiums_async_vector_environment(envs):
    env = AsyncVectorEnv([lambda: gym.make("SimOpt/RobosuiteLift-v0")])
    observation, _ = env.reset(seed=3)
    np.testing.assert_array_equal(observation[0], envs["SimOpt/RobosuiteLift-v0"].reset(seed=3)[0])
    env.close()
