"""Rendering through Gymnasium's MuJoCo renderer."""

from __future__ import annotations

import os
import sys
from typing import Any

import mujoco


def make_renderer(model: mujoco.MjModel, data: mujoco.MjData, camera: str, mode: str) -> Any:
    """A renderer of the named camera, for a Gymnasium render mode.

    Raises:
        RuntimeError: if there is no OpenGL to draw with, or a package is missing.
    """
    if sys.platform == "linux" and "DISPLAY" not in os.environ:
        os.environ.setdefault("MUJOCO_GL", "egl")  # the only window system a headless machine is likely to have
    try:
        from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer
    except ImportError as error:
        raise RuntimeError(f'rendering needs a package ({error}): pip install "simopt-envs[report]"') from error
    renderer = MujocoRenderer(model, data, width=640, height=480, camera_name=camera)
    try:
        renderer.render(mode)
    except Exception as error:  # without OpenGL, drivers and bindings fail in ways of their own
        raise RuntimeError(
            f"OpenGL cannot draw here ({type(error).__name__}: {error}); "
            "set MUJOCO_GL to egl, osmesa or glfw, whichever this machine has"
        ) from error
    return renderer
