"""A hidden system that keeps a robot's log of the rollouts that SimOpt measures, for the gap workflow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec

from simopt_envs.adaptation import HiddenSystem
from simopt_envs.adaptation.protocols import Policy
from simopt_envs.measured.trajectory import Trajectory
from wrappers import RecordEpisodes


class LoggedSystem:
    """An environment of this package that plays the robot, and logs what a robot would log.

    Args:
        env: its id or spec.
        folder: where the log of each rollout goes; evaluations are not logged.
        columns: names or patterns of what is logged beside the commands of the drives.
        log_noise: of the log, by name or pattern of its columns.
        per_step: measurements that are logged in each step of the policy.
        parameters, noise: see :class:`~simopt_envs.adaptation.HiddenSystem`.

    Attributes:
        folder: as given.
    """

    def __init__(
        self,
        env: str | EnvSpec,
        folder: Path,
        columns: Sequence[str],
        log_noise: Mapping[str, float],
        per_step: int = 1,
        parameters: Mapping[str, float] | None = None,
        noise: float = 0.0,
    ):
        self.folder = folder

        def logged() -> gym.Env:
            return RecordEpisodes(gym.make(env), folder, columns=columns, noise=log_noise, per_step=per_step)

        self._system = HiddenSystem(env, parameters or {}, noise)
        self._logged = HiddenSystem(logged, parameters or {}, noise, vectorization_mode="sync")

    def identity(self) -> dict[str, Any]:
        """What identifies it in a checkpoint."""
        return self._system.identity()

    def rollout(self, policy: Policy, n: int, rng: np.random.Generator) -> list[Trajectory]:
        """Run n episodes, log them, and return what the sensors measured."""
        return self._logged.rollout(policy, n, rng)

    def evaluate(self, policy: Policy, episodes: int, rng: np.random.Generator) -> float | None:
        """The share of so many episodes that end in success."""
        return self._system.evaluate(policy, episodes, rng)

    def logs(self) -> list[Path]:
        """The logs so far."""
        return sorted(self.folder.glob("*.npz"))
