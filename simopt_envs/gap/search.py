"""Which effects are missing: a screen of the whole library, refits of the best, forward selection, elimination."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from simopt_envs.adaptation.checkpoint import Result
from simopt_envs.adaptation.fitting import Noise
from simopt_envs.engine import Engine, LocalEngine
from simopt_envs.gap.fit import Fit, Misfit, fit
from simopt_envs.gap.hypothesis import Candidate, Hypothesis
from simopt_envs.gap.kept import kept_fits, key_of
from simopt_envs.gap.plain import SPEAKS_FOR, Plain
from simopt_envs.gap.thresholds import EVIDENCE, EXPLAINED, FAR, FURTHER, MOST_EFFECTS, REFITTED, SIMPLER, SIMPLER_SHARE
from simopt_envs.measured.recording import Finding, Recording
from simopt_envs.measured.windows import Windows
from simopt_envs.physics.effects import Motion
from simopt_envs.physics.parameters import Array

Progress = Callable[[str, int, int], None]
"""Is told what is being done, and how many of how many are done."""

_ITERATIONS = 10
_STEPS = np.array([1.0, 0.3, 0.1, 0.03])  # shares of the screen's step that a fit may start from
_WORTH_A_START = 0.2  # share of the best probe's gain at which a fit may start from another one
_SIZES = np.array([-30.0, -10.0, -3.0, -1.0, 1.0, 3.0, 10.0, 30.0])  # probes, of an effect that is spoken for
_FURTHEST = 20.0  # probes that the screen's step may be long
_COARSE = 3.0  # times the sensors' noise, from which what a model leaves decides what a fit counts errors in


@dataclass(frozen=True)
class Data:
    """Windows of recordings to fit, and of recordings that no fit sees.

    Attributes:
        fitted, held_out: the windows.
        fitted_recordings, held_out_recordings: what they are cut from.
        warnings: of the recordings' audit.
    """

    fitted: Windows
    held_out: Windows
    fitted_recordings: tuple[Recording, ...]
    held_out_recordings: tuple[Recording, ...]
    warnings: tuple[Finding, ...] = ()


@dataclass(frozen=True)
class Trial:
    """A hypothesis fitted, and what it says of the recordings that were held out.

    Attributes:
        hypothesis: plain parameters and effects.
        fit: of the fitted windows.
        held_out: whitened errors there, in units of the sensors' noise, (w, S, c).
    """

    hypothesis: Hypothesis
    fit: Fit
    held_out: Array

    @property
    def excess(self) -> float:
        """Mean square of the whitened held-out errors above that of noise alone, which is 1."""
        return float(np.mean(self.held_out**2)) - 1.0


@dataclass(frozen=True)
class Base(Trial):
    """A trial that others are compared with, and the noise they are all fitted in.

    Attributes:
        noise, held_out_noise: at its ξ.
        tolerance: how many times the sensors' noise that noise is, (c,): what even the best model leaves, where it
            leaves more. Fits in units of less would count priors for nothing.
    """

    noise: Noise
    held_out_noise: Noise
    tolerance: Array

    @property
    def sensor_noise(self) -> Array:
        """Standard deviation of each channel's noise, (c,)."""
        return self.noise.scale / self.tolerance

    @property
    def whitened(self) -> tuple[Array, Array]:
        """Errors fitted and held out, in units of the sensors' noise, (w, S, c)."""
        return self.tolerance * self.fit.errors, self.held_out


@dataclass(frozen=True)
class Screened:
    """A candidate that acts linearly.

    Attributes:
        candidate: the effect and its place.
        hypothesis: the base's with the candidate.
        direction: what its best probe changes in the base's residual, plain parameters projected out, (m,).
        gain: in -log p, of the best multiple of that probe.
        starts: u from which a fit may start, (k, d).
    """

    candidate: Candidate
    hypothesis: Hypothesis
    direction: Array
    gain: float
    starts: Array


