"""The page of a question: its table and figure, beside the command and seeds that made them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from inspect import cleandoc
from pathlib import Path

from matplotlib.figure import Figure

from baselines.experiments.cell import Cell, Results, Store
from simopt_envs.report.figures import save_figure, styled


@dataclass(frozen=True)
class Table:
    """A table of texts."""

    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]

    def markdown(self) -> str:
        """As Markdown."""
        lines = [self.header, ["---"] * len(self.header), *self.rows]
        return "\n".join([f"{self.caption}\n", *("| " + " | ".join(line) + " |" for line in lines)])


@dataclass(frozen=True)
class Question:
    """A question of the paper, or one that it leaves open.

    Attributes:
        name: on the command line and of its files.
        title: the question.
        setting: what is done, a paragraph.
        paper: what the paper found.
        cells: declares them.
        tables: of results.
        figure: of results.
        findings: sentences that compare results with each other and with the paper.
    """

    name: str
    title: str
    setting: str
    paper: str
    cells: Callable[[], list[Cell]]
    tables: Callable[[Results], list[Table]]
    figure: Callable[[Results], Figure]
    findings: Callable[[Results], list[str]]


def write_document(question: Question, store: Store, docs: Path) -> Path | None:
    """Write the page and the figure of what is finished; None if nothing is."""
    cells = question.cells()
    results = store.results(cells)
    if not results:
        return None
    docs.mkdir(parents=True, exist_ok=True)
    figure = docs / f"{question.name}.png"
    save_figure(styled(question.figure)(results), figure)
    found = [f"* {sentence}" for sentence in question.findings(results)] or ["Too little is finished to say."]
    parts = [
        f"# {question.title}",
        cleandoc(question.setting),
        f"![{question.title}]({figure.name})",
        *(table.markdown() for table in question.tables(results) if table.rows),
        "## What came out",
        "\n".join(found),
        "## In the paper",
        cleandoc(question.paper),
        "## How it was made",
        _made(question, cells, results, store),
    ]
    page = docs / f"{question.name}.md"
    page.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    return page


def _made(question: Question, cells: list[Cell], results: Results, store: Store) -> str:
    finished = [cell for cell in cells if cell.seed in results.get(cell.condition, {})]
    quick = " --quick" if all(cell.quick for cell in finished) else ""
    minutes = store.seconds(cells) / 60
    took = f"{minutes:.0f} min" if minutes < 100 else f"{minutes / 60:.1f} h"
    seeds = sorted({seed for of_seed in results.values() for seed in of_seed})
    lines = [
        f"`python -m baselines.experiments {question.name}{quick}`; seeds {', '.join(map(str, seeds))};"
        f" {len(finished)} of {len(cells)} cells, which took {took} in all.",
        "Square brackets hold 95 % intervals: of the seeds by bootstrap, for success also of the episodes it was"
        " counted over. The interval of a success that has one seed only is that of its episodes.",
    ]
    if len(finished) < len(cells):
        if conditions := dict.fromkeys(cell.condition for cell in cells if cell.condition not in results):
            lines.append(f"Not run yet: {', '.join(conditions)}.")
        planned = Counter(cell.condition for cell in cells)
        if partial := {c: of_seed for c, of_seed in results.items() if len(of_seed) < planned[c]}:
            listed = (f"{c} ({', '.join(map(str, sorted(of_seed)))})" for c, of_seed in partial.items())
            lines.append(
                "Of some seeds only, so not to be compared with what has all, as seeds differ in how hard they are:"
                f" {'; '.join(listed)}."
            )
    return "\n\n".join(lines)
