"""A model with an effect in it: nothing changes while there is none of it, and it starts where the effect lets it."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from conftest import needs_effects
from gap_plant import MODEL, record

from simopt_envs.distributions import Gaussian
from simopt_envs.gap.fit import Misfit
from simopt_envs.gap.hypothesis import Candidate, Hypothesis
from simopt_envs.gap.large import of_some_size
from simopt_envs.gap.motion import motion_of
from simopt_envs.gap.plain import Plain, plain_parameters
from simopt_envs.gap.recordings import read_windows
from simopt_envs.gap.thresholds import FARTHEST
from simopt_envs.measured import Recording, cut_windows
from simopt_envs.physics.effects import EFFECTS
from simopt_envs.physics.parameters import Parameter, ParameterSpace, Write
from simopt_envs.physics.writer import ModelWriter

pytestmark = needs_effects


_DRAWER = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="drawer">
      <joint name="drawer" type="slide" axis="1 0 0" stiffness="20" damping="1"/>
      <geom size="0.05" mass="1"/>
      <site name="handle" pos="0.1 0 0"/>
    </body>
  </worldbody>
  <actuator><motor name="drawer" joint="drawer"/></actuator>
</mujoco>
"""
_MASS = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="mass"><joint name="mass" type="slide" axis="1 0 0"/><geom size="0.05" mass="2"/></body>
  </worldbody>
  <actuator><motor name="mass" joint="mass"/></actuator>
</mujoco>
"""
_SOFT = ("backlash", "load_dependent_friction")


_SCENERY = """
<mujoco>
  <worldbody>
    <site name="eye" pos="0 0 2" zaxis="0 0 -1"/>
    <body name="lump" pos="0 0 0.5">
      <freejoint/>
      <geom name="core" size="0.05"/>
      <geom name="shell" type="box" size="0.2 0.1 0.05" pos="0.1 0 0" euler="10 20 30" contype="0" conaffinity="0"/>
    </body>
    <geom name="floor" type="plane" size="1 1 0.1"/>
    <geom name="picture" size="0.1" pos="0 0 1" contype="0" conaffinity="0"/>
  </worldbody>
  {}
</mujoco>
"""


@pytest.fixture(scope="module")
def arm():
    """Plain parameters, windows and motion of an arm with strong dry friction in its shoulder."""
    plain = plain_parameters(mujoco.MjSpec.from_string(MODEL))
    recordings = record(lambda q, v: np.array([-4.0 * np.tanh(v[0] / 0.01), 0.0]), np.random.default_rng(0))
    return plain, read_windows(plain.model, recordings, None), motion_of(plain.model, recordings, None)


@pytest.mark.parametrize("name", EFFECTS)
def test_without_any_of_an_effect_every_column_is_as_without_its_structure(arm, name):
    plain, data, motion = arm
    without = Hypothesis(plain, (), motion)
    expected = without.simulator(data.fitted)(without.xi(without.neutral()[None]))
    for place in EFFECTS[name].places(plain.model)[:1]:  # the first joint: those after it move up
        hypothesis = Hypothesis(plain, [Candidate(EFFECTS[name], place)], motion)
        simulated = hypothesis.simulator(data.fitted)(hypothesis.xi(hypothesis.neutral()[None]))
        # A stop that counts as rigid, and the shoes of a brake, give by a little under the load.
        np.testing.assert_allclose(simulated, expected, atol=5e-3 if name in _SOFT else 3e-4)


def test_how_far_an_armature_may_move_does_not_depend_on_what_other_drives_push():
    wrist = '<body><joint name="ball" type="ball"/><geom size="0.1"/></body></worldbody>'
    drive = '<actuator><orientation name="wrist" joint="ball" kp="3"/>'  # three forces, each with its gear
    geared = MODEL.replace('kv="3"', 'kv="3" gear="5"')
    stds = []
    for xml in (geared, geared.replace("</worldbody>", wrist).replace("<actuator>", drive)):
        prior = plain_parameters(mujoco.MjSpec.from_string(xml)).prior
        stds.append(float(prior.std[prior.space.index("armature.elbow")]))
    assert stds[0] == stds[1] == pytest.approx(np.hypot(0.1 * 0.01, 0.002 * (0.2 + 3 * 5**2)))


@pytest.mark.parametrize(("drive", "names"), [("biastype='affine'", ["gain.d", "velocity_gain.d"]), ("", [])])
def test_gains_are_those_of_drives_that_feed_back(drive, names):
    """Other numbers than a feedback's may stand where theirs are, as those of muscles."""
    xml = f"""
    <mujoco>
      <worldbody><body name="b"><joint name="j"/><geom size="0.1"/></body></worldbody>
      <actuator><general name="d" joint="j" gainprm="9" {drive} biasprm="0 -9 -1"/></actuator>
    </mujoco>"""
    spec = mujoco.MjSpec.from_string(xml)
    assert [name for name in plain_parameters(spec).prior.space.names if "gain" in name] == names
    (width,) = EFFECTS["deadband"].parameters(spec.compile(), "actuator:d")
    assert width.unit == ("rad" if names else "")


