"""Finding hidden physics from fixed rollouts of a fixed policy: what compares costs, updates and searches cheaply."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from baselines.experiments.cell import Result
from baselines.experiments.environments import DRAWER, Randomization, simulator
from baselines.experiments.workspace import Workspace
from simopt_envs.adaptation import Discrepancy, Policy, RecordedSystem, Rollouts, SimOpt, Simulator
from simopt_envs.adaptation.updates import Update
from simopt_envs.distributions import Gaussian
from simopt_envs.measured.trajectory import Trajectory
from simopt_envs.physics.parameters import Array

LOCATED = 0.02
"""m: a cabinet located this well stands where a policy trained around the estimate (σ 2 cm) has practised."""
LEAST_XI = 10
"""An update draws at least so many."""
_MOST_UPDATES = 10


@dataclass(frozen=True)
class Problem:
    """A drawer policy that was measured once where the cabinet stands elsewhere; find ξ.

    Attributes:
        simulator: of the drawer.
        policy: trained at the nominal place.
        prior: p(ξ) of its training.
        truth: (d,), the hidden system in the prior's space, physical.
        real: what was measured.
        discrepancy: cost of ξ.
    """

    simulator: Simulator
    policy: Policy
    prior: Gaussian
    truth: Array
    real: list[Trajectory]
    discrepancy: Discrepancy

    @classmethod
    def make(cls, shift: float, seed: int, workspace: Workspace) -> Problem:
        """The cabinet stands ``shift`` [m] farther than thought."""
        p, simulation = Randomization.default(DRAWER).gaussian(), simulator(DRAWER)
        policy = workspace.train(DRAWER, p, seed).policy
        hidden = {"cabinet_x": shift}
        real = workspace.hidden(DRAWER, hidden).rollout(policy, 1, np.random.default_rng(seed))
        discrepancy = Discrepancy().for_channels(simulation.observation_names, simulation.discrepancy_weights)
        return cls(simulation, policy, p, p.space.values(hidden), real, discrepancy)

    def simulate(self, xi: Array) -> Rollouts:
        """Each ξ (n, d) once."""
        return self.simulator.rollout(self.policy, self.prior.space, xi, self.real, seed=0)

    def judge(self, xi: Array) -> Result:
        """How good an estimate (d,) is."""
        space, column = self.prior.space, self.prior.space.index("cabinet_x")
        off = (space.to_unconstrained(xi) - space.to_unconstrained(self.truth)) / self.prior.std
        cost = float(self.discrepancy(self.simulate(xi[None]), self.real)[0])
        return {
            "cabinet_x_error": float(abs(xi[column] - self.truth[column])),
            "distance": float(np.sqrt(np.mean(off**2))),
            "cost": cost if np.isfinite(cost) else None,
        }


@dataclass(frozen=True)
class Split:
    """How a number of rollouts is spent on updates."""

    updates: int
    xi: int

    @classmethod
    def of(cls, rollouts: int) -> Split:
        """In ten equal parts, or in fewer where these were too small."""
        updates = min(max(rollouts // LEAST_XI, 1), _MOST_UPDATES)
        return cls(updates, max(rollouts // updates, 2))


def adapt(problem: Problem, update: Update, rollouts: int, seed: int, tell: Callable[[str], None]) -> list[Array]:
    """SimOpt with the policy as it is: the medians (d,) of p(ξ) before the first update and after each."""
    split = Split.of(rollouts)
    loop = SimOpt(
        problem.simulator,
        problem.prior,
        None,
        RecordedSystem(problem.real),
        policy=problem.policy,
        discrepancy=problem.discrepancy,
        update=update,
        simulated_rollouts=split.xi,
        real_rollouts=len(problem.real),
        updates_per_iteration=1,
        evaluation_episodes=0,
        seed=seed,
    )
    medians = []
    for step in loop.run(split.updates):
        tell(f"update {step.index} of {split.updates}")
        medians.append(step.distribution.median)
    return medians