@dataclass(frozen=True)
class Score:
    """What a candidate earns over the base, in nats.

    Attributes:
        screened: by the linear screen.
        trial: its fit.
        fitted: gain on the fitted windows and the prior, less the price of its parameters (BIC).
        held_out: gain on the windows held out and the prior.
        of_prior: the part of both that plain parameters give back, as they need not stand in for the effect any more.
    """

    screened: Screened
    trial: Trial
    fitted: float
    held_out: float
    of_prior: float

    @property
    def candidate(self) -> Candidate:
        """The effect and its place."""
        return self.screened.candidate

    @property
    def total(self) -> float:
        """By which candidates are ranked."""
        return self.fitted + self.held_out

    @property
    def earned(self) -> bool:
        """Whether it may be called missing: it must show in what was fitted, and in recordings that no fit saw.

        Less is asked of an effect that plain parameters can stand in for: all it can show is how far they had to go.
        """
        stood_in_for = self.candidate.effect.name in SPEAKS_FOR.values() and self.of_prior > 0.5 * FAR**2
        least = 0.0 if stood_in_for else EVIDENCE
        return (
            self.fitted > least
            and self.held_out > least
            and self.trial.hypothesis.is_itself(self.candidate, self.trial.fit.u)
        )


@dataclass(frozen=True)
class Stage:
    """One step of a search.

    Attributes:
        base: what there was.
        screened: every candidate, largest expected gain first.
        scores: those that were fitted, best first.
    """

    base: Base
    screened: tuple[Screened, ...]
    scores: tuple[Score, ...]


@dataclass(frozen=True)
class Explanation:
    """What a search found.

    Attributes:
        null: the model as given, its plain parameters refitted.
        final: with all effects that are missing; the null where there are none.
        stages: one for each effect that was added, and the one that added none.
    """

    null: Base
    final: Base
    stages: tuple[Stage, ...]

    @property
    def effects(self) -> tuple[Candidate, ...]:
        """What is missing."""
        return self.final.hypothesis.candidates


