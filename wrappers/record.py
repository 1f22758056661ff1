"""A wrapper that writes an environment's episodes as recordings."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Literal

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from simopt_envs.measured.channels import actuator_names, model_channels, read_channels
from simopt_envs.measured.recording import Recording
from simopt_envs.physics.parameters import unknown_name

Array = NDArray[np.float64]
_STREAM = 4  # sets the noise's generator apart from those of the other wrappers


class RecordEpisodes(gym.Wrapper, RecordConstructorArgs):
    """Writes each episode in the recording format, so that a robot wrapped as an environment records itself.

    Row k holds what was measured at step k and the command that was then held until row k + 1; the last command is
    repeated beside the last measurement. An environment around a MuJoCo model is recorded under the model's names
    (``ctrl/``, ``qpos/``, ``qvel/``, ``sensor/``, ``site/``), any other one under the names given, or
    ``observation/0`` ... and ``action/0`` .... Episodes are numbered on from those already in the folder, which several
    processes may share; one cut short by ``reset`` or ``close`` is written too.

    Args:
        env: the environment.
        folder: where the files go.
        observations: names of the flattened observation's numbers, ``["qpos/elbow", ...]``.
        actions: names of the flattened action's numbers, ``["ctrl/elbow", ...]``.
        clock: seconds, ``time.monotonic`` for a robot; None for the environment's own time step (``dt``, or else one
            over ``render_fps``).
        suffix: file format.
        columns: what of it the robot measures, names or patterns such as ``"qpos/*"``; None for all. Commands are
            always recorded.
        noise: standard deviation of the noise of its sensors, by name or pattern of the columns, in their units. A
            seeded ``reset`` seeds it.
        per_step: measurements of a step of an environment of this package, as a robot's log is faster than its policy.
        minari_id: also keep the episodes in memory and, at ``close``, store them as this Minari data set.

    Raises:
        ValueError: if names do not fit the spaces, a pattern fits no column, there is neither a clock nor a time step,
            or so many measurements of a step cannot be had.
        ImportError: if ``minari_id`` is given and Minari is not installed.

    Change log:
        0.1.0: added.
    """

    def __init__(
        self,
        env: gym.Env,
        folder: str | Path,
        *,
        observations: Sequence[str] | None = None,
        actions: Sequence[str] | None = None,
        clock: Callable[[], float] | None = None,
        suffix: Literal[".npz", ".csv", ".parquet"] = ".npz",
        columns: Sequence[str] | None = None,
        noise: Mapping[str, float] | None = None,
        per_step: int = 1,
        minari_id: str | None = None,
    ):
        RecordConstructorArgs.__init__(
            self,
            _disable_deepcopy=True,  # the clock may be a method of the robot's driver
            folder=folder,
            observations=observations,
            actions=actions,
            clock=clock,
            suffix=suffix,
            columns=columns,
            noise=noise,
            per_step=per_step,
            minari_id=minari_id,
        )
        gym.Wrapper.__init__(self, env)
        self.recordings: list[Path] = []
        self._folder, self._suffix = Path(folder), suffix
        self._clock, self._period = clock, None if clock else _time_step(env)
        named = observations is not None or actions is not None
        model = None if named else getattr(env.unwrapped, "model", None)
        self._source: _ModelSource | _SpaceSource
        if isinstance(model, mujoco.MjModel):
            self._source = _ModelSource(env)
        else:
            self._source = _SpaceSource(env, observations, actions)
        names = self._source.signal_names
        self._kept = [names.index(name) for name in (names if columns is None else _matching(columns, names))]
        self._noise = np.zeros(len(names))
        for pattern, std in (noise or {}).items():
            self._noise[[names.index(name) for name in _matching([pattern], names)]] = std
        self._rng = np.random.default_rng()
        if per_step != 1:
            self._measure_within_steps(per_step)
        self._minari = None if minari_id is None else _MinariEpisodes(minari_id)
        self._signals: list[Array] = []
        self._commands: list[Array] = []
        self._times: list[float] = []

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Write an episode that was cut short, reset, and begin the next."""
        self._write()
        observation, info = self.env.reset(seed=seed, options=options)
        if seed is not None:
            self._rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_STREAM,)))
        self._measure(observation)
        if self._minari:
            self._minari.begin(observation, seed, options)
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step, and write the episode if that ended it."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._commands.append(self._source.command(action))
        self._measure(observation)
        if self._minari:
            self._minari.append(observation, action, float(reward), terminated, truncated)
        if terminated or truncated:
            self._write()
        return observation, reward, terminated, truncated, info

    def close(self) -> None:
        """Write an episode that was cut short, and the Minari data set; then close."""
        self._write()
        if self._minari:
            self._minari.store(self.env)
            self._minari = None
        super().close()

    def _measure(self, observation: Any) -> None:
        self._times.append(self._clock() if self._clock else len(self._times) * (self._period or 0.0))
        signal = self._source.signal(observation)
        self._signals.append(signal + self._noise * self._rng.standard_normal(signal.shape))

    def _measure_within_steps(self, per_step: int) -> None:
        """Measure so many times a step, the last time when it is over."""
        env: Any = self.env.unwrapped
        simulation: Any = getattr(env, "simulation", None)
        task: Any = getattr(env, "task", None)
        if not hasattr(simulation, "on_timestep") or task is None or self._period is None:
            raise ValueError(f"per_step={per_step}: only environments of this package are measured within their steps")
        every, rest = divmod(task.substeps, per_step) if per_step > 0 else (0, 1)
        if rest:
            raise ValueError(f"per_step must divide the {task.substeps} timesteps of a step, got {per_step}")
        self._period /= per_step

        def measure(number: int) -> None:
            if number % every == 0 and number < task.substeps:
                self._commands.append(self._source.command(None))
                self._measure(None)

        simulation.on_timestep = measure

    def _write(self) -> None:
        if self._commands:
            signals, commands = np.array(self._signals), np.array([*self._commands, self._commands[-1]])
            columns = dict(zip(self._source.command_names, commands.T, strict=True))
            columns |= {self._source.signal_names[i]: signals[:, i] for i in self._kept}
            self.recordings.append(self._save(Recording(np.array(self._times) - self._times[0], columns)))
        self._times, self._signals, self._commands = [], [], []

    def _save(self, recording: Recording) -> Path:
        """Write a file of a number of its own, whole or not at all: several processes may share the folder."""
        self._folder.mkdir(parents=True, exist_ok=True)
        while True:
            path = self._folder / f"episode_{_next_number(self._folder):06d}{self._suffix}"
            unfinished = path.with_name(f".{path.name}")
            try:
                unfinished.touch(exist_ok=False)  # claims the number: who did not create this never writes ``path``
            except FileExistsError:
                continue
            if not path.exists():  # else its writer finished since the folder was listed
                return recording.save(unfinished).replace(path)
            unfinished.unlink()


