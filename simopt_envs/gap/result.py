"""What the gap workflow found, as numbers, files and a page."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np

from simopt_envs.gap.confusion import Partner, commands_file, partners
from simopt_envs.gap.describe import Description
from simopt_envs.gap.error import Errors
from simopt_envs.gap.explanation import Explanation
from simopt_envs.gap.hypothesis import Candidate
from simopt_envs.gap.localise import Row
from simopt_envs.gap.presence import is_there
from simopt_envs.gap.repair import COLUMNS, difference, observation_model, repaired, to_xml_in
from simopt_envs.gap.thresholds import CONFIDENT, EXPLAINED, LEAST_SHARE
from simopt_envs.gap.timestep import TIMESTEP
from simopt_envs.gap.trial import Data, of_median_window
from simopt_envs.measured.recording import Finding
from simopt_envs.physics.effects import object_name
from simopt_envs.physics.effects.actuators import driven_joint
from simopt_envs.physics.parameters import Array

Verdict = Literal["named", "partly", "none", "unexplained"]


@dataclass(frozen=True)
class Estimate:
    """A parameter's value, unit and 95 % interval."""

    value: float
    unit: str
    interval95: tuple[float, float]

    def __str__(self) -> str:
        unit = "" if self.unit == "1" else f" {self.unit}"
        return f"{self.value:.3g}{unit} [{self.interval95[0]:.3g}, {self.interval95[1]:.3g}]"


@dataclass(frozen=True)
class Named:
    """An effect that the model lacks.

    Attributes:
        candidate: the effect and its place.
        parameters: its numbers by their short names.
        evidence: nats that it earns beside the others, ``"fitted"`` and ``"held_out"``.
        partners: effects that change these data much as it does.
        sized: whether what was fitted tells how much of it there is: its interval leaves out none of it.
    """

    candidate: Candidate
    parameters: dict[str, Estimate]
    evidence: dict[str, float]
    partners: tuple[Partner, ...]
    sized: bool = True

    def __str__(self) -> str:
        numbers = ", ".join(f"{name} {estimate}" for name, estimate in self.parameters.items())
        return f"{self.candidate}: {numbers}"


@dataclass(frozen=True)
class Gap:
    """Where a model and recordings disagree, what is missing, and the model with it.

    Attributes:
        verdict: ``"named"``, ``"partly"``, ``"none"`` or ``"unexplained"``.
        effects: what is missing, most evidence first.
        errors: on recordings that no fit saw.
        localisation: where the refitted model and the recordings disagree, largest share first.
        left: what the part that is not explained depends on.
        explanation: the search behind it.
        unforeseen: what the verdict is on, see :attr:`simopt_envs.gap.trial.Base.unforeseen`.
        spec: the repaired model.
        columns: what of it MJCF cannot hold, as the mapping by which recordings are read for it; empty for nothing.
        diff: its difference to the model as given.
        seconds: that it took.
    """

    verdict: Verdict
    effects: tuple[Named, ...]
    errors: Errors
    localisation: tuple[Row, ...]
    left: Description
    explanation: Explanation
    unforeseen: float
    spec: mujoco.MjSpec
    columns: str
    diff: str
    seconds: float

    @property
    def data(self) -> Data:
        """The recordings, in the windows that were fitted and held out."""
        return self.explanation.data

    @property
    def remarks(self) -> tuple[str, ...]:
        """What the effects say together."""
        said = two_directions(self.explanation.null.hypothesis.plain.model, self.effects)
        unsized = (str(named.candidate) for named in self.effects if not named.sized)
        return *said, *(f"Data tell that {name} is there, but hardly how much of it." for name in unsized)

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """Of the recordings' audit."""
        return self.data.warnings

    def __str__(self) -> str:
        numbers = f"held-out error {self.errors.refit:.3g} -> {self.errors.after:.3g}"
        numbers += f" (model as given {self.errors.before:.3g}, noise floor {self.errors.noise_floor:.3g})"
        of_step = [warning.message for warning in self.warnings if warning.check == TIMESTEP]
        return "\n  ".join([self.verdict, *map(str, self.effects), *self.remarks, *of_step, numbers])

    def to_dict(self) -> dict[str, Any]:
        """As in ``gap.json``."""
        first = self.explanation.stages[0]
        return {
            "verdict": self.verdict,
            "effects": [
                {
                    "effect": named.candidate.effect.name,
                    "where": named.candidate.place,
                    "parameters": {
                        name: {"value": e.value, "unit": e.unit, "interval95": list(e.interval95)}
                        for name, e in named.parameters.items()
                    },
                    "evidence": named.evidence,
                    "confounded_with": [
                        {
                            "effect": p.candidate.effect.name,
                            "where": p.candidate.place,
                            "correlation": p.correlation,
                            "motion": _motion(named.candidate, p),
                        }
                        for p in named.partners
                    ],
                }
                for named in self.effects
            ],
            "remarks": list(self.remarks),
            "candidates": [
                {
                    "effect": score.candidate.effect.name,
                    "where": score.candidate.place,
                    "held_out_gap": 1.0 + score.trial.excess,
                    "evidence": {"fitted": score.fitted, "held_out": score.held_out},
                }
                for score in first.scores
            ],
            "gap": {
                "metric": "normalised RMSE",
                "before": self.errors.before,
                "refit": self.errors.refit,
                "after": self.errors.after,
                "interval95": list(self.errors.interval95),
                "noise_floor": self.errors.noise_floor,
                "whitened": {  # mean square in units of the noise of sensors and starts (and ξ), which alone leaves 1
                    "refit": 1.0 + self.explanation.null.excess,
                    "after": 1.0 + self.explanation.final.excess,
                    "unforeseen": 1.0 + self.unforeseen,
                },
                "held_out": [recording.name for recording in self.data.held_out_recordings],
            },
            "localisation": [
                {"channel": row.channel, "regime": row.regime, "share": row.share, "z": row.z}
                for row in self.localisation
            ],
            "unexplained": self.left.text,
            "warnings": [str(warning) for warning in self.warnings],
            "model": "model.repaired.xml",
            "diff": "model.diff",
            "seconds": self.seconds,
        }

    def save(self, folder: str | Path) -> Path:
        """Write ``gap.json``, ``model.repaired.xml``, ``model.diff`` and the report with its plots into a folder.

        What of the repaired model MJCF cannot hold goes into ``columns.yaml`` there, if there is any: recordings read
        with that mapping are as the model means them. Commands of motions that tell effects from their partners go into
        the folder ``separate``, as CSV.

        Raises:
            ImportError: without what the report needs, after all else is written.
        """
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "model.repaired.xml").write_text(to_xml_in(self.spec, folder))
        (folder / "model.diff").write_text(self.diff)
        if self.columns:
            (folder / COLUMNS).write_text(self.columns)
        (folder / "gap.json").write_text(json.dumps(self.to_dict(), indent=1))
        for effect in self.effects:
            for partner in effect.partners:
                if partner.separation is not None and partner.separation.separates:
                    partner.separation.commands.save(folder / commands_file(effect.candidate, partner.candidate))
        try:
            from simopt_envs.gap.report import write_report
        except ImportError as error:
            raise ImportError('the report needs more packages: pip install "simopt-envs[report]"') from error
        write_report(self, folder, self.localisation, self.left)
        return folder


