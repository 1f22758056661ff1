"""The screen: what each candidate would gain on a fitted base if it acted linearly, and where its fit may start."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from simopt_envs.engine import Engine, counted
from simopt_envs.gap.fit import Misfit
from simopt_envs.gap.hypothesis import Candidate, Hypothesis
from simopt_envs.gap.thresholds import EVIDENCE, FORETELLING, FORETOLD, PROBED_LARGER, REFITTED
from simopt_envs.gap.trial import Base, noise_alone
from simopt_envs.measured.windows import Windows
from simopt_envs.physics.parameters import Array

_STEPS = np.array([1.0, 0.3, 0.1, 0.03])  # shares of the screen's step that a fit may start from
_WORTH_A_START = 0.2  # share of the best probe's gain at which a fit may start from another one
_FURTHEST = 20.0  # probes that the screen's step may be long
_LEAST_CHANGE = np.sqrt(2 * EVIDENCE)  # of the errors together, in standard deviations, that can earn so many nats


@dataclass(frozen=True)
class Probed:
    """What the probes of a candidate change on some windows.

    Attributes:
        own: its parameters' coordinates, (n, k).
        changes: of what is simulated, (n, w, S, c), in the channels' units.
    """

    own: Array
    changes: Array


@dataclass(frozen=True)
class Screened:
    """A candidate that acts linearly.

    Attributes:
        candidate: the effect and its place.
        hypothesis: the base's with the candidate.
        direction: what its best probe changes in the base's residual, plain parameters projected out, (m,).
        gain: in -log p, of the best multiple of that probe.
        starts: u from which a fit may start, some for each promising probe, (n, k, d).
    """

    candidate: Candidate
    hypothesis: Hypothesis
    direction: Array
    gain: float
    starts: Array


def screen(
    base: Base,
    candidates: Sequence[Candidate],
    windows: Windows,
    engine: Engine,
    progress: Callable[[int, int], None],
    probed: dict[Candidate, Probed],
) -> list[Screened]:
    """The candidates that a base lacks, largest expected gain less the price of their parameters (BIC) first.

    By the gain alone, those that have a shape to choose would crowd out others that need none. What a probe changes
    differs little from one base to another, so that one of which it promises next to nothing is not simulated again.

    Args:
        base: what they are added to.
        candidates: some of which the base may have.
        windows: that the base was fitted to.
        engine: screens them.
        progress: is told how many of how many are done.
        probed: what is known of these windows from screens before, with other bases; what is found now is put there.
    """
    plain, effects, motion = base.hypothesis.plain, base.hypothesis.candidates, base.hypothesis.motion
    hypotheses = {c: Hypothesis(plain, [*effects, c], motion) for c in candidates if c not in effects}
    known = {c: _screened(h, probed[c], base) for c, h in hypotheses.items() if c in probed}
    anew = [h for c, h in hypotheses.items() if c not in known or known[c].gain > FORETOLD]
    here = Misfit(base.hypothesis, windows).with_noise(base.noise).off(base.fit.u[None])[0]
    note = counted(progress, len(hypotheses), len(hypotheses) - len(anew))
    made = engine.map(made_by_probes, anew, (base, here, windows, engine.num_threads), note)
    for hypothesis, one in zip(anew, made, strict=True):
        candidate = hypothesis.candidates[-1]
        probed[candidate], known[candidate] = one, _screened(hypothesis, one, base)
    found = [known[c] for c in hypotheses]
    price = 0.5 * np.log(base.fit.errors.size)
    return sorted(found, key=lambda s: price * len(s.hypothesis.columns[s.candidate]) - s.gain)


def fitted_anyway(base: Base) -> int:
    """How many of the first of a screen are fitted in any case: one, where effects have left no more than noise may."""
    return 1 if base.hypothesis.candidates and base.excess < noise_alone(base) else REFITTED


def made_by_probes(hypothesis: Hypothesis, base: Base, here: Array, windows: Windows, num_threads: int) -> Probed:
    """What the probes of a hypothesis' last candidate change in what a base is off, ``here`` (w, S, c).

    Of one that changes less than an effect must to earn its name, a larger one is a probe, too: where things touch,
    what is smaller than that drowns in what any change of the model does.
    """
    candidate, first = hypothesis.candidates[-1], len(base.fit.u)
    misfit = Misfit(hypothesis, windows, num_threads).with_noise(base.noise)
    without = hypothesis.neutral()
    without[:first] = base.fit.u
    probes = hypothesis.probes(candidate)
    probes[:, :first] = base.fit.u
    if not hypothesis.is_built_as(base.hypothesis):  # its structure alone changes a little
        here = misfit.off(without[None])[0]
    changes = misfit.off(probes) - here
    small = np.linalg.norm(base.noise.whiten(changes).reshape(len(probes), -1), axis=1) < _LEAST_CHANGE
    if not small.any():
        return Probed(probes[:, first:], changes)
    amounts, larger = hypothesis.amounts(candidate), probes[small]
    larger[:, amounts] += (PROBED_LARGER - 1) * (larger - without)[:, amounts]
    larger = np.clip(larger, hypothesis.low, hypothesis.high)
    changes = np.concatenate([changes, misfit.off(larger) - here])
    return Probed(np.concatenate([probes, larger])[:, first:], changes)


def foretelling(base: Base, screened: Sequence[Screened], windows: Windows, engine: Engine) -> list[Candidate]:
    """Those that take the most from what a base leaves of the windows held out, at the screen's steps.

    What was fitted may hardly go where an effect acts, so that the screen alone would not have it fitted.
    """
    some = [one for one in screened if one.gain > FORETOLD]
    left = np.array(engine.map(_least_left, some, (base, windows, engine.num_threads)))
    gains = 0.5 * (np.sum((base.held_out.errors / base.tolerance) ** 2) - left)
    return [some[i].candidate for i in np.argsort(-gains, kind="stable")[:FORETELLING] if gains[i] > EVIDENCE]


def _least_left(screened: Screened, base: Base, windows: Windows, num_threads: int) -> float:
    """The least sum of squared errors of windows held out at the screen's whole step, of each promising probe."""
    misfit = Misfit(screened.hypothesis, windows, num_threads).with_noise(base.held_out_noise)
    return float(np.sum(misfit.errors(screened.starts[:, 0]) ** 2, axis=(1, 2, 3)).min())