def test_effects_can_be_tried_where_nothing_moves_or_is_measured():
    finger = '<body><joint name="finger" type="slide" stiffness="1e6"/><geom size="0.01" contype="0"/></body>'
    plain = plain_parameters(mujoco.MjSpec.from_string(MODEL.replace("<site", f"{finger}<site")))
    motion = motion_of(plain.model, record(lambda q, v: np.zeros(2), np.random.default_rng(0)))
    candidates = [Candidate(effect, "joint:finger") for effect in EFFECTS.values()]
    candidates = [c for c in candidates if c.place in c.effect.places(plain.model)]
    assert len(candidates) > 9
    for candidate in candidates:
        assert np.isfinite(Hypothesis(plain, [candidate], motion).probes(candidate)).all(), candidate


@pytest.mark.parametrize(("name", "value"), [("joint_elasticity", 60.0), ("backlash", 0.03)])
def test_a_link_starts_where_it_rests_under_its_load(name, value):
    plain = plain_parameters(mujoco.MjSpec.from_string(MODEL))
    candidate = Candidate(EFFECTS[name], "joint:shoulder")
    steady = _at_rest(plain.spec, candidate, value)
    data, motion = read_windows(plain.model, steady, None), motion_of(plain.model, steady, None)
    hypothesis = Hypothesis(plain, [candidate], motion)
    xi = hypothesis.space.nominal.copy()
    xi[hypothesis.columns[candidate]] = value
    simulated = hypothesis.simulator(data.fitted)(xi[None])[0]
    rest, stiff = (np.abs(s - data.fitted.measured).max() for s in (simulated, _rigid(plain, data, motion)))
    assert rest < 3e-4
    assert stiff > 20 * rest  # a link that did not give would show its tip elsewhere


@pytest.mark.parametrize("name", ["joint_elasticity", "backlash", "load_dependent_friction"])
def test_a_joint_that_an_effect_adds_starts_as_exactly_as_the_one_that_it_is_added_to(arm, name):
    plain, data, motion = arm
    hypothesis = Hypothesis(plain, [Candidate(EFFECTS[name], "joint:shoulder")], motion)
    given, starts = data.fitted.starts, hypothesis.simulator(data.fitted).windows.starts
    shoulder, elbow = (hypothesis.model.joint(joint).dofadr[0] for joint in ("shoulder", "elbow"))
    (new,) = set(range(hypothesis.model.nv)) - {shoulder, elbow}
    for of_all, of_given in ((starts.qpos_error, given.qpos_error), (starts.qvel_error, given.qvel_error)):
        np.testing.assert_array_equal(of_all[:, [shoulder, elbow, new]], of_given[:, [0, 1, 0]])


