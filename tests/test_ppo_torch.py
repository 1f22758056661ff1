from dataclasses import replace
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from baselines.ppo_torch import (
    Arguments,
    Collector,
    PPOConfig,
    Rollout,
    RunningNormaliser,
    TorchPPO,
    evaluate,
    generalised_advantages,
    main,
)


class Aim(gym.Env):
    """Answer the observed target, drawn anew at each episode, with an action at 3 × target.

    The best return is 0; answering 0 all the time gets -7.5 on average (10 steps of the variance of U(-1.5, 1.5)).
    """

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = gym.spaces.Box(-2.0, 2.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.target = self.np_random.uniform(-0.5, 0.5, 1)
        self.steps = 0
        return self.target, {}

    def step(self, action):
        self.steps += 1
        error = float(abs(action[0] - 3.0 * self.target[0]))
        return self.target, -(error**2), False, self.steps == 10, {"is_success": error < 0.2}


class Corridor(gym.Env):
    """A walk of random length that ends by termination or by truncation; each observation is unique."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.length, self.name = 0, self.np_random.integers(2, 9), self.np_random.random()
        return np.array([self.steps, self.name]), {}

    def step(self, action):
        self.steps += 1
        over, by_time = self.steps == self.length, self.name < 0.5
        reward = self.name + float(action[0])
        return np.array([self.steps, self.name]), reward, over and not by_time, over and by_time, {"is_success": over}


def worlds(env_class, num_envs, mode=AutoresetMode.SAME_STEP):
    return SyncVectorEnv([env_class] * num_envs, autoreset_mode=mode)


SMALL = PPOConfig(
    num_envs=16,
    num_steps=20,
    iterations=30,
    warm_start_iterations=2,
    minibatches=4,
    target_kl=0.01,
    initial_log_std=-0.7,
    success_stop=None,
    evaluation_share=0.0,
)


def weights(policy):
    return torch.cat([value.double().ravel() for value in policy.state_dict().values()])


def train(config=SMALL, seed=0, policy=None, env_class=Aim, **kwargs):
    return TorchPPO(config, **kwargs)(partial(worlds, env_class), policy, np.random.default_rng(seed))


@pytest.mark.parametrize("seed", [0, 1])
def test_learns_a_task_of_known_optimum_and_nothing_in_zero_iterations(seed):
    untrained = evaluate(train(replace(SMALL, iterations=0), seed), worlds(Aim, 64), seed=5)
    trained = evaluate(train(seed=seed), worlds(Aim, 64), seed=5)
    assert untrained.mean() < -5.0
    assert trained.mean() > -0.5


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_learns_pendulum(seed):
    def make(num_envs):
        return gym.make_vec("Pendulum-v1", num_envs=num_envs, vectorization_mode="sync")

    config = PPOConfig(num_envs=32, num_steps=200, iterations=30)
    untrained = TorchPPO(replace(config, iterations=0))(make, None, np.random.default_rng(seed))
    trained = TorchPPO(config)(make, None, np.random.default_rng(seed))
    assert evaluate(untrained, make(20), seed=9).mean() < -900
    assert evaluate(trained, make(20), seed=9).mean() > -400


def test_same_generator_gives_bit_identical_weights_and_leaves_global_state_alone():
    config = replace(SMALL, iterations=3)
    torch_state, numpy_state, threads = torch.get_rng_state(), np.random.get_state()[1].copy(), torch.get_num_threads()  # noqa: NPY002
    first = weights(train(config))
    torch.manual_seed(123)
    assert torch.equal(first, weights(train(config)))
    assert not torch.equal(first, weights(train(config, seed=1)))
    torch.set_rng_state(torch_state)
    train(config)
    assert torch.equal(torch_state, torch.get_rng_state())
    assert np.array_equal(numpy_state, np.random.get_state()[1])  # noqa: NPY002
    assert torch.get_num_threads() == threads


def test_saved_policy_acts_the_same_and_continues_the_same(tmp_path):
    policy, trainer = train(replace(SMALL, iterations=3)), TorchPPO(SMALL)
    trainer.save(policy, tmp_path / "policy.pt")
    loaded = trainer.load(tmp_path / "policy.pt")
    observations = np.random.default_rng(0).normal(size=(50, 1))
    assert np.array_equal(policy.act(observations), loaded.act(observations))
    assert loaded.steps_trained == policy.steps_trained == 3 * 16 * 20
    assert torch.equal(weights(train(policy=policy)), weights(train(policy=loaded)))
    assert [file.name for file in tmp_path.iterdir()] == ["policy.pt"]
    with pytest.raises(FileNotFoundError):
        trainer.load(tmp_path / "absent.pt")


def test_warm_start_goes_on_from_a_copy():
    policy = train()
    before, seen = weights(policy), []
    further = train(policy=policy, on_progress=seen.append)
    assert torch.equal(before, weights(policy))
    assert not torch.equal(before, weights(further))
    assert len(seen) == SMALL.warm_start_iterations
    assert seen[-1].steps == seen[-1].total_steps == 2 * 16 * 20
    assert further.steps_trained == 32 * 16 * 20
    assert further.observation_normaliser.count == policy.observation_normaliser.count + 2 * 16 * 20
    assert evaluate(further, worlds(Aim, 64), seed=5).mean() > -0.5
    with pytest.raises(ValueError, match="observation size"):
        train(policy=policy, env_class=Corridor)


def test_actions_stay_in_the_space():
    policy = train(replace(SMALL, iterations=1))
    actions = policy.act(np.linspace(-1e6, 1e6, 100).reshape(-1, 1) * 1e6)
    assert actions.shape == (100, 1)
    assert all(Aim.action_space.contains(action) for action in actions)
    with torch.no_grad():
        policy.actor[-1].bias.fill_(100.0)
    assert np.all(policy.act(np.zeros((3, 1))) == 2.0)


class Precise(Aim):
    """Aim with bounds that single precision cannot hold, and which it rounds outwards."""

    action_space = gym.spaces.Box(-0.3, 0.3, (1,), np.float64)

    def step(self, action):
        assert self.action_space.contains(action)
        return super().step(action)


@pytest.mark.parametrize(("bound", "penalised"), [(2.0, True), (np.inf, False)])
def test_mean_actions_beyond_their_bounds_are_penalised_where_there_are_bounds(bound, penalised):
    class Bounded(Aim):
        action_space = gym.spaces.Box(-bound, bound, (1,), np.float32)

    start = train(replace(SMALL, iterations=0), env_class=Bounded)
    torch.nn.init.constant_(start.actor[-1].bias, 3.0)
    with_penalty, without = (
        train(replace(SMALL, warm_start_iterations=1, bound_weight=weight), policy=start, env_class=Bounded)
        for weight in (5.0, 0.0)
    )
    assert torch.equal(weights(with_penalty), weights(without)) != penalised


@pytest.mark.parametrize(("bound", "floor"), [(5.0, 0.1), (1e6, 1e-4), (np.inf, 1e-4)])
def test_bounds_that_tell_nothing_set_no_scale(bound, floor):
    class Bounded(Aim):
        observation_space = gym.spaces.Box(-bound, bound, (1,), np.float64)

    assert train(replace(SMALL, iterations=0), env_class=Bounded).observation_normaliser.floor == floor


def test_bounds_in_double_precision_are_kept_and_fit_again(tmp_path):
    config = replace(SMALL, iterations=1, initial_log_std=1.0)
    policy, trainer = train(config, env_class=Precise), TorchPPO(config)
    trainer.save(policy, tmp_path / "policy.pt")
    for start in (policy, trainer.load(tmp_path / "policy.pt")):
        train(replace(config, warm_start_iterations=1), policy=start, env_class=Precise)
    for bias in (-100.0, 100.0):
        with torch.no_grad():
            policy.actor[-1].bias.fill_(bias)
        (action,) = policy.act(np.zeros((1, 1)))
        assert Precise.action_space.contains(action)
        assert action == pytest.approx(0.3 * np.sign(bias), rel=1e-6)


def test_stops_at_the_success_rate_asked_for():
    seen = []
    config = replace(SMALL, iterations=60, success_stop=0.9, evaluation_share=0.25, evaluation_episodes=16)
    policy = train(config, on_progress=seen.append)
    assert 2 <= len(seen) < 60
    assert seen[-1].success >= 0.9
    assert all(progress.success < 0.9 for progress in seen[1:-1])
    assert policy.steps_trained == len(seen) * 16 * 20
    # Evaluation worlds are not learned from, nor is the last iteration: the policy returned is the one measured.
    assert policy.observation_normaliser.count == (len(seen) - 1) * 12 * 20


def test_an_env_without_success_is_trained_to_the_end():
    seen = []
    config = replace(SMALL, iterations=3, warm_start_iterations=3, success_stop=0.0, stuck_iterations=1)
    trainer = TorchPPO(config, on_progress=seen.append)

    def make(num_envs):
        return gym.make_vec("Pendulum-v1", num_envs, vectorization_mode="sync", max_episode_steps=10)

    further = trainer(make, trainer(make, None, np.random.default_rng(0)), np.random.default_rng(0))
    assert len(seen) == 6
    assert all(np.isnan(progress.success) and np.isfinite(progress.episode_return) for progress in seen)
    assert further.log_std.max() < -0.6  # not known to be stuck


class Unsolvable(Aim):
    """Aim where nothing counts as success."""

    def step(self, action):
        return *super().step(action)[:4], {"is_success": False}


@pytest.mark.parametrize(("env_class", "iterations"), [(Unsolvable, [1, 2, 1, 2, 3, 4]), (Aim, [1, 2, 3])])
def test_a_given_policy_that_never_succeeds_gives_way_to_a_new_one(env_class, iterations):
    config = replace(SMALL, iterations=4, warm_start_iterations=3, stuck_iterations=2)
    policy, seen = train(), []
    further = train(config, policy=policy, env_class=env_class, on_progress=seen.append)
    assert [progress.steps for progress in seen] == [i * 16 * 20 for i in iterations]
    assert further.steps_trained == policy.steps_trained + len(iterations) * 16 * 20
    starts_anew = further.observation_normaliser.count < policy.observation_normaliser.count
    assert starts_anew == (env_class is Unsolvable)


def test_interrupt_leaves_the_checkpoint_of_the_last_iteration(tmp_path):
    closed = []

    def interrupt(progress):
        if progress.steps == 2 * 16 * 20:
            raise KeyboardInterrupt

    def make(num_envs):
        env = worlds(Aim, num_envs)
        env.close_extras = lambda **kwargs: closed.append(True)
        return env

    trainer = TorchPPO(SMALL, on_progress=interrupt, checkpoint=tmp_path / "policy.pt")
    with pytest.raises(KeyboardInterrupt):
        trainer(make, None, np.random.default_rng(0))
    assert closed == [True]
    expected = train(replace(SMALL, iterations=2))
    assert torch.equal(weights(trainer.load(tmp_path / "policy.pt")), weights(expected))


def random_rollout(rng, steps=40, num_envs=6):
    terminated = rng.random((steps, num_envs)) < 0.1
    done = terminated | (rng.random((steps, num_envs)) < 0.1)
    numbers = rng.normal(size=(steps, num_envs, 1))
    arrays = (numbers, numbers, numbers[..., 0], numbers, terminated, done, np.ones_like(done))
    return Rollout(*map(torch.as_tensor, arrays))


def test_advantages_match_the_sum_over_steps():
    rng, gamma, gae_lambda = np.random.default_rng(3), 0.9, 0.8
    rollout = random_rollout(rng)
    values, successor_values = rng.normal(size=(2, *rollout.rewards.shape))
    advantages = generalised_advantages(
        rollout, torch.as_tensor(values), torch.as_tensor(successor_values), gamma, gae_lambda
    )
    assert (rollout.done & ~rollout.terminated).any()
    for world in range(rollout.rewards.shape[1]):
        for start in range(len(rollout.rewards)):
            expected = 0.0
            for t in range(start, len(rollout.rewards)):
                future = 0.0 if rollout.terminated[t, world] else successor_values[t, world]
                error = rollout.rewards[t, world] + gamma * future - values[t, world]
                expected += (gamma * gae_lambda) ** (t - start) * error
                if rollout.done[t, world]:
                    break
            assert float(advantages[start, world]) == pytest.approx(float(expected), abs=1e-12)


def test_both_autoreset_modes_give_the_same_transitions():
    policy = train(replace(SMALL, iterations=0), env_class=Corridor)

    def transitions(mode, steps):
        collector = Collector(worlds(Corridor, 4, mode), seed=7, evaluation_envs=0, window=1000)
        rollout = collector.collect(policy, torch.zeros(steps, 4, 1))
        values, futures = policy.values(rollout.observations), policy.values(rollout.successors)
        advantages = generalised_advantages(rollout, values, futures, 0.98, 0.95)
        columns = (rollout.rewards, rollout.terminated, rollout.done, advantages)
        rows = np.concatenate(
            [rollout.observations, rollout.actions, rollout.successors, *(c[..., None] for c in columns)], axis=-1
        )
        valid = [rows[rollout.valid[:, world], world] for world in range(4)]
        complete = [world[: np.flatnonzero(world[:, -2])[-1] + 1] for world in valid]  # whole episodes only
        return complete, collector.episodes, rollout

    same, same_episodes, rollout = transitions(AutoresetMode.SAME_STEP, 60)
    later, later_episodes, padded = transitions(AutoresetMode.NEXT_STEP, 60)
    assert rollout.valid.all()
    assert np.array_equal(~padded.valid[1:], padded.done[:-1])
    assert (rollout.done & ~rollout.terminated).any()
    assert rollout.terminated.any()
    for ours, theirs in zip(same, later, strict=True):
        assert 20 < len(theirs) <= len(ours)
        np.testing.assert_allclose(theirs, ours[: len(theirs)], rtol=0, atol=1e-6)
        assert np.array_equal(theirs[:, 3], theirs[:, 0] + 1)  # the successor ends its own episode, not the next
    assert set(later_episodes) <= set(same_episodes)
    assert all(success == 1.0 for _, success in same_episodes)


def test_running_statistics_match_those_of_the_whole_stream():
    stream = torch.from_numpy(np.random.default_rng(0).normal([3.0, -1e4], [1e-2, 7.0], size=(1000, 2)))
    normaliser = RunningNormaliser(2, clip=10.0)
    for part in stream.split([1, 399, 600]):
        normaliser.update(part)
    torch.testing.assert_close(normaliser.mean, stream.mean(0), rtol=1e-12, atol=0)
    torch.testing.assert_close(normaliser.variance, stream.var(0, correction=0), rtol=1e-9, atol=0)
    torch.testing.assert_close(normaliser.denormalise(normaliser(stream).double()), stream, rtol=0, atol=1e-4)
    assert normaliser(stream + 1e6).max() == 10.0


def test_refuses_what_it_cannot_train():
    with pytest.raises(ValueError, match="autoreset_mode"):
        TorchPPO(SMALL)(partial(worlds, Aim, mode=AutoresetMode.DISABLED), None, np.random.default_rng(0))
    with pytest.raises(TypeError, match="action space"):
        TorchPPO(SMALL)(
            lambda n: gym.make_vec("CartPole-v1", n, vectorization_mode="sync"), None, np.random.default_rng(0)
        )
    with pytest.raises(ValueError, match="epochs must be at least 1, got 0"):
        PPOConfig(epochs=0)
    with pytest.raises(ValueError, match="evaluation_share must be within"):
        PPOConfig(evaluation_share=1.0)


def test_command_line_trains_evaluates_and_saves(tmp_path, capsys):
    out = tmp_path / "new" / "policy.pt"
    main(Arguments("Pendulum-v1", out=out, ppo=PPOConfig(num_envs=4, num_steps=50, iterations=2)))
    lines = capsys.readouterr().out.splitlines()
    assert "mean return of 20 episodes -" in lines[-1]
    assert sum("KL" in line for line in lines) == 2
    assert TorchPPO().load(out).steps_trained == 400
    warm = PPOConfig(num_envs=4, num_steps=50, warm_start_iterations=1)
    main(Arguments("Pendulum-v1", out=tmp_path / "warm.pt", warm_start=out, ppo=warm))
    assert TorchPPO().load(tmp_path / "warm.pt").steps_trained == 600
