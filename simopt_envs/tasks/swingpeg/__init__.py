"""``SimOpt/SwingPeg-v0``: an ABB YuMi swings a peg that hangs on a rope into a hole inclined at 45 degrees.

The hole is farther away than the arm can hold the peg: it must swing the peg up to 45 degrees and follow it with the
gripper when it is there.

Observation Box(10,): 7 joint positions [rad], the position of the peg's centre [m] in the frame of the robot's base.
Where the hole is, is not observed. Action Box(-1, 1, (7,)): joint velocities, scaled by ``action_scaling_*``.
An episode is 50 actions at 60 ms, as the drawer's: 3 s are two to three periods of the swinging peg.
Success: at the end of the episode the peg's tip is in the hole, at least half the peg's length deep, and its axis
within 15 degrees of the hole's.
"""

from __future__ import annotations

from typing import Any

from simopt_envs.tasks.effects import Effects
from simopt_envs.tasks.env import TaskEnv
from simopt_envs.tasks.swingpeg.task import SwingPegTask
from simopt_envs.tasks.vector_env import TaskVectorEnv

__all__ = ["SwingPegTask", "make_env", "make_vector_env"]


def make_env(effects: Effects = (), **kwargs: Any) -> TaskEnv:
    """The single environment; physical effects that its model is to have, and keywords of :class:`TaskEnv`."""
    return TaskEnv(SwingPegTask(effects), **kwargs)


vars(make_env)["metadata"] = TaskEnv.metadata  # where gym.make looks for the render modes


def make_vector_env(effects: Effects = (), **kwargs: Any) -> TaskVectorEnv:
    """The native vector environment; physical effects, and keywords of :class:`TaskVectorEnv`."""
    return TaskVectorEnv(SwingPegTask(effects), **kwargs)
