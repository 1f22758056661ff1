"""Recording an environment's episodes: what is written, and that a replay of it is the episode."""

from __future__ import annotations

import threading
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import simopt_envs  # noqa: F401 - registers the environments
from simopt_envs.measured import LogMapping, Recording, Source, load_recording, load_recordings, replay
from wrappers.record import RecordEpisodes

ARM = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body>
      <joint name="hinge" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5"/>
      <site name="tip" pos="0 0 -0.3"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
  <sensor><gyro name="gyro" site="tip"/></sensor>
</mujoco>
"""


class Arm(gym.Env):
    """Ten substeps a step, from a random posture, for eight steps."""

    observation_space = gym.spaces.Dict({"q": gym.spaces.Box(-10, 10, (1,)), "v": gym.spaces.Box(-99, 99, (1,))})
    action_space = gym.spaces.Box(-1, 1, (1,), dtype=np.float64)

    def __init__(self) -> None:
        self.model = mujoco.MjModel.from_xml_string(ARM)
        self.data = mujoco.MjData(self.model)
        self.dt = 0.02

    def _observe(self) -> dict[str, Any]:
        return {"q": self.data.qpos.astype(np.float32), "v": self.data.qvel.astype(np.float32)}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[0] = self.np_random.uniform(0.5, 1.5)
        self._steps = 0
        return self._observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, 10)
        self._steps += 1
        return self._observe(), 0.0, False, self._steps == 8, {}


class Robot(gym.Wrapper):
    """The same without a model to be seen: hardware."""

    def __init__(self) -> None:
        super().__init__(gym.wrappers.FlattenObservation(Arm()))

    @property
    def unwrapped(self) -> Any:
        return self


def test_commands_that_cannot_be_recorded_are_told(tmp_path):
    """Of two actuators without a name on one joint; one alone is called as its joint."""
    env = Arm()
    env.model = mujoco.MjModel.from_xml_string(ARM.replace('name="motor" ', ""))
    assert "ctrl/hinge" in RecordEpisodes(env, tmp_path)._source.command_names
    env.model = mujoco.MjModel.from_xml_string(
        ARM.replace('<motor name="motor" joint="hinge"/>', '<motor joint="hinge"/>' * 2)
    )
    with pytest.warns(UserWarning, match="the commands of actuators 0, 1, which have no name, are not recorded"):
        RecordEpisodes(env, tmp_path)


def run(env: gym.Env, episodes: int, steps: int = 8) -> list[float]:
    rng = np.random.default_rng(5)
    actions = []
    for episode in range(episodes):
        env.reset(seed=episode)
        for _ in range(steps):
            actions.append(float(rng.uniform(-1, 1)))
            env.step(np.array(actions[-1:]))
    return actions


def test_a_mujoco_env_is_recorded_under_the_models_names(tmp_path):
    env = RecordEpisodes(Arm(), tmp_path)
    actions = run(env, 2)
    env.close()
    assert [path.name for path in env.recordings] == ["episode_000000.npz", "episode_000001.npz"]
    recording = load_recording(env.recordings[1])
    assert set(recording.columns) == {
        "ctrl/motor", "qpos/hinge", "qvel/hinge", "site/tip/x", "site/tip/y", "site/tip/z",
        "sensor/gyro/0", "sensor/gyro/1", "sensor/gyro/2",
    }  # fmt: skip
    np.testing.assert_allclose(recording.time, 0.02 * np.arange(9))
    np.testing.assert_array_equal(recording["ctrl/motor"], [*actions[8:], actions[-1]])
    # Sites and sensors belong to the same instant as the state.
    np.testing.assert_allclose(recording["site/tip/x"], -0.3 * np.sin(recording["qpos/hinge"]), atol=1e-12)
    np.testing.assert_allclose(recording["sensor/gyro/1"], recording["qvel/hinge"], atol=1e-12)


def test_a_replay_of_the_recording_is_the_episode(tmp_path):
    env = RecordEpisodes(Arm(), tmp_path)
    run(env, 1)
    recording = load_recording(env.recordings[0])
    result = replay(env.unwrapped.model, recording)
    # The start is an estimate from nine samples; the motion after it must be the same to that accuracy.
    assert result.rmse[0, result.windows.names.index("qpos/hinge")] < 0.02
    env.unwrapped.model.dof_damping[:] = 1.0
    assert replay(env.unwrapped.model, recording).rmse[0, 0] > 0.1


def test_an_env_without_a_model_needs_names_and_a_clock(tmp_path):
    times = iter(np.cumsum(np.full(100, 0.021)))
    with pytest.raises(ValueError, match="neither dt nor"):
        RecordEpisodes(Robot(), tmp_path)
    with pytest.raises(ValueError, match="has 2 numbers, got the names"):
        RecordEpisodes(Robot(), tmp_path, observations=["qpos/hinge"], clock=lambda: next(times))
    env = RecordEpisodes(
        Robot(),
        tmp_path,
        observations=["qpos/hinge", "qvel/hinge"],
        actions=["ctrl/motor"],
        clock=lambda: next(times),
        suffix=".csv",
    )
    actions = run(env, 1)
    recording = load_recording(env.recordings[0])
    assert list(recording.columns) == ["ctrl/motor", "qpos/hinge", "qvel/hinge"]
    np.testing.assert_allclose(recording.time, 0.021 * np.arange(9))
    np.testing.assert_array_equal(recording["ctrl/motor"][:-1], actions)


def test_episodes_cut_short_are_kept_and_numbers_go_on(tmp_path):
    env = RecordEpisodes(Arm(), tmp_path)
    run(env, 2, steps=3)  # the second reset cuts the first episode short, close the second
    env.reset()
    env.close()
    assert len(env.recordings) == 2, "an episode without a step is not written"
    again = RecordEpisodes(Arm(), tmp_path)
    run(again, 1)
    assert [path.name for path in again.recordings] == ["episode_000002.npz"]
    assert [len(load_recording(path)) for path in [*env.recordings, *again.recordings]] == [4, 4, 9]


def test_episodes_that_end_at_the_same_time_get_numbers_of_their_own(tmp_path, monkeypatch):
    first, second = (RecordEpisodes(Arm(), tmp_path) for _ in range(2))
    save, waiting = Recording.save, [second]

    def save_while_another_does(recording, path):
        while waiting:
            run(waiting.pop(), 1, steps=8)
        return save(recording, path)

    monkeypatch.setattr(Recording, "save", save_while_another_does)
    run(first, 1, steps=8)
    assert {path.name for path in tmp_path.iterdir()} == {"episode_000000.npz", "episode_000001.npz"}
    assert (*first.recordings, *second.recordings) == tuple(sorted(tmp_path.iterdir()))

    looked = iter([1, 2])  # the other one finished number 1 after this one looked
    monkeypatch.setattr("wrappers.record._next_number", lambda folder: next(looked))
    run(first, 1)
    assert [path.name for path in sorted(tmp_path.iterdir())] == [f"episode_00000{i}.npz" for i in range(3)]


def test_a_recording_is_there_as_a_whole_or_not_at_all(tmp_path, monkeypatch):
    def be_killed(recording, path):
        path.write_bytes(b"PK")
        raise KeyboardInterrupt

    (tmp_path / "episode_000004_notes.txt").write_text("")  # no number to go on from
    with monkeypatch.context() as patch:
        patch.setattr(Recording, "save", be_killed)
        with pytest.raises(KeyboardInterrupt):
            run(RecordEpisodes(Arm(), tmp_path), 1)
    assert not [*tmp_path.glob("episode_*.npz")]
    env = RecordEpisodes(Arm(), tmp_path)
    run(env, 1)
    assert [*tmp_path.glob("episode_*.npz")] == env.recordings
    assert len(load_recording(env.recordings[0])) == 9


class Driver:
    """A robot's, which cannot be copied."""

    def __init__(self) -> None:
        self.lock, self.seconds = threading.Lock(), 0.0

    def now(self) -> float:
        self.seconds += 0.5
        return self.seconds


