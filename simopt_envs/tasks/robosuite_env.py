"""robosuite's manipulation tasks as Gymnasium environments, one world each.

robosuite's own ``GymWrapper`` gives different observations for the same seed and another dtype than it declares; it
also rebuilds its model at every reset, which takes a hundred times as long as putting the old one back.
"""

from __future__ import annotations

import logging
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from simopt_envs.physics.parameters import Array

_PROPRIOCEPTION = ("joint_pos", "joint_vel", "eef_pos", "eef_quat", "gripper_qpos", "gripper_qvel")


class RobosuiteEnv(gym.Env[Array, Any]):
    """One world of a robosuite task with one robot.

    An observation is the robot's joint positions and velocities, the pose of its gripper, the fingers' positions and
    velocities, and what robosuite tells of the task's objects. Of robosuite's proprioception it leaves out the
    accelerations, which are no part of the state, and the sines and cosines of the joint positions.
    ``info["is_success"]`` of every step says whether the task is solved. Episodes end by Gymnasium's ``TimeLimit``.

    To randomize its physics, wrap it in ``RandomizablePhysics``.

    Args:
        task: robosuite's name of the task, ``"Door"``.
        robot: robosuite's name of the robot.
        render_mode: None, "rgb_array" or "human".
        camera: the camera that ``render`` looks through.
        reward_shaping: whether the reward also tells how near success is.
        **kwargs: further arguments of ``robosuite.make``, such as ``control_freq``.

    Attributes:
        model, data: MuJoCo's own.
        start_variables: live arrays besides ``qpos`` and ``qvel`` that differ from episode to episode.

    Raises:
        ImportError: without robosuite.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 20}  # noqa: RUF012 - Gymnasium's own attribute

    def __init__(
        self,
        task: str,
        robot: str = "Panda",
        render_mode: str | None = None,
        camera: str = "frontview",
        reward_shaping: bool = True,
        **kwargs: Any,
    ):
        self._robosuite = _make(task, robots=robot, reward_shaping=reward_shaping, **kwargs)
        self.model, self.data = self._robosuite.sim.model._model, self._robosuite.sim.data._data
        self.model.geom_rgba[self.model.geom_group == 0, 3] = 0.0  # robosuite's collision shapes, not to be seen
        self.metadata = self.metadata | {"render_fps": round(self._robosuite.control_freq)}
        self.render_mode = render_mode
        self._camera = camera
        self._renderer: Any = None
        self._keys = [f"robot0_{name}" for name in _PROPRIOCEPTION] + ["object-state"]
        low, high = (np.asarray(bound, dtype=np.float32) for bound in self._robosuite.action_spec)
        self.action_space = spaces.Box(low, high, dtype=np.float32)
        self.observation_space = spaces.Box(-np.inf, np.inf, self._get_obs().shape, np.float64)
        self.start_variables: tuple[np.ndarray, ...] = ()
        if task == "Door":
            frame = self.model.body("Door_main").id
            self.start_variables = (self.model.body_pos[frame, :2], self.model.body_quat[frame, ::3])  # turned about z

    @property
    def dt(self) -> float:
        """Seconds between two actions."""
        return float(self._robosuite.control_timestep)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Begin an episode; all that robosuite draws for it comes from Gymnasium's generator."""
        super().reset(seed=seed)
        self._robosuite.rng = self._robosuite.placement_initializer.rng = self.np_random
        self._robosuite.reset()
        # robosuite's controllers begin with the mass matrix of another posture of the fingers
        self.set_state(self.data.qpos.copy(), self.data.qvel.copy())
        if self.render_mode == "human":
            self.render()
        return self._get_obs(), {}

    def step(self, action: NDArray[np.floating]) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Advance by ``dt``; the action is that of robosuite's controller, within ±1."""
        _, reward, _, _ = self._robosuite.step(np.asarray(action, dtype=np.float64))
        if self.render_mode == "human":
            self.render()
        info = {"is_success": bool(self._robosuite._check_success())}
        return self._get_obs(), float(reward), False, False, info

    def set_state(self, qpos: Array, qvel: Array) -> None:
        """Begin the episode in another state: the controllers take it for the one they start from."""
        sim = self._robosuite.sim
        sim.reset()
        self.data.qpos[:], self.data.qvel[:] = qpos, qvel
        for robot in self._robosuite.robots:
            robot._load_controller()
            robot.composite_controller.update_state()
            robot.composite_controller.reset()
        sim.forward()

    def render(self) -> Any:
        """An image (height, width, 3) for "rgb_array"; a window for "human"."""
        if self.render_mode is None:
            return None
        if self._renderer is None:
            from simopt_envs.tasks.rendering import make_renderer

            self._renderer = make_renderer(self.model, self.data, self._camera, self.render_mode)
        return self._renderer.render(self.render_mode)

    def close(self) -> None:
        """Close the renderer, if there is one, and robosuite's environment."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        self._robosuite.close()

    def _get_obs(self) -> Array:
        """The observation of the state as it is; robosuite's own may be as old as the last action."""
        observations = self._robosuite._get_observations(force_update=True)
        return np.concatenate([np.ravel(observations[key]) for key in self._keys], dtype=np.float64)


def _make(task: str, **kwargs: Any) -> Any:
    """robosuite's environment: without cameras and time limit, and one model for its whole life."""
    logging.getLogger("robosuite_logs").addFilter(_only_errors)
    try:
        import robosuite
    except ImportError as error:
        raise ImportError(f'SimOpt/Robosuite{task}-v0 needs robosuite: pip install "simopt-envs[robotics]"') from error
    return robosuite.make(
        task,
        has_renderer=False,
        has_offscreen_renderer=False,
        use_camera_obs=False,
        ignore_done=True,
        hard_reset=False,
        seed=0,  # of the model: the size of a cube is drawn once
        **kwargs,
    )


def _only_errors(record: logging.LogRecord) -> bool:
    """It greets with warnings about options that nobody asked for."""
    return record.levelno >= logging.ERROR
