import copy
import json
import random
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv, VectorWrapper
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from baselines.ppo_sb3 import SB3
from baselines.ppo_torch import one_torch_thread
from baselines.sb3_vec_env import SB3VecEnv, infos_by_world
from simopt_envs.adaptation.checkpoint import identity

MODES = [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED]


class Corridor(gym.Env):
    """A walk of random length that ends by termination or by truncation; every observation is unique."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self):
        self.gain = 1.0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.length, self.name = 0, self.np_random.integers(2, 9), self.np_random.random()
        self.name += (options or {}).get("offset", 0.0)
        return np.array([self.steps, self.name], np.float32), {"name": self.name}

    def step(self, action):
        self.steps += 1
        over, by_time = self.steps == self.length, self.name < 0.5
        observation = np.array([self.steps, self.name], np.float32)
        reward = self.gain * self.name + float(action[0])
        return (
            observation,
            reward,
            over and not by_time,
            over and by_time,
            {"is_success": over, "depth": {"n": self.steps}},
        )

    def scale(self, factor):
        self.gain *= factor
        return self.gain


def adapted(mode, num_envs=3, vector=SyncVectorEnv):
    return SB3VecEnv(vector([Corridor] * num_envs, autoreset_mode=mode))


def assert_same_infos(ours, theirs):
    assert ours.keys() == theirs.keys()
    for key, value in theirs.items():
        np.testing.assert_equal(ours[key], value)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("vector", [SyncVectorEnv, AsyncVectorEnv])
def test_shows_what_dummy_vec_env_shows(mode, vector):
    ours, theirs = adapted(mode, vector=vector), DummyVecEnv([Corridor] * 3)
    assert ours.seed(5) == theirs.seed(5)
    np.testing.assert_array_equal(ours.reset(), theirs.reset())
    rng, cuts = np.random.default_rng(0), []
    for _ in range(60):
        actions = rng.uniform(-1, 1, (3, 1)).astype(np.float32)
        (obs, rewards, dones, infos), expected = ours.step(actions), theirs.step(actions)
        for value, reference in zip((obs, rewards, dones), expected, strict=False):
            np.testing.assert_array_equal(value, reference)
            assert value.dtype == reference.dtype
        for world in range(3):
            assert_same_infos(infos[world], expected[3][world])
            assert ours.reset_infos[world] == theirs.reset_infos[world]
        cuts += [info["TimeLimit.truncated"] for info, done in zip(infos, dones, strict=True) if done]
    assert {True, False} == set(cuts)
    ours.close()


def trained(env):
    model = PPO("MlpPolicy", env, n_steps=40, batch_size=40, n_epochs=3, seed=11, device="cpu")
    with one_torch_thread():
        model.learn(3 * 40 * env.num_envs)
    return torch.cat([value.ravel() for value in model.policy.state_dict().values()]), model


@pytest.fixture(scope="module")
def weights_over_dummy_vec_env():
    return trained(DummyVecEnv([Corridor] * 3))[0]


@pytest.mark.parametrize("mode", MODES)
def test_ppo_of_sb3_ends_with_the_weights_it_has_over_dummy_vec_env(mode, weights_over_dummy_vec_env):
    weights, model = trained(VecMonitor(adapted(mode)))
    assert torch.equal(weights, weights_over_dummy_vec_env)
    assert all(model.ep_success_buffer)
    assert len(model.ep_success_buffer) >= 40
    returns, _ = evaluate_policy(model, VecMonitor(adapted(mode)), n_eval_episodes=6, return_episode_rewards=True)
    assert len(returns) == 6


def test_ppo_of_sb3_ends_with_other_weights_over_other_worlds(weights_over_dummy_vec_env):
    env = adapted(AutoresetMode.SAME_STEP)
    env.env_method("scale", 1.5)
    assert not torch.equal(trained(env)[0], weights_over_dummy_vec_env)


@pytest.mark.parametrize("vector", [SyncVectorEnv, AsyncVectorEnv])
def test_reaches_the_sub_environments(vector):
    env = adapted(AutoresetMode.SAME_STEP, vector=vector)
    assert env.get_attr("gain") == [1.0] * 3
    assert env.env_method("scale", 3.0) == [3.0] * 3
    assert env.get_attr("gain", indices=[0, 2]) == [3.0, 3.0]
    env.set_attr("gain", 0.5)
    assert env.get_attr("gain", indices=1) == [0.5]
    assert env.has_attr("gain")
    assert not env.has_attr("loss")
    with pytest.raises(AttributeError, match="loss"):
        env.get_attr("loss")
    with pytest.raises(AttributeError, match="widen"):
        env.env_method("widen")
    with pytest.raises(NotImplementedError, match=r"indices=\[0\]"):
        env.env_method("scale", 2.0, indices=[0])
    with pytest.raises(NotImplementedError, match="indices=1"):
        env.set_attr("gain", 2.0, indices=1)
    assert env.get_attr("gain") == [0.5] * 3
    env.close()


def test_options_reach_the_worlds_once():
    env = adapted(AutoresetMode.SAME_STEP)
    env.set_options({"offset": 100.0})
    assert np.all(env.reset()[:, 1] > 99)
    assert np.all(env.reset()[:, 1] < 2)
    env.set_options([{"offset": 1.0}, {}, {}])
    with pytest.raises(ValueError, match="same reset options"):
        env.reset()


def test_knows_the_wrappers_of_sub_environments():
    env = SB3VecEnv(SyncVectorEnv([lambda: Monitor(Corridor()), Corridor]))
    assert env.env_is_wrapped(Monitor) == [True, False]


class Native(VectorEnv):
    """A batched env without sub-environments, which knows nothing of `reset_mask`."""

    def __init__(self, mode):
        self.num_envs, self.metadata, self.gain, self.mode = 3, {"autoreset_mode": mode}, 1.0, mode
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)
        self.single_action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.state = np.zeros((3, 1))

    def reset(self, *, seed=None, options=None):
        self.state[:, 0] = [-1.0, -2.0, -3.0]
        return self.state, {"start": self.state[:, 0].copy()}

    def step(self, actions):
        self.state += 1.0
        done = self.state[:, 0] == 0.0
        infos = {"is_success": done.copy()}
        if self.mode is AutoresetMode.SAME_STEP and done.any():
            infos |= {"final_obs": self.state.copy(), "_final_obs": done}
            self.state[done] = -3.0
        return self.state, self.gain * np.ones(3), np.zeros(3, bool), done, infos

    def scale(self, factor):
        self.gain *= factor
        return self.gain


class Tuned(VectorWrapper):
    tune = 440.0


def test_native_vector_env_answers_for_all_worlds():
    env = SB3VecEnv(Tuned(Native(AutoresetMode.SAME_STEP)))
    assert env.get_attr("tune") == [440.0] * 3
    assert env.env_method("scale", 2.0) == [2.0] * 3
    assert not env.has_attr("loss")
    env.set_attr("gain", 7.0)
    assert env.get_attr("gain", indices=[2]) == [7.0]
    first = env.reset()
    observations, rewards, dones, infos = env.step(np.zeros((3, 1), np.float32))
    np.testing.assert_array_equal(first[:, 0], [-1, -2, -3])  # though the env reuses its array
    np.testing.assert_array_equal(observations[:, 0], [-3, -1, -2])
    np.testing.assert_array_equal(rewards, [7.0] * 3)
    assert dones.tolist() == [True, False, False]
    assert infos[0]["terminal_observation"] == [0.0]
    assert infos[0]["is_success"]
    assert "terminal_observation" not in infos[1]


def test_refuses_an_env_it_would_corrupt():
    env = SB3VecEnv(Native(AutoresetMode.NEXT_STEP))
    env.reset()
    with pytest.raises(ValueError, match="reset_mask"):
        env.step(np.zeros((3, 1), np.float32))
    with pytest.raises(ValueError, match="autoreset_mode"):
        SB3VecEnv(Native(None))


def test_infos_by_world_honours_masks():
    infos = {
        "a": np.array([1, 2]),
        "b": np.array([3, 4]),
        "_b": np.array([False, True]),
        "c": {"d": np.array([5.0, 6.0]), "_d": np.array([True, False])},
        "_c": np.array([True, False]),
        "_private": np.array([7, 8]),
    }
    first, second = infos_by_world(infos, 2)
    assert first == {"a": 1, "c": {"d": 5.0}, "_private": 7}
    assert second == {"a": 2, "b": 4, "_private": 8}


class Aim(gym.Env):
    """Answer the observed target with the action; answering 0 gets -3.3 on average over an episode of 10 steps."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = gym.spaces.Box(-2.0, 2.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.target, self.steps = self.np_random.uniform(-1, 1, 1), 0
        return self.target, {}

    def step(self, action):
        self.steps += 1
        return self.target, -float((action[0] - self.target[0]) ** 2), False, self.steps == 10, {}


