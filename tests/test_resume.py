"""A run killed at any moment and resumed ends as if nothing had happened."""

import json
import os
import signal

import numpy as np
import pytest
from test_simopt import make

from simopt_envs.adaptation import REPS

TARGET = {"force": 0.6, "gain": 1.3}
pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="the test kills forked processes")


def run(directory, resume=False, on_event=None, iterations=2):
    loop = make(TARGET, directory=directory, updates_per_iteration=2, simulated_rollouts=60, on_event=on_event)
    return list(loop.run(iterations, resume=resume))


def run_and_die(directory, die_at, resume):
    """Run in a process that kills itself at the given one of its writes (fsync); True if it lived to the end."""
    child = os.fork()
    if child == 0:
        writes, sync = 0, os.fsync

        def fsync(descriptor):
            nonlocal writes
            if writes == die_at:
                os.kill(os.getpid(), signal.SIGKILL)
            writes += 1
            sync(descriptor)

        os.fsync = fsync
        status = 1
        try:
            run(directory, resume)
            status = 0
        finally:
            os._exit(status)
    _, status = os.waitpid(child, 0)
    assert os.WIFSIGNALED(status) or os.WEXITSTATUS(status) == 0
    return not os.WIFSIGNALED(status)


def without_clock(directory):
    """Every number and text of a result by where it stands, so that a failure names those that differ."""
    result = json.loads((directory / "result.json").read_text())
    for entry in result["iterations"]:
        assert entry.pop("train_seconds") >= 0
    return dict(leaves(result))


def leaves(value, where="result"):
    if isinstance(value, dict | list):
        for key, part in value.items() if isinstance(value, dict) else enumerate(value):
            yield from leaves(part, f"{where}.{key}")
    else:
        yield where, value


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    directory = tmp_path_factory.mktemp("undisturbed") / "run"
    return directory, run(directory)


def assert_same(directory, records, undisturbed):
    expected_directory, expected = undisturbed
    assert without_clock(directory) == without_clock(expected_directory)
    for record, other in zip(records, expected, strict=True):
        np.testing.assert_array_equal(record.costs, other.costs)
        np.testing.assert_array_equal(record.xi, other.xi)
        assert vars(record.policy) == vars(other.policy)
        for a, b in zip([*record.real, *record.simulated], [*other.real, *other.simulated], strict=True):
            np.testing.assert_array_equal(a.observations, b.observations)
            np.testing.assert_array_equal(a.actions, b.actions)
            assert a.success == b.success


@pytest.mark.parametrize("die_at", [0, 1, 2, 3, 4, 6, 9, 12, 13, 14, 16, 19, 25, 30, 36, 41, 42])
def test_killed_and_resumed(die_at, tmp_path, undisturbed):
    directory = tmp_path / "run"
    assert not run_and_die(directory, die_at, resume=False)
    assert_same(directory, run(directory, resume=True), undisturbed)
    assert not [p for p in (directory / "checkpoints").iterdir() if p.name.startswith(".")]


def test_killed_again_and_again(tmp_path, undisturbed):
    directory, lives = tmp_path / "run", 1
    while not run_and_die(directory, die_at=7, resume=True):
        lives += 1
    assert lives > 5
    assert_same(directory, run(directory, resume=True), undisturbed)


def test_resume_restores_instead_of_computing(tmp_path, undisturbed):
    directory, events = tmp_path / "run", []
    run(directory, iterations=1)
    before = {path: path.stat().st_mtime_ns for path in (directory / "checkpoints").rglob("*") if path.is_file()}
    assert_same(directory, run(directory, resume=True, on_event=events.append), undisturbed)
    assert all(path.stat().st_mtime_ns == time for path, time in before.items())
    assert {event.status for event in events if event.iteration < 2} == {"restored"}
    assert {event.status for event in events if event.iteration == 2} == {"started", "finished"}


def test_another_run_in_the_folder_is_left_alone(tmp_path):
    directory = tmp_path / "run"
    run(directory, iterations=0)
    before = {path: path.read_bytes() for path in directory.rglob("*") if path.is_file()}
    with pytest.raises(FileExistsError, match="holds a run already"):
        make(TARGET, directory=directory).run(1)
    with pytest.raises(
        ValueError, match=r"update.epsilon was 1.0, is now 0.5; .*updates_per_iteration was 2, is now 3"
    ):
        make(TARGET, directory=directory, update=REPS(epsilon=0.5), simulated_rollouts=60).run(1, resume=True)
    with pytest.raises(ValueError, match=r"real_system.parameters_sha256"):
        make({}, directory=directory, updates_per_iteration=2, simulated_rollouts=60).run(1, resume=True)
    assert {path: path.read_bytes() for path in directory.rglob("*") if path.is_file()} == before


def test_a_file_that_is_none_of_the_runs_is_left_alone(tmp_path, undisturbed):
    directory = tmp_path / "run"
    run(directory, iterations=1)
    (directory / "checkpoints/.DS_Store").write_text("a file manager's")
    assert_same(directory, run(directory, resume=True), undisturbed)
    assert (directory / "checkpoints/.DS_Store").exists()


def test_no_finished_iteration_is_lost(tmp_path):
    directory = tmp_path / "run"
    run(directory, iterations=2)
    before = (directory / "result.json").read_text()
    with pytest.raises(ValueError, match="holds a run of 2 iterations; resume it with as many or more, not with 1"):
        run(directory, resume=True, iterations=1)
    loop = make(TARGET, directory=directory, updates_per_iteration=2, simulated_rollouts=60)
    next(loop.run(2, resume=True))  # and is stopped
    assert (directory / "result.json").read_text() == before


def test_a_result_without_its_checkpoints_is_not_overwritten(tmp_path):
    (tmp_path / "result.json").write_text("{}")
    for resume in (False, True):
        with pytest.raises(FileExistsError, match=r"result\.json"):
            make(TARGET, directory=tmp_path).run(1, resume=resume)
    assert (tmp_path / "result.json").read_text() == "{}"
