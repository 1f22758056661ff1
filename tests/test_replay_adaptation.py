"""Adapting to recordings: a pendulum's friction from its logged motion, no policy and no training."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from simopt_envs.adaptation import RecordedSystem, ReplaySimulator, SimOpt, window_trajectories
from simopt_envs.distributions import Gaussian
from simopt_envs.engine import ThreadEngine
from simopt_envs.measured.recording import Recording
from simopt_envs.measured.trajectory import Trajectory
from simopt_envs.measured.windows import WindowSimulator, cut_windows
from simopt_envs.physics import ModelWriter, Parameter, ParameterSpace, Write

XML = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="rod" pos="0 0 1">
      <joint name="hinge" type="hinge" axis="0 1 0" damping="0.02" frictionloss="0.001"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="0.5"/>
    </body>
  </worldbody>
  <actuator><motor name="drive" joint="hinge"/></actuator>
</mujoco>
"""
SPACE = ParameterSpace(
    [
        Parameter("friction", "N m", 0.02, 0.0001, 1.0, writes=(Write("dof_frictionloss", "hinge"),)),
        Parameter("damping", "N m s/rad", 0.02, 0.001, 1.0, writes=(Write("dof_damping", "hinge"),)),
    ]
)
TRUTH = np.array([0.08, 0.02])


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(XML)


@pytest.fixture(scope="module")
def windows(model):
    """6 s of motion under a wandering torque, at the true ξ, cut into windows of 0.5 s."""
    real, rng = mujoco.MjModel.from_xml_string(XML), np.random.default_rng(0)
    data = mujoco.MjData(real)
    ModelWriter(real, SPACE).write_model(TRUTH, real, data)
    torque = 0.5 * np.sin(np.cumsum(rng.uniform(0, 0.05, 1200)))
    position = np.empty(1200)
    for t in range(1200):
        position[t] = data.qpos[0]
        data.ctrl[0] = torque[t]
        mujoco.mj_step(real, data)
    position += 1e-4 * rng.standard_normal(1200)
    log = Recording(0.005 * np.arange(1200), {"ctrl/drive": torque, "qpos/hinge": position})
    return cut_windows(model, log, seconds=0.5)


def test_finds_the_friction_of_a_recording(model, windows, tmp_path):
    system = RecordedSystem(window_trajectories(windows))

    def loop():
        return SimOpt(
            ReplaySimulator(model, SPACE, windows),
            Gaussian.around_nominal(SPACE, std=[0.7, 0.2]),
            None,
            system,
            real_rollouts=6,
            simulated_rollouts=600,
            directory=tmp_path / "run",
        )

    first, *_, last = loop().run(4)
    heavier, wider = mujoco.MjModel.from_xml_string(XML.replace('mass="0.5"', 'mass="1.5"')), SPACE.parameters
    for simulator, what in (
        (ReplaySimulator(heavier, SPACE, windows), "model_digest"),
        (ReplaySimulator(model, ParameterSpace([replace(wider[0], high=2.0), wider[1]]), windows), "parameters_digest"),
    ):
        other = loop()
        other.simulator = simulator
        with pytest.raises(ValueError, match=rf"other settings: simulator.{what}"):
            other.run(4, resume=True)
    assert last.distribution.median[0] == pytest.approx(TRUTH[0], rel=0.1)
    assert last.discrepancy_mean < 0.1 * first.discrepancy_mean
    assert last.verdict.label != "unexplained"
    assert (first.policy, first.target_success, first.sim_success, first.train_steps) == (None, None, None, 0)
    *_, restored = loop().run(4, resume=True)
    np.testing.assert_array_equal(restored.distribution.mean, last.distribution.mean)


def test_at_the_true_parameters_the_windows_are_met(model, windows):
    real = window_trajectories(windows)
    rollouts = ReplaySimulator(model, SPACE, windows).rollout(None, SPACE, np.array([TRUTH, SPACE.nominal]), real, 0)
    difference = rollouts.observations - np.stack([t.observations for t in real])
    assert difference.shape == (2, 11, 101, 1)
    true, nominal = np.sqrt(np.square(difference).mean(axis=(1, 2, 3)))
    assert true < 0.03
    assert nominal > 0.1


def test_threads_get_the_same_replays(model, windows):
    real, xi = window_trajectories(windows), Gaussian.around_nominal(SPACE, 0.3).sample(300, np.random.default_rng(0))
    local, threads = (
        ReplaySimulator(model, SPACE, windows, engine).rollout(None, SPACE, xi, real, 0)
        for engine in (None, ThreadEngine())
    )
    np.testing.assert_array_equal(threads.observations, local.observations)


def test_windows_that_look_alike_keep_their_commands(model):
    """A joint that sticks shows the same whatever the drive tries."""
    torque = np.repeat([0.0, 0.01, 0.04], 50)
    still = Recording(0.005 * np.arange(150), {"ctrl/drive": torque, "qpos/hinge": np.zeros(150)})
    windows = cut_windows(model, still, seconds=0.2)
    real, xi = window_trajectories(windows), np.array([[0.001, 0.02]])
    replayed = ReplaySimulator(model, SPACE, windows).rollout(None, SPACE, xi, real, 0).observations[0]
    np.testing.assert_array_equal(replayed, WindowSimulator(model, windows, SPACE)(xi)[0])
    assert len(np.unique(replayed[:, -1])) == len(real) == 3


def test_what_cannot_be_replayed(model, windows):
    simulator = ReplaySimulator(model, SPACE, windows)
    with pytest.raises(ValueError, match="none of the simulator's windows"):
        simulator.rollout(None, SPACE, TRUTH[None], [Trajectory(np.zeros((3, 1)), np.zeros((2, 1)))], 0)
    with pytest.raises(ValueError, match="without a policy"):
        simulator.make_vector_env(2, Gaussian.around_nominal(SPACE, 0.1), 0)