class Search:
    """A search on one set of data.

    Args:
        plain: the model and its plain parameters.
        data: the windows.
        motion: of the recordings.
        candidates: what may be missing.
        progress: is told of it.
        engine: fits the candidates; this process by default.
        directory: keeps finished fits, from which a search of the same goes on; None for none.
    """

    def __init__(
        self,
        plain: Plain,
        data: Data,
        motion: Motion,
        candidates: Sequence[Candidate],
        progress: Progress = lambda *_: None,
        engine: Engine | None = None,
        directory: str | Path | None = None,
    ):
        self.plain, self.data, self.motion, self.candidates = plain, data, motion, tuple(candidates)
        self._progress, self._engine = progress, engine or LocalEngine()
        self._kept = kept_fits(directory, plain, motion, data.fitted, data.held_out)
        self._floor: Array | None = None
        self._tolerance = np.ones(len(data.fitted.channels))

    def run(self) -> Explanation:
        """Add effects while they earn it, then take away those that the others have made needless."""
        null = base = self.base()
        stages = [self.stage(null)]
        left = _left_by(min((score.trial for score in stages[0].scores), key=lambda trial: trial.excess))
        if np.any(left > _COARSE):  # only now it is known that nothing comes near the sensors' noise
            self._tolerance = left
            null = base = self.base()
            stages = [self.stage(null)]
        while (best := _chosen(null, base, stages[-1].scores)) is not None:
            self._tolerance = _left_by(best.trial)
            base = self.base([*base.hypothesis.candidates, best.candidate], best.trial.fit.u)
            if len(base.hypothesis.candidates) == MOST_EFFECTS:
                break
            stages.append(self.stage(base))
        return Explanation(null, self._eliminated(base), tuple(stages))

    def base(self, effects: Sequence[Candidate] = (), start: Array | None = None) -> Base:
        """The hypothesis of some effects, fitted with all its differences."""
        hypothesis = Hypothesis(self.plain, effects, self.motion)
        u = hypothesis.neutral() if start is None else start
        fitted, held_out = (Misfit(hypothesis, w) for w in (self.data.fitted, self.data.held_out))
        if self._floor is None:  # what the first fit leaves is nearer to noise alone than what the model as given does
            self._progress("fit", 0, 2)
            floor = fitted.noise_floor(u)
            u = self._fit(fitted.with_noise(fitted.noise_at(u, floor)), u).u
            self._floor = np.minimum(floor, fitted.noise_floor(u))
        self._progress("fit", 1, 2)
        scale = self._floor * self._tolerance
        noise, held_out_noise = fitted.noise_at(u, scale), held_out.noise_at(u, scale)
        found = self._fit(fitted.with_noise(noise), u)
        errors = self._tolerance * held_out.with_noise(held_out_noise).errors(found.u[None])[0]
        return Base(hypothesis, found, errors, noise, held_out_noise, self._tolerance)

    def stage(self, base: Base) -> Stage:
        """Screen all candidates, and fit the best."""
        open_candidates = [c for c in self.candidates if c not in base.hypothesis.candidates]
        screened = []
        for done, candidate in enumerate(open_candidates):
            self._progress("screen", done, len(open_candidates))
            screened.append(self.screen(base, candidate))
        screened.sort(key=lambda s: -s.gain)
        spoken_for = self._spoken_for(base)
        promising = screened[:REFITTED] + [s for s in screened[REFITTED:] if s.candidate in spoken_for]
        trials = self.trials(base, [_Refit(one, one.candidate in spoken_for) for one in promising])
        best = min(trials, key=lambda trial: trial.fit.loss + 0.5 * np.sum((trial.held_out / base.tolerance) ** 2))
        worth = _worth(best)
        scores = [_score(base, s, t, worth) for s, t in zip(promising, trials, strict=True)]
        return Stage(base, tuple(screened), tuple(sorted(scores, key=lambda score: -score.total)))

    def screen(self, base: Base, candidate: Candidate) -> Screened:
        """What a candidate would gain if its best probe acted linearly."""
        hypothesis = Hypothesis(self.plain, [*base.hypothesis.candidates, candidate], self.motion)
        misfit = Misfit(hypothesis, self.data.fitted).with_noise(base.noise)
        amounts, neutral = hypothesis.amounts(candidate), hypothesis.neutral()
        probes = hypothesis.probes(candidate)
        probes[:, : len(base.fit.u)] = base.fit.u
        residual, (orthonormal, triangle) = base.fit.residual, base.fit.orthonormal
        found: list[Screened] = []
        for probe, errors in zip(probes, misfit.errors(probes), strict=True):
            change = np.concatenate([errors.ravel() - base.fit.errors.ravel(), np.zeros(len(base.fit.u))])
            absorbed = orthonormal.T @ change
            direction = change - orthonormal @ absorbed
            size, slope = float(direction @ direction), float(direction @ residual)
            step = _clipped(-slope / size if size > 0 else 0.0, probe - neutral, neutral, hypothesis, amounts)
            gain = -step * slope - 0.5 * step**2 * size
            origin, shift = probe.copy(), np.zeros(len(probe))
            shift[: len(base.fit.u)] = -np.linalg.solve(triangle, absorbed)
            origin[amounts], shift[amounts] = neutral[amounts], (probe - neutral)[amounts]
            starts = np.clip(origin + step * _STEPS[:, None] * shift, hypothesis.low, hypothesis.high)
            found.append(Screened(candidate, hypothesis, direction, gain, starts))
        best = max(found, key=lambda s: s.gain)
        promising = [s.starts for s in found if s.gain >= _WORTH_A_START * best.gain]
        return replace(best, starts=np.concatenate(promising))

    def trials(self, base: Base, refits: Sequence[_Refit]) -> list[Trial]:
        """Candidates fitted, each together with all that the base has."""
        keys = [
            key_of(r.screened.hypothesis, base.fit.u, base.noise.scale, r.screened.starts, np.array(r.spoken_for))
            for r in refits
        ]
        todo = [i for i, key in enumerate(keys) if not self._kept.has(key)]
        done = itertools.count(len(refits) - len(todo) + 1)
        self._progress("refit", len(refits) - len(todo), len(refits))

        def note(number: int, outcome: Result | Exception) -> None:
            if not isinstance(outcome, Exception):
                self._kept.phase(keys[todo[number]], lambda: outcome)
            self._progress("refit", next(done), len(refits))

        shared = base, self.data.fitted, self.data.held_out, self._engine.num_threads
        found = dict(zip(todo, self._engine.map(_fitted, [refits[i] for i in todo], shared, note), strict=True))
        trials = []
        for i, (key, refit) in enumerate(zip(keys, refits, strict=True)):
            arrays = self._kept.phase(key, partial(found.__getitem__, i))
            held_out = arrays.pop("held_out")
            trials.append(Trial(refit.screened.hypothesis, Fit(**arrays), held_out))
        return trials

    def _fit(self, misfit: Misfit, start: Array) -> Fit:
        """A fit of all differences."""
        key = key_of(misfit.hypothesis, start, misfit.noise.scale)
        return Fit(**self._kept.phase(key, lambda: vars(fit(misfit, start, _ITERATIONS))))

    def _spoken_for(self, base: Base) -> list[Candidate]:
        """The candidates that plain parameters far outside their priors speak for; a linear screen cannot tell them."""
        plain = base.hypothesis.num_plain
        far = np.flatnonzero(np.abs(base.fit.u[:plain]) > FAR)
        names = [base.hypothesis.space.names[i].partition(".") for i in far]
        wanted = [(SPEAKS_FOR[kind], name) for kind, _, name in names if kind in SPEAKS_FOR]
        return [
            c for c in self.candidates for effect, name in wanted if c.effect.name == effect and c.place.endswith(name)
        ]

    def _eliminated(self, base: Base) -> Base:
        """Without the effects that the others have made needless, one after another."""
        effects = base.hypothesis.candidates
        for effect in effects if len(effects) > 1 else ():
            others = [e for e in effects if e != effect]
            without = self.base(others, base.hypothesis.without(effect, base.fit.u))
            screened = self.screen(without, effect)
            (with_it,) = self.trials(without, [_Refit(screened)])
            if not _score(without, screened, with_it, _worth(with_it)).earned:
                return self._eliminated(without)
        return base


