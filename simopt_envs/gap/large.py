"""Effects so large that a linear screen tells neither which they are nor how large: they are tried at several sizes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from simopt_envs.adaptation.fitting import Noise
from simopt_envs.gap.fit import Misfit
from simopt_envs.gap.hypothesis import Candidate, Hypothesis
from simopt_envs.gap.thresholds import LARGE_REFITTED
from simopt_envs.measured.windows import Windows
from simopt_envs.physics.parameters import Array

SECONDS = 2.0
"""Of the windows of which a base leaves the most, that sizes are tried on."""

_SIZES = np.outer([-1.0, 1.0], [1.0, 10.0, 100.0]).ravel()  # probes
_BETWEEN = np.array([1 / 3, 1.0, 3.0])  # of the best so far, of each of the shapes that come nearest
_SHAPES = 3  # that a fit starts from, as starts alone tell little
_FINER = np.geomspace([0.4, 0.9], [2.5, 1.1], 9).T  # of the best so far: where things touch, a fit from afar gets stuck


def nearest_size(
    tried: tuple[Hypothesis, Array | None], windows: Windows, noise: Noise, base: Array, num_threads: int
) -> tuple[float, Array]:
    """How far a hypothesis is from some windows at the size of its last candidate that comes nearest.

    That is -log p, and the coordinates; those of the base (k,) stay. Sizes are tried all over, or around a rough one,
    (d,), that comes with the hypothesis.
    """
    hypothesis, rough = tried
    candidate = hypothesis.candidates[-1]
    misfit = Misfit(hypothesis, windows, num_threads).with_noise(noise)
    start = np.concatenate([base, hypothesis.neutral()[len(base) :]])
    if rough is None:
        found = of_rough_size(misfit, candidate, start)
    else:
        found = of_fine_size(misfit, candidate, start, rough)
    return float(misfit.losses(found[None])[0]), found


def of_some_size(misfit: Misfit, candidate: Candidate, start: Array) -> Array:
    """Starts (k, d) with the candidate at the size that is nearest to the data, one of each of the nearest shapes."""
    shapes = _of_each_shape(misfit, candidate, start)
    return np.array([of_fine_size(misfit, candidate, start, rough) for rough in shapes])


def of_rough_size(misfit: Misfit, candidate: Candidate, start: Array) -> Array:
    """The nearest one (d,), of sizes that are far apart."""
    return _of_each_shape(misfit, candidate, start)[0]


def _of_each_shape(misfit: Misfit, candidate: Candidate, start: Array) -> Array:
    """The same of each probe, of those that come nearest, (k, d), nearest first."""
    hypothesis = misfit.hypothesis
    probes = hypothesis.probes(candidate)
    others = np.setdiff1d(np.arange(len(start)), hypothesis.columns[candidate])
    probes[:, others] = start[others]
    for sizes in (_SIZES, _BETWEEN):
        tried = np.array([_scaled(hypothesis, candidate, start, probe, sizes) for probe in probes])
        probes = best_of_each(misfit, tried)
    return probes


def best_of_each(misfit: Misfit, starts: Array) -> Array:
    """The best starts of the sets that have the best ones, (k, d), best first, of several sets, (n, m, d)."""
    losses = misfit.losses(np.concatenate(starts)).reshape(starts.shape[:2])
    best = starts[np.arange(len(starts)), np.argmin(losses, axis=1)]
    return best[np.argsort(losses.min(axis=1), kind="stable")[:_SHAPES]]


def of_fine_size(misfit: Misfit, candidate: Candidate, start: Array, rough: Array) -> Array:
    """The same, of sizes near a rough one (d,)."""
    for sizes in _FINER:
        rough = misfit.best(_scaled(misfit.hypothesis, candidate, start, rough, sizes))
    return rough


def of_several_effects(ordered: Sequence[Candidate]) -> list[Candidate]:
    """The first of some candidates, and the first of further effects: one that acts alike at all places may take all.

    Args:
        ordered: nearest to the data first.
    """
    firsts: dict[str, Candidate] = {}
    for candidate in ordered:
        firsts.setdefault(candidate.effect.name, candidate)
    kept = {*ordered[:LARGE_REFITTED], *list(firsts.values())[:LARGE_REFITTED]}
    return [candidate for candidate in ordered if candidate in kept]


def _scaled(hypothesis: Hypothesis, candidate: Candidate, start: Array, tried: Array, sizes: Array) -> Array:
    """Some coordinates (d,) with so many times their amount of the effect, (sizes, d)."""
    amounts = hypothesis.amounts(candidate)
    out = np.tile(tried, (len(sizes), 1))
    out[:, amounts] = start[amounts] + sizes[:, None] * (tried[amounts] - start[amounts])
    return np.clip(out, hypothesis.low, hypothesis.high)
