import threading
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import NormalizeObservation, RecordEpisodeStatistics, TimeLimit, TransformObservation

import simopt_envs  # noqa: F401 - registers the environments
from simopt_envs.distributions import Gaussian, Uniform
from wrappers import (
    DistributionVectorWrapper,
    DistributionWrapper,
    RandomizablePhysics,
    SensorDelay,
    SensorDropout,
    SensorNoise,
)

MASS = "body_mass of pole"


def physics(**kwargs) -> gym.Env:
    return RandomizablePhysics(gym.make("InvertedPendulum-v5", **kwargs), ["body_mass of *", "gravity"])


def masses(std: float = 0.3) -> Gaussian:
    with physics() as env:
        return Gaussian.around_nominal(env.parameters.subset([MASS]), std)


MASSES = masses()


def randomized(distribution=MASSES, **kwargs) -> gym.Env:
    return DistributionWrapper(physics(**kwargs), distribution)


def drawn(env: gym.Env, n: int, seed: int | None = None) -> list[float]:
    first = env.reset(seed=seed)[1]["parameters"][MASS]
    return [first] + [env.reset()[1]["parameters"][MASS] for _ in range(n - 1)]


class Fixed:
    """A user's own distribution over all parameters of the environment: nothing but ``sample``."""

    def __init__(self, *row: float):
        self.row = row

    def sample(self, n, rng):
        return np.tile(self.row, (n, 1))


# --- single ---------------------------------------------------------------------------------------------------------


def test_each_reset_draws_and_a_seed_reproduces_the_sequence():
    env, again = randomized(), randomized()
    sequence = drawn(env, 5, seed=3)
    assert len(set(sequence)) == 5
    assert drawn(again, 5, seed=3) == sequence
    assert drawn(again, 5, seed=4) != sequence
    assert env.reset()[1]["parameters"]["gravity"] == pytest.approx(9.81)


def test_the_draw_is_what_the_simulation_runs_with():
    env = randomized()
    _, info = env.reset(seed=0)
    assert env.unwrapped.model.body("pole").mass[0] == pytest.approx(info["parameters"][MASS], rel=1e-12)


def test_the_environments_own_stream_is_untouched():
    env, plain = randomized(), gym.make("InvertedPendulum-v5")
    np.testing.assert_array_equal(env.reset(seed=5)[0], plain.reset(seed=5)[0])
    np.testing.assert_array_equal(env.reset()[0], plain.reset()[0])


def test_explicit_values_win_and_do_not_shift_the_sequence():
    env, again = randomized(), randomized()
    _, _, third = drawn(env, 3, seed=3)
    again.reset(seed=3)
    given = again.reset(options={"parameters": {MASS: 4.0, "gravity": 5.0}})[1]["parameters"]
    assert (given[MASS], given["gravity"]) == (4.0, 5.0)
    assert again.reset()[1]["parameters"][MASS] == third


def test_the_distribution_can_be_replaced_between_episodes():
    env = randomized()
    env.reset(seed=0)
    env.distribution = Fixed(6.0, 2.0, 3.0)
    info = env.reset()[1]
    assert list(info["parameters"].values()) == [6.0, 2.0, 3.0]
    with pytest.raises(ValueError, match="unknown parameter 'cabinet_x'"):
        env.distribution = Gaussian.around_nominal(
            gym.make("SimOpt/Drawer-v0").unwrapped.parameters.subset(["cabinet_x"]), 0.1
        )
    assert list(env.reset()[1]["parameters"].values()) == [6.0, 2.0, 3.0]


def test_an_environment_without_parameters_is_refused():
    with pytest.raises(TypeError, match="wrap it in RandomizablePhysics"):
        DistributionWrapper(gym.make("InvertedPendulum-v5"), MASSES)


class Locked(Fixed):
    """A distribution that cannot be copied."""

    def __init__(self, *row: float):
        super().__init__(*row)
        self.lock = threading.Lock()


def test_a_distribution_need_not_be_copied():
    locked = Locked(6.0, 2.0, 3.0)
    assert randomized(locked).reset()[1]["parameters"][MASS] == 2.0
    venv = DistributionVectorWrapper(SyncVectorEnv([randomized] * 2), locked)
    assert (venv.reset()[1]["parameters"][MASS] == 2.0).all()


COMPOSITIONS = {
    "time limit": partial(TimeLimit, max_episode_steps=7),
    "normalize": NormalizeObservation,
    "statistics": RecordEpisodeStatistics,
    "transform": lambda env: TransformObservation(env, lambda x: 2 * x, env.observation_space),
    "noise": partial(SensorNoise, std=0.01),
}


@pytest.mark.parametrize("wrapper", COMPOSITIONS.values(), ids=COMPOSITIONS)
def test_it_composes_over_and_under_other_wrappers(wrapper):
    expected = drawn(randomized(), 4, seed=8)
    over = DistributionWrapper(wrapper(physics()), MASSES)
    under = wrapper(DistributionWrapper(physics(), MASSES))
    assert drawn(over, 4, seed=8) == expected
    assert drawn(under, 4, seed=8) == expected
    under.set_wrapper_attr("distribution", Fixed(6.0, 2.0, 3.0))
    assert under.reset()[1]["parameters"][MASS] == 2.0


