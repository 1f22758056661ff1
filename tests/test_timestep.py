"""A timestep that is too long for the recordings, where things touch, and one that is not."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from conftest import needs_effects

from benchmarks.gymnasium_models import CASES, hidden, nominal
from benchmarks.gymnasium_models import record as recorded
from simopt_envs.gap import find_gap
from simopt_envs.gap.find import at_a_timestep_that_fits, read, refitted
from simopt_envs.gap.plain import plain_parameters
from simopt_envs.gap.timestep import halved, takes_all, with_warning
from simopt_envs.measured import Recording, cut_windows, simulate_windows
from simopt_envs.physics.effects import EFFECTS

pytestmark = needs_effects

STEP, FRICTION, NOISE = 0.01, 3.0, 1e-3
FEW = [EFFECTS[name] for name in ("coulomb_friction", "viscous_friction")]
CARRIAGE = f"""
<mujoco>
  <option timestep="{STEP}" integrator="RK4" gravity="0 0 0"/>
  <worldbody>
    <body name="carriage">
      <joint name="rail" type="slide" axis="1 0 0" damping="1" range="-0.1 0.1" limited="true"/>
      <geom size="0.1" mass="1" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><motor name="drive" joint="rail" delay="0.02" nsample="4"/></actuator>
</mujoco>
"""


def record(friction: float = 0.0) -> list[Recording]:
    """Eight recordings of 3 s of a carriage that is pushed to and fro between the stops; noisy."""
    spec, rng = mujoco.MjSpec.from_string(CARRIAGE), np.random.default_rng(0)
    spec.joint("rail").frictionloss = friction
    model, time, recordings = spec.compile(), STEP * np.arange(300), []
    for run in range(8):
        data, positions = mujoco.MjData(model), []
        frequency, phase = rng.uniform(0.5, 2, 3), rng.uniform(0, 2 * np.pi, 3)
        commands = 6 * np.sin(2 * np.pi * frequency * time[:, None] + phase).sum(axis=1)
        for command in commands:
            positions.append(data.qpos[0])
            data.ctrl[:] = command
            mujoco.mj_step(model, data)
        measured = np.array(positions) + rng.normal(0, NOISE, len(time))
        recordings.append(
            Recording(time, {"ctrl/drive": commands, "qpos/rail": measured}, f"run_{run}").select(start=0.3)
        )
    return recordings


def test_half_the_timestep_is_taken_where_it_leaves_no_more_than_noise():
    """Gymnasium's half cheetah on its ground, recorded with steps half as long and other masses; nothing is missing."""
    case, spec = CASES["half_cheetah"], nominal("half_cheetah")
    system = hidden(spec, case, friction=0.0)
    problem = read(spec, [recorded(system, case, seed) for seed in range(8)])
    found, null = at_a_timestep_that_fits(problem, refitted(problem), problem.data)
    assert found.plain.model.opt.timestep == spec.option.timestep / 2
    assert abs(null.excess) < 0.03
    (told,) = [str(warning) for warning in found.data.warnings if warning.check == "timestep"]
    assert "with half the model's timestep, 0.005 s, 0.99" in told
    more = replace(null, held_out=replace(null.held_out, errors=1.05 * null.held_out.errors))
    assert not takes_all(more)
    assert (
        with_warning(problem.data, 0.005, null, more)
        .warnings[-1]
        .message.endswith(": a shorter one may be what is missing")
    )
    assert found.given.option.timestep == spec.option.timestep  # so that the difference shows it


@pytest.mark.parametrize("friction", [0.0, FRICTION])
def test_one_that_is_not_stays(friction):
    gap = find_gap(mujoco.MjSpec.from_string(CARRIAGE), record(friction), effects=FEW)
    assert gap.spec.option.timestep == STEP
    assert not [warning for warning in gap.warnings if warning.check == "timestep"]
    assert [str(effect.candidate) for effect in gap.effects] == ["coulomb_friction at joint:rail"] * (friction > 0)


def test_half_the_timestep_moves_a_free_model_alike():
    """Where nothing touches; a delay is of as many seconds, but for a part of a step."""
    spec = mujoco.MjSpec.from_string(CARRIAGE)
    spec.joint("rail").limited = mujoco.mjtLimited.mjLIMITED_FALSE
    plain = plain_parameters(spec)
    windows = cut_windows(plain.model, record(), 0.5)
    finer = windows.at_half_the_timestep()
    moved, moved_finer = simulate_windows(plain.model, windows)[0], simulate_windows(halved(plain).model, finer)[0]
    assert np.abs(moved_finer - moved).max() < 5e-3 * np.abs(moved).max()
    assert finer.offsets is windows.offsets