def test_a_drawer_without_an_encoder_starts_where_its_handle_shows_it():
    plain = plain_parameters(mujoco.MjSpec.from_string(_DRAWER))
    candidate, offset = Candidate(EFFECTS["frame_offset"], "site:handle"), 0.01
    measured = _of_drawer(plain.model, offset)
    windows = cut_windows(plain.model, measured, 0.5, history=0.2)
    hypothesis = Hypothesis(plain, [candidate], motion_of(plain.model, [measured]))
    xi = np.tile(hypothesis.space.nominal, (2, 1))
    xi[1, hypothesis.space.index(candidate.full_name("x"))] = offset
    simulate = hypothesis.simulator(windows)
    without, within = np.abs(simulate(xi) - windows.measured).max(axis=(1, 2, 3))
    assert within < 1e-3  # its spring pulls from where it is, not from where its handle seems to be
    assert without > 10 * within
    pushed = replace(windows.starts, qpos=windows.starts.qpos + 0.005)  # as by whoever asks what starts do
    moved = simulate(xi[1:], pushed)[0, :, 0, 0] - windows.measured[:, 0, 0]
    np.testing.assert_allclose(moved, 0.005, atol=1e-3)
    several = hypothesis.xi(np.array([[0.0] * len(xi[0]), [1.0] + [0.0] * (len(xi[0]) - 1), [0.5] * len(xi[0])]))
    several = np.concatenate([several, xi])
    np.testing.assert_array_equal(simulate(several), np.concatenate([simulate(one[None]) for one in several]))


def test_a_large_effect_is_tried_at_about_its_size(arm):
    plain, data, motion = arm
    candidate = Candidate(EFFECTS["coulomb_friction"], "joint:shoulder")
    hypothesis = Hypothesis(plain, [candidate], motion)
    misfit = Misfit(hypothesis, data.fitted)
    (found,) = of_some_size(misfit, candidate, hypothesis.neutral())
    (friction,) = hypothesis.values(candidate, hypothesis.xi(found[None])[0]).values()
    assert friction == pytest.approx(4.0, rel=0.2)


def test_differences_in_an_amount_are_no_larger_than_it_or_its_smallest_probe(arm):
    plain, _, motion = arm
    loose = Candidate(EFFECTS["backlash"], "joint:elbow")
    hypothesis = Hypothesis(plain, [loose], motion)
    (play,) = hypothesis.columns[loose]
    probes = np.sort(hypothesis.probes(loose)[:, play])
    for amount, reach in (
        (0.0, probes[0]),
        (0.3 * probes[0], probes[0]),
        (probes[1], probes[1]),
        (9 * probes[-1], 1.0),
    ):
        u = hypothesis.neutral()
        u[play] = amount
        assert hypothesis.reach(u)[play] == pytest.approx(reach)
        assert np.all(np.delete(hypothesis.reach(u), play) == 1.0)
    assert probes[0] < 0.02 * probes[-1] == pytest.approx(0.02)


def test_a_fit_counts_a_spring_in_a_joint_by_how_much_it_gives(arm):
    """In which its law is linear: half a probe is a spring of twice the stiffness, and none of it is rigid."""
    plain, _, motion = arm
    soft = Candidate(EFFECTS["joint_elasticity"], "joint:elbow")
    hypothesis = Hypothesis(plain, [soft], motion)
    (column,) = hypothesis.columns[soft]
    neutral, probe = hypothesis.neutral(), hypothesis.probes(soft)[-1]
    rigid, half, whole = hypothesis.xi(np.array([neutral, (neutral + probe) / 2, probe]))[:, column]
    assert rigid == hypothesis.space.high[column] == hypothesis.space.nominal[column]
    assert half == pytest.approx(2 * whole, rel=1e-3)
    assert hypothesis.low[column] <= neutral[column] + 1e-9 < probe[column] < hypothesis.high[column]
    np.testing.assert_allclose(hypothesis.coordinates(hypothesis.xi(probe[None]))[0], probe, atol=1e-9)
    assert hypothesis.xi((neutral - 1.0)[None])[0, column] == rigid


@pytest.mark.parametrize("name", ["sensor_bias", "sensor_delay", "sensor_scale"])
def test_a_joint_a_sensor_and_a_site_may_have_one_name(name):
    sensor = "<sensor><framepos name='elbow' objtype='site' objname='elbow'/></sensor>"
    spec = mujoco.MjSpec.from_string(MODEL.replace("tip", "elbow").replace("</mujoco>", sensor + "</mujoco>"))
    plain = plain_parameters(spec)
    candidates = [Candidate(EFFECTS[name], p) for p in EFFECTS[name].places(plain.model) if p.endswith(":elbow")]
    rng = np.random.default_rng(0)
    hypothesis = Hypothesis(plain, candidates, motion_of(plain.model, record(lambda q, v: np.zeros(2), rng)))
    assert len(candidates) >= 2
    assert set(map(len, hypothesis.columns.values())) == {len(c.parameters(plain.model)) for c in candidates}


