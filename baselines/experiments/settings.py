"""What a cell may do where policies are trained."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from baselines.experiments.cell import Result
from baselines.experiments.environments import Randomization
from baselines.experiments.workspace import Training, Workspace
from simopt_envs.distributions import Gaussian

Hidden = Mapping[str, float]
"""Parameters of a hidden system that differ from nominal, and their values."""
_LEARNED = 0.9


@dataclass(frozen=True)
class Cure:
    """SimOpt from a first p(ξ): until the policy works on the hidden system, or for so many iterations.

    Attributes:
        start: the first p(ξ).
        hidden: the system.
        iterations: at most.
        real_rollouts: measured in each.
        noise, dropout: of the sensors; see :class:`~simopt_envs.adaptation.HiddenSystem`.
        enough: success at which the run ends.
    """

    start: Randomization
    hidden: Hidden
    iterations: int
    real_rollouts: int = 3
    noise: float = 0.002
    dropout: float = 0.0
    enough: float = 0.95

    def run(self, seed: int, workspace: Workspace) -> Result:
        """Per iteration, from 0 on: success, discrepancy, medians of what is hidden, steps of PPO."""
        iterations = workspace.cure(self, seed)
        return {
            "success": [i["target_success"] for i in iterations],
            "simulated_success": [i["sim_success"] for i in iterations],
            "discrepancy": [i["discrepancy"]["mean"] for i in iterations],
            "medians": [{name: i["median"][name] for name in self.hidden} for i in iterations],
            "steps": [i["train_steps"] for i in iterations],
            "episodes": workspace.effort.evaluation_episodes,
        }


@dataclass(frozen=True)
class Train:
    """A training from scratch, and what its policy can do on hidden systems.

    Attributes:
        randomization: p(ξ).
        targets: name -> hidden system.
    """

    randomization: Randomization
    targets: Mapping[str, Hidden]

    def run(self, seed: int, workspace: Workspace) -> Result:
        """Success by target, and how the training went."""
        training = workspace.train(self.randomization.env, self.randomization.gaussian(), seed)
        return _judged(training, self.randomization.env, self.targets, seed, workspace)


@dataclass(frozen=True)
class TrainLearned:
    """A training from scratch under the p(ξ) that SimOpt ended with.

    Attributes:
        cure: the run of SimOpt.
        targets: name -> hidden system.
    """

    cure: Cure
    targets: Mapping[str, Hidden]

    def run(self, seed: int, workspace: Workspace) -> Result:
        """Success by target, and how the training went."""
        first, last = self.cure.start.gaussian(), workspace.cure(self.cure, seed)[-1]
        p = Gaussian(first.space, last["mean"], last["covariance"])
        training = workspace.train(self.cure.start.env, p, seed)
        return _judged(training, self.cure.start.env, self.targets, seed, workspace)


@dataclass(frozen=True)
class Instance:
    """Whether one ξ drawn from a wide p(ξ) can be solved at all; the seed says which.

    A policy is trained for this ξ alone. To spare it the search for what all instances have in common, it starts from
    one that was trained under another randomization.

    Attributes:
        drawn_from: the wide p(ξ).
        start: p(ξ) of the policy to start from.
        training_seed: of that policy.
    """

    drawn_from: Randomization
    start: Randomization
    training_seed: int = 0

    def run(self, seed: int, workspace: Workspace) -> Result:
        """ξ, the success of the policy trained for it, and of the one it started from."""
        p, env = self.drawn_from.gaussian(), self.drawn_from.env
        xi = p.space.as_dict(p.sample(1, np.random.default_rng(seed))[0])
        start = workspace.train(env, self.start.gaussian(), self.training_seed)
        own = workspace.train(env, Randomization.exactly(env, xi).gaussian(), seed, start)
        return {
            "xi": xi,
            "success": workspace.success(env, own.policy, xi, seed),
            "success_before": workspace.success(env, start.policy, xi, seed),
            "steps": own.curve[-1][0],
        }


def _judged(training: Training, env: str, targets: Mapping[str, Hidden], seed: int, workspace: Workspace) -> Result:
    learned = [steps for steps, success in training.curve if success is not None and success >= _LEARNED]
    return {
        "success": {name: workspace.success(env, training.policy, hidden, seed) for name, hidden in targets.items()},
        "episodes": workspace.effort.evaluation_episodes,
        "own_success": training.curve[-1][1],
        "steps": training.curve[-1][0],
        "steps_to_90": learned[0] if learned else None,
        "curve": training.curve,
    }
