"""The library of physical effects that a model may lack. A file in this folder with an :class:`Effect` joins it."""

from __future__ import annotations

import importlib
import pkgutil

import mujoco

from simopt_envs.physics.effects.effect import Effect, Motion, object_name

for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")

EFFECTS: dict[str, Effect] = {effect.name: effect() for effect in sorted(Effect.__subclasses__(), key=lambda e: e.name)}
"""Every effect by its name."""


def require_mujoco() -> None:
    """ImportError where MuJoCo is too old for the effects, which use what came with 4.0."""
    if int(mujoco.__version__.split(".")[0]) < 4:
        raise ImportError(f"physical effects need mujoco >= 4.0, found {mujoco.__version__}")


__all__ = ["EFFECTS", "Effect", "Motion", "object_name", "require_mujoco"]
