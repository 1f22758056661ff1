"""Recordings that a user names: finding them, holding some out, and what an adapted model makes of those."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from baselines.commands.inputs import existing
from simopt_envs.distributions import Gaussian
from simopt_envs.measured import LogMapping, Recording, WindowSimulator, audited, load_recordings
from simopt_envs.measured.replay import Replay
from simopt_envs.measured.windows import Windows

GUARD = 0.5
"""Seconds between what is fitted of a recording and what is held out."""


def existing_logs(logs: Iterable[Path]) -> list[Path]:
    """The logs, installed data sets ``minari:ID`` among them; FileNotFoundError naming the first that is missing."""
    logs = list(logs)
    existing(log for log in logs if not str(log).startswith("minari:"))
    return logs


def read_split(
    model: mujoco.MjModel,
    data: Sequence[Path],
    held_out: Sequence[Path],
    fraction: float,
    window: float,
    mapping: Path | None = None,
) -> tuple[list[Recording], list[Recording]]:
    """The audited recordings to fit, and those held out.

    Args:
        model: to audit them against.
        data: to fit.
        held_out: not to fit; if there are none, the last part of each recording of ``data`` is held out instead.
        fraction: that part, of each recording's duration, a guard included; 0 for none.
        window: seconds of the windows that will be cut; a recording whose part would not hold one is fitted whole.
        mapping: names the columns of foreign logs.

    Raises:
        FileNotFoundError: for a log that does not exist.
        ValueError: for a fraction outside [0, 1), a log in both, or an audit that found errors.
    """
    if not 0 <= fraction < 1:
        raise ValueError(f"the fraction held out must be in [0, 1), got {fraction:g}")
    if both := set(data) & set(held_out):
        raise ValueError(f"{min(both)} is both to be fitted and held out")
    data, held_out = existing_logs(data), existing_logs(held_out)
    read_mapping = None if mapping is None else LogMapping.from_yaml(mapping)

    def read(logs: Iterable[Path]) -> list[Recording]:
        return [audited(recording, model) for log in logs for recording in load_recordings(log, read_mapping)]

    fitted, others = read(data), read(held_out)
    if others or fraction == 0:
        return fitted, others
    long = [fraction * recording.duration > GUARD + window + 2 * recording.period for recording in fitted]
    parts = [r.split(1 - fraction, GUARD) if cut else (r, None) for r, cut in zip(fitted, long, strict=True)]
    return [first for first, _ in parts], [last for _, last in parts if last is not None]


@dataclass(frozen=True)
class HeldOut:
    """What a model makes of recordings that no fit saw, before and after it was adapted.

    Attributes:
        recordings: their names.
        windows, seconds: how many windows of what length.
        channels, units: of what is compared.
        before, after: root-mean-square errors at the medians of p(ξ); None where a simulation diverged.
    """

    recordings: tuple[str, ...]
    windows: int
    seconds: float
    channels: tuple[str, ...]
    units: tuple[str, ...]
    before: tuple[float | None, ...]
    after: tuple[float | None, ...]

    @classmethod
    def of(cls, model: mujoco.MjModel, windows: Windows, before: Gaussian, after: Gaussian) -> HeldOut:
        """Replay the windows at the medians of two distributions over the same parameters."""
        space = before.space
        medians = np.clip([before.median, after.median], space.low, space.high)  # a fit may end at a bound, rounded
        simulated = WindowSimulator(model, windows, space)(medians)
        rmse = Replay(windows, simulated, np.zeros_like(windows.measured)).rmse
        return cls(
            tuple(dict.fromkeys(windows.recording)),
            len(windows),
            float(windows.offsets[-1]),
            windows.names,
            tuple(channel.unit for channel in windows.channels),
            *(tuple(float(error) if np.isfinite(error) else None for error in row) for row in rmse),
        )

    def to_dict(self) -> dict[str, Any]:
        """For ``result.json``."""
        return asdict(self)

    def __str__(self) -> str:
        rows = zip(self.channels, self.units, self.before, self.after, strict=True)
        errors = (f"{name} {_number(before)} → {_number(after)} {unit}" for name, unit, before, after in rows)
        return (
            f"Held out ({', '.join(self.recordings)}; {self.windows} windows of {self.seconds:g} s), RMSE before →"
            f" after: {', '.join(errors)}"
        )


def _number(error: float | None) -> str:
    return "diverged" if error is None else f"{error:.3g}"
