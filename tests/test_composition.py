"""DistributionWrapper among Gymnasium's wrappers and in its vector environments: ξ is drawn once per episode, told,
reproducible, survives autoreset, and p(ξ) can be replaced while the environment lives."""

import sys
from functools import partial
from types import ModuleType

import gymnasium as gym
import numpy as np
import pytest
from conftest import needs_batch
from gymnasium.wrappers import (
    FrameStackObservation,
    NormalizeObservation,
    RecordVideo,
    TimeLimit,
    TransformObservation,
)
from gymnasium.wrappers import vector as vector_wrappers

import simopt_envs  # noqa: F401 - registers the environments
from simopt_envs.distributions import Gaussian, Uniform
from simopt_envs.physics import Parameter, ParameterSpace
from wrappers import DistributionVectorWrapper, DistributionWrapper, RandomizablePhysics

MASS = "body_mass of pole"
EPISODES, STEPS, SEED = 4, 3, 11
MASSES = Gaussian.around_nominal(ParameterSpace([Parameter(MASS, "kg", 5.0, 0.5, 50.0)]), 0.3)
HEAVY = Uniform(MASSES.space, [20.0], [30.0])

pytestmark = pytest.mark.filterwarnings("ignore:.*Overwriting existing videos:UserWarning")


@pytest.fixture(autouse=True)
def _folder_for_videos(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


class Painted(gym.Wrapper):
    """Renders without a graphics card."""

    render_mode = "rgb_array"

    def render(self):
        return np.zeros((8, 8, 3), np.uint8)


class Video(RecordVideo):
    """Counts the frames it records instead of writing them."""

    frames = 0

    def __init__(self, env):
        sys.modules.setdefault("moviepy", ModuleType("moviepy"))  # which only writing needs
        super().__init__(Painted(env), "videos", episode_trigger=lambda episode: True)

    def stop_recording(self):
        self.frames += len(self.recorded_frames)
        self.recorded_frames, self.recording = [], False


class Counting(gym.Wrapper):
    """Innermost: what the simulation ran with in each of its episodes."""

    def __init__(self, env):
        super().__init__(env)
        self.masses = []

    def reset(self, **kwargs):
        observation, info = self.env.reset(**kwargs)
        self.masses.append(float(self.unwrapped.model.body("pole").mass[0]))
        return observation, info


def physics(env=None) -> gym.Env:
    return Counting(RandomizablePhysics(env or gym.make("InvertedPendulum-v5"), [MASS, "gravity"]))


def double(env):
    return TransformObservation(env, np.array([2.0]).__mul__, env.observation_space)


WRAPPERS = {
    "time limit": partial(TimeLimit, max_episode_steps=STEPS),
    "normalize": NormalizeObservation,
    "video": Video,
    "frame stack": partial(FrameStackObservation, stack_size=3),
    "transform": double,
}


def single(wrapper, where) -> gym.Env:
    """The wrapper over or under a DistributionWrapper, with episodes of a few steps."""
    if where == "over":
        return TimeLimit(wrapper(DistributionWrapper(physics(), MASSES)), STEPS)
    return TimeLimit(DistributionWrapper(wrapper(physics()), MASSES), STEPS)


def expected(seed: int) -> list[float]:
    """What a DistributionWrapper alone draws."""
    env = DistributionWrapper(physics(), MASSES)
    first = env.reset(seed=seed)[1]["parameters"][MASS]
    return [first] + [env.reset()[1]["parameters"][MASS] for _ in range(EPISODES - 1)]


def run_episode(env) -> None:
    while not any(env.step(np.zeros(1, np.float32))[2:4]):
        pass


@pytest.mark.parametrize("where", ["over", "under"])
@pytest.mark.parametrize("wrapper", WRAPPERS.values(), ids=WRAPPERS)
def test_single(wrapper, where):
    env = single(wrapper, where)
    told = []
    for episode in range(EPISODES):
        observation, info = env.reset(seed=SEED if episode == 0 else None)
        assert observation in env.observation_space
        told.append(info["parameters"][MASS])
        run_episode(env)
    assert told == expected(SEED)
    assert env.get_wrapper_attr("masses") == pytest.approx(told, rel=1e-12)  # once per episode, and in force
    env.set_wrapper_attr("distribution", HEAVY)
    assert 20 <= env.reset()[1]["parameters"][MASS] <= 30
    if wrapper is Video:
        assert env.get_wrapper_attr("frames") >= EPISODES * STEPS
    env.close()


@pytest.mark.parametrize("mode", ["sync", "async"])
@pytest.mark.parametrize("where", ["over", "under"])
@pytest.mark.parametrize("wrapper", WRAPPERS.values(), ids=WRAPPERS)
def test_gymnasiums_vector_environments(wrapper, where, mode):
    n = 2
    env = gym.make_vec("InvertedPendulum-v5", n, mode, wrappers=[lambda env: physics(env), *layers(wrapper, where)])
    env = DistributionVectorWrapper(env, MASSES)
    told = [[mass] for mass in env.reset(seed=SEED)[1]["parameters"][MASS]]
    run_worlds(env, told, EPISODES * (STEPS + 1) - 1)  # by default the step after an episode's end resets
    for world in range(n):
        assert told[world] == expected(SEED + world)
        assert env.unwrapped.get_attr("masses")[world] == pytest.approx(told[world], rel=1e-12)
    env.distribution = HEAVY
    run_worlds(env, told, 1)
    assert all(20 <= masses[-1] <= 30 and len(masses) == EPISODES + 1 for masses in told)
    env.close()


def layers(wrapper, where):
    """As in ``single``, from the inside."""
    inner = [partial(DistributionWrapper, distribution=MASSES)]
    inner = [*inner, wrapper] if where == "over" else [wrapper, *inner]
    return [*inner, partial(TimeLimit, max_episode_steps=STEPS)]


def run_worlds(env, told, steps):
    for _ in range(steps):
        *_, info = env.step(np.zeros(env.action_space.shape, np.float32))
        for world in np.flatnonzero(info.get("_parameters", [])):
            told[world].append(info["parameters"][MASS][world])


VECTOR_WRAPPERS = {
    "normalize": vector_wrappers.NormalizeObservation,
    "statistics": vector_wrappers.RecordEpisodeStatistics,
    "transform": lambda env: vector_wrappers.TransformObservation(env, np.array([2.0]).__mul__),
}


@needs_batch
@pytest.mark.parametrize("where", ["over", "under"])
@pytest.mark.parametrize("wrapper", VECTOR_WRAPPERS.values(), ids=VECTOR_WRAPPERS)
def test_the_native_vector_environment(wrapper, where):
    n = 2

    def make():
        env = gym.make_vec("SimOpt/Drawer-v0", n, max_episode_steps=STEPS)
        xi = env.unwrapped.parameters.subset(["drawer_damping"])
        distribution = Uniform(xi, [5.0], [20.0])
        if where == "over":
            return wrapper(DistributionVectorWrapper(env, distribution)), xi
        return DistributionVectorWrapper(wrapper(env), distribution), xi

    def dampings(env, steps):
        told = [env.reset(seed=SEED)[1]["parameters"][:, column]]
        for _ in range(steps):
            told.append(env.step(np.zeros(env.action_space.shape))[-1]["parameters"][:, column])
        return np.array(told)

    env, xi = make()
    column = env.unwrapped.parameters.index("drawer_damping")
    told = dampings(env, EPISODES * (STEPS + 1) - 1)
    period = STEPS + 1  # the step after an episode's end resets
    changes = np.flatnonzero((np.diff(told, axis=0) != 0).any(axis=1)) + 1
    assert changes.tolist() == list(range(period, len(told), period))  # once per episode
    single_env = DistributionWrapper(gym.make("SimOpt/Drawer-v0"), Uniform(xi, [5.0], [20.0]))
    for world in range(n):
        single_env.reset(seed=SEED + world)
        second = single_env.reset()[1]["parameters"]["drawer_damping"]
        assert told[period, world] == second
    np.testing.assert_array_equal(dampings(make()[0], len(told) - 1), told)

    layer = env if isinstance(env, DistributionVectorWrapper) else env.env
    env.step(np.zeros(env.action_space.shape))  # begins an episode
    layer.distribution = Uniform(xi, [30.0], [40.0])
    later = np.array([env.step(np.zeros(env.action_space.shape))[-1]["parameters"][:, column] for _ in range(period)])
    assert (later[:-1] <= 20).all()
    assert ((later[-1] >= 30) & (later[-1] <= 40)).all()
