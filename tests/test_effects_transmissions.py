"""Effects between a joint's motor and its link: springs and play."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from effect_arm import ARM, STEPS, TIMESTEP, structure, with_effect

from simopt_envs.physics.effects import EFFECTS
from simopt_envs.physics.effects.joints import on_bearing

pytest.importorskip("mujoco.batch", reason="effects need MuJoCo >= 3.17")

# The drive with a rotor of 0.5 kg and a link of 2 kg, free to fly.
FREE_DRIVE = ARM.replace('axis="1 0 0" damping="5"', 'axis="1 0 0" damping="0" armature="0.5"')


def test_elasticity_gives_by_the_load_over_the_stiffness() -> None:
    model = with_effect("joint_elasticity", "joint:elbow", {"stiffness": 60.0})
    data = mujoco.MjData(model)
    elbow, link = (model.joint(name).qposadr[0] for name in ("elbow", "elbow.link"))
    for _ in range(4 * STEPS):
        mujoco.mj_step(model, data)
    weight = -data.qfrc_bias[model.joint("elbow").dofadr[0]]
    assert abs(weight) > 0.3
    assert data.qpos[link] == pytest.approx(weight / 60, rel=1e-3)
    assert abs(data.qpos[link]) > 5e-3
    expected = -0.3 * np.sin(data.qpos[0]) - 0.25 * np.sin(
        data.qpos[0] + data.qpos[elbow] + data.qpos[link] - np.radians(10)
    )
    assert data.site("tip").xpos[2] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("stiffness", [1e2, 1e4])
def test_elastic_link_swings_as_two_masses_do(stiffness: float) -> None:
    model = with_effect("joint_elasticity", "joint:drive", {"stiffness": stiffness}, FREE_DRIVE)
    model.opt.timestep = 1e-4
    model.dof_damping[model.joint("drive.link").dofadr[0]] *= 0.05  # as fits the timestep
    data = mujoco.MjData(model)
    dof, adr = model.joint("drive.link").dofadr[0], model.joint("drive.link").qposadr[0]
    data.qpos[adr] = 1e-3
    stretch = []
    for _ in range(8000):
        mujoco.mj_step(model, data)
        stretch.append(data.qpos[adr])
    crossings = np.flatnonzero(np.diff(np.sign(stretch)))
    half_period = np.diff(crossings).mean() * 1e-4
    assert dof == model.nv - 1
    assert half_period == pytest.approx(np.pi / np.sqrt(stiffness * (1 / 0.5 + 1 / 2.0)), rel=5e-3)


def test_backlash_link_rests_on_a_stop_and_is_loose_between() -> None:
    play = 0.02
    model = with_effect("backlash", "joint:drive", {"play": play}, FREE_DRIVE)
    data = mujoco.MjData(model)
    motor, link = (model.joint(name).id for name in ("drive", "drive.play"))
    positions = []
    for i in range(STEPS):
        data.ctrl[2] = 3.0 * np.sign(np.sin(6 * i * TIMESTEP))
        mujoco.mj_step(model, data)
        positions.append(data.qpos[[model.jnt_qposadr[motor], model.jnt_qposadr[link]]].copy())
    behind = np.array(positions)[:, 1]
    assert np.abs(behind).max() == pytest.approx(play / 2, abs=1e-3)
    assert behind.max() > 0.009
    assert behind.min() < -0.009
    data = mujoco.MjData(model)
    data.qvel[model.jnt_dofadr[link]] = 0.01  # in the gap, the motor does not feel the link
    mujoco.mj_step(model, data, 100)
    assert data.qvel[model.jnt_dofadr[motor]] == pytest.approx(0.0, abs=1e-6)
    assert data.qpos[model.jnt_qposadr[link]] == pytest.approx(0.002, rel=1e-3)


def test_backlash_link_lies_still_on_a_stop() -> None:
    model = with_effect("backlash", "joint:elbow", {"play": 0.02})
    data = mujoco.MjData(model)
    link = model.joint("elbow.play")
    turns, last = 0, 0.0
    for i in range(2 * STEPS):
        data.ctrl[:2] = np.array([0.6, 0.5]) * np.sin(np.array([3.0, 5.0]) * i * TIMESTEP)
        mujoco.mj_step(model, data)
        speed = data.qvel[link.dofadr[0]]
        turns += int(abs(data.qpos[link.qposadr[0]]) > 0.0099 and speed * last < 0)
        last = speed
    assert turns < 60  # stops of impedance 0.9999 make it turn round 190 times


@pytest.mark.parametrize(("effect", "link"), [("backlash", "play"), ("joint_elasticity", "link")])
def test_a_link_turns_about_the_axis_of_a_joint_in_a_frame(effect: str, link: str) -> None:
    joint = '<joint name="elbow" type="hinge" axis="0 1 0" ref="10" springref="20"/>'
    framed = '<frame pos="0.1 0 0" euler="30 0 40">' + joint.replace("<joint", '<joint pos="0 0.2 0"') + "</frame>"
    model, _ = structure(effect, "joint:elbow", ARM.replace(joint, framed))
    motor, behind = model.joint("elbow"), model.joint(f"elbow.{link}")
    assert np.abs(motor.axis - [0, 1, 0]).max() > 0.1
    np.testing.assert_allclose([behind.axis, behind.pos], [motor.axis, motor.pos], atol=1e-12)


@pytest.mark.parametrize("effect", ["backlash", "joint_elasticity", "load_dependent_friction"])
def test_keyframes_have_all_joints_where_they_were(effect: str) -> None:
    """What is added comes between the others."""
    keys = '<keyframe><key qpos="0.1 0.2 0.3" qvel="1 2 3"/><key ctrl="0.5 0 0"/></keyframe></mujoco>'
    spec = mujoco.MjSpec.from_string(ARM.replace("</mujoco>", keys))
    for joint in ("shoulder", "elbow"):
        EFFECTS[effect].add(spec, f"joint:{joint}")
    for model in (spec.compile(), mujoco.MjModel.from_xml_string(spec.to_xml())):
        for name, at in (("shoulder", 1.0), ("elbow", 2.0), ("drive", 3.0)):
            joint = model.joint(name)
            assert model.key_qpos[0, joint.qposadr[0]] == pytest.approx(0.1 * at)
            assert model.key_qvel[0, joint.dofadr[0]] == pytest.approx(at)
        assert np.count_nonzero(model.key_qpos[0]) == np.count_nonzero(model.key_qvel[0]) == 3
        np.testing.assert_allclose(model.key_qpos[1], model.qpos0)


def test_elasticity_and_backlash_can_be_in_series() -> None:
    spec = mujoco.MjSpec.from_string(ARM)
    for name in ("joint_elasticity", "backlash"):
        EFFECTS[name].add(spec, "joint:elbow")
    model = spec.compile()
    assert model.nv == 5
    assert model.tendon_num[model.tendon("elbow.bearing").id] == 3


def test_damping_of_a_joint_slows_the_link_not_the_motor() -> None:
    """A link of 2 kg in its play, damped by 5 N s/m: v = v0 exp(-t 5/2), and the motor rests."""
    model = with_effect("backlash", "joint:drive", {"play": 0.02}, FREE_DRIVE.replace('damping="0"', 'damping="5"'))
    data = mujoco.MjData(model)
    motor, link = (model.joint(name).dofadr[0] for name in ("drive", "drive.play"))
    data.qvel[link] = 0.01
    mujoco.mj_step(model, data, 100)
    assert data.qvel[link] == pytest.approx(0.01 * np.exp(-2.5 * 100 * TIMESTEP), rel=1e-2)
    assert data.qvel[motor] == pytest.approx(0.0, abs=1e-4)


def test_what_resists_a_joint_is_written_to_its_bearing_where_it_has_one() -> None:
    loose = with_effect("backlash", "joint:elbow", {"play": 0.02})
    friction = EFFECTS["coulomb_friction"].parameters(loose, "joint:elbow")[0]
    (write,) = on_bearing(loose, friction).writes
    assert (write.field, write.object) == ("tendon_frictionloss", "elbow.bearing")
    assert write.operation == friction.writes[0].operation
    firm = mujoco.MjModel.from_xml_string(ARM)
    assert on_bearing(firm, friction) == friction
    elsewhere = EFFECTS["coulomb_friction"].parameters(loose, "joint:drive")[0]
    assert on_bearing(loose, elsewhere) == elsewhere
