"""The single and the vector environment over one task: same trajectories, autoreset, ξ per world, divergence."""

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest
from conftest import needs_batch, needs_effects
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from toy_task import ToyTask

import simopt_envs  # noqa: F401 - registers the environments
from simopt_envs.tasks.env import TaskEnv

pytestmark = needs_batch
for_both_tasks = pytest.mark.parametrize("env_id", ["SimOpt/Drawer-v0", "SimOpt/SwingPeg-v0"])


def vector_env(num_envs, **kwargs):
    from simopt_envs.tasks.vector_env import TaskVectorEnv

    return TaskVectorEnv(ToyTask(), num_envs, **{"max_episode_steps": 10, **kwargs})


def actions(num_envs, steps, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (steps, num_envs, 1))


def rollout(env, acts, **reset):
    observation, _ = env.reset(**reset)
    observations = [observation]
    for a in acts:
        observations.append(env.step(a)[0])
    return np.array(observations)


def test_single_env_passes_gymnasiums_check(recwarn):
    check_env(TaskEnv(ToyTask()), skip_render_check=True)
    assert [str(w.message) for w in recwarn] == []


def test_single_equals_batched_for_each_world():
    acts = actions(4, 9)
    xi = np.random.default_rng(3).uniform(*np.log([[0.5, 0.5], [5.0, 5.0]]), (4, 2))
    xi = np.exp(xi)
    many = rollout(vector_env(4), acts, seed=5, options={"parameters": xi})
    for world in range(4):
        options = {"parameters": dict(zip(("damping", "mass"), xi[world], strict=True))}
        one = rollout(TaskEnv(ToyTask()), acts[:, world], seed=5 + world, options=options)
        np.testing.assert_allclose(many[:, world], one, atol=1e-9)


@pytest.mark.parametrize("num_threads", [1, 2])
@pytest.mark.parametrize("num_envs", [16, 256])
def test_a_world_does_not_depend_on_the_others(num_envs, num_threads):
    acts = actions(num_envs, 25, seed=1)
    alone = rollout(vector_env(1, num_threads=1), acts[:, :1], seed=7)
    among = rollout(vector_env(num_envs, num_threads=num_threads), acts, seed=7)
    np.testing.assert_array_equal(among[:, :1], alone)


def test_delayed_servo_starts_from_its_first_command():
    """With its command buffer at zero the servo would pull towards 0 for the first 30 ms."""
    env = vector_env(3)
    observation, _ = env.reset(seed=0)
    first, *_ = env.step(np.zeros((3, 1)))
    np.testing.assert_allclose(first, observation, atol=1e-12)


def test_parameters_are_in_force_for_one_episode_and_reported():
    env = vector_env(2)
    _, info = env.reset(seed=0, options={"parameters": {"mass": [2.0, 3.0]}})
    np.testing.assert_array_equal(info["parameters"], [[2.0, 2.0], [2.0, 3.0]])
    np.testing.assert_array_equal(env.simulation.model_field("body_mass")[:, 1], [2.0, 3.0])
    _, info = env.reset()
    np.testing.assert_array_equal(info["parameters"], [[2.0, 1.0], [2.0, 1.0]])
    np.testing.assert_array_equal(env.simulation.model_field("body_mass")[:, 1], [1.0, 1.0])


def test_parameters_none_leaves_xi_to_the_source():
    env = vector_env(2)
    env.parameter_source = lambda worlds: np.tile([4.0, 2.0], (len(worlds), 1))
    _, info = env.reset(seed=0, options={"parameters": None})
    np.testing.assert_array_equal(info["parameters"], [[4.0, 2.0]] * 2)


@pytest.mark.parametrize("env", [lambda: vector_env(2), lambda: TaskEnv(ToyTask())])
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"parameters": {"weight": 1.0}}, "unknown parameter 'weight'"),
        ({"parameters": {"mass": np.inf}}, "'mass'.* is not finite"),
        ({"parameters": {"mass": 11.0}}, "'mass'.* is out of bounds"),
        ({"parameter": {}}, "unknown reset option 'parameter'; did you mean 'parameters'"),
        ({"initial_observation": np.zeros(7)}, "initial_observation"),
    ],
)
def test_bad_options_are_refused_before_anything_changes(env, options, message):
    env = env()
    env.reset(seed=0)
    before = env.simulation.data("qpos").copy()
    with pytest.raises(ValueError, match=message):
        env.reset(options=options)
    np.testing.assert_array_equal(env.simulation.data("qpos"), before)


