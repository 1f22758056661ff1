"""Where a model and recordings disagree: the whitened errors by channel and by regime."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from simopt_envs.gap.circumstances import Circumstances, Mask, circumstances
from simopt_envs.measured.windows import Windows
from simopt_envs.physics.parameters import Array

EVERYWHERE = "all"
"""The regime of a channel as a whole."""
SIGNIFICANT = 3.0
"""Standard errors from which a regime counts."""

_AFTER = 0.1  # s after a reversal or a command's step that count as its regime
_FEWEST_WINDOWS = 4  # that a regime is in, to say anything of it beside the channel as a whole
_LEAST_SHARE = 0.02  # of the samples, likewise
_VARIANCE_OF_SQUARE = 2.0  # of a standard normal
_NOISE_KNOWN_BY = 2 / 3.9  # samples' worth: second differences, which give the size of the noise, go together


@dataclass(frozen=True)
class Row:
    """The misfit of one channel in one regime.

    Attributes:
        channel: the column.
        regime: ``"all"``, or a partition of the samples and the part meant, ``"speed of elbow: high"``.
        share: of the squared errors of all channels; those of a partition's parts and all channels sum to one.
        lift: mean square here relative to the channel's over the partition: 1 where the regime makes no difference.
        z: mean square above 1, which is what noise leaves, in standard errors.
    """

    channel: str
    regime: str
    share: float
    lift: float
    z: float

    @property
    def telling(self) -> float:
        """How much it matters that the misfit is larger, or smaller, here than elsewhere; 0 for what may be chance."""
        return self.share * abs(np.log(max(self.lift, 1e-3))) if self.z > SIGNIFICANT else 0.0


@dataclass(frozen=True)
class Partition:
    """Disjoint regimes: what they differ in, and the samples (w, S) of each."""

    name: str
    parts: dict[str, Mask]


def split_regime(regime: str) -> tuple[str, str]:
    """The partition and the part of a regime; joints, which partitions are named after, may have ``": "`` in theirs."""
    partition, _, part = regime.rpartition(": ")
    return partition, part


def localise(windows: Windows, errors: Array, model: mujoco.MjModel, parts: int = 1) -> tuple[Row, ...]:
    """The misfit by channel and regime, largest share first.

    Args:
        windows: w windows of S samples of c channels.
        errors: whitened errors there of the model with its plain parameters refitted, (w, S, c).
        model: that the windows were cut for.
        parts: stretches in a window, of which each counts as one: errors of long windows go together in stretches.
    """
    length = errors.shape[1] // parts

    def cut(values: NDArray[Any]) -> NDArray[Any]:
        return values[:, : parts * length].reshape(-1, length, *values.shape[2:])

    present = [
        Partition(partition.name, {name: cut(mask) for name, mask in partition.parts.items()})
        for partition in partitions(circumstances(model, windows))
    ]
    return tabulate(windows.names, cut(errors), cut(np.isfinite(windows.measured)), present)


def partitions(of: Circumstances) -> Iterator[Partition]:
    """The regimes that are told apart; partitions of which only one part occurs are left out."""
    yield Partition(EVERYWHERE, {"": np.ones(of.contact.shape, dtype=bool)})
    held, after = of.held(), max(1, round(_AFTER / of.period))
    turned = _soon_after(np.diff(of.direction(), axis=1, prepend=of.direction()[:, :1]) != 0, after)
    for j, joint in enumerate(of.joints):
        moving, speed, load = ~held[..., j], np.abs(of.velocity[..., j]), np.abs(of.load[..., j])
        if not speed.any():
            continue
        low = speed <= np.median(speed[moving]) if moving.any() else moving
        yield Partition(f"speed of {joint}", {"hold": ~moving, "low": moving & low, "high": moving & ~low})
        yield Partition(f"direction of {joint}", {"just reversed": turned[..., j], "steady": ~turned[..., j]})
        yield Partition(f"position of {joint}", _thirds(of.position[..., j], ("low", "middle", "high")))
        heavy = load > np.median(load)
        yield Partition(f"load on {joint}", {"low": ~heavy, "high": heavy})
        stopped = _soon_after(of.stopped[..., j : j + 1], after)[..., 0]
        yield Partition(f"stop of {joint}", {"just reached": stopped, "away": ~stopped})
    yield Partition("contact", {"touching": of.contact, "free": ~of.contact})
    stepped = _soon_after(of.stepped()[..., None], after)[..., 0]
    yield Partition("command", {"just stepped": stepped, "smooth": ~stepped})
    yield Partition("time in the recording", _thirds(of.time, ("early", "middle", "late")))


def tabulate(
    channels: Sequence[str], errors: Array, counted: Mask, partitions: Iterator[Partition] | Sequence[Partition]
) -> tuple[Row, ...]:
    """The rows of some partitions, largest share first.

    Args:
        channels: names of the c channels.
        errors: whitened, (w, S, c).
        counted: which of them were measured, (w, S, c).
        partitions: of the samples.
    """
    rows = []
    for partition in partitions:
        parts = {name: counted & mask[..., None] for name, mask in partition.parts.items()}
        if partition.name != EVERYWHERE:
            parts = {name: mask for name, mask in parts.items() if _is_present(mask)}
            if len(parts) < 2:
                continue
        squares = {name: np.sum(errors**2, axis=(0, 1), where=mask) for name, mask in parts.items()}
        counts = {name: np.maximum(mask.sum(axis=(0, 1)), 1) for name, mask in parts.items()}
        of_channel = sum(squares.values()) / np.maximum(sum(counts.values()), 1)
        total = sum(float(square.sum()) for square in squares.values()) or 1.0
        for name, mask in parts.items():
            z = _z(errors, mask, counted)
            lift = squares[name] / counts[name] / np.where(of_channel > 0, of_channel, 1.0)
            regime = f"{partition.name}: {name}" if name else partition.name
            rows += [
                Row(channel, regime, float(squares[name][c] / total), float(lift[c]), float(z[c]))
                for c, channel in enumerate(channels)
            ]
    return tuple(sorted(rows, key=lambda row: (-row.share, -row.z)))


def _z(errors: Array, mask: Mask, counted: Mask) -> Array:
    """Mean square of the errors in a regime above 1, in the standard errors that it has without a gap, (c,).

    These are of the scatter over windows, since errors within one go together: at least what normal errors scatter that
    are independent, as a few windows may scatter less by chance; at most what those do that are all the same within a
    window, as more is of the gap itself, which would hide where it shows in one of a few recordings. Of hardly any
    windows it is the most. On top comes that of the noise which the errors were whitened with: it was estimated from
    about as many samples as there are.
    """
    count = mask.sum(axis=1)
    surplus = np.sum(errors**2 - 1.0, axis=1, where=mask)
    total = count.sum(axis=0)
    mean = surplus.sum(axis=0) / np.maximum(total, 1)
    windows = np.count_nonzero(count, axis=0)
    scatter = np.sum((surplus - mean * count) ** 2, axis=0) * windows / np.maximum(windows - 1, 1)
    together = np.sum(count**2, axis=0)
    least = np.where(windows < _FEWEST_WINDOWS, together, total)
    scatter = np.clip(scatter, _VARIANCE_OF_SQUARE * least, _VARIANCE_OF_SQUARE * together)
    variance = scatter / np.maximum(total, 1) ** 2
    of_noise = _VARIANCE_OF_SQUARE / np.maximum(_NOISE_KNOWN_BY * counted.sum(axis=(0, 1)), 1)
    error = np.sqrt(variance + of_noise)
    return mean / np.where(error > 0, error, 1.0)


def _is_present(mask: Mask) -> bool:
    """Whether a regime occurs in enough windows and samples."""
    present = np.any(mask, axis=2)
    return int(present.any(axis=1).sum()) >= _FEWEST_WINDOWS and float(present.mean()) >= _LEAST_SHARE


def _soon_after(events: Mask, samples: int) -> Mask:
    """Events (w, S, j) and the samples that follow each."""
    structure = np.zeros((1, 2 * samples + 1, 1), dtype=bool)
    structure[:, samples:] = True
    return binary_dilation(events, structure)


def _thirds(values: Array, names: tuple[str, str, str]) -> dict[str, Mask]:
    """Terciles of the samples."""
    lower, upper = np.quantile(values, (1 / 3, 2 / 3))
    low, high = values <= lower, values > upper
    return {names[0]: low, names[1]: ~low & ~high, names[2]: high}
