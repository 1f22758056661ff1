"""What acts outside the model: columns that show something else than what they stand for, and commands that are late.

A parameter that writes ``column.bias``, ``column.scale`` or ``column.delay`` of a column acts after the simulation,

    shown(t) = scale * true(t - delay) + bias,

and one that writes ``command.delay`` of an actuator acts before it. (MuJoCo's own delays are at least one timestep
long, as a command is stored after it was used: what is shorter cannot be said in MJCF.)
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import CubicSpline

from simopt_envs.physics.parameters import Array, Parameter, ParameterSpace

_OUTSIDE = ("column.", "command.", "clock.")
_NEUTRAL = {"column.bias": 0.0, "column.scale": 1.0, "column.delay": 0.0}


def acts_on_columns(parameter: Parameter) -> bool:
    """Whether a parameter changes columns of recordings, what sensors show or when commands arrive, not the model."""
    return any(write.field.startswith(_OUTSIDE) for write in parameter.writes)


class ColumnModel:
    """What the columns of a recording show, for values of a space.

    Args:
        space: parameters; those that write no ``column.`` field do nothing here.
        columns: names of the recording's columns, c of them.
    """

    def __init__(self, space: ParameterSpace, columns: Sequence[str]):
        self._places = [
            (write.field, columns.index(write.object), i)
            for i, parameter in enumerate(space)
            for write in parameter.writes
            if write.field in _NEUTRAL and write.object in columns
        ]

    def __bool__(self) -> bool:
        return bool(self._places)

    def shown(self, true: Array, xi: Array, period: float) -> Array:
        """True values (n, w, S, c), sampled at a period [s], -> what the columns show for ξ (n, d)."""
        shown = true.copy()
        for column in {c for _, c, _ in self._places}:
            bias, scale, delay = (self._of(field, column, xi) for field in _NEUTRAL)
            late = _shifted(true[..., column], delay, period) if delay.any() else true[..., column]
            shown[..., column] = scale[:, None, None] * late + bias[:, None, None]
        return shown

    def meant(self, shown: Array, rate: Array, column: int, xi: Array) -> Array:
        """What is true where a column shows values (w,) that change at a rate (w,), for ξ (n, d): (n, w)."""
        bias, scale, delay = (self._of(field, column, xi)[:, None] for field in _NEUTRAL)
        return (shown - bias) / scale + delay * rate / scale

    def _of(self, field: str, column: int, xi: Array) -> Array:
        """One property of a column for each ξ, (n,)."""
        mine = [i for f, c, i in self._places if f == field and c == column]
        if field == "column.scale":
            return np.prod(xi[:, mine], axis=1)
        return np.sum(xi[:, mine], axis=1)


class CommandModel:
    """When commands arrive, for values of a space.

    Args:
        space: parameters; those that write no ``command.delay`` do nothing here.
        actuators: names of the commanded actuators, nu of them.
    """

    def __init__(self, space: ParameterSpace, actuators: Sequence[str]):
        self._places = [
            (actuators.index(write.object), i)
            for i, parameter in enumerate(space)
            for write in parameter.writes
            if write.field == "command.delay" and write.object is not None
        ]
        self._count = len(actuators)

    def delays(self, xi: Array) -> Array:
        """Seconds for ξ (n, d) and each actuator, (n, nu)."""
        delays = np.zeros((len(xi), self._count))
        for actuator, i in self._places:
            delays[:, actuator] += xi[:, i]
        return delays

    def arriving(self, past: Array, commands: Array, xi: Array, timestep: float) -> Array:
        """What arrives in each step, linear between steps.

        Args:
            past: commands before the first step, (w, P, nu), oldest first.
            commands: as given, (w, N, nu).
            xi: (n, d).
            timestep: of the steps [s].

        Returns:
            (n, w, N, nu).
        """
        stream = np.concatenate([past, commands], axis=1)
        at = past.shape[1] + np.arange(commands.shape[1])
        steps = np.clip(self.delays(xi) / timestep, 0, past.shape[1] - 1)
        whole = np.floor(steps).astype(np.intp)
        out = np.empty((len(xi), *commands.shape))
        for actuator in range(self._count):
            late = at - whole[:, actuator, None]  # (n, N)
            part = (steps[:, actuator] - whole[:, actuator])[:, None, None]
            values = stream[:, :, actuator]
            now, before = (np.moveaxis(values[:, index], 1, 0) for index in (late, late - 1))
            out[..., actuator] = (1 - part) * now + part * before
        return out


def _shifted(values: Array, delay: Array, period: float) -> Array:
    """Values (n, w, S) at each time less the delay (n,) [s]; before the first sample by extrapolation."""
    samples = values.shape[-1]
    time = period * np.arange(samples)
    out = np.empty_like(values)
    for i, seconds in enumerate(delay):
        finite = np.isfinite(values[i]).all(axis=-1)
        out[i] = np.nan
        if finite.any():
            out[i, finite] = CubicSpline(time, values[i, finite], axis=-1)(time - seconds)
    return out