def test_it_draws_once_per_episode():
    class Counting(Fixed):
        calls = 0

        def sample(self, n, rng):
            self.calls += 1
            return super().sample(n, rng)

    counting = Counting(6.0, 2.0, 3.0)
    env = TimeLimit(RecordEpisodeStatistics(DistributionWrapper(physics(), counting)), 3)
    for _ in range(4):
        env.reset()
        while not any(env.step(env.action_space.sample())[2:4]):
            pass
    assert counting.calls == 4


def test_gymnasium_can_make_it_again_from_its_spec():
    env = SensorNoise(randomized(), 0.01)
    again = gym.make(env.spec)
    assert drawn(again, 3, seed=2) == drawn(env, 3, seed=2)
    np.testing.assert_array_equal(again.reset(seed=1)[0], env.reset(seed=1)[0])


def test_it_works_on_our_own_task():
    env = gym.make("SimOpt/Drawer-v0")
    xi = env.unwrapped.parameters.subset(["cabinet_x", "drawer_damping"])
    env = DistributionWrapper(env, Gaussian.around_nominal(xi, std=[0.02, 0.2]))
    _, info = env.reset(seed=0)
    changed = {name for name, value in info["parameters"].items() if value != env.unwrapped.parameters[name].nominal}
    assert changed == {"cabinet_x", "drawer_damping"}


# --- vector ---------------------------------------------------------------------------------------------------------


def short_episodes(distribution) -> gym.Env:
    return TimeLimit(randomized(distribution), 3)


@pytest.mark.parametrize("vector_env", [SyncVectorEnv, AsyncVectorEnv])
def test_draws_survive_autoreset_and_equal_those_of_single_environments(vector_env):
    n, episodes = 2, 4
    expected = [drawn(randomized(), episodes, seed=11 + i) for i in range(n)]
    venv = vector_env([partial(short_episodes, MASSES)] * n)
    venv = DistributionVectorWrapper(venv, MASSES)
    _, info = venv.reset(seed=11)
    seen = [[m] for m in info["parameters"][MASS]]
    for _ in range(40):
        info = venv.step(np.zeros((n, 1)))[-1]
        for i in range(n):
            if "parameters" in info and info["_parameters"][i]:
                seen[i].append(info["parameters"][MASS][i])
    for i in range(n):
        assert seen[i][:episodes] == expected[i]
    venv.distribution = Fixed(6.0, 2.0, 3.0)
    assert (venv.reset()[1]["parameters"][MASS] == 2.0).all()
    venv.close()


def test_a_vector_environment_that_takes_no_distribution_is_refused():
    venv = SyncVectorEnv([physics] * 2)
    with pytest.raises(TypeError, match="sub-environments are wrapped in DistributionWrapper"):
        DistributionVectorWrapper(venv, MASSES)


def drawer(n: int, mode: AutoresetMode = AutoresetMode.NEXT_STEP) -> tuple[gym.vector.VectorEnv, Uniform]:
    pytest.importorskip("mujoco.batch", reason="the native vector environment needs mujoco >= 3.17")
    venv = gym.make_vec("SimOpt/Drawer-v0", n, autoreset_mode=mode, max_episode_steps=2)
    xi = venv.unwrapped.parameters.subset(["drawer_damping", "cabinet_x"])
    return venv, Uniform(xi, [5.0, -0.1], [20.0, 0.1])


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_the_native_vector_environment_draws_what_single_environments_draw(mode):
    venv, distribution = drawer(3, mode)
    venv = DistributionVectorWrapper(venv, distribution)
    space = venv.unwrapped.parameters
    seen = [venv.reset(seed=20)[1]["parameters"]]
    for _ in range(9):
        xi = venv.step(np.zeros(venv.action_space.shape))[-1]["parameters"]
        if not np.array_equal(xi, seen[-1]):
            seen.append(xi)
    assert len(seen) >= 4
    for i in range(3):
        env = DistributionWrapper(gym.make("SimOpt/Drawer-v0"), distribution)
        single = [env.reset(seed=20 + i if episode == 0 else None)[1]["parameters"] for episode in range(len(seen))]
        np.testing.assert_array_equal([xi[i] for xi in seen], [[p[name] for name in space.names] for p in single])


def test_explicit_values_in_the_native_vector_environment():
    venv, distribution = drawer(2)
    venv = DistributionVectorWrapper(venv, distribution)
    space = venv.unwrapped.parameters
    x, damping = space.index("cabinet_x"), space.index("drawer_damping")
    plain = venv.reset(seed=0)[1]["parameters"]
    given = venv.reset(seed=0, options={"parameters": {"cabinet_x": [0.2, -0.2]}})[1]["parameters"]
    np.testing.assert_array_equal(given[:, x], [0.2, -0.2])
    np.testing.assert_array_equal(given[:, damping], plain[:, damping])
    whole = np.tile(space.nominal, (2, 1))
    np.testing.assert_array_equal(venv.reset(options={"parameters": whole})[1]["parameters"], whole)