def test_a_prior_with_correlations_holds_a_fit_to_them(arm):
    """Of two parameters that go together in p(ξ), the data pull one; the other goes with it."""
    plain, motion, _ = arm
    names = ["mass.upper", "mass.lower"]
    near = plain.prior.marginal(names)
    covariance = near.covariance * np.array([[1, 0.99], [0.99, 1]])
    alike = Plain.of(plain.spec, Gaussian(near.space, near.mean, covariance))
    hypothesis = Hypothesis(alike, (), motion)
    xi = np.tile(hypothesis.space.nominal, (3, 1))
    xi[1, :2], xi[2, :2] = (1.2, 1.2), (1.2, 1 / 1.2)
    u = hypothesis.coordinates(xi)
    np.testing.assert_allclose(hypothesis.xi(u), xi)
    off = np.log(1.2) / near.std[0]
    np.testing.assert_allclose(hypothesis.off(u)[1:, :2], [[off, off], [off, -off]])
    penalty = np.sum(u[:, :2] ** 2, axis=1)
    precision = np.linalg.inv(covariance)
    log = np.log(xi[:, :2])
    np.testing.assert_allclose(penalty, np.einsum("ni,ij,nj->n", log, precision, log), atol=1e-9)
    free = Hypothesis(Plain.of(plain.spec, near), (), motion)
    np.testing.assert_array_equal(free.off(u), u)
    assert np.all(np.abs(hypothesis.low[:2]) == FARTHEST)


def test_a_plain_parameter_goes_no_farther_than_its_prior_has_it_and_an_effect_is_free(arm):
    plain, _, motion = arm
    hypothesis = Hypothesis(plain, [Candidate(EFFECTS["viscous_friction"], "joint:elbow")], motion)
    everything = np.clip(np.full(len(hypothesis.space), 99.0), hypothesis.low, hypothesis.high)
    xi = dict(zip(hypothesis.space.names, hypothesis.xi(everything[None])[0], strict=True))
    assert xi["damping.elbow"] == pytest.approx(np.exp(0.1 * FARTHEST))
    assert everything[hypothesis.num_plain] == 99.0


def test_a_mass_pushed_by_held_forces_is_where_an_exact_integrator_has_it():
    """MuJoCo's is ahead by half a step; what is left of that once it is taken away must not go with acceleration."""
    plain, period = plain_parameters(mujoco.MjSpec.from_string(_MASS)), 0.004
    time = period * np.arange(500)
    pushed = 10.0 * np.sin(12.0 * time)  # m/s2
    velocity = period * np.concatenate([[0.0], np.cumsum(pushed)[:-1]])
    position = np.concatenate([[0.0], np.cumsum(period * velocity + 0.5 * period**2 * pushed)[:-1]])
    measured = Recording(time, {"ctrl/mass": 2.0 * pushed, "qpos/mass": position, "qvel/mass": velocity}, "pushed")
    windows = cut_windows(plain.model, measured, 0.5, history=0.2)
    hypothesis = Hypothesis(plain, (), motion_of(plain.model, [measured]))
    xi = np.array([hypothesis.space.values({"integration_lead": lead}) for lead in (0.0, 0.001)])
    first = np.round(windows.start_time / period).astype(int)
    exact = replace(windows.starts, qpos=position[first, None], qvel=velocity[first, None])
    errors = hypothesis.simulator(windows)(xi, exact) - windows.measured
    ahead, right = np.abs(errors[..., 0]).max(axis=(1, 2))
    assert right < 1e-6 < 1e-3 * ahead  # to first order in the lead, 1e-5 would be left


