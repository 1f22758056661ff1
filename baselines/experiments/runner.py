"""Running cells one after the other, shown as they go."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from baselines.experiments.cell import Cell, Store
from baselines.experiments.workspace import Workspace


def run_cells(
    cells: Sequence[Cell],
    store: Store,
    make_workspace: Callable[[Callable[[str], None]], Workspace],
    console: Console | None = None,
) -> list[Cell]:
    """Run those that are not finished. One that fails does not keep the others from running.

    Args:
        cells: in this order.
        store: where the results go.
        make_workspace: given what to tell about the work within a cell.
        console: standard output by default.

    Returns:
        The cells that failed.

    Raises:
        KeyboardInterrupt: with a message; the finished cells are kept, and so is a part of what was going on.
    """
    console = console or Console(highlight=False)
    todo = [cell for cell in cells if store.load(cell) is None]
    failed = []
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(bar_width=20),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[doing]}"),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )
    console.print(f"{len(cells)} cells, {len(cells) - len(todo)} of them finished before")
    with bar:
        task = bar.add_task("", total=len(cells), completed=len(cells) - len(todo), doing="")
        workspace = make_workspace(lambda text: bar.update(task, doing=text))
        for number, cell in enumerate(todo, 1):
            bar.update(task, description=str(cell), doing="")
            start = time.perf_counter()
            try:
                result = cell.settings.run(cell.seed, workspace)
            except KeyboardInterrupt:
                raise KeyboardInterrupt(
                    f"interrupted in {cell}; {number - 1} of {len(todo)} cells are new. The same command goes on"
                ) from None
            except Exception as error:  # of whatever a cell runs; it is told below and by the exit code
                failed.append(cell)
                console.print(f"{cell}: failed, {type(error).__name__}: {error}", markup=False)
            else:
                seconds = time.perf_counter() - start
                store.save(cell, result, seconds)
                console.print(f"{cell}: {seconds:.0f} s ({number} of {len(todo)})", markup=False)
            bar.advance(task)
    return failed
