"""MuJoCo's built-in profiler, which rests while many worlds step: nobody reads what it measures there."""

from __future__ import annotations

import ctypes
from importlib import import_module
from threading import Lock
from types import TracebackType

import mujoco


class _ProfilerRests:
    """A context in which no step is timed, of the whole process; it may be entered again, also by other threads.

    The Python package of MuJoCo 4 installs ``mjcb_time``, a clock that every stage of every step reads for
    ``MjData.timer``; of small models that is a third of a step or more (``benchmarks/profiler.py``). Its own
    ``mujoco.set_mjcb_time`` cannot take that away.
    """

    def __init__(self) -> None:
        self._clock, self._lock = _clock(), Lock()
        self._inside = 0
        self._callback: int | None = None

    def __enter__(self) -> None:
        with self._lock:
            if not self._inside:
                self._callback, self._clock.value = self._clock.value, None
            self._inside += 1

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside:
                self._clock.value = self._callback


def _clock() -> ctypes.c_void_p:
    """``mjcb_time``, or, where it is not to be found, a pointer of no effect."""
    try:
        return ctypes.c_void_p.in_dll(ctypes.CDLL(import_module(mujoco.mj_step.__module__).__file__), "mjcb_time")
    except (OSError, ValueError):  # as on Windows, where a library does not pass on what it links to
        return ctypes.c_void_p()


PROFILER_RESTS = _ProfilerRests()
"""``with PROFILER_RESTS:`` steps of MuJoCo are not timed."""
