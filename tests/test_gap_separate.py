"""Motions that tell an effect from its partner: they do, or none is said to."""

from __future__ import annotations

import json
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from conftest import needs_effects
from gap_plant import MODEL

from simopt_envs.gap import find_gap, plain_parameters
from simopt_envs.gap.confusion import correlation
from simopt_envs.gap.excitations import excitations
from simopt_envs.gap.explanation import Explanation, ranked
from simopt_envs.gap.hypothesis import Candidate
from simopt_envs.gap.motion import motion_of
from simopt_envs.gap.recordings import read_windows
from simopt_envs.gap.search import Search
from simopt_envs.gap.separate import _fitted_size
from simopt_envs.measured import Recording, load_recording
from simopt_envs.physics.effects import EFFECTS
from simopt_envs.physics.effects.actuator_bias import ActuatorBias

pytestmark = needs_effects

PERIOD = 0.02
JOINTS = ("shoulder", "elbow")


class ConstantForce(ActuatorBias):
    """The constant force of a drive by another name: no motion tells the two apart."""

    name = "constant_force"


TRIED = [EFFECTS["coulomb_friction"], EFFECTS["actuator_bias"], ConstantForce()]


def perform(commands: Recording, rng: np.random.Generator, force: float = 0.0, friction: float = 0.0) -> Recording:
    """What the arm does on commands, with a force or Coulomb friction in its elbow, seen by noisy sensors."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    model.joint("elbow").frictionloss[0] = friction
    data = mujoco.MjData(model)
    data.qfrc_applied[1] = force
    given = np.stack([commands[f"ctrl/{joint}"] for joint in JOINTS], axis=-1)
    data.qpos[:], data.ctrl[:] = given[0], given[0]
    mujoco.mj_step(model, data, 1000)
    qpos = []
    for command in given:
        qpos.append(data.qpos + 5e-4 * rng.standard_normal(2))
        data.ctrl[:] = command
        mujoco.mj_step(model, data, round(PERIOD / model.opt.timestep))
    measured = {f"qpos/{joint}": q for joint, q in zip(JOINTS, np.transpose(qpos), strict=True)}
    return Recording(commands.time, {**commands.columns, **measured}, commands.name)


def one_way(rng: np.random.Generator, count: int = 4) -> list[Recording]:
    """Commands that move both joints up, never down: friction is a constant force there."""
    time = PERIOD * np.arange(101)
    out = []
    for i in range(count):
        starts, speeds, bends = rng.uniform([[-0.5], [0.4], [-0.1]], [[0.0], [0.8], [0.1]], (3, 2))
        ramps = starts + np.outer(time, speeds) + np.outer(time**2, bends)
        out.append(Recording(time, {f"ctrl/{joint}": ramps[:, j] for j, joint in enumerate(JOINTS)}, f"up_{i}"))
    return out


@pytest.fixture(scope="module")
def recordings():
    rng = np.random.default_rng(0)
    return [perform(commands, rng, force=-0.4) for commands in one_way(rng)]


@pytest.fixture(scope="module")
def one_way_gap(recordings):
    return find_gap(mujoco.MjSpec.from_string(MODEL), recordings, effects=TRIED)


def asked(gap, **truth: float):
    """The motion that was asked for, recorded twice."""
    rng = np.random.default_rng(1)
    commands = partner_of(gap, "actuator_bias").separation.commands
    return [perform(replace(commands, name=f"asked_{i}"), rng, **truth) for i in range(2)]


@pytest.fixture(scope="module")
def told_gap(recordings, one_way_gap):
    return find_gap(mujoco.MjSpec.from_string(MODEL), [*recordings, *asked(one_way_gap, force=-0.4)], effects=TRIED)


def partner_of(gap, name):
    (named,) = gap.effects
    (partner,) = [p for p in named.partners if p.candidate.effect.name == name]
    return partner


def test_a_motion_is_asked_for_that_tells_friction_from_a_constant_force(one_way_gap):
    partner = partner_of(one_way_gap, "actuator_bias")
    assert one_way_gap.effects[0].candidate.effect.name == "coulomb_friction"  # the data cannot know
    assert partner.correlation > 0.999
    assert partner.separation.nats_recorded < 1.0
    assert partner.separation.nats > 100
    assert partner.separation.separates
    assert str(partner.separation).startswith("to tell them apart: ")


def test_on_its_recording_the_two_are_as_different_as_was_expected(one_way_gap):
    separation = partner_of(one_way_gap, "actuator_bias").separation
    recordings, plain = asked(one_way_gap, friction=0.4), plain_parameters(mujoco.MjSpec.from_string(MODEL))
    candidates = [Candidate(EFFECTS["coulomb_friction"], "joint:elbow"), Candidate(ActuatorBias(), "actuator:elbow")]
    search = Search(plain, read_windows(plain.model, recordings), motion_of(plain.model, recordings), candidates)
    stage = search.stage(search.base())
    one, other = (screened.direction for screened in stage.screened)
    assert correlation(one, other) == pytest.approx(separation.correlation, abs=0.2)
    assert correlation(one, other) < 0.6
    losses = {score.candidate.effect.name: score.trial.fit.loss for score in stage.scores}
    nats = losses["actuator_bias"] - losses["coulomb_friction"]
    assert separation.nats / 3 < nats < 10 * separation.nats  # to first order: the partner's fit ends far away


def test_with_its_recording_the_right_one_is_named(told_gap):
    (named,) = told_gap.effects
    assert named.candidate.effect.name in ("actuator_bias", "constant_force")
    assert "coulomb_friction" not in {partner.candidate.effect.name for partner in named.partners}


def test_no_motion_is_asked_for_where_none_tells_two_apart(told_gap, tmp_path):
    (named,) = told_gap.effects
    (partner,) = named.partners
    assert {named.candidate.effect.name, partner.candidate.effect.name} == {"actuator_bias", "constant_force"}
    assert partner.separation.nats < 0.1
    assert partner.separation.correlation > 0.999
    assert not partner.separation.separates
    assert str(partner.separation).startswith("no motion tried would tell them apart")
    found = json.loads((told_gap.save(tmp_path) / "gap.json").read_text())
    assert found["effects"][0]["confounded_with"][0]["motion"]["file"] is None
    assert not (tmp_path / "separate").exists()


def test_commands_are_saved_where_the_files_say(one_way_gap, tmp_path):
    found = json.loads((one_way_gap.save(tmp_path) / "gap.json").read_text())
    (motion,) = [p["motion"] for p in found["effects"][0]["confounded_with"] if p["effect"] == "actuator_bias"]
    separation = partner_of(one_way_gap, "actuator_bias").separation
    assert motion["file"] == "separate/coulomb_friction.elbow_vs_actuator_bias.elbow.csv"
    assert (motion["excitation"], motion["nats"]) == (separation.commands.name, separation.nats)
    commands = load_recording(tmp_path / motion["file"])
    assert list(commands.columns) == ["ctrl/shoulder", "ctrl/elbow"]
    np.testing.assert_allclose(commands["ctrl/elbow"], separation.commands["ctrl/elbow"])
    assert motion["file"] in (tmp_path / "report.html").read_text()


def test_motions_stay_within_what_was_commanded():
    model = mujoco.MjModel.from_xml_string(MODEL)
    recordings = one_way(np.random.default_rng(0))
    model.actuator("elbow").ctrllimited[0], model.actuator("elbow").ctrlrange[:] = 1, (-1.0, 0.5)
    motions = list(excitations(model, recordings, PERIOD))
    assert len({motion.name for motion in motions}) == len(motions) == 10
    for name, limit in (("ctrl/shoulder", np.inf), ("ctrl/elbow", 0.5)):
        recorded = np.concatenate([recording[name] for recording in recordings])
        fastest = max(np.abs(np.diff(recording[name])).max() for recording in recordings)
        sent = np.stack([motion[name] for motion in motions])
        assert sent.min() >= recorded.min()
        assert min(recorded.max(), limit) - 0.2 < sent.max() <= min(recorded.max(), limit)
        assert np.abs(np.diff(sent)).max() <= 1.5 * fastest + 1e-9
        np.testing.assert_array_equal(sent[:, 0], np.full(len(motions), min(recordings[0][name][0], limit)))


def test_nothing_can_be_commanded_without_actuators_or_commands_that_moved():
    recordings = one_way(np.random.default_rng(0))
    spec = mujoco.MjSpec.from_string(MODEL)
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    assert list(excitations(spec.compile(), recordings, PERIOD)) == []
    still = [replace(r, columns={name: np.full(len(r), 0.3) for name in r.columns}) for r in recordings]
    assert list(excitations(mujoco.MjModel.from_xml_string(MODEL), still, PERIOD)) == []


def test_a_partners_size_is_its_own_whatever_order_a_fit_has_its_effects_in(recordings):
    plain = plain_parameters(mujoco.MjSpec.from_string(MODEL))
    spring, friction, force = (
        Candidate(EFFECTS["joint_spring"], "joint:shoulder"),
        Candidate(EFFECTS["coulomb_friction"], "joint:elbow"),
        Candidate(EFFECTS["actuator_bias"], "actuator:elbow"),
    )
    data = read_windows(plain.model, recordings)
    search = Search(plain, data, motion_of(plain.model, recordings), (spring, friction, force))
    without, both = search.base((friction,)), search.base((spring, friction))
    (screened,) = search._screened(without, (spring,))
    assert screened.hypothesis.columns[spring] != both.hypothesis.columns[spring]
    stage = ranked(without, [screened], {spring: both})
    size = _fitted_size(Explanation(without, both, (), (stage,), data), force, spring)
    np.testing.assert_array_equal(size, both.fit.u[both.hypothesis.columns[spring]])
