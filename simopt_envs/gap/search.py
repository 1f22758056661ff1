"""Which effects are missing: a screen of the whole library, refits of the best, forward selection, second thoughts."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import fields, replace
from functools import partial
from pathlib import Path

import numpy as np

from simopt_envs.adaptation.checkpoint import Result
from simopt_envs.adaptation.fitting import Noise
from simopt_envs.engine import Engine, LocalEngine, ThreadEngine, counted
from simopt_envs.gap.explanation import Explanation, Stage, ranked, rivals_of
from simopt_envs.gap.fit import DIFFERENCES, Fit, Misfit, fit
from simopt_envs.gap.hypothesis import Candidate, Hypothesis
from simopt_envs.gap.kept import kept_fits, key_of
from simopt_envs.gap.large import SECONDS, nearest_size, of_several_effects
from simopt_envs.gap.outliers import without_outliers
from simopt_envs.gap.plain import SPEAKS_FOR, Plain
from simopt_envs.gap.predictive import HeldOut
from simopt_envs.gap.presence import is_there, is_told_from_none, may_be_itself
from simopt_envs.gap.refit import ITERATIONS, Refit, extended, fitted, grown, spoken_for
from simopt_envs.gap.screen import Probed, Screened, fitted_anyway, foretelling, screen
from simopt_envs.gap.selection import Score, chosen, is_all, score_of, tolerance_of, worth_of
from simopt_envs.gap.thresholds import EVIDENCE, EVIDENCE_EACH, LARGE, LARGE_REFITTED, MOST_EFFECTS, REFITTED_AT_MOST
from simopt_envs.gap.trial import Base, Data, Trial, afresh
from simopt_envs.gap.wild_starts import as_predicted, without_starts_told_wild
from simopt_envs.physics.effects import Motion
from simopt_envs.physics.parameters import Array

Progress = Callable[[str, int, int], None]
"""Is told what is being done, and how many of how many are done."""

_FITTED_IN_FULL = 3  # candidates
_TRIED_FINELY = 4  # times as many candidates as are fitted at such a size are tried at finer ones
_BETTER = 2.0  # nats by which a base must become better for its candidates to be fitted anew


class Search:
    """A search on one set of data.

    Args:
        plain: the model and its plain parameters.
        data: the windows.
        motion: of the recordings.
        candidates: what may be missing, one at least.
        progress: is told of it.
        engine: tries and fits the candidates; threads of this process by default.
        directory: keeps finished fits, from which a search of the same goes on; None for none.
        longer: the recordings in longer windows, the longest first; the first in which the model is near are fitted.
        null: what :meth:`base` gives without effects, if it is there already.
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
        longer: Sequence[Data] = (),
        null: Base | None = None,
    ):
        self.plain, self.data, self.motion, self.candidates = plain, data, motion, tuple(candidates)
        self._longer, self._progress, self._engine = tuple(longer), progress, engine or ThreadEngine()
        self._kept = kept_fits(directory, plain, motion, data.fitted, data.held_out)
        self._null = null
        self._tolerance = np.ones(len(data.fitted.channels))
        self._floor = np.inf * self._tolerance if null is None else null.sensor_noise
        self._largest: dict[tuple[Candidate, ...], list[Candidate]] = {}
        self._probed: dict[Candidate, Probed] = {}

    def run(self) -> Explanation:
        """Add effects while they earn it, then take away those that the others have made needless."""
        base = self._null or self.base()
        stage = self._first(self._in_longer_windows(base))
        self._tolerance = self._tolerance_of(
            min((score.trial for score in stage.scores), key=lambda trial: trial.excess)
        )
        if np.any(self._tolerance > 1):  # only now it is known that nothing comes near the sensors' noise
            stage = self.stage(self.base(start=self._led_to(stage)))
        stages: list[Stage] = []
        final, effects = self._revised(self._grown(stages, stage), stages)
        return Explanation(stages[0].base, final, effects, tuple(stages), self.data)

    def _grown(self, stages: list[Stage], stage: Stage, dropped: frozenset[Candidate] = frozenset()) -> Base:
        """A stage's base with effects added while they earn it, but for those that were dropped; stages are noted."""
        most = min(MOST_EFFECTS, len(self.candidates))
        while True:
            stage = self._polished(stage)
            stages.append(replace(stage, scores=tuple(s for s in stage.scores if s.candidate not in dropped)))
            best = chosen(stages[0].base, stage.base, stages[-1].scores)
            if best is None:
                return stage.base
            base = self._contested(stages, self._sharpened(best.trial), best.candidate)
            if len(base.hypothesis.candidates) == most or is_all(stages[0].base, base):
                return base
            stage = self.stage(base)

    def _in_longer_windows(self, base: Base) -> Base:
        """A base fitted to the longest windows that it predicts, and of which, fitted, it leaves no large error.

        They tell more than short ones, as what a model lacks adds up. So does what a law of another form leaves.
        """
        short = self.data
        for longer in filter(None, map(partial(as_predicted, base), self._longer)):
            self.data = longer
            if (found := self.base(start=base.fit.u)).excess < LARGE:
                return found
        self.data = short
        return base

    def _first(self, base: Base) -> Stage:
        """The first stage, on windows whose start does not decide, and in which nothing happened that none explains.

        Where the base is far from the data, the few candidates that come nearest at some size may tell of wild windows
        before all others are fitted. Where none of those left out was fitted, fits stand.
        """
        look = self._look(base) if base.excess >= LARGE else None
        if look is not None:
            base = look.base
        elif base.excess >= LARGE:
            base = self.base()
        stage = self._without_wild(self.stage(base, look)) or self.stage(self.base())
        return self._of_fewer(stage, without_outliers(stage, self.data)) or self.stage(self.base())

    def _without_wild(self, stage: Stage) -> Stage | None:
        """A stage without the windows whose start, as it tells, decides; None where fits had been to some of them."""
        return self._of_fewer(stage, without_starts_told_wild(stage, self.data))

    def _of_fewer(self, stage: Stage, data: Data) -> Stage | None:
        before, self.data = self.data, data
        if self.data is before:
            return stage
        if self.data.fitted is not before.fitted:
            self._largest.clear()
            self._probed.clear()
            return None
        return stage.held_against(before.held_out.find(self.data.held_out))

    def base(self, effects: Sequence[Candidate] = (), start: Array | None = None) -> Base:
        """The hypothesis of some effects, fitted with all its differences."""
        hypothesis = Hypothesis(self.plain, effects, self.motion)
        u, differences = (hypothesis.neutral(), DIFFERENCES) if start is None else (start, DIFFERENCES[1:])
        fitted, held_out = (Misfit(hypothesis, w) for w in (self.data.fitted, self.data.held_out))
        if np.isinf(self._floor).all():  # what a first fit leaves is nearer to noise than what the model as given does
            self._progress("fit", 0, 2)
            floor = fitted.noise_floor(u)
            u, differences = self.fit(fitted.with_noise(fitted.noise_at(u, floor)), u, differences).u, DIFFERENCES[1:]
            self._floor = np.minimum(floor, fitted.noise_floor(u))
        self._progress("fit", 1, 2)
        scale = self._floor * self._tolerance
        noise, held_out_noise = fitted.noise_at(u, scale), held_out.noise_at(u, scale)
        found = self.fit(fitted.with_noise(noise), u, differences)
        told = HeldOut.of(held_out.with_noise(held_out_noise), found.u, self._tolerance)
        return Base(hypothesis, found, told, noise, held_out_noise, self._tolerance)

    def _sharpened(self, trial: Trial) -> Base:
        """A trial's hypothesis as a base: fitted to the sensors' noise or, where that leaves far more, to what is left.

        What the trial itself left was of a fit in the noise of a base that lacked the effect, which looked too large.
        """
        effects, usual = trial.hypothesis.candidates, trial.hypothesis.usual
        self._floor = np.minimum(self._floor, Misfit(trial.hypothesis, self.data.fitted).noise_floor(trial.fit.u))
        self._tolerance = np.ones(len(self._tolerance))
        base = self.base(effects, usual(trial.fit.u))
        best = min(trial, base, key=lambda t: t.excess)
        self._tolerance = self._tolerance_of(best)
        return self.base(effects, usual(best.fit.u)) if np.any(self._tolerance > 1) else base

    def _tolerance_of(self, best: Trial) -> Array:
        """What errors are to be counted in where no trial comes nearer to the data, (c,)."""
        return tolerance_of(best, self.data.held_out, self._floor)

    def _look(self, base: Base) -> Stage | None:
        """A stage of those candidates alone that come nearest to the data at some size.

        None where they tell of windows whose start decides, which fits with the base's derivatives may do already.
        """
        screened = self._screened(base, self._large(base))
        halfway = self._without_wild(ranked(base, screened, self.trials(base, self._refits(base, screened))))
        if halfway is None:
            return None
        base = halfway.base
        return self._without_wild(ranked(base, screened, self._in_full(base, screened, halfway.trials)))

    def stage(self, base: Base, look: Stage | None = None, before: Stage | None = None) -> Stage:
        """Screen all candidates, and fit the best, by what was held out too, but those that a look there has fitted.

        The best of a stage before, from another fit of the base, are fitted from where they ended there, too. Where
        noise alone may be left, only what the screen has something of is.
        """
        screened = self._screened(base)
        done = {} if look is None else look.trials
        wanted = [*spoken_for(base, self.candidates), *self._large(base)]
        wanted += [s.candidate for s in screened[:REFITTED_AT_MOST] if s.gain > EVIDENCE_EACH]
        wanted += foretelling(base, screened, self.data.held_out, self._engine)
        promising = [s for i, s in enumerate(screened) if i < fitted_anyway(base) or s.candidate in wanted]
        trials = done | self.trials(base, self._refits(base, [one for one in promising if one.candidate not in done]))
        return ranked(base, screened, self._in_full(base, screened, trials, done, before))

    def _refits(self, base: Base, promising: Sequence[Screened]) -> list[Refit]:
        """From where candidates are fitted: afar, too, where the base is far from the data or its priors."""
        far: dict[Candidate, tuple[Array, ...]] = {c: (u,) for c, u in spoken_for(base, self.candidates).items()}
        for candidate in (one.candidate for one in promising):
            if base.excess > LARGE or (base.strained and candidate.effect.name in SPEAKS_FOR.values()):
                far[candidate] = (*far.get(candidate, ()), afresh(base))
        return [Refit(one, far.get(one.candidate, ())) for one in promising]

    def _screened(self, base: Base, candidates: Sequence[Candidate] | None = None) -> list[Screened]:
        """All candidates, or some, as they would act on a base."""
        screened = self.candidates if candidates is None else candidates
        note = partial(self._progress, "screen")
        return screen(base, screened, self.data.fitted, self._engine, note, self._probed)

    def _polished(self, stage: Stage) -> Stage:
        """A stage from the base fitted from where candidates led its parameters, if it comes out better there.

        Or what a candidate's fit found, and the base's had missed, would count as the candidate's merit. Whether there
        is any is told with the base's derivatives. Candidates are fitted anew from there, unless the base is far from
        the data: then they are in their contest, see below.
        """
        base = stage.base
        misfit = Misfit(base.hypothesis, self.data.fitted).with_noise(base.noise)
        found = self.fit(misfit, self._led_to(stage), DIFFERENCES[-1:], base.fit.jacobian)
        if found.loss >= base.fit.loss - _BETTER:
            return stage
        if base.excess < LARGE:
            return self.stage(self.base(base.hypothesis.candidates, found.u), before=stage)
        test = Misfit(base.hypothesis, self.data.held_out).with_noise(base.held_out_noise)
        found = self.fit(misfit, found.u, DIFFERENCES[1:])
        better = replace(base, fit=found, held_out=HeldOut.of(test, found.u, base.tolerance))
        return ranked(better, stage.screened, stage.trials)

    def _led_to(self, stage: Stage) -> Array:
        """The base's coordinates (d,), of those that its candidates' fits led to, that are best without a candidate."""
        base = stage.base
        misfit = Misfit(base.hypothesis, self.data.fitted).with_noise(base.noise)
        return misfit.best(np.array([score.trial.fit.u[: len(base.fit.u)] for score in stage.scores]))

    def _contested(self, stages: Sequence[Stage], base: Base, effect: Candidate) -> Base:
        """A sharpened base or, where the one before its last effect was far from the data, its best rival's.

        There the noise was that of a model far off, in which fits end early, whatever they could come to.
        """
        stage = stages[-1]
        rivals = stage.rivals(effect)
        if stage.base.excess < LARGE or not rivals:
            return base
        without = self._without(base, effect, stages)
        near = {score.candidate: score.trial.fit.u for score in stage.scores}
        refits = [Refit(s, near=near[s.candidate]) for s in stage.screened if s.candidate in rivals]
        contest = ranked(without, stage.screened, {**self.trials(without, refits), effect: base})
        best = chosen(stages[0].base, without, contest.scores)
        return base if best is None or best.candidate == effect else self._sharpened(best.trial)

    def _large(self, base: Base) -> list[Candidate]:
        """The candidates that come nearest to the data at some size, where the base is far from them.

        The other parameters are at the priors' means, as the base may be bent, and few windows tell that much. They
        are looked for once: the same effects in another noise change little of it.
        """
        if base.excess < LARGE:
            return []
        effects = base.hypothesis.candidates
        if effects not in self._largest:
            rows = base.worst(SECONDS / self.data.seconds)
            windows, noise = self.data.fitted.select(rows), base.noise.select(rows)
            shared = windows, noise, afresh(base), self._engine.num_threads
            lacking = [c for c in self.candidates if c not in effects]
            roughly = [(Hypothesis(self.plain, (*effects, c), self.motion), None) for c in lacking]
            note = counted(partial(self._progress, "try sizes of"), len(lacking))
            nearest = self._engine.map(nearest_size, roughly, shared, note)
            order = np.argsort([loss for loss, _ in nearest], kind="stable")[: _TRIED_FINELY * LARGE_REFITTED]
            finely = [(roughly[i][0], nearest[i][1]) for i in order]
            fine = [loss for loss, _ in self._engine.map(nearest_size, finely, shared)]
            ordered = [lacking[order[i]] for i in np.argsort(fine, kind="stable")]
            self._largest[effects] = of_several_effects(ordered)
        return self._largest[effects]

    def _in_full(
        self,
        base: Base,
        screened: Sequence[Screened],
        trials: dict[Candidate, Trial],
        done: Collection[Candidate] = (),
        before: Stage | None = None,
    ) -> dict[Candidate, Trial]:
        """Trials with those fitted further that earn the most, or would by the screen, where that is enough.

        With the base's derivatives a fit may end halfway, and so hide what an effect earns. Those that are done have
        been in their turn; the best of a stage before, from another fit of the base, may go on from there.
        """
        earlier = {} if before is None else {s.candidate: s.trial for s in before.scores[:_FITTED_IN_FULL]}
        first = [s for s in screened if s.candidate in trials][:_FITTED_IN_FULL]
        best = {s.candidate for s in ranked(base, screened, trials).scores[:_FITTED_IN_FULL] if s.total > EVIDENCE_EACH}
        best.update(s.candidate for s in first if 2 * s.gain > EVIDENCE)  # with as much on the windows held out
        best.update(c for c in trials if (smaller := extended(c, trials)) in best and smaller not in done)
        refits = []
        for one in screened:
            if one.candidate in best.union(earlier).difference(done):
                ends = [found[one.candidate].fit.u for found in (trials, earlier) if one.candidate in found]
                refits.append(Refit(one, near=ends[0], others=(*ends[1:], *grown(one, trials))))
        return trials | self.trials(base, refits)

    def trials(self, base: Base, refits: Sequence[Refit]) -> dict[Candidate, Trial]:
        """Candidates fitted, each together with all that the base has."""
        keys = [self._key(r.screened.hypothesis, base.noise, base.fit.u, *r.starts) for r in refits]
        todo = [i for i, key in enumerate(keys) if not self._kept.has(key)]
        tell = counted(partial(self._progress, "refit"), len(refits), len(refits) - len(todo))

        def note(number: int, outcome: Result | Exception) -> None:
            if not isinstance(outcome, Exception):
                self._kept.phase(keys[todo[number]], lambda: outcome)
            tell(number, outcome)

        engine = self._engine if len(todo) > 1 else LocalEngine()  # one alone may have all cores
        shared = base, self.data.fitted, self.data.held_out, engine.num_threads
        found = dict(zip(todo, engine.map(fitted, [refits[i] for i in todo], shared, note), strict=True))
        trials = {}
        for i, (key, refit) in enumerate(zip(keys, refits, strict=True)):
            arrays = self._kept.phase(key, partial(found.__getitem__, i))
            held_out = HeldOut(**{f.name: arrays.pop(f"held_out_{f.name}") for f in fields(HeldOut)})
            trials[refit.screened.candidate] = Trial(refit.screened.hypothesis, Fit(**arrays), held_out)
        return trials

    def fit(self, misfit: Misfit, start: Array, differences: Sequence[float], known: Array | None = None) -> Fit:
        """A fit of all parameters, kept like those of candidates."""
        given = np.array(differences), np.empty(0) if known is None else known
        key = self._key(misfit.hypothesis, misfit.noise, start, *given)
        return Fit(**self._kept.phase(key, lambda: vars(fit(misfit, start, ITERATIONS, known, differences))))

    def _key(self, hypothesis: Hypothesis, noise: Noise, *given: Array) -> str:
        """A fit's name; of the noise of starts, what tells one from another is enough."""
        return key_of(hypothesis, np.array(self.data.fitted.measured.shape), noise.scale, noise.shrink, *given)

    def _revised(
        self, base: Base, stages: list[Stage], dropped: frozenset[Candidate] = frozenset()
    ) -> tuple[Base, tuple[Score, ...]]:
        """Without the effects that the others have made needless, and with rivals that do more beside them instead.

        With it comes what each earns, most first. With and without are compared in one noise, that of the model with
        all: what uncertain starts leave depends on the model too. An effect whose interval, by all windows, holds "none
        of it" goes as well, unless it is so strong that its size shows little: the evidence for it is of a few
        stretches, and others speak against it. So does one that is not what its name means. What did well beside it may
        take its place, and others then be added. One of which that holds for what it adds to the effect that it extends
        gives way to that, which may have been dropped. In no other way does what was dropped come back.
        """
        effects, earned = base.hypothesis.candidates, []
        if not effects:
            return base, ()
        hypothesis, (u, spread) = base.hypothesis, base.by_all(self.data)
        itself = {effect: may_be_itself(hypothesis, effect, u, spread) for effect in effects}
        for effect in sorted(effects, key=itself.__getitem__):  # beside what is none, another may only seem needless
            told, smaller = (hypothesis, effect, u, spread), extended(effect, {*self.candidates} - {*effects})
            if smaller is not None and not (itself[effect] and is_there(*told, smaller)):
                return self._revised(self._reduced(base, effect, smaller), stages, dropped | {effect})
            without = self._without(base, effect, stages)
            score = score_of(without, effect, base, worth_of(base.held_out.errors))
            there = is_there(*told) or is_told_from_none(effect, base, without, self.data.parts)
            stays = score.needed and itself[effect] and there
            rivals = rivals_of(effect, stays, without, stages) - dropped - {*effects}
            if rivals and len(dropped) < MOST_EFFECTS:  # or what is outside the library has one try after another
                screened = self._screened(without)
                trials = self.trials(without, [Refit(s) for s in screened if s.candidate in rivals])
                trials = self._in_full(without, screened, trials) | ({effect: base} if stays else {})
                stages.append(ranked(without, screened, trials))
                best = chosen(stages[0].base, without, stages[-1].scores)
                if best is not None and best.candidate != effect:
                    base, dropped = self._sharpened(best.trial), dropped | {effect}
                    if not stays and len(base.hypothesis.candidates) < MOST_EFFECTS:
                        base = self._grown(stages, self.stage(base), dropped)
                    return self._revised(base, stages, dropped)
            if not stays:
                return self._revised(self.base(without.hypothesis.candidates, without.fit.u), stages, dropped)
            earned.append(score)
        return base, tuple(sorted(earned, key=lambda score: -score.total))

    def _without(self, base: Base, effect: Candidate, stages: Sequence[Stage]) -> Base:
        """A base without one of its effects, in its noise."""
        left = tuple(e for e in base.hypothesis.candidates if e != effect)
        hypothesis = Hypothesis(self.plain, left, self.motion)
        misfit, test = (Misfit(hypothesis, windows) for windows in (self.data.fitted, self.data.held_out))
        misfit = misfit.with_noise(base.noise)
        before = [stage.base.fit.u for stage in stages if stage.base.hypothesis.candidates == left]
        start = misfit.best(np.array([base.hypothesis.without(effect, base.fit.u), *before]))
        found = self.fit(misfit, start, DIFFERENCES[1:])
        told = HeldOut.of(test.with_noise(base.held_out_noise), found.u, base.tolerance)
        return Base(hypothesis, found, told, base.noise, base.held_out_noise, base.tolerance)

    def _reduced(self, base: Base, effect: Candidate, smaller: Candidate) -> Base:
        """A base with the effect that one of its effects extends instead of that, from what both share."""
        left = tuple(smaller if e == effect else e for e in base.hypothesis.candidates)
        shared = np.delete(base.hypothesis.xi(base.fit.u[None])[0], base.hypothesis.added(effect, smaller))
        return self.base(left, Hypothesis(self.plain, left, self.motion).coordinates(shared))
