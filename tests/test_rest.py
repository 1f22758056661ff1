"""Recordings that begin at rest: where they start, what held them, and how the gap workflow takes them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from conftest import needs_effects
from hanging import LOOSE, a_rope, drive, hanging, part, swing

from simopt_envs.gap import find, find_gap
from simopt_envs.gap.recordings import under_way, whole_from_rest
from simopt_envs.gap.separate import simulated_motions
from simopt_envs.gap.thresholds import LARGE
from simopt_envs.gap.trial import Data
from simopt_envs.measured import Recording, cut_windows, estimate_states, replay
from simopt_envs.measured.engines import settle_actuators
from simopt_envs.measured.rest import holding_commands
from simopt_envs.physics.effects import EFFECTS

# An arm that a servo holds against its weight, late; from a cart beside it hangs a rod.
HUNG = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body>
      <joint name="arm" axis="0 -1 0" damping="5"/>
      <geom type="capsule" fromto="0 0 0 0.6 0 0" size="0.02" mass="1"/>
    </body>
    <body pos="0 1 0">
      <joint name="cart" type="slide" axis="1 0 0" damping="5"/>
      <geom type="box" size="0.1 0.1 0.1" mass="1"/>
      <body>
        <joint name="rod" axis="0 1 0" damping="1e-3"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.1"/>
        <site name="tip" pos="0 0 -0.3"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="arm" joint="arm" kp="200" kv="5" delay="0.02" nsample="12"/>
    <motor name="cart" joint="cart"/>
  </actuator>
</mujoco>
"""
HELD = np.array([-0.4, 0.2, 0.0])


def from_rest(columns: Sequence[str]) -> tuple[mujoco.MjModel, Recording]:
    """A servo that lags by 20 ms and is sent off by a step as the recording begins; a pendulum hangs from it."""
    model = mujoco.MjModel.from_xml_string(HUNG)
    data, rows, rng = mujoco.MjData(model), [], np.random.default_rng(0)
    data.qpos[:] = HELD
    held = np.tile(holding_commands(model, data.qpos, np.full(2, np.nan)), (20, 1))
    settle_actuators(model, data, held)
    for _ in range(100):
        mujoco.mj_kinematics(model, data)
        rows.append(np.concatenate([data.qpos, data.site_xpos[0]]) + 1e-4 * rng.standard_normal(6))
        data.ctrl[:] = 0.5, 0.0
        mujoco.mj_step(model, data, 5)
    names = ("qpos/arm", "qpos/cart", "qpos/rod", "site/tip/x", "site/tip/y", "site/tip/z")
    measured = dict(zip(names, np.array(rows).T, strict=True))
    commands = {"ctrl/arm": np.full(100, 0.5), "ctrl/cart": np.zeros(100)}
    log = Recording(0.01 * np.arange(100), {**commands, **{name: measured[name] for name in columns}}, at_rest=True)
    return model, log


def test_commands_that_hold_are_those_of_the_weight_in_servos_and_of_others_the_first():
    model = mujoco.MjModel.from_xml_string(HUNG)
    data = mujoco.MjData(model)
    data.qpos[:] = HELD
    held = holding_commands(model, HELD, np.full(2, np.nan))
    weight = 1.0 * 9.81 * 0.3 * np.cos(HELD[0])
    assert held == pytest.approx([HELD[0] + weight / 200, 0.0], abs=1e-9)
    settle_actuators(model, data, np.tile(held, (20, 1)))
    data.ctrl[:] = held
    mujoco.mj_step(model, data, 500)
    np.testing.assert_allclose(data.qpos, HELD, atol=1e-6)
    model.actuator_forcelimited[0], model.actuator_forcerange[0] = 1, (-1.0, 1.0)
    assert holding_commands(model, HELD, np.array([0.7, 0.8]))[0] == 0.7, "too weak to hold it"


