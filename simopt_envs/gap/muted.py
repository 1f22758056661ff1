"""MuJoCo while a search runs: it writes no warnings."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import mujoco


@contextmanager
def muted() -> Iterator[None]:
    """Keep MuJoCo from writing of each simulation that runs away: a search tries some, and notices itself.

    It is the whole process', and there again afterwards.
    """
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
