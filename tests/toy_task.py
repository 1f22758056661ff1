"""A task small enough to check by hand: a mass on a rail, pushed towards a mark."""

import mujoco
import numpy as np
from gymnasium import spaces

from simopt_envs.physics import Parameter, ParameterSpace, Write
from simopt_envs.tasks.task import Outcome

XML = """
<mujoco>
  <option timestep="0.01" integrator="implicitfast"/>
  <worldbody>
    <camera name="side" pos="0 -3 0" xyaxes="1 0 0 0 0 1"/>
    <body name="cart" gravcomp="1">
      <joint name="slide" type="slide" axis="1 0 0" damping="2"/>
      <geom type="box" size=".1 .1 .1" mass="1"/>
    </body>
  </worldbody>
  <actuator><position name="servo" joint="slide" kp="20" delay="0.03" nsample="5"/></actuator>
</mujoco>
"""


class ToyTask:
    """Observation: position. Action: how far ahead the servo's target is."""

    parameters = ParameterSpace(
        [
            Parameter("damping", "N s/m", 2.0, 0.2, 20.0, writes=(Write("dof_damping", "slide"),)),
            Parameter(
                "mass",
                "kg",
                1.0,
                0.1,
                10.0,
                writes=(
                    Write("body_mass", "cart", operation="scale"),
                    Write("body_inertia", "cart", operation="scale"),
                ),
            ),
        ]
    )
    observation_space = spaces.Box(-10.0, 10.0, (1,), np.float64)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    substeps = 3
    camera = "side"
    observation_names = ("position",)
    discrepancy_weights = np.ones(1)

    def make_model(self, visual=True):
        return mujoco.MjModel.from_xml_string(XML)

    def initial_qpos(self, rng):
        return rng.uniform(0.5, 1.5, 1)

    def qpos_from_observation(self, observation):
        return np.array(observation)

    def hold(self, qpos):
        return qpos

    def control(self, simulation, action):
        return simulation.data("qpos") + action

    def observe(self, simulation):
        return simulation.data("qpos") * 1.0

    def evaluate(self, simulation, action):
        distance = abs(simulation.data("xpos")[:, 1, 0] - 2.0)
        return Outcome(reward=-distance, terms={"distance": -distance}, success=distance < 0.1)
