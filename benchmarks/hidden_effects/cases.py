"""Which cases exist: plant, what is hidden where and how large, all following from the split alone."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np

from benchmarks.hidden_effects.catalogue import EFFECTS, Effect, joint_of
from benchmarks.hidden_effects.detectability import EQUIVALENT, FILE, key
from benchmarks.hidden_effects.outside import OUTSIDE
from benchmarks.hidden_effects.plants import plants

Kind = Literal["single", "null", "outside", "double"]
KINDS: tuple[Kind, ...] = ("single", "null", "outside", "double")
FIRST_SEED = {"dev": 0, "test": 38000}
"""Split -> its first seed. Seeds from 1000, 2000, ... 36000 on were earlier test splits, so they count as seen; with
which commit each was run is in ``docs/hidden_effects.md``.
"""
LEVELS = (10.0, 3.0)
"""Magnitudes of single effects, in least detectable ones."""
_OF_TRANSMISSION = {"backlash", "joint_elasticity"}  # a joint has one, which the law of either replaces


@dataclass(frozen=True)
class Hidden:
    """One hidden effect.

    Attributes:
        effect: its name.
        place: ``kind:name``.
        magnitude: as the catalogue's builders take it.
        same_form: whether the law is the usual one.
        ratio: magnitude in least detectable ones.
        capped: whether the wanted ratio would have made the system unusable.
    """

    effect: str
    place: str
    magnitude: float
    same_form: bool
    ratio: float
    capped: bool


@dataclass(frozen=True)
class Case:
    """One case; everything random in it follows from the seed."""

    seed: int
    plant: str
    kind: Kind
    hidden: tuple[Hidden, ...] = ()

    @property
    def name(self) -> str:
        """Folder name; it tells nothing."""
        return hashlib.sha256(f"hidden effects {self.seed}".encode()).hexdigest()[:10]


@cache
def table() -> dict[str, dict[str, dict[str, object]]]:
    """The least detectable magnitudes by plant and ``effect@place``.

    Raises:
        FileNotFoundError: before ``python -m benchmarks.hidden_effects.detectability`` has run.
    """
    if not FILE.exists():
        raise FileNotFoundError(f"{FILE} is missing: run python -m benchmarks.hidden_effects.detectability")
    return dict(json.loads(FILE.read_text()))


def cases(split: str, among: Sequence[str] | None = None) -> list[Case]:
    """All cases of a split, interleaved so that any first part of them holds every kind.

    Args:
        split: ``"dev"`` or ``"test"``.
        among: names of plants; all that the table has by default. An effect that has no place in any is left out.

    Raises:
        ValueError: for an unknown split or plant, and where an effect can be detected in none of the plants.
    """
    if split not in FIRST_SEED:
        raise ValueError(f"unknown split {split!r}; there are {', '.join(FIRST_SEED)}")
    first, shift = FIRST_SEED[split], list(FIRST_SEED).index(split)
    names = [name for name in plants() if name in (table() if among is None else among)]
    if among is not None and (unknown := set(among) - set(table())):
        raise ValueError(f"no such plants: {', '.join(sorted(unknown))}; there are {', '.join(table())}")
    inside, outside = (
        [effect for effect in effects.values() if any(effect.places(plants()[name]) for name in names)]
        for effects in (EFFECTS, OUTSIDE)
    )
    groups: list[list[Case]] = [[], [], [], []]
    for i, effect in enumerate(inside):
        for turn, level in enumerate(LEVELS):
            same_form = effect.forms[(i + turn + shift) % len(effect.forms)]
            groups[0].append(_single(first + 2 * i + turn, "single", effect, level, same_form, names, i + turn + shift))
    for i in range(10):
        groups[1].append(Case(first + 100 + i, names[(i + shift) % len(names)], "null"))
        effect = outside[(i + shift) % len(outside)]
        groups[2].append(_single(first + 200 + i, "outside", effect, LEVELS[0], False, names, i + shift))
        groups[3].append(_double(first + 300 + i, names[(i + shift) % len(names)]))
    groups[0] = [groups[0][i] for i in np.random.default_rng(first).permutation(len(groups[0]))]
    order = np.concatenate([np.linspace(0, 1, len(group), endpoint=False) for group in groups])
    flat = [case for group in groups for case in group]
    spread = [flat[i] for i in np.argsort(order, kind="stable")]
    return spread


def equivalents(case: Case) -> list[str]:
    """``effect@place`` that no data of these recordings could tell from what is hidden (for each hidden effect)."""
    return [name for hidden in case.hidden for name in _equivalents(case.plant, hidden)]


def _equivalents(plant: str, hidden: Hidden) -> list[str]:
    alike = _entry(plant, hidden)["alike"]
    return [name for name, c in alike.items() if c >= EQUIVALENT] if isinstance(alike, dict) else []


def _entry(plant: str, hidden: Hidden) -> dict[str, object]:
    return table()[plant][key((EFFECTS | OUTSIDE)[hidden.effect], hidden.place, hidden.same_form)]


def _options(plant: str, effect: Effect, same_form: bool, level: float) -> list[Hidden]:
    """The effect at every place of a plant where it can be detected at all."""
    options = []
    for place in effect.places(plants()[plant]):
        entry = table()[plant].get(key(effect, place, same_form))
        if entry is None:
            continue
        least = float(entry["least"])  # type: ignore[arg-type]
        limit = effect.limit(plants()[plant], place.split(":")[1])
        magnitude = min(level * least, limit)
        if magnitude >= least:
            capped = bool(level * least > limit)
            options.append(Hidden(effect.name, place, magnitude, same_form, magnitude / least, capped))
    return options


def _single(seed: int, kind: Kind, effect: Effect, level: float, same_form: bool, names: list[str], turn: int) -> Case:
    """The effect in the next plant in turn that can show it, uncapped if any can."""
    rng = np.random.default_rng([seed, 9])
    options = {name: _options(name, effect, same_form, level) for name in names}
    for capped in (False, True):
        for name in [*names[turn % len(names) :], *names[: turn % len(names)]]:
            usable = [h for h in options[name] if h.capped == capped]
            if usable:
                return Case(seed, name, kind, (usable[rng.integers(len(usable))],))
    raise ValueError(f"{effect.name} is detectable in none of {', '.join(names)}")


def _double(seed: int, plant: str) -> Case:
    """Two different effects at ten times the least detectable magnitude that do not look alike."""
    rng = np.random.default_rng([seed, 9])
    while True:
        chosen: list[Hidden] = []
        for name in rng.choice(list(EFFECTS), 2, replace=False):
            effect = EFFECTS[name]
            same_form = effect.forms[rng.integers(len(effect.forms))]
            options = [h for h in _options(plant, effect, same_form, LEVELS[0]) if not h.capped]
            if options:
                chosen.append(options[rng.integers(len(options))])
        if len(chosen) < 2 or _are_one(plant, chosen):
            continue
        if f"{chosen[1].effect}@{chosen[1].place}" not in _entry(plant, chosen[0])["alike"]:  # type: ignore[operator]
            return Case(seed, plant, "double", tuple(chosen))


def _are_one(plant: str, pair: Sequence[Hidden]) -> bool:
    """Whether two effects are one, whatever their sizes.

    A joint has one transmission, and a constant force beside a linear spring only moves its rest position.
    """
    if len({h.place for h in pair}) == 1 and {h.effect for h in pair} == _OF_TRANSMISSION:
        return True
    for spring, other in (pair, pair[::-1]):
        if spring.effect == "joint_spring" and spring.same_form:
            names = [f"{other.effect}@{other.place}", *_equivalents(plant, other)]
            drives = [name.split(":")[1] for name in names if name.startswith("actuator_bias@")]
            joints = [joint_of(plants()[plant], drive) for drive in drives]
            if spring.place.split(":")[1] in joints:
                return True
    return False
