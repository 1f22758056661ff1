"""The motion that tells an effect from one it is confounded with: commands to record next.

Motions within the range of what was recorded are simulated with the repaired model, as if they had been recorded, and
cut into windows as the recordings were. What the effect then changes beyond all that its partner and the plain
parameters, under their priors, could change linearly is what such a recording tells the two apart by: half its square
is the expected log likelihood ratio in nats if the effect is there, the criterion of T-optimal designs (Atkinson and
Fedorov 1975, "The design of experiments for discriminating between two rival models").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from simopt_envs.adaptation.fitting import Noise
from simopt_envs.gap.confusion import Partner, Separation
from simopt_envs.gap.excitations import excitations
from simopt_envs.gap.explanation import Explanation, stage_of
from simopt_envs.gap.fit import Fit, Misfit
from simopt_envs.gap.hypothesis import Candidate, Hypothesis
from simopt_envs.gap.result import Named
from simopt_envs.gap.trial import Base, Data
from simopt_envs.measured.recording import Recording
from simopt_envs.measured.windows import Windows, cut_windows
from simopt_envs.physics.effects.actuator_delay import LONGEST
from simopt_envs.physics.parameters import Array

_OUTSIDE, _FASTER = 0.5, 2.0  # of a column's recorded range, and times its fastest change, that a motion may go to
_NOISE_ALONE = 6.0  # standard deviations of a sensor's noise that a column may move by without any motion
_SEED = 0  # of the sensors' noise in what is simulated


def separate(named: Sequence[Named], explanation: Explanation, keyframe: str | None = None) -> tuple[Named, ...]:
    """The effects named, each partner with the motion that tells the two apart best.

    Partners stay without one where nothing can be commanded: the model has no actuators, their commands never moved,
    or every motion would go far from what the recordings show.

    Args:
        named: the effects of the explanation.
        explanation: of the data.
        keyframe: where joints without a column start.
    """
    final, data = explanation.final, explanation.data
    motions = simulated_motions(final, data) if any(effect.partners for effect in named) else ()
    if not motions:
        return tuple(named)
    length, history = min(data.seconds, *(motion.duration for motion in motions)), 2 * LONGEST
    windows = cut_windows(final.hypothesis.plain.model, motions, length, keyframe=keyframe, history=history)
    here, there = _Experiment(data.fitted, final.noise, final.hypothesis, final.fit), _Experiment.of(final, windows)

    def separation(effect: Candidate, partner: Candidate) -> Separation:
        size = _fitted_size(explanation, effect, partner)
        recorded, rivals = (experiment.rivals(effect, partner, size) for experiment in (here, there))
        told = [rivals.told_apart(there.windows_of(motion)) for motion in motions]
        best = int(np.argmax([nats for _, nats in told]))
        _, nats_recorded = recorded.told_apart(np.arange(len(data.fitted)))
        commands = motions[best].only(motions[best].commands)
        return Separation(commands, *told[best], nats_recorded)

    def with_motions(effect: Candidate, partners: tuple[Partner, ...]) -> tuple[Partner, ...]:
        return tuple(replace(p, separation=separation(effect, p.candidate)) for p in partners)

    return tuple(replace(effect, partners=with_motions(effect.candidate, effect.partners)) for effect in named)


def simulated_motions(final: Base, data: Data) -> tuple[Recording, ...]:
    """What the sensors would show of each motion that stays near what was recorded, from the first recorded start.

    Where that is at rest, so is the motion's. A motion may leave the range that a column had by half of it, and move it
    twice as fast.
    """
    recordings = [*data.fitted_recordings, *data.held_out_recordings]
    period = data.fitted.offsets[1]
    tried = list(excitations(final.hypothesis.plain.model, recordings, period))
    if not tried:
        return ()
    first = np.zeros(len(tried), dtype=np.intp)
    stride, samples = data.fitted.stride, len(tried[0])
    commands = np.array([[motion[name] for name in motion.commands] for motion in tried]).transpose(0, 2, 1)
    windows = replace(
        data.fitted,
        offsets=np.float64(period) * np.arange(samples),
        start_time=np.zeros(len(tried)),
        recording=tuple(motion.name for motion in tried),
        measured=np.zeros((len(tried), samples, len(data.fitted.channels))),
        commands=np.repeat(commands[:, :-1], stride, axis=1),
        past_commands=data.fitted.past_commands[first],
        starts=data.fitted.starts.select(first),
    )
    beginning = data.fitted.recording[0], data.fitted.start_time[0]
    at_rest = any(r.at_rest and (r.name, r.time[0]) == beginning for r in recordings)
    true = final.hypothesis.simulator(windows)(final.hypothesis.xi(final.fit.u[None]))[0]
    shown = true + final.sensor_noise * np.random.default_rng(_SEED).standard_normal(true.shape)
    return tuple(
        replace(motion, columns={**motion.columns, **dict(zip(windows.names, values.T, strict=True))}, at_rest=at_rest)
        for motion, values, near in zip(tried, shown, _is_near(true, data, final.sensor_noise), strict=True)
        if near
    )


def _is_near(simulated: Array, data: Data, noise: Array) -> NDArray[np.bool_]:
    """Whether motions (n, S, c) stay near what was recorded, (n,); one that diverged does not."""
    measured = [windows.measured for windows in (data.fitted, data.held_out)]
    low = np.min([np.nanmin(m, axis=(0, 1)) for m in measured], axis=0)
    high = np.max([np.nanmax(m, axis=(0, 1)) for m in measured], axis=0)
    fastest = np.max([np.nanmax(np.abs(np.diff(m, axis=1)), axis=(0, 1)) for m in measured], axis=0)
    margin = _OUTSIDE * (high - low) + _NOISE_ALONE * noise
    inside = np.all((simulated >= low - margin) & (simulated <= high + margin), axis=(1, 2))
    slow = np.all(np.abs(np.diff(simulated, axis=1)) <= _FASTER * fastest + _NOISE_ALONE * noise, axis=(1, 2))
    return np.asarray(inside & slow)


def _fitted_size(explanation: Explanation, effect: Candidate, partner: Candidate) -> Array:
    """The partner's parameters where it explains the data best in the effect's place, as far as it was fitted, (k,)."""
    stage = stage_of(explanation.stages, effect)
    trial = next((score.trial for score in stage.scores if score.candidate == partner), None)
    if trial is not None:  # whose effects may be in another order than the screen's
        return trial.fit.u[trial.hypothesis.columns[partner]]
    screened = next(s for s in stage.screened if s.candidate == partner)
    misfit = Misfit(screened.hypothesis, explanation.data.fitted).with_noise(stage.base.noise)
    return misfit.best(np.concatenate(screened.starts))[screened.hypothesis.columns[partner]]


@dataclass(frozen=True)
class _Experiment:
    """Windows, and the final hypothesis on them.

    Attributes:
        windows: as recorded or as simulated.
        noise: to count errors in.
        hypothesis: the final one.
        fit: its ξ, and errors and derivatives here.
    """

    windows: Windows
    noise: Noise
    hypothesis: Hypothesis
    fit: Fit

    @classmethod
    def of(cls, final: Base, windows: Windows) -> _Experiment:
        """Of the final hypothesis at its fitted ξ."""
        u, misfit = final.fit.u, Misfit(final.hypothesis, windows)
        misfit = misfit.with_noise(misfit.noise_at(u, final.sensor_noise * final.tolerance))
        errors = misfit.errors(u[None])[0]
        fit = Fit(u, errors, misfit.jacobian(u), final.fit.prior_std, misfit.noise.log_det)
        return cls(windows, misfit.noise, final.hypothesis, fit)

    def windows_of(self, recording: Recording) -> NDArray[np.intp]:
        """Which of the windows are cut from a recording."""
        return np.flatnonzero(np.array(self.windows.recording) == recording.name)

    def rivals(self, effect: Candidate, partner: Candidate, size: Array) -> _Rivals:
        """An effect and its partner, which is linearised about a size (k,) of its parameters in the effect's place."""
        final = self.hypothesis
        of_effect, of_partner = final.columns[effect], final.columns.get(partner, [])
        u = np.tile(self.fit.u, (2, 1))
        u[:, of_partner] = final.neutral()[of_partner]
        u[0, of_effect] = final.neutral()[of_effect]
        without, with_effect = Misfit(final, self.windows).with_noise(self.noise).errors(u)
        rest = [c for c in final.candidates if c not in (effect, partner)]
        rival = Hypothesis(final.plain, [*rest, partner], final.motion)
        others = [i for i in range(len(self.fit.u)) if i not in {*of_effect, *of_partner}]
        at = np.append(self.fit.u[others], size)
        misfit = Misfit(rival, self.windows).with_noise(self.noise)
        with_partner = misfit.errors(at[None])[0]
        jacobian = misfit.jacobian(at, rival.columns[partner])
        changes = [(errors - without).reshape(-1, 1) for errors in (with_effect, with_partner)]
        columns = np.hstack([self.fit.jacobian[:, others], jacobian, *changes])
        columns = columns.reshape(len(self.windows), -1, columns.shape[1])
        prior_std = np.append(self.fit.prior_std[others], rival.prior_std[rival.columns[partner]])
        return _Rivals(columns.transpose(0, 2, 1) @ columns, prior_std, len(others))


