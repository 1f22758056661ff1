"""The environments' Gymnasium ids.

``gym.make("SimOpt/Drawer-v0")`` is to work without ``import simopt_envs``. Gymnasium dropped its plugin entry points in
1.0, so the wheel carries a ``.pth`` file that imports ``simopt_envs`` at start-up; to keep start-up free, that import
does nothing but arrange for :func:`register_envs` to run once ``gymnasium.envs`` has been imported.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType


def register_envs() -> None:
    """Register the environments with Gymnasium; calling it again changes nothing."""
    from gymnasium.envs.registration import register, registry

    for name, horizon in (("Drawer", 50), ("SwingPeg", 50)):
        if f"SimOpt/{name}-v0" not in registry:
            register(
                id=f"SimOpt/{name}-v0",
                entry_point=f"simopt_envs.tasks.{name.lower()}:make_env",
                vector_entry_point=f"simopt_envs.tasks.{name.lower()}:make_vector_env",
                max_episode_steps=horizon,
            )
    for name in ("Door", "Lift"):
        if f"SimOpt/Robosuite{name}-v0" not in registry:
            register(
                id=f"SimOpt/Robosuite{name}-v0",
                entry_point="simopt_envs.tasks.robosuite_env:RobosuiteEnv",
                kwargs={"task": name},
                max_episode_steps=500,
            )


def register_with_gymnasium() -> None:
    """Register now if Gymnasium is imported already, else as soon as it is."""
    if "gymnasium.envs" in sys.modules:
        register_envs()
    elif not any(isinstance(finder, _AfterGymnasium) for finder in sys.meta_path):
        sys.meta_path.insert(0, _AfterGymnasium())


class _AfterGymnasium(MetaPathFinder):
    """Finds nothing itself: it has ``gymnasium.envs`` call :func:`register_envs` at the end of its own import."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != "gymnasium.envs":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(fullname)
        if spec is None or spec.loader is None:
            return None
        execute = spec.loader.exec_module

        def execute_then_register(module: ModuleType) -> None:
            execute(module)
            register_envs()

        spec.loader.exec_module = execute_then_register  # type: ignore[method-assign]
        return spec
