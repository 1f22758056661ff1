"""Whether what is left is of the model's timestep, and of no effect.

Where things touch or joints run into their stops, a simulation depends on how long its steps are, and a system that is
none, or another one, moves otherwise. Effects would stand in for that.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import lsq_linear

from simopt_envs.gap.fit import Misfit
from simopt_envs.gap.hypothesis import Hypothesis
from simopt_envs.gap.plain import INTEGRATION_LEAD, Plain
from simopt_envs.gap.thresholds import EVIDENCE, LARGE, OF_TIMESTEP
from simopt_envs.gap.trial import Base, Data, noise_alone
from simopt_envs.measured.recording import Finding

TIMESTEP = "timestep"
"""The check of a warning that the model's timestep is too long."""


def halved(plain: Plain) -> Plain:
    """The plain parameters of the model with half its timestep; what delays keep is as many seconds as before."""
    spec = plain.spec.copy()
    spec.option.timestep /= 2
    for delayed in (*spec.actuators, *spec.sensors):
        delayed.nsample *= 2
    return Plain.of(spec, plain.prior.marginal([name for name in plain.prior.space.names if name != INTEGRATION_LEAD]))


def finer(data: Data) -> Data:
    """The same windows for a model with half the timestep."""
    return replace(data, fitted=data.fitted.at_half_the_timestep(), held_out=data.held_out.at_half_the_timestep())


def promises(null: Base, hypothesis: Hypothesis, data: Data) -> bool:
    """Whether a finer hypothesis predicts what was held out clearly better, to first order from where a fit ended.

    Args:
        null: the refitted model, or one with an effect.
        hypothesis: the same with half the timestep.
        data: windows for it.
    """
    if not noise_alone(null) < null.excess < LARGE:
        return False
    u = null.fit.u[None]
    fitted = Misfit(hypothesis, data.fitted).with_noise(null.noise).errors(u)[0]
    held_out = Misfit(hypothesis, data.held_out).with_noise(null.held_out_noise).errors(u)[0]
    residual = replace(null.fit, errors=fitted).residual
    step = lsq_linear(null.fit.rows, -residual, null.within, method="bvls").x
    predicted = held_out + null.held_out.jacobian / null.tolerance[:, None] @ step
    return bool(0.5 * np.sum((null.held_out.errors / null.tolerance) ** 2 - predicted**2) > EVIDENCE)


def takes_most(null: Base, half: Base) -> bool:
    """Whether half the timestep takes most of what the refitted model leaves above noise, and that clearly."""
    gain = 0.5 * null.held_out.errors.size * (null.excess - half.excess)
    return gain > EVIDENCE and half.excess < (1 - OF_TIMESTEP) * null.excess


def takes_all(half: Base) -> bool:
    """Whether no more than noise is left with half the timestep."""
    return half.excess < noise_alone(half)


def with_warning(data: Data, timestep: float, null: Base, half: Base) -> Data:
    """Data with a warning that half the timestep [s] takes most, or all, of what the model leaves."""
    told = f"with half the model's timestep, {timestep:g} s, {1 + half.excess:.3g} times the noise is left"
    told += f", not {1 + null.excess:.3g}"
    told += (
        "; it is so here, and in the repaired model" if takes_all(half) else ": a shorter one may be what is missing"
    )
    return replace(data, warnings=(*data.warnings, Finding.warning("", TIMESTEP, told)))
