"""MuJoCo Warp, on its CPU device and on a GPU where there is one: the same worlds as MuJoCo's to single precision, and
what a vector env must do.

Compiling Warp's kernels takes half a minute the first time; they are then kept in Warp's cache.
"""

import sys
from functools import partial

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from toy_task import ToyTask

import simopt_envs  # noqa: F401 - registers the environments
from simopt_envs.adaptation import EnvSimulator, HiddenSystem
from simopt_envs.distributions import Gaussian
from simopt_envs.physics import Parameter, ParameterSpace, Write
from simopt_envs.physics.simulation import BatchSimulation

pytest.importorskip("mujoco_warp", reason="MuJoCo Warp is not installed")
import torch
import warp as wp

from simopt_envs.physics.arrays import to_numpy
from simopt_envs.physics.warp_simulation import WarpSimulation
from simopt_envs.tasks.vector_env import TaskVectorEnv

TASKS = ("SimOpt/Drawer-v0", "SimOpt/SwingPeg-v0")
BALL = """
<mujoco>
  <option timestep="0.004" integrator="implicitfast"/>
  <worldbody>
    <body name="table" pos="0 0 1"><geom name="top" type="box" size="1 1 .1"/></body>
    <body name="ball" pos="0 0 1.5"><joint type="slide" axis="0 0 1" damping="2"/><geom size=".1"/></body>
  </worldbody>
</mujoco>
"""
TABLE = ParameterSpace(
    [
        Parameter("height", "m", 0.0, -0.5, 0.3, "linear", (Write("body_pos", "table", (2,), "add"),)),
        Parameter("thickness", "m", 0.1, 0.01, 0.2, writes=(Write("geom_size", "top", (2,)),)),
        Parameter("mass", "kg", 4.19, 0.1, 100, writes=(Write("body_mass", "ball"),)),
    ]
)


@pytest.fixture(params=[device.alias for device in wp.get_devices()])
def on_device(request):
    """The options of a vector env on each of Warp's devices in turn."""
    return {"backend": "warp", "device": request.param}


def close(actual, desired, atol):
    """Arrays, wherever they are, alike to a tolerance."""
    np.testing.assert_allclose(to_numpy(actual), to_numpy(desired), atol=atol)


def drawn(space, n, seed=0):
    """ξ with every parameter off its nominal, (n, d)."""
    z = Gaussian.around_nominal(space, std=np.where([p.coordinate == "log" for p in space], 0.2, 0.01))
    return np.clip(z.sample(n, np.random.default_rng(seed)), space.low, space.high)


@pytest.mark.parametrize("env_id", TASKS)
def test_the_trajectories_are_those_of_mujoco(env_id, on_device):
    """20 control steps under a ξ per world: observations to 1e-4 (rad, m), rewards to 1e-3."""
    n = 6
    exact = gym.make_vec(env_id, n, autoreset_mode="Disabled")
    single = gym.make_vec(env_id, n, autoreset_mode="Disabled", **on_device)
    xi = drawn(exact.unwrapped.parameters, n)
    expected, _ = exact.reset(seed=3, options={"parameters": xi})
    observed, info = single.reset(seed=3, options={"parameters": xi})
    close(observed, expected, atol=1e-5)
    np.testing.assert_array_equal(info["parameters"], xi)
    rng = np.random.default_rng(0)
    for _ in range(20):
        action = np.tile(rng.uniform(-1, 1, exact.single_action_space.shape), (n, 1))
        expected, reward, *_, told = exact.step(action)
        observed, single_reward, _, _, single_told = single.step(torch.as_tensor(action))
        close(observed, expected, atol=1e-4)
        close(single_reward, reward, atol=1e-3)
        for name, term in told["reward_terms"].items():
            close(single_told["reward_terms"][name], term, atol=1e-3)
    assert np.abs(expected[0] - expected[1:]).max(axis=1).min() > 5e-3  # ξ makes far more of a difference
    for field in ("site_xpos", "site_xmat", "xpos", "qvel"):
        actual = single.unwrapped.simulation.data(field)
        close(actual, exact.unwrapped.simulation.data(field), atol=2e-3)


