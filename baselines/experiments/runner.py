"""Running cells, shown as they go."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from baselines.experiments.cell import Cell, Store
from baselines.experiments.workspace import Workspace
from simopt_envs.engine import Engine, FailedTasksError, LocalEngine


def run_cells(
    cells: Sequence[Cell],
    store: Store,
    make_workspace: Callable[[Callable[[str], None]], Workspace],
    console: Console | None = None,
    engine: Engine | None = None,
) -> list[Cell]:
    """Run those that are not finished. One that fails does not keep the others from running.

    Args:
        cells: begun in this order.
        store: where the results go.
        make_workspace: given what to tell about the work within a cell.
        console: standard output by default.
        engine: runs them, one after the other by default. Its workers write into the store and the workspace
            themselves: on several machines, both must be in a folder that all of them share.

    Returns:
        The cells that failed.

    Raises:
        KeyboardInterrupt: with a message; the finished cells are kept, and so is a part of what was going on.
    """
    console = console or Console(highlight=False)
    todo = [cell for cell in cells if store.load(cell) is None]
    failed: list[Cell] = []
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
        task = bar.add_task("", total=len(cells), doing="")
        workspace = make_workspace(lambda text: bar.update(task, doing=text))
        unfinished = dict(enumerate(todo))

        def show() -> None:
            bar.update(task, completed=len(cells) - len(unfinished), description=_first(unfinished), doing="")

        def note(index: int, outcome: float | Exception) -> None:
            cell = unfinished.pop(index)
            if isinstance(outcome, Exception):
                failed.append(cell)
                told = f"failed, {type(outcome).__name__}: {outcome}"
            else:
                told = f"{outcome:.0f} s ({len(todo) - len(unfinished)} of {len(todo)})"
            console.print(f"{cell}: {told}", markup=False)
            show()

        show()
        try:
            (engine or LocalEngine()).map(_run, todo, (store, workspace), note)
        except FailedTasksError:  # told above, and by the exit code
            pass
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                f"interrupted in {_first(unfinished)}; {len(todo) - len(unfinished)} of {len(todo)} cells are new. "
                "The same command goes on"
            ) from None
    return failed


def _run(cell: Cell, store: Store, workspace: Workspace) -> float:
    """Run a cell and keep its result; the seconds that it took."""
    start = time.perf_counter()
    result = cell.settings.run(cell.seed, workspace)
    seconds = time.perf_counter() - start
    store.save(cell, result, seconds)
    return seconds


def _first(unfinished: dict[int, Cell]) -> str:
    return str(next(iter(unfinished.values()), ""))
