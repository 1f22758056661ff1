"""Does it work for different tasks and robots?"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from baselines.experiments.cell import Cell, Result, Results
from baselines.experiments.document import Question, Table
from baselines.experiments.drawing import as_percent, count_iterations, draw_curve, new_figure
from baselines.experiments.iterations import count, needed, over_iterations
from baselines.experiments.settings import Cure
from baselines.experiments.statistics import mean_of, success_of
from baselines.experiments.targets import drawer_cure, peg_cure, pendulum_cure

_NAME = "robots"
_SEEDS = range(5)
_LISTED = 4  # hidden parameters, of many


@dataclass(frozen=True)
class _Robot:
    """A row: what is cured, in words and settings."""

    task: str
    robot: str
    hidden: str
    cure: Cure
    paper: str = ""
    quick_seeds: int = 0


_ROBOTS: Mapping[str, _Robot] = {
    "drawer": _Robot("drawer", "Franka Panda", "cabinet 22 cm off", drawer_cure("22 cm"), "5 (simulated)", 1),
    "peg": _Robot("swing-peg", "ABB YuMi", "rope, peg and arm", peg_cure("far"), "2 (real, 18 of 20)"),
    "pendulum": _Robot("`InvertedPendulum-v5`", "cart", "motor six times as strong", pendulum_cure(), quick_seeds=1),
}


def _cells() -> list[Cell]:
    return [
        Cell(_NAME, name, seed, robot.cure, seed < robot.quick_seeds)
        for name, robot in _ROBOTS.items()
        for seed in _SEEDS
    ]


def _runs(results: Results, name: str) -> list[Result]:
    return list(results.get(name, {}).values())


def _tables(results: Results) -> list[Table]:
    rows = []
    for name, robot in _ROBOTS.items():
        runs = _runs(results, name)
        if runs:
            steps = over_iterations(runs, "success")
            before, after = (success_of(rates, runs[0]["episodes"]).percent for rates in (steps[0], steps[-1]))
            cures = [needed(run) for run in runs]
            cured = f"{int(np.isfinite(cures).sum())} of {len(cures)}"
            rows.append([robot.task, robot.robot, robot.hidden, before, after, cured, count(cures, runs), robot.paper])
    header = ["task", "robot", "hidden", "success before", "after", "≥ 90 %", "iterations (median)", "in the paper"]
    return [Table("Success on the hidden system before and after SimOpt.", header, rows)]


def _figure(results: Results) -> Figure:
    figure, (success, discrepancy) = new_figure(2)
    for index, (name, robot) in enumerate(_ROBOTS.items()):
        runs = _runs(results, name)
        if not runs:
            continue
        rates = [success_of(r, runs[0]["episodes"]) for r in over_iterations(runs, "success")]
        label = f"{robot.task.strip('`')}, {robot.robot}"
        draw_curve(success, range(len(rates)), rates, label, index, 0.05)
        relative = [{"ratio": [d / run["discrepancy"][0] for d in run["discrepancy"]]} for run in runs]
        ratios = [mean_of(r) for r in over_iterations(relative, "ratio")]
        draw_curve(discrepancy, range(len(ratios)), ratios, label, index, 0.05)
    success.set(title="Success on the target")
    discrepancy.set(title="Mean discrepancy, as a share of the first", yscale="log")
    for axes in (success, discrepancy):
        count_iterations(axes)
    as_percent(success)
    success.legend()
    return figure


def _findings(results: Results) -> list[str]:
    found = []
    for name, robot in _ROBOTS.items():
        runs = _runs(results, name)
        if runs:
            last = [run["medians"][-1] for run in runs]
            estimates = [
                f"{parameter} {mean_of([medians[parameter] for medians in last]).text(digits=2)} (hidden {value:.3g})"
                for parameter, value in list(robot.cure.hidden.items())[:_LISTED]
            ]
            found.append(f"{robot.task.strip('`')}: p(ξ) ends around {', '.join(estimates)}.")
    return found


QUESTION = Question(
    name=_NAME,
    title="Does it work for different tasks and robots?",
    setting="""
    SimOpt with the same settings on the two tasks of this package, which have different robots, and on an
    environment of Gymnasium's, there with a policy that has to keep a pole upright for 100 steps. Three real
    rollouts an iteration.
    """,
    paper="""
    Two tasks on two real robots: swing-peg-in-hole on an ABB YuMi, 18 of 20 after 2 iterations; a drawer on a
    Franka Panda, 20 of 20 after 1 iteration. How often the first policies succeeded is not given. Here a simulation
    with hidden physics plays the robot.
    """,
    cells=_cells,
    tables=_tables,
    figure=_figure,
    findings=_findings,
)
