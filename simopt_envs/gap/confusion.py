"""Which effects change the data much as the one named does, and the motion that would tell them apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simopt_envs.gap.explanation import Explanation, stage_of
from simopt_envs.gap.hypothesis import Candidate
from simopt_envs.gap.thresholds import CONFOUNDED, EVIDENCE
from simopt_envs.measured.recording import Recording
from simopt_envs.physics.parameters import Array


@dataclass(frozen=True)
class Separation:
    """The motion that tells an effect from a partner best, of those that :mod:`simopt_envs.gap.separate` tries.

    Attributes:
        commands: to send, columns ``ctrl/<actuator>``; the name is that of the motion.
        correlation: of what the two change in a recording of it, plain parameters projected out.
        nats: that such a recording is expected to tell them apart by, if the effect is there.
        nats_recorded: that the fitted recordings do, counted alike.
    """

    commands: Recording
    correlation: float
    nats: float
    nats_recorded: float

    @property
    def separates(self) -> bool:
        """Whether it tells them apart, by what an effect must earn."""
        return self.nats > EVIDENCE

    def __str__(self) -> str:
        numbers = f"expected {self.nats:.0f} nats; the recordings here: {self.nats_recorded:.0f}"
        if self.separates:
            return f"to tell them apart: {self.commands.name} ({numbers})"
        return f"no motion tried would tell them apart; best: {self.commands.name} ({numbers}; {EVIDENCE:.0f} needed)"


@dataclass(frozen=True)
class Partner:
    """An effect that changes these data much as the one named does.

    Attributes:
        candidate: it.
        correlation: of what the two change in the data, plain parameters projected out.
        behind: nats that it is behind the one named, fitted and held out together; None where it was not fitted.
        separation: the motion that tells them apart best; None before one was looked for, or where no command can be
            given.
    """

    candidate: Candidate
    correlation: float
    behind: float | None
    separation: Separation | None = None


def partners(explanation: Explanation, effect: Candidate) -> tuple[Partner, ...]:
    """The confounded partners of an effect that was added, most alike first."""
    stage = stage_of(explanation.stages, effect)
    direction = {screened.candidate: screened.direction for screened in stage.screened}
    totals = {score.candidate: score.total for score in stage.scores}
    found = []
    for candidate, other in direction.items():
        if candidate == effect:
            continue
        alike = correlation(direction[effect], other)
        behind = totals[effect] - totals[candidate] if effect in totals and candidate in totals else None
        if alike > CONFOUNDED or (behind is not None and behind < EVIDENCE):
            found.append(Partner(candidate, alike, behind))
    return tuple(sorted(found, key=lambda partner: -partner.correlation))


def commands_file(effect: Candidate, partner: Candidate) -> str:
    """Where the commands that tell the two apart are saved, within the folder of what was found."""
    names = (candidate.full_name("").rstrip(".").replace("/", "_") for candidate in (effect, partner))
    return f"separate/{'_vs_'.join(names)}.csv"


def correlation(one: Array, other: Array) -> float:
    """Of two changes of the data, without their signs; 0 where one changes nothing."""
    sizes = float(np.linalg.norm(one) * np.linalg.norm(other))
    return min(abs(float(one @ other)) / sizes, 1.0) if sizes > 0 else 0.0
