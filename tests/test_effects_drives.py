"""Effects of payloads, gravity, drives, contacts and sensors: neutral, the law, and the same in many worlds."""

import mujoco
import numpy as np
import pytest

from simopt_envs.physics import ModelWriter, Parameter, ParameterSpace, Write
from simopt_envs.physics.columns import acts_on_columns
from simopt_envs.physics.effects import EFFECTS, Motion
from simopt_envs.physics.effects.actuator_saturation import UNLIMITED
from simopt_envs.physics.effects.actuators import command_sources, on_all_parts

Batch = pytest.importorskip("mujoco.batch", reason="effects need MuJoCo >= 3.17").Batch

XML = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <geom name="floor" type="plane" size="3 3 .1" pos="0 0 -.3" friction="0.8"/>
    <body name="base" pos="0 0 .2">
      <body name="upper">
        <joint name="shoulder" axis="0 1 0" damping="0.1" range="-1.5 1.5"/>
        <geom name="upper" type="box" size=".15 .02 .02" pos=".15 0 0" mass="0.8"/>
        <body name="lower" pos=".3 0 0">
          <joint name="elbow" axis="0 1 0" damping="0.05" ref="0.2" springref="0.3" stiffness="0.5" range="-1 1.6"/>
          <geom name="lower" type="box" size=".1 .02 .02" pos=".1 0 0" mass="0.4"/>
          <body name="tool" pos=".2 0 0"><site name="tip" pos=".05 0 .01"/></body>
        </body>
      </body>
    </body>
    <body name="cart" pos="0 1 -.25">
      <joint name="carriage" type="slide" axis="1 .5 0" damping="1"/>
      <joint name="settle" type="slide" axis="0 0 1"/>
      <geom name="cart" type="box" size=".05 .05 .05" mass="0.5" friction="0.3"/>
    </body>
  </worldbody>
  <tendon>
    <fixed name="cable" stiffness="2" springlength="0.1"><joint joint="shoulder" coef="0.5"/><joint joint="elbow" coef="-1"/></fixed>
  </tendon>
  <actuator>
    <position name="shoulder" joint="shoulder" kp="40" kv="2"/>
    <position name="elbow" joint="elbow" kp="15" kv="0.6"/>
    <motor name="drive" joint="carriage" gear="5"/>
  </actuator>
  <sensor><framelinacc name="acceleration" objtype="site" objname="tip"/><jointvel name="rate" joint="elbow"/></sensor>
