"""Score a workflow's answers against the labels.

    python -m benchmarks.hidden_effects.score --gaps DIR --labels DIR [--figure confusion.png] [--json score.json]

DIR holds ``CASE/gap.json`` for each case; cases without one count as missing and are listed. An answer is right where
the effect and its place are the hidden ones, or ones that no data could tell from them (the label's ``equivalents``).
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from benchmarks.hidden_effects.catalogue import EFFECTS

ANSWERS = (*EFFECTS, "none", "unexplained")
SCALES_FROM_ONE = ("scale",)
"""Parameters whose neutral value is 1: their error is relative to the distance from that."""
SIGNLESS = ("amplitude",)
"""Parameters whose sign can be turned by a phase: their size is compared."""


@dataclass(frozen=True)
class Answer:
    """One case's label beside the workflow's answer."""

    label: dict[str, Any]
    gap: dict[str, Any]

    @property
    def accepted(self) -> set[str]:
        """``effect@place`` of every right answer."""
        return {_name(effect) for effect in self.label["effects"]} | set(self.label["equivalents"])

    @property
    def named(self) -> list[str]:
        """``effect@place`` of what was named, best first."""
        return [_name(effect) for effect in self.gap["effects"]]

    @property
    def ranking(self) -> list[str]:
        """What was named and then the candidates, each once."""
        return list(dict.fromkeys(self.named + [_name(candidate) for candidate in self.gap["candidates"]]))

    @property
    def noticed(self) -> bool:
        """Whether the workflow says that anything is missing."""
        return bool(self.gap["verdict"] != "none")

    @property
    def first_right(self) -> bool:
        """Whether the first name given is right."""
        return bool(self.named) and self.named[0] in self.accepted

    @property
    def right_effect(self) -> bool:
        """The same, wherever it is said to be."""
        return bool(self.named) and self.named[0].split("@")[0] in {name.split("@")[0] for name in self.accepted}

    @property
    def in_three(self) -> bool:
        """Whether a right answer is among the first three of the ranking."""
        return bool(set(self.ranking[:3]) & self.accepted)

    @property
    def all_named(self) -> bool:
        """Whether every hidden effect is named, or an equivalent for it."""
        missing = [effect for effect in self.label["effects"] if _name(effect) not in self.named]
        stand_ins = set(self.named) & set(self.label["equivalents"])
        return len(missing) <= len(stand_ins)

    def pairs(self) -> list[tuple[dict[str, Any], dict[str, Any]]]:
        """(hidden effect, its named counterpart) for those named exactly."""
        by_name = {_name(effect): effect for effect in self.gap["effects"]}
        return [(effect, by_name[_name(effect)]) for effect in self.label["effects"] if _name(effect) in by_name]

    def excess_removed(self) -> float | None:
        """Share that the repair removed of the refit's gap above the noise; None where there is no such gap.

        A gap is the mean square of the held-out errors in units of the noise of sensors and of estimated starts.
        """
        gap = self.gap["gap"]["whitened"]
        excess = gap["refit"] - 1.0
        return None if excess <= 0 else float(1 - (gap["after"] - 1.0) / excess)


def _name(effect: dict[str, Any]) -> str:
    return f"{effect['effect']}@{effect['where']}"


def read_answers(gaps: Path, labels: Path) -> tuple[list[Answer], list[str]]:
    """All labelled cases that have an answer, and the names of those without one.

    Raises:
        FileNotFoundError: if there are no labels.
    """
    files = sorted(labels.glob("*.json"))
    if not files:
        raise FileNotFoundError(f"no labels (*.json) in {labels}")
    answers, missing = [], []
    for file in files:
        gap = gaps / file.stem / "gap.json"
        if gap.exists():
            answers.append(Answer(json.loads(file.read_text()), json.loads(gap.read_text())))
        else:
            missing.append(file.stem)
    return answers, missing


@dataclass(frozen=True)
class Rate:
    """A count out of a number, with Wilson's 95 % interval."""

    name: str
    hits: int
    of: int

    @property
    def interval(self) -> tuple[float, float]:
        """Lower and upper bound; (0, 1) where nothing was counted."""
        if not self.of:
            return 0.0, 1.0
        bounds = binomtest(self.hits, self.of).proportion_ci(method="wilson")
        return float(bounds.low), float(bounds.high)

    def __str__(self) -> str:
        low, high = self.interval
        share = f"{100 * self.hits / self.of:5.1f} %" if self.of else "    – %"
        return f"{self.name:<58}{share}  {self.hits:3d}/{self.of:<3d}  [{100 * low:.0f}, {100 * high:.0f}] %"

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {"name": self.name, "hits": self.hits, "of": self.of, "interval95": self.interval}


def rate(name: str, answers: Sequence[Answer], hit: Callable[[Answer], bool]) -> Rate:
    """How many of the answers are hits."""
    return Rate(name, sum(map(hit, answers)), len(answers))


