"""What a step costs with MuJoCo's built-in profiler, and without, as where many worlds step.

    python -m benchmarks.profiler

Steps of ``mj_step`` per CPU-second of the hidden effects' plants, with the one and without, in turn in one run.
"""

from __future__ import annotations

import time

import mujoco
import numpy as np

from benchmarks.hidden_effects.plants import nominal_model, plants
from simopt_envs.physics.profiler import PROFILER_RESTS

STEPS = 20_000
REPETITIONS = 7


def rate(model: mujoco.MjModel) -> float:
    """Steps per CPU-second."""
    data = mujoco.MjData(model)
    start = time.process_time()
    mujoco.mj_step(model, data, STEPS)
    return STEPS / (time.process_time() - start)


def main() -> None:
    print("| plant | steps / CPU-s, with the profiler | without | its share of a step |\n|---|---|---|---|")
    for name in plants():
        model, pairs = nominal_model(name), []
        for _ in range(REPETITIONS):
            with_it = rate(model)
            with PROFILER_RESTS:
                pairs.append((with_it, rate(model)))
        best = np.max(pairs, axis=0)
        print(f"| {name} | {best[0]:,.0f} | {best[1]:,.0f} | {np.median([1 - a / b for a, b in pairs]):.0%} |")


if __name__ == "__main__":
    main()
