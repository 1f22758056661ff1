"""What the SimOpt loop reports: an :class:`Iteration` each, and their form in ``result.json``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from simopt_envs.adaptation.discrepancy import Verdict
from simopt_envs.adaptation.protocols import Policy
from simopt_envs.distributions.gaussian import Gaussian
from simopt_envs.measured.trajectory import Trajectory
from simopt_envs.physics.parameters import Array


@dataclass(frozen=True)
class Event:
    """Something that the loop begins or has done, for progress bars and logs.

    Attributes:
        iteration: 0 is before any adaptation.
        phase: "update_0", "update_1", ..., "train", "evaluate", "real" (rollouts on the real system), "measure" (their
            discrepancy from the simulation).
        status: "restored" is a phase that an earlier process finished.
    """

    iteration: int
    phase: str
    status: Literal["started", "finished", "restored"]


@dataclass(frozen=True)
class Iteration:
    """One iteration of SimOpt: p(ξ) as updated, the policy trained under it, and how both fare on the real system.

    Attributes:
        index: 0 is before any adaptation.
        distribution: p(ξ) of this iteration.
        policy: trained under it, or the fixed one; None where recordings are replayed.
        kl: largest KL divergence of the single updates that led here, as their rule bounds it; 0 in iteration 0.
        total_kl: KL divergence of ``distribution`` from that of the iteration before.
        effective_sample_size: the smallest of those updates; None in iteration 0.
        relevance: (d,), within [0, 1], how far the costs of the last update spoke about each parameter; None in
            iteration 0.
        real: the episodes measured with ``policy``, which the next iteration adapts to.
        xi, costs: ξ drawn from ``distribution`` (n, d), physical, and their discrepancies (n,) from ``real``.
        simulated: the episodes of the best of these ξ, one for each of ``real``.
        verdict: whether these ξ explain ``real``.
        target_success: share of successes on the real system: of its evaluation, or else of ``real``, or None.
        sim_success: share of successes in those simulations of ``xi`` that came to their end within the length of the
            measured episodes, or None.
        train_seconds: wall time of the training.
        train_steps: control steps of the training.
        sim_rollouts: simulated episodes since the iteration before, outside the training.
        real_rollouts: episodes measured since the iteration before, outside the evaluation.
    """

    index: int
    distribution: Gaussian
    policy: Policy | None
    kl: float
    total_kl: float
    effective_sample_size: float | None
    relevance: Array | None
    real: list[Trajectory]
    xi: Array
    costs: Array
    simulated: list[Trajectory]
    verdict: Verdict
    target_success: float | None
    sim_success: float | None
    train_seconds: float
    train_steps: int
    sim_rollouts: int
    real_rollouts: int

    @property
    def discrepancy_mean(self) -> float:
        """Mean of the costs of the simulations that did not diverge."""
        return float(self.costs[np.isfinite(self.costs)].mean())

    @property
    def discrepancy_min(self) -> float:
        """Least of the costs."""
        return float(self.costs.min())

    @property
    def best_xi(self) -> dict[str, float]:
        """The physical values of the ξ of least cost."""
        return self.distribution.space.as_dict(self.xi[np.argmin(self.costs)])

    def to_dict(self) -> dict[str, Any]:
        """Its entry in ``result.json``; mean, std and covariance are in unconstrained coordinates."""
        return {
            "index": self.index,
            "mean": self.distribution.mean.tolist(),
            "std": self.distribution.std.tolist(),
            "covariance": self.distribution.covariance.tolist(),
            "median": self.distribution.space.as_dict(self.distribution.median),
            "kl": self.kl,
            "total_kl": self.total_kl,
            "effective_sample_size": self.effective_sample_size,
            "relevance": None if self.relevance is None else self.relevance.tolist(),
            "discrepancy": {"mean": self.discrepancy_mean, "min": self.discrepancy_min},
            "diverged": int(np.isinf(self.costs).sum()),
            "best_xi": self.best_xi,
            "verdict": asdict(self.verdict),
            "target_success": self.target_success,
            "sim_success": self.sim_success,
            "train_seconds": self.train_seconds,
            "train_steps": self.train_steps,
            "sim_rollouts": self.sim_rollouts,
            "real_rollouts": self.real_rollouts,
        }


def pack_trajectories(trajectories: Sequence[Trajectory]) -> dict[str, np.ndarray]:
    """Trajectories as arrays for an npz file."""
    arrays: dict[str, np.ndarray] = {}
    for i, trajectory in enumerate(trajectories):
        arrays[f"observations_{i}"], arrays[f"actions_{i}"] = trajectory.observations, trajectory.actions
        arrays[f"success_{i}"] = np.array(math.nan if trajectory.success is None else float(trajectory.success))
    return arrays


def unpack_trajectories(arrays: Mapping[str, np.ndarray]) -> list[Trajectory]:
    """The inverse of :func:`pack_trajectories`; other arrays are passed over."""
    count = sum(name.startswith("success_") for name in arrays)
    return [
        Trajectory(
            arrays[f"observations_{i}"],
            arrays[f"actions_{i}"],
            None if np.isnan(arrays[f"success_{i}"]) else bool(arrays[f"success_{i}"]),
        )
        for i in range(count)
    ]