def _of_drawer(model: mujoco.MjModel, offset: float) -> Recording:
    """Its handle, which is elsewhere, as the spring of the drawer swings it."""
    data, seen = mujoco.MjData(model), []
    data.qpos[:] = 0.2
    for _ in range(210):
        mujoco.mj_step(model, data, 5)
        seen.append(data.qpos[0] + 0.1 + offset)
    columns = {"ctrl/drawer": np.zeros(210), "site/handle/x": np.array(seen)}
    return Recording(0.01 * np.arange(210), columns, "swinging")


def _rigid(plain, data, motion):
    hypothesis = Hypothesis(plain, (), motion)
    return hypothesis.simulator(data.fitted)(hypothesis.space.nominal[None])[0]


def _at_rest(spec: mujoco.MjSpec, candidate: Candidate, value: float) -> list[Recording]:
    """Recordings of the arm held still, with the effect."""
    spec = spec.copy()
    candidate.effect.add(spec, candidate.place)
    model = spec.compile()
    (parameter,) = candidate.effect.parameters(model, candidate.place)
    data = mujoco.MjData(model)
    ModelWriter(model, ParameterSpace([parameter])).write_model(np.array([value]), model, data)
    recordings = []
    for number, posture in enumerate([[0.2, 0.1], [-0.3, 0.4]]):
        mujoco.mj_resetData(model, data)
        data.ctrl[:] = posture
        for _ in range(5000):
            mujoco.mj_step(model, data)
        time = np.arange(60) * 0.02
        columns = {f"ctrl/{j}": posture[i] for i, j in enumerate(("shoulder", "elbow"))}
        columns |= {f"qpos/{j}": data.joint(j).qpos[0] for j in ("shoulder", "elbow")}
        columns |= {f"site/tip/{a}": data.site("tip").xpos[i] for i, a in enumerate("xyz")}
        recordings.append(Recording(time, {k: np.full(60, v) for k, v in columns.items()}, f"still_{number}"))
    return recordings


def test_a_cogging_of_negative_amplitude_is_the_same_as_people_write_it(arm):
    plain, data, motion = arm
    candidate = Candidate(EFFECTS["cogging"], "joint:elbow")
    hypothesis = Hypothesis(plain, [candidate], motion)
    xi = hypothesis.space.nominal.copy()
    xi[hypothesis.columns[candidate]] = -0.5, 7.0, -0.4
    u = hypothesis.coordinates(xi)
    usual = hypothesis.usual(u)
    values = hypothesis.values(candidate, hypothesis.xi(usual[None])[0])
    assert values == pytest.approx({"amplitude": 0.5, "periods": 7.0, "phase": np.pi - 0.4})
    np.testing.assert_array_equal(usual[: hypothesis.num_plain], u[: hypothesis.num_plain])
    np.testing.assert_array_equal(hypothesis.usual(usual), usual)
    given, written = hypothesis.simulator(data.fitted)(hypothesis.xi(np.array([u, usual])))
    np.testing.assert_allclose(given, written, atol=1e-9)


def _simulated(model):
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 300)  # it falls, and tumbles on the floor
    return data.qpos


@pytest.mark.parametrize("settings", ["", '<compiler inertiafromgeom="true"/>'])
def test_what_is_only_seen_is_not_simulated_and_nothing_moves_otherwise(settings):
    spec = mujoco.MjSpec.from_string(_SCENERY.format(settings))
    plain = plain_parameters(spec)
    lean = plain.compiled(plain.spec)
    assert [lean.geom(i).name for i in range(lean.ngeom)] == ["floor", "core"]
    np.testing.assert_array_equal(_simulated(lean), _simulated(spec.compile()))
    assert plain.spec.geom("shell") is not None  # the repaired model has it


def test_what_is_only_seen_stays_where_it_matters():
    spec = mujoco.MjSpec.from_string(_SCENERY.format(""))
    size = Parameter("shell", "1", 1.0, 0.5, 2.0, "log", (Write("geom_size", "shell", (0,), "scale"),))
    assert Plain.of(spec, Gaussian.around_nominal(ParameterSpace([size]), [0.1])).compiled(spec).ngeom == 4
    spec = mujoco.MjSpec.from_string(_SCENERY.format('<sensor><rangefinder name="eye" site="eye"/></sensor>'))
    assert plain_parameters(spec).compiled(spec).ngeom == 4
