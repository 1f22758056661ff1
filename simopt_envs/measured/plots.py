"""Plots of recordings and replays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from simopt_envs.measured.recording import Finding, Recording
from simopt_envs.measured.replay import Replay

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_ROW = 1.6  # inches per channel
_WIDTH = 10.0


def plot_recording(
    recording: Recording,
    path: str | Path,
    findings: Sequence[Finding] = (),
    units: Mapping[str, str] = MappingProxyType({}),
) -> Path:
    """Draw every column over time, those with findings in red, and the intervals between the time stamps.

    Args:
        recording: to draw.
        path: of the image.
        findings: of its audit.
        units: of columns, where they are known.
    """
    names = list(recording.columns)
    figure, axes = _rows(len(names) + 1)
    flagged = {finding.channel for finding in findings}
    for name, axis in zip(names, axes, strict=False):
        axis.plot(
            recording.time,
            recording[name],
            color="tab:red" if name in flagged else "tab:blue",
            linewidth=0.8,
            drawstyle="steps-post" if name.startswith("ctrl/") else "default",
        )
        axis.set_ylabel(f"{name}\n[{units[name]}]" if units.get(name) else name, fontsize=8)
    axes[-1].plot(recording.time[1:], 1e3 * np.diff(recording.time), ".", markersize=2, color="tab:gray")
    axes[-1].set_ylabel("interval [ms]", fontsize=8)
    axes[-1].set_xlabel("time [s]")
    axes[0].set_title(recording.name)
    return _save(figure, path)


def plot_replay(replay: Replay, path: str | Path, recording: str | None = None) -> Path:
    """Draw each channel, measured against simulated, over the windows of one recording (the first by default)."""
    windows = replay.windows
    name = windows.recording[0] if recording is None else recording
    chosen = [w for w, of in enumerate(windows.recording) if of == name]
    if not chosen:
        raise ValueError(f"no window of {name!r}; there are some of {', '.join(dict.fromkeys(windows.recording))}")
    figure, axes = _rows(len(windows.channels))
    for c, (channel, axis) in enumerate(zip(windows.channels, axes, strict=True)):
        for w in chosen:
            time, once = windows.start_time[w] + windows.offsets, w == chosen[0]
            simulated, spread = replay.simulated[0, w, :, c], 2 * replay.start_spread[w, :, c]
            axis.plot(time, windows.measured[w, :, c], color="black", linewidth=1.0, label="measured" if once else None)
            axis.plot(time, simulated, color="tab:orange", linewidth=1.0, label="simulated" if once else None)
            axis.fill_between(time, simulated - spread, simulated + spread, color="tab:orange", alpha=0.2, linewidth=0)
        # The uncertainty of the starts can explode; the axis shows the motion.
        shown = np.concatenate([windows.measured[chosen, :, c].ravel(), replay.simulated[0, chosen, :, c].ravel()])
        shown = shown[np.isfinite(shown)]
        if len(shown) and np.ptp(shown):
            axis.set_ylim(shown.min() - 0.05 * np.ptp(shown), shown.max() + 0.05 * np.ptp(shown))
        axis.set_ylabel(f"{channel.name}\n[{channel.unit or '1'}]", fontsize=8)
    axes[0].legend(loc="upper right", fontsize=8)
    axes[0].set_title(f"{name}: band = two standard errors of the start")
    axes[-1].set_xlabel("time [s]")
    return _save(figure, path)


def plot_error(replay: Replay, path: str | Path) -> Path:
    """Draw the error of each channel against the horizon, and the part that the starts explain."""
    windows = replay.windows
    figure, axes = _rows(len(windows.channels))
    from_start = np.sqrt(np.mean(replay.start_spread**2, axis=0))
    for c, (channel, axis) in enumerate(zip(windows.channels, axes, strict=True)):
        axis.plot(windows.offsets, replay.rmse_by_horizon[0, :, c], color="tab:orange", label="RMSE")
        axis.plot(windows.offsets, from_start[:, c], color="tab:gray", linestyle="--", label="from the start alone")
        axis.set_ylim(0, 1.05 * np.nanmax(np.where(np.isfinite(y := replay.rmse_by_horizon[0, :, c]), y, 0)) or 1)
        axis.set_ylabel(f"{channel.name}\n[{channel.unit or '1'}]", fontsize=8)
    axes[0].legend(loc="upper left", fontsize=8)
    axes[-1].set_xlabel("time since the start of a window [s]")
    return _save(figure, path)


def _rows(count: int) -> tuple[Figure, list]:
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise ImportError('plots need matplotlib: pip install "simopt-envs[report]"') from None
    figure = Figure(figsize=(_WIDTH, 0.6 + _ROW * count), layout="constrained")
    return figure, list(figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0])


def _save(figure: Figure, path: str | Path) -> Path:
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    for text in figure.findobj(lambda artist: hasattr(artist, "set_parse_math")):
        text.set_parse_math(False)  # type: ignore[attr-defined]  # names may hold dollars
    figure.savefig(path, dpi=120)
    return path
