"""Drawing ξ further out than p(ξ) reaches, where its updates have come to a standstill.

Contacts make costs flat or misleading near p(ξ): while every simulated peg drops into the hole that the real one
misses, its rope's length changes little, and updates go to the bottom of a valley in which nothing explains what was
measured. So half of the draws go three times as far as p(ξ) did when its updates began. Where the best of them is
better than the best of p(ξ)'s own, p(ξ) goes on from there instead: as that wider Gaussian is updated by them, with
its own width.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from simopt_envs.adaptation.updates import Update, UpdateResult
from simopt_envs.distributions.gaussian import Gaussian
from simopt_envs.physics.parameters import Array

_PATIENCE, _GAIN = 3, 0.1
_FARTHER = 3.0


def is_stuck(costs: Sequence[Array], explained: float) -> bool:
    """Whether half of the next update's draws should go further out.

    They should once three updates on end have not brought the lowest cost down by a tenth, until a ξ that p(ξ) drew
    itself explains the measurements; or until three such updates have not brought it down either, then it is the turn
    of three others.

    Args:
        costs: of the ξ that each update so far drew.
        explained: costs up to here count as explained.
    """
    stuck, waited, lowest = False, 0, np.inf
    for drawn in costs:
        if (own_and_far(drawn)[0] if stuck else drawn).min() <= explained:
            stuck, waited, lowest = False, 0, np.inf
        elif drawn.min() < (1 - _GAIN) * lowest:
            waited, lowest = 0, drawn.min()
        elif (waited := waited + 1) == _PATIENCE:
            stuck, waited = not stuck, 0
    return stuck


def sample_further_out(p: Gaussian, start: Gaussian, n: int, rng: np.random.Generator) -> Array:
    """Draws (n, d), physical: of p(ξ), and then as many three times as far out as those of ``start``, within bounds."""
    own, space = p.sample(n - n // 2, rng), p.space
    offset = space.to_unconstrained(start.sample(n // 2, rng)) - start.mean
    far = space.from_unconstrained(start.mean + _FARTHER * offset)
    return np.concatenate([own, np.clip(far, space.low, space.high)])


def own_and_far(drawn: Array) -> tuple[Array, Array]:
    """What :func:`sample_further_out` drew, or its costs: of p(ξ) itself, and further out."""
    own = len(drawn) - len(drawn) // 2
    return drawn[:own], drawn[own:]


def is_better_further_out(costs: Array) -> bool:
    """Whether the best ξ further out is better than the best that p(ξ) drew itself, by a tenth."""
    own, far = own_and_far(costs)
    return bool(far.min() < (1 - _GAIN) * own.min())


def update_further_out(
    rule: Update,
    p: Gaussian,
    start: Gaussian,
    xi: Array,
    costs: Array,
    rng: np.random.Generator,
    std_floor: ArrayLike,
) -> UpdateResult:
    """What a rule makes of such draws: those further out if they are better, and of ``start``; else p(ξ)'s own.

    Its KL bound is that of the Gaussian that the draws came from.
    """
    (own, far), (own_costs, far_costs) = own_and_far(xi), own_and_far(costs)
    if not is_better_further_out(costs):
        return rule(p, own, own_costs, rng, std_floor)
    step = rule(_scaled(start, _FARTHER), far, far_costs, rng, std_floor=_FARTHER * np.asarray(std_floor))
    return replace(step, distribution=_scaled(step.distribution, 1 / _FARTHER))


def _scaled(p: Gaussian, factor: float) -> Gaussian:
    return Gaussian(p.space, p.mean, factor**2 * p.covariance)
