"""Adapting p(ξ) to a real system: the SimOpt loop and its parts."""

from simopt_envs.adaptation.discrepancy import Discrepancy, Verdict
from simopt_envs.adaptation.protocols import Policy, RealSystem, Trainer
from simopt_envs.adaptation.records import Event, Iteration
from simopt_envs.adaptation.replay import ReplaySimulator, window_trajectories
from simopt_envs.adaptation.rollouts import Rollouts
from simopt_envs.adaptation.simopt import SimOpt
from simopt_envs.adaptation.simulator import EnvSimulator, Simulator
from simopt_envs.adaptation.systems import HiddenSystem, RecordedSystem
from simopt_envs.adaptation.updates import CEM, REPS

__all__ = [
    "CEM",
    "REPS",
    "Discrepancy",
    "EnvSimulator",
    "Event",
    "HiddenSystem",
    "Iteration",
    "Policy",
    "RealSystem",
    "RecordedSystem",
    "ReplaySimulator",
    "Rollouts",
    "SimOpt",
    "Simulator",
    "Trainer",
    "Verdict",
    "window_trajectories",
]