def test_a_masked_reset_draws_for_the_masked_worlds_alone():
    venv, distribution = drawer(3)
    venv = DistributionVectorWrapper(venv, distribution)
    first = venv.reset(seed=0)[1]["parameters"]
    second = venv.reset()[1]["parameters"]
    venv.reset(seed=0)
    mask = np.array([False, True, False])
    masked = venv.reset(options={"reset_mask": mask})[1]["parameters"]
    np.testing.assert_array_equal(masked, np.where(mask[:, None], second, first))
    seeded = venv.reset(seed=0, options={"reset_mask": mask})[1]["parameters"]
    np.testing.assert_array_equal(seeded, first)
    np.testing.assert_array_equal(venv.reset()[1]["parameters"], second)


def test_replacing_the_distribution_of_the_live_native_environment():
    venv, distribution = drawer(2)
    venv = DistributionVectorWrapper(venv, distribution)
    venv.reset(seed=0)
    space = venv.unwrapped.parameters
    venv.distribution = Fixed(*(space.nominal * 1.01))
    for _ in range(4):
        xi = venv.step(np.zeros(venv.action_space.shape))[-1]["parameters"]
    np.testing.assert_array_equal(xi, np.tile(space.nominal * 1.01, (2, 1)))
    with pytest.raises(ValueError, match="unknown parameter 'body_mass of pole'"):
        venv.distribution = MASSES


# --- sensors --------------------------------------------------------------------------------------------------------


def seen_by(env: gym.Env, steps: int = 50, seed: int = 0) -> np.ndarray:
    observations = [env.reset(seed=seed)[0]]
    observations += [env.step(np.array([0.1 * np.sin(t)], dtype=np.float32))[0] for t in range(steps)]
    return np.array(observations)


def pendulum() -> gym.Env:
    return gym.make("InvertedPendulum-v5").unwrapped


def test_noise_has_the_stated_spread_and_follows_the_seed():
    std = np.array([0.01, 0.02, 0.0, 0.1])
    clean = seen_by(pendulum(), 2000)
    noisy = seen_by(SensorNoise(pendulum(), std), 2000)
    np.testing.assert_allclose((noisy - clean).std(axis=0), std, rtol=0.1)
    np.testing.assert_array_equal(seen_by(SensorNoise(pendulum(), std), 2000), noisy)
    assert not np.array_equal(seen_by(SensorNoise(pendulum(), std), 2000, seed=1) - noisy, np.zeros_like(noisy))
    np.testing.assert_array_equal(seen_by(SensorNoise(pendulum(), 0.0), 2000), clean)


def test_delay_shows_earlier_observations():
    clean, delayed = seen_by(pendulum()), seen_by(SensorDelay(pendulum(), 3))
    np.testing.assert_array_equal(delayed[3:], clean[:-3])
    np.testing.assert_array_equal(delayed[:3], np.tile(clean[0], (3, 1)))
    np.testing.assert_array_equal(seen_by(SensorDelay(pendulum(), 0)), clean)
    env = SensorDelay(pendulum(), 3)
    seen_by(env)
    np.testing.assert_array_equal(seen_by(env), delayed)  # nothing is left of an earlier episode


def test_dropouts_lose_the_tracked_channels_together():
    clean, lossy = seen_by(pendulum(), 2000), seen_by(SensorDropout(pendulum(), 0.2, channels=[1, 3]), 2000)
    lost = np.isnan(lossy)
    assert not lost[0].any()
    assert not lost[:, [0, 2]].any()
    np.testing.assert_array_equal(lost[:, 1], lost[:, 3])
    assert lost[:, 1].mean() == pytest.approx(0.2, abs=0.05)
    np.testing.assert_array_equal(lossy[~lost], clean[~lost])
    np.testing.assert_array_equal(seen_by(SensorDropout(pendulum(), 0.0)), clean[:51])


def test_sensors_of_one_kind_are_independent():
    def lost(env):
        return np.isnan(seen_by(env, 500))[1:]

    alone = SensorDropout(pendulum(), 0.5, [0])
    both = lost(SensorDropout(SensorDelay(alone, 0), 0.5, [1]))
    np.testing.assert_array_equal(both[:, 0], lost(SensorDropout(pendulum(), 0.5, [0]))[:, 0])
    assert np.mean(both[:, 0] == both[:, 1]) == pytest.approx(0.5, abs=0.1)
    np.testing.assert_array_equal(lost(SensorDropout(alone, 0.5, [1])), both)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SensorNoise(pendulum(), -1.0), "std must be"),
        (lambda: SensorNoise(pendulum(), [0.1, 0.1]), r"std must be a number or \(4,\)"),
        (lambda: SensorDelay(pendulum(), -1), "steps must be"),
        (lambda: SensorDropout(pendulum(), 1.5), "probability must lie"),
        (lambda: SensorDropout(pendulum(), 0.5, [4]), "channels must be indices from 0 to 3"),
    ],
)
def test_wrong_sensor_arguments_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_sensors_need_observations_of_one_axis():
    with pytest.raises(TypeError, match="Box of floats with one axis"):
        SensorNoise(gym.make("FrozenLake-v1"), 0.1)
