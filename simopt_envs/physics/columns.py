"""What MJCF cannot say of a sensor: a column that shows a scaled, shifted or late value of what it stands for.

A parameter that writes ``column.bias``, ``column.scale`` or ``column.delay`` of a column acts here, after the
simulation, and not on the model:

    shown(t) = scale * true(t - delay) + bias.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import CubicSpline

from simopt_envs.physics.parameters import Array, Parameter, ParameterSpace

_FIELD = "column."
_NEUTRAL = {"column.bias": 0.0, "column.scale": 1.0, "column.delay": 0.0}


def acts_on_columns(parameter: Parameter) -> bool:
    """Whether a parameter changes what a sensor shows, and not the model."""
    return any(write.field.startswith(_FIELD) for write in parameter.writes)


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