def test_a_table_that_cannot_move_stands_where_xi_puts_it(on_device):
    """Contacts with a body welded to the world, placed and sized by each world's ξ, also after others reset."""
    model = mujoco.MjModel.from_xml_string(BALL)
    xi = np.array([[0.0, 0.1, 4.19], [0.3, 0.1, 1.0], [-0.5, 0.05, 4.19], [0.0, 0.2, 20.0]])
    rests = {}
    for make in (BatchSimulation, partial(WarpSimulation, device=on_device["device"])):
        simulation = make(model, TABLE, 4)
        for worlds in ([0, 1, 2, 3], [2]):
            worlds = np.array(worlds)
            simulation.write(worlds, xi[worlds])
            simulation.reset(worlds, np.zeros((len(worlds), 1)), np.zeros((len(worlds), 1)), np.zeros((len(worlds), 0)))
        for _ in range(3):
            diverged = simulation.step(simulation.asarray(np.zeros((4, 0))), 200)
        assert not diverged.any()
        rests[make] = to_numpy(simulation.data("xpos"))[:, 2, 2]
    exact, single = rests.values()
    close(single, exact, atol=1e-4)
    close(exact, 1.0 + xi[:, 0] + xi[:, 1] + 0.1, atol=2e-3)  # table, its half thickness, ball


@pytest.mark.parametrize("mode", ["SameStep", "NextStep"])
def test_some_worlds_reset_and_the_others_do_not_notice(mode, on_device):
    """Both autoresets against MuJoCo's, worlds out of step with each other; all that comes is on the device."""
    make = partial(TaskVectorEnv, ToyTask(), 4, max_episode_steps=6, autoreset_mode=mode)
    exact, single = make(), make(**on_device)
    rng = np.random.default_rng(0)
    xi = rng.uniform(0.5, 4.0, (4, 2))
    for env in (exact, single):
        env.parameter_source = lambda worlds: xi[worlds]
        env.reset(seed=0)
    for t in range(16):
        action = rng.uniform(-1, 1, (4, 1))
        if t == 3:
            options = {"reset_mask": np.array([True, False, False, True])}
            before = single.simulation.data("qpos")[1:3].clone()
            expected, observed = exact.reset(options=options)[0], single.reset(options=options)[0]
            torch.testing.assert_close(single.simulation.data("qpos")[1:3], before, rtol=0, atol=0)
            close(observed, expected, atol=1e-5)
        *expected, told = exact.step(action)
        *observed, single_told = single.step(torch.as_tensor(action))
        for mine, theirs in zip(observed, expected, strict=True):
            assert isinstance(mine, torch.Tensor)
            close(mine, theirs, atol=1e-5)
        assert ("final_obs" in single_told) == ("final_obs" in told)
        if "final_obs" in told:
            done = told["_final_obs"]
            np.testing.assert_array_equal(to_numpy(single_told["_final_obs"]), done)
            close(to_numpy(single_told["final_obs"])[done], np.stack(told["final_obs"][done]), atol=1e-5)
    assert single.diverged_count == 0


def test_delayed_servo_starts_from_its_first_command(on_device):
    env = TaskVectorEnv(ToyTask(), 3, **on_device)
    first, _ = env.reset(seed=0)
    second, *_ = env.step(torch.zeros(3, 1))
    torch.testing.assert_close(second, first, atol=1e-6, rtol=0)


def test_a_world_that_diverges_ends_its_episode_alone(on_device):
    env = TaskVectorEnv(ToyTask(), 3, autoreset_mode="SameStep", **on_device)
    before, _ = env.reset(seed=0)
    env.simulation.data("qvel")[1] = torch.nan
    after, reward, terminated, truncated, info = env.step(torch.zeros(3, 1))
    assert info["diverged"].tolist() == truncated.tolist() == [False, True, False]
    assert not terminated.any()
    assert reward[1] == 0.0
    torch.testing.assert_close(info["final_obs"][1], before[1])
    assert torch.isfinite(after).all()
    assert env.diverged_count == 1
    *_, info = env.step(torch.zeros(3, 1))
    assert not info["diverged"].any()