def _motion(effect: Candidate, partner: Partner) -> dict[str, Any] | None:
    """As in ``gap.json``; no file where the best motion does not tell them apart either."""
    found = partner.separation
    if found is None:
        return None
    return {
        "file": commands_file(effect, partner.candidate) if found.separates else None,
        "excitation": found.commands.name,
        "correlation": found.correlation,
        "nats": found.nats,
        "nats_recorded": found.nats_recorded,
    }


def judge(explanation: Explanation) -> Verdict:
    """The verdict on a search, from what is left on recordings that no fit saw.

    Effects that take away too little are no explanation, unless they make the median window right: then what is left is
    of a few, in which something else happens as well. So it is where windows were left out as outliers.
    """
    right, whole = explanation.final.unforeseen < EXPLAINED - 1, not explanation.data.outliers
    if not explanation.effects:
        return "none" if right and whole else "unexplained"
    if right:
        return "named" if whole else "partly"
    before, after = (of_median_window(base.held_out.errors) for base in (explanation.null, explanation.final))
    least = (1 - LEAST_SHARE) * explanation.null.excess_everywhere
    enough = explanation.final.excess_everywhere < least or after < EXPLAINED < before
    return "partly" if enough else "unexplained"


def named_effects(explanation: Explanation) -> tuple[Named, ...]:
    """The effects that a search found, with what it knows of their numbers."""
    final = explanation.final
    hypothesis, u = final.hypothesis, final.fit.u
    spread = final.spread(explanation.data)
    ends = u + CONFIDENT * np.array([-spread, spread])
    xi, (low, high) = hypothesis.xi(u[None])[0], np.sort(hypothesis.xi(ends), axis=0)
    return tuple(
        Named(
            score.candidate,
            {
                hypothesis.space.names[i].removeprefix(score.candidate.full_name("")): Estimate(
                    float(xi[i]), hypothesis.space.units[i], (float(low[i]), float(high[i]))
                )
                for i in hypothesis.columns[score.candidate]
            },
            {"fitted": score.fitted, "held_out": score.held_out},
            partners(explanation, score.candidate),
            is_there(hypothesis, score.candidate, u, spread),
        )
        for score in explanation.effects
    )


def two_directions(model: mujoco.MjModel, named: Sequence[Named]) -> Iterator[str]:
    """A sentence for each joint with Coulomb friction whose drive has a constant force.

    Together they are a friction that differs between the directions: no motion tells which of the two it is.
    """
    frictions = {n.candidate.place: n for n in named if n.candidate.effect.name == "coulomb_friction"}
    for force in (n for n in named if n.candidate.effect.name == "actuator_bias"):
        drive = object_name(force.candidate.place)
        friction = frictions.get(f"joint:{driven_joint(model, drive)}")
        if friction is None:
            continue
        level, push = friction.parameters["frictionloss"], force.parameters["force"]
        if abs(push.value) < level.value:  # or it would be no friction one way
            low, high = sorted(2 * abs(end) for end in push.interval95)
            yield (
                f"The constant force of {drive} and the friction at {friction.candidate.place} are the same as a"
                f" friction that differs between the directions: {level.value - push.value:.3g} {level.unit} forwards,"
                f" {level.value + push.value:.3g} {level.unit} backwards, {2 * abs(push.value):.3g} {level.unit}"
                f" [{low:.3g}, {high:.3g}] apart."
            )


def repair(explanation: Explanation, given: mujoco.MjSpec, xi: Array) -> tuple[mujoco.MjSpec, str, str]:
    """The repaired spec, what of it MJCF cannot hold, and the difference of both to the one given."""
    hypothesis = explanation.final.hypothesis
    columns = observation_model(hypothesis, xi, explanation.data.fitted_recordings[0].columns)
    spec = repaired(hypothesis, xi)
    return spec, columns, difference(given, spec, columns)
