"""Fits to recordings: least squares and CMA-ES find the same ξ, say how well, and what the data leave open."""

import mujoco
import numpy as np
import pytest

from baselines.commands.recordings import HeldOut
from simopt_envs.adaptation import RecordedSystem, ReplaySimulator, SimOpt, window_trajectories
from simopt_envs.adaptation.fitting import CMAES, LeastSquares, Noise, WindowMisfit, untold_combinations
from simopt_envs.distributions import Gaussian
from simopt_envs.measured import Recording, cut_windows
from simopt_envs.physics import ModelWriter, Parameter, ParameterSpace, Write

XML = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="rod" pos="0 0 1">
      <joint name="hinge" type="hinge" axis="0 1 0" damping="0.02" frictionloss="0.001" armature="0.01"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="0.5"/>
    </body>
  </worldbody>
  <actuator><motor name="drive" joint="hinge"/></actuator>
</mujoco>
"""
FRICTION = Parameter("friction", "N m", 0.02, 1e-4, 1.0, writes=(Write("dof_frictionloss", "hinge"),))
DAMPING = Parameter("damping", "N m s/rad", 0.02, 1e-3, 1.0, writes=(Write("dof_damping", "hinge"),))
ROTOR = Parameter("rotor", "kg m^2", 0.01, 1e-3, 0.1, writes=(Write("dof_armature", "hinge"),))
SHELL = Parameter("shell", "kg m^2", 0.00377, 1e-4, 0.1, writes=(Write("body_inertia", "rod", (0, 1)),))
SPACE = ParameterSpace([FRICTION, DAMPING])
PRIOR = Gaussian.around_nominal(SPACE, [0.7, 0.5])
TRUTH = np.array([0.08, 0.03])


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(XML)


@pytest.fixture(scope="module")
def windows(model):
    """6 s of motion under a wandering torque, at the true ξ, with 1 mrad of noise."""
    real, rng = mujoco.MjModel.from_xml_string(XML), np.random.default_rng(0)
    data = mujoco.MjData(real)
    ModelWriter(real, SPACE).write_model(TRUTH, real, data)
    torque, position = 0.5 * np.sin(np.cumsum(rng.uniform(0, 0.05, 1200))), np.empty(1200)
    for t in range(1200):
        position[t] = data.qpos[0]
        data.ctrl[0] = torque[t]
        mujoco.mj_step(real, data)
    position += 1e-3 * rng.standard_normal(1200)
    return cut_windows(
        model, Recording(0.005 * np.arange(1200), {"ctrl/drive": torque, "qpos/hinge": position}), seconds=0.5
    )


@pytest.fixture(scope="module")
def fitted(model, windows):
    return LeastSquares(WindowMisfit(model, windows, PRIOR)).fit(np.random.default_rng(0))


def test_least_squares_finds_the_truth_within_its_own_error(fitted):
    z = SPACE.to_unconstrained(TRUTH)
    assert (np.abs(fitted.mean - z) < 4 * fitted.std).all()
    assert (fitted.std < 0.1 * PRIOR.std).all()
    np.testing.assert_allclose(fitted.median, TRUTH, rtol=0.05)


def test_cma_es_finds_what_least_squares_finds(model, windows, fitted):
    pytest.importorskip("cma")
    misfit = WindowMisfit(model, windows, PRIOR)
    state = np.random.get_state()[1].copy()  # noqa: NPY002
    found = CMAES(misfit, evaluations=200).fit(np.random.default_rng(1))
    assert (np.abs(found.mean - fitted.mean) < fitted.std).all()
    np.testing.assert_allclose(found.std, fitted.std, rtol=0.3)
    np.testing.assert_array_equal(np.random.get_state()[1], state)  # noqa: NPY002
    again = CMAES(WindowMisfit(model, windows, PRIOR), evaluations=200).fit(np.random.default_rng(1))
    np.testing.assert_array_equal(found.mean, again.mean)
    assert misfit.rollouts > 3 * 100 * len(windows)


def test_a_fit_is_an_update_of_the_loop(model, windows, fitted, tmp_path):
    def loop():
        return SimOpt(
            ReplaySimulator(model, SPACE, windows),
            PRIOR,
            None,
            RecordedSystem(window_trajectories(windows)),
            update=LeastSquares(WindowMisfit(model, windows, PRIOR)),
            real_rollouts=11,
            simulated_rollouts=220,
            updates_per_iteration=1,
            directory=tmp_path / "run",
        )

    before, after = loop().run(1)
    np.testing.assert_allclose(after.distribution.mean, fitted.mean)
    assert after.discrepancy_mean < 0.05 * before.discrepancy_mean
    assert (after.relevance > 0.9).all()
    *_, restored = loop().run(1, resume=True)
    np.testing.assert_array_equal(restored.distribution.covariance, after.distribution.covariance)


def test_what_the_data_cannot_tell_apart_is_said(model, windows, fitted):
    assert untold_combinations(PRIOR, fitted) == []
    # The inertia of a rotor on the joint and that of the rod about it are one number to every motion.
    prior = Gaussian.around_nominal(ParameterSpace([FRICTION, ROTOR, SHELL]), [0.7, 0.2, 0.5])
    posterior = LeastSquares(WindowMisfit(model, windows, prior)).fit(np.random.default_rng(0))
    (sentence,) = untold_combinations(prior, posterior)
    assert sentence.startswith("The data hardly tell apart: ")
    assert "rotor" in sentence
    assert "shell" in sentence
    assert "friction" not in sentence


def test_what_the_data_say_nothing_about_is_said():
    space = ParameterSpace([FRICTION, DAMPING])
    prior = Gaussian.around_nominal(space, 0.5)
    posterior = Gaussian(space, prior.mean, np.diag([1e-4, 0.24]))
    assert untold_combinations(prior, posterior) == ["The data say hardly anything about damping."]
    assert len(untold_combinations(prior, prior)) == 2


def test_a_fit_that_ends_at_a_bound_is_tried_on_what_was_held_out(model, windows):
    rounded = Gaussian(SPACE, SPACE.to_unconstrained(SPACE.high) + 1e-15, PRIOR.covariance)
    assert rounded.median[0] > SPACE.high[0]
    assert HeldOut.of(model, windows, PRIOR, rounded).after[0] > 0


def test_whitening_leaves_independent_errors():
    rng = np.random.default_rng(0)
    starts, scale = rng.standard_normal((3, 1, 4, 2)), np.array([0.5, 2.0])
    noise = Noise.of(scale, starts)
    root = noise.whiten(np.eye(8).reshape(8, 1, 4, 2)).reshape(8, 8).T
    columns = starts.reshape(3, 8)
    covariance = np.diag(np.tile(scale**2, 4)) + columns.T @ columns
    np.testing.assert_allclose(root @ covariance @ root.T, np.eye(8), atol=1e-12)
    in_units_of_scale = np.linalg.slogdet(covariance / np.outer(*2 * [np.tile(scale, 4)])).logabsdet
    np.testing.assert_allclose(noise.log_det, [in_units_of_scale])


def test_what_cannot_be_fitted(model, windows):
    elsewhere = ParameterSpace([Parameter("a", "1", 1, 0.1, 2, writes=(Write("dof_damping", "nowhere"),))])
    with pytest.raises(ValueError, match="nowhere"):
        WindowMisfit(model, windows, Gaussian.around_nominal(elsewhere, 0.1))


def test_a_channel_that_never_moves_is_no_trouble(model):
    still = Recording(0.005 * np.arange(400), {"ctrl/drive": np.zeros(400), "qpos/hinge": np.zeros(400)})
    resting = cut_windows(model, still, seconds=0.5)
    posterior = LeastSquares(WindowMisfit(model, resting, PRIOR)).fit(np.random.default_rng(0))
    np.testing.assert_allclose(posterior.std, PRIOR.std, rtol=0.05)
    assert len(untold_combinations(PRIOR, posterior)) == 2


def test_a_noise_of_some_windows_may_have_more_directions_than_that_of_others():
    rng, scale = np.random.default_rng(0), np.array([0.5, 2.0])
    few, many = (Noise.of(scale, rng.standard_normal((k, 3, 4, 2))) for k in (1, 3))
    errors, rows = rng.standard_normal((2, 3, 4, 2)), np.array([True, False, True])
    for one, other in ((few, many), (many, few)):
        mixed = one.replaced(rows, other)
        np.testing.assert_allclose(mixed.log_det, np.where(rows, other.log_det, one.log_det))
        expected = np.where(rows[:, None, None], other.whiten(errors), one.whiten(errors))
        np.testing.assert_allclose(mixed.whiten(errors), expected, atol=1e-12)
