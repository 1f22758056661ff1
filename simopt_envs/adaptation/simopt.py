"""The SimOpt loop: Algorithm 1 of Chebotar et al. 2019, "Closing the Sim-to-Real Loop"."""

from __future__ import annotations

import itertools
import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv

from simopt_envs.adaptation.checkpoint import Checkpoint, Content, Result, identity
from simopt_envs.adaptation.discrepancy import Discrepancy, Verdict, judge
from simopt_envs.adaptation.protocols import EvaluableSystem, PersistentTrainer, Policy, RealSystem, Trainer
from simopt_envs.adaptation.records import Event, Iteration, pack_trajectories, unpack_trajectories
from simopt_envs.adaptation.rollouts import Counted, require_measured
from simopt_envs.adaptation.search import (
    is_better_further_out,
    is_stuck,
    own_and_far,
    sample_further_out,
    update_further_out,
)
from simopt_envs.adaptation.simulator import EnvSimulator, Simulator
from simopt_envs.adaptation.updates import REPS, Update
from simopt_envs.distributions.gaussian import Gaussian
from simopt_envs.measured.trajectory import Trajectory
from simopt_envs.physics.parameters import Array

# Least standard deviations, as shares of the first ones. As long as no ξ drawn explains the measured episodes, p(ξ) has
# not arrived, and to narrow it would only shorten its next steps, which go with its width.
_FLOOR_SEARCHING, _FLOOR_ARRIVED = 0.5, 0.05
_PHASES = ("train", "evaluate", "real", "measure", "update")


@dataclass(frozen=True)
class _Measurement:
    """Real episodes of a policy, and how ξ ~ p(ξ) compare with them."""

    real: list[Trajectory]
    xi: Array
    costs: Array
    simulated: list[Trajectory]
    verdict: Verdict
    sim_success: float | None


