"""What hangs: rods that swing by a torque, and a rope from a cart that is driven."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from simopt_envs.measured import Recording

LOOSE = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast" gravity="0 0 {gravity}"/>
  <worldbody>
    <body name="rod">
      <joint name="hinge" axis="0 1 0" damping="0.01"/>
      <geom type="capsule" fromto="0 0 0 0 0 0.5" size="0.02" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor name="hinge" joint="hinge"/></actuator>
</mujoco>
"""


def swing(
    model: mujoco.MjModel, starts: Sequence[float], rng: np.random.Generator, push: float = 0.0
) -> list[Recording]:
    """The rod from some angles, by a small torque and one that nothing tells; its sensor has 1 mrad of noise."""
    recordings, time = [], 0.01 * np.arange(201)
    for i, start in enumerate(starts):
        data, torque, angle = mujoco.MjData(model), 0.3 * np.sin((i + 2) * time), np.empty(201)
        data.qpos[:] = start
        for k in range(201):
            angle[k] = data.qpos[0] + 1e-3 * rng.standard_normal()
            data.ctrl[:] = torque[k] + push
            mujoco.mj_step(model, data, 5)
        recordings.append(Recording(time, {"ctrl/hinge": torque, "qpos/hinge": angle}, f"run_{i}"))
    return recordings


def hanging(count: int) -> list[float]:
    """Where so many rods begin, each a little farther from rest."""
    return [np.pi + 0.1 * i for i in range(count)]


def part(recording: Recording, kept: np.ndarray) -> Recording:
    """Some of its samples."""
    columns = {name: values[kept] for name, values in recording.columns.items()}
    return replace(recording, time=recording.time[kept], columns=columns)


def a_rope(links: int, damping: float, lag: str = "") -> mujoco.MjSpec:
    """A cart that is driven, from which a rope hangs."""
    rope = "<site name='tip' pos='0 0 -0.2'/>" + "</body>" * links
    for i in reversed(range(links)):
        rope = (
            f"<body name='part{i}' pos='0 0 {-0.2 if i else 0}'>"
            f"<joint name='link{i}' axis='0 1 0' damping='{damping}'/>"
            f"<geom type='capsule' fromto='0 0 0 0 0 -0.2' size='0.01' mass='0.02'/>{rope}"
        )
    spec = mujoco.MjSpec.from_string(
        "<mujoco><option timestep='0.002'/><worldbody><body><joint name='cart' type='slide' axis='1 0 0' damping='5'/>"
        f"<geom type='box' size='0.1 0.1 0.1' mass='5'/>{rope}</body></worldbody>"
        f"<actuator><position name='cart' joint='cart' kp='500' kv='50' {lag}/></actuator></mujoco>"
    )
    spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_CONTACT
    return spec


def drive(
    model: mujoco.MjModel, commands: Sequence[np.ndarray], turning: float, noise: Sequence[float]
) -> list[Recording]:
    """What is seen of the cart and of the rope's tip where the cart is driven, and the rope turns at first."""
    rng, recordings = np.random.default_rng(0), []
    for i, command in enumerate(commands):
        data, rows = mujoco.MjData(model), []
        data.qvel[1:] = turning
        for value in command:
            mujoco.mj_kinematics(model, data)
            rows.append([data.qpos[0], *data.site_xpos[0]] + np.array(noise) * rng.standard_normal(4))
            data.ctrl[:] = value
            mujoco.mj_step(model, data, 10)
        names = ("qpos/cart", "site/tip/x", "site/tip/y", "site/tip/z")
        columns = {"ctrl/cart": command, **dict(zip(names, np.array(rows).T, strict=True))}
        recordings.append(Recording(0.02 * np.arange(len(command)), columns, f"run_{i}"))
    return recordings
