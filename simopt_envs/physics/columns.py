"""What acts outside the model: columns that show something else than what they stand for, and commands that are late.

A parameter that writes ``column.bias``, ``column.scale`` or ``column.delay`` of a column acts after the simulation,

    shown(t) = scale * true(t - delay) + bias,

and one that writes ``command.delay`` of an actuator acts before it. (MuJoCo's own delays are at least one timestep
long, as a command is stored after it was used: what is shorter cannot be said in MJCF.) Of either delay the share
``column.lag_share`` or ``command.lag_share`` is that of a first-order lag, and the rest is dead time.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

from simopt_envs.physics.parameters import Array, Parameter, ParameterSpace, unknown_name

_OUTSIDE = ("column.", "command.", "clock.")
_NEUTRAL = {"column.bias": 0.0, "column.scale": 1.0, "column.delay": 0.0, "column.lag_share": 0.0}
# Ages, in time constants, and weights that a first-order lag gives to what was before (Gauss-Laguerre).
_AGES, _WEIGHTS = np.polynomial.laguerre.laggauss(3)


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
            bias, scale, delay, share = (self._of(field, column, xi) for field in _NEUTRAL)
            late = _late(true[..., column], delay, share * delay, period) if delay.any() else true[..., column]
            shown[..., column] = scale[:, None, None] * late + bias[:, None, None]
        return shown

    def meant(self, column: int, xi: Array, shown: Array, rate: Array, acceleration: Array | float = 0.0) -> Array:
        """What is true where a column shows values that change.

        Args:
            column: its index.
            xi: (n, d).
            shown: values, (w,).
            rate: their derivative by time, (w,).
            acceleration: the second one, (w,), or 0 where it is not known.

        Returns:
            (n, w).
        """
        bias, scale, delay, share = (self._of(field, column, xi)[:, None] for field in _NEUTRAL)
        return (shown - bias + delay * rate + 0.5 * delay**2 * (1 - share**2) * acceleration) / scale

    def meant_rate(self, column: int, xi: Array, rate: Array, acceleration: Array) -> Array:
        """The derivative by time (n, w) of what is true where a column's values have these derivatives, (w,)."""
        _, scale, delay, _ = (self._of(field, column, xi)[:, None] for field in _NEUTRAL)
        return (rate + delay * acceleration) / scale

    def _of(self, field: str, column: int, xi: Array) -> Array:
        """One property of a column for each ξ, (n,)."""
        mine = [i for f, c, i in self._places if f == field and c == column]
        if field == "column.scale":
            return np.prod(xi[:, mine], axis=1)
        return np.sum(xi[:, mine], axis=1)


class CommandModel:
    """When commands arrive, for values of a space.

    Args:
        space: parameters; those that write neither ``command.delay`` nor ``command.lag_share`` do nothing here.
        actuators: names of the commanded actuators, nu of them.

    Raises:
        ValueError: if a parameter writes the commands of another.
    """

    def __init__(self, space: ParameterSpace, actuators: Sequence[str]):
        delays = [
            (write, i)
            for i, parameter in enumerate(space)
            for write in parameter.writes
            if write.field in ("command.delay", "command.lag_share") and write.object is not None
        ]
        if unknown := [write.object for write, _ in delays if write.object not in actuators]:
            raise ValueError(unknown_name("commanded actuator", unknown[0], actuators))
        self._places = [(write.field, actuators.index(write.object), i) for write, i in delays]
        self._count = len(actuators)

    def delays(self, xi: Array) -> Array:
        """Seconds for ξ (n, d) and each actuator, (n, nu): dead times and lags together."""
        return self._of("command.delay", xi)

    def lags(self, xi: Array) -> Array:
        """Time constants [s] of the lags among the delays, (n, nu)."""
        return self._of("command.lag_share", xi) * self.delays(xi)

    def _of(self, field: str, xi: Array) -> Array:
        values = np.zeros((len(xi), self._count))
        for _, actuator, i in (place for place in self._places if place[0] == field):
            values[:, actuator] += xi[:, i]
        return values

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
        lags = self.lags(xi) / timestep
        stream = np.concatenate([past, commands], axis=1)
        first = 0 if lags.any() else past.shape[1]  # a lag remembers
        at = np.arange(first, stream.shape[1])
        steps = np.clip(self.delays(xi) / timestep - lags, 0, past.shape[1] - 1)
        whole = np.floor(steps).astype(np.intp)
        out = np.empty((len(xi), *commands.shape))
        for actuator in range(self._count):
            late = np.maximum(at - whole[:, actuator, None], 1)  # (n, N)
            part = (steps[:, actuator] - whole[:, actuator])[:, None, None]
            values = stream[:, :, actuator]
            now, before = (np.moveaxis(values[:, index], 1, 0) for index in (late, late - 1))
            arrived = (1 - part) * now + part * before
            for one, lag in zip(arrived, lags[:, actuator], strict=True):
                if lag:
                    one[:] = _lagging(one, lag)
            out[..., actuator] = arrived[..., past.shape[1] - first :]
        return out


def _lagging(held: Array, lag: float) -> Array:
    """Means over each step of what a first-order lag (in steps) makes of values that are held, (..., N)."""
    kept = np.exp(-1 / lag)
    at_once, later = 1 - lag * (1 - kept), lag * (1 - kept) ** 2
    return lfilter([at_once, later - kept * at_once], [1, -kept], held, zi=(1 - at_once) * held[..., :1])[0]


def _late(values: Array, delay: Array, lag: Array, period: float) -> Array:
    """Values (n, w, S) at each time less the delay (n,) [s], of which so much is a lag (n,) [s]."""
    if not lag.any():
        return _shifted(values, delay, period)
    aged = (_shifted(values, delay + (age - 1) * lag, period) for age in _AGES)
    return np.sum([weight * each for weight, each in zip(_WEIGHTS, aged, strict=True)], axis=0)


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
