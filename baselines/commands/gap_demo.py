"""``simopt-envs demo --task gap``: what SimOpt cannot cure by its parameters, the gap workflow names and repairs."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from baselines.commands import inputs
from baselines.commands.gap import explain, told, told_effect
from baselines.commands.progress import Display
from baselines.commands.runs import control_period, run_loop
from baselines.logged_system import LoggedSystem
from simopt_envs.adaptation import EnvSimulator, SimOpt
from simopt_envs.adaptation.records import Iteration
from simopt_envs.distributions import Gaussian
from simopt_envs.physics import ParameterSpace
from simopt_envs.physics.effects import EFFECTS
from simopt_envs.report import Details
from simopt_envs.tasks.effects import with_effects

ENV_ID = "SimOpt/Drawer-v0"
HIDDEN: tuple[Mapping[str, Any], ...] = (
    {"effect": "payload", "where": "body:link7", "parameters": {"mass": 2.5}},
    {"effect": "joint_spring", "where": "joint:joint2", "parameters": {"stiffness": 100.0, "reference": -0.6}},
    {"effect": "coulomb_friction", "where": "joint:joint2", "parameters": {"frictionloss": 40.0}},
)
"""What the hidden arm may have: a load at the hand, a cable that pulls the shoulder, a shoulder that binds."""

_NOISE = 0.002  # rad, m
_ROLLOUTS = 3  # measured per iteration
_SIMULATED = 300  # an update: half of what ``adapt`` takes, in half the time
_ENOUGH = 0.9
_ITERATIONS = 3  # in the repaired environment, at most: one left seed 2 at 86 %; alone SimOpt has one
_LEAST_STD = 0.02  # of a new parameter's value


@dataclass(frozen=True)
class GapDemo:
    """The demonstration.

    Attributes:
        out: folder of the reports: of SimOpt alone, and under it those of the gap and of SimOpt in the repaired
            environment.
        seed: of everything random; it chooses what is hidden.
        typed: the command line.
    """

    out: Path
    seed: int
    typed: str

    def run(self) -> None:
        """Adapt, name what is missing, repair, adapt again; whatever is there already is kept."""
        inputs.require_free(self.out, resume=True)
        hidden, display = HIDDEN[self.seed % len(HIDDEN)], Display()
        robot = LoggedSystem(with_effects(ENV_ID, [hidden]), self.out / "recordings", noise=_NOISE)
        display.say(f"{ENV_ID}: the target has what no parameter of the simulation stands for: {told_effect(hidden)}")
        simulator = EnvSimulator(ENV_ID)
        prior = inputs.distribution(ENV_ID, simulator.parameters, ())
        first, alone = self._adapt(simulator, prior, robot, self.out, iterations=1)

        # The rollouts that SimOpt adapted to, in vain, and those that showed it.
        logs = dict.fromkeys(robot.log(trajectory) for step in (first, alone) for trajectory in step.real)
        effects = self._missing(prior, list(logs), display)
        if not effects:
            display.say("The gap workflow names nothing; the simulation cannot be repaired.")
            return
        repaired = EnvSimulator(with_effects(ENV_ID, effects))
        joined = _joined(prior, repaired.parameters, effects)
        # p(ξ) is the first one again, and so is the policy: the other was trained for what SimOpt took the gap for.
        _, after = self._adapt(repaired, joined, robot, self.out / "repaired", _ITERATIONS, first)
        for label, step in (
            ("trained in simulation", first),
            ("adapted by SimOpt alone", alone),
            ("adapted with the missing effect", after),
        ):
            display.say(f"{label:34} {step.target_success or 0.0:6.0%} success on the target")
        display.say(f"hidden: {told_effect(hidden)}; named: {'; '.join(map(told_effect, effects))}")

    def _adapt(
        self,
        simulator: EnvSimulator,
        distribution: Gaussian,
        robot: LoggedSystem,
        directory: Path,
        iterations: int,
        start: Iteration | None = None,
    ) -> tuple[Iteration, Iteration]:
        """SimOpt until its policy works, for so many iterations at most; the first and the last iteration."""
        display = Display()
        loop = SimOpt(
            simulator,
            distribution,
            inputs.make_trainer("torch", display.training),
            robot,
            policy=None if start is None else start.policy,
            updates_per_iteration=inputs.UPDATES,
            simulated_rollouts=_SIMULATED,
            real_rollouts=_ROLLOUTS,
            seed=self.seed,
            directory=directory,
            on_event=display.event,
        )
        steps: list[Iteration] = []

        def enough(step: Iteration) -> bool:
            steps.append(step)
            return (step.target_success or 0.0) >= _ENOUGH

        details = Details(self.typed, ENV_ID, control_period(ENV_ID), {})
        run_loop(loop, iterations, display, details, self.typed, resume=True, enough=enough)
        return steps[0], steps[-1]

    def _missing(self, prior: Gaussian, logs: Sequence[Path], display: Display) -> list[dict[str, Any]]:
        """What the gap workflow names in logs; entries of ``gap.json``."""
        folder = self.out / "gap"
        if explain(ENV_ID, [prior], logs, folder, display.console):
            return []
        display.say(told(folder))
        display.say(f"report: {folder / 'report.html'}")
        effects: list[dict[str, Any]] = json.loads((folder / "gap.json").read_text())["effects"]
        return effects


def _joined(prior: Gaussian, space: ParameterSpace, effects: list[dict[str, Any]]) -> Gaussian:
    """p(ξ) with the parameters of the effects that the space has, as sure of them as the gap workflow is."""
    from simopt_envs.gap.thresholds import CONFIDENT  # only where the workflow has run

    ends = {
        full_name: fitted["interval95"]
        for entry in effects
        for name, fitted in entry["parameters"].items()
        if (full_name := EFFECTS[entry["effect"]].full_name(entry["where"], name)) in space
    }
    added = space.subset(list(ends))
    low, high = (added.to_unconstrained(np.clip(end, added.low, added.high)) for end in np.transpose([*ends.values()]))
    mean = added.to_unconstrained(added.nominal)
    std = np.maximum((high - low) / (2 * CONFIDENT), _LEAST_STD * np.where(added.is_log, 1.0, np.abs(mean)))
    covariance = np.diag(np.append(prior.std, std) ** 2)
    return Gaussian(space.subset([*prior.space.names, *added.names]), np.append(prior.mean, mean), covariance)