def by_kind_of(answers: Iterable[Answer]) -> dict[str, list[Answer]]:
    """Answers by the kind of their case."""
    by_kind: dict[str, list[Answer]] = {"single": [], "null": [], "outside": [], "double": []}
    for answer in answers:
        by_kind[answer.label["kind"]].append(answer)
    return by_kind


def by_level(answers: Iterable[Answer]) -> tuple[list[Answer], list[Answer]]:
    """Single effects that can be detected, of about 10 and of about 3 times the least detectable magnitude."""
    singles = [a for a in by_kind_of(answers)["single"] if a.label["detectable"]]
    return [a for a in singles if a.label["ratio"] > 5], [a for a in singles if a.label["ratio"] <= 5]


def plant_table(answers: Sequence[Answer]) -> list[str]:
    """The most important counts by plant, as a Markdown table."""
    lines = ["| plant | 10 x, named first | 3 x | wrong first | nulls that alarm | outside, not claimed | pairs |"]
    lines.append("|---|---|---|---|---|---|---|")
    for plant in dict.fromkeys(a.label["plant"] for a in answers):
        mine = [a for a in answers if a.label["plant"] == plant]
        (large, small), kinds = by_level(mine), by_kind_of(mine)
        counts = [
            rate("", large, lambda a: a.first_right),
            rate("", small, lambda a: a.first_right),
            rate("", [*large, *small], lambda a: bool(a.named) and not a.first_right),
            rate("", kinds["null"], lambda a: a.noticed),
            rate("", kinds["outside"], lambda a: not _claims(a)),
            rate("", kinds["double"], lambda a: a.all_named),
        ]
        lines.append(f"| {plant} | {' | '.join(f'{c.hits} of {c.of}' for c in counts)} |")
    return lines


def rates(answers: Iterable[Answer]) -> list[Rate]:
    """All rates."""
    answers = list(answers)
    by_kind, (large, small) = by_kind_of(answers), by_level(answers)
    singles = [*large, *small]
    same_form = [
        (true, named)
        for answer in (*singles, *by_kind["double"])
        for true, named in answer.pairs()
        if true["same_form"] and _interval(true, named) is not None
    ]
    covered = sum(low <= _main(true)[1] <= high for true, named in same_form for low, high in [_interval(true, named)])  # type: ignore[misc]
    removed = [share for a in singles if a.first_right and (share := a.excess_removed()) is not None]
    return [
        rate("detected (any verdict but none)", singles, lambda a: a.noticed),
        rate("named first, effect and place", singles, lambda a: a.first_right),
        rate("  about 10 times the least detectable", large, lambda a: a.first_right),
        rate("  about 3 times the least detectable", small, lambda a: a.first_right),
        rate("named first, the effect wherever", singles, lambda a: a.right_effect),
        rate("among the first three", singles, lambda a: a.in_three),
        rate("wrong name given first", singles, lambda a: bool(a.named) and not a.first_right),
        rate("something wrong named beside the right one", singles, lambda a: a.first_right and not _clean(a)),
        rate("false alarms on nulls", by_kind["null"], lambda a: a.noticed),
        rate("  of these with a name", by_kind["null"], lambda a: bool(a.named)),
        rate("outside the library: not named as something else", by_kind["outside"], lambda a: not _claims(a)),
        rate("  noticed", by_kind["outside"], lambda a: a.noticed),
        rate("two at once, both named", by_kind["double"], lambda a: a.all_named),
        rate("two at once, at least one named", by_kind["double"], lambda a: bool(set(a.named) & a.accepted)),
        Rate("95 % intervals that hold the truth (same form)", covered, len(same_form)),
        Rate("excess gap removed by 80 % or more, when named", sum(r >= 0.8 for r in removed), len(removed)),
    ]


def _clean(answer: Answer) -> bool:
    return set(answer.named) <= answer.accepted


def _claims(answer: Answer) -> bool:
    """Whether it claims to have explained the data."""
    return bool(answer.gap["verdict"] == "named")


def _main(effect: dict[str, Any]) -> tuple[str, float]:
    """Name and value of an effect's first parameter, its magnitude."""
    name, value = next(iter(effect["parameters"].items()))
    return name, abs(float(value)) if name in SIGNLESS else float(value)


def _interval(true: dict[str, Any], named: dict[str, Any]) -> tuple[float, float] | None:
    name, _ = _main(true)
    parameter = named["parameters"].get(name)
    if parameter is None or "interval95" not in parameter:
        return None
    low, high = parameter["interval95"]
    return (-high, -low) if name in SIGNLESS and parameter["value"] < 0 else (low, high)


