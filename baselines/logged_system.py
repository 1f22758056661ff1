"""A hidden system that keeps a robot's log of the rollouts that SimOpt measures, for the gap workflow."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.envs.registration import EnvSpec

from simopt_envs.adaptation import HiddenSystem
from simopt_envs.adaptation.protocols import Policy
from simopt_envs.adaptation.systems import PerChannel
from simopt_envs.measured.trajectory import Trajectory
from wrappers import RecordEpisodes

_PERIOD = 0.01  # s between two measurements of the log, at least: a robot's log is faster than its policy
_LEAST_NOISE = 1e-3  # rad, m: from exacter logs the gap workflow takes touching fingers for a gap
_GRIPPER_NOISE = 1e-4  # m: of joints that drives move and the policy does not see


class LoggedSystem:
    """An environment of this package that plays the robot, and logs what a robot would log.

    That is, beside the commands of its drives, the positions of the joints that they move, and of what else the policy
    sees, with the noise that it sees: a millimetre or milliradian at least. The rollouts are those of the
    :class:`~simopt_envs.adaptation.HiddenSystem` without a log; evaluations are not logged.

    Args:
        env: its id or spec.
        folder: where the logs go.
        parameters, noise, dropout: see :class:`~simopt_envs.adaptation.HiddenSystem`.

    Raises:
        ValueError: for an environment that is not of this package.
    """

    def __init__(
        self,
        env: str | EnvSpec,
        folder: Path,
        parameters: Mapping[str, float] | None = None,
        noise: PerChannel = 0.0,
        dropout: PerChannel = 0.0,
    ):
        hidden = parameters or {}
        self._system = HiddenSystem(env, hidden, noise, dropout)
        seen = dict(zip(self._system.observation_names, self._system.noise.tolist(), strict=True))
        log_noise, per_step = _log_of(env, seen)
        self._folder, self._unfinished = folder, folder / ".unfinished"
        self._recorders: list[RecordEpisodes] = []

        def logged() -> gym.Env:
            recorder = RecordEpisodes(
                gym.make(env), self._unfinished, columns=list(log_noise), noise=log_noise, per_step=per_step
            )
            self._recorders.append(recorder)
            return recorder

        self._logged = HiddenSystem(logged, hidden, noise, dropout, vectorization_mode="sync")

    def identity(self) -> dict[str, Any]:
        """What identifies it in a checkpoint: nothing that a system without a log does not have."""
        return self._system.identity()

    def rollout(self, policy: Policy, n: int, rng: np.random.Generator) -> list[Trajectory]:
        """Run n episodes, log them, and return what the sensors measured."""
        shutil.rmtree(self._unfinished, ignore_errors=True)  # of a run that was stopped
        self._recorders.clear()
        rolled = self._logged.rollout(policy, n, rng)
        for trajectory, recorder in zip(rolled, self._recorders, strict=True):
            recorder.recordings[0].replace(self.log(trajectory))
        shutil.rmtree(self._unfinished)
        return rolled

    def evaluate(self, policy: Policy, episodes: int, rng: np.random.Generator) -> float | None:
        """The share of so many episodes that end in success."""
        return self._system.evaluate(policy, episodes, rng)

    def log(self, trajectory: Trajectory) -> Path:
        """The log of a measured episode.

        It is called after what was measured: episodes that are run again, as the first time was stopped, are logged
        once.
        """
        return self._folder / f"{hashlib.sha256(trajectory.observations.tobytes()).hexdigest()[:12]}.npz"


def _log_of(env: str | EnvSpec, seen: Mapping[str, float]) -> tuple[dict[str, float], int]:
    """What is logged of an environment: column -> standard deviation of its noise; measurements per step.

    ``seen`` has the observed channels and their noise.
    """
    made = gym.make(env)
    unwrapped: Any = made.unwrapped
    made.close()
    if not hasattr(unwrapped, "task"):
        raise ValueError(f"{unwrapped.spec.id} is no environment of this package; wrap it in RecordEpisodes to log it")
    model: mujoco.MjModel = unwrapped.model
    driven = set(model.actuator_trnid[model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT), 0])
    for pair in np.transpose([model.eq_obj1id, model.eq_obj2id])[model.eq_type == int(mujoco.mjtEq.mjEQ_JOINT)]:
        driven |= set(pair) if driven & set(pair) else set()
    sites = {model.site(i).name for i in range(model.nsite)}
    columns = {f"qpos/{model.joint(i).name}": _GRIPPER_NOISE for i in driven}
    for channel, std in seen.items():
        site, _, axis = channel.rpartition("_")
        columns[f"site/{site}/{axis}" if site in sites else f"qpos/{channel}"] = max(std, _LEAST_NOISE)
    substeps = unwrapped.task.substeps
    often = [n for n in range(1, substeps + 1) if substeps % n == 0 and unwrapped.dt / n >= _PERIOD]
    return columns, max(often, default=1)
