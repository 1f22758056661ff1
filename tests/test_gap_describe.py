"""What is left in words: the right carrier and variable, held against recordings that were not used."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from conftest import needs_effects

from simopt_envs.gap.carriers import Carrier, Residual
from simopt_envs.gap.circumstances import circumstances
from simopt_envs.gap.curves import Variable
from simopt_envs.gap.describe import describe, describe_errors
from simopt_envs.gap.fit import Misfit
from simopt_envs.gap.hypothesis import Hypothesis
from simopt_envs.gap.motion import motion_of
from simopt_envs.gap.plain import plain_parameters
from simopt_envs.measured import cut_windows
from simopt_envs.measured.recording import Recording

pytestmark = needs_effects


WINDOWS, SAMPLES, RECORDINGS = 40, 20, 5
SUBSTEPS = 10
SLIDER = """
<mujoco><option timestep="0.001" gravity="0 0 0"/><worldbody>
  <body><joint name="slide" type="slide" axis="1 0 0" damping="2"/>
    <geom size="0.1" mass="1" contype="0" conaffinity="0"/></body>
</worldbody><actuator><position name="drive" joint="slide" kp="25" kv="10"/></actuator></mujoco>
"""


def described(force, rng, noise=1.0):
    """Describe errors that a force makes, which is a function of position or velocity."""
    position, velocity = rng.uniform(-1, 1, (2, WINDOWS, SAMPLES))
    jacobian = np.tile(np.tril(np.ones((SAMPLES, SAMPLES))), (WINDOWS, 1, 1))  # a force acts on all that follows
    errors = -np.einsum("wsk,wk->ws", jacobian, force(position, velocity))
    errors += noise * rng.standard_normal(errors.shape)
    carriers = [
        Carrier(
            "force on slide",
            "N",
            "slide",
            (np.swapaxes(jacobian, 1, 2) @ jacobian,),
            (np.einsum("wsk,ws->wk", jacobian, errors),),
        ),
        Carrier("reading of qpos/slide", "m", "", (np.tile(np.eye(SAMPLES), (WINDOWS, 1, 1)),), (errors,)),
    ]
    variables = [
        Variable("position of slide", "m", "slide", 1, (position,)),
        Variable("velocity of slide", "m/s", "slide", 1, (velocity,)),
        Variable("|velocity| of slide", "m/s", "slide", 0, (np.abs(velocity),)),
    ]
    names = [f"run {w * RECORDINGS // WINDOWS}" for w in range(WINDOWS)]
    return describe_errors(carriers, variables, [names], float(np.sum(errors**2)) - errors.size)


@pytest.mark.parametrize(
    ("force", "variable", "verb"),
    [
        (lambda x, v: 5 * x, "position of slide", "grows with"),
        (lambda x, v: -5 * v, "velocity of slide", "falls with"),
        (lambda x, v: 5 * np.abs(v) - 2.5, "|velocity| of slide", "grows with"),
        (lambda x, v: 5 * np.sign(v) - 3 * v, "velocity of slide", "jumps at the zero of"),
        (lambda x, v: 5 * np.sin(9 * x), "position of slide", "oscillates with"),
    ],
)
def test_names_what_a_force_depends_on(force, variable, verb):
    found = described(force, np.random.default_rng(0))
    assert found.curve is not None
    assert (found.curve.carrier, found.curve.variable) == ("force on slide", variable)
    assert found.curve.r2 > 0.9
    assert found.text.startswith(f"The force on slide {verb} {variable} (R²")
    x = np.zeros_like(found.curve.x)
    arguments = (found.curve.x, x) if variable.startswith("position") else (x, found.curve.x)
    away = np.abs(found.curve.x) > 0.3  # a jump is as steep as the knots allow
    assert found.curve.y[away] == pytest.approx(force(*arguments)[away], abs=1.0)


def test_says_what_it_does_not_depend_on():
    text = described(lambda x, v: 5 * np.abs(v) - 2.5, np.random.default_rng(1)).text
    assert ", not with position of slide;" in text
    assert text.endswith("velocity of slide would do nearly as well.")  # whose sign alone it does without


def test_says_that_a_force_is_constant():
    found = described(lambda x, v: 3.0 + 0.0 * x, np.random.default_rng(5))
    assert found.curve is not None
    assert found.curve.y == pytest.approx([3.0], abs=0.1)
    assert found.text.startswith("The force on slide is constant, ")


def test_describes_nothing_by_what_it_is_not():
    """A force that no variable tells: curves fitted to some recordings explain nothing of another."""
    rng = np.random.default_rng(2)
    found = described(lambda x, v: 5 * rng.standard_normal(x.shape), rng)
    assert found.curve is None
    assert found.text.startswith("No one variable describes it")
    assert all(r2 < 0.1 for _, _, r2 in found.table)


def slider_residual(law, rng):
    """A servo driven carriage with a force that its model lacks, and what the model leaves of the recordings."""
    spec = mujoco.MjSpec.from_string(SLIDER)
    plain = plain_parameters(spec)
    spec.option.timestep = 0.005 / SUBSTEPS  # the real carriage has no timestep
    model, recordings = spec.compile(), []
    for run in range(4):
        data, rows = mujoco.MjData(model), []
        speed = rng.uniform(2, 6)
        for _ in range(600):
            data.ctrl[0] = np.sin(speed * data.time)
            rows.append([data.time, data.ctrl[0], data.qpos[0] + 1e-4 * rng.standard_normal()])
            for _ in range(SUBSTEPS):
                data.qfrc_applied[0] = law(data.qpos[0])
                mujoco.mj_step(model, data)
        time, ctrl, qpos = np.array(rows).T
        recordings.append(Recording(time, {"ctrl/drive": ctrl, "qpos/slide": qpos}, f"run {run}"))
    windows = cut_windows(plain.model, recordings, 0.5)
    hypothesis = Hypothesis(plain, (), motion_of(plain.model, recordings))
    u = hypothesis.coordinates(hypothesis.space.nominal)
    misfit = Misfit(hypothesis, windows)
    noise = misfit.noise_at(u, np.array([1e-4]))
    return hypothesis, u, Residual(windows, misfit.with_noise(noise).errors(u[None])[0], noise)


def test_describes_a_simulated_force():
    hypothesis, u, residual = slider_residual(lambda q: 0.5 * q**2, np.random.default_rng(3))
    found = describe(hypothesis, u, [residual])
    assert found.curve is not None
    assert (found.curve.carrier, found.curve.variable) == ("force on slide", "position of slide")
    assert found.curve.r2 > 0.8
    truth = 0.5 * found.curve.x**2  # some of it the plain parameters take up
    assert np.sqrt(np.mean((found.curve.y - truth) ** 2)) < 0.3 * np.sqrt(np.mean(truth**2))


def test_where_no_variable_describes_it_the_regime_is_told_in_which_most_is_left():
    """Errors without any law, but six times as large while the carriage moves fast."""
    rng = np.random.default_rng(3)
    hypothesis, u, residual = slider_residual(lambda q: 0.0, rng)
    fast = np.abs(circumstances(hypothesis.plain.model, residual.windows).velocity)
    errors = rng.standard_normal(residual.errors.shape) * np.where(fast > np.median(fast), 6.0, 1.0)
    found = describe(hypothesis, u, [replace(residual, errors=errors)])
    assert found.curve is None
    assert "Most is left of qpos/slide with the speed of slide high: there its mean square is 1.9 times" in found.text
    even = describe(hypothesis, u, [replace(residual, errors=6 * rng.standard_normal(residual.errors.shape))])
    assert even.text.startswith("No one variable describes it")
    assert "Most is left" not in even.text


def test_has_nothing_to_describe_where_noise_alone_is_left():
    rng = np.random.default_rng(4)
    hypothesis, u, residual = slider_residual(lambda q: 0.5 * q**2, rng)
    found = describe(hypothesis, u, [replace(residual, errors=rng.standard_normal(residual.errors.shape))])
    assert found.text == "No more is left than noise."
    assert found.curve is None