def magnitude_errors(answers: Iterable[Answer]) -> dict[bool, list[float]]:
    """Relative errors of the first parameter of what was named exactly, by whether the form is the usual one."""
    errors: dict[bool, list[float]] = {False: [], True: []}
    for answer in answers:
        for true, named in answer.pairs():
            name, value = _main(true)
            if name in named["parameters"]:
                neutral = 1.0 if name in SCALES_FROM_ONE else 0.0
                found = named["parameters"][name]["value"]
                error = abs((abs(found) if name in SIGNLESS else found) - value) / abs(value - neutral)
                errors[true["same_form"]].append(float(error))
    return errors


def confusion(answers: Iterable[Answer]) -> tuple[list[str], np.ndarray]:
    """Counts of the first name given (columns: ANSWERS) by what is hidden (rows, named in the list)."""
    rows = [*EFFECTS, "nothing", "outside"]
    counts = np.zeros((len(rows), len(ANSWERS)), int)
    for answer in answers:
        kind = answer.label["kind"]
        if kind == "double":
            continue
        row = {"null": "nothing", "outside": "outside"}.get(kind) or answer.label["effects"][0]["effect"]
        given = answer.named[0].split("@")[0] if answer.named else answer.gap["verdict"]
        counts[rows.index(row), ANSWERS.index(given if given in ANSWERS else "unexplained")] += 1
    return rows, counts


def draw_confusion(answers: Iterable[Answer], path: Path) -> None:
    """The confusion matrix as a picture.

    Raises:
        ImportError: without matplotlib.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError('the figure needs matplotlib: pip install "simopt-envs[report]"') from error
    rows, counts = confusion(answers)
    figure = Figure(figsize=(10, 9.5), layout="constrained")
    axes = figure.subplots()
    share = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    axes.imshow(share, cmap="Blues", vmin=0, vmax=1.3)
    axes.set_xticks(range(len(ANSWERS)), [name.replace("_", " ") for name in ANSWERS], rotation=60, ha="right")
    axes.set_yticks(range(len(rows)), [name.replace("_", " ") for name in rows])
    for i, j in zip(*np.nonzero(counts), strict=True):
        axes.text(j, i, counts[i, j], ha="center", va="center", fontsize=8)
    axes.set_xlabel("first named")
    axes.set_ylabel("hidden")
    axes.set_xticks(np.arange(len(ANSWERS)) - 0.5, minor=True)
    axes.set_yticks(np.arange(len(rows)) - 0.5, minor=True)
    axes.grid(which="minor", color="0.9", linewidth=0.5)
    axes.tick_params(which="minor", length=0)
    figure.savefig(path, dpi=130)


def _median(values: Sequence[float]) -> str:
    if not values:
        return "none"
    low, middle, high = np.percentile(values, [25, 50, 75])
    return f"median {middle:.3g}, quartiles {low:.3g} to {high:.3g}, of {len(values)}"


def main() -> None:
    parser = argparse.ArgumentParser(description="Score answers against labels.")
    parser.add_argument("--gaps", type=Path, required=True)
    parser.add_argument("--labels", type=Path, required=True)
    parser.add_argument("--figure", type=Path)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--cases", action="store_true", help="also print one line per case")
    arguments = parser.parse_args()
    answers, missing = read_answers(arguments.gaps, arguments.labels)
    if arguments.cases:
        for a in answers:
            true = ", ".join(_name(effect) for effect in a.label["effects"]) or "-"
            given = ", ".join(a.named) or "-"
            mark = "ok" if a.first_right or (not a.accepted and not a.noticed) else "  "
            ratio = a.label["ratio"] or 0
            print(f"{mark} {a.label['case']} {a.label['plant']:<12} {a.label['kind']:<8} x{ratio:<5.3g} {true}"
                  f"  ->  {a.gap['verdict']}: {given}")  # fmt: skip
    results = rates(answers)
    print("\n".join(map(str, results)))
    print("\n".join(["", *plant_table(answers), ""]))
    errors = magnitude_errors(answers)
    print(f"magnitude error, same form: {_median(errors[True])}")
    print(f"magnitude error, other form: {_median(errors[False])}")
    removed = [share for a in answers if a.first_right and (share := a.excess_removed()) is not None]
    print(f"share of the excess gap removed: {_median(removed)}")
    timed = [(a.label["plant"], float(a.gap["seconds"])) for a in answers if "seconds" in a.gap]
    print(f"seconds a case: {_median([seconds for _, seconds in timed])}")
    for plant in dict.fromkeys(plant for plant, _ in timed):
        print(f"  of {plant}: {_median([seconds for of, seconds in timed if of == plant])}")
    if missing:
        print(f"{len(missing)} of {len(missing) + len(answers)} cases have no gap.json: {', '.join(missing)}")
    if arguments.figure:
        draw_confusion(answers, arguments.figure)
    if arguments.json:
        arguments.json.write_text(json.dumps([r.to_dict() for r in results], indent=1) + "\n")


if __name__ == "__main__":
    main()