class SimOpt:
    """Adapts p(ξ) to a real system, and trains a policy under it: in turns, until the policy works there.

    Iteration 0 trains under the distribution given and measures ``real_rollouts`` episodes of the policy on the real
    system. Each further iteration moves p(ξ) towards what these episodes show, trains the policy further under it, and
    measures again.

    Args:
        env_id: of a registered environment; or a :class:`Simulator`.
        distribution: p(ξ) to start from, over some of the simulator's parameters.
        trainer: trains the policy; None keeps the given one.
        real_system: what to adapt to.
        policy: where the first training starts, or the fixed policy, which recordings were then made with. Without
            it, or with a trainer, their actions are replayed.
        discrepancy: the cost of ξ; without weights, those that the simulator states are used.
        update: how p(ξ) moves; REPS by default.
        simulated_rollouts: simulated episodes of one update; each ξ drawn takes ``real_rollouts`` of them.
        real_rollouts: episodes measured on the real system per iteration.
        updates_per_iteration: updates on the same measured episodes, each from ξ drawn anew; from further out once they
            have come to a standstill and nothing drawn explains the episodes (:mod:`simopt_envs.adaptation.search`).
        evaluation_episodes: episodes that count successes on a system that has ``evaluate``; never used to adapt.
        seed: of everything that is random.
        directory: where ``result.json`` and checkpoints are written; None writes nothing.
        on_event: called when a phase begins and ends.

    Raises:
        ValueError: for counts that are too small, parameters that the simulator does not have, an environment whose
            episodes cannot begin as measured ones did, weights that do not fit the observation, or neither trainer nor
            policy.
        TypeError: for a directory with a trainer that cannot save and load policies.
    """

    def __init__(
        self,
        env_id: str | Simulator,
        distribution: Gaussian,
        trainer: Trainer[Any] | None,
        real_system: RealSystem,
        *,
        policy: Policy | None = None,
        discrepancy: Discrepancy | None = None,
        update: Update | None = None,
        simulated_rollouts: int = 600,
        real_rollouts: int = 3,
        updates_per_iteration: int = 3,
        evaluation_episodes: int = 100,
        seed: int = 0,
        directory: str | Path | None = None,
        on_event: Callable[[Event], None] | None = None,
    ):
        for name, value, least in (
            ("real_rollouts", real_rollouts, 1),
            ("simulated_rollouts", simulated_rollouts, 2 * real_rollouts),
            ("updates_per_iteration", updates_per_iteration, 1),
            ("evaluation_episodes", evaluation_episodes, 0),
            ("seed", seed, 0),
        ):
            if value < least:
                raise ValueError(f"{name} must be at least {least}, got {value}")
        needs_policy = getattr(real_system, "needs_policy", True)
        if trainer is None and policy is None and needs_policy:
            raise ValueError(f"{type(real_system).__name__} needs a policy to run: give a trainer or a policy")
        if directory is not None and trainer is not None and not isinstance(trainer, PersistentTrainer):
            raise TypeError(f"{type(trainer).__name__} has no save and load, which checkpoints in a directory need")
        self.simulator: Simulator = EnvSimulator(env_id) if isinstance(env_id, str) else env_id
        self.simulator.parameters.subset(distribution.space.names)  # raises for names that it does not have
        if isinstance(self.simulator, EnvSimulator):
            self.simulator.require_start()
        self.distribution = distribution
        self.trainer = trainer
        self.real_system = real_system
        self.policy = policy
        self.discrepancy = (discrepancy or Discrepancy()).for_channels(
            self.simulator.observation_names, self.simulator.discrepancy_weights
        )
        self.update: Update = update or REPS()
        self.simulated_rollouts = simulated_rollouts
        self.real_rollouts = real_rollouts
        self.updates_per_iteration = updates_per_iteration
        self.evaluation_episodes = evaluation_episodes
        self.seed = seed
        self.directory = None if directory is None else Path(directory)
        self._on_event = on_event or (lambda event: None)
        self._replays = trainer is not None and not needs_policy  # recordings are not of a policy trained here

    def run(self, iterations: int, resume: bool = False) -> Iterator[Iteration]:
        """Yield iteration 0, before any adaptation, and so many further ones.

        Args:
            iterations: updates of p(ξ), each followed by a training.
            resume: go on with the run in the directory, if there is one: phases that are on disk are not computed
                again, and the results are those of an undisturbed run, bit for bit.

        Raises:
            FileExistsError: if the directory holds a run and ``resume`` is False.
            ValueError: if it holds a run with other settings, or with more iterations.
            RuntimeError: if every simulation of an update diverged.
        """
        if iterations < 0:
            raise ValueError(f"iterations must be >= 0, got {iterations}")
        checkpoint = Checkpoint(self.directory, self._settings(), resume)
        finished = next(k for k in itertools.count() if not checkpoint.has(_name(k, "measure")))  # its last phase
        if finished > iterations + 1:
            raise ValueError(
                f"{self.directory} holds a run of {finished - 1} iterations; resume it with as many or more, not with "
                f"{iterations}"
            )
        return self._iterate(iterations, checkpoint, finished)

    def _iterate(self, iterations: int, checkpoint: Checkpoint, finished: int) -> Iterator[Iteration]:
        """See :meth:`run`; so many of the iterations are on disk."""
        distribution, policy = self.distribution, self.policy
        measurement: _Measurement | None = None
        entries: list[dict[str, Any]] = []
        for k in range(iterations + 1):
            before = distribution
            updates: list[Result] = []
            if measurement is not None:
                start = before
                for j in range(self.updates_per_iteration):
                    stuck = is_stuck([u["costs"] for u in updates], measurement.verdict.threshold)
                    update = self._update(checkpoint, k, j, distribution, policy, measurement, start if stuck else None)
                    updates.append(update)
                    distribution = Gaussian.from_dict(json.loads(str(update["distribution"])), self.distribution.space)
                    if stuck and is_better_further_out(update["costs"]):
                        start = distribution
            policy, training = self._train(checkpoint, k, distribution, policy)
            success = self._evaluate(checkpoint, k, policy)
            measurement = self._measure(checkpoint, k, distribution, policy)
            rolled = [t.success for t in measurement.real]
            if success is None and None not in rolled:
                success = float(np.mean(np.array(rolled, dtype=bool)))
            iteration = Iteration(
                index=k,
                distribution=distribution,
                policy=policy,
                kl=max((float(u["kl"]) for u in updates), default=0.0),
                total_kl=float(distribution.kl(before)) if updates else 0.0,
                effective_sample_size=min((float(u["effective_sample_size"]) for u in updates), default=None),
                relevance=updates[-1]["relevance"] if updates else None,
                real=measurement.real,
                xi=measurement.xi,
                costs=measurement.costs,
                simulated=measurement.simulated,
                verdict=measurement.verdict,
                target_success=success,
                sim_success=measurement.sim_success,
                train_seconds=float(training["seconds"]),
                train_steps=int(training["steps"]),
                # The first update uses the simulations that the last iteration measured.
                sim_rollouts=max(len(updates), 1) * len(measurement.costs) * len(measurement.real),
                real_rollouts=len(measurement.real),
            )
            entries.append(iteration.to_dict())
            if len(entries) >= finished:  # so that no interruption leaves fewer on disk than there were
                checkpoint.write_result(self._result(entries))
            yield iteration

    def _train(
        self, checkpoint: Checkpoint, k: int, distribution: Gaussian, policy: Policy | None
    ) -> tuple[Policy | None, Result]:
        """The policy trained further under the distribution, and what it took."""
        trainer = self.trainer
        if trainer is None:
            return policy, {"seconds": np.zeros(()), "steps": np.zeros(())}
        worlds, random = self._rngs(k, "train")
        steps = 0

        def count(stepped: int) -> None:
            nonlocal steps
            steps += stepped

        def make_vector_env(num_envs: int) -> VectorEnv:
            return Counted(self.simulator.make_vector_env(num_envs, distribution, int(worlds.integers(2**31))), count)

        def compute() -> Content:
            nonlocal policy
            start = time.perf_counter()
            policy = trainer(make_vector_env, policy, random)
            return {"seconds": time.perf_counter() - start, "steps": steps}

        if not isinstance(trainer, PersistentTrainer) or checkpoint.directory is None:
            training = self._phase(checkpoint, k, "train", compute)
            return policy, training
        training = self._phase(checkpoint, k, "train", compute, lambda folder: trainer.save(policy, folder / "policy"))
        return trainer.load(checkpoint.folder(_name(k, "train")) / "policy"), training  # as a resumed run has it

    def _evaluate(self, checkpoint: Checkpoint, k: int, policy: Policy | None) -> float | None:
        system = self.real_system
        if not isinstance(system, EvaluableSystem) or policy is None or self.evaluation_episodes == 0:
            return None
        (random,) = self._rngs(k, "evaluate", 1)

        def compute() -> Content:
            success = system.evaluate(policy, self.evaluation_episodes, random)
            return {"success": math.nan if success is None else success}

        return _number(self._phase(checkpoint, k, "evaluate", compute)["success"])

    def _measure(self, checkpoint: Checkpoint, k: int, distribution: Gaussian, policy: Policy | None) -> _Measurement:
        """Run the policy on the real system, and compare ξ ~ p(ξ) with what was measured."""
        (random,) = self._rngs(k, "real", 1)

        def roll_out() -> Content:
            real = self.real_system.rollout(policy, self.real_rollouts, random)  # type: ignore[arg-type]
            require_measured(real, self.simulator.observation_names)
            return pack_trajectories(real)

        real = unpack_trajectories(self._phase(checkpoint, k, "real", roll_out))
        draws, noise = self._rngs(k, "measure")

        def compare() -> Content:
            xi = distribution.sample(self.simulated_rollouts // len(real), draws)
            costs, simulated, success = self._simulate(distribution, xi, policy, real, draws)
            verdict = json.dumps(asdict(judge(self.discrepancy, costs, real, noise)))
            success = math.nan if success is None else success
            scalars: Content = {"sim_success": success, "verdict": verdict}
            return {**pack_trajectories(simulated), "xi": xi, "costs": costs, **scalars}

        result = self._phase(checkpoint, k, "measure", compare)
        return _Measurement(
            real,
            result["xi"],
            result["costs"],
            unpack_trajectories(result),
            Verdict(**json.loads(str(result["verdict"]))),
            _number(result["sim_success"]),
        )

    def _update(
        self,
        checkpoint: Checkpoint,
        k: int,
        j: int,
        distribution: Gaussian,
        policy: Policy | None,
        measurement: _Measurement,
        stuck_since: Gaussian | None,
    ) -> Result:
        """One step of p(ξ) towards the measured episodes; stuck ones also look further out from where they began."""
        draws, random, noise = self._rngs(k, "update", 3, j)

        def compute() -> Content:
            xi, costs = measurement.xi, measurement.costs
            if j > 0:
                n = len(xi)
                if stuck_since is None:
                    xi = distribution.sample(n, draws)
                else:
                    xi = sample_further_out(distribution, stuck_since, n, draws)
                costs, _, _ = self._simulate(distribution, xi, policy, measurement.real, draws)
            own = costs if stuck_since is None else own_and_far(costs)[0]
            arrived = judge(self.discrepancy, own, measurement.real, noise).label != "unexplained"
            floor = (_FLOOR_ARRIVED if arrived else _FLOOR_SEARCHING) * self.distribution.std
            if stuck_since is None:
                step = self.update(distribution, xi, costs, random, std_floor=floor)
            else:
                step = update_further_out(self.update, distribution, stuck_since, xi, costs, random, floor)
            return {
                "distribution": json.dumps(step.distribution.to_dict()),
                "kl": step.kl,
                "effective_sample_size": step.effective_sample_size,
                "relevance": step.relevance,
                "xi": xi,
                "costs": costs,
            }

        return self._phase(checkpoint, k, f"update_{j}", compute)

    def _simulate(
        self,
        distribution: Gaussian,
        xi: Array,
        policy: Policy | None,
        real: Sequence[Trajectory],
        rng: np.random.Generator,
    ) -> tuple[Array, list[Trajectory], float | None]:
        """Costs of ξ that were drawn for an update of p(ξ), the episodes of the best, and the share of successes."""
        acting = None if self._replays else policy
        rollouts = self.simulator.rollout(acting, distribution.space, xi, real, int(rng.integers(2**31)))
        costs = self.discrepancy(rollouts, real)
        if not np.isfinite(costs).any():
            raise RuntimeError(f"the simulation diverged for every one of {len(xi)} ξ drawn from\n{distribution}")
        best = int(np.argmin(costs))
        simulated = [rollouts.trajectory(best, i) for i in range(len(real))]
        return costs, simulated, rollouts.success_rate()

    def _phase(
        self,
        checkpoint: Checkpoint,
        k: int,
        phase: str,
        compute: Callable[[], Content],
        save: Callable[[Path], None] | None = None,
    ) -> Result:
        restored = checkpoint.has(_name(k, phase))
        if not restored:
            self._on_event(Event(k, phase, "started"))
        result = checkpoint.phase(_name(k, phase), compute, save)
        self._on_event(Event(k, phase, "restored" if restored else "finished"))
        return result

    def _rngs(self, k: int, phase: str, n: int = 2, j: int = 0) -> list[np.random.Generator]:
        """n generators for a phase, which depend on nothing that happened before it."""
        sequence = np.random.SeedSequence(self.seed, spawn_key=(k, _PHASES.index(phase), j))
        return [np.random.default_rng(child) for child in sequence.spawn(n)]

    def _settings(self) -> dict[str, Any]:
        return {
            "simulator": identity(self.simulator),
            "distribution": self.distribution.to_dict(),
            "trainer": identity(self.trainer),
            "policy": identity(self.policy),
            "real_system": identity(self.real_system),
            "discrepancy": identity(self.discrepancy),
            "update": identity(self.update),
            "simulated_rollouts": self.simulated_rollouts,
            "real_rollouts": self.real_rollouts,
            "updates_per_iteration": self.updates_per_iteration,
            "evaluation_episodes": self.evaluation_episodes,
            "seed": self.seed,
        }

    def _result(self, entries: list[dict[str, Any]]) -> dict[str, Any]:
        space = self.distribution.space
        return {
            "env_id": getattr(self.simulator, "env_id", type(self.simulator).__name__),
            "seed": self.seed,
            "parameter_names": list(space.names),
            "units": list(space.units),
            "coordinates": [p.coordinate for p in space],
            "nominal": space.nominal.tolist(),
            "observation_names": list(self.simulator.observation_names),
            "iterations": entries,
        }


def _number(stored: np.ndarray) -> float | None:
    """A number that a phase stored, NaN for None."""
    return None if np.isnan(stored) else float(stored)


def _name(k: int, phase: str) -> str:
    return f"{k:03d}_{phase}"
