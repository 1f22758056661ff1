"""Parameter, ParameterSpace and ModelWriter."""

from functools import partial

import mujoco
import numpy as np
import pytest
from conftest import needs_effects

from simopt_envs.physics import ModelWriter, Parameter, ParameterSpace, Write
from simopt_envs.physics.simulation import BatchSimulation, SingleSimulation

XML = """
<mujoco>
  <option gravity="0 0 -9.81"/>
  <custom><numeric name="gain" data="1 2 3"/></custom>
  <worldbody>
    <body name="cart" pos="1 0 0">
      <joint name="slide" type="slide" axis="1 0 0" damping="2" frictionloss="0.5"/>
      <geom size="0.1" contype="0" conaffinity="0" mass="0"/>
      <geom name="box" type="box" size=".1 .1 .1" mass="3"/>
      <body name="pole" pos="0 0 .1">
        <joint name="hinge" axis="0 1 0" damping="0.1"/>
        <geom name="rod" type="capsule" fromto="0 0 0 0 0 .5" size=".02" mass="0.4"/>
      </body>
    </body>
  </worldbody>
  <actuator><position name="servo" joint="slide" kp="10"/></actuator>
</mujoco>
"""

SPACE = ParameterSpace(
    [
        Parameter("damping", "N s/m", 2.0, 0.1, 50.0, writes=(Write("dof_damping", "slide"),)),
        Parameter(
            "pole_mass",
            "kg",
            0.4,
            0.04,
            4.0,
            writes=(Write("body_mass", "pole", operation="scale"), Write("body_inertia", "pole", operation="scale")),
        ),
        Parameter("offset", "m", 0.0, -0.3, 0.3, "linear", (Write("body_pos", "cart", (0,), "add"),)),
        Parameter(
            "servo_gain",
            "1",
            1.0,
            0.1,
            10.0,
            writes=(
                Write("actuator_gainprm", "servo", (0,), "scale"),
                Write("actuator_biasprm", "servo", (1,), "scale"),
            ),
        ),
        Parameter("gain_2", "1", 2.0, 0.1, 10.0, writes=(Write("numeric_data", "gain", (1,)),)),
        Parameter("gravity", "m/s^2", -9.81, -20.0, 0.0, "linear", (Write("opt.gravity", index=(2,)),)),
    ]
)


def compiled():
    model = mujoco.MjModel.from_xml_string(XML)
    return model, mujoco.MjData(model)


def all_fields(model):
    fields = {f: np.array(getattr(model, f)) for f in dir(model) if isinstance(getattr(model, f, None), np.ndarray)}
    return fields | {"opt.gravity": np.array(model.opt.gravity)}


def test_space_describes_itself():
    assert SPACE.names[:2] == ("damping", "pole_mass")
    assert SPACE.units[1] == "kg"
    np.testing.assert_array_equal(SPACE.nominal, [2.0, 0.4, 0.0, 1.0, 2.0, -9.81])
    assert SPACE.subset(["offset", "damping"]).names == ("offset", "damping")
    assert "offset = 0 m in [-0.3, 0.3]" in repr(SPACE)


def test_coordinates_are_log_for_scales_and_identity_for_offsets():
    rng = np.random.default_rng(0)
    x = rng.uniform(SPACE.low, SPACE.high, (50, len(SPACE)))
    z = SPACE.to_unconstrained(x)
    np.testing.assert_allclose(z[:, 0], np.log(x[:, 0]), rtol=1e-15)
    np.testing.assert_array_equal(z[:, 2], x[:, 2])
    np.testing.assert_allclose(SPACE.from_unconstrained(z), x, rtol=1e-14)


@pytest.mark.parametrize(
    ("named", "message"),
    [
        ({"dampin": 1.0}, "unknown parameter 'dampin'; did you mean 'damping'"),
        ({"damping": np.nan}, "'damping' is not finite"),
        ({"offset": 0.31}, "'offset' is out of bounds: got 0.31 m, expected -0.3 to 0.3"),
        ({"offset": [0.0, 0.1]}, "'offset': got shape"),
    ],
)
def test_bad_values_are_named(named, message):
    with pytest.raises(ValueError, match=message.replace("(", r"\(")):
        SPACE.values(named)


