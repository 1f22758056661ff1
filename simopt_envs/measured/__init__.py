"""Measured data: recordings of real systems, what is wrong with them, and how far a model is from them."""

from simopt_envs.measured.audit import audit, audited
from simopt_envs.measured.logs import Inspection, inspect_log, replay_log
from simopt_envs.measured.mapping import LogMapping, Source
from simopt_envs.measured.readers import load_recording, load_recordings
from simopt_envs.measured.recording import Finding, Recording
from simopt_envs.measured.replay import Replay, replay, start_sensitivity
from simopt_envs.measured.states import States, estimate_states
from simopt_envs.measured.trajectory import Trajectory
from simopt_envs.measured.windows import Windows, WindowSimulator, cut_windows, simulate_windows

__all__ = [
    "Finding",
    "Inspection",
    "LogMapping",
    "Recording",
    "Replay",
    "Source",
    "States",
    "Trajectory",
    "WindowSimulator",
    "Windows",
    "audit",
    "audited",
    "cut_windows",
    "estimate_states",
    "inspect_log",
    "load_recording",
    "load_recordings",
    "replay",
    "replay_log",
    "simulate_windows",
    "start_sensitivity",
]
