"""The hidden systems of the experiments, and how SimOpt is run against them."""

from __future__ import annotations

from collections.abc import Mapping

from baselines.commands.demo import TASKS
from baselines.experiments.environments import DRAWER, PEG, PENDULUM, Randomization, partway
from baselines.experiments.settings import Cure, Hidden

SHIFTS = {"5 cm": 0.05, "10 cm": 0.10, "15 cm": 0.15, "22 cm": 0.22}
"""Name -> how far the hidden cabinet stands from where it is thought to be, m."""
PAPER_ITERATIONS = {"15 cm": 3, "22 cm": 5}
"""Of SimOpt, until the paper's drawer opens."""
_MOST_ITERATIONS = 3
QUICK_SEEDS = {"15 cm": 2, "22 cm": 1}
"""Shift -> how many runs of SimOpt the quick set has."""


def drawer(shift: str) -> Hidden:
    """The hidden system of a shift."""
    return {"cabinet_x": SHIFTS[shift]}


def peg(share: float = 1.0) -> Hidden:
    """The demo's hidden system, or one on the way from nominal to it."""
    return partway(PEG, TASKS["swing-peg"][1], share)


PEG_TARGETS = {"near": 0.5, "far": 1.0}
"""Name -> share of the way."""
PENDULUM_HIDDEN: Mapping[str, float] = {"actuator_gain of slide": 6.0}
"""A motor six times as strong as thought."""


def drawer_cure(shift: str, real_rollouts: int = 3, noise: float = 0.002, dropout: float = 0.0) -> Cure:
    """SimOpt, with as many iterations as the paper needed at most."""
    iterations = PAPER_ITERATIONS.get(shift, _MOST_ITERATIONS)
    return Cure(Randomization.default(DRAWER), drawer(shift), iterations, real_rollouts, noise, dropout)


def peg_cure(target: str) -> Cure:
    """SimOpt on the swing-peg, 90 % being enough as in the paper (18 of 20)."""
    return Cure(Randomization.default(PEG), peg(PEG_TARGETS[target]), _MOST_ITERATIONS, enough=0.9)


def pendulum_cure() -> Cure:
    """SimOpt on Gymnasium's pendulum."""
    start = Randomization(PENDULUM, {"actuator_gain of slide": 0.3, "body_mass of *": 0.1, "dof_damping of *": 0.1})
    return Cure(start, PENDULUM_HIDDEN, _MOST_ITERATIONS)
