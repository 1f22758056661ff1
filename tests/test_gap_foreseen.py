"""What a fit leaves uncertain is no gap; what the model lacks is one all the same."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from conftest import needs_effects
from gap_plant import MODEL, record

from simopt_envs.gap.foreseen import unforeseen
from simopt_envs.gap.hypothesis import Candidate
from simopt_envs.gap.motion import motion_of
from simopt_envs.gap.plain import plain_parameters
from simopt_envs.gap.recordings import read_windows
from simopt_envs.gap.search import Search
from simopt_envs.gap.thresholds import EXPLAINED
from simopt_envs.gap.trial import Base
from simopt_envs.measured.windows import Windows
from simopt_envs.physics.effects import EFFECTS

pytestmark = needs_effects


def fitted(friction: float, windows: int) -> tuple[Base, Windows]:
    """The model, which lacks some friction of the elbow, fitted to so many windows, and the windows held out."""
    recordings = record(lambda q, v: np.array([0.0, -friction * np.tanh(v[1] / 0.01)]), np.random.default_rng(0))
    plain = plain_parameters(mujoco.MjSpec.from_string(MODEL))
    data = read_windows(plain.model, recordings)
    some = replace(data, fitted=data.fitted.select(np.arange(windows)))
    candidates = (Candidate(EFFECTS["coulomb_friction"], "joint:elbow"),)
    return Search(plain, some, motion_of(plain.model, recordings), candidates).base(), data.held_out


@pytest.mark.parametrize(("friction", "explained"), [(0.0, True), (0.4, False)])
def test_what_one_second_tells_of_the_parameters_leaves_the_rest_uncertain(friction, explained):
    base, held_out = fitted(friction, windows=2)
    right = EXPLAINED - 1
    assert base.excess > 1.5 * right
    assert (unforeseen(base, held_out) < right) == explained


def test_nothing_is_excused_where_the_model_does_not_fit_what_was_fitted():
    base, held_out = fitted(friction=0.1, windows=8)
    assert unforeseen(base, held_out) == base.excess > EXPLAINED - 1
