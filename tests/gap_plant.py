"""A two-link arm, a simulator of its own: Euler at 0.5 ms, wrong plain parameters, noisy sensors, late commands."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import mujoco
import numpy as np

from simopt_envs.gap.thresholds import WINDOW
from simopt_envs.gap.trial import Data
from simopt_envs.measured import Recording, cut_windows
from simopt_envs.physics.effects.actuator_delay import LONGEST

MODEL = """
<mujoco model="two_link">
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="0.5" armature="0.02"/>
      <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.03" mass="2" contype="0" conaffinity="0"/>
      <body name="lower" pos="0.4 0 0">
        <joint name="elbow" axis="0 1 0" damping="0.2" armature="0.01"/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.025" mass="1" contype="0" conaffinity="0"/>
        <site name="tip" pos="0.3 0 0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="shoulder" joint="shoulder" kp="80" kv="6"/>
    <position name="elbow" joint="elbow" kp="40" kv="3"/>
  </actuator>
</mujoco>
"""
_STEP, _PERIOD, _LATENCY = 0.0005, 0.02, 2  # s, s, steps

Law = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""(positions, velocities) -> generalised forces that the model knows nothing of."""


def record(
    law: Law, rng: np.random.Generator, count: int = 4, seconds: float = 2.0, limit: float | None = None
) -> list[Recording]:
    """Recordings of the arm with a hidden law, or limit of the elbow's drive [N m], in random sums of sines."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    if limit is not None:
        model.actuator_forcelimited[1], model.actuator_forcerange[1] = True, (-limit, limit)
    model.opt.timestep, model.opt.integrator = _STEP, mujoco.mjtIntegrator.mjINT_EULER
    for field in (model.body_mass, model.body_inertia, model.dof_damping, model.dof_armature):
        field *= np.exp(0.05 * rng.standard_normal(field.shape))
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return [_record_one(model, law, rng, seconds, f"run_{i}") for i in range(count)]


def halves(model: mujoco.MjModel, recordings: list[Recording]) -> Data:
    """Windows of every other recording to fit and of the rest held out, however fast they move."""
    fitted, held_out = tuple(recordings[::2]), tuple(recordings[1::2])
    cut = partial(cut_windows, model, seconds=WINDOW, history=2 * LONGEST, centred=True)
    return Data(cut(fitted), cut(held_out), fitted, held_out)


def _record_one(model: mujoco.MjModel, law: Law, rng: np.random.Generator, seconds: float, name: str) -> Recording:
    size, rate, phase = rng.uniform(0.1, 0.5, (3, 2)), rng.uniform(0.2, 1.5, (3, 2)), rng.uniform(0, 6.3, (3, 2))

    def command(time: float) -> np.ndarray:
        held = np.floor(time / _PERIOD + 1e-9) * _PERIOD
        return 0.3 + np.sum(size * np.sin(2 * np.pi * rate * held + phase), axis=0)

    data = mujoco.MjData(model)
    data.qpos[:] = command(0.0)
    for _ in range(2000):
        data.ctrl[:] = command(0.0)
        mujoco.mj_step(model, data)
    rows, every = [], round(_PERIOD / _STEP)
    for i in range(round(seconds / _STEP) + 1):
        if i % every == 0:
            mujoco.mj_kinematics(model, data)
            tip = data.site("tip").xpos + 1e-3 * rng.standard_normal(3)
            joints = data.qpos + 5e-4 * rng.standard_normal(2)
            rows.append([i * _STEP, *command(i * _STEP), *joints, *tip])
        data.ctrl[:] = command((i - _LATENCY) * _STEP) if i >= _LATENCY else command(0.0)
        data.qfrc_applied[:] = law(data.qpos, data.qvel)
        mujoco.mj_step(model, data)
    time, *columns = np.array(rows).T
    joints = ("shoulder", "elbow")
    names = [*(f"ctrl/{j}" for j in joints), *(f"qpos/{j}" for j in joints), *(f"site/tip/{a}" for a in "xyz")]
    return Recording(time, dict(zip(names, columns, strict=True)), name)
