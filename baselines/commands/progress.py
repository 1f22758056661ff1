"""What a run shows of itself: bars with rate and time left on a terminal, plain lines elsewhere, and a table."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Protocol, Self

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from simopt_envs.adaptation import Event, Iteration
from simopt_envs.physics.parameters import Array

_PHASES = {
    "train": "training the policy",
    "evaluate": "counting successes on the target",
    "real": "measuring rollouts on the target",
    "measure": "comparing simulations with them",
    "update": "moving p(ξ)",
}
SECONDS_BETWEEN_LINES = 10.0


class TrainingProgress(Protocol):
    """Where a training stands, as ``baselines.ppo_torch.Progress`` tells."""

    steps: int
    total_steps: int
    success: float
    seconds: float


class Display:
    """Shows the phases of a run as they happen and a row for each iteration; a context manager.

    Args:
        console: where to; standard output by default.

    Attributes:
        computed: whether any phase was computed rather than restored.
    """

    def __init__(self, console: Console | None = None):
        self.console = console or Console(highlight=False)
        self.computed = False
        self._bar = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(bar_width=30),
            TimeElapsedColumn(),
            TextColumn("{task.fields[rate]}"),
            console=self.console,
            transient=True,
            disable=not self.console.is_terminal,
        )
        self._task = self._bar.add_task("", total=None, rate="", visible=False)
        self._what, self._began, self._last_line = "", 0.0, 0.0
        self._first: tuple[Array, Array] | None = None

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def event(self, event: Event) -> None:
        """Take note of a phase of the loop."""
        if event.status == "restored":
            return
        if event.status == "started":
            phase, _, number = event.phase.partition("_")
            step = f", step {int(number) + 1}" if number else ""
            self._what = f"iteration {event.iteration}: {_PHASES[phase]}{step}"
            self._began = self._last_line = time.monotonic()
            self._bar.reset(self._task, total=None, description=self._what, rate="", visible=True)
            return
        self.computed = True
        self._bar.update(self._task, visible=False)
        if not self.console.is_terminal:
            self._line(f"{self._what} ({time.monotonic() - self._began:.1f} s)")

    def training(self, progress: TrainingProgress) -> None:
        """Take note of how far a training is."""
        per_second = progress.steps / max(progress.seconds, 1e-9)
        left = (progress.total_steps - progress.steps) / per_second
        rate = f"{per_second / 1000:.1f}k steps/s, {left:.0f} s left"
        success = "" if np.isnan(progress.success) else f", success {progress.success:.0%}"
        self._advance(progress.steps, progress.total_steps, success, rate)

    def tasks(self, done: int, total: int) -> None:
        """Take note of how many tasks of a phase an engine has done."""
        if total > 1:
            self._advance(done, total, "", f"{done} of {total} tasks")

    def iteration(self, iteration: Iteration) -> None:
        """Print the row of an iteration."""
        distribution = iteration.distribution
        if self._first is None:
            self._first = distribution.mean, distribution.std
            self._line("iteration   success on target   in simulation   discrepancy   p(ξ) moved to")
        mean, std = self._first
        moved = (distribution.mean - mean) / std
        largest = [i for i in np.argsort(-np.abs(moved))[:3] if abs(moved[i]) >= 0.5]
        text = ", ".join(
            f"{distribution.space.names[i]} {distribution.median[i]:.3g} {distribution.space.units[i]}".removesuffix(
                " 1"
            )
            for i in largest
        )
        success, simulated = (
            "-" if share is None else f"{share:.0%}" for share in (iteration.target_success, iteration.sim_success)
        )
        self._line(
            f"{iteration.index:9d}   {success:>17}   {simulated:>13}   {iteration.discrepancy_min:11.3g}   "
            f"{text or '-'}"
        )

    def say(self, text: str) -> None:
        """Print a line."""
        self._line(text)

    def _advance(self, done: int, total: int, result: str, rate: str) -> None:
        if self.console.is_terminal:
            self._bar.update(self._task, total=total, completed=done, description=self._what + result, rate=rate)
        elif time.monotonic() - self._last_line > SECONDS_BETWEEN_LINES:
            self._line(f"{self._what}: {done / total:.0%}{result}, {rate}")
            self._last_line = time.monotonic()

    def _line(self, text: str) -> None:
        self.console.print(text, markup=False, highlight=False, soft_wrap=True)
