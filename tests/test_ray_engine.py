"""The engines: the same results from this process and from Ray's workers, also where one of them is killed."""

from __future__ import annotations

import json
import os
import signal
import socket
import sys
import time
from dataclasses import dataclass

import mujoco
import numpy as np
import pytest
from conftest import needs_batch, needs_effects
from gap_plant import MODEL, record
from test_cli import PENDULUM as PENDULUM_MODEL
from test_cli import XI
from test_replay_adaptation import SPACE as PENDULUM
from test_replay_adaptation import model, windows  # noqa: F401 - fixtures
from toy_reach import SPACE, PushPolicy, ReachEnv

from baselines.cli import main
from simopt_envs.adaptation import EnvSimulator, HiddenSystem, ReplaySimulator, window_trajectories
from simopt_envs.engine import FailedTasksError, LocalEngine, RayEngine, ThreadEngine
from simopt_envs.gap import find_gap
from simopt_envs.physics.effects import EFFECTS

ray = pytest.importorskip("ray", reason="Ray is not installed")


@pytest.fixture(scope="module", autouse=True)
def _two_workers():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join(sys.path))  # the workers import the functions of this file
        ray.init(num_cpus=2, include_dashboard=False, object_store_memory=80_000_000, log_to_driver=False)
        yield
        ray.shutdown()


def weighted(task, weights, path):
    return task * weights.sum(), os.getpid()


def killed_once(task, marker):
    """Task 3 kills its worker the first time."""
    if task == 3 and not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return np.random.default_rng(task).normal(size=4)


def some_fail(task):
    if task % 3 == 1:
        raise ValueError(f"{task} is not to be had")
    return task


def forever(task):
    time.sleep(600)


def test_results_in_order_and_progress_from_all_engines():
    shared = (np.arange(1000.0), "x")
    for make, workers in ((LocalEngine, 1), (ThreadEngine, 1), (RayEngine, 2)):
        seen = []
        results = make(on_progress=lambda *counts: seen.append(counts)).map(weighted, range(20), shared)  # noqa: B023
        assert [value for value, _ in results] == [task * 499500.0 for task in range(20)]
        assert len({pid for _, pid in results} - {os.getpid()}) <= workers
        assert (os.getpid() in {pid for _, pid in results}) is (make is not RayEngine)
        assert seen == [(done, 20) for done in range(1, 21)]


def test_a_killed_worker_changes_nothing(tmp_path):
    marker = tmp_path / "killed"
    results = RayEngine().map(killed_once, range(8), (marker,))
    assert marker.exists()
    undisturbed = LocalEngine().map(killed_once, range(8), (marker,))
    np.testing.assert_array_equal(results, undisturbed)


@pytest.mark.parametrize("make", [LocalEngine, ThreadEngine, RayEngine])
def test_failures_are_told_and_the_rest_is_kept(make):
    with pytest.raises(
        FailedTasksError, match="2 of 6 tasks failed, the first of them number 1, 1: ValueError: 1 is not"
    ) as told:
        make().map(some_fail, range(6))
    assert told.value.results == [0, None, 2, 3, None, 5]
    assert list(told.value.failures) == [1, 4]
    assert all(isinstance(cause, ValueError) for cause in told.value.failures.values())


def test_what_is_shared_is_sent_once(monkeypatch):
    engine, shared, sent = RayEngine(), np.zeros(3), []
    put = ray.put
    monkeypatch.setattr(ray, "put", lambda x: sent.append(x) or put(x))
    for _ in range(2):
        engine.map(weighted, range(2), (shared, "path"))
    assert len(sent) == 2
    engine.map(weighted, range(2), (np.zeros(3), "path"))
    assert len(sent) == 3


def test_an_address_where_nothing_answers_is_told_at_once(monkeypatch):
    with socket.socket() as taken, monkeypatch.context() as patch:
        taken.bind(("127.0.0.1", 0))  # and does not listen
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        patch.setattr(ray, "is_initialized", lambda: False)
        patch.setattr(ray, "init", lambda **_: pytest.fail("Ray would wait for the cluster"))
        began = time.monotonic()
        with pytest.raises(ConnectionError, match=f"no Ray cluster answers at {address}: .*refused"):
            RayEngine(address)
        assert time.monotonic() - began < 6.0
        with pytest.raises(ValueError, match="is HOST:PORT, auto or local, got 'head'"):
            RayEngine("head")
        patch.setattr(ray, "init", lambda **_: None)
        taken.listen()
        RayEngine(address)


@pytest.mark.parametrize("make", [ThreadEngine, RayEngine])
def test_ctrl_c_cancels_what_is_left(make):
    def interrupt(*_):
        raise KeyboardInterrupt

    previous = signal.signal(signal.SIGALRM, interrupt)
    signal.alarm(2)
    try:
        with pytest.raises(KeyboardInterrupt):
            make().map(forever, range(2))
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, previous)
    assert make().map(some_fail, [0, 2]) == [0, 2]  # the workers are free again