@dataclass(frozen=True, repr=False)
class _Refit:
    """A task: to fit a candidate, which plain parameters far from their priors may speak for."""

    screened: Screened
    spoken_for: bool = False

    def __repr__(self) -> str:
        return str(self.screened.candidate)


def _fitted(refit: _Refit, base: Base, fitted: Windows, held_out: Windows, num_threads: int) -> Result:
    """The fit of a candidate, and its errors on what was held out; the base's derivatives are taken as known.

    Where plain parameters far from their priors speak for the candidate, it is fitted from the priors' means too: a
    base that they have bent is the end of a valley that leads away from the right one.
    """
    screened, hypothesis = refit.screened, refit.screened.hypothesis
    misfit = Misfit(hypothesis, fitted, num_threads).with_noise(base.noise)
    found = fit(misfit, misfit.best(screened.starts), _ITERATIONS, known=base.fit.jacobian)
    if refit.spoken_for:
        start = hypothesis.neutral()
        effects = slice(base.hypothesis.num_plain, len(base.fit.u))
        start[effects] = base.fit.u[effects]
        probes = hypothesis.probes(screened.candidate)
        probes[:, : len(base.fit.u)] = start[: len(base.fit.u)]
        amounts = hypothesis.amounts(screened.candidate)
        tried = np.tile(probes, (len(_SIZES), 1, 1))
        tried[..., amounts] = start[amounts] + _SIZES[:, None, None] * (probes[:, amounts] - start[amounts])
        tried = np.clip(tried.reshape(-1, len(start)), hypothesis.low, hypothesis.high)
        other = fit(misfit, misfit.best(tried), _ITERATIONS)
        found = min(found, other, key=lambda f: f.loss)
    test = Misfit(hypothesis, held_out, num_threads).with_noise(base.held_out_noise)
    return {**vars(found), "held_out": base.tolerance * test.errors(found.u[None])[0]}


