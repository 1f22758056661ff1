"""Effects so large that a linear screen tells neither which they are nor how large: they are tried at several sizes."""

from __future__ import annotations

import numpy as np

from simopt_envs.gap.fit import Misfit
from simopt_envs.gap.hypothesis import Candidate
from simopt_envs.physics.parameters import Array

_SIZES = np.outer([-1.0, 1.0], [1.0, 3.0, 10.0, 30.0, 100.0, 300.0]).ravel()  # probes
_FINER = np.geomspace([0.4, 0.9], [2.5, 1.1], 9).T  # of the best so far: where things touch, a fit from afar gets stuck


def of_some_size(misfit: Misfit, candidate: Candidate, start: Array) -> Array:
    """A start (d,) with the candidate at the size, and of the shape, that comes nearest to the data."""
    hypothesis, amounts = misfit.hypothesis, misfit.hypothesis.amounts(candidate)

    def scaled(tried: Array, sizes: Array) -> Array:
        """Each of some coordinates (k, d) with so many times its amount of the effect."""
        out = np.tile(tried, (len(sizes), 1, 1))
        out[..., amounts] = start[amounts] + sizes[:, None, None] * (tried[:, amounts] - start[amounts])
        return np.clip(out.reshape(-1, len(start)), hypothesis.low, hypothesis.high)

    probes = hypothesis.probes(candidate)
    others = np.setdiff1d(np.arange(len(start)), hypothesis.columns[candidate])
    probes[:, others] = start[others]
    best = misfit.best(scaled(probes, _SIZES))
    for sizes in _FINER:
        best = misfit.best(scaled(best[None], sizes))
    return best
