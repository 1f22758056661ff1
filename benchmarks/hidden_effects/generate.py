"""Write cases: a folder with the nominal model and recordings for the workflow, a label elsewhere for the score.

Beside those of a registered task, ``at_rest.txt`` names the recordings that begin at rest.

    python -m benchmarks.hidden_effects.generate --split dev --out DIR --labels OTHER_DIR [--only single]
        [--count 20] [--plants two_link arm3]

Cases that are already there are kept.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.hidden_effects.cases import FIRST_SEED, KINDS, Case, cases, equivalents
from benchmarks.hidden_effects.catalogue import EFFECTS
from benchmarks.hidden_effects.outside import OUTSIDE
from benchmarks.hidden_effects.plants import RECORDINGS, Array, begins_in_motion, nominal_model, plants
from benchmarks.hidden_effects.truth import Diverged, Law, World, draw_plain


def write_case(case: Case, out: Path, labels: Path) -> Path:
    """Simulate a case and write it; the label last, so that a label means a complete case.

    Where the hidden effect makes the system run away its magnitude is halved until it does not.

    Returns:
        The case's folder.
    """
    while True:
        try:
            tables, effects, plain = simulate(case)
            break
        except Diverged:
            milder = [replace(h, magnitude=h.magnitude / 2, ratio=h.ratio / 2, capped=True) for h in case.hidden]
            case = replace(case, hidden=tuple(milder))
    folder = out / case.name
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "model.xml").write_text(plants()[case.plant].xml.lstrip())
    header = ",".join(column_names(case.plant))
    for i, table in enumerate(tables):
        np.savetxt(folder / f"rec_{i}.csv", table, fmt="%.8g", delimiter=",", header=header, comments="")
    if plants()[case.plant].says_rest:
        resting = [f"rec_{i}.csv\n" for i in range(RECORDINGS) if not begins_in_motion(i)]
        (folder / "at_rest.txt").write_text("".join(resting))
    labels.mkdir(parents=True, exist_ok=True)
    label = {
        "case": case.name,
        "seed": case.seed,
        "plant": case.plant,
        "kind": case.kind,
        "effects": effects,
        "ratio": min((h.ratio for h in case.hidden), default=None),
        "detectable": bool(case.hidden) and all(h.ratio >= 1 for h in case.hidden),
        "equivalents": equivalents(case),
        "plain": plain,
    }
    (labels / f"{case.name}.json").write_text(json.dumps(label, indent=1) + "\n")
    return folder


def column_names(plant: str) -> list[str]:
    """Columns of a plant's recordings."""
    model = nominal_model(plant)
    return ["time", *(f"ctrl/{model.actuator(i).name}" for i in range(model.nu)), *plants()[plant].columns]


def simulate(case: Case) -> tuple[list[Array], list[dict[str, object]], dict[str, float]]:
    """The case's recordings as tables in the order of the columns, its effects for the label, its plain errors."""
    plant = plants()[case.plant]
    plain_rng, motion_rng, noise_rng, hidden_rng = (np.random.default_rng([case.seed, k]) for k in range(4))
    plain = draw_plain(plant, plain_rng)
    laws: list[Law] = []
    effects: list[dict[str, object]] = []
    for hidden in case.hidden:
        effect = (EFFECTS | OUTSIDE)[hidden.effect]
        law, parameters = effect.build(
            plant, hidden.place.split(":")[1], hidden.magnitude, hidden.same_form, hidden_rng
        )
        laws.append(law)
        effects.append(
            {
                "effect": hidden.effect,
                "where": hidden.place,
                "parameters": {name: float(value) for name, value in parameters.items()},
                "same_form": hidden.same_form,
                "ratio": hidden.ratio,
                "capped": hidden.capped,
            }
        )
    world = World(plant, laws, plain)
    tables = []
    for i in range(RECORDINGS):
        motion = plant.motion(i, motion_rng)
        samples = len(motion.reference) - motion.lead
        noise = noise_rng.normal(size=(samples, len(plant.columns))) * plant.sigma
        run = world.run(motion, noise)
        stamps = np.arange(samples) / plant.rate
        tables.append(np.column_stack([stamps, run.commands[motion.lead :], run.columns + noise]))
    return tables, effects, plain


def main() -> None:
    parser = argparse.ArgumentParser(description="Write the cases of a split.")
    parser.add_argument("--split", choices=list(FIRST_SEED), required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--labels", type=Path, required=True)
    parser.add_argument("--only", choices=KINDS)
    parser.add_argument("--count", type=int)
    parser.add_argument("--plants", nargs="+", help="all by default")
    arguments = parser.parse_args()
    if arguments.labels.resolve().is_relative_to(arguments.out.resolve()):
        parser.error(f"labels {arguments.labels} must not lie inside the cases' folder {arguments.out}")
    chosen = [case for case in cases(arguments.split, arguments.plants) if arguments.only in (None, case.kind)][
        : arguments.count
    ]
    for i, case in enumerate(chosen, 1):
        if (arguments.labels / f"{case.name}.json").exists():
            continue
        began = time.perf_counter()
        write_case(case, arguments.out, arguments.labels)
        print(f"{i}/{len(chosen)} {case.name}: {time.perf_counter() - began:.1f} s", flush=True)


if __name__ == "__main__":
    main()