class CrashingEnv(ReachEnv):
    """Kills its process where the force is right in a small range."""

    def reset(self, *, seed=None, options=None):
        if 0.55 < (options or {}).get("parameters", {}).get("force", 0.0) < 0.65:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().reset(seed=seed, options=options)


def test_an_episode_that_kills_every_worker_is_reported_and_the_others_are_kept():
    policy, xi = PushPolicy(), np.array([[0.1], [0.2], [0.3], [0.6]])
    real = HiddenSystem(ReachEnv, {}).rollout(policy, 1, np.random.default_rng(0))
    arguments = (policy, SPACE.subset(["force"]), xi, real, 5)
    with pytest.warns(RuntimeWarning, match=r"counts as diverged: seed \d+, ξ .*'force': .*0\.6.*Worker") as told:
        rollouts = EnvSimulator(CrashingEnv, "sync", 2, RayEngine(max_retries=1)).rollout(*arguments)
    assert len(told) == 1
    assert rollouts.diverged[:, 0].tolist() == [False, False, False, True]
    expected = EnvSimulator(ReachEnv, "sync", 2).rollout(*arguments)
    np.testing.assert_array_equal(rollouts.observations[:3], expected.observations[:3])
    assert np.isnan(rollouts.observations[3]).all()


class Wander:
    """A policy that moves every joint, without randomness; kills its worker once if told where to note that."""

    def __init__(self, marker=None):
        self.marker = marker

    def act(self, observations):
        if self.marker is not None and not self.marker.exists():
            self.marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return np.sin(37.0 * np.tile(observations[:, :4], 2))


@needs_batch
def test_rollouts_are_the_same_bit_by_bit(tmp_path):
    """From one process, from two workers, and from two of which one is killed."""
    robot = HiddenSystem("SimOpt/Drawer-v0", {"cabinet_x": 0.05})
    real = robot.rollout(Wander(), 2, np.random.default_rng(0))
    marker = tmp_path / "killed"
    results = {}
    for name, engine, policy in (
        ("local", LocalEngine(), Wander()),
        ("ray", RayEngine(), Wander()),
        ("killed", RayEngine(), Wander(marker)),
    ):
        simulator = EnvSimulator("SimOpt/Drawer-v0", num_envs=8, engine=engine)
        space = simulator.parameters.subset(["cabinet_x", "latency"])
        xi = np.random.default_rng(1).uniform([-0.1, 0.0], [0.1, 0.03], (15, 2))
        results[name] = simulator.rollout(policy, space, xi, real, seed=3)
    assert marker.exists()
    assert results["local"].observations.shape == (15, 2, 51, 10)
    for other in ("ray", "killed"):
        for field in ("observations", "actions", "lengths", "diverged", "success"):
            np.testing.assert_array_equal(getattr(results[other], field), getattr(results["local"], field))


def test_replays_are_the_same_bit_by_bit(model, windows):  # noqa: F811
    real, xi = window_trajectories(windows)[:3], PENDULUM.nominal * np.random.default_rng(0).uniform(0.5, 2, (150, 2))
    local, remote = (
        ReplaySimulator(model, PENDULUM, windows, engine).rollout(None, PENDULUM, xi, real, 0)
        for engine in (LocalEngine(), RayEngine())
    )
    assert local.observations.shape == (150, 3, 101, 1)
    np.testing.assert_array_equal(remote.observations, local.observations)


