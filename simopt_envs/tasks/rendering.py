"""Rendering through Gymnasium's MuJoCo renderer."""

from __future__ import annotations

import os
import sys
from typing import Any

import mujoco


def make_renderer(model: mujoco.MjModel, data: mujoco.MjData, camera: str, width: int = 640, height: int = 480) -> Any:
    """A renderer of the named camera.

    Raises:
        RuntimeError: if OpenGL cannot be had, saying what to set.
    """
    if sys.platform == "linux" and "DISPLAY" not in os.environ:
        os.environ.setdefault("MUJOCO_GL", "egl")  # the only window system a headless machine is likely to have
    try:
        from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer

        return MujocoRenderer(model, data, width=width, height=height, camera_name=camera)
    except ImportError as error:
        raise RuntimeError(f'rendering needs a package: {error}; pip install "simopt-envs[report]"') from error