def make_worlds(num_envs):
    return SyncVectorEnv([Aim] * num_envs, autoreset_mode=AutoresetMode.SAME_STEP)


def mean_error(policy):
    targets = np.linspace(-1, 1, 101).reshape(-1, 1)
    return np.abs(policy.act(targets) - targets).mean()


def test_trainer_learns_saves_and_continues(tmp_path):
    trainer = SB3(PPO, total_timesteps=9_600, warm_start_timesteps=800, num_envs=16, batch_size=200)
    untrained = SB3(PPO, total_timesteps=0, num_envs=16, batch_size=200)(make_worlds, None, np.random.default_rng(0))
    policy = trainer(make_worlds, None, np.random.default_rng(0))
    assert mean_error(untrained) > 0.4
    assert mean_error(policy) < 0.15
    assert policy.steps_trained == 9_600

    trainer.save(policy, tmp_path / "policy.pt")
    loaded = trainer.load(tmp_path / "policy.pt")
    observations = np.random.default_rng(1).normal(size=(40, 1))
    np.testing.assert_array_equal(policy.act(observations), loaded.act(observations))
    further = [trainer(make_worlds, start, np.random.default_rng(2)) for start in (policy, loaded)]
    np.testing.assert_array_equal(further[0].act(observations), further[1].act(observations))
    assert further[1].steps_trained == 10_400
    assert mean_error(further[0]) < 0.15
    assert not np.array_equal(further[0].act(observations), policy.act(observations))
    np.testing.assert_array_equal(policy.act(observations), loaded.act(observations))  # not touched by the above