@dataclass(frozen=True)
class _Rivals:
    """What an effect and its partner change in w windows, whitened.

    Attributes:
        products: inner products in each window, (w, d + 2, d + 2), of the derivatives by d parameters and of what the
            effect and the partner change at their fitted sizes.
        prior_std: of the parameters, (d,): all but the effect's, those of the partner last.
        others: how many are not the partner's.
    """

    products: Array
    prior_std: Array
    others: int

    def told_apart(self, windows: NDArray[np.intp]) -> tuple[float, float]:
        """Correlation of what the two change in some windows, other parameters projected out, and nats between them.

        The partner explains as much of the effect as it can, from its fitted size or from none, whichever is nearer.
        """
        own = self._beyond(windows, self.others)[0, 0]
        left = self._beyond(windows, len(self.prior_std))
        difference = np.array([1.0, -1.0])
        least = min(float(left[0, 0]), float(difference @ left @ difference))
        share = left[0, 0] / own if own > 0 else 1.0
        return float(np.sqrt(max(1 - share, 0.0))), 0.5 * max(least, 0.0)

    def _beyond(self, windows: NDArray[np.intp], count: int) -> Array:
        """Inner products of what is left of both changes, (2, 2), by the u that makes each least.

        That is |change + J u|² + |u / prior std|², J by the first parameters.
        """
        products = self.products[windows].sum(axis=0)
        hessian = products[:count, :count] + np.diag(self.prior_std[:count] ** -2)
        slopes = products[:count, -2:]
        return np.asarray(products[-2:, -2:] - slopes.T @ np.linalg.solve(hessian, slopes))
