"""Running windows of recordings on MuJoCo, for many ξ at once: on ``mujoco.batch``, or before 3.17 on its rollouts."""

from __future__ import annotations

import copy
import os
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from simopt_envs.measured.channels import Channel, commanded_actuators, read_channels
from simopt_envs.measured.resample import Array
from simopt_envs.measured.states import States
from simopt_envs.physics.parameters import ParameterSpace
from simopt_envs.physics.profiler import PROFILER_RESTS
from simopt_envs.physics.writer import ModelWriter

if TYPE_CHECKING:
    from simopt_envs.measured.windows import Windows


class BatchEngine:
    """Windows x ξ as the worlds of one ``mujoco.batch``."""

    def __init__(self, model: mujoco.MjModel, space: ParameterSpace, windows: Windows, num_threads: int):
        self._model, self._windows, self._num_threads = model, windows, num_threads
        self._writer = ModelWriter(model, space)
        self._settled = _settled_starts(model, windows)
        self._grow(1)

    def _grow(self, num_xi: int) -> None:
        from mujoco.batch import Batch

        self._batch = Batch(self._model, num_xi * len(self._windows), self._num_threads)
        self._fields = {name: self._batch.expand(name) for name in self._writer.fields}

    def run(self, xi: Array, starts: States, commands: Array) -> Array:
        """The windows' channels (n, w, S, c); NaN from where a world diverged.

        Args:
            xi: (n, d).
            starts: n w states.
            commands: (n w, N, nu).
        """
        windows, num_windows = self._windows, len(self._windows)
        if len(xi) * num_windows > self._batch.nsim:
            self._grow(len(xi))
        batch, worlds = self._batch, np.arange(len(xi) * num_windows)
        self._writer.write(np.repeat(xi, num_windows, axis=0), self._fields.__getitem__, worlds)
        if self._writer.needs_set_const:
            batch.set_const(worlds)
        batch.reset(worlds, stage=int(mujoco.mjtStage.mjSTAGE_NONE))
        for field, values in _initial_fields(self._model, windows, starts, self._settled).items():
            batch.bind(field)[worlds] = values
        # One step more than the window is long: derived fields lag the state by a step.
        commands = np.concatenate([commands, commands[:, -1:]], axis=1)
        fields = list(field_sizes(self._model, windows.channels))
        with PROFILER_RESTS:
            records = batch.rollout(
                commands.shape[1],
                control=commands if self._model.nu else None,
                control_spec=int(mujoco.mjtState.mjSTATE_CTRL),
                record=[*fields, mujoco.mjtState.mjSTATE_TIME],
                ids=worlds,
            )
        start = {"qpos": starts.qpos, "qvel": starts.qvel}
        series = {}
        for field in fields:
            if field in start:
                first = start[field][:, None]
                series[field] = np.concatenate([first, records[field][:, :-1]], axis=1)[:, :: windows.stride]
            else:
                series[field] = records[field][:, :: windows.stride]
        values = read_channels(list(windows.channels), series)
        clock = records[mujoco.mjtState.mjSTATE_TIME].reshape(len(worlds), -1)
        return _until_stopped(values, clock, windows.stride).reshape(len(xi), num_windows, *values.shape[1:])


class RolloutEngine:
    """The same on ``mujoco.rollout``, for MuJoCo before 3.17: one copy of the model per ξ."""

    def __init__(self, model: mujoco.MjModel, space: ParameterSpace, windows: Windows, num_threads: int):
        self._model, self._windows = model, windows
        self._writer = ModelWriter(model, space)
        self._settled = _settled_starts(model, windows)
        self._data = [mujoco.MjData(model) for _ in range(num_threads or os.cpu_count() or 1)]

    def run(self, xi: Array, starts: States, commands: Array) -> Array:
        """See :meth:`BatchEngine.run`."""
        from mujoco import rollout

        windows, model = self._windows, self._model
        models = [copy.copy(model) for _ in xi]
        for values, world in zip(xi, models, strict=True):
            self._writer.write_model(values, world, self._data[0])
        initial = _initial_states(model, windows, starts, self._settled)
        commands = np.concatenate([commands, commands[:, -1:]], axis=1)
        states, sensors = rollout.rollout(
            [world for world in models for _ in range(len(windows))],
            self._data,
            initial,
            commands if model.nu else None,
            nstep=commands.shape[1],
        )
        clock = states[..., 0]
        states = np.concatenate([initial[:, None], states[:, :-1]], axis=1)
        qpos, qvel = states[..., 1 : 1 + model.nq], states[..., 1 + model.nq : 1 + model.nq + model.nv]
        series = {"qpos": qpos, "qvel": qvel, "sensordata": sensors}
        series = {field: values[:, :: windows.stride] for field, values in series.items()}
        if any(channel.kind == "site_xpos" for channel in windows.channels):
            sites = [_site_positions(m, self._data[0], q) for m, q in _per_world(models, series["qpos"])]
            series["site_xpos"] = np.array(sites)
        values = read_channels(list(windows.channels), series)
        return _until_stopped(values, clock, windows.stride).reshape(len(xi), len(windows), *values.shape[1:])


