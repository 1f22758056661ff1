"""What recordings that no fit saw say of a model: its errors there, as far as uncertain parameters do not excuse them.

They may go where the fitted ones told little of a parameter. A right model then errs there by more than noise: its
errors r have the covariance I + J P Jᵀ, J their derivative by u and P the posterior covariance of u. All of it is to
first order, and holds no farther than u may go.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from simopt_envs.gap.fit import Fit, Misfit
from simopt_envs.gap.known import completed
from simopt_envs.physics.parameters import Array


@dataclass(frozen=True)
class HeldOut:
    """A fit's errors on held-out windows.

    Attributes:
        errors: whitened, in units of the sensors' noise, (w, S, c).
        jacobian: their derivative by u, (w, S, c, d).
        log_det: of the covariance that they are whitened by, (w,).
    """

    errors: Array
    jacobian: Array
    log_det: Array

    @classmethod
    def of(cls, misfit: Misfit, u: Array, tolerance: Array, known: Array | None = None) -> HeldOut:
        """Those of u (d,).

        Args:
            misfit: on the windows, in ``tolerance`` times the sensors' noise.
            u: coordinates, (d,).
            tolerance: (c,).
            known: the Jacobian by the first k of u, (w, S, c, k), where it is known well enough; NaN by what is to be
                taken, see :func:`~simopt_envs.gap.known.of_silent`. None to take all.
        """
        errors = tolerance * misfit.errors(u[None])[0]

        def taken(columns: list[int]) -> Array:
            return tolerance[:, None] * misfit.jacobian(u, columns).reshape(*errors.shape, -1)

        return cls(errors, completed(known, len(u), taken), misfit.noise.log_det)

    def select(self, rows: NDArray[np.intp]) -> HeldOut:
        """Those of some windows, laid out alike whatever they come from: sums depend on that in their last digits."""
        return HeldOut(*(np.ascontiguousarray(of_all[rows]) for of_all in (self.errors, self.jacobian, self.log_det)))

    def surprise(self, known: Array, worth: Array, within: tuple[Array, Array]) -> float:
        """-log p of the held-out data given the fitted ones, up to a constant that all models share; see above.

        The determinant is what foresight costs: a parameter that the fitted data left open makes all held-out data
        less likely, whatever it could take from their errors.

        Args:
            known: P⁻¹, (d, d).
            worth: what a squared error of 1 is worth in each channel, (c,).
            within: how far u may go down and up, (d,) each.
        """
        excused, more = self._excused(known, worth, within)
        squares = float(worth @ np.sum(self.errors**2, axis=(0, 1)))
        spread = np.linalg.slogdet(more).logabsdet - np.linalg.slogdet(known).logabsdet
        return 0.5 * (squares - excused + float(spread) + float(np.sum(self.log_det)))

    def excused(self, known: Array, within: tuple[Array, Array]) -> float:
        """What the uncertainty of u takes from the sum of the squared errors."""
        return self._excused(known, np.ones(self.errors.shape[-1]), within)[0]

    def _excused(self, known: Array, worth: Array, within: tuple[Array, Array]) -> tuple[float, Array]:
        """rᵀr less the least of |r + J v|² + vᵀP⁻¹v over steps v of u that stay within bounds, and P⁻¹ + JᵀJ.

        Were there no bounds, that is rᵀr - rᵀ(I + J P Jᵀ)⁻¹r.
        """
        pull = np.einsum("c,wsci,wsc->i", worth, self.jacobian, self.errors)
        more = known + information(self.jacobian, worth)
        root = np.linalg.cholesky(more)
        aim = -np.linalg.solve(root, pull)
        left = root.T @ lsq_linear(root.T, aim, within, method="bvls").x - aim
        return float(aim @ aim - left @ left), more


def information(jacobian: Array, weight: Array) -> Array:
    """JᵀJ, (d, d), of (w, S, c, d), each channel's squares by a weight, (c,); summed without BLAS, as in fits."""
    rows = np.ascontiguousarray((np.sqrt(weight)[:, None] * jacobian).reshape(-1, jacobian.shape[-1]).T)
    return np.einsum("im,jm->ij", rows, rows)


def precision(fit: Fit, room: Array, weight: Array) -> Array:
    """P⁻¹, (d, d), by the windows fitted.

    Args:
        fit: of them.
        room: between the bounds of u, (d,): an effect's parameter has a prior of no width to speak of, but no linear
            account may have it leave them.
        weight: of a squared error in each channel, (c,).
    """
    jacobian = fit.jacobian.reshape(*fit.errors.shape, -1)
    prior = np.minimum(fit.prior_std, room / np.sqrt(12))  # that of values all as likely
    return information(jacobian, weight) + np.diag(prior**-2.0)
