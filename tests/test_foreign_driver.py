"""SimOpt over other libraries' environments, in Gymnasium's own vector environments."""

from importlib.util import find_spec

import foreign
import numpy as np
import pytest

from simopt_envs.adaptation import Discrepancy, EnvSimulator, HiddenSystem, SimOpt
from simopt_envs.distributions import Gaussian


def adapt(scene, value, mode="sync", num_envs=20, **arguments):
    """The iterations of SimOpt with a fixed policy, from a Gaussian at the nominal value."""
    simulator = EnvSimulator(scene.make_env, mode, num_envs)
    start = Gaussian.around_nominal(simulator.parameters, std=[arguments.pop("std")])
    robot = HiddenSystem(scene.make_env, {scene.name: value}, noise=arguments.pop("noise"))
    discrepancy = Discrepancy(weights=scene.weights)
    loop = SimOpt(
        simulator,
        start,
        None,
        robot,
        policy=scene.policy,
        discrepancy=discrepancy,
        evaluation_episodes=0,
        **arguments,
    )
    iterations = list(loop.run(2))
    simulator.close()
    return iterations


@pytest.mark.parametrize("seed", range(3))
def test_hopper_finds_the_mass_of_its_torso(seed):
    scene = foreign.hopper()
    first, _, last = adapt(scene, scene.value, seed=seed, std=0.3, noise=5e-4, simulated_rollouts=80, real_rollouts=2)
    assert first.distribution.median[0] == pytest.approx(3.665, abs=1e-3)
    assert last.distribution.median[0] == pytest.approx(scene.value, rel=0.08)


@pytest.mark.parametrize("seed", range(2))
def test_hopper_keeps_what_is_right(seed):
    scene = foreign.hopper()
    *_, last = adapt(scene, 3.66519143, seed=seed, std=0.3, noise=5e-4, simulated_rollouts=80, real_rollouts=2)
    assert last.distribution.median[0] == pytest.approx(3.665, rel=0.08)


def test_async_gives_what_sync_gives():
    scene = foreign.hopper()
    arguments = {"num_envs": 3, "std": 0.3, "noise": 5e-4, "simulated_rollouts": 8, "real_rollouts": 2}
    runs = [adapt(scene, scene.value, mode, **arguments) for mode in ("sync", "async")]
    for a, b in zip(*runs, strict=True):
        np.testing.assert_array_equal(a.costs, b.costs)
        np.testing.assert_array_equal(a.distribution.mean, b.distribution.mean)


def test_the_truth_costs_nothing_without_noise():
    """Every simulated episode starts where the measured one did."""
    scene = foreign.hopper()
    robot = HiddenSystem(scene.make_env, {scene.name: scene.value})
    simulator = EnvSimulator(scene.make_env, "sync")
    real = robot.rollout(scene.policy, 3, np.random.default_rng(0))
    xi = np.array([[scene.value], [0.8 * scene.value]])
    rollouts = simulator.rollout(scene.policy, simulator.parameters, xi, real, seed=0)
    truth, wrong = Discrepancy().for_channels(simulator.observation_names, None)(rollouts, real)
    assert truth < 1e-8
    assert wrong > 0.1
    simulator.close()


@pytest.mark.slow
@pytest.mark.skipif(not find_spec("gymnasium_robotics"), reason="gymnasium-robotics is in the robotics environment")
def test_fetch_slide_finds_the_friction_of_its_puck():
    scene = foreign.fetch_slide()
    *_, last = adapt(scene, scene.value, num_envs=14, std=0.5, noise=2e-4, simulated_rollouts=120, real_rollouts=4)
    assert last.distribution.median[0] == pytest.approx(scene.value, rel=0.3)  # 0.1 at first


@pytest.mark.slow
@pytest.mark.skipif(not find_spec("robosuite"), reason="robosuite is in the robotics environment")
def test_robosuite_lift_finds_the_friction_of_its_joints():
    scene = foreign.robosuite_lift()
    *_, last = adapt(scene, scene.value, num_envs=8, std=0.5, noise=5e-4, simulated_rollouts=24, real_rollouts=1)
    assert last.distribution.median[0] == pytest.approx(scene.value, rel=0.3)  # 0.1 at first
