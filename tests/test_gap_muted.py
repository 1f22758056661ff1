"""MuJoCo while a search runs: silent, and as it was afterwards."""

from __future__ import annotations

import mujoco
import numpy as np
from conftest import needs_effects
from gap_plant import MODEL

from simopt_envs.gap.muted import muted

pytestmark = needs_effects


def test_the_user_hears_of_no_simulation_that_runs_away_meanwhile():
    model = mujoco.MjModel.from_xml_string(MODEL)
    heard: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(heard.append)
    try:
        with muted():
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
