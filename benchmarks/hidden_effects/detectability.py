"""How large an effect must be to be seen at all: from the truth's own simulation, before anything is named.

An effect moves the recordings by d(m). White noise, starts that are uncertain, and plain parameters that are known only
to their priors hide part of it: what is left, in standard deviations, is sqrt(d' (Sigma + A A')^-1 d), A holding the
derivatives by starts and plain parameters times their prior deviations (the local Fisher information, the nuisances
marginalised; the plain parameters' curvature followed by a fit). The least detectable magnitude has 5 of them, in the
effect's usual law where it has one: another law's difference from it may show long before the effect does.

    python -m benchmarks.hidden_effects.detectability [PLANT ...]
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.hidden_effects.catalogue import EFFECTS, Effect
from benchmarks.hidden_effects.outside import OUTSIDE
from benchmarks.hidden_effects.plants import RECORDINGS, Array, Motion, Plant, nominal_model, plants
from benchmarks.hidden_effects.truth import HALF_STEP_LEAD, MAX_LATENCY, Diverged, Law, World, plain_parameters

FILE = Path(__file__).with_name("detectable.json")
SIGMAS = 5.0
MOVES = 10
"""Most moves of the plain parameters."""
NEAR = 1.2
"""How far from 5 sigmas a magnitude may be for what is left to be extrapolated."""
EQUIVALENT = 0.99
"""Effects whose projected directions correlate by this much cannot be told apart."""
SAME = 0.999
"""Effects that change the recordings themselves alike by this much are one, as a rotor and a load of a carriage are,
whatever priors the plain parameters have beside which they act."""
SIMILAR = 0.9
"""The table lists others from here up."""
UNSETTLED = 5
"""Samples at the beginning of a stretch that do not count: what a delay shows there happened before."""
FREE = 1e6
"""Standard deviations of the sensors' noise to which a start is known beforehand: as good as not at all. (A start that
is known lets a shifted reading show where it shifts the start as well.)"""


@dataclass(frozen=True)
class Stretch:
    """A piece of a recording that is predicted in one go.

    Attributes:
        motion: up to its end.
        commands: as logged in the unchanged system.
        first: sample at which the simulation starts.
        start: state there; None: set down at rest, the lead simulated too.
    """

    motion: Motion
    commands: Array
    first: int
    start: tuple[Array, Array] | None


def reduced(vector: Array, nuisance: Array) -> Array:
    """(I + A A')^-1/2 v: what nuisances of unit variance leave of a whitened vector (n,) or of columns (n, k).

    Args:
        vector: (n,) or (n, k).
        nuisance: A (n, p).
    """
    u, s, _ = np.linalg.svd(nuisance, full_matrices=False)
    shrink = 1 - 1 / np.sqrt(1 + s**2)
    return vector - (u * shrink) @ (u.T @ vector)


class Observability:
    """The recordings of one plant with nothing hidden, and how a hidden law would show in them."""

    def __init__(self, plant: Plant, seed: int = 0):
        self.plant = plant
        self._plain = {"latency": MAX_LATENCY}
        self._stretches = self._cut(np.random.default_rng(seed))
        self._base = self._columns(())
        starts = self._start_sensitivity()
        self._starts = starts
        self._deviations = plain_parameters(plant)
        # All of its range is there to undo a delay: in a system whose latency is the shortest, any longer one may do.
        longest = (MAX_LATENCY - HALF_STEP_LEAD) / self._deviations["latency"]
        self._furthest = np.array([longest if name == "latency" else 3.0 for name in self._deviations])
        self._slopes = np.stack([self._slope(unit) for unit in np.eye(len(self._deviations))], axis=1)

    def direction(self, law: Law) -> tuple[Array, Array]:
        """Change of all recordings that a law makes and no plain parameters undo; its norm is in standard deviations.

        With it comes the whole change, no plain parameter moved.

        The plain parameters are fitted with the law in (Gauss-Newton, Broyden's update): taken as linear, what is
        left of a load of a few per cent is its own curvature. Their moves, in prior deviations, stand behind the
        whitened changes, so that two directions' product is d1' (Sigma + A A')^-1 d2 where all is linear.

        Raises:
            Diverged: where the law makes the simulation run away.
        """
        slopes, x = self._slopes.copy(), np.zeros(len(self._deviations))
        whole = change = self._changed((law,), x)
        best = np.r_[change, x]
        for _ in range(MOVES):
            normal = slopes.T @ slopes + np.eye(len(x))
            following = np.clip(x - np.linalg.solve(normal, slopes.T @ change + x), -self._furthest, self._furthest)
            move, x = following - x, following
            before, change = change, self._changed((law,), x)
            slopes += np.outer(change - before - slopes @ move, move) / max(float(move @ move), 1e-12)
            gained = np.linalg.norm(best) - np.hypot(np.linalg.norm(change), np.linalg.norm(x))
            if gained > 0:
                best = np.r_[change, x]
            if gained < 0.005 * np.linalg.norm(best):
                break
        return best, whole

    def _cut(self, rng: np.random.Generator) -> list[Stretch]:
        world, stretches = World(self.plant, (), self._plain), []
        for i in range(self.plant.analysed):
            motion = self.plant.motion(i, rng)
            samples = len(motion.reference) - motion.lead
            run = world.run(motion, rng.normal(size=(samples, len(self.plant.columns))) * self.plant.sigma)
            if self.plant.window is None:
                stretches.append(Stretch(motion, run.commands, 0, None))
                continue
            length = round(self.plant.window * self.plant.rate)
            for first in range(0, samples - length, length):
                end = motion.lead + first + length + 1
                piece = Motion(motion.reference[:end], motion.lead, motion.qpos)
                stretches.append(
                    Stretch(piece, run.commands[:end], motion.lead + first, (run.qpos[first], run.qvel[first]))
                )
        return stretches

    def _columns(self, laws: Sequence[Law], plain: dict[str, float] | None = None) -> list[Array]:
        world = World(self.plant, laws, self._plain if plain is None else plain)
        return [self._shown(world, stretch) for stretch in self._stretches]

    @staticmethod
    def _shown(world: World, stretch: Stretch, shift: tuple[Array, Array] | None = None) -> Array:
        run = world.run(
            stretch.motion, commands=stretch.commands, first=stretch.first, start=stretch.start, shift=shift
        )
        return run.columns[0 if stretch.start is None else UNSETTLED :]

    def _changed(self, laws: Sequence[Law], moved: Array) -> Array:
        """Whitened change of all columns under laws and with plain parameters moved by so many deviations, (n,).

        What is analysed counts for all recordings.
        """
        moves = {name: move * sd for move, (name, sd) in zip(moved, self._deviations.items(), strict=True)}
        plain = {name: self._plain.get(name, 0.0) + move for name, move in moves.items()}
        changes = np.concatenate(self._whitened(self._columns(laws, plain)))
        return changes * np.sqrt(RECORDINGS / self.plant.analysed)

    def _slope(self, unit: Array, step: float = 0.1) -> Array:
        """Derivative by a plain parameter, over a tenth of its deviation from both sides.

        Over the whole, the curvature, hundreds of sigmas where noise is small, would count as what no plain parameter
        explains.
        """
        return (self._changed((), step * unit) - self._changed((), -step * unit)) / (2 * step)

    def _start_sensitivity(self) -> list[Array]:
        """Per stretch, the change of the (whitened, flattened) columns by each number of the start, prior-scaled."""
        model = nominal_model(self.plant.name)
        nv = model.nv
        unsure = [d for d in range(nv) if not model.joint(model.dof_jntid[d]).name.startswith(self.plant.exact)]
        position = FREE * self.plant.noise["qpos"]
        deviation = np.r_[np.full(nv, position), np.full(nv, position * self.plant.rate / 5)]
        world, step = World(self.plant, (), self._plain), 2 / FREE
        changes = []
        for i in (*unsure, *(nv + dof for dof in unsure)):
            shift = np.eye(2 * nv)[i] * deviation * step
            shown = [self._shown(world, s, (shift[:nv], shift[nv:])) for s in self._stretches]
            changes.append([self._scaled(columns, b) / step for columns, b in zip(shown, self._base, strict=True)])
        return [np.stack(parts, axis=1) for parts in zip(*changes, strict=True)]

    def _scaled(self, columns: Array, base: Array) -> Array:
        return np.ravel((columns - base) / self.plant.sigma)

    def _whitened(self, columns: list[Array]) -> list[Array]:
        """Changes against the base per stretch, in noise units, what uncertain starts would explain shrunk."""
        return [reduced(self._scaled(c, b), s) for c, b, s in zip(columns, self._base, self._starts, strict=True)]


@dataclass(frozen=True)
class Found:
    """What one magnitude does.

    Attributes:
        magnitude: that was tried.
        sigmas: that it makes.
        direction: of the change, with all that plain parameters could undo taken away.
        change: the whole of it.
        least: the magnitude that makes 5, by this one and others tried.
    """

    magnitude: float
    sigmas: float
    direction: Array
    change: Array
    least: float = np.nan

    @property
    def off(self) -> float:
        """Logarithm of how far from 5 sigmas."""
        return float(np.log(max(self.sigmas, 1e-9) / SIGMAS))


def least_detectable(
    observability: Observability, effect: Effect, place: str, same_form: bool, guess: float | None = None
) -> Found | None:
    """What a magnitude that makes about 5 sigmas does, or the largest usable one; None where that makes nothing.

    Args:
        observability: of the plant.
        effect: one of the catalogue's.
        place: ``kind:name``.
        same_form: which variant.
        guess: a magnitude to start from; the effect's own by default.

    """
    plant, name = observability.plant, place.split(":")[1]
    limit = effect.limit(plant, name)
    magnitude = min(effect.guess(plant, name) if guess is None else guess, limit)
    tried: list[Found] = []

    def shown(magnitude: float) -> tuple[Array, Array]:
        law, _ = effect.build(plant, name, magnitude, same_form, np.random.default_rng(0))
        return observability.direction(law)

    traces = shown(0.0) if effect.sets_apart else (np.zeros(1), np.zeros(1))
    for _ in range(8):
        try:
            direction, change = (of - trace for of, trace in zip(shown(magnitude), traces, strict=True))
        except Diverged:
            limit = magnitude / 2
            magnitude /= 3
            continue
        tried.append(Found(magnitude, float(np.linalg.norm(direction)), direction, change))
        following = min(_next_magnitude(tried), limit)
        if abs(tried[-1].off) < np.log(NEAR) or abs(following / magnitude - 1) < 0.01:
            break
        magnitude = following
    best = min(tried, key=lambda f: abs(f.off), default=None)
    return replace(best, least=_next_magnitude(tried)) if best is not None and best.sigmas > 0.1 else None


def _next_magnitude(tried: Sequence[Found]) -> float:
    """Towards 5 sigmas: by proportion, or between the nearest on both sides, as thresholds are no proportions."""
    low = max((f for f in tried if f.off < 0), key=lambda f: f.magnitude, default=None)
    high = min((f for f in tried if f.off >= 0), key=lambda f: f.magnitude, default=None)
    if low is not None and high is not None:
        share = float(np.clip(low.off / (low.off - high.off), 0.2, 0.8))
        return float(low.magnitude * (high.magnitude / low.magnitude) ** share)
    return tried[-1].magnitude * float(np.clip(np.exp(-tried[-1].off), 1 / 30, 30 if tried[-1].sigmas > 0.1 else 2))


def analyse(plant: Plant, before: dict[str, dict[str, Any]], kept: Path) -> dict[str, dict[str, Any]]:
    """Least detectable magnitudes and look-alikes of everything in a plant, keyed as :func:`key` says.

    Args:
        plant: to be analysed.
        before: an earlier answer, to start from.
        kept: folder of what is finished; an analysis that was stopped goes on from it.
    """
    observability = Observability(plant)
    found: dict[str, Found] = {}
    kept.mkdir(parents=True, exist_ok=True)
    for effect in (*EFFECTS.values(), *OUTSIDE.values()):
        places = effect.places(plant)
        for place in places if effect.name in EFFECTS else places[-2:]:
            for same_form in effect.forms if effect.forms_differ else effect.forms[-1:]:
                name = key(effect, place, same_form)
                file = kept / f"{name}.npz"
                if not file.exists():
                    guess = before.get(name, {}).get("least")
                    _keep(file, least_detectable(observability, effect, place, same_form, guess))
                answer = _kept(file)
                if answer is not None:
                    found[name] = answer
                    print(f"{plant.name}: {name}: {answer.magnitude:.4g} makes {answer.sigmas:.2f} sigma", flush=True)
    projected, whole = (
        _correlation(vectors) for vectors in zip(*((f.direction, f.change) for f in found.values()), strict=True)
    )
    correlation = np.where(whole >= SAME, whole, projected)
    keys = list(found)
    result: dict[str, dict[str, Any]] = {}
    for i, (name, answer) in enumerate(found.items()):
        alike: dict[str, float] = {}
        for j in np.argsort(-correlation[i]):
            other = keys[j].split("#")[0]
            if other == name.split("#")[0] or other.split("@")[0] not in EFFECTS or correlation[i, j] < SIMILAR:
                continue
            alike.setdefault(other, round(float(correlation[i, j]), 4))
        result[name] = {
            "least": answer.least,
            "tried": answer.magnitude,
            "sigmas": round(answer.sigmas, 3),
            "alike": alike,
        }
    return result


def _keep(file: Path, found: Found | None) -> None:
    """Writes an answer; one that is nothing as an empty archive. A file is whole or not there."""
    partial = file.with_suffix(".partial.npz")
    np.savez(partial, **({} if found is None else vars(found)))
    partial.replace(file)


def _kept(file: Path) -> Found | None:
    with np.load(file) as archive:
        if not archive.files:
            return None
        magnitude, sigmas, least = (float(archive[name]) for name in ("magnitude", "sigmas", "least"))
        return Found(magnitude, sigmas, archive["direction"], archive["change"], least)


def _correlation(vectors: Sequence[Array]) -> Array:
    """Of each with each, without signs."""
    units = np.stack([v / np.linalg.norm(v) for v in vectors])
    return np.asarray(np.abs(units @ units.T))


def key(effect: Effect, place: str, same_form: bool) -> str:
    """Name of an entry of the table: ``effect@place``, and the form where that matters."""
    return f"{effect.name}@{place}" + ("#same" if same_form and effect.forms_differ else "")


def main() -> None:
    parser = argparse.ArgumentParser(description="Compute the least detectable magnitudes.")
    parser.add_argument("plants", nargs="*", default=None)
    parser.add_argument("--kept", type=Path, default=Path("out/detectable"), help="what is finished, till the end")
    arguments = parser.parse_args()
    for name in arguments.plants or plants():
        table = json.loads(FILE.read_text()) if FILE.exists() else {}
        answer = analyse(plants()[name], table.get(name, {}), arguments.kept / name)
        table = json.loads(FILE.read_text()) if FILE.exists() else {}
        FILE.write_text(json.dumps(table | {name: answer}, indent=1) + "\n")
        shutil.rmtree(arguments.kept / name)


if __name__ == "__main__":
    main()
