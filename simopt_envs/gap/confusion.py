"""Which effects the data can hardly tell from the one named, and the motion that would."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simopt_envs.gap.hypothesis import Candidate
from simopt_envs.gap.search import Explanation, Stage
from simopt_envs.gap.thresholds import CONFOUNDED, EVIDENCE
from simopt_envs.physics.parameters import Array


@dataclass(frozen=True)
class Partner:
    """An effect that these data hardly tell from the one named.

    Attributes:
        candidate: it.
        correlation: of what the two change in the data, plain parameters projected out.
        behind: nats that it is behind the one named, fitted and held out together; None where it was not fitted.
    """

    candidate: Candidate
    correlation: float
    behind: float | None


def partners(explanation: Explanation, effect: Candidate) -> tuple[Partner, ...]:
    """The confounded partners of an effect that was added, most alike first."""
    stage = _stage_of(explanation, effect)
    direction = {screened.candidate: screened.direction for screened in stage.screened}
    totals = {score.candidate: score.total for score in stage.scores}
    found = []
    for candidate, other in direction.items():
        if candidate == effect:
            continue
        correlation = _correlation(direction[effect], other)
        behind = totals[effect] - totals[candidate] if effect in totals and candidate in totals else None
        if correlation > CONFOUNDED or (behind is not None and behind < EVIDENCE):
            found.append(Partner(candidate, correlation, behind))
    return tuple(sorted(found, key=lambda partner: -partner.correlation))


def _stage_of(explanation: Explanation, effect: Candidate) -> Stage:
    """The stage at whose end an effect was added: the last one without it."""
    without = [stage for stage in explanation.stages if effect not in stage.base.hypothesis.candidates]
    return without[-1]


def _correlation(one: Array, other: Array) -> float:
    sizes = float(np.linalg.norm(one) * np.linalg.norm(other))
    return abs(float(one @ other)) / sizes if sizes > 0 else 0.0