@needs_effects
def test_a_drive_with_a_dead_band_holds_by_one_command():
    spec = mujoco.MjSpec.from_string(HUNG)
    EFFECTS["deadband"].add(spec, "actuator:arm")
    held = holding_commands(spec.compile(), HELD, np.full(3, np.nan))
    weight = 1.0 * 9.81 * 0.3 * np.cos(HELD[0])
    assert held == pytest.approx([HELD[0] + weight / 200, 0.0, HELD[0] + weight / 200], abs=1e-9)


@needs_effects
def test_drives_hold_against_actuators_that_take_no_command():
    """As a repaired model has them, here before a drive, which is held back by a dead time."""
    spec = mujoco.MjSpec.from_string(HUNG.replace('<motor name="cart" joint="cart"/>', ""))
    EFFECTS["cogging"].add(spec, "joint:arm")
    spec.add_actuator(name="cart", target="cart", trntype=mujoco.mjtTrn.mjTRN_JOINT, delay=0.02, nsample=12)
    model = spec.compile()
    model.actuator("arm.cogging").biasprm[:3] = 0.5, 4.0, 0.3
    data = mujoco.MjData(model)
    data.qpos[:] = HELD
    held = holding_commands(model, HELD, np.full(2, np.nan))
    settle_actuators(model, data, np.tile(held, (20, 1)))
    data.ctrl[:] = held
    mujoco.mj_step(model, data, 500)
    np.testing.assert_allclose(data.qpos, HELD, atol=1e-6)


def test_a_recording_from_rest_starts_at_rest_and_what_nothing_shows_near_its_reference():
    model, log = from_rest(["qpos/arm", "qpos/cart"])
    samples = np.array([0, 50])
    told, untold = (estimate_states(model, replace(log, at_rest=rest), samples) for rest in (True, False))
    np.testing.assert_array_equal(told.qvel[0], 0.0)
    assert told.qpos[0, :2] == pytest.approx(HELD[:2], abs=4e-4)
    assert (told.qpos_error[0, 2], told.qvel_error[0, 2]) == pytest.approx((0.01, 0.1))
    assert untold.qpos_error[0, 2] > 0.9
    for states in zip(vars(told).values(), vars(untold).values(), strict=True):
        np.testing.assert_array_equal(states[0][1], states[1][1], err_msg="later on, nothing is told")


def test_a_drive_that_lags_holds_on_where_a_recording_begins_at_rest():
    model, log = from_rest(["qpos/arm", "qpos/cart", "site/tip/x", "site/tip/y", "site/tip/z"])
    right, wrong = (replay(model, replace(log, at_rest=rest)) for rest in (True, False))
    assert right.rmse[0, 0] < 3e-4
    assert wrong.rmse[0, 0] > 1e-2
    part = cut_windows(model, log, seconds=0.2)
    np.testing.assert_array_equal(part.past_commands[1:, :, 0], 0.5)
    assert part.past_commands[0, :, 0].max() < 0.0


def of_a_hanging_rope(damping: float, at_rest: bool, load: float = 0.0) -> tuple[mujoco.MjSpec, list[Recording]]:
    """A rope of four links that hangs from a cart, which its drive begins to shake as the recording begins."""
    spec, time = a_rope(4, 5e-3, "delay='0.01' nsample='8'"), 0.02 * np.arange(101)
    model = spec.compile()
    model.joint("link1").damping[:] = damping
    model.body("part3").mass[:] += load
    recordings = drive(model, [0.1 * np.cos((i + 3) * time) for i in range(4)], 0.0, [2e-4, 1e-3, 1e-3, 1e-3])
    return spec, [replace(recording, at_rest=at_rest) for recording in recordings]


