"""What several cells need and takes long to make: trained policies and runs of SimOpt, kept on disk."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from filelock import FileLock
from gymnasium.vector import VectorEnv

from baselines.commands.inputs import UPDATES
from baselines.experiments.cell import described, digest
from baselines.experiments.environments import ENVIRONMENTS, simulator
from baselines.ppo_torch import MakeVectorEnv, PPOConfig, Progress, TorchPolicy, TorchPPO
from simopt_envs.adaptation import Event, HiddenSystem, SimOpt
from simopt_envs.adaptation.checkpoint import write_json
from simopt_envs.distributions import Gaussian

if TYPE_CHECKING:
    from baselines.experiments.settings import Cure


@dataclass(frozen=True)
class Effort:
    """What cells may spend; results of different efforts are not mixed.

    Attributes:
        ppo: every training.
        xi_per_update: ξ that an update of p(ξ) draws in a run of SimOpt.
        updates: of p(ξ) in an iteration of SimOpt.
        evaluation_episodes: that count successes.
        fit_share: of the rollouts that a fit without training may take.
    """

    ppo: PPOConfig = field(default_factory=PPOConfig)
    xi_per_update: int = 200
    updates: int = UPDATES
    evaluation_episodes: int = 100
    fit_share: float = 1.0


SMOKE = Effort(
    PPOConfig(num_envs=8, iterations=2, warm_start_iterations=1, minibatches=1, epochs=1, evaluation_episodes=1),
    xi_per_update=6,
    updates=2,
    evaluation_episodes=4,
    fit_share=0.02,
)
"""Enough to see that everything runs, and nothing else."""


@dataclass(frozen=True)
class Training:
    """A finished training.

    Attributes:
        key: names it.
        policy: trained.
        curve: (control steps, success) after each iteration; None before the first successes were counted.
    """

    key: str
    policy: TorchPolicy
    curve: list[tuple[int, float | None]]


class _Begun(TorchPPO):
    """PPO whose first training is done: it gives its policy."""

    def __init__(self, policy: TorchPolicy, config: PPOConfig, on_progress: Callable[[Progress], None]):
        super().__init__(config, on_progress)
        self._policy = policy

    def __call__(
        self, make_vector_env: MakeVectorEnv, policy: TorchPolicy | None, rng: np.random.Generator
    ) -> TorchPolicy:
        return self._policy if policy is None else super().__call__(make_vector_env, policy, rng)


class Workspace:
    """Makes what is not there yet, and gives what is. Of several processes that want the same, one makes it.

    Args:
        folder: holds it.
        effort: what it may take.
        tell: is told what goes on.
    """

    def __init__(self, folder: Path, effort: Effort, tell: Callable[[str], None] = lambda text: None):
        self.folder, self.effort, self.tell = folder, effort, tell

    def __reduce__(self) -> tuple[Any, ...]:
        """For another process, where there is nobody to tell."""
        return Workspace, (self.folder, self.effort)

    def train(self, env: str, p: Gaussian, seed: int, start: Training | None = None) -> Training:
        """A policy trained under p(ξ): from scratch, or from where another training ended."""
        ppo = self.effort.ppo
        begun = None if start is None else start.key
        made_with = {"env": env, "p": p.to_dict(), "ppo": asdict(ppo), "seed": seed, "start": begun}
        key = digest(made_with)
        folder = self.folder / "policies" / key
        with _alone(folder):
            if not folder.exists():
                self._train(env, p, seed, start, folder, made_with)
        stored = json.loads((folder / "training.json").read_text(encoding="utf-8"))
        return Training(key, TorchPPO().load(folder / "policy.pt"), [tuple(point) for point in stored["curve"]])

    def cure(self, cure: Cure, seed: int) -> list[dict[str, Any]]:
        """The iterations of a run of SimOpt, as in its ``result.json``; it goes on where it was interrupted."""
        env, effort = cure.start.env, self.effort
        p = cure.start.gaussian()
        begun = self.train(env, p, seed)
        folder = self.folder / "cures" / digest([described(cure), described(effort), seed])
        loop = SimOpt(
            simulator(env),
            p,
            _Begun(begun.policy, effort.ppo, self._training),
            self.hidden(env, cure.hidden, cure.noise, cure.dropout),
            simulated_rollouts=effort.xi_per_update * cure.real_rollouts,
            real_rollouts=cure.real_rollouts,
            updates_per_iteration=effort.updates,
            evaluation_episodes=effort.evaluation_episodes,
            seed=seed,
            directory=folder,
            on_event=self._event,
        )
        with _alone(folder):
            for step in loop.run(cure.iterations, resume=True):
                if step.target_success is not None and step.target_success >= cure.enough:
                    break
        iterations: list[dict[str, Any]] = json.loads((folder / "result.json").read_text())["iterations"]
        iterations[0]["train_steps"] = begun.policy.steps_trained
        return iterations[: step.index + 1]

    def hidden(
        self, env: str, parameters: Mapping[str, float], noise: float = 0.002, dropout: float = 0.0
    ) -> HiddenSystem:
        """A system with hidden physics; see :class:`HiddenSystem`."""
        return HiddenSystem(ENVIRONMENTS[env], parameters, noise, dropout)

    def success(self, env: str, policy: TorchPolicy, parameters: Mapping[str, float], seed: int) -> float:
        """The share of episodes in which a policy succeeds on hidden physics."""
        self.tell("counting successes")
        random = np.random.default_rng(seed)
        success = self.hidden(env, parameters).evaluate(policy, self.effort.evaluation_episodes, random)
        assert success is not None
        return success

    def _train(
        self, env: str, p: Gaussian, seed: int, start: Training | None, folder: Path, made_with: dict[str, Any]
    ) -> None:
        curve = []
        worlds, random = np.random.default_rng(seed).spawn(2)

        def make_vector_env(num_envs: int) -> VectorEnv:
            return simulator(env).make_vector_env(num_envs, p, int(worlds.integers(2**31)))

        def note(progress: Progress) -> None:
            curve.append((progress.steps, None if np.isnan(progress.success) else progress.success))
            self._training(progress)

        trainer = TorchPPO(self.effort.ppo, on_progress=note)
        policy = trainer(make_vector_env, None if start is None else start.policy, random)
        unfinished = folder.with_name(f".{folder.name}")
        shutil.rmtree(unfinished, ignore_errors=True)  # of a process that was killed
        unfinished.mkdir()
        trainer.save(policy, unfinished / "policy.pt")
        write_json(unfinished / "training.json", {**made_with, "curve": curve})
        unfinished.rename(folder)

    def _training(self, progress: Progress) -> None:
        success = "" if np.isnan(progress.success) else f", success {progress.success:.0%}"
        self.tell(f"training {progress.steps / progress.total_steps:.0%}{success}")

    def _event(self, event: Event) -> None:
        if event.status == "started":
            self.tell(f"iteration {event.iteration}, {event.phase.replace('_', ' ')}")


def _alone(folder: Path) -> FileLock:
    """A context in which no other process makes a folder; the lock of one that is killed opens."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    return FileLock(folder.with_name(f"{folder.name}.lock"))
