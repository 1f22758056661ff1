"""The states that recordings begin in, estimated from what was measured, and how wrong they may be."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from test_replay import CART, cart, centred, record, without

from simopt_envs.measured import Recording, cut_windows, estimate_states, replay


@pytest.mark.parametrize(("left_out", "noise"), [(["qvel"], {"qpos": 1e-3}), ([], {"qpos": 1e-3, "qvel": 0.1})])
def test_estimated_starts_are_as_right_as_they_say(left_out, noise):
    """Positions with 1 mrad of noise, velocities not measured or badly; the errors are those that are claimed."""
    model = cart()
    recording, qpos, qvel = record(model, 3000)
    rng = np.random.default_rng(0)
    noisy = without(recording, "sensor", "site", *left_out)
    noisy = replace(
        noisy,
        columns={n: v + rng.normal(0, noise.get(n.split("/")[0], 0), len(v)) for n, v in noisy.columns.items()},
    )
    samples = np.arange(100, 2900, 20)
    states = estimate_states(model, noisy, samples)
    for estimate, truth, error in (
        (states.qpos, qpos, states.qpos_error),
        (states.qvel, centred(qvel), states.qvel_error),
    ):
        assert np.median(np.abs(estimate - truth[samples]) / error) < 1.5  # 0.67 if Gaussian and unbiased
        assert np.median(np.abs(estimate - truth[samples]) / error) > 0.3
    assert np.std(states.qvel - qvel[samples]) < 0.1


def test_of_a_quaternion_the_errors_are_those_of_the_rotation():
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint name='ball' type='ball'/><geom size='0.1'/></body></worldbody></mujoco>"
    )
    time, rng = 0.01 * np.arange(600), np.random.default_rng(0)
    truth = np.stack([np.cos(np.sin(time) / 2), np.sin(np.sin(time) / 2), 0 * time, 0 * time], axis=1)  # about x
    samples, off = np.arange(50, 550, 50), []
    for _ in range(8):
        noisy = truth + 1e-2 * rng.standard_normal(truth.shape)
        columns = {f"qpos/ball/{k}": noisy[:, k] for k in range(4)}
        states, turned = estimate_states(model, Recording(time, columns), samples), np.empty(3)
        for estimate, error, true in zip(states.qpos, states.qpos_error, truth[samples], strict=True):
            mujoco.mj_normalizeQuat(model, estimate)
            mujoco.mj_differentiatePos(model, turned, 1.0, true, estimate)
            off.append(turned / error)
    assert 0.7 < np.sqrt(np.mean(np.square(off))) < 1.4


def test_joints_without_a_column_are_found_from_sites_and_sensors():
    model = cart()
    recording, qpos, qvel = record(model, 1500)
    samples = np.arange(50, 1450, 100)
    for kept in (("site",), ("sensor/place", "sensor/half", "sensor/gyro"), ("site", "qpos/slide")):
        seen = recording.only([n for n in recording.columns if n.startswith(("ctrl", *kept))])
        states = estimate_states(model, seen, samples)
        np.testing.assert_allclose(states.qpos, qpos[samples], atol=2e-4)
        np.testing.assert_allclose(states.qvel, centred(qvel)[samples], atol=2e-2)
        assert states.qpos_error.max() < 0.01
    blind = estimate_states(model, recording.only(["ctrl/push", "ctrl/servo", "qpos/slide"]), samples)
    np.testing.assert_array_equal(blind.qpos[:, 1], 0.0)
    assert blind.qpos_error[:, 1].min() > 0.9, "what nothing sees is not known"
    result = replay(model, recording.only(["ctrl/push", "ctrl/servo", "qpos/slide"]), seconds=0.5)
    assert [str(w) for w in result.warnings] == [
        "warning: qpos/hinge: no column tells where it is: it starts at the model's reference"
    ]


def chain(links: int) -> mujoco.MjModel:
    """A rope of links of 10 cm, with a site at its tip."""
    tail = "<site name='tip' pos='0 0 -0.1'/>" + "</body>" * links
    link = (
        "<body pos='0 0 {z}'><joint name='link{i}' axis='0 1 0' damping='1e-4'/>"
        "<geom type='capsule' fromto='0 0 0 0 0 -0.1' size='0.01' mass='0.02'/>"
    )
    bodies = "".join(link.format(i=i, z=-0.1 if i else 0.0) for i in range(links))
    return mujoco.MjModel.from_xml_string(
        f"<mujoco><option timestep='0.002'/><worldbody>{bodies}{tail}</worldbody></mujoco>"
    )


@pytest.mark.parametrize("links", [1, 6])
def test_of_joints_that_one_site_tells_little_of_no_more_is_unknown_than_it_shows(links):
    """Of a rope that swings, its tip tells where the joints are together, and so how far off each may be."""
    model, rng, off, rates = chain(links), np.random.default_rng(0), [], []
    samples = np.arange(50, 450, 50)
    for _ in range(8):
        data, rows = mujoco.MjData(model), []
        data.qpos[:] = 0.05 * rng.standard_normal()  # bent as a whole, and let go
        for _ in range(500):
            mujoco.mj_kinematics(model, data)
            rows.append(np.concatenate([data.qpos, data.qvel, data.site_xpos[0] + 1e-4 * rng.standard_normal(3)]))
            mujoco.mj_step(model, data)
        qpos, qvel, tip = np.split(np.array(rows), [links, 2 * links], axis=1)
        columns = {f"site/tip/{axis}": values for axis, values in zip("xyz", tip.T, strict=True)}
        states = estimate_states(model, Recording(0.002 * np.arange(500), columns), samples)
        off.append((states.qpos - qpos[samples]) / states.qpos_error)
        rates.append((states.qvel - centred(qvel)[samples]) / states.qvel_error)
    assert 0.4 < np.std(off) < 1.6
    assert 0.4 < np.std(rates) < 1.6


def test_a_keyframe_replaces_the_reference():
    model = mujoco.MjModel.from_xml_string(
        CART.format(armature="").replace("<actuator>", '<keyframe><key name="up" qpos="0 3"/></keyframe><actuator>')
    )
    recording, *_ = record(model, 300)
    seen = recording.only(["ctrl/push", "ctrl/servo", "qpos/slide"])
    states = estimate_states(model, seen, np.array([50]), keyframe="up")
    assert states.qpos[0, 1] == pytest.approx(3.0, abs=1e-9)
    with pytest.raises(ValueError, match=r"unknown keyframe 'upp'; did you mean 'up'\?"):
        cut_windows(model, seen, keyframe="upp")


def test_a_free_body_starts_with_the_right_angular_velocity():
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><option timestep='0.002' gravity='0 0 0'/><worldbody><body><freejoint name='f'/>"
        "<geom type='box' size='0.1 0.2 0.3'/></body></worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    data.qvel[:] = [0.1, -0.2, 0.3, 1.0, -2.0, 0.5]
    rows, velocities = [], []
    for _ in range(500):
        rows.append(data.qpos.copy())
        velocities.append(data.qvel.copy())
        mujoco.mj_step(model, data)
    recording = Recording(0.002 * np.arange(500), {f"qpos/f/{k}": np.array(rows)[:, k] for k in range(7)})
    states = estimate_states(model, recording, np.array([100, 300]))
    np.testing.assert_allclose(states.qvel, centred(np.array(velocities))[[100, 300]], atol=1e-5)
