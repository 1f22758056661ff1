"""MuJoCo while a search runs: silent and without its profiler, and as it was afterwards."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from conftest import needs_effects
from gap_plant import MODEL

from simopt_envs.gap.unobserved import unobserved

pytestmark = needs_effects


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(MODEL)


def _timed(model: mujoco.MjModel) -> bool:
    """Whether a step is."""
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    return data.timer[mujoco.mjtTimer.mjTIMER_STEP].duration > 0


def test_no_step_is_timed_meanwhile(model):
    assert _timed(model)
    with unobserved():
        assert not _timed(model)
        with unobserved():
            pass
        assert not _timed(model)
    assert _timed(model)


def test_steps_are_timed_again_after_an_error(model):
    with pytest.raises(RuntimeError), unobserved():
        raise RuntimeError
    assert _timed(model)


def test_the_user_hears_of_no_simulation_that_runs_away_meanwhile(model):
    heard: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(heard.append)
    try:
        with unobserved():
            _run_away(model)
        assert not heard
        _run_away(model)
        assert heard
    finally:
        mujoco.set_mju_user_warning(before)


def _run_away(model: mujoco.MjModel) -> None:
    data = mujoco.MjData(model)
    data.qpos[:] = np.nan
    mujoco.mj_step(model, data)
