"""Drawing ξ further out than p(ξ) reaches, where its updates have come to a standstill.

Contacts make costs flat or misleading near p(ξ): while every simulated peg meets the wall of the box, nothing tells
that with a longer rope it would not. Draws from p(ξ) then lead to the bottom of a valley in which nothing explains
what was measured. So every second draw goes three times as far, and the update sees a Gaussian as wide as all of
them; the new p(ξ) has the new mean, and has changed its width as that Gaussian has.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from simopt_envs.adaptation.updates import Update, UpdateResult
from simopt_envs.distributions.gaussian import Gaussian
from simopt_envs.physics.parameters import Array

_PATIENCE, _LEAST_GAIN = 3, 0.1
_FARTHER, _FAR = 3.0, slice(0, None, 2)
OWN = slice(1, None, 2)
"""Which of the draws that :func:`further_out` made are p(ξ)'s own."""
_WIDTH = np.sqrt((1 + _FARTHER**2) / 2)


def is_stuck(costs: Sequence[Array], explained: float) -> bool:
    """Whether the next update should look further out.

    It should once three updates on end have not brought the lowest cost down by a tenth, until a ξ that p(ξ) drew
    itself explains the measurements; or until three that looked further out have not brought it down either, then it
    is the turn of three others.

    Args:
        costs: of the ξ that each update so far drew.
        explained: costs up to here count as explained.
    """
    stuck, waited, lowest = False, 0, np.inf
    for drawn in costs:
        if (drawn[OWN] if stuck else drawn).min() <= explained:
            stuck, waited, lowest = False, 0, np.inf
        elif drawn.min() < (1 - _LEAST_GAIN) * lowest:
            waited, lowest = 0, drawn.min()
        elif (waited := waited + 1) == _PATIENCE:
            stuck, waited = not stuck, 0
    return stuck


def further_out(p: Gaussian, xi: Array) -> Array:
    """Draws (n, d) of p(ξ), every second of them three times as far from its median, within the bounds."""
    further = xi.copy()
    offset = p.space.to_unconstrained(xi[_FAR]) - p.mean
    further[_FAR] = np.clip(p.space.from_unconstrained(p.mean + _FARTHER * offset), p.space.low, p.space.high)
    return further


def update_further_out(
    rule: Update, p: Gaussian, xi: Array, costs: Array, rng: np.random.Generator, std_floor: ArrayLike
) -> UpdateResult:
    """What a rule makes of draws that :func:`further_out` made: of all, or of p(ξ)'s own if the best is among them.

    Where all count, its KL bound is that of the wider Gaussian.
    """
    if costs[OWN].min() <= costs[_FAR].min():
        return rule(p, xi[OWN], costs[OWN], rng, std_floor)
    step = rule(_scaled(p, _WIDTH), xi, costs, rng, std_floor=_WIDTH * np.asarray(std_floor))
    return replace(step, distribution=_scaled(step.distribution, 1 / _WIDTH))


def _scaled(p: Gaussian, factor: float) -> Gaussian:
    return Gaussian(p.space, p.mean, factor**2 * p.covariance)
