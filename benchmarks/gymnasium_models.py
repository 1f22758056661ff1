"""The gap workflow on models that were not made for it: Gymnasium's own, with and without a hidden Coulomb friction.

    python -m benchmarks.gymnasium_models [--models reacher swimmer]

Plain parameters are wrong in either case (masses by 2 %, damping by 10 %), the hidden system takes half the step, and
positions have 1 mrad (1 mm) of noise. It is MuJoCo too, though: what systems of other laws and code show is in
``benchmarks/hidden_effects``.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np

from simopt_envs.gap import find_gap
from simopt_envs.measured import Recording

_ASSETS = Path(gym.__file__).parent / "envs" / "mujoco" / "assets"
_PERIOD, _SECONDS, _SETTLED = 0.01, 4.0, 0.3  # s: of a sample, of a recording, and of its beginning that is left out
_RECORDINGS, _NOISE = 8, 1e-3
_WAVES = 5  # of each command


@dataclass(frozen=True)
class Case:
    """A model, and what is hidden in it.

    Attributes:
        swing: about the largest command of each actuator.
        joint: has the friction.
        friction: its size [N m].
        unseen: joints of no interest, which no column shows.
    """

    swing: tuple[float, ...]
    joint: str
    friction: float
    unseen: tuple[str, ...] = ()


CASES = {
    "reacher": Case((0.04, 0.02), "joint1", 0.3, ("target_x", "target_y")),
    "swimmer": Case((0.5, 0.5), "motor1_rot", 5.0),
    "pusher_v5": Case(
        (1, 1, 1, 0.5, 0.3, 0.3, 0.3),
        "r_elbow_flex_joint",
        0.2,
        ("obj_slidey", "obj_slidex", "goal_slidey", "goal_slidex"),
    ),
    "half_cheetah": Case((0.3,) * 6, "fthigh", 2.0),
}


def nominal(model: str) -> mujoco.MjSpec:
    """Gymnasium's model; its actuators, which mostly have no name, are given one."""
    spec = mujoco.MjSpec.from_file(str(_ASSETS / f"{model}.xml"))
    for i, actuator in enumerate(spec.actuators):
        actuator.name = actuator.name or f"motor{i}"
    return spec


def hidden(spec: mujoco.MjSpec, case: Case, friction: float) -> mujoco.MjModel:
    """The system that is recorded."""
    rng, spec = np.random.default_rng(0), spec.copy()
    spec.joint(case.joint).frictionloss = friction
    spec.option.timestep /= 2
    model = spec.compile()
    model.body_mass *= (factor := 1 + 0.02 * rng.standard_normal(model.nbody))
    model.body_inertia *= factor[:, None]
    model.dof_damping *= 1 + 0.1 * rng.standard_normal(model.nv)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def record(model: mujoco.MjModel, case: Case, seed: int) -> Recording:
    """A recording under sums of sines, as a log of it would be."""
    rng, data = np.random.default_rng(seed), mujoco.MjData(model)
    at = np.arange(0, _SECONDS, _PERIOD)
    frequency, phase = rng.uniform(0.15, 1.5, (_WAVES, model.nu)), rng.uniform(0, 2 * np.pi, (_WAVES, model.nu))
    waves = rng.uniform(0.2, 0.6, (_WAVES, model.nu)) * np.sin(2 * np.pi * frequency * at[:, None, None] + phase)
    commands, positions = waves.sum(axis=1) * case.swing, []
    for command in commands:
        positions.append(data.qpos.copy())
        data.ctrl[:] = command
        mujoco.mj_step(model, data, round(_PERIOD / model.opt.timestep))
    measured = np.array(positions) + rng.normal(0, _NOISE, (len(at), model.nq))
    joints = (model.joint(i) for i in range(model.njnt))
    columns = {f"ctrl/{model.actuator(i).name}": commands[:, i] for i in range(model.nu)}
    columns |= {f"qpos/{j.name}": measured[:, j.qposadr[0]] for j in joints if j.name not in case.unseen}
    return Recording(at, columns, f"run_{seed}").select(start=_SETTLED)


def row(model: str, case: Case, friction: float) -> str:
    """A row of the table."""
    spec = nominal(model)
    system = hidden(spec, case, friction)
    gap = find_gap(spec, [record(system, case, seed) for seed in range(_RECORDINGS)])
    named = "<br>".join(map(str, gap.effects))
    what = f"{friction:g} N m at {case.joint}" if friction else "nothing"
    left = 1 + gap.explanation.null.excess, 1 + gap.explanation.final.excess
    return f"| {model} | {what} | {gap.verdict} | {named} | {left[0]:.3g} → {left[1]:.3g} | {gap.seconds:.0f} |"


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", nargs="+", choices=CASES, default=list(CASES))
    print("| model | hidden | verdict | named, 95 % interval | held-out error², noise = 1 | seconds |")
    print("|---|---|---|---|---|---|")
    for model in parser.parse_args().models:
        for friction in (CASES[model].friction, 0.0):
            print(row(model, CASES[model], friction), flush=True)


if __name__ == "__main__":
    main()
