"""The options of commands that say where their simulations are done."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from simopt_envs.engine import Engine, LocalEngine, OnProgress, RayEngine


@dataclass(frozen=True)
class EngineOptions:
    """Where independent simulations are done. The results are the same."""

    engine: Literal["local", "ray"] = "local"
    """This machine's cores, or tasks of Ray."""
    ray_address: str | None = None
    """With --engine ray: address of the cluster (HOST:PORT, or auto); by default the one that this machine is part of,
    else this machine alone."""

    def __post_init__(self) -> None:
        if self.ray_address is not None and self.engine != "ray":
            raise ValueError(f"--ray-address {self.ray_address} needs --engine ray")

    def make(self, on_progress: OnProgress | None = None, local: Callable[..., Engine] = LocalEngine) -> Engine:
        """The engine.

        Args:
            on_progress: called after each task.
            local: makes that of this machine's cores.

        Raises:
            ConnectionError: where no cluster answers at the address.
            ImportError: without Ray.
        """
        if self.engine == "ray":
            return RayEngine(self.ray_address, on_progress)
        return local(on_progress)
