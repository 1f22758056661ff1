"""MuJoCo while a search runs: it writes no warnings, and its built-in profiler rests."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module

import mujoco


@contextmanager
def unobserved() -> Iterator[None]:
    """Keep MuJoCo from writing of each simulation that runs away, and from timing the stages of each step.

    A search tries some that run away, and notices itself. The Python package of MuJoCo 4 installs ``mjcb_time``, a
    clock that every stage of every step reads for ``MjData.timer``; of small models that is a third of a step or more
    (``benchmarks/profiler.py``). It is the whole process', and there again afterwards.
    """
    before = mujoco.get_mju_user_warning()
    clock = _clock()
    timer = clock.value
    mujoco.set_mju_user_warning(lambda _: None)
    clock.value = None
    try:
        yield
    finally:
        clock.value = timer
        mujoco.set_mju_user_warning(before)


def _clock() -> ctypes.c_void_p:
    """``mjcb_time``, which ``mujoco.set_mjcb_time`` cannot take away: where it is not to be found, one of no effect."""
    try:
        return ctypes.c_void_p.in_dll(ctypes.CDLL(import_module(mujoco.mj_step.__module__).__file__), "mjcb_time")
    except (OSError, ValueError):  # as on Windows, where a library does not pass on what it links to
        return ctypes.c_void_p()
