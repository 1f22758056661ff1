"""A carrier as a function of a variable: linear least squares with hat functions, judged on recordings left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from simopt_envs.gap.carriers import Carrier, stretches
from simopt_envs.physics.parameters import Array

_KNOTS = 16
_RIDGE = 1e-5  # of the mean information about a knot: decides only what the data do not
_SMOOTHNESS = (0.0, 1e-3, 1e-2, 1e-1)  # of the same, for a bend at a knot; what predicts best is taken
_CURVE_POINTS = 60
_STEEP = 0.01  # of a variable's range, within which a curve may jump at zero


@dataclass(frozen=True, eq=False)
class Variable:
    """What a misfit may depend on.

    Attributes:
        name: ``"velocity of elbow"``.
        unit: of its values.
        of: the joint or actuator, empty for none.
        rank: simpler ones come first where they do as well.
        values: at each sample, one (w, S) for each set of windows.
    """

    name: str
    unit: str
    of: str
    rank: int
    values: tuple[Array, ...]


@dataclass(frozen=True)
class Curve:
    """A carrier as a function of a variable.

    Attributes:
        carrier, carrier_unit, variable, variable_unit: names and units.
        r2: share of the squared errors above those of noise that it takes away from recordings it was not fitted to.
        x: arguments, (g,).
        y: values, (g,), in all recordings together.
        by_recording: the same fitted to each recording alone, (r, g), NaN outside of its range.
    """

    carrier: str
    carrier_unit: str
    variable: str
    variable_unit: str
    r2: float
    x: Array
    y: Array
    by_recording: Array


@dataclass(frozen=True, eq=False)
class Regression:
    """A carrier as a function of a variable: the normal equations of r recordings, of hat functions at b knots.

    Attributes:
        carrier, variable: which.
        knots: values of the variable, (b,).
        information: of each recording, (r, b, b).
        slope: of the squared errors, halved, where the curve is zero, (r, b).
        ranges: of the variable, (r, 2).
    """

    carrier: Carrier
    variable: Variable
    knots: Array
    information: Array
    slope: Array
    ranges: Array

    @property
    def is_own(self) -> bool:
        """Whether the variable is of the joint that the force acts on."""
        return bool(self.carrier.of) and self.carrier.of == self.variable.of

    @cached_property
    def priors(self) -> Array:
        """What is added to the information of a fit, (p, b, b): next to nothing, and ever smoother curves."""
        size = max(float(np.trace(self.information.sum(axis=0))), 1e-12) / len(self.knots)
        bends = _bends(self.knots)
        smooth = [np.eye(len(self.knots)) * _RIDGE + weight * bends.T @ bends for weight in _SMOOTHNESS]
        return size * np.array(smooth)

    @cached_property
    def gains(self) -> Array:
        """Squared errors that curves of the other recordings take away from each, for each prior, (p,)."""
        others = self.information.sum(axis=0) - self.information, self.slope.sum(axis=0) - self.slope
        beta = -np.linalg.solve(others[0][:, None] + self.priors, others[1][:, None, :, None])[..., 0]
        linear = np.einsum("rb,rpb->p", self.slope, beta)
        return -2 * linear - np.einsum("rpb,rbc,rpc->p", beta, self.information, beta)

    def curve(self, r2: float) -> Curve:
        """The curve of all recordings, and of each."""
        x = self.knots if len(self.knots) <= 2 else np.linspace(self.knots[0], self.knots[-1], _CURVE_POINTS)
        hats, smooth = _hats(x, self.knots), self.priors[np.argmax(self.gains)]
        beta = -np.linalg.solve(self.information.sum(axis=0) + smooth, self.slope.sum(axis=0))
        alone = []
        for r in range(len(self.slope)):
            # Towards the common curve, where a recording alone does not tell.
            prior = 0.1 * np.diag(np.diag(self.information.mean(axis=0)) + 1e-12)
            own = beta - np.linalg.solve(self.information[r] + prior, self.slope[r] + self.information[r] @ beta)
            inside = (x >= self.ranges[r, 0]) & (x <= self.ranges[r, 1])
            alone.append(np.where(inside, hats @ own, np.nan))
        return Curve(
            self.carrier.name,
            self.carrier.unit,
            self.variable.name,
            self.variable.unit,
            r2,
            x,
            hats @ beta,
            np.array(alone),
        )


def regress(carrier: Carrier, variable: Variable, recordings: Sequence[Sequence[str]]) -> Regression:
    """The normal equations of each recording for hat functions of a variable.

    Args:
        carrier: what of.
        variable: of what.
        recordings: names of the recordings that the windows are of, for each set of windows.
    """
    knots = _knots(np.concatenate([values.ravel() for values in variable.values]))
    names = list(dict.fromkeys(name for of_set in recordings for name in of_set))
    information, slope = np.zeros((len(names), len(knots), len(knots))), np.zeros((len(names), len(knots)))
    ranges = np.tile([np.inf, -np.inf], (len(names), 1))
    for values, of_set, gram, gradient in zip(
        variable.values, recordings, carrier.information, carrier.slope, strict=True
    ):
        inside = stretches(values.shape[1], gram.shape[-1])
        basis = np.einsum("wsb,sk->wkb", _hats(values, knots), inside / inside.sum(axis=0))
        rows = np.array([names.index(name) for name in of_set])
        np.add.at(information, rows, np.swapaxes(basis, 1, 2) @ gram @ basis)
        np.add.at(slope, rows, np.einsum("wkb,wk->wb", basis, gradient))
        np.minimum.at(ranges[:, 0], rows, values.min(axis=1))
        np.maximum.at(ranges[:, 1], rows, values.max(axis=1))
    return Regression(carrier, variable, knots, information, slope, ranges)


def _knots(values: Array) -> Array:
    """Where hat functions of a variable peak: its values where there are two, else quantiles, (b,).

    Around zero there are two more, close together, so that a curve may jump there.
    """
    unique = np.unique(values)
    if len(unique) <= 2:
        return unique
    inner = np.quantile(values, np.linspace(0, 1, _KNOTS)[1:-1])
    zero = _STEEP * (inner[-1] - inner[0]) * np.array([-1.0, 1.0])
    if inner[0] < zero[0] and zero[1] < inner[-1]:
        inner = np.concatenate([inner[(inner < 2 * zero[0]) | (inner > 2 * zero[1])], zero])
    knots = np.unique(np.concatenate([unique[[0]], inner, unique[[-1]]]))
    return knots[np.append(True, np.diff(knots) > 1e-9 * np.ptp(knots))]


def _hats(values: Array, knots: Array) -> Array:
    """Hat functions at values (...,), (..., b)."""
    return np.stack([np.interp(values, knots, unit) for unit in np.eye(len(knots))], axis=-1)


def _bends(knots: Array) -> Array:
    """Changes of a curve's slope at its knots, in units of its values, (n, b); none where it may jump."""
    spacing, steep = np.diff(knots), 3 * _STEEP * np.ptp(knots)
    rows = []
    for i in range(1, len(knots) - 1):
        if min(spacing[i - 1], spacing[i]) > steep or len(knots) < _KNOTS:
            row = np.zeros(len(knots))
            row[i - 1 : i + 2] = 1 / spacing[i - 1], -1 / spacing[i - 1] - 1 / spacing[i], 1 / spacing[i]
            rows.append(row * spacing[i - 1 : i + 1].mean())
    return np.array(rows).reshape(-1, len(knots))
