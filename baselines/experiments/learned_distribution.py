"""Is the p(ξ) that SimOpt learned worth more than a wide one?"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from baselines.experiments.cell import Cell, Result, Results, Settings
from baselines.experiments.document import Question, Table
from baselines.experiments.drawing import as_percent, draw_points, new_figure, style
from baselines.experiments.randomization import EPISODE_STEPS, FAR, FIXED, TARGETS, condition
from baselines.experiments.settings import Train, TrainLearned
from baselines.experiments.statistics import Estimate, mean_of, success_of
from baselines.experiments.targets import drawer_cure, peg_cure

_NAME = "learned_distribution"
_SEEDS = range(5)
_COMPARED = {"drawer": ("xyz 2 cm", "x 10 cm", "xyz 10 cm"), "peg": ("narrow", "all wide")}
_QUICK = {"xyz 2 cm", "x 10 cm", "learned at 22 cm"}


def _settings(task: str) -> Mapping[str, Settings]:
    """Name -> training."""
    cure = drawer_cure if task == "drawer" else peg_cure
    fixed = {name: Train(FIXED[task][name], TARGETS[task]) for name in _COMPARED[task]}
    learned = {f"learned at {t}": TrainLearned(cure(t), {t: TARGETS[task][t]}) for t in FAR[task]}
    return {**fixed, **learned}


def _cells() -> list[Cell]:
    return [
        Cell(_NAME, condition(task, name), seed, settings, task == "drawer" and seed == 0 and name in _QUICK)
        for task in FIXED
        for name, settings in _settings(task).items()
        for seed in _SEEDS
    ]


def _runs(results: Results, task: str, name: str) -> list[Result]:
    return list(results.get(condition(task, name), {}).values())


def _success(runs: list[Result], target: str) -> Estimate | None:
    rates = [run["success"][target] for run in runs if target in run["success"]]
    return success_of(rates, runs[0]["episodes"]) if rates else None


def _episodes(run: Result) -> float:
    """Until 90 % of the episodes under the run's own p(ξ) succeed; infinite if that never happened."""
    return np.inf if run["steps_to_90"] is None else run["steps_to_90"] / EPISODE_STEPS


def _tables(results: Results) -> list[Table]:
    tables = []
    for task in FIXED:
        rows = []
        for name in _settings(task):
            runs = _runs(results, task, name)
            if runs:
                learned = [_episodes(run) for run in runs if np.isfinite(_episodes(run))]
                successes = [_success(runs, target) for target in FAR[task]]
                row = [name, str(len(runs)), f"{len(learned)} of {len(runs)}"]
                row += [
                    mean_of(learned).text(digits=0) if learned else "",
                    *(s.percent if s else "" for s in successes),
                ]
                rows.append(row)
        header = ["p(ξ)", "seeds", "reached 90 %", "episodes until then", *(f"success on {t}" for t in FAR[task])]
        caption = (
            f"Trainings of the {task} policy from scratch; those 90 % are of episodes under the training's own p(ξ)."
        )
        if rows:
            tables.append(Table(caption, header, rows))
    return tables


def _figure(results: Results) -> Figure:
    figure, (*curves, success) = new_figure(len(FIXED) + 1, width=14.0)
    rows: dict[str, Estimate] = {}
    for axes, task in zip(curves, FIXED, strict=True):
        for index, name in enumerate(_settings(task)):
            runs = _runs(results, task, name)
            for run in runs:
                steps, reached = np.array([(s, np.nan if y is None else y) for s, y in run["curve"]]).T
                look = style(index) | {"marker": ""}
                axes.plot(steps / EPISODE_STEPS / 1000, reached, **look, label=name if run is runs[0] else "")
        axes.set(title=f"{task}: success under its own p(ξ)", xlabel="thousand episodes of training")
        if axes.lines:
            axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.18), ncols=2)
        as_percent(axes)
    for task in FIXED:
        for target in FAR[task]:
            for name in _settings(task):
                estimate = _success(_runs(results, task, name), target)
                if estimate:
                    rows[f"{task}, {target}: {name}"] = estimate
    success.set(title="Success on the target after training")
    draw_points(success, rows)
    as_percent(success, "x")
    return figure


def _findings(results: Results) -> list[str]:
    found = []
    for task in FIXED:
        for target in FAR[task]:
            learned = _runs(results, task, f"learned at {target}")
            after = _success(learned, target)
            for name in _COMPARED[task]:
                runs = _runs(results, task, name)
                other = _success(runs, target)
                if after and other:
                    apart = "above" if after.above(other) else "not wholly above"
                    found.append(
                        f"{task}, {target}: trained under the learned p(ξ) the policy succeeds in {after.percent},"
                        f" {apart} {other.percent} under {name}. To be right in 90 % of its own simulations takes"
                        f" {_count(learned)} episodes, against {_count(runs)} (medians)."
                    )
    return found


def _count(runs: list[Result]) -> str:
    median = np.median([_episodes(run) for run in runs])
    return f"{median:,.0f}" if np.isfinite(median) else f"over {max(run['steps'] for run in runs) / EPISODE_STEPS:,.0f}"


QUESTION = Question(
    name=_NAME,
    title="Is the learned p(ξ) worth more than a wide one?",
    setting="""
    A policy is trained from scratch: under the p(ξ) with which SimOpt ended ([iterations](iterations.md)), under
    the narrow one that it began with, and under wide ones. How long does that take, and what can the policy do on
    the target? So what is compared is p(ξ) alone, without what a policy kept from earlier trainings.
    """,
    paper="""
    The paper argues that a wide p(ξ) makes training slower, more conservative, or impossible, and shows it for the
    cabinet's place (see [randomization](randomization.md)); it trains no policy from scratch under a learned p(ξ).
    """,
    cells=_cells,
    tables=_tables,
    figure=_figure,
    findings=_findings,
)
