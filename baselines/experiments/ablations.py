"""What do parts of the method contribute that the paper does not vary?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from baselines.experiments.cell import Cell, Result, Results
from baselines.experiments.document import Question, Table
from baselines.experiments.drawing import draw_curve, draw_points, new_figure
from baselines.experiments.fits import LEAST_XI, LOCATED, Problem, adapt
from baselines.experiments.statistics import FEWEST_SEEDS, mean_of
from baselines.experiments.workspace import Workspace
from simopt_envs.adaptation import REPS, Policy, Rollouts, Simulator
from simopt_envs.adaptation.updates import Update, UpdateResult
from simopt_envs.distributions import Gaussian
from simopt_envs.measured.trajectory import Trajectory
from simopt_envs.physics import ParameterSpace
from simopt_envs.physics.parameters import Array

_NAME = "ablations"
_SEEDS = range(5)
_SHIFTS = (0.15, 0.22)
_ROLLOUTS = 2000


class OpenLoop:
    """A simulator that repeats the measured actions, where another one lets the policy act."""

    def __init__(self, simulator: Simulator):
        self._simulator = simulator
        self.parameters, self.observation_names = simulator.parameters, simulator.observation_names
        self.discrepancy_weights = simulator.discrepancy_weights
        self.make_vector_env = simulator.make_vector_env

    def rollout(
        self, policy: Policy | None, space: ParameterSpace, xi: Array, real: Sequence[Trajectory], seed: int
    ) -> Rollouts:
        """See :meth:`Simulator.rollout`."""
        return self._simulator.rollout(None, space, xi, real, seed)


@dataclass(frozen=True)
class Diagonal:
    """An update that forgets the correlations."""

    update: Update

    def __call__(
        self,
        distribution: Gaussian,
        xi: ArrayLike,
        costs: ArrayLike,
        rng: np.random.Generator,
        std_floor: ArrayLike | None = None,
    ) -> UpdateResult:
        """See :meth:`Update.__call__`."""
        result = self.update(distribution, xi, costs, rng, std_floor)
        fitted = result.distribution
        diagonal = Gaussian(fitted.space, fitted.mean, np.diag(fitted.std**2))
        return replace(result, distribution=diagonal, kl=diagonal.kl(distribution))


@dataclass(frozen=True)
class Ablation:
    """The loop's own fit with something left out.

    Attributes:
        shift: of the hidden cabinet, m.
        rollouts: that may be simulated.
        open_loop: repeat the measured actions instead of letting the policy act.
        blind: leave the handle's x out of the cost.
        diagonal: no correlations in p(ξ).
        filtered: with the filter over time in the cost.
    """

    shift: float
    rollouts: int
    open_loop: bool = False
    blind: bool = False
    diagonal: bool = False
    filtered: bool = True

    def run(self, seed: int, workspace: Workspace) -> Result:
        """How good the estimate is, and the estimates of cabinet_x after each update."""
        problem = Problem.make(self.shift, seed, workspace)
        cost = problem.discrepancy
        if self.blind:
            weights = np.array(cost.weights) * [name != "handle_x" for name in problem.simulator.observation_names]
            cost = replace(cost, weights=tuple(weights))
        if not self.filtered:
            cost = replace(cost, filter_std=0.0)
        simulation: Simulator = OpenLoop(problem.simulator) if self.open_loop else problem.simulator
        changed = replace(problem, discrepancy=cost, simulator=simulation)
        update: Update = Diagonal(REPS()) if self.diagonal else REPS()
        rollouts = max(int(self.rollouts * workspace.effort.fit_share), LEAST_XI)
        medians = adapt(changed, update, rollouts, seed, workspace.tell)
        column = problem.prior.space.index("cabinet_x")
        return problem.judge(medians[-1]) | {"cabinet_x": [float(median[column]) for median in medians]}


_ABLATIONS: Mapping[str, Mapping[str, Any]] = {
    "nothing left out": {},
    "open loop": {"open_loop": True},
    "handle x not in the cost": {"blind": True},
    "open loop, handle x not in the cost": {"open_loop": True, "blind": True},
    "diagonal covariance": {"diagonal": True},
    "no filter over time": {"filtered": False},
}


def _condition(name: str, shift: float) -> str:
    return f"{name.replace(',', '').replace(' ', '_')}-{100 * shift:.0f}cm"


def _cells() -> list[Cell]:
    return [
        Cell(
            _NAME,
            _condition(name, shift),
            seed,
            Ablation(shift, _ROLLOUTS, **left_out),
            seed == 0 and shift == _SHIFTS[0],
        )
        for shift in _SHIFTS
        for name, left_out in _ABLATIONS.items()
        for seed in _SEEDS
    ]


def _runs(results: Results, name: str, shift: float) -> list[Result]:
    return list(results.get(_condition(name, shift), {}).values())


def _tables(results: Results) -> list[Table]:
    rows = []
    for name in _ABLATIONS:
        texts = []
        for shift in _SHIFTS:
            runs = _runs(results, name, shift)
            error = mean_of([run["cabinet_x_error"] for run in runs]).text(100) if runs else ""
            located = f"{sum(run['cabinet_x_error'] <= LOCATED for run in runs)} of {len(runs)}" if runs else ""
            texts += [error, located]
        if any(texts):
            rows.append([name, *texts])
    header = ["left out"]
    for shift in _SHIFTS:
        header += [f"error at {100 * shift:.0f} cm [cm]", f"located to {100 * LOCATED:.0f} cm"]
    return [Table(f"Error of the cabinet's place after {_ROLLOUTS} simulated rollouts in ten updates.", header, rows)]


def _figure(results: Results) -> Figure:
    figure, (path, error) = new_figure(2)
    for index, name in enumerate(_ABLATIONS):
        runs = _runs(results, name, _SHIFTS[0])
        if runs:
            medians = [mean_of([100 * x for x in at]) for at in zip(*(run["cabinet_x"] for run in runs), strict=True)]
            draw_curve(path, range(len(medians)), medians, name, index)
    path.axhline(100 * _SHIFTS[0], color="black", linewidth=0.8)
    path.set(title="Median of cabinet_x [cm]; line: the truth", xlabel="update")
    figure.legend(*path.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    for index, shift in enumerate(_SHIFTS):
        runs_of = {name: _runs(results, name, shift) for name in _ABLATIONS}
        rows = {name: mean_of([100 * r["cabinet_x_error"] for r in runs]) for name, runs in runs_of.items() if runs}
        if rows:
            draw_points(error, rows, index, offset=0.2 * index, label=f"{100 * shift:.0f} cm off")
    error.set(title="Error of the cabinet's place at the end [cm]")
    error.legend()
    return figure


def _findings(results: Results) -> list[str]:
    found = []
    usual, *others = _ABLATIONS
    for shift in _SHIFTS:
        with_all = results.get(_condition(usual, shift), {})
        for name in others:
            without = results.get(_condition(name, shift), {})
            pairs = [
                (without[seed]["cabinet_x_error"], with_all[seed]["cabinet_x_error"])
                for seed in without
                if seed in with_all
            ]
            if pairs:
                more = mean_of([100 * (a - b) for a, b in pairs])
                verdict = "worse" if more.low > 0 else "better" if more.high < 0 else "not told apart"
                verdict = verdict if more.seeds >= FEWEST_SEEDS else f"{more.seeds} seeds, too few to tell"
                found.append(
                    f"{100 * shift:.0f} cm, {name}: {verdict}; the same seeds end {more.text()} cm farther off than"
                    " with nothing left out."
                )
    return found


QUESTION = Question(
    name=_NAME,
    title="What do the parts of the method contribute?",
    setting="""
    The fits of [update_rules](update_rules.md) with REPS (KL bound 1), with something left out: the policy that
    acts on the simulation's own observations (open loop: it repeats the measured actions); the channel of the cost
    that shows directly where the cabinet stands; the correlations of p(ξ); the filter over time in the cost.
    """,
    paper="""
    With the cabinet's x left out of the cost, closed-loop rollouts still gave informative updates. The other parts
    are not varied.
    """,
    cells=_cells,
    tables=_tables,
    figure=_figure,
    findings=_findings,
)