class _ModelSource:
    """Columns named after the MuJoCo model that the environment runs."""

    def __init__(self, env: Any):
        self._env = env.unwrapped
        channels = model_channels(self._env.model).values()
        self._commands = [c for c in channels if c.kind == "ctrl"]
        self._signals = [c for c in channels if c.kind != "ctrl"]
        self.command_names = [c.name for c in self._commands]
        if nameless := [str(i) for i, name in enumerate(actuator_names(self._env.model)) if not name]:
            gym.logger.warn(f"the commands of actuators {', '.join(nameless)}, which have no name, are not recorded")
        self.signal_names = [c.name for c in self._signals]
        self._scratch = mujoco.MjData(self._env.model)
        self._state = np.empty(mujoco.mj_stateSize(self._env.model, mujoco.mjtState.mjSTATE_INTEGRATION))

    def signal(self, observation: Any) -> Array:
        # After mj_step, sites and sensors are those of the substep before: compute them for the state as it is.
        model, data = self._env.model, self._scratch
        mujoco.mj_getState(model, self._env.data, self._state, mujoco.mjtState.mjSTATE_INTEGRATION)
        mujoco.mj_setState(model, data, self._state, mujoco.mjtState.mjSTATE_INTEGRATION)
        mujoco.mj_forward(model, data)
        fields = {kind: getattr(data, kind) for kind in ("qpos", "qvel", "sensordata", "site_xpos")}
        return read_channels(self._signals, fields) if self._signals else np.empty(0)

    def command(self, action: Any) -> Array:
        return self._env.data.ctrl[[c.index for c in self._commands]].copy()


