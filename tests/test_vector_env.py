"""The single and the vector environment over one task: same trajectories, autoreset, ξ per world, divergence."""

import numpy as np
import pytest
from conftest import needs_batch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from toy_task import ToyTask

from simopt_envs.tasks.env import TaskEnv

pytestmark = needs_batch


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


def test_single_env_reports_divergence():
    env = TaskEnv(ToyTask())
    env.reset(seed=0)
    env.data.qvel[0] = np.nan
    *_, truncated, info = env.step(np.ones(1))
    assert truncated
    assert info["diverged"]