def test_the_command_line_gives_the_same_result_with_ray(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("baselines.commands.runs.write_report", lambda directory: directory / "report.html")
    (tmp_path / "arm.xml").write_text(PENDULUM_MODEL.format(friction=0.001))
    (tmp_path / "xi.yaml").write_text(XI)
    time = np.arange(400) * 0.005
    log = np.column_stack([time, np.zeros(400), 0.5 * np.cos(5.0 * time)])
    np.savetxt("log.csv", log, delimiter=",", header="time,ctrl/drive,qpos/hinge", comments="")
    typed = ["adapt", "arm.xml", "--data", "log.csv", "--parameters", "xi.yaml", "--iterations", "1"]
    results = []
    for engine in ("local", "ray"):
        main([*typed, "--rollouts", "300", "--out", engine, "--engine", engine])
        results.append(json.loads((tmp_path / engine / "result.json").read_text()))
    assert results[0] == results[1]
    capsys.readouterr()
    with pytest.raises(SystemExit):
        main([*typed, "--out", "third", "--ray-address", "auto"])
    assert "--ray-address auto needs --engine ray" in capsys.readouterr().err


# -- candidates of the gap workflow ------------------------------------------------------------------------------------

FEW = [EFFECTS[name] for name in ("coulomb_friction", "viscous_friction", "actuator_bias")]


@pytest.fixture(scope="module")
def recordings():
    law = lambda q, v: np.array([0.0, -0.4 * np.tanh(v[1] / 0.01)])  # noqa: E731
    return record(law, np.random.default_rng(1), count=2, seconds=1.5)


@needs_effects
def test_candidates_are_fitted_the_same_bit_by_bit(recordings):
    found, told = [], []
    for engine in (LocalEngine(), ThreadEngine(), RayEngine()):
        told.append([])
        gap = find_gap(
            mujoco.MjSpec.from_string(MODEL),
            recordings,
            effects=FEW,
            engine=engine,
            progress=lambda *now, log=told[-1]: log.append(now),
        )
        found.append(gap)
    local = found[0]
    assert told[0] == told[1] == told[2]
    assert {("refit", done, 3) for done in range(4)} <= {*told[0]}  # the three that come nearest at some size
    assert local.effects[0].candidate.place == "joint:elbow"
    for gap in found[1:]:
        for one, other in zip(local.explanation.stages, gap.explanation.stages, strict=True):
            assert [str(score.candidate) for score in one.scores] == [str(score.candidate) for score in other.scores]
            for mine, its in zip(one.scores, other.scores, strict=True):
                np.testing.assert_array_equal(mine.trial.fit.u, its.trial.fit.u)
                np.testing.assert_array_equal(mine.trial.fit.jacobian, its.trial.fit.jacobian)
                np.testing.assert_array_equal(mine.trial.held_out.errors, its.trial.held_out.errors)
                np.testing.assert_array_equal(mine.trial.held_out.jacobian, its.trial.held_out.jacobian)
        assert local.to_dict() | {"seconds": 0} == gap.to_dict() | {"seconds": 0}
        assert local.spec.to_xml() == gap.spec.to_xml()


@needs_effects
def test_a_candidate_whose_fit_fails_is_named_and_the_others_need_not_be_fitted_again(
    recordings, monkeypatch, tmp_path
):
    from simopt_envs.gap import refit

    fitted, broken, real = [], "actuator_bias at actuator:elbow", refit.fit

    def fit(misfit, start, iterations, **options):
        fitted.append(" and ".join(map(str, misfit.hypothesis.candidates)))
        if fitted[-1] == broken:
            raise np.linalg.LinAlgError("singular")
        return real(misfit, start, iterations, **options)

    def find(found_in, recordings=recordings):
        fitted.clear()
        return find_gap(mujoco.MjSpec.from_string(MODEL), recordings, effects=FEW, directory=found_in)

    monkeypatch.setattr(refit, "fit", fit)
    with pytest.raises(FailedTasksError, match=f"1 of 3 .* {broken}: LinAlgError: singular"):
        find(tmp_path)
    finished = len(fitted) - 1
    assert finished > 6
    with pytest.raises(ValueError, match=r"settings: recordings was .*, is now"):
        find(tmp_path, recordings[:1])
    broken = None
    resumed = find(tmp_path)
    assert fitted[0] == "actuator_bias at actuator:elbow"
    again = len(fitted)
    assert find(None).to_dict() | {"seconds": 0} == resumed.to_dict() | {"seconds": 0}
    assert len(fitted) == again + finished


# -- cells of the experiments ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Learn:
    """Settings that need a training, all of them the same one."""

    number: int
    fails: bool = False

    def run(self, seed, workspace):
        from baselines.experiments.environments import PENDULUM as ENV
        from baselines.experiments.environments import Randomization

        training = workspace.train(ENV, Randomization.none(ENV).gaussian(), 0)
        if self.fails:
            raise RuntimeError("on purpose")
        weights = [float(values.double().sum()) for values in training.policy.actor.state_dict().values()]
        return {"number": self.number, "weights": weights, "curve": training.curve}


def test_cells_that_share_a_training_run_side_by_side(tmp_path, capsys):
    pytest.importorskip("torch", reason="the experiments train with torch")
    from baselines.experiments.cell import Cell, Store
    from baselines.experiments.runner import run_cells
    from baselines.experiments.workspace import SMOKE, Workspace

    cells = [Cell("q", "c", number, Learn(number, fails=number == 1)) for number in range(4)]
    results = []
    for engine in (LocalEngine(), RayEngine()):
        folder = tmp_path / type(engine).__name__
        store = Store(folder / "cells", SMOKE)

        def workspace(tell, folder=folder):
            return Workspace(folder, SMOKE, tell)

        assert run_cells(cells, store, workspace, engine=engine) == [cells[1]]
        results.append(store.results(cells)["c"])
        assert len([path for path in (folder / "policies").iterdir() if path.is_dir()]) == 1
    assert results[0] == results[1]
    assert list(results[0]) == [0, 2, 3]
    assert capsys.readouterr().out.count("q/c-1: failed, RuntimeError: on purpose") == 2
