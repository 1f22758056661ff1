"""The driver with a user's own trainer, here plain random search over linear policies."""

from functools import partial

import gymnasium as gym
import numpy as np
import pytest

from simopt_envs.adaptation import EnvSimulator, HiddenSystem, SimOpt
from simopt_envs.distributions import Gaussian
from wrappers import AdaptableEnv

GAIN = "actuator_gain of slide"


class LinearPolicy:
    def __init__(self, weights):
        self.weights = weights

    def act(self, observations):
        return np.clip(observations @ self.weights, -3.0, 3.0)


class RandomSearch:
    """Keeps the best of some policies, each a random step away from the best one before it."""

    def __init__(self, candidates=40, step=1.0):
        self.candidates, self.step = candidates, step

    def __call__(self, make_vector_env, policy, rng):
        env = make_vector_env(4)
        best = np.zeros((4, 1)) if policy is None else policy.weights
        score = self.score(env, best, rng)
        for _ in range(self.candidates):
            candidate = best + self.step * rng.standard_normal(best.shape)
            value = self.score(env, candidate, rng)
            if value > score:
                best, score = candidate, value
        env.close()
        return LinearPolicy(best)

    @staticmethod
    def score(env, weights, rng):
        observations, _ = env.reset(seed=int(rng.integers(2**31)))
        running, total = np.ones(env.num_envs, dtype=bool), 0.0
        while running.any():
            observations, rewards, terminated, truncated, _ = env.step(LinearPolicy(weights).act(observations))
            total += rewards[running].sum()
            running &= ~(terminated | truncated)
        return total / env.num_envs


def adapted(true_gain, seed, iterations):
    make_env = AdaptableEnv(partial(gym.make, "InvertedPendulum-v5", max_episode_steps=60), [GAIN])
    simulator = EnvSimulator(make_env, "sync")
    robot = HiddenSystem(make_env, {GAIN: true_gain}, noise=0.001)
    distribution = Gaussian.around_nominal(simulator.parameters, std=[0.2])
    loop = SimOpt(
        simulator,
        distribution,
        RandomSearch(),
        robot,
        simulated_rollouts=40,
        real_rollouts=2,
        evaluation_episodes=0,
        seed=seed,
    )
    return list(loop.run(iterations))


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("true_gain", [0.4, 1.0])
def test_random_search_adapts(true_gain, seed):
    first, *_, last = adapted(true_gain, seed, 3)
    assert abs(np.log(last.distribution.median / true_gain)) < 0.3  # 4.6 standard deviations away at first, or none
    assert min(map(len, first.real)) > 1
    assert last.train_steps > 0
    assert not np.array_equal(last.policy.weights, np.zeros((4, 1)))


def test_it_repeats():
    a, b = (adapted(0.4, 3, 1)[-1] for _ in range(2))
    np.testing.assert_array_equal(a.policy.weights, b.policy.weights)
    np.testing.assert_array_equal(a.distribution.mean, b.distribution.mean)