def test_the_driver_rolls_out_on_it(on_device):
    """Simulated rollouts of the loop: repeated measured episodes, on the host, as from MuJoCo."""

    class Wander:
        def act(self, observations):
            assert isinstance(observations, np.ndarray)
            return np.sin(7.0 * np.tile(observations[:, :4], 2))

    real = HiddenSystem(TASKS[0], {"cabinet_x": 0.05}).rollout(Wander(), 2, np.random.default_rng(0))
    results = []
    for options in ({}, on_device):
        simulator = EnvSimulator(TASKS[0], num_envs=8, **options)
        space = simulator.parameters.subset(["cabinet_x", "latency"])
        results.append(simulator.rollout(Wander(), space, np.array([[0.05, 0.008], [-0.1, 0.02]]), real, 0))
    exact, single = results
    close(single.observations, exact.observations, atol=2e-3)
    close(single.observations[0], np.stack([t.observations for t in real]), atol=2e-3)
    assert np.abs(single.observations[1] - single.observations[0]).max() > 0.1
    assert EnvSimulator(TASKS[0], **on_device).identity() != EnvSimulator(TASKS[0]).identity()


def test_ppo_trains_on_it(on_device):
    from baselines.ppo_torch import PPOConfig, TorchPPO

    space = ToyTask.parameters
    policy = TorchPPO(PPOConfig(num_envs=8, num_steps=10, iterations=2))(
        lambda n: TaskVectorEnv(ToyTask(), n, 10, "SameStep", **on_device), None, np.random.default_rng(0)
    )
    assert policy.steps_trained == 160
    assert np.isfinite(policy.act(space.nominal[None, :1])).all()


def test_what_it_does_not_have():
    with pytest.raises(ValueError, match=r"unknown backend 'wrap'; did you mean 'warp'"):
        gym.make_vec(TASKS[0], 2, backend="wrap")
    gravity = ParameterSpace(
        [Parameter("gravity", "m/s^2", -9.81, -20, 0, "linear", (Write("opt.gravity", None, (2,)),))]
    )
    model = mujoco.MjModel.from_xml_string(BALL)
    with pytest.raises(ValueError, match=r"has the same opt.gravity in all worlds"):
        WarpSimulation(model, gravity, 2, "cpu")
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_FWDINV
    with pytest.raises(NotImplementedError, match="unsupported"):
        WarpSimulation(model, TABLE, 2, "cpu")


def test_without_warp_the_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco_warp", None)
    with pytest.raises(ImportError, match=r"simopt-envs\[warp\]"):
        TaskVectorEnv(ToyTask(), 2, backend="warp")


@pytest.mark.slow
@pytest.mark.parametrize("env_id", TASKS)
def test_one_policy_succeeds_as_often(env_id, on_device):
    """200 episodes of a policy trained on MuJoCo, the same starts and ξ: both rates within each other's interval."""
    from scipy.stats import binomtest

    from baselines.commands.inputs import distribution
    from baselines.ppo_torch import TorchPPO

    simulator = EnvSimulator(env_id)
    p = distribution(env_id, simulator.parameters, ())
    policy = TorchPPO()(lambda n: simulator.make_vector_env(n, p, 0), None, np.random.default_rng(0))
    xi = simulator.parameters.values(
        dict(zip(p.space.names, p.sample(200, np.random.default_rng(1)).T, strict=True)), 200
    )
    successes = []
    for options in ({}, on_device):
        env = EnvSimulator(env_id, **options).make_worlds(200)
        observation, _ = env.reset(seed=0, options={"parameters": xi})
        for _ in range(50):
            observation, *_, info = env.step(policy.act(observation))
        successes.append(int(info["is_success"].sum()))
    assert successes[0] > 100  # it can do something
    for k, other in (successes, successes[::-1]):
        interval = binomtest(k, 200).proportion_ci(0.95, "wilson")
        assert interval.low <= other / 200 <= interval.high
