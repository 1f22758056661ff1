"""Derivatives that are known from a fit nearby, and those that are still to be taken."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from simopt_envs.physics.parameters import Array

_SILENT = 0.3  # standard deviations of the noise that one of a prior changes in all data together


def of_silent(jacobian: Array, num_plain: int) -> Array:
    """A Jacobian (..., d) of whitened errors by those plain parameters that hardly show in the data; NaN by the others.

    Nothing that a fit finds moves them far from their priors, so that their derivatives need not be taken anew.
    """
    loud = np.linalg.norm(jacobian.reshape(-1, jacobian.shape[-1]), axis=0) >= _SILENT
    loud[num_plain:] = True  # the shape of an effect is silent where there is none of it, and then is not
    return np.where(loud, np.nan, jacobian)


def to_take(known: Array | None, size: int) -> list[int]:
    """By which of so many coordinates derivatives are not known: NaN, or beyond what is there."""
    if known is None:
        return list(range(size))
    missing = np.isnan(known).reshape(-1, known.shape[-1])
    return [i for i in range(size) if i >= missing.shape[1] or missing[:, i].any()]


def completed(known: Array | None, size: int, take: Callable[[list[int]], Array]) -> Array:
    """The Jacobian by so many coordinates, (..., size).

    Args:
        known: by the first k of them, (..., k), NaN by those that are not known; None for none of them.
        size: how many there are.
        take: gives that by some of them, (..., n).
    """
    columns = to_take(known, size)
    if known is None or not columns:
        return take(columns) if known is None else known
    taken = take(columns)
    whole = np.concatenate([known, np.empty((*known.shape[:-1], size - known.shape[-1]))], axis=-1)
    whole[..., columns] = taken
    return whole
