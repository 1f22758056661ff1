"""MuJoCo's profiler rests while many worlds step, and works as before for everybody else."""

from __future__ import annotations

from collections.abc import Callable
from threading import Thread

import gymnasium as gym
import mujoco
import pytest

from simopt_envs.physics.profiler import PROFILER_RESTS

pytestmark = pytest.mark.skipif(int(mujoco.__version__.split(".")[0]) < 4, reason="the profiler is MuJoCo 4's")


@pytest.fixture(scope="module")
def timed() -> Callable[[], bool]:
    """Whether a step is timed."""
    model = mujoco.MjModel.from_xml_string("<mujoco/>")

    def timed() -> bool:
        data = mujoco.MjData(model)
        mujoco.mj_step(model, data)
        return data.timer[mujoco.mjtTimer.mjTIMER_STEP].duration > 0

    return timed


def test_no_step_is_timed_meanwhile(timed):
    with PROFILER_RESTS:
        assert not timed()
        with PROFILER_RESTS:
            pass
        assert not timed()
    assert timed()


def test_the_last_of_several_threads_lets_it_go_on(timed):
    def enter_and_leave() -> None:
        with PROFILER_RESTS:
            pass

    with PROFILER_RESTS:
        other = Thread(target=enter_and_leave)
        other.start()
        other.join()
        assert not timed()
    assert timed()


def test_steps_are_timed_again_after_an_error(timed):
    with pytest.raises(RuntimeError), PROFILER_RESTS:
        raise RuntimeError
    assert timed()


def test_worlds_are_not_timed_and_whatever_steps_afterwards_is(timed, monkeypatch):
    from mujoco.batch import Batch

    seen, step = [], Batch.step

    def observed(*args, **kwargs):
        seen.append(timed())
        return step(*args, **kwargs)

    monkeypatch.setattr(Batch, "step", observed)
    env = gym.make_vec("SimOpt/Drawer-v0", num_envs=2)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()
    assert seen == [False]
    assert timed()
