"""Which candidate earns its place: evidence in what was fitted and in what was held out, and a taste for the simple."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simopt_envs.gap.fit import Fit, Misfit
from simopt_envs.gap.hypothesis import Candidate
from simopt_envs.gap.plain import SPEAKS_FOR
from simopt_envs.gap.thresholds import (
    COARSE,
    EVIDENCE,
    EVIDENCE_EACH,
    EXPLAINED,
    FAR,
    FURTHER,
    LEFT_SHARE,
    SIMPLER,
    SIMPLER_LEAVES,
    SIMPLER_SHARE,
)
from simopt_envs.gap.trial import Base, Trial, noise_alone
from simopt_envs.measured.windows import Windows
from simopt_envs.physics.parameters import Array

_ROUNDS, _ALIKE = 10, 0.05  # of which a tolerance is told at most, and how much it may still change


@dataclass(frozen=True)
class Score:
    """What a candidate earns over the base, in nats.

    Attributes:
        candidate: the effect and its place.
        trial: its fit.
        fitted: gain on the fitted windows and the prior, less the price of its parameters (BIC).
        held_out: gain on the windows held out, as far as those fitted foretell them, and the prior.
        of_prior: the part of both that plain parameters give back, as they need not stand in for the effect any more.
    """

    candidate: Candidate
    trial: Trial
    fitted: float
    held_out: float
    of_prior: float

    @property
    def total(self) -> float:
        """By which candidates are ranked."""
        return self.fitted + self.held_out

    @property
    def was_stood_in_for(self) -> bool:
        """Whether plain parameters were farther off without it than they ever are."""
        return self.of_prior > 0.5 * FAR**2

    @property
    def earned(self) -> bool:
        """Whether it may be called missing: it is needed, and has become what its name means."""
        return self.needed and self.trial.hypothesis.is_itself(self.candidate, self.trial.fit.u)

    @property
    def needed(self) -> bool:
        """Whether it shows in what was fitted, and in recordings that no fit saw.

        The latter may tell alone, as where what was fitted hardly went where the effect acts: there is no price to pay
        for parameters that they had no part in. Where they hardly went there, they need only not speak against it.
        Less is asked of an effect that plain parameters can stand in for: all it can show is how far they had to go.
        """
        all_it_can = self.candidate.effect.name in SPEAKS_FOR.values() and self.was_stood_in_for
        least, in_all = (0.0, 0.0) if all_it_can else (EVIDENCE_EACH, EVIDENCE)
        least_held_out = 0.0 if self.fitted > EVIDENCE else least
        on_both = self.fitted > least and self.held_out > least_held_out
        return (on_both or self.held_out > EVIDENCE) and self.total > in_all


def chosen(null: Base, base: Base, scores: Sequence[Score]) -> Score | None:
    """The candidate to add: the simplest of those that the best does not beat clearly.

    A law of slightly another form than the true one leaves an error that nothing in the library describes, but much of
    it bends a little. So a further effect must make the model right, to what noise is, or explain a share of what the
    ones before it did, or most of what they left, if that is more than noise may leave. Where even the best leaves more
    than noise, a simpler one that takes, and leaves, nearly as much is as good. Where the best makes the model right,
    one that does not is not that law in another form; and its form takes no more nats from a law than what it leaves.
    """
    earned, right = [score for score in scores if score.earned], EXPLAINED - 1
    if base is not null:
        least = FURTHER * (null.excess - base.excess)
        if base.excess > noise_alone(base):
            least = min(least, LEFT_SHARE * base.excess)
        earned = [
            s
            for s in earned
            if base.excess > right > s.trial.excess or base.excess - s.trial.excess > least or s.was_stood_in_for
        ]
    if not earned:
        return None
    best = earned[0]
    most = base.excess - SIMPLER_SHARE * (base.excess - best.trial.excess)
    enough = min(most, SIMPLER_LEAVES * best.trial.excess)

    left = 0.5 * best.trial.held_out.errors.size * best.trial.excess

    def clearly(score: Score) -> float:
        alone_right = best.trial.excess < right < score.trial.excess
        return SIMPLER if alone_right else max(SIMPLER, min(FURTHER * best.held_out, left))

    as_good = [
        s for s in earned if best.total - s.total < clearly(s) or enough > s.trial.excess > best.trial.excess > right
    ]
    return min(as_good, key=lambda score: (len(score.trial.fit.u), -score.total))


def is_all(null: Base, base: Base) -> bool:
    """Whether no further effect can be chosen, so that none need be tried.

    What is left may be noise alone, and taking as much as one must would leave less than noise does. No plain parameter
    speaks for one, nor do all of them together.
    """
    plain, noise = base.hypothesis.off(base.fit.u)[: base.hypothesis.num_plain], noise_alone(base)
    quiet = base.excess < noise and not base.strained and bool(np.all(np.abs(plain) < FAR))
    return quiet and base.excess - FURTHER * (null.excess - base.excess) < -noise


def worth_of(errors: Array) -> Array:
    """What a squared error of 1 is worth in each channel, (c,), by what the best model leaves, (w, S, c): 1 if noise.

    Where it leaves more, the errors are larger than the noise and go together within a window: that many fewer count.
    """
    mean_square = np.mean(errors**2, axis=(0, 1))
    of_means = np.mean(errors.mean(axis=1) ** 2, axis=0)
    alike = np.clip(errors.shape[1] * of_means / np.maximum(mean_square, 1e-12), 1.0, errors.shape[1])
    return 1 / np.maximum(mean_square * np.where(mean_square > EXPLAINED, alike, 1.0), 1.0)


def tolerance_of(best: Trial, held_out: Windows, sensor_noise: Array) -> Array:
    """What errors are to be counted in, in units of the sensors' noise, (c,).

    That is 1 or, where even the best model leaves far more in some channel, what it leaves, by what that is worth. The
    larger that is, the less of it can be of uncertain starts, so that it is told until it stays the same.

    Args:
        best: the model.
        held_out: the windows that it is judged by.
        sensor_noise: standard deviation of each channel's, (c,).
    """
    tolerance = np.ones(len(sensor_noise))
    if np.all(np.sqrt(np.mean(best.held_out.errors**2, axis=(0, 1))) <= COARSE):
        return tolerance
    misfit, u = Misfit(best.hypothesis, held_out), best.fit.u
    for _ in range(_ROUNDS):
        noise = misfit.noise_at(u, tolerance * sensor_noise)
        before, tolerance = tolerance, 1 / np.sqrt(worth_of(tolerance * misfit.with_noise(noise).errors(u[None])[0]))
        if np.allclose(tolerance, before, rtol=_ALIKE):
            break
    return tolerance


def score_of(base: Base, candidate: Candidate, trial: Trial, worth: Array) -> Score:
    """Gains in nats, each squared error counted by what it is worth."""

    def gain(before: Array, after: Array) -> float:
        return 0.5 * float(np.sum(worth * (np.sum(before**2, axis=(0, 1)) - np.sum(after**2, axis=(0, 1)))))

    def prior(fit: Fit) -> float:
        return 0.5 * float(np.sum((fit.u / fit.prior_std) ** 2))

    added = len(trial.fit.u) - len(base.fit.u)
    price = 0.5 * added * np.log(base.fit.errors.size)
    of_prior = prior(base.fit) - prior(trial.fit)
    of_starts = 0.5 * float(np.sum(base.fit.log_det) - np.sum(trial.fit.log_det))
    fitted = gain(base.tolerance * base.fit.errors, base.tolerance * trial.fit.errors) + of_starts + of_prior - price
    weight = worth * base.tolerance**2
    before, after = (t.held_out.surprise(t.precision(weight), worth, t.within) for t in (base, trial))
    held_out = before - after + of_prior
    return Score(candidate, trial, float(fitted), float(held_out), of_prior)
