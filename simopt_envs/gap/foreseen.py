"""Whether what is left on held-out recordings is more than noise and the uncertainty of what was fitted.

Recordings that no fit saw may go where the fitted ones told little of a parameter. A right model then errs there by
more than noise: its errors have the covariance I + J P Jᵀ, J their derivative by u and P the posterior covariance of u.
"""

from __future__ import annotations

import numpy as np

from simopt_envs.gap.fit import Misfit
from simopt_envs.gap.thresholds import EXPLAINED
from simopt_envs.gap.trial import Base
from simopt_envs.measured.windows import Windows


def unforeseen(base: Base, held_out: Windows) -> float:
    """Mean square of the held-out errors in units of the predictive distribution, above 1, to first order.

    It is the base's excess where the model does not fit what was fitted either, or where errors are counted in more
    than the sensors' noise: that no parameter's uncertainty excuses.

    Args:
        base: fitted.
        held_out: the windows that its held-out errors are of.
    """
    if np.any(base.tolerance > 1) or np.mean(base.fit.errors**2) > EXPLAINED:
        return base.excess
    u = base.fit.u
    jacobian = Misfit(base.hypothesis, held_out).with_noise(base.held_out_noise).jacobian(u)
    slope = jacobian.T @ base.held_out.ravel()
    information = base.fit.rows.T @ base.fit.rows + jacobian.T @ jacobian
    foreseen = float(slope @ np.linalg.solve(information, slope))  # r'r - r'(I + J P J')⁻¹ r, by Woodbury's identity
    return base.excess - foreseen / base.held_out.size
