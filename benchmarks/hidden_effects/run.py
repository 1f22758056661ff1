"""Run the gap workflow on cases, which is given their folder and nothing else.

    python -m benchmarks.hidden_effects.run --cases DIR --out RESULTS [--count 20]

Cases that have a result are kept, so that a run that was stopped goes on. A case that fails is told and skipped.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

from simopt_envs.gap import find_gap
from simopt_envs.measured import Recording, load_recording


def recordings(case: Path) -> list[Recording]:
    """The recordings of a case, those that it says begin at rest marked."""
    told = case / "at_rest.txt"
    at_rest = told.read_text().split() if told.exists() else []
    return [replace(load_recording(path), at_rest=path.name in at_rest) for path in sorted(case.glob("rec_*.csv"))]


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=Path, required=True, help="folder of cases, without their labels")
    parser.add_argument("--out", type=Path, required=True, help="folder for a gap.json of each case")
    parser.add_argument("--count", type=int, default=None, help="the first so many cases by name")
    arguments = parser.parse_args()
    cases = sorted(path for path in arguments.cases.iterdir() if (path / "model.xml").exists())[: arguments.count]
    if not cases:
        parser.error(f"there is no case in {arguments.cases}")
    began, done = time.monotonic(), 0
    for i, case in enumerate(cases):
        target = arguments.out / case.name / "gap.json"
        if target.exists():
            continue
        try:
            gap = find_gap(case / "model.xml", recordings(case))
        except (ValueError, RuntimeError) as error:
            print(f"{i + 1}/{len(cases)} {case.name}: FAILED: {error}", flush=True)
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        partial = target.with_suffix(".part")
        partial.write_text(json.dumps(gap.to_dict(), indent=1) + "\n")
        partial.replace(target)
        done += 1
        left = (time.monotonic() - began) / done * (len(cases) - i - 1)
        print(f"{i + 1}/{len(cases)} {case.name}: {gap.verdict}, {gap.seconds:.0f} s, {left:.0f} s left", flush=True)


if __name__ == "__main__":
    main()
