"""Values written to a spec: it compiles, also from its MJCF, to what a ModelWriter makes of the model."""

import ctypes
import difflib
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from conftest import needs_effects

import simopt_envs  # noqa: F401 - registers the environments
from simopt_envs.physics import ModelWriter, Parameter, ParameterSpace, Write
from simopt_envs.physics.columns import acts_on_columns
from simopt_envs.physics.effects import EFFECTS, Motion
from simopt_envs.physics.spec_writer import keep_inertias, write_spec
from simopt_envs.physics.writer import field_elements, model_field

pytestmark = needs_effects


XML = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <geom name="floor" type="plane" size="3 3 .1" pos="0 0 -.3" friction="0.8"/>
    <body name="upper" pos="0 0 .2">
      <joint name="shoulder" axis="0 1 0" damping="0.1" range="-1.5 1.5"/>
      <geom name="upper" type="box" size=".15 .02 .02" pos=".15 0 0" mass="0.8"/>
      <body name="lower" pos=".3 0 0">
        <joint name="elbow" axis="0 1 0" damping="0.05" ref="0.2" springref="0.3" stiffness="0.5"/>
        <geom name="lower" type="box" size=".1 .02 .02" pos=".1 0 0" mass="0.4"/>
        <site name="tip" pos=".25 0 .01"/>
      </body>
    </body>
    <body name="cart" pos="0 1 -.25">
      <joint name="carriage" type="slide" axis="1 .5 0" damping="1"/>
      <joint name="settle" type="slide" axis="0 0 1"/>
      <geom name="cart" type="box" size=".05 .05 .05" mass="0.5" friction="0.3"/>
    </body>
  </worldbody>
  <actuator>
    <position name="shoulder" joint="shoulder" kp="40" kv="2"/>
    <position name="elbow" joint="elbow" kp="15" kv="0.6"/>
    <motor name="drive" joint="carriage" gear="5"/>
  </actuator>
  <sensor><jointvel name="rate" joint="elbow"/></sensor>
