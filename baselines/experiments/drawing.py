"""What the figures of all questions share: colours and markers that print and colour-blind eyes keep apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, PercentFormatter

from baselines.experiments.statistics import Estimate
from simopt_envs.report.figures import BLUE, GREEN, GREY, INK, ORANGE

# Okabe and Ito's, from dark to light; each with its own marker, so that grey print does as well.
_STYLES = [
    (BLUE, "o", "-"),
    (ORANGE, "s", "--"),
    (GREEN, "^", "-."),
    (INK, "D", ":"),
    ("#CC79A7", "v", "-"),
    ("#E69F00", "P", "--"),
    ("#56B4E9", "X", "-."),
    (GREY, "*", ":"),
]


def new_figure(panels: int = 1, height: float = 3.4, width: float = 10.0) -> tuple[Figure, list[Axes]]:
    """A figure with panels beside each other."""
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, list(figure.subplots(1, panels, squeeze=False)[0])


def style(index: int) -> dict[str, Any]:
    """Colour, marker and line of the index-th condition; they begin anew after eight."""
    colour, marker, line = _STYLES[index % len(_STYLES)]
    return {"color": colour, "marker": marker, "linestyle": line}


def draw_curve(
    axes: Axes, x: Sequence[float], estimates: Sequence[Estimate], label: str, index: int, offset: float = 0.0
) -> None:
    """Means over x, with a bar for each interval; conditions stand beside each other by an offset each."""
    look, at = style(index), np.asarray(x) + index * offset
    mean, low, high = (np.array([getattr(e, name) for e in estimates]) for name in ("mean", "low", "high"))
    axes.plot(at, mean, label=label, clip_on=False, **look)
    axes.vlines(at, low, high, color=look["color"], linewidth=1.0, alpha=0.7)


def draw_points(
    axes: Axes, estimates: Mapping[str, Estimate], index: int = 0, offset: float = 0.0, **more: Any
) -> None:
    """A row for each label: the mean as a point, the interval as a line."""
    look = style(index)
    rows = np.arange(len(estimates)) + offset
    axes.hlines(
        rows, [e.low for e in estimates.values()], [e.high for e in estimates.values()], color=look["color"], alpha=0.7
    )
    axes.plot([e.mean for e in estimates.values()], rows, **{**look, "linestyle": "none"}, clip_on=False, **more)
    axes.set_yticks(range(len(estimates)), list(estimates))
    axes.set_ylim(len(estimates) - 0.5, -0.5)


def count_iterations(axes: Axes) -> None:
    """A horizontal axis of SimOpt's iterations."""
    axes.set_xlabel("SimOpt iteration")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))


def as_percent(axes: Axes, axis: str = "y") -> None:
    """An axis of shares."""
    getattr(axes, f"set_{axis}lim")(-0.02, 1.02)
    getattr(axes, f"{axis}axis").set_major_formatter(PercentFormatter(1.0))
