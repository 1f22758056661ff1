"""An arm and a carriage, and their models with one effect."""

from __future__ import annotations

from collections.abc import Mapping

import mujoco

from simopt_envs.physics import ModelWriter, ParameterSpace
from simopt_envs.physics.effects import EFFECTS

# The classes' defaults are a trap: nothing that an effect adds may inherit them.
ARM = """
<mujoco>
  <compiler angle="degree"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <default>
    <joint damping="0.1" armature="0.02"/>
    <tendon damping="3" frictionloss="2" limited="true" range="-0.01 0.01"/>
    <general gear="2" forcerange="-30 30"/>
  </default>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" type="hinge" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02"/>
      <body name="fore" pos="0.3 0 0">
        <joint name="elbow" type="hinge" axis="0 1 0" ref="10" springref="20"/>
        <geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.02"/>
        <site name="tip" pos="0.25 0 0"/>
      </body>
    </body>
    <body name="carriage" pos="0 1 0">
      <joint name="drive" type="slide" axis="1 0 0" damping="5"/>
      <geom type="box" size="0.1 0.1 0.1" mass="2"/>
    </body>
  </worldbody>
  <actuator>
    <position joint="shoulder" kp="60" kv="4"/>
    <position joint="elbow" kp="40" kv="2"/>
    <motor joint="drive"/>
  </actuator>
</mujoco>
"""
STEPS, TIMESTEP = 1000, 0.002


def structure(name: str, place: str, arm: str = ARM) -> tuple[mujoco.MjModel, ParameterSpace]:
    """The arm with an effect's structure, and its parameters."""
    spec = mujoco.MjSpec.from_string(arm)
    EFFECTS[name].add(spec, place)
    model = spec.compile()
    return model, ParameterSpace(EFFECTS[name].parameters(model, place))


def with_effect(name: str, place: str, values: Mapping[str, float] | None = None, arm: str = ARM) -> mujoco.MjModel:
    """The arm with an effect at some values, its neutral ones by default."""
    model, space = structure(name, place, arm)
    ModelWriter(model, space).write_model(space.values(dict(values or {})), model, mujoco.MjData(model))
    return model