@pytest.mark.parametrize(
    ("env", "action", "message"),
    [
        (lambda: TaskEnv(ToyTask()), [np.nan], "action is not finite: .*nan"),
        (lambda: TaskEnv(ToyTask()), [np.inf], "action is not finite: .*inf"),
        (lambda: vector_env(3), [[0.0], [np.nan], [0.0]], "action of world 1 is not finite: .*nan"),
    ],
)
def test_actions_that_are_not_finite_are_refused(env, action, message):
    env = env()
    before, _ = env.reset(seed=0)
    with pytest.raises(ValueError, match=message):
        env.step(np.array(action))
    np.testing.assert_array_equal(env.simulation.data("qpos").reshape(before.shape), before)


@pytest.mark.parametrize(("given", "horizon"), [(7, 7), (None, 50), (-1, None)])
def test_horizons_are_given_as_gymnasium_has_them(given, horizon):
    env = vector_env(2, max_episode_steps=given, render_mode=None)
    env.reset(seed=0)
    ends = [step for step in range(1, 61) if env.step(np.zeros((2, 1)))[3].all()]
    assert ends[:1] == ([] if horizon is None else [horizon])


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"max_episode_steps": 0}, "max_episode_steps must be at least 1, or -1 for no limit, got 0"),
        ({"render_mode": "rgb_array"}, "does not render.*'rgb_array'.*vectorization_mode"),
    ],
)
def test_keywords_that_it_cannot_take_are_refused(keywords, message):
    with pytest.raises(ValueError, match=message):
        vector_env(2, **keywords)


def test_initial_observation_sets_the_start():
    env = vector_env(2)
    observation, _ = env.reset(seed=0, options={"initial_observation": [[0.1], [0.2]]})
    np.testing.assert_allclose(observation, [[0.1], [0.2]])


def test_next_step_autoreset_spends_a_step_on_the_reset():
    env = vector_env(2, autoreset_mode=AutoresetMode.NEXT_STEP)
    env.parameter_source = lambda worlds: np.tile([4.0, 2.0], (len(worlds), 1))
    env.reset(seed=0)
    for _ in range(10):
        final, _, _, truncated, _ = env.step(np.ones((2, 1)))
    assert truncated.all()
    first, reward, _, truncated, info = env.step(np.ones((2, 1)))
    assert not truncated.any()
    assert not np.allclose(first, final)
    np.testing.assert_array_equal(reward, 0.0)
    np.testing.assert_array_equal(info["parameters"], [[4.0, 2.0]] * 2)
    for _ in range(9):
        assert not env.step(np.ones((2, 1)))[3].any()
    assert env.step(np.ones((2, 1)))[3].all()


def test_same_step_autoreset_keeps_the_final_observation():
    env = vector_env(2, autoreset_mode="SameStep")
    reference = vector_env(2, autoreset_mode="Disabled")
    env.reset(seed=0)
    reference.reset(seed=0)
    for _ in range(10):
        observation, _, _, truncated, info = env.step(np.ones((2, 1)))
        final, *_ = reference.step(np.ones((2, 1)))
    assert truncated.all()
    np.testing.assert_array_equal(np.stack(list(info["final_obs"])), final)
    assert info["_final_obs"].all()
    assert set(info["final_info"]) >= {"is_success", "_is_success"}
    assert not np.allclose(observation, final)


def test_disabled_autoreset_waits_for_a_masked_reset():
    env = vector_env(2, autoreset_mode="Disabled")
    env.reset(seed=0)
    for _ in range(10):
        env.step(np.ones((2, 1)))
    with pytest.raises(RuntimeError, match=r"\[0, 1\] are done"):
        env.step(np.ones((2, 1)))
    env.reset(options={"reset_mask": np.array([True, True])})
    env.step(np.ones((2, 1)))


