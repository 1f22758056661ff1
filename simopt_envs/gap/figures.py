"""The figures of a gap report, each a matplotlib figure of a few arrays or rows.

Colours are those of Okabe and Ito, which people with any form of colour vision can tell apart; lines differ in style as
well.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import StrMethodFormatter

from simopt_envs.gap.curves import Curve
from simopt_envs.gap.localise import EVERYWHERE, SIGNIFICANT, Row, split_regime
from simopt_envs.gap.thresholds import MOVING
from simopt_envs.measured.windows import Windows
from simopt_envs.physics.parameters import Array
from simopt_envs.report.figures import BLUE, GREEN, GREY, INK, ORANGE, styled

_WIDTH = 10.0  # inches
_MOST_PARTITIONS = 12
_MOST_CHANNELS = 6
_SHOWN_WINDOWS = 4
_WIDEST_RATIO = 30.0  # of errors that bars on a linear axis can show
_STAGES: tuple[tuple[str, dict[str, Any]], ...] = (
    ("as given", {"color": GREY, "linestyle": ":"}),
    ("refitted", {"color": ORANGE, "linestyle": (0, (4, 2))}),
    ("repaired", {"color": BLUE, "linestyle": "-"}),
)


@styled
def regime_figure(rows: Sequence[Row]) -> Figure:
    """Where the misfit is: each channel's share, and for each regime how it differs from the channel's average."""
    whole = [row for row in rows if row.regime == EVERYWHERE]
    regimes = _telling_regimes(rows)
    figure = Figure(figsize=(_WIDTH, 2.6 + 0.32 * len(whole)), layout="constrained")
    bars, *cells = figure.subplots(1, 2 if regimes else 1, width_ratios=(1, 4)[: 2 if regimes else 1], squeeze=False)[0]
    strong = [BLUE if row.z > SIGNIFICANT else "#C5C9CF" for row in whole]
    bars.barh(range(len(whole)), [100 * row.share for row in whole], color=strong)
    bars.set_yticks(range(len(whole)), [row.channel for row in whole])
    bars.set(title="Share of the misfit [%]", xlim=(0, None), ylim=(len(whole) - 0.5, -0.5))
    bars.grid(visible=False, axis="y")
    for axis in cells:
        _draw_cells(figure, axis, rows, [row.channel for row in whole], regimes)
    return figure


def _draw_cells(figure: Figure, axis: Axes, rows: Sequence[Row], channels: list[str], regimes: list[str]) -> None:
    """The lift of each channel in each regime, where there is more than noise."""
    lift = np.full((len(channels), len(regimes)), np.nan)
    for row in rows:
        if row.regime in regimes and row.z > SIGNIFICANT:
            lift[channels.index(row.channel), regimes.index(row.regime)] = row.lift
    image = axis.imshow(lift, cmap="PuOr_r", norm=LogNorm(1 / 3, 3), aspect="auto")
    for (i, j), value in np.ndenumerate(lift):
        if np.isfinite(value):
            colour = "white" if abs(np.log(value)) > np.log(2.2) else INK
            axis.text(j, i, f"{value:.1f}", ha="center", va="center", fontsize=6.5, color=colour)
    names, parts = zip(*map(split_regime, regimes), strict=True)
    axis.set_xticks(range(len(regimes)), parts, rotation=90)
    edges = [i for i in range(len(names)) if i == 0 or names[i] != names[i - 1]]
    for start, end in zip(edges, [*edges[1:], len(names)], strict=True):
        axis.axvline(start - 0.5, color=INK, linewidth=0.6)
        name = re.sub(" (of|on|in) ", r"\n\1 ", names[start])
        axis.text((start + end - 1) / 2, -0.62, name, ha="center", va="bottom", fontsize=7, rotation=90)
    axis.grid(visible=False)
    axis.set_yticks([])
    axis.tick_params(length=0)
    axis.spines[:].set_visible(False)
    bar = figure.colorbar(image, ax=axis, shrink=0.8, label="× the channel's average")
    bar.set_ticks((1 / 3, 1 / 2, 1, 2, 3), labels=("⅓", "½", "1", "2", "3"))
    bar.ax.minorticks_off()
    bar.outline.set_visible(False)


@styled
def overlay_figure(windows: Windows, simulated: Sequence[Array], noise: Array) -> Figure:
    """Measured and simulated around each channel's worst window, and the errors there; the worst channel first.

    Channels that show noise alone are left out.

    Args:
        windows: held out.
        simulated: by the model as given, refitted and repaired, (w, S, c) each; the last may be missing.
        noise: standard deviation of each channel's, (c,).
    """
    refit = np.nan_to_num(np.nanmean((simulated[1] - windows.measured) ** 2, axis=1)) / noise**2
    moves = windows.channel_scale() > MOVING * noise
    ordered = np.argsort(-refit.max(axis=0) * (moves if moves.any() else 1.0))
    chosen = ordered[: min(_MOST_CHANNELS, int(moves.sum()) or len(moves))]
    figure = Figure(figsize=(_WIDTH, 1.6 * len(chosen) + 0.7), layout="constrained")
    panels = figure.subplots(len(chosen), 2, squeeze=False, sharex="row")
    for (left, right), c in zip(panels, chosen, strict=True):
        around = _neighbours(windows, int(np.argmax(refit[:, c])))
        for w in around:
            time, measured = windows.start_time[w] + windows.offsets, windows.measured[w, :, c]
            left.plot(time, measured, color=INK, linewidth=2.4, alpha=0.35, label="measured")
            for values, (label, style) in zip(simulated, _STAGES, strict=False):
                left.plot(time, values[w, :, c], label=label, linewidth=1.2, **style)
                right.plot(time, values[w, :, c] - measured, label=label, linewidth=1.2, **style)
        right.axhline(0, color=INK, linewidth=0.6)
        _limit(left, [windows.measured[around, :, c], *(s[around, :, c] for s in simulated[1:])])
        _limit(right, [s[around, :, c] - windows.measured[around, :, c] for s in simulated[1:]])
        channel = windows.channels[c]
        left.set_ylabel(f"[{channel.unit or '1'}]")
        left.set_title(channel.name)
        right.set_title("simulated minus measured", fontsize=8, color=GREY, weight="normal")
        left.set_title(windows.recording[around[0]], fontsize=7.5, color=GREY, loc="right", weight="normal")
    for axis in panels[-1]:
        axis.set_xlabel("time in the recording [s]")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    figure.legend(unique.values(), unique.keys(), loc="outside upper right", ncols=4)
    return figure


@styled
def error_figure(values: Sequence[float], intervals: Sequence[tuple[float, float]], noise_floor: float) -> Figure:
    """The error of the model as given, refitted and repaired, on recordings that no fit saw.

    Args:
        values: normalised root-mean-square errors, up to three.
        intervals: 95 %, by bootstrap over recordings or, of one alone, over its half seconds.
        noise_floor: what a right model would have.
    """
    figure = Figure(figsize=(_WIDTH, 0.85 + 0.5 * len(values)), layout="constrained")
    axis = figure.add_subplot()
    colours = ("#A3A8AF", ORANGE, BLUE)[: len(values)]
    ends = np.array(intervals)
    ends = np.where(np.isfinite(ends), ends, np.array(values)[:, None])
    low, high = ends.T
    spread = np.clip([values - low, high - np.array(values)], 0, None)
    axis.barh(range(len(values)), values, color=colours, height=0.62)
    axis.errorbar(values, range(len(values)), xerr=spread, fmt="none", ecolor=INK, elinewidth=1.2, capsize=3)
    axis.axvline(noise_floor, color=GREEN, linestyle="--", label=f"noise floor {noise_floor:.2g}")
    if max(values) > _WIDEST_RATIO * min(values):
        axis.set_xscale("log")
        axis.set_xlim(min(*values, noise_floor) / 2, 2 * max(high))
    for i, value in enumerate(values):
        axis.annotate(
            f"{value:.3g}", (high[i], i), (6, 0), textcoords="offset points", va="center", color=INK, weight="bold"
        )
    axis.set_yticks(range(len(values)), [label for label, _ in _STAGES][: len(values)])
    axis.invert_yaxis()
    axis.grid(visible=False, axis="y")
    axis.margins(x=0.12)
    axis.set_xlabel("normalised RMSE on recordings that no fit saw; bars: 95 % by bootstrap")
    figure.legend(loc="outside upper right")
    return figure


@styled
def candidates_figure(
    names: Sequence[str],
    fitted: Sequence[float],
    held_out: Sequence[float],
    leaves: Sequence[float],
    each: float,
    in_all: float,
) -> Figure:
    """What each candidate gains, in nats, best first, against what it must gain to be called missing.

    Gains span decades; what candidates of much gain leave tells them apart.

    Args:
        names: of the candidates.
        fitted: gains on the fitted windows, less the price of the parameters.
        held_out: gains on windows that no fit saw.
        leaves: mean square of the errors there, noise leaves 1.
        each: threshold of either.
        in_all: threshold of their sum.
    """
    at = np.arange(len(names))
    figure = Figure(figsize=(_WIDTH, 0.9 + 0.42 * len(names)), layout="constrained")
    axis = figure.add_subplot()
    axis.barh(at - 0.19, fitted, height=0.36, color=BLUE, label="fitted recordings")
    axis.barh(
        at + 0.19, held_out, height=0.36, color=ORANGE, label="held-out recordings", hatch="///", edgecolor="white"
    )
    axis.axvline(each, color=INK, linestyle="--", linewidth=1.0, label=f"needed: {each:g} in each, {in_all:g} in all")
    axis.axvline(0, color=INK, linewidth=0.6)
    axis.set_xscale("symlog", linthresh=in_all)
    axis.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axis.set_xlim(min(0.0, 2 * min(*fitted, *held_out)), 3 * max(*fitted, *held_out, in_all))
    axis.set_yticks(at, names)
    axis.invert_yaxis()
    axis.grid(visible=False, axis="y")
    axis.set_xlabel("gain [nats]")
    right = axis.secondary_yaxis("right")
    right.set_yticks(at, [f"{left:,.2f}" for left in leaves])
    right.set_ylabel("leaves (noise: 1)")
    figure.legend(loc="outside upper right", ncols=3)
    return figure


@styled
def curve_figure(curve: Curve) -> Figure:
    """What is missing against the variable that describes it best: in each recording, and in all together."""
    figure = Figure(figsize=(6.5, 3.4), layout="constrained")
    axis = figure.add_subplot()
    points = len(curve.x) <= 2
    for i, alone in enumerate(curve.by_recording):
        label = "each recording alone" if i == 0 else None
        axis.plot(curve.x, alone, "o-" if points else "-", color=GREY, alpha=0.55, linewidth=0.9, label=label)
    axis.plot(curve.x, curve.y, "o-" if points else "-", color=BLUE, linewidth=2.4, label="all recordings")
    axis.axhline(0, color=INK, linewidth=0.6)
    _limit(axis, [curve.y, *curve.by_recording])
    axis.set_xlabel(_with_unit(curve.variable, curve.variable_unit))
    axis.set_ylabel(_with_unit(f"missing {curve.carrier}", curve.carrier_unit))
    axis.set_title(f"R² {curve.r2:.2f} on recordings not used")
    axis.legend(loc="best")
    return figure


def _telling_regimes(rows: Sequence[Row]) -> list[str]:
    """Regimes of the partitions that differ most in what is left in them, in the order of their names."""
    strength: dict[str, float] = {}
    parts: dict[str, list[str]] = {}
    for row in rows:
        if row.regime == EVERYWHERE:
            continue
        partition, _ = split_regime(row.regime)
        parts.setdefault(partition, [])
        if row.regime not in parts[partition]:
            parts[partition].append(row.regime)
        strength[partition] = max(strength.get(partition, 0.0), row.telling)
    best = sorted(strength, key=lambda partition: -strength[partition])[:_MOST_PARTITIONS]
    return [regime for partition in best for regime in sorted(parts[partition], key=_natural)]


def _natural(regime: str) -> int:
    """Low before middle before high."""
    order = ("hold", "free", "smooth", "steady", "away", "early", "low", "middle", "high", "late")
    _, part = split_regime(regime)
    return order.index(part) if part in order else len(order)


def _neighbours(windows: Windows, worst: int) -> list[int]:
    """The worst window and those around it in its recording, in time."""
    same = [w for w, name in enumerate(windows.recording) if name == windows.recording[worst]]
    same.sort(key=lambda w: windows.start_time[w])
    first = max(0, min(same.index(worst) - _SHOWN_WINDOWS // 2, len(same) - _SHOWN_WINDOWS))
    return same[first : first + _SHOWN_WINDOWS]


def _limit(axis: Axes, shown: Sequence[Array]) -> None:
    """Let the axis show these values; others (a model that diverged) may leave it."""
    values = np.concatenate([np.ravel(of) for of in shown])
    values = values[np.isfinite(values)]
    if len(values) and np.ptp(values):
        margin = 0.08 * np.ptp(values)
        axis.set_ylim(values.min() - margin, values.max() + margin)


def _with_unit(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit else name
