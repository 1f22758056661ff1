"""Where a fit that has ended looks again, beyond what small steps reach."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from simopt_envs.gap.chart import Chart
from simopt_envs.gap.hypothesis import Hypothesis
from simopt_envs.physics.parameters import Array

_BEYOND = np.geomspace(3.0, 3000.0, 7)  # standard deviations from where a fit ended
_SIZES = np.array([0.2, 0.35, 0.6, 0.8, 1.25, 1.7, 3.0, 5.0])  # of what it ended with
_PROMISING = 3  # of these that are simulated with the other parameters where they then belong


def along_uncertain(x: Array, rows: Array, columns: Sequence[int]) -> Array:
    """Coordinates far along the axes of what is uncertain of some columns, the others as these foretell, (n, d).

    Args:
        x: where the fit ended, (d,).
        rows: the derivative of its residual by x there, (m, d).
        columns: of the effects.
    """
    covariance = np.linalg.pinv(_squares(rows), hermitian=True)
    variances, axes = np.linalg.eigh(covariance[np.ix_(columns, columns)])
    known = variances > 0
    along = covariance[:, columns] @ (axes[:, known] / np.sqrt(variances[known]))
    steps = np.concatenate([-_BEYOND, _BEYOND])
    return x + (steps[:, None, None] * along.T).reshape(-1, len(x))


def of_other_sizes(
    x: Array, rows: Array, residual: Callable[[Array], Array], chart: Chart, hypothesis: Hypothesis
) -> Array:
    """Coordinates with less or more of each effect, all else where a linear model has it then, (n, d).

    What holds a thing at rest, or lets it go, makes a misfit rugged along an effect's amount, so that no derivative by
    that tells where it leads; by the others they still do.

    Args:
        x: where the fit ended, (d,).
        rows: the derivative of its residual by x there, (m, d).
        residual: that of x (d, n), (m, n).
        chart: of x.
        hypothesis: that is fitted.
    """
    u, neutral, found = chart.bent(x), hypothesis.neutral(), [np.empty((0, len(x)))]
    for candidate, own in hypothesis.columns.items():
        amounts, others = hypothesis.amounts(candidate), np.setdiff1d(np.arange(len(x)), own)
        if not amounts:
            continue
        sized = np.tile(u, (len(_SIZES), 1))
        sized[:, amounts] = neutral[amounts] + _SIZES[:, None] * (u - neutral)[amounts]
        sized = np.clip(chart.straight(np.clip(sized, hypothesis.low, hypothesis.high)), chart.low, chart.high)
        left = residual(sized.T)
        of_others = np.ascontiguousarray(rows[:, others].T)
        pulls = np.einsum("om,mk->ko", of_others, left)
        steps = -pulls @ np.linalg.pinv(_squares(rows[:, others]), hermitian=True)
        foretold = np.sum(left**2, axis=0) + np.sum(pulls * steps, axis=1)
        sized[:, others] += steps
        found.append(np.clip(sized[np.argsort(foretold, kind="stable")[:_PROMISING]], chart.low, chart.high))
    return np.vstack(found)


def _squares(rows: Array) -> Array:
    """Sums of the products of columns, (d, d), without BLAS: what that gives depends on how many threads it has."""
    columns = np.ascontiguousarray(rows.T)
    return np.asarray(np.einsum("im,jm->ij", columns, columns))