def _until_stopped(values: Array, clock: Array, stride: int) -> Array:
    """Values (worlds, S, c), NaN from where the engine stopped a world that diverged: its clock stands or went back.

    ``clock`` (worlds, N + 1) is the time after each step.
    """
    stopped = np.maximum.accumulate(np.diff(clock, prepend=0.0) <= 0, axis=1)
    # The state at sample s is the one after step s * stride.
    at_samples = np.concatenate([np.zeros((len(clock), 1), dtype=bool), stopped[:, :-1]], axis=1)[:, ::stride]
    return np.where(at_samples[..., None], np.nan, values)


def _per_world(models: list[mujoco.MjModel], qpos: Array) -> Iterator[tuple[mujoco.MjModel, Array]]:
    windows = len(qpos) // len(models)
    yield from ((models[i // windows], q) for i, q in enumerate(qpos))


def _site_positions(model: mujoco.MjModel, data: mujoco.MjData, qpos: Array) -> Array:
    """(S, nsite, 3) for postures (S, nq)."""
    positions = np.empty((len(qpos), model.nsite, 3))
    for s, posture in enumerate(qpos):
        data.qpos[:] = posture
        mujoco.mj_kinematics(model, data)
        positions[s] = data.site_xpos
    return positions


def _settled_starts(model: mujoco.MjModel, windows: Windows) -> dict[str, Array] | None:
    """Activations and delays at the starts of windows, name -> (w, ...); None if they depend on where joints are."""
    if mujoco.mjtDyn.mjDYN_INTEGRATOR in model.actuator_dyntype:
        return None
    return _settled(model, windows, windows.starts)


def _settled(model: mujoco.MjModel, windows: Windows, starts: States) -> dict[str, Array]:
    """The same at other starts, name -> (n w, ...)."""
    data = mujoco.MjData(model)
    act, history = np.zeros((len(starts), model.na)), np.zeros((len(starts), model.nhistory))
    for i in range(len(starts) if model.na or model.nhistory else 0):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = starts.qpos[i], starts.qvel[i]
        settle_actuators(model, data, windows.past_commands[i % len(windows)])
        act[i], history[i] = data.act, data.history
    return ({"act": act} if model.na else {}) | ({"history": history} if model.nhistory else {})


def _initial_fields(
    model: mujoco.MjModel, windows: Windows, starts: States, settled: dict[str, Array] | None
) -> dict[str, Array]:
    """The state fields to write at the starts, name -> (n w, ...)."""
    fields = {"qpos": starts.qpos, "qvel": starts.qvel}
    if settled is None:
        return fields | _settled(model, windows, starts)
    return fields | {name: np.tile(values, (len(starts) // len(windows), 1)) for name, values in settled.items()}


def settle_actuators(model: mujoco.MjModel, data: mujoco.MjData, past: Array) -> None:
    """Fill activations and delays as the commands before the start (P, nu), P >= 1, left them.

    A filter had settled on the first of these, and an integrated setpoint is where the joint is.
    """
    mujoco.mj_fwdPosition(model, data)
    for command, i in enumerate(commanded_actuators(model)):
        first = int(model.actuator_actadr[i])
        match mujoco.mjtDyn(model.actuator_dyntype[i]):
            case mujoco.mjtDyn.mjDYN_FILTER | mujoco.mjtDyn.mjDYN_FILTEREXACT:
                lag, delay = float(model.actuator_dynprm[i, 0]), float(model.actuator_delay[i])
                arrived = past[: max(1, len(past) - round(delay / model.opt.timestep)), command]
                kept = np.exp(-model.opt.timestep / max(lag, mujoco.mjMINVAL)) ** np.arange(len(arrived) + 1)[::-1]
                data.act[first] = np.diff(kept) @ arrived + kept[0] * arrived[0]
            case mujoco.mjtDyn.mjDYN_INTEGRATOR:
                data.act[first] = data.actuator_length[i]
        length = int(model.actuator_history[i, 0]) if model.nhistory else 0
        if length:
            times = model.opt.timestep * np.arange(-length, 0)
            mujoco.mj_initCtrlHistory(model, data, i, times, np.ascontiguousarray(past[-length:, command, None]))


def _initial_states(model: mujoco.MjModel, windows: Windows, starts: States, settled: dict[str, Array] | None) -> Array:
    """Full physics states (n w, ...) at the starts."""
    spec = mujoco.mjtState.mjSTATE_FULLPHYSICS
    data, rows = mujoco.MjData(model), np.empty((len(starts), mujoco.mj_stateSize(model, spec)))
    fields = _initial_fields(model, windows, starts, settled)
    for i, row in enumerate(rows):
        for field, values in fields.items():
            getattr(data, field)[:] = values[i]
        mujoco.mj_getState(model, data, row, spec)
    return rows


def field_sizes(model: mujoco.MjModel, channels: Sequence[Channel]) -> dict[str, int]:
    """The MjData fields that the channels read, and the numbers in each."""
    sizes = {"qpos": model.nq, "qvel": model.nv, "sensordata": model.nsensordata, "site_xpos": 3 * model.nsite}
    return {kind: sizes[kind] for kind in dict.fromkeys(channel.kind for channel in channels)}