</mujoco>
"""


def rollout(model):
    data, out = mujoco.MjData(model), []
    for i in range(300):
        data.ctrl[:] = np.sin(0.012 * i + np.arange(model.nu))
        mujoco.mj_step(model, data)
        out.append(np.concatenate([data.qpos, data.qvel, data.site("tip").xpos, data.sensordata]))
    return np.array(out)


def written_model(model, space, xi):
    ModelWriter(model, space).write_model(xi, model, mujoco.MjData(model))
    return model


def space_of(*parameters):
    return ParameterSpace(p for p in parameters if not acts_on_columns(p))


@contextmanager
def all_digits():
    """MuJoCo saves six digits of a number; what the structure keeps shows with all of them."""
    folder = Path(mujoco.__file__).parent
    library = ctypes.CDLL(str(next(folder.glob("libmujoco.*"))))
    library._mjPRIVATE__set_xml_precision(17)
    yield
    library._mjPRIVATE__set_xml_precision(6)


@pytest.mark.parametrize("effect", EFFECTS.values(), ids=EFFECTS)
def test_every_effect_survives_a_spec_and_its_mjcf(effect):
    model = mujoco.MjModel.from_xml_string(XML)
    motion = Motion(*np.array([-0.4, 0.5, 1.5, 3.0])[:, None] * np.ones(model.nv), np.ones(model.nu))
    place = effect.places(model)[0]
    spec = mujoco.MjSpec.from_string(XML)
    effect.add(spec, place)
    structured = spec.compile()
    space = space_of(*effect.parameters(structured, place))
    probe = effect.probes(structured, place, motion)[0]
    xi = space.values({name: value for name, value in probe.items() if name in space})
    before = rollout(structured)
    write_spec(spec, structured, space, xi)
    truth = rollout(written_model(structured, space, xi))
    np.testing.assert_allclose(rollout(spec.compile()), truth, rtol=0, atol=1e-9)
    with all_digits():
        saved = spec.to_xml()
    np.testing.assert_allclose(rollout(mujoco.MjModel.from_xml_string(saved)), truth, rtol=0, atol=1e-9)
    assert np.any(truth != before) == bool(len(space))


def changed(old, new):
    """Lines that were added to the MJCF of one spec by another."""
    lines = difflib.ndiff(old.to_xml().splitlines(), new.to_xml().splitlines())
    return [line[2:].strip() for line in lines if line.startswith("+ ")]


def test_only_what_differs_is_written():
    specs = [mujoco.MjSpec.from_string(XML) for _ in range(4)]
    given, frictional, damped, nominal = specs
    model, *_ = (spec.compile() for spec in specs)
    space = ParameterSpace(
        [
            Parameter("a", "N m", 0.0, 0.0, 1.0, "linear", (Write("dof_frictionloss", "elbow", operation="add"),)),
            Parameter("b", "1", 1.0, 0.1, 9.0, "log", (Write("dof_damping", "carriage", operation="scale"),)),
            Parameter("c", "1", 1.0, 0.1, 9.0, "log", (Write("body_mass", "lower", operation="scale"),)),
        ]
    )
    write_spec(frictional, model, space, [0.2, 1.0, 1.0])
    (line,) = changed(given, frictional)
    assert 'frictionloss="0.2"' in line
    write_spec(damped, model, space, [0.0, 3.0, 1.0])
    (line,) = changed(given, damped)
    assert 'damping="3"' in line
    write_spec(nominal, model, space, space.nominal)
    assert changed(given, nominal) == []


def test_a_body_s_mass_no_longer_comes_from_its_geoms():
    spec, given = mujoco.MjSpec.from_string(XML), mujoco.MjSpec.from_string(XML)
    given.compile()
    model = spec.compile()
    both = tuple(Write(field, "lower", operation="scale") for field in ("body_mass", "body_inertia"))
    space = ParameterSpace(
        [
            Parameter("mass", "1", 1.0, 0.1, 9.0, "log", both),
            Parameter("x", "m", 0.0, -1.0, 1.0, "linear", (Write("body_ipos", "lower", (0,), "add"),)),
        ]
    )
    write_spec(spec, model, space, [1.5, 0.02])
    truth = rollout(written_model(model, space, [1.5, 0.02]))
    np.testing.assert_allclose(rollout(spec.compile()), truth, rtol=0, atol=1e-12)
    with all_digits():
        saved = spec.to_xml()
    np.testing.assert_allclose(rollout(mujoco.MjModel.from_xml_string(saved)), truth, rtol=0, atol=1e-9)
    (line,) = changed(given, spec)
    assert line.startswith('<inertial pos="0.12 0 0" mass="0.6"')


IN_DEGREES = """
<mujoco>
  <worldbody>
    <body name="arm">
      <joint name="hinge" axis="0 1 0" ref="10" springref="-20" range="-90 45" stiffness="2"/>
      <geom size=".05 .2 .1" type="box" pos=".1 0 0"/>
      <frame euler="0 0 90" pos="1 0 0">
        <frame quat="0.8 0.6 0 0"><site name="tip" pos=".1 .2 .3" euler="10 20 30"/></frame>
        <site name="rod" type="capsule" fromto="0 0 0 .1 .2 .3" size=".02"/>
      </frame>
      <body name="slider"><joint name="slide" type="slide" ref="0.1" range="-1 1"/><geom size=".1"/></body>
    </body>
    <body><joint name="ball" type="ball" range="0 60"/><geom size=".1"/></body>
  </worldbody>
  <actuator>
    <position joint="hinge" kp="100" inheritrange="1"/>
    <position name="servo" joint="hinge" kp="100" inheritrange="1"/>
  </actuator>