def test_an_infinite_bound_allows_no_infinite_value():
    space = ParameterSpace([Parameter("stiffness", "N/m", 1.0, 0.0, np.inf, "linear")])
    with pytest.raises(ValueError, match="'stiffness' is not finite"):
        space.values({"stiffness": np.inf})


@pytest.mark.parametrize(
    "wrong",
    [
        dict(name="a", unit="", nominal=2.0, low=0.1, high=1.0),
        dict(name="a", unit="", nominal=0.0, low=0.0, high=1.0),
        dict(name="a", unit="", nominal=1.0, low=0.1, high=2.0, coordinate="square"),
    ],
)
def test_contradictory_parameters_are_refused(wrong):
    with pytest.raises(ValueError, match="parameter 'a'"):
        Parameter(**wrong)


def test_names_are_unique():
    with pytest.raises(ValueError, match="damping given more than once"):
        ParameterSpace([SPACE["damping"], SPACE["damping"]])


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (Write("dof_dampin", "slide"), "did you mean 'dof_damping'"),
        (Write("dof_damping", "slid"), "unknown joint 'slid'; did you mean 'slide'"),
        (Write("geom_size", "bix"), "Valid names: box, rod"),
        (Write("dof_damping"), "needs the name of the object"),
        (Write("body_pos", "cart", (3,)), "index"),
        (Write("opt.gravity", index=(3,)), "opt.gravity has 3 columns, index"),
    ],
)
def test_writes_to_places_that_do_not_exist_are_refused(write, message):
    model, _ = compiled()
    with pytest.raises(ValueError, match=message):
        ModelWriter(model, ParameterSpace([Parameter("p", "1", 1.0, 0.1, 2.0, writes=(write,))]))


EXPECTED = {  # what doubling (or, for the linear ones, shifting) a parameter changes
    "damping": {"dof_damping"},
    "pole_mass": {"body_mass", "body_inertia"},
    "offset": {"body_pos"},
    "servo_gain": {"actuator_gainprm", "actuator_biasprm"},
    "gain_2": {"numeric_data"},
    "gravity": {"opt.gravity"},
}
DERIVED = {"body_subtreemass", "dof_invweight0", "body_invweight0", "actuator_acc0", "dof_M0", "tendon_invweight0"}
DERIVED |= {"cam_pos0", "light_pos0", "cam_poscom0", "light_poscom0"}


@pytest.mark.parametrize("name", SPACE.names)
def test_each_parameter_changes_its_fields_and_only_those(name):
    model, data = compiled()
    writer = ModelWriter(model, SPACE)
    before = all_fields(model)
    value = SPACE[name].nominal + 0.1 if SPACE[name].coordinate == "linear" else 2 * SPACE[name].nominal
    writer.write_model(SPACE.values({name: value}), model, data)
    changed = {f for f, v in all_fields(model).items() if not np.array_equal(v, before[f])}
    assert changed - DERIVED == EXPECTED[name]


def test_nominal_is_restored_exactly_and_nothing_accumulates():
    model, data = compiled()
    mujoco.mj_setConst(model, data)
    writer = ModelWriter(model, SPACE)
    before = all_fields(model)
    rng = np.random.default_rng(1)
    for _ in range(20):
        writer.write_model(rng.uniform(SPACE.low, SPACE.high), model, data)
    writer.write_model(SPACE.nominal, model, data)
    for field, value in all_fields(model).items():
        np.testing.assert_array_equal(value, before[field], err_msg=field)


def test_mass_keeps_what_is_derived_from_it_right():
    model, data = compiled()
    ModelWriter(model, SPACE).write_model(SPACE.values({"pole_mass": 0.8}), model, data)
    truth = mujoco.MjModel.from_xml_string(XML.replace('mass="0.4"', 'mass="0.8"'))
    for field in ("body_mass", "body_inertia", "body_subtreemass", "dof_invweight0", "body_invweight0", "dof_M0"):
        np.testing.assert_allclose(getattr(model, field), getattr(truth, field), rtol=1e-12, err_msg=field)


