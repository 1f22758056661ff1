"""Coordinates for fits in which laws are linear, where those of a hypothesis are not."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from simopt_envs.gap.hypothesis import Hypothesis
from simopt_envs.physics.parameters import Array

_LEAST = 1e-3  # probes of an amount: less is none, and then no shape shows
_WIDEST = 1e6  # of a product


class Chart:
    """Coordinates x of a fit: as u, but of a shape x is its product with the amount, where a law is linear in that.

    A spring pulls with k (r - q). In k and r the valley of the misfit is bent, and the more so the stronger the spring;
    in k and k r it is straight, as k alone may be well known, and r is not.

    Args:
        hypothesis: with the coordinates u.
        columns: of u that may differ from x.

    Attributes:
        low, high: bounds of x, (d,).
        pull: 1 / prior standard deviation of x, (d,); 0 of a product.
    """

    def __init__(self, hypothesis: Hypothesis, columns: Collection[int]):
        self._hypothesis = hypothesis
        self._products = [(shape, amount) for shape, amount in hypothesis.products if shape in columns]
        self.low, self.high, self.pull = hypothesis.low.copy(), hypothesis.high.copy(), 1 / hypothesis.prior_std
        for shape, _ in self._products:
            self.low[shape], self.high[shape], self.pull[shape] = -_WIDEST, _WIDEST, 0.0

    def straight(self, u: Array) -> Array:
        """u (..., d) -> x."""
        x = u.copy()
        for shape, amount in self._products:
            x[..., shape] *= np.maximum(u[..., amount], _LEAST)
        return x

    def bent(self, x: Array) -> Array:
        """x (..., d) -> u, within its bounds."""
        u = x.copy()
        for shape, amount in self._products:
            u[..., shape] /= np.maximum(x[..., amount], _LEAST)
        return np.clip(u, self._hypothesis.low, self._hypothesis.high)

    def by_u(self, jacobian: Array, u: Array) -> Array:
        """A Jacobian (m, d) by x as one by u, at u (d,)."""
        out = jacobian.copy()
        for shape, amount in self._products:
            out[:, amount] += jacobian[:, shape] * u[shape]
            out[:, shape] *= max(u[amount], _LEAST)
        return out

    def reach(self, u: Array) -> Array:
        """How far a difference of 1 goes along each of x at u (d,)."""
        reach = self._hypothesis.reach(u)
        reach[[shape for shape, _ in self._products]] = 1.0
        return reach