def test_trainer_is_reproducible():
    trainer = SB3(total_timesteps=800, num_envs=16, batch_size=200)
    runs = [trainer(make_worlds, None, np.random.default_rng(seed)) for seed in (3, 3, 4)]
    weights = [torch.cat([value.ravel() for value in run.network.state_dict().values()]) for run in runs]
    assert torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[0], weights[2])


def test_a_warm_start_leaves_the_given_policy_as_it_is():
    trainer = SB3(total_timesteps=800, num_envs=16, batch_size=200)
    policy = trainer(make_worlds, None, np.random.default_rng(0))
    before = copy.deepcopy(policy.parameters)
    runs = [trainer(make_worlds, policy, np.random.default_rng(1)).parameters for _ in range(2)]
    for expected, got in ((before, policy.parameters), runs):
        torch.testing.assert_close(got, expected, rtol=0.0, atol=0.0)


def test_what_identifies_a_trainer():
    same, *others = (
        SB3(**arguments)
        for arguments in (
            {"gamma": 0.9, "policy_kwargs": {"activation_fn": torch.nn.ReLU}},
            {"gamma": 0.8, "policy_kwargs": {"activation_fn": torch.nn.ReLU}},
            {"gamma": 0.9, "policy_kwargs": {"activation_fn": torch.nn.Tanh}},
            {"gamma": 0.9, "policy_kwargs": {"activation_fn": torch.nn.ReLU}, "algorithm": SAC},
            {"gamma": 0.9, "policy_kwargs": {"activation_fn": torch.nn.ReLU}, "num_envs": 4},
        )
    )
    again = SB3(gamma=0.9, policy_kwargs={"activation_fn": torch.nn.ReLU})
    assert identity(same) == json.loads(json.dumps(again.identity()))
    assert identity(same)["type"] == "baselines.ppo_sb3.SB3"
    assert identity(same)["algorithm"] == "stable_baselines3.ppo.ppo.PPO"
    assert all(identity(other) != identity(same) for other in others)


def test_other_algorithms(tmp_path):
    trainer = SB3(SAC, total_timesteps=200, num_envs=4, learning_starts=40, buffer_size=1000)
    policy = trainer(make_worlds, None, np.random.default_rng(0))
    trainer.save(policy, tmp_path / "sac.pt")
    actions = trainer.load(tmp_path / "sac.pt").act(np.linspace(-5, 5, 20).reshape(-1, 1))
    assert np.all(np.abs(actions) <= 2.0)
    np.testing.assert_array_equal(actions, policy.act(np.linspace(-5, 5, 20).reshape(-1, 1)))


def test_the_entropy_coefficient_goes_on(tmp_path):
    learning = SB3(SAC, total_timesteps=200, num_envs=4, learning_starts=40, buffer_size=1000, learning_rate=1e-2)
    policy = learning(make_worlds, None, np.random.default_rng(0))
    assert policy.variables["log_ent_coef"] < -0.1  # 0 at the start
    learning.save(policy, tmp_path / "sac.pt")
    loaded = learning.load(tmp_path / "sac.pt")
    waiting = SB3(SAC, total_timesteps=0, num_envs=4, buffer_size=1000)
    further = waiting(make_worlds, loaded, np.random.default_rng(1))
    assert policy.variables == loaded.variables == further.variables


def global_states():
    return random.getstate(), np.random.get_state()[1].tolist(), torch.get_rng_state().tolist()  # noqa: NPY002


def test_global_generators_are_left_as_they_were(tmp_path):
    trainer = SB3(total_timesteps=16, num_envs=2, n_steps=8, batch_size=8)
    before = global_states()
    policy = trainer(make_worlds, None, np.random.default_rng(0))
    assert global_states() == before
    trainer.save(policy, tmp_path / "policy.pt")
    trainer.load(tmp_path / "policy.pt")
    assert global_states() == before


def test_spaces_that_cannot_be_saved_are_named(tmp_path):
    trainer = SB3(total_timesteps=0, num_envs=1, n_steps=8, batch_size=8)
    make = partial(gym.make_vec, "CartPole-v1", vectorization_mode="sync")
    policy = trainer(lambda num_envs: make(num_envs=num_envs), None, np.random.default_rng(0))
    with pytest.raises(TypeError, match="Discrete"):
        trainer.save(policy, tmp_path / "policy.pt")