def test_operations_on_one_place_compose_from_the_nominal():
    model, data = compiled()
    space = ParameterSpace(
        [
            Parameter("shift", "kg", 0.0, -1.0, 1.0, "linear", (Write("body_mass", "cart", operation="add"),)),
            Parameter("width", "m", 0.2, 0.1, 1.0, writes=(Write("body_mass", "cart", operation="scale", power=2),)),
            Parameter("density", "1", 1.0, 0.1, 5.0, writes=(Write("body_mass", "cart", operation="scale"),)),
        ]
    )
    ModelWriter(model, space).write_model(np.array([0.5, 0.4, 3.0]), model, data)
    assert model.body("cart").mass[0] == pytest.approx(3.0 * (0.4 / 0.2) ** 2 * 3.0 + 0.5, rel=1e-12)


@needs_effects
def test_fields_of_actuators_with_several_commands_and_outputs_are_written_where_they_are():
    before = '<actuator><orientation name="wrist" joint="ball" kp="3"/>'
    ball = '<body><joint name="ball" type="ball"/><geom size="0.1"/></body></worldbody>'
    servo = 'kp="10" gear="2" ctrlrange="-1 1" forcerange="-3 3"'
    xml = XML.replace("</worldbody>", ball).replace("<actuator>", before).replace('kp="10"', servo)
    model = mujoco.MjModel.from_xml_string(xml)
    assert (model.nu, model.nactuator) == (4, 2)
    fields = ("actuator_gear", "actuator_ctrlrange", "actuator_forcerange")
    for field in fields:
        write = Write(field, "servo", operation="scale")
        space = ParameterSpace([Parameter("twice", "1", 1.0, 0.1, 2.0, writes=(write,))])
        ModelWriter(model, space).write_model(np.array([2.0]), model, mujoco.MjData(model))
    truth = mujoco.MjModel.from_xml_string(xml.replace(servo, 'kp="10" gear="4" ctrlrange="-2 2" forcerange="-6 6"'))
    for field in fields:
        np.testing.assert_array_equal(getattr(model, field), getattr(truth, field), err_msg=field)


@needs_effects
def test_delayed_drives_of_several_commands_start_from_their_first_ones():
    """As if they had always held: as without the delays."""
    pid = '<actuator><pid name="rod" joint="hinge" kp="5" kv="1" delay="0.01" nsample="8"/>'
    late = XML.replace("<actuator>", pid).replace('kp="10"', 'kp="10" delay="0.01" nsample="8"')
    ends, command = [], np.array([[0.2, -0.1, 0.4]])
    for xml in (late, late.replace('delay="0.01" nsample="8"', "")):
        model = mujoco.MjModel.from_xml_string(xml)
        for engine in (SingleSimulation, partial(BatchSimulation, num_worlds=1)):
            simulation = engine(model, ParameterSpace(()))
            simulation.reset(np.array([0]), np.zeros((1, 2)), np.zeros((1, 2)), command)
            simulation.step(command, 10)
            ends.append(simulation.data("qpos")[0].copy())
    assert np.abs(ends[0]).min() > 5e-5
    np.testing.assert_allclose(ends, [ends[0]] * 4, rtol=1e-12)


def test_two_setters_of_one_place_are_refused():
    model, _ = compiled()
    twice = [Parameter(n, "1", 1.0, 0.1, 2.0, writes=(Write("dof_damping", "slide"),)) for n in ("a", "b")]
    with pytest.raises(ValueError, match="several parameters set the same element of dof_damping"):
        ModelWriter(model, ParameterSpace(twice))


def test_an_added_value_is_multiplied_by_its_factor():
    model, data = compiled()
    add = Write("body_mass", "cart", operation="add", factor=-2.0)
    space = ParameterSpace([Parameter("less", "kg", 0.0, 0.0, 1.0, "linear", (add,))])
    ModelWriter(model, space).write_model(np.array([0.5]), model, data)
    assert model.body("cart").mass[0] == pytest.approx(2.0, rel=1e-12)
