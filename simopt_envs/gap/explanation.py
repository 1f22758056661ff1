"""What a search found, and the steps by which it did."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simopt_envs.gap.hypothesis import Candidate
from simopt_envs.gap.screen import Screened
from simopt_envs.gap.selection import Score, score_of, worth_of
from simopt_envs.gap.thresholds import EVIDENCE, EXPLAINED
from simopt_envs.gap.trial import Base, Data, Trial


@dataclass(frozen=True)
class Stage:
    """One step of a search.

    Attributes:
        base: what there was.
        screened: every candidate, most promising first.
        scores: those that were fitted, best first.
    """

    base: Base
    screened: tuple[Screened, ...]
    scores: tuple[Score, ...]

    @property
    def trials(self) -> dict[Candidate, Trial]:
        """Those that were fitted."""
        return {score.candidate: score.trial for score in self.scores}

    def held_against(self, rows: NDArray[np.intp]) -> Stage:
        """The same, of some of the windows held out."""
        trials = {candidate: trial.held_against(rows) for candidate, trial in self.trials.items()}
        return ranked(self.base.held_against(rows), self.screened, trials)

    @property
    def promising(self) -> set[Candidate]:
        """The candidates that earn as many nats as are evidence."""
        return {score.candidate for score in self.scores if score.total > EVIDENCE}

    def rivals(self, effect: Candidate) -> set[Candidate]:
        """The other candidates that do nearly as much as the one that was taken, or more; none if it was not fitted."""
        total = {score.candidate: score.total for score in self.scores}
        least = total.get(effect, np.inf) - EVIDENCE
        return {candidate for candidate in total if candidate != effect and total[candidate] > least}


def ranked(base: Base, screened: Sequence[Screened], trials: Mapping[Candidate, Trial]) -> Stage:
    """A stage from what was screened and fitted: errors count by what the best trial makes of them."""

    def loss(trial: Trial) -> float:
        told = trial.held_out
        return trial.fit.loss + 0.5 * float(np.sum((told.errors / base.tolerance) ** 2) + np.sum(told.log_det))

    best = min(trials.values(), key=loss)
    worth = worth_of(best.held_out.errors)
    scores = [score_of(base, candidate, trial, worth) for candidate, trial in trials.items()]
    return Stage(base, tuple(screened), tuple(sorted(scores, key=lambda score: -score.total)))


def stage_of(stages: Sequence[Stage], effect: Candidate) -> Stage:
    """The stage at whose end an effect was taken: the last one without it."""
    return [stage for stage in stages if effect not in stage.base.hypothesis.candidates][-1]


def rivals_of(effect: Candidate, stays: bool, without: Base, stages: Sequence[Stage]) -> set[Candidate]:
    """What an effect is held against beside others or, if it goes and these alone are not enough, what may follow it.

    Beside no others, the stage at whose end it was taken held it against all.

    Args:
        effect: that was taken.
        stays: whether it does.
        without: the base with the others.
        stages: so far.
    """
    if stays:
        return stage_of(stages, effect).rivals(effect) if without.hypothesis.candidates else set()
    return set().union(*(stage.promising for stage in stages)) if without.excess > EXPLAINED - 1 else set()


@dataclass(frozen=True)
class Explanation:
    """What a search found.

    Attributes:
        null: the model as given, its plain parameters refitted.
        final: with all effects that are missing; the null where there are none.
        effects: what each of them earns beside the others, most first.
        stages: one for each effect that was added, the one that added none, and those that compared an effect with its
            rivals beside the others.
        data: the windows that were fitted.
    """

    null: Base
    final: Base
    effects: tuple[Score, ...]
    stages: tuple[Stage, ...]
    data: Data