def _screened(hypothesis: Hypothesis, probed: Probed, base: Base) -> Screened:
    """What a hypothesis' last candidate would gain if its best probe acted linearly."""
    candidate = hypothesis.candidates[-1]
    probes = np.hstack([np.tile(base.fit.u, (len(probed.own), 1)), probed.own])
    amounts, neutral = hypothesis.amounts(candidate), hypothesis.neutral()
    residual, (orthonormal, triangle) = base.fit.residual, base.fit.orthonormal
    found: list[Screened] = []
    for probe, change_of_data in zip(probes, base.noise.whiten(probed.changes), strict=True):
        change = np.concatenate([change_of_data.ravel(), np.zeros(len(base.fit.u))])
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
    return replace(best, starts=np.array(promising))


def _clipped(step: float, shift: Array, neutral: Array, hypothesis: Hypothesis, columns: list[int]) -> float:
    """A step along a shift of some coordinates that stays within their bounds and is not absurdly long.

    What has no amount, as a limit, is there as it was tried, or milder: there is no opposite of it.
    """
    if not columns:
        return float(np.clip(step, 0.0, 1.0))
    moving = [c for c in columns if shift[c]]
    bounds = np.array([hypothesis.low[moving], hypothesis.high[moving]])
    ends = (bounds - neutral[moving]) / shift[moving]
    smallest, largest = ends.min(axis=0).max(initial=-_FURTHEST), ends.max(axis=0).min(initial=_FURTHEST)
    return float(np.clip(step, smallest, largest))
