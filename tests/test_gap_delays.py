"""Delays of which a share is a first-order lag: of commands, of what sensors show, and in the repaired MJCF."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from conftest import needs_effects
from gap_plant import MODEL, record

from simopt_envs.gap.hypothesis import Candidate, Hypothesis
from simopt_envs.gap.motion import motion_of
from simopt_envs.gap.plain import INTEGRATION_LEAD, plain_parameters
from simopt_envs.gap.recordings import read_windows
from simopt_envs.gap.repair import repaired
from simopt_envs.measured import cut_windows, simulate_windows
from simopt_envs.physics.columns import ColumnModel, CommandModel
from simopt_envs.physics.effects import EFFECTS
from simopt_envs.physics.parameters import ParameterSpace

pytestmark = needs_effects

STEP = 0.002  # s


def space_of(effect: str, place: str) -> ParameterSpace:
    model = mujoco.MjModel.from_xml_string(MODEL)
    return ParameterSpace(EFFECTS[effect].parameters(model, place))


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_commands_arrive_late_by_the_delay_and_spread_by_the_lag(share):
    delay, past, count = 0.02, 60, 300
    commands = CommandModel(space_of("actuator_delay", "actuator:elbow"), ["shoulder", "elbow"])
    step = np.ones((1, count, 2))
    arrived = commands.arriving(np.zeros((1, past, 2)), step, np.array([[delay, share]]), STEP)[0, 0]
    np.testing.assert_array_equal(arrived[:, 0], 1.0)
    answer, age = np.diff(arrived[:, 1], prepend=0.0), STEP * np.arange(count)
    assert answer.sum() == pytest.approx(1.0)
    assert answer @ age == pytest.approx(delay)
    assert np.sqrt(answer @ (age - delay) ** 2) == pytest.approx(share * delay, rel=0.02, abs=1e-9)
    with pytest.raises(ValueError, match="unknown commanded actuator 'elbow'; did you mean 'elbows'"):
        CommandModel(space_of("actuator_delay", "actuator:elbow"), ["elbows"])


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_a_sensor_shows_what_a_lag_leaves_of_a_wave(share):
    delay, frequency, period = 0.015, 9.0, 0.004
    columns = ColumnModel(space_of("sensor_delay", "joint:elbow"), ["qpos/elbow"])
    time = period * np.arange(250)
    xi = np.array([[delay, share]])
    shown = columns.shown(np.sin(frequency * time)[None, None, :, None], xi, period)[0, 0, :, 0]
    answer = np.exp(-1j * frequency * (1 - share) * delay) / (1 + 1j * frequency * share * delay)
    expected = np.imag(answer * np.exp(1j * frequency * time))
    np.testing.assert_allclose(shown[30:], expected[30:], atol=2e-4)

    rate, bend = (np.imag((1j * frequency) ** d * answer * np.exp(1j * frequency * time)) for d in (1, 2))
    position, velocity = np.sin(frequency * time), frequency * np.cos(frequency * time)
    meant = columns.meant(0, xi, expected, rate, bend)[0]
    assert np.abs(meant - position).max() < 0.2 * np.abs(expected + delay * rate - position).max() + 1e-3
    meant = columns.meant_rate(0, xi, rate, bend)[0]
    assert np.abs(meant - velocity).max() < 0.2 * np.abs(rate - velocity).max()


@pytest.mark.parametrize(("share", "filters"), [(0.6, 1), (0.0, 0)])
def test_the_repaired_model_has_the_lag_as_a_filter(share, filters):
    plain = plain_parameters(mujoco.MjSpec.from_string(MODEL))
    recordings = record(lambda q, v: np.zeros(2), np.random.default_rng(3), count=2)
    data, motion = read_windows(plain.model, recordings, None), motion_of(plain.model, recordings, None)
    candidate = Candidate(EFFECTS["actuator_delay"], "actuator:shoulder")
    hypothesis = Hypothesis(plain, [candidate], motion)
    xi = hypothesis.space.nominal.copy()
    xi[hypothesis.space.index("command_latency")] = xi[hypothesis.space.index(INTEGRATION_LEAD)] = 0.0
    xi[hypothesis.columns[candidate]] = 0.04, share
    model = repaired(hypothesis, xi).compile()
    assert model.na == filters
    windows = cut_windows(model, data.fitted_recordings, data.seconds, history=0.2)
    in_model = simulate_windows(model, windows)[0]
    outside = hypothesis.simulator(data.fitted)(xi[None])[0]
    xi[hypothesis.columns[candidate]] = 0.04, 0.6 - share
    other = hypothesis.simulator(data.fitted)(xi[None])[0]
    error, apart = (np.sqrt(np.mean((s - outside) ** 2)) for s in (in_model, other))
    assert error < 0.1 * apart