def _clipped(step: float, shift: Array, neutral: Array, hypothesis: Hypothesis, columns: list[int]) -> float:
    """A step along a shift of some coordinates that stays within their bounds and is not absurdly long."""
    moving = [c for c in columns if shift[c]]
    bounds = np.array([hypothesis.low[moving], hypothesis.high[moving]])
    ends = (bounds - neutral[moving]) / shift[moving]
    smallest, largest = ends.min(axis=0).max(initial=-_FURTHEST), ends.max(axis=0).min(initial=_FURTHEST)
    return float(np.clip(step, smallest, largest))


def _chosen(null: Base, base: Base, scores: Sequence[Score]) -> Score | None:
    """The candidate to add: the simplest of those that the best does not beat both in the fit and on held-out data.

    A law of slightly another form than the true one leaves an error that nothing in the library describes, but much of
    it bends a little. So a further effect must make the model right, to what noise is, or explain a share of what the
    ones before it did. Where even the best leaves more than noise, a simpler one that takes nearly as much is as good.
    """
    earned = [score for score in scores if score.earned]
    if base is not null:
        right, least = EXPLAINED - 1, FURTHER * (null.excess - base.excess)
        earned = [
            s
            for s in earned
            if base.excess > right > s.trial.excess or base.excess - s.trial.excess > least or s.of_prior > 0.5 * FAR**2
        ]
    if not earned:
        return None
    best = earned[0]
    enough = base.excess - SIMPLER_SHARE * (base.excess - best.trial.excess)
    as_good = [
        s
        for s in earned
        if best.fitted - s.fitted < SIMPLER
        or best.held_out - s.held_out < SIMPLER
        or enough > s.trial.excess > best.trial.excess > EXPLAINED - 1
    ]
    return min(as_good, key=lambda score: (len(score.trial.fit.u), -score.total))


def _worth(best: Trial) -> Array:
    """What a squared error of 1 is worth in each channel, (c,): 1 where the best model leaves noise alone.

    Where it leaves more, the errors are larger than the noise and go together within a window: that many fewer count.
    """
    errors = best.held_out
    mean_square = np.mean(errors**2, axis=(0, 1))
    of_means = np.mean(errors.mean(axis=1) ** 2, axis=0)
    alike = np.clip(errors.shape[1] * of_means / np.maximum(mean_square, 1e-12), 1.0, errors.shape[1])
    return 1 / np.maximum(mean_square * np.where(mean_square > EXPLAINED, alike, 1.0), 1.0)


def _left_by(best: Trial) -> Array:
    """The errors that a model leaves, in units of the sensors' noise, (c,), each counted by what it is worth."""
    return 1 / np.sqrt(_worth(best))


def _score(base: Base, screened: Screened, trial: Trial, worth: Array) -> Score:
    """Gains in nats, each squared error counted by what it is worth."""

    def gain(before: Array, after: Array) -> float:
        return 0.5 * float(np.sum(worth * (np.sum(before**2, axis=(0, 1)) - np.sum(after**2, axis=(0, 1)))))

    def prior(fit: Fit) -> float:
        return 0.5 * float(np.sum((fit.u / fit.prior_std) ** 2))

    added = len(trial.fit.u) - len(base.fit.u)
    price = 0.5 * added * np.log(base.fit.errors.size)
    of_prior = prior(base.fit) - prior(trial.fit)
    fitted = gain(base.tolerance * base.fit.errors, base.tolerance * trial.fit.errors) + of_prior - price
    held_out = gain(base.held_out, trial.held_out) + of_prior
    return Score(screened, trial, float(fitted), float(held_out), of_prior)
