"""``SimOpt/Drawer-v0``: a Franka Panda opens a cabinet's drawer by its bar handle.

Observation Box(10,): 7 joint positions [rad], the handle's position [m] in the frame of the robot's base.
Action Box(-1, 1, (8,)): 7 joint velocities, scaled by ``action_scaling_*``, and the gripper (-1 closed, 1 open).
An episode is 50 actions at 60 ms. The paper's has 150 steps; a policy chooses three times less often here, over the
same 3 s, which makes credit assignment easier and saves samples, while the servos run at 250 Hz in between.
Success: at the end of the episode the drawer stands open by at least 0.2 m and its handle is in the closed gripper.
"""

from __future__ import annotations

from typing import Any

from simopt_envs.tasks.drawer.task import DrawerTask
from simopt_envs.tasks.effects import Effects
from simopt_envs.tasks.env import TaskEnv
from simopt_envs.tasks.vector_env import TaskVectorEnv

__all__ = ["DrawerTask", "make_env", "make_vector_env"]


def make_env(effects: Effects = (), **kwargs: Any) -> TaskEnv:
    """The single environment; physical effects that its model is to have, and keywords of :class:`TaskEnv`."""
    return TaskEnv(DrawerTask(effects), **kwargs)


vars(make_env)["metadata"] = TaskEnv.metadata  # where gym.make looks for the render modes


def make_vector_env(effects: Effects = (), **kwargs: Any) -> TaskVectorEnv:
    """The native vector environment; physical effects, and keywords of :class:`TaskVectorEnv`."""
    return TaskVectorEnv(DrawerTask(effects), **kwargs)
