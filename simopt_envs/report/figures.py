"""The figures of a run. Each takes a :class:`~simopt_envs.report.run.Run` and returns a matplotlib figure.

Colours are those of Okabe and Ito, which people with any form of colour vision can tell apart; what they tell apart
differs in line style as well.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from io import BytesIO
from pathlib import Path
from typing import Any, ParamSpec

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import MaxNLocator, PercentFormatter

from simopt_envs.measured.trajectory import Trajectory
from simopt_envs.report.run import Run

BLUE, ORANGE, GREEN, GREY, INK = "#0072B2", "#D55E00", "#009E73", "#7A7F87", "#22262B"
STYLE: Any = {  # matplotlib types it name by name
    "font.size": 9,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelcolor": INK,
    "axes.edgecolor": "#B4B8BE",
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#ECEEF1",
    "grid.linewidth": 0.8,
    "axes.axisbelow": True,
    "xtick.color": "#5A6068",
    "ytick.color": "#5A6068",
    "lines.linewidth": 1.6,
    "lines.markersize": 4.5,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "svg.hashsalt": "simopt-envs",  # so that the same run gives the same file
}
_WIDTH = 10.0  # inches
_MOST_EPISODES = 6  # in one panel
P = ParamSpec("P")


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Draw with the style of this package, whatever the user's matplotlib is set to, and names as they are."""

    @wraps(draw)
    def draw_styled(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with rc_context(STYLE):
            return without_formulas(draw(*args, **kwargs))

    return draw_styled


def without_formulas(figure: Figure) -> Figure:
    """The figure, its text with dollars shown as it is: that of a name, as matplotlib's own comes when it is drawn."""
    for text in figure.findobj(lambda artist: isinstance(artist, Text) and "$" in artist.get_text()):
        text.set_parse_math(False)  # type: ignore[attr-defined]
    return figure


def save_figure(figure: Figure, path: Path) -> Path:
    """Write a figure as PNG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with rc_context(STYLE):
        figure.savefig(path, dpi=150)
    return path


def svg_of(figure: Figure) -> bytes:
    """A figure as SVG, the same bytes for the same figure."""
    drawing = BytesIO()
    with rc_context(STYLE):
        figure.savefig(drawing, format="svg", metadata={"Date": None})
    return drawing.getvalue()


@styled
def progress_figure(run: Run) -> Figure:
    """Success and discrepancy against the iteration; discrepancy alone where nothing counts successes."""
    k = np.arange(len(run.iterations))
    target, simulated = (_column(run, name) for name in ("target_success", "sim_success"))
    counted = np.isfinite(target).any() or np.isfinite(simulated).any()
    figure = Figure(figsize=(_WIDTH, 3.0), layout="constrained")
    axes = figure.subplots(1, 2 if counted else 1, squeeze=False)[0]
    if counted:
        axes[0].plot(k, target, "o-", color=BLUE, label="target system", clip_on=False)
        axes[0].plot(k, simulated, "s--", color=ORANGE, label="simulation, ξ ~ p(ξ)", clip_on=False)
        axes[0].set(title="Success of the policy", ylim=(0, 1))
        axes[0].yaxis.set_major_formatter(PercentFormatter(1.0))
        axes[0].legend(loc="best")
    cost, verdicts = axes[-1], [entry["verdict"] for entry in run.iterations]
    mean, best = ([entry["discrepancy"][of] for entry in run.iterations] for of in ("mean", "min"))
    cost.plot(k, mean, "s--", color=ORANGE, label="mean over p(ξ)")
    cost.plot(k, best, "o-", color=BLUE, label="best ξ drawn")
    if any(verdict["noise"] > 0 for verdict in verdicts):
        cost.plot(k, [verdict["noise"] for verdict in verdicts], ":", color=GREY, label="measurement noise alone")
    cost.set(title="Discrepancy between simulation and target", yscale="log")
    cost.legend(loc="best")
    for axis in axes:
        axis.set_xlabel("SimOpt iteration (0: before any adaptation)")
        axis.xaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


@styled
def parameters_figure(run: Run) -> Figure:
    """Median ± one standard deviation of each parameter against the iteration, physical; the hidden truth if known."""
    low, median, high = (run.physical(run.mean + s * run.std) for s in (-1, 0, 1))
    k, columns = np.arange(len(run.mean)), min(4, len(run.names))
    rows = -(-len(run.names) // columns)
    figure = Figure(figsize=(_WIDTH, 1.75 * rows + 0.35), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True).ravel()
    for i, axis in enumerate(panels[: len(run.names)]):
        axis.fill_between(k, low[:, i], high[:, i], color=BLUE, alpha=0.18, linewidth=0, label="± 1 std")
        axis.plot(k, median[:, i], "o-", color=BLUE, label="median of p(ξ)")
        if run.truth is not None:
            axis.axhline(run.truth[i], color=ORANGE, linestyle="--", label="hidden truth")
        axis.set_title(run.labels[i].replace(" [", "\n["), size=8)  # on one line, long names run into the next panel
        axis.xaxis.set_major_locator(MaxNLocator(integer=True))
        axis.yaxis.set_major_locator(MaxNLocator(4))
    for axis in panels[len(run.names) :]:
        axis.set_visible(False)
    for axis in panels[max(0, len(run.names) - columns) : len(run.names)]:
        axis.tick_params(labelbottom=True)  # also where the panel below is empty
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper left", ncols=3)
    figure.supxlabel("SimOpt iteration", fontsize=9, color=INK)
    return figure


@styled
def overlay_figure(run: Run) -> Figure:
    """Every observed channel, measured and simulated with the best ξ drawn: first iteration left, last one right."""
    chosen = list(dict.fromkeys([0, len(run.iterations) - 1]))
    figure = Figure(figsize=(_WIDTH, 1.3 * len(run.channels) + 0.8), layout="constrained")
    panels = figure.subplots(len(run.channels), len(chosen), squeeze=False, sharex="col", sharey="row")
    period = run.details.control_period
    for column, iteration in enumerate(chosen):
        real, simulated = (_spread(of(iteration)) for of in (run.real, run.simulated))
        for channel, axis in enumerate(panels[:, column]):
            for trajectories, style in (
                (real, {"color": INK, "linewidth": 1.2, "label": "measured"}),
                (simulated, {"color": ORANGE, "linestyle": (0, (4, 2)), "linewidth": 1.4, "label": "simulated"}),
            ):
                for trajectory in trajectories:
                    time = np.arange(len(trajectory.observations)) * (period or 1.0)
                    axis.plot(time, trajectory.observations[:, channel], **style)
            _note_error(axis, real, simulated, channel)
            if column == 0:
                name = run.channels[channel]
                unit = run.details.channel_units.get(name)
                axis.set_ylabel(f"{name}\n[{unit}]" if unit else name, rotation=0, ha="right", va="center")
        panels[0, column].set_title("Before adaptation" if iteration == 0 else f"After iteration {iteration}")
        panels[-1, column].set_xlabel("time [s]" if period else "control step")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    figure.legend(unique.values(), unique.keys(), loc="outside upper right", ncols=2)
    return figure


@styled
def correlation_figure(run: Run) -> Figure:
    """Correlations of the parameters in the last p(ξ)."""
    d, std = len(run.names), run.std[-1]
    correlation = run.covariance[-1] / np.outer(std, std)
    size = min(_WIDTH, 2.6 + 0.36 * d)
    figure = Figure(figsize=(size + 0.8, size), layout="constrained")
    axis = figure.add_subplot()
    image = axis.imshow(correlation, cmap="RdBu_r", vmin=-1, vmax=1)
    axis.set_xticks(range(d), run.names, rotation=90)
    axis.set_yticks(range(d), run.names)
    axis.grid(visible=False)
    axis.spines[:].set_visible(False)
    axis.tick_params(length=0)
    if d <= 20:
        for i, j in np.ndindex(d, d):
            if i != j and abs(correlation[i, j]) >= 0.1:
                colour = "white" if abs(correlation[i, j]) > 0.6 else INK
                axis.text(j, i, f"{correlation[i, j]:.1f}", ha="center", va="center", color=colour, fontsize=7)
    figure.colorbar(image, shrink=0.7, label="correlation").outline.set_visible(False)
    return figure


def _spread(trajectories: list[Trajectory]) -> list[Trajectory]:
    """As many as a panel can hold, evenly spread."""
    return trajectories[:: -(-len(trajectories) // _MOST_EPISODES) or 1]


def _column(run: Run, name: str) -> np.ndarray:
    """An entry over the iterations, NaN where it is missing."""
    return np.array([np.nan if entry[name] is None else entry[name] for entry in run.iterations], dtype=float)


def _note_error(axis: Axes, real: list[Trajectory], simulated: list[Trajectory], channel: int) -> None:
    """The root-mean-square difference over the steps that both have."""
    pairs = [(r.observations[:, channel], s.observations[:, channel]) for r, s in zip(real, simulated, strict=False)]
    differences = [r[: len(s)] - s[: len(r)] for r, s in pairs]
    if differences:
        rms = np.sqrt(np.nanmean(np.concatenate(differences) ** 2))
        axis.annotate(
            f"RMSE {rms:.2g}", (1.0, 1.01), xycoords="axes fraction", ha="right", va="bottom", size=7.5, color=GREY
        )