@needs_effects
@pytest.mark.parametrize(
    ("damping", "at_rest", "named"), [(2e-2, True, True), (4e-2, True, True), (2e-2, False, False), (5e-3, True, False)]
)
def test_what_acts_in_a_rope_is_named_where_it_is_told_that_it_hangs_at_rest(damping, at_rest, named):
    """Also a friction that all but stiffens its joint, of which no interval leaves out none."""
    spec, recordings = of_a_hanging_rope(damping, at_rest)
    gap = find_gap(spec, recordings, effects=[EFFECTS["viscous_friction"], EFFECTS["joint_spring"]])
    assert gap.data.seconds == pytest.approx(2.0 if at_rest else 0.5)
    assert len(gap.data.fitted.names) == (4 if at_rest else 2)
    assert [str(effect.candidate) for effect in gap.effects] == ["viscous_friction at joint:link1"] * named
    assert gap.verdict == ("named" if named else "none")
    assert len(gap.remarks) == named, "hardly how much of it"
    motions = simulated_motions(gap.explanation.final, gap.data)
    assert motions
    assert all(motion.at_rest == at_rest for motion in motions)


@needs_effects
def test_a_rope_from_rest_is_not_cut_where_the_model_is_far_from_it_as_its_tip_would_be_lost():
    spec, recordings = of_a_hanging_rope(5e-3, True, load=0.3)
    problem = find.read(spec, recordings)
    assert find.refitted(problem).excess > LARGE
    gap = find_gap(spec, recordings, effects=[EFFECTS["payload"]])
    assert gap.data.seconds == pytest.approx(2.0)
    assert str(gap.effects[0].candidate) == "payload at body:part3"


def test_recordings_from_rest_are_taken_alone_where_they_are_half_of_all_and_short():
    model = mujoco.MjModel.from_xml_string(LOOSE.format(gravity=-9.81))
    recordings = swing(model, hanging(6), np.random.default_rng(0))

    def whole(resting: int, of: Sequence[Recording] = recordings) -> Data | None:
        return whole_from_rest(model, [replace(r, at_rest=i < resting) for i, r in enumerate(of)])

    data = whole(4)
    assert data is not None
    assert {*data.fitted.recording, *data.held_out.recording} == {f"run_{i}" for i in range(4)}
    assert data.seconds == pytest.approx(2.0)
    np.testing.assert_array_equal(data.fitted.start_time, 0.0)
    assert whole(3) is not None
    assert whole(2) is None
    assert whole(0) is None
    assert whole(1, recordings[:1]) is None, "none would be left to hold out"
    long = [replace(recording, time=4.1 * recording.time) for recording in recordings]
    assert whole(6, long) is None, "most of them is far from where they rested"
    torn = [part(r, (r.time < 0.5) | (r.time > 1.0)) for r in recordings]
    assert whole(6, torn) is None
    few = whole(6, [*torn[:3], *recordings[3:]])
    assert few is not None
    assert len(few.fitted) + len(few.held_out) == 3


def test_short_windows_leave_out_how_recordings_set_off_from_rest():
    time = 0.01 * np.arange(101)
    resting = Recording(time, {"qpos/hinge": np.sin(time)}, at_rest=True)
    later = under_way([resting, replace(resting, at_rest=False), resting.select(end=0.5)])
    assert [recording.time[0] for recording in later] == pytest.approx([0.1, 0.0, 0.0])
    assert [recording.at_rest for recording in later] == [False, False, True]


@needs_effects
@pytest.mark.parametrize(("push", "seconds"), [(0.0, 2.0), (1.0, 0.5)])
def test_recordings_from_rest_are_cut_where_a_model_is_far_from_them(push, seconds):
    """The rod from where it hangs; a push that nothing tells leaves hundreds of times the noise."""
    spec = mujoco.MjSpec.from_string(LOOSE.format(gravity=-9.81))
    recordings = [replace(r, at_rest=True) for r in swing(spec.compile(), [np.pi] * 4, np.random.default_rng(0), push)]
    assert find.read(spec, recordings).data.seconds == pytest.approx(2.0)
    gap = find_gap(spec, recordings, effects=[EFFECTS["sensor_bias"]])
    assert gap.data.seconds == pytest.approx(seconds)