</mujoco>
"""  # noqa: E501
MINE = (
    *("payload", "gravity_compensation", "base_tilt", "actuator_gain", "actuator_bias", "actuator_saturation"),
    *("deadband", "contact_friction", "sensor_bias", "frame_offset"),
)
PLACES = {
    "payload": "body:lower",
    "gravity_compensation": "body:lower",
    "base_tilt": "body:base",
    "actuator_gain": "actuator:elbow",
    "actuator_bias": "actuator:drive",
    "actuator_saturation": "actuator:elbow",
    "deadband": "actuator:elbow",
    "contact_friction": "geom:cart",
    "sensor_bias": "joint:elbow",
    "frame_offset": "site:tip",
}
STEPS = 400
TIME = 0.002 * np.arange(STEPS)
COMMANDS = np.stack([0.5 * np.sin(4 * TIME), 0.3 + 0.6 * np.sin(6 * TIME), 0.8 * np.cos(5 * TIME)], axis=1)


def plain(xml=XML):
    return mujoco.MjModel.from_xml_string(xml)


def structured(effect, place, xml=XML):
    spec = mujoco.MjSpec.from_string(xml)
    EFFECTS[effect].add(spec, place)
    return spec.compile()


def space_of(effect, place, model):
    return ParameterSpace(EFFECTS[effect].parameters(model, place))


def with_effect(effect, values, place=None, xml=XML):
    place = place or PLACES[effect]
    model = structured(effect, place, xml)
    space = space_of(effect, place, model)
    ModelWriter(model, space).write_model(space.values(values), model, mujoco.MjData(model))
    return model


def rollout(model, commands=COMMANDS, qpos=None):
    """Positions of joints and of the tip, (steps, nq + 3)."""
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0 if qpos is None else qpos
    out = []
    for command in commands:
        data.ctrl[:] = command[command_sources(model)]
        mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)
        out.append(np.concatenate([data.qpos, data.site("tip").xpos]))
    return np.array(out)


def motion():
    """How the plain model moves; none of the effects here adds a joint."""
    model = plain()
    data, velocity, force = mujoco.MjData(model), [], []
    for command in COMMANDS:
        data.ctrl[:] = command
        mujoco.mj_step(model, data)
        velocity.append(data.qvel.copy())
        force.append(data.qfrc_actuator.copy())
    positions = rollout(model)[:, : model.nv]
    speed, force, command = (np.sqrt(np.mean(np.square(a), axis=0)) for a in (velocity, force, COMMANDS))
    return Motion(positions.min(axis=0), positions.max(axis=0), speed, force, command)


def close(a, b, tolerance=1e-9):
    np.testing.assert_allclose(a, b, rtol=0, atol=tolerance)


@pytest.mark.parametrize("effect", MINE)
def test_neutral_is_the_model_as_given_and_a_probe_is_not(effect):
    truth = rollout(plain())
    close(rollout(structured(effect, PLACES[effect])), truth, 1e-10)
    close(rollout(with_effect(effect, {})), truth, 1e-10)
    model = structured(effect, PLACES[effect])
    shown = {}
    for probe in EFFECTS[effect].probes(model, PLACES[effect], motion()):
        difference = np.abs(rollout(with_effect(effect, probe)) - truth).max()
        shown[tuple(probe)] = max(difference, shown.get(tuple(probe), 0.0))
    assert min(shown.values()) > 1e-6


@pytest.mark.parametrize("effect", MINE)
def test_every_place_has_parameters_that_a_probe_moves(effect):
    model = plain()
    assert PLACES[effect] in EFFECTS[effect].places(model)
    for place in EFFECTS[effect].places(model):
        changed = structured(effect, place)
        space = space_of(effect, place, changed)
        writes = [p for p in space if not acts_on_columns(p)]
        ModelWriter(changed, ParameterSpace(writes))
        probes = EFFECTS[effect].probes(changed, place, motion())
        moved = {
            name for probe in probes for name in probe if space.values(probe)[space.index(name)] != space[name].nominal
        }
        assert moved == set(space.names)


@pytest.mark.parametrize("effect", MINE)
def test_many_worlds_are_the_single_one(effect):
    place = PLACES[effect]
    model = structured(effect, place)
    space = space_of(effect, place, model)
    probe = EFFECTS[effect].probes(model, place, motion())[0]
    xi = np.stack([space.nominal, space.values(probe)])
    batch, writer = Batch(model, 2, 1), ModelWriter(model, space)
    fields = {name: batch.expand(name) for name in writer.fields}
    writer.write(xi, fields.__getitem__)
    if writer.needs_set_const:
        batch.set_const()
    batch.reset()
    qpos = batch.bind("qpos")
    qpos[:] = [with_effect(effect, values).qpos0 for values in ({}, probe)]
    positions = []
    for command in COMMANDS[:150]:
        batch.bind("ctrl")[:] = command[command_sources(model)]
        batch.step()
        positions.append(qpos.copy())
    for world, values in enumerate(({}, probe)):
        single = rollout(with_effect(effect, values), COMMANDS[:150])[:, : model.nq]
        close(np.array(positions)[:, world], single, 1e-12)


def test_payload_is_a_mass_at_the_tip():
    heavy = XML.replace(
        '<site name="tip"',
        '<body pos=".05 0 .01"><inertial pos="0 0 0" mass="0.3" diaginertia="0 0 0"/></body><site name="tip"',
    )
    close(rollout(with_effect("payload", {"mass": 0.3})), rollout(plain(heavy)), 1e-12)


def test_payload_without_a_site_is_at_the_centre_of_mass():
    model = with_effect("payload", {"mass": 0.3}, "body:upper")
    np.testing.assert_allclose(model.body("upper.payload").pos, model.body("upper").ipos)
    assert EFFECTS["payload"].places(model)[0] == "body:lower"
    fusing = XML.replace("<compiler", '<compiler fusestatic="true"')
    assert with_effect("payload", {"mass": 0.3}, "body:upper", fusing).body("upper.payload").mass[0] == 0.3


def test_gravity_compensation_cancels_the_subtree():
    """With all of it, the upper arm, the lower arm and what they carry weigh nothing."""
    model = with_effect("gravity_compensation", {"fraction": 1.0}, "body:upper")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    dofs = [model.joint(name).dofadr[0] for name in ("shoulder", "elbow")]
    close(data.qfrc_gravcomp[dofs], data.qfrc_bias[dofs], 1e-12)
    assert abs(data.qfrc_bias[dofs[0]]) > 1
    model = with_effect("gravity_compensation", {"fraction": 0.25})
    mujoco.mj_forward(model, data)
    close(data.qfrc_gravcomp[dofs[1]], 0.25 * data.qfrc_bias[dofs[1]], 1e-12)


def test_base_tilt_turns_gravity():
    for axis, name in enumerate("xy"):
        angle = 0.02
        turned = np.zeros(9)
        mujoco.mju_quat2Mat(turned, np.array([np.cos(angle / 2), *(np.sin(angle / 2) * np.eye(3)[axis])]))
        expected = turned.reshape(3, 3) @ [0, 0, -9.81]
        close(with_effect("base_tilt", {name: angle}).opt.gravity, expected, 9.81 * angle**2)


def test_actuator_gain_scales_the_servo():
    stiff = XML.replace('kp="15" kv="0.6"', 'kp="18" kv="0.72"')
    close(rollout(with_effect("actuator_gain", {"scale": 1.2})), rollout(plain(stiff)), 1e-10)


def test_actuator_bias_is_a_force_behind_the_gear():
    commands = COMMANDS + np.array([0, 0, 2.0 / 5])
    close(rollout(with_effect("actuator_bias", {"force": 2.0})), rollout(plain(), commands), 1e-10)
    commands = COMMANDS + np.array([0, 0.3 / 15, 0])
    close(rollout(with_effect("actuator_bias", {"force": 0.3}, "actuator:elbow")), rollout(plain(), commands), 1e-10)


def test_actuator_bias_does_not_bring_in_a_bias_that_the_model_ignores():
    ignored = XML.replace('<motor name="drive"', '<general biasprm="1 -50 -5" name="drive"')
    close(
        rollout(with_effect("actuator_bias", {"force": 2.0}, xml=ignored)),
        rollout(with_effect("actuator_bias", {"force": 2.0})),
    )


def test_actuator_saturation_clips_behind_the_gear():
    limited = XML.replace('name="drive"', 'name="drive" forcerange="-.4 .4"')
    model = with_effect("actuator_saturation", {"limit": 2.0}, "actuator:drive")
    close(rollout(model), rollout(plain(limited)), 1e-12)
    commands = np.clip(COMMANDS, [-9, -9, -0.4], [9, 9, 0.4])
    close(rollout(model), rollout(plain(), commands), 1e-12)


def test_actuator_saturation_starts_at_the_limit_that_the_model_has():
    limited = XML.replace('name="drive"', 'name="drive" forcerange="-.4 .3"')
    space = space_of(
        "actuator_saturation", "actuator:drive", structured("actuator_saturation", "actuator:drive", limited)
    )
    assert space["limit"].nominal == pytest.approx(2.0)
    model = with_effect("actuator_saturation", {"limit": 1.0}, "actuator:drive", limited)
    np.testing.assert_allclose(model.actuator("drive").forcerange, [-0.2, 0.15])


def test_actuator_saturation_does_not_start_at_a_limit_that_is_not_in_force():
    loose = XML.replace('name="drive"', 'name="drive" forcelimited="false" forcerange="-.1 .1"')
    saturation = structured("actuator_saturation", "actuator:drive", loose)
    assert space_of("actuator_saturation", "actuator:drive", saturation)["limit"].nominal == 5 * UNLIMITED
    limited = [with_effect("actuator_saturation", {"limit": 2.0}, "actuator:drive", xml) for xml in (loose, XML)]
    close(*map(rollout, limited), 1e-12)


def test_small_limits_are_tried_where_a_servo_is_held_back():
    model, still = plain(), np.zeros(4)
    asked = Motion(still - 0.1, still + 0.1, still + 1, still + 40.0, np.zeros(3))  # kp x error, and none of it arrives
    tried = [probe["limit"] for probe in EFFECTS["actuator_saturation"].probes(model, "actuator:elbow", asked)]
    assert min(tried) == pytest.approx(1.2)
    assert max(tried) == pytest.approx(120)


def dead_zone(error, width):
    return np.sign(error) * np.maximum(np.abs(error) - width, 0)


def test_deadband_of_a_motor_is_of_its_command():
    commands = COMMANDS.copy()
    commands[:, 2] = dead_zone(commands[:, 2], 0.3)
    close(rollout(with_effect("deadband", {"width": 0.3}, "actuator:drive")), rollout(plain(), commands), 1e-10)


def test_deadband_of_a_servo_is_of_its_error():
    """The command that makes an ideal servo give the force of one with the dead band."""
    model, width = plain(), 0.1
    data, positions = mujoco.MjData(model), []
    data.qpos[:] = model.qpos0
    elbow = model.joint("elbow").qposadr[0]
    for command in COMMANDS:
        data.ctrl[:] = command
        data.ctrl[1] = data.qpos[elbow] + dead_zone(command[1] - data.qpos[elbow], width)
        mujoco.mj_step(model, data)
        positions.append(data.qpos.copy())
    found = rollout(with_effect("deadband", {"width": width}))[:, : model.nq]
    close(found, positions, 1e-9)
    assert np.abs(found - rollout(model)[:, : model.nq]).max() > 0.03


@pytest.mark.parametrize("limit", [2.0, 1.0])
def test_a_dead_band_leaves_the_limit_that_its_drive_has_or_is_given(limit):
    """The force is clip(k dz(e), -L, L'), and a drive without a limit gets none."""
    spec = mujoco.MjSpec.from_string(XML.replace('kp="15" kv="0.6"', 'kp="15" forcerange="-2 1.5"'))
    for effect in ("actuator_saturation", "deadband"):
        EFFECTS[effect].add(spec, "actuator:elbow")
    model = spec.compile()
    space = ParameterSpace(
        p for e in ("actuator_saturation", "deadband") for p in EFFECTS[e].parameters(model, PLACES[e])
    )
    data = mujoco.MjData(model)
    ModelWriter(model, space).write_model(space.values({"limit": limit, "width": 0.1}), model, data)
    elbow = model.joint("elbow")
    for error in np.linspace(-0.4, 0.4, 33):
        data.ctrl[[1, 3]] = data.qpos[elbow.qposadr[0]] + error
        mujoco.mj_forward(model, data)
        force = np.clip(15 * dead_zone(error, 0.1), -limit, 0.75 * limit)
        assert data.qfrc_actuator[elbow.dofadr[0]] == pytest.approx(force, abs=1e-9)
    writes = [
        w.object
        for p in space_of("deadband", "actuator:elbow", structured("deadband", "actuator:elbow"))
        for w in p.writes
    ]
    assert set(writes) == {"elbow.deadband"}


def test_keyframes_command_both_actuators_of_a_drive_with_a_dead_band():
    keys = '<keyframe><key name="up" ctrl=".1 .6 .2" act=".4 .5"/><key name="rest" qpos="0 .2 0 0"/></keyframe>'
    filtered = XML.replace(' kp="40"', ' kp="40" timeconst=".1"').replace(' kp="15"', ' kp="15" timeconst=".1"')
    spec = mujoco.MjSpec.from_string(filtered.replace("</mujoco>", f"{keys}</mujoco>"))
    for place in ("actuator:elbow", "actuator:drive"):
        EFFECTS["deadband"].add(spec, place)
    for model in (spec.compile(), mujoco.MjModel.from_xml_string(spec.to_xml())):
        close(model.key_ctrl, [[0.1, 0.6, 0.2, 0.6, 0.2], [0] * 5])
        close(model.key_act, [[0.4, 0.5, 0.5], [0] * 3])


def test_a_drive_without_a_gain_is_no_place_for_a_dead_band():
    idle = '<general name="drive" joint="carriage" gainprm="0" biastype="affine" biasprm="0 -10 0"/>'
    model = plain(XML.replace('<motor name="drive" joint="carriage" gear="5"/>', idle))
    assert EFFECTS["deadband"].places(model) == ("actuator:shoulder", "actuator:elbow")


def test_both_actuators_of_a_drive_with_a_dead_band_are_scaled_and_delayed():
    model = structured("deadband", "actuator:elbow")
    gain = on_all_parts(model, EFFECTS["actuator_gain"].parameters(model, "actuator:elbow")[0])
    width = EFFECTS["deadband"].parameters(model, "actuator:elbow")[0]
    space = ParameterSpace([gain, width])
    ModelWriter(model, space).write_model(np.array([1.2, 0.1 * 1.2]), model, mujoco.MjData(model))
    stiff = XML.replace('kp="15" kv="0.6"', 'kp="18" kv="0.72"')
    close(rollout(model), rollout(with_effect("deadband", {"width": 0.1}, xml=stiff)), 1e-10)
    delay = Parameter("delay", "s", 0.0, 0.0, 1.0, "linear", (Write("actuator_delay", "elbow", operation="add"),))
    assert [w.object for w in on_all_parts(model, delay).writes] == ["elbow", "elbow.deadband"]
    other = Parameter("delay", "s", 0.0, 0.0, 1.0, "linear", (Write("actuator_delay", "shoulder", operation="add"),))
    assert on_all_parts(model, other) == other
    bias = EFFECTS["actuator_bias"].parameters(model, "actuator:elbow")[0]
    assert on_all_parts(model, bias) == bias
    np.testing.assert_array_equal(command_sources(model), [0, 1, 2, 1])


def test_contact_friction_scales_what_the_contact_has():
    """The larger coefficient of cart and floor counts, that of the floor."""
    rough = XML.replace('friction="0.8"', 'friction="0.4"')
    close(rollout(with_effect("contact_friction", {"scale": 0.5})), rollout(plain(rough)), 1e-9)


def test_contact_pairs_are_those_that_mujoco_looks_for():
    model = structured("contact_friction", "geom:upper")
    partners = {frozenset((model.pair_geom1[i], model.pair_geom2[i])) for i in range(model.npair)}
    names = [{model.geom(g).name for g in pair} - {"upper"} for pair in partners]
    assert sorted(name for rest in names for name in rest) == ["cart", "floor"]  # the lower arm is adjacent
    excluded = XML.replace("<tendon>", '<contact><exclude body1="cart" body2="upper"/></contact><tendon>')
    assert structured("contact_friction", "geom:upper", excluded).npair == 1


def test_sensor_bias_of_an_encoder_moves_what_it_reads_and_nothing_else():
    """The servo sees the reading; springs, limits and tendons stay where they are."""
    bias = 0.15
    biased = with_effect("sensor_bias", {"bias": bias})
    elbow = biased.joint("elbow").qposadr[0]
    found = rollout(biased)
    expected = rollout(plain(), COMMANDS - [0, bias, 0])
    expected[:, elbow] += bias
    close(found, expected, 1e-10)
    into_limit = COMMANDS + np.array([0, 3.0, 0])
    expected = rollout(plain(), into_limit - [0, bias, 0])
    assert expected[:, elbow].max() > 1.55
    expected[:, elbow] += bias
    close(rollout(biased, into_limit), expected, 1e-10)


def test_sensor_bias_of_an_encoder_moves_tendons_without_a_name_too():
    nameless = XML.replace('<fixed name="cable"', "<fixed")
    bias = {"bias": 0.15}
    close(rollout(with_effect("sensor_bias", bias, xml=nameless)), rollout(with_effect("sensor_bias", bias)), 0)
    untouched = structured("sensor_bias", "joint:carriage", nameless)
    assert untouched.tendon(0).name == ""


def test_frame_offset_moves_the_site_in_its_body():
    shift = {"x": 0.01, "y": -0.02, "z": 0.03}
    moved = XML.replace('name="tip" pos=".05 0 .01"', 'name="tip" pos=".06 -.02 .04"')
    close(rollout(with_effect("frame_offset", shift)), rollout(plain(moved)), 1e-12)


def test_sites_that_carry_force_are_no_place_for_an_offset():
    site = '<site name="held"/><joint name="settle"'
    driven = XML.replace('<joint name="settle"', site).replace("<sensor>", "<sensor>")
    assert "site:held" in EFFECTS["frame_offset"].places(plain(driven))
    driven = driven.replace("<position name", '<general name="jet" site="held" gear="1 0 0 0 0 0"/><position name', 1)
    assert EFFECTS["frame_offset"].places(plain(driven)) == ("site:tip",)


@pytest.mark.parametrize(
    ("effect", "field", "nominal"),
    [("sensor_bias", "column.bias", 0), ("sensor_scale", "column.scale", 1), ("sensor_delay", "column.delay", 0)],
)
def test_sensor_effects_write_columns(effect, field, nominal):
    model = plain()
    columns = {}
    for place in EFFECTS[effect].places(model):
        parameters = EFFECTS[effect].parameters(model, place)
        assert all(p.nominal == nominal for p in parameters)
        columns[place] = [w.object for p in parameters for w in p.writes if w.field == field]
    assert columns["sensor:rate"] == ["sensor/rate"]
    assert columns["sensor:acceleration"] == [f"sensor/acceleration/{i}" for i in range(3)]
    assert columns["joint:elbow"] == ([] if effect == "sensor_bias" else ["qpos/elbow", "qvel/elbow"])
    assert columns.get("site:tip", []) == ([] if effect == "sensor_bias" else [f"site/tip/{a}" for a in "xyz"])
