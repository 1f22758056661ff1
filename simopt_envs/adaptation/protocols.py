"""What the SimOpt loop asks of policies, trainers and real systems."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np
from gymnasium.vector import VectorEnv

from simopt_envs.measured.trajectory import Trajectory
from simopt_envs.physics.parameters import Array

MakeVectorEnv = Callable[[int], VectorEnv]
"""From a number of worlds to a vector environment in which each episode has its own ξ ~ p(ξ)."""


class Policy(Protocol):
    """A policy without memory and without noise."""

    def act(self, observations: Array) -> np.ndarray:
        """Observations (n, o) -> actions (n, a)."""
        ...


P = TypeVar("P", bound=Policy)


class Trainer(Protocol[P]):
    """Reinforcement learning, of any kind.

    To write checkpoints the loop also needs :class:`PersistentTrainer`.
    """

    def __call__(self, make_vector_env: MakeVectorEnv, policy: P | None, rng: np.random.Generator) -> P:
        """Train a new policy, or ``policy`` further (which is left as it was).

        All randomness must come from ``rng``: resuming a run relies on it. A trainer may make several environments,
        and closes them.
        """
        ...


@runtime_checkable
class PersistentTrainer(Trainer[P], Protocol[P]):
    """A trainer whose policies can be kept on disk, with all that further training needs."""

    def save(self, policy: P, path: Path) -> None:
        """Write a policy to ``path``, whose folder exists; a file suffix may be added."""
        ...

    def load(self, path: Path) -> P:
        """Read what ``save`` wrote at the same ``path``."""
        ...


class RealSystem(Protocol):
    """What the simulation is adapted to. No reward is asked of it."""

    def rollout(self, policy: Policy, n: int, rng: np.random.Generator) -> list[Trajectory]:
        """Run n episodes of the policy and return what was measured."""
        ...


@runtime_checkable
class EvaluableSystem(Protocol):
    """A real system that can afford to count successes; the adaptation itself makes no use of it."""

    def evaluate(self, policy: Policy, episodes: int, rng: np.random.Generator) -> float | None:
        """The share of so many episodes that end in success; None where it cannot be told."""
        ...