def test_masked_reset_leaves_the_others_alone():
    env = vector_env(3)
    env.reset(seed=0)
    before, *_ = env.step(np.ones((3, 1)))
    after, _ = env.reset(options={"reset_mask": np.array([False, True, False])})
    np.testing.assert_array_equal(after[[0, 2]], before[[0, 2]])
    assert after[1] != before[1]


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_a_diverged_world_is_reset_counted_and_alone(mode):
    env, reference = vector_env(3, autoreset_mode=mode), vector_env(3, autoreset_mode=mode)
    for repetition in range(2):  # the second time, the world's counters are not zero any more
        env.reset(seed=0)
        reference.reset(seed=0)
        env.step(np.ones((3, 1)))
        reference.step(np.ones((3, 1)))
        env.simulation.data("qvel")[1] = np.nan
        observation, reward, _, truncated, info = env.step(np.ones((3, 1)))
        others, other_reward, *_ = reference.step(np.ones((3, 1)))
        np.testing.assert_array_equal(truncated, [False, True, False])
        np.testing.assert_array_equal(info["diverged"], [False, True, False])
        assert env.diverged_count == repetition + 1
        assert np.isfinite(observation).all()
        assert reward[1] == 0.0
        np.testing.assert_array_equal(observation[[0, 2]], others[[0, 2]])
        np.testing.assert_array_equal(reward[[0, 2]], other_reward[[0, 2]])
        for _ in range(5):
            observation, *_, info = env.step(np.ones((3, 1)))
            assert np.isfinite(observation).all()
            assert not info["diverged"].any()


def test_a_world_diverges_alike_in_the_single_and_the_vector_env():
    single, vector = TaskEnv(ToyTask()), vector_env(1)
    single.reset(seed=0)
    vector.reset(seed=0)
    last, *_ = single.step(np.ones(1))
    vector.step(np.ones((1, 1)))
    single.data.qvel[0] = vector.simulation.data("qvel")[0] = np.nan
    observation, reward, terminated, truncated, info = single.step(np.ones(1))
    np.testing.assert_array_equal(observation, last)
    assert (reward, terminated, truncated) == (0.0, False, True)
    assert info == {"is_success": False, "diverged": True, "reward_terms": {"distance": 0.0}}
    *expected, infos = vector.step(np.ones((1, 1)))
    for ours, theirs in zip((observation, reward, terminated, truncated), expected, strict=True):
        np.testing.assert_allclose(ours, theirs[0], atol=1e-9)
    assert not infos["is_success"][0]
    assert infos["diverged"][0]


@for_both_tasks
def test_frames_are_collected_and_an_unknown_render_mode_is_refused(env_id):
    assert gym.make(env_id, render_mode="rgb_array_list").render_mode == "rgb_array_list"
    with (
        pytest.warns(UserWarning, match="not in the possible render_modes"),
        pytest.raises(ValueError, match=r"unknown render mode 'rgb'.*human, rgb_array"),
    ):
        gym.make(env_id, render_mode="rgb")


@needs_effects
@for_both_tasks
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_is_a_new_environment_of_the_same_task(env_id, copied):
    payload = {"effect": "payload", "where": "body:link5", "parameters": {"mass": 1.0}}
    env = gym.make(env_id, effects=[payload], render_mode="rgb_array").unwrapped
    twin = copied(env)
    assert twin.parameters == env.parameters
    assert twin.render_mode == "rgb_array"
    acts = np.random.default_rng(0).uniform(-1, 1, (3, *env.action_space.shape))
    np.testing.assert_array_equal(rollout(twin, acts, seed=2), rollout(env, acts, seed=2))


@for_both_tasks
def test_latency_acts_up_to_its_bound(env_id):
    env = gym.make_vec(env_id, num_envs=3)
    env.reset(seed=[0] * 3, options={"parameters": {"latency": [0.032, 0.036, 0.04]}})
    observation, *_ = env.step(np.ones(env.action_space.shape))
    assert np.all(np.diff(np.abs(observation[:, 0] - env.reset(seed=[0] * 3)[0][:, 0])) < -1e-6)