def test_the_clock_may_belong_to_something_that_cannot_be_copied(tmp_path):
    driver = Driver()
    env = RecordEpisodes(Robot(), tmp_path, clock=driver.now)
    run(env, 1)
    assert driver.seconds == 4.5
    np.testing.assert_array_equal(load_recording(env.recordings[0]).time, 0.5 * np.arange(9))


def test_a_registered_env_keeps_its_behaviour_and_its_spec_rebuilds_the_wrapper(tmp_path):
    plain, recorded = gym.make("Pendulum-v1"), RecordEpisodes(gym.make("Pendulum-v1"), tmp_path)
    for env in (plain, recorded):
        env.reset(seed=3)
        env.action_space.seed(4)
    for _ in range(200):
        expected, got = plain.step(plain.action_space.sample()), recorded.step(recorded.action_space.sample())
        np.testing.assert_array_equal(got[0], expected[0])
        assert got[1:4] == expected[1:4]
    recording = load_recording(recorded.recordings[0])
    assert list(recording.columns) == ["action/0", "observation/0", "observation/1", "observation/2"]
    assert len(recording) == 201
    assert isinstance(gym.make(recorded.spec), RecordEpisodes)


def test_a_log_that_is_faster_than_the_policy_and_noisy(tmp_path):
    noise = {"qpos/joint*": 0.01, "site/handle/*": 0.1}
    columns = ["qpos/joint*", "site/handle/*"]
    robot = RecordEpisodes(gym.make("SimOpt/Drawer-v0"), tmp_path / "a", columns=columns, noise=noise, per_step=5)
    exact = RecordEpisodes(gym.make("SimOpt/Drawer-v0"), tmp_path / "b")
    plain = gym.make("SimOpt/Drawer-v0")
    for env in (robot, exact, plain):
        env.reset(seed=4)
    for action in np.random.default_rng(0).uniform(-1, 1, (50, 8)).astype(np.float32):
        expected = plain.step(action)[0]
        np.testing.assert_array_equal(robot.step(action)[0], expected)
        exact.step(action)
    fast, slow = (load_recording(env.recordings[0]) for env in (robot, exact))
    assert (len(fast), len(slow)) == (251, 51)
    assert set(fast.signals) == {*(f"qpos/joint{i}" for i in range(1, 8)), *(f"site/handle/{axis}" for axis in "xyz")}
    np.testing.assert_allclose(fast.time[::5], slow.time, atol=1e-9)
    np.testing.assert_array_equal(fast["ctrl/joint3"][:-1:5], slow["ctrl/joint3"][:-1])
    np.testing.assert_array_equal(fast["ctrl/joint3"][4:-1:5], slow["ctrl/joint3"][:-1])
    for column, std in (("qpos/joint3", 0.01), ("site/handle/y", 0.1)):
        error = fast[column][::5] - slow[column]
        assert 0.6 * std < error.std() < 1.4 * std
    assert np.abs(np.diff(slow["qpos/joint4"])).max() > 0.01

    for wrong, message in ((7, "must divide the 15 timesteps"), (0, "must divide")):
        with pytest.raises(ValueError, match=message):
            RecordEpisodes(gym.make("SimOpt/Drawer-v0"), tmp_path / "c", per_step=wrong)
    with pytest.raises(ValueError, match="only environments of this package"):
        RecordEpisodes(Arm(), tmp_path / "c", per_step=2)
    with pytest.raises(ValueError, match="unknown column 'qpos/elbow'"):
        RecordEpisodes(Arm(), tmp_path / "c", columns=["qpos/elbow"])


def test_minari(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    try:
        import minari  # noqa: F401
    except ImportError:
        with pytest.raises(ImportError, match=r"pip install \"minari\[hdf5\]\""):
            RecordEpisodes(Arm(), tmp_path, minari_id="arm/test-v0")
        return
    env = RecordEpisodes(Arm(), tmp_path / "own", minari_id="arm/test-v0")
    actions = run(env, 2)
    env.close()
    mapping = LogMapping(
        {"ctrl/motor": Source("action/0"), "qpos/hinge": Source("observation/q/0")}, time=None, sample_rate=50.0
    )
    for source in ("minari:arm/test-v0", tmp_path / "minari" / "arm" / "test-v0"):
        first, second = load_recordings(source, mapping)
        np.testing.assert_allclose(second["ctrl/motor"], [*actions[8:], actions[-1]])
        own = load_recording(env.recordings[0])
        np.testing.assert_allclose(first["qpos/hinge"], own["qpos/hinge"], rtol=1e-6)
        np.testing.assert_allclose(first.time, own.time)