class _SpaceSource:
    """Columns from the flattened observation and action."""

    def __init__(self, env: gym.Env, observations: Sequence[str] | None, actions: Sequence[str] | None):
        self._spaces = env.observation_space, env.action_space
        self.signal_names = _names("observation", observations, env.observation_space)
        self.command_names = _names("action", actions, env.action_space)

    def signal(self, observation: Any) -> Array:
        return np.asarray(gym.spaces.flatten(self._spaces[0], observation), dtype=np.float64)

    def command(self, action: Any) -> Array:
        return np.asarray(gym.spaces.flatten(self._spaces[1], action), dtype=np.float64)


class _MinariEpisodes:
    """Episodes kept for a Minari data set."""

    def __init__(self, dataset_id: str):
        try:
            import minari
        except ImportError:
            raise ImportError('recording as a Minari data set needs minari: pip install "minari[hdf5]"') from None
        self._minari, self._id = minari, dataset_id
        self._episodes: list[dict[str, Any]] = []

    def begin(self, observation: Any, seed: int | None, options: dict[str, Any] | None) -> None:
        steps: dict[str, list[Any]] = {"actions": [], "rewards": [], "terminations": [], "truncations": []}
        self._episodes.append({"seed": seed, "options": options, "observations": [observation], **steps})

    def append(self, observation: Any, action: Any, reward: float, terminated: bool, truncated: bool) -> None:
        values = (observation, action, reward, terminated, truncated)
        for name, value in zip(
            ("observations", "actions", "rewards", "terminations", "truncations"), values, strict=True
        ):
            self._episodes[-1][name].append(value)

    def store(self, env: gym.Env) -> None:
        from minari.data_collector import EpisodeBuffer

        whole = [episode for episode in self._episodes if episode["actions"]]
        buffers = [
            EpisodeBuffer(
                id=i,
                **{
                    **episode,
                    "observations": _by_part(episode["observations"]),
                    "actions": _by_part(episode["actions"]),
                },
            )
            for i, episode in enumerate(whole)
        ]
        if buffers:
            self._minari.create_dataset_from_buffers(self._id, buffers, env=env)


def _by_part(values: list[Any]) -> Any:
    """Samples of a space -> one list per part of a nested space, as Minari keeps them."""
    if isinstance(values[0], dict):
        return {key: _by_part([value[key] for value in values]) for key in values[0]}
    if isinstance(values[0], tuple):
        return tuple(_by_part([value[i] for value in values]) for i in range(len(values[0])))
    return values


def _names(kind: str, names: Sequence[str] | None, space: gym.Space) -> list[str]:
    size = gym.spaces.flatdim(space)
    if names is None:
        return [f"{kind}/{k}" for k in range(size)]
    if isinstance(names, str) or len(names) != size:
        raise ValueError(f"the flattened {kind} has {size} numbers, got the names {names!r}")
    return list(names)


def _matching(patterns: Sequence[str], names: Sequence[str]) -> list[str]:
    """The names that some of the patterns fit, in their order; ValueError for a pattern that fits none."""
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in names):
            raise ValueError(unknown_name("column", pattern, names))
    return [name for name in names if any(fnmatchcase(name, pattern) for pattern in patterns)]


def _time_step(env: gym.Env) -> float:
    if (period := getattr(env.unwrapped, "dt", None)) is not None:
        return float(period)
    if (rate := env.metadata.get("render_fps")) is not None:
        return 1.0 / float(rate)
    raise ValueError(f"{env} has neither dt nor metadata['render_fps']: give a clock, clock=time.monotonic")


def _next_number(folder: Path) -> int:
    """The number after those in a folder, also of files that are being written."""
    matches = (re.fullmatch(r"\.?episode_(\d+)", path.stem) for path in folder.iterdir())
    return max((int(match[1]) for match in matches if match), default=-1) + 1