</mujoco>
"""


def test_degrees_frames_and_inherited_ranges():
    spec = mujoco.MjSpec.from_string(IN_DEGREES)
    model = spec.compile()
    commanded = model.actuator_ctrlrange.copy()
    parameters = [
        *EFFECTS["sensor_bias"].parameters(model, "joint:hinge"),
        *EFFECTS["frame_offset"].parameters(model, "site:tip"),
        Parameter("rod", "m", 0.0, -1.0, 1.0, "linear", (Write("site_pos", "rod", (0,), "add"),)),
        Parameter("cone", "rad", 0.0, -1.0, 1.0, "linear", (Write("jnt_range", "ball", (1,), "add"),)),
    ]
    slide = EFFECTS["sensor_bias"].parameters(model, "joint:slide")[0]
    space = ParameterSpace([*parameters, Parameter("s", "m", 0.0, -1.0, 1.0, "linear", slide.writes)])
    xi = np.array([0.1, 0.01, 0.02, 0.03, 0.04, 0.2, 0.05])
    write_spec(spec, model, space, xi)
    compiled, truth = spec.compile(), written_model(model, space, xi)
    for field in ("qpos0", "qpos_spring", "jnt_range", "site_pos", "site_quat"):
        np.testing.assert_allclose(getattr(compiled, field), getattr(truth, field), rtol=0, atol=1e-12, err_msg=field)
    np.testing.assert_array_equal(compiled.actuator_ctrlrange, commanded)
    np.testing.assert_allclose(compiled.jnt_range[0], np.radians([-90, 45]) + 0.1)


@pytest.mark.parametrize("name", ["Drawer", "SwingPeg"])
def test_a_spec_holds_all_parameters_of_the_environments(name):
    task = gym.make(f"SimOpt/{name}-v0").unwrapped.task
    spec = task.make_spec()
    space = task.parameters.subset([n for n in task.parameters.names if n != "rope_bending_damping"])
    z = space.to_unconstrained(space.nominal) + np.random.default_rng(0).uniform(-0.05, 0.05, len(space))
    xi = np.clip(space.from_unconstrained(z), space.low, space.high)
    model = spec.compile()
    write_spec(spec, model, space, xi)
    compiled, truth = spec.compile(), written_model(model, space, xi)
    for write in (write for parameter in space for write in parameter.writes):
        row = field_elements(model, replace(write, index=None))
        kept, meant = (model_field(m, write.field).ravel()[row] for m in (compiled, truth))
        np.testing.assert_allclose(kept, meant, rtol=1e-9, atol=1e-12, err_msg=str(write))


def test_a_field_that_a_spec_cannot_hold_is_named_and_nothing_is_written():
    spec = mujoco.MjSpec.from_string(XML)
    model = spec.compile()
    space = ParameterSpace(
        [
            Parameter("a", "N m", 0.0, 0.0, 1.0, "linear", (Write("dof_frictionloss", "elbow", operation="add"),)),
            Parameter("b", "1", 1.0, 0.1, 9.0, "log", (Write("dof_invweight0", "elbow", operation="scale"),)),
        ]
    )
    with pytest.raises(ValueError, match="unknown model field that a spec can hold 'dof_invweight0'"):
        write_spec(spec, model, space, [0.2, 2.0])
    assert spec.joint("elbow").frictionloss == 0


MASS = ParameterSpace([Parameter("m", "1", 1.0, 0.1, 9.0, "log", (Write("body_mass", "lower", operation="scale"),))])
INERTIAL = '<body name="lower" pos=".3 0 0"><inertial pos="0 0 0" mass="7" diaginertia="1 1 1"/>'


@pytest.mark.filterwarnings("ignore:compiler attribute .settotalmass")
@pytest.mark.parametrize(
    "compiler",
    [
        'inertiafromgeom="true"',
        'inertiafromgeom="true" settotalmass="14"',
        'boundmass="0.6" boundinertia="0.01"',
        'balanceinertia="true"',
    ],
)
def test_a_compiler_that_infers_or_changes_masses_keeps_what_is_written(compiler):
    """As those of most of Gymnasium's own models do; nothing else of the model changes."""
    given = XML.replace('angle="radian"', f'angle="radian" {compiler}')
    spec = mujoco.MjSpec.from_string(given.replace('<body name="lower" pos=".3 0 0">', INERTIAL))
    model = spec.compile()
    keep_inertias(spec)
    np.testing.assert_array_equal(rollout(spec.compile()), rollout(model))
    write_spec(spec, model, MASS, [2.0])
    np.testing.assert_allclose(rollout(spec.compile()), rollout(written_model(model, MASS, [2.0])), atol=1e-9)


def test_a_compiler_that_overrides_what_was_written_is_noticed():
    capsule = 'name="lower" type="capsule" size=".02" fromto="0 0 0 .2 0 0"'
    spec = mujoco.MjSpec.from_string(XML.replace('name="lower" type="box" size=".1 .02 .02" pos=".1 0 0"', capsule))
    longer = Parameter("length", "1", 1.0, 0.1, 9.0, "log", (Write("geom_size", "lower", (1,), operation="scale"),))
    with pytest.raises(ValueError, match="overrides what was written to geom_size of lower"):
        write_spec(spec, spec.compile(), ParameterSpace([longer]), [0.5])
