"""How far three models are from recordings that no fit saw: as given, refitted, and repaired."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simopt_envs.gap.hypothesis import Hypothesis
from simopt_envs.gap.thresholds import MOVING, WINDOW
from simopt_envs.measured.replay import start_sensitivity
from simopt_envs.measured.windows import Windows
from simopt_envs.physics.parameters import Array

_RESAMPLES = 2000
_DIVERGED = 10.0  # standard deviations of its channel that a sample counts for which a simulation did not reach


@dataclass(frozen=True)
class Errors:
    """Normalised root-mean-square errors of held-out windows: each channel relative to its standard deviation.

    Attributes:
        before, refit, after: of the model as given, with its plain parameters refitted, and repaired.
        noise_floor: what the noise of the sensors and of the estimated starts leaves a right model with.
        interval95: of ``after``, by bootstrap over recordings or, of one alone, over its half seconds.
        intervals: of all three, in their order.
        simulated: what each predicts, (w, S, c).
    """

    before: float
    refit: float
    after: float
    noise_floor: float
    intervals: tuple[tuple[float, float], ...]
    simulated: tuple[Array, Array, Array]

    @property
    def interval95(self) -> tuple[float, float]:
        """Of ``after``."""
        return self.intervals[2]


def held_out_errors(
    windows: Windows, models: Sequence[tuple[Hypothesis, Array]], noise: Array, rng: np.random.Generator
) -> Errors:
    """The errors of three models, each a hypothesis with its ξ (d,).

    Args:
        windows: held out.
        models: as given, refitted, repaired.
        noise: standard deviation of each channel's noise, (c,).
        rng: for the bootstrap.

    Raises:
        ValueError: where no channel shows more than noise.
    """
    scale = windows.channel_scale()
    moving = moving_channels(windows.names, scale, noise)
    names, parts = np.array(windows.recording), 1
    groups = [np.flatnonzero(names == name) for name in dict.fromkeys(windows.recording)]
    if len(groups) == 1:  # half seconds stand for recordings
        parts = max(1, round(windows.seconds / WINDOW))
        groups = list(np.arange(parts * len(windows))[:, None])
    simulated, squares = [], []
    for hypothesis, xi in models:
        predicted = hypothesis.simulator(windows)(xi[None])[0]
        diverged = np.isnan(predicted) & np.isfinite(windows.measured)
        off = np.where(diverged, _DIVERGED * scale, predicted - windows.measured)
        simulated.append(predicted)
        stretches = np.array_split((off[..., moving] / scale[moving]) ** 2, parts, axis=1)
        squares.append(np.concatenate([_mean(stretch) for stretch in stretches]))
    per_stretch = np.array(squares)  # (3, w parts, c)
    values = np.sqrt(np.mean(per_stretch, axis=(1, 2)))
    drawn = rng.integers(len(groups), size=(_RESAMPLES, len(groups)))
    resampled = [
        np.sqrt(np.mean(per_stretch[:, np.concatenate([groups[g] for g in draw])], axis=(1, 2))) for draw in drawn
    ]
    low, high = np.quantile(resampled, [0.025, 0.975], axis=0)
    hypothesis, xi = models[-1]
    simulator = hypothesis.simulator(windows)
    starts = np.nan_to_num(start_sensitivity(hypothesis.model, simulator, xi[None], simulated[-1]))
    floor = np.sqrt(np.mean((noise**2 + np.sum(starts**2, axis=0))[..., moving] / scale[moving] ** 2))
    before, refit, after = map(float, values)
    return Errors(
        before,
        refit,
        after,
        noise_floor=float(floor),
        intervals=tuple((float(a), float(b)) for a, b in zip(low, high, strict=True)),
        simulated=(simulated[0], simulated[1], simulated[2]),
    )


def moving_channels(names: Sequence[str], scale: Array, noise: Array) -> NDArray[np.bool_]:
    """Which channels of held-out recordings show more than noise, (c,): one that does not says nothing.

    Args:
        names: of the channels, c.
        scale: standard deviation of each, (c,).
        noise: standard deviation of each one's noise, (c,).

    Raises:
        ValueError: where none does.
    """
    moving = scale > MOVING * noise
    if not moving.any():
        raise ValueError(f"nothing moves in the recordings held out: {', '.join(names)} show noise alone")
    return moving


def _mean(squares: Array) -> Array:
    """Over the samples of each window that were measured, (w, S, c) -> (w, c)."""
    measured = np.isfinite(squares)
    total = np.sum(np.where(measured, squares, 0.0), axis=1)
    return total / np.maximum(measured.sum(axis=1), 1)
