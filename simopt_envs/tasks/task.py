"""What a task is: a model, and how it is commanded, observed, rewarded and judged.

A task is written once, over arrays with the worlds as first axis; the single and the vector environment both run it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from simopt_envs.physics.parameters import Array, ParameterSpace
from simopt_envs.physics.simulation import Simulation


@dataclass(frozen=True)
class Outcome:
    """What n worlds earned in one control step.

    Attributes:
        reward: (n,), the sum of the terms.
        terms: the weighted reward terms by name, each (n,).
        success: (n,) bool, whether the task is solved as things stand now.
    """

    reward: Array
    terms: dict[str, Array]
    success: NDArray[np.bool_]


class Task(Protocol):
    """A task over a :class:`Simulation` of its model.

    Attributes:
        parameters: ξ, every quantity that an episode may vary.
        observation_space, action_space: of one world.
        substeps: model steps per control step.
        camera: name of the camera that shows the scene.
        observation_names: (o,), what the observed channels are.
        discrepancy_weights: (o,), the weight of each observed channel in the discrepancy (W in the paper's Eq. 4).
    """

    parameters: ParameterSpace
    observation_space: spaces.Box[Any]
    action_space: spaces.Box[Any]
    substeps: int
    camera: str
    observation_names: tuple[str, ...]
    discrepancy_weights: Array

    def make_spec(self) -> mujoco.MjSpec:
        """A fresh spec of the model at nominal ξ, with the structure of the effects that the task was made with."""
        ...

    def make_model(self, visual: bool = True) -> mujoco.MjModel:
        """A fresh model at nominal ξ; without ``visual`` it lacks what is there only to be seen, and steps faster."""
        ...

    def initial_qpos(self, rng: np.random.Generator) -> Array:
        """Draw the start posture of an episode, (nq,)."""
        ...

    def qpos_from_observation(self, observation: Array) -> Array:
        """The start posture (nq,) that best explains a first observation (o,), to repeat a measured episode."""
        ...

    def hold(self, qpos: Array) -> Array:
        """The commands (k, nu) that hold postures (k, nq)."""
        ...

    def control(self, simulation: Simulation, action: Array) -> Array:
        """Actions (n, a) in [-1, 1] -> actuator commands (n, nu)."""
        ...

    def observe(self, simulation: Simulation) -> Array:
        """Observations (n, o)."""
        ...

    def evaluate(self, simulation: Simulation, action: Array) -> Outcome:
        """Judge the state that an action led to."""
        ...
