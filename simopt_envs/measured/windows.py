"""Stretches of recordings that a model can be run through, and running it: for every window and every ξ at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from simopt_envs.measured.channels import Channel, actuator_names, model_channels
from simopt_envs.measured.engines import BatchEngine, RolloutEngine, field_sizes
from simopt_envs.measured.recording import Recording
from simopt_envs.measured.resample import GAP_PERIODS, Array, hold, longest_interval, rounding_noise
from simopt_envs.measured.rest import holding_commands
from simopt_envs.measured.states import States, estimate_states
from simopt_envs.physics.parameters import ParameterSpace

_NUMBERS_AT_ONCE = 2**25  # a chunk of worlds records at most so many, 256 MB
_LEAST_NOISE = 1e-6  # of a channel's standard deviation: a perfect fit leaves no error to take it from
_TIME_CONSTANTS = 5.0  # after which a filter has forgotten all but 1 % of a command


@dataclass(frozen=True)
class Windows:
    """w stretches of equal length from one or several recordings.

    Attributes:
        channels: the c columns that are compared.
        offsets: seconds from a window's start to its samples, (S,), offsets[0] = 0.
        start_time: when each window begins in its recording [s], (w,).
        recording: name of the recording each comes from, w of them.
        measured: (w, S, c), NaN where a sample is missing.
        commands: held over each step of the model, (w, N, nu), N = (S - 1) * stride.
        past_commands: those of the steps before the start, oldest first, (w, P, nu): a delayed actuator still sees
            them. Before a recording that begins at rest, those that held the model there.
        starts: the estimated states at the start.
        stride: steps of the model from one sample to the next.
        rounding: standard deviation of what coarse encoders' rounding leaves, (c,).
    """

    channels: tuple[Channel, ...]
    offsets: Array
    start_time: Array
    recording: tuple[str, ...]
    measured: Array
    commands: Array
    past_commands: Array
    starts: States
    stride: int
    rounding: Array

    def __len__(self) -> int:
        return len(self.start_time)

    @property
    def seconds(self) -> float:
        """Length of each."""
        return float(self.offsets[-1])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the compared columns."""
        return tuple(channel.name for channel in self.channels)

    def select(self, rows: NDArray[np.intp]) -> Windows:
        """Some of them, in the order given."""
        names = ("start_time", "measured", "commands", "past_commands")
        taken = {name: getattr(self, name)[rows] for name in names}
        recording = tuple(self.recording[row] for row in rows)
        return replace(self, recording=recording, starts=self.starts.select(rows), **taken)

    def of_columns(self, names: Sequence[str]) -> Windows:
        """The same, compared in some of their columns alone."""
        shown = [c for c, channel in enumerate(self.channels) if channel.name in names]
        channels = tuple(self.channels[c] for c in shown)
        return replace(self, channels=channels, measured=self.measured[..., shown], rounding=self.rounding[shown])

    def at_half_the_timestep(self) -> Windows:
        """The same for a model with half the timestep."""
        commands, past = (np.repeat(values, 2, axis=1) for values in (self.commands, self.past_commands))
        return replace(self, commands=commands, past_commands=past, stride=2 * self.stride)

    def find(self, others: Windows) -> NDArray[np.intp]:
        """Where some of them are among all, (k,)."""
        wanted = set(zip(others.recording, others.start_time.tolist(), strict=True))
        own = zip(self.recording, self.start_time.tolist(), strict=True)
        return np.array([row for row, one in enumerate(own) if one in wanted], dtype=np.intp)

    def channel_scale(self) -> Array:
        """Standard deviation of each channel over all windows, (c,): what normalised errors are relative to."""
        return np.nanstd(self.measured.reshape(-1, len(self.channels)), axis=0)

    def least_noise(self) -> Array:
        """Standard deviation of each channel's noise, (c,), below which there is none to be told from errors."""
        spread = self.channel_scale()
        return np.maximum(self.rounding, _LEAST_NOISE * np.where(spread > 0, spread, 1.0))


def cut_windows(
    model: mujoco.MjModel,
    recordings: Recording | Sequence[Recording],
    seconds: float | None = None,
    step: float | None = None,
    keyframe: str | None = None,
    history: float = 0.0,
    centred: bool = False,
) -> Windows:
    """Cut recordings into windows with estimated starts.

    Samples are compared at the multiple of the model's timestep nearest to the recording's period; commands are held
    on the timestep itself.

    Args:
        model: names the columns and gives the timestep.
        recordings: with all columns they can be compared in; all must have the same ones.
        seconds: length of a window; None for one window per recording, of its whole length (or of the shortest one's).
        step: seconds between starts; the length by default, so that windows do not overlap.
        keyframe: where joints without a column start, see :func:`estimate_states`.
        history: seconds of commands before the start to keep, at least as many as the model's delays need.
        centred: whether what windows leave over of a recording is left at both ends alike, instead of at the end.

    Raises:
        ValueError: if an actuator has no column, no column names anything in the model, recordings differ in their
            columns, windows are too short to hold two samples, or no whole window fits.
    """
    recordings = [recordings] if isinstance(recordings, Recording) else list(recordings)
    if not recordings:
        raise ValueError("windows need at least one recording")
    known = model_channels(model)
    for recording in recordings:
        _check_columns(model, recording, recordings[0], known)
    channels = tuple(known[name] for name in recordings[0].signals if name in known)
    timestep = float(model.opt.timestep)
    stride = max(1, round(max(recording.period for recording in recordings) / timestep))
    period = stride * timestep
    grids = [recording.resample(period) for recording in recordings]
    samples = min(len(grid) for grid in grids) if seconds is None else round(seconds / period) + 1
    if samples < 2:
        length = min(recording.duration for recording in recordings) if seconds is None else seconds
        raise ValueError(f"windows of {length:g} s hold no two samples that are {period:g} s apart")
    hop = samples if seconds is None else max(1, round((step or seconds) / period))
    past = max(_longest_history(model), int(np.ceil(history / timestep)) + 1)
    rounding = np.array([_rounding(recordings, channel.name) for channel in channels])
    parts = []
    for recording, grid in zip(recordings, grids, strict=True):
        last = len(grid) - samples
        starts = np.arange(last % hop // 2 if centred else 0, last + 1, hop)[: 1 if seconds is None else None]
        starts = starts[[_is_usable(recording.in_order(), grid, s, s + samples - 1) for s in starts]]
        if not len(starts):
            continue
        measured = np.stack([grid[c.name] for c in channels], axis=-1)
        commands = _commands(model, recording.in_order(), grid.time[starts], timestep, past, stride * (samples - 1))
        states = estimate_states(model, grid, starts, keyframe)
        if recording.at_rest and starts[0] == 0:
            commands[0, :past] = holding_commands(model, states.qpos[0], first=commands[0, past])
        parts.append(
            Windows(
                channels=channels,
                offsets=np.arange(samples) * np.float64(period),
                start_time=grid.time[starts],
                recording=(recording.name,) * len(starts),
                measured=measured[starts[:, None] + np.arange(samples)],
                commands=commands[:, past:],
                past_commands=commands[:, :past],
                starts=states,
                stride=stride,
                rounding=rounding,
            )
        )
    if not parts:
        wanted = "" if seconds is None else f" of {seconds:g} s"
        longest = max(recording.duration for recording in recordings)
        raise ValueError(f"no whole window{wanted} without gaps in any recording; the longest lasts {longest:g} s")
    return _join(parts)


class WindowSimulator:
    """Runs a model through windows, for many ξ at once.

    The simulated worlds are kept between calls, so a fit that calls again and again pays for them once.

    Args:
        model: the model; it is not changed.
        windows: what to run it through.
        space: the parameters that differ between ξ; None for the model as it is.
        num_threads: 0 for one per core.
    """

    def __init__(
        self, model: mujoco.MjModel, windows: Windows, space: ParameterSpace | None = None, num_threads: int = 0
    ):
        self.windows = windows
        self.space = space if space is not None else ParameterSpace(())
        numbers_per_window = (windows.commands.shape[1] + 1) * sum(field_sizes(model, windows.channels).values())
        self._xi_at_once = max(1, _NUMBERS_AT_ONCE // (numbers_per_window * len(windows)))
        self._engine: BatchEngine | RolloutEngine
        try:
            import mujoco.batch  # noqa: F401
        except ImportError:
            self._engine = RolloutEngine(model, self.space, windows, num_threads)
        else:
            self._engine = BatchEngine(model, self.space, windows, num_threads)

    def __call__(
        self, xi: ArrayLike | None = None, starts: States | None = None, commands: Array | None = None
    ) -> Array:
        """Simulate the windows.

        Args:
            xi: (n, d); None for the model as it is, n = 1.
            starts: states other than the windows' own: w, or n w, the first ξ's w first.
            commands: other than the windows' own, for each ξ, (n w, N, nu).

        Returns:
            (n, w, S, c), NaN from where a simulation diverged.

        Raises:
            ValueError: for values that the space does not allow.
        """
        values = self.space.validate(np.atleast_2d(self.space.nominal if xi is None else np.asarray(xi)))
        starts = self.windows.starts if starts is None else starts
        if len(starts) == len(self.windows):
            starts = starts.select(np.tile(np.arange(len(starts)), len(values)))
        per_xi = np.arange(len(starts)).reshape(len(values), -1)
        if commands is None:
            commands = np.tile(self.windows.commands, (len(values), 1, 1))
        chunks = [slice(i, i + self._xi_at_once) for i in range(0, len(values), self._xi_at_once)]
        rows = [(chunk, per_xi[chunk].ravel()) for chunk in chunks]
        return np.concatenate([self._engine.run(values[c], starts.select(r), commands[r]) for c, r in rows])


def simulate_windows(
    model: mujoco.MjModel, windows: Windows, space: ParameterSpace | None = None, xi: ArrayLike | None = None
) -> Array:
    """Predicted channels (n, w, S, c) for n vectors ξ (n, d); see :class:`WindowSimulator` to call repeatedly."""
    return WindowSimulator(model, windows, space)(xi)


def _longest_history(model: mujoco.MjModel) -> int:
    """Past commands that the start of a window needs, at least the one in force."""
    filters = np.isin(model.actuator_dyntype, (mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT))
    slowest = float(np.max(model.actuator_dynprm[filters, 0], initial=0.0))
    delayed = int(np.max(np.ravel(model.actuator_history[:, 0]), initial=0)) if model.nhistory else 0
    return max(1, delayed + int(np.ceil(_TIME_CONSTANTS * slowest / model.opt.timestep)))


def _commands(
    model: mujoco.MjModel, recording: Recording, starts: Array, timestep: float, past: int, future: int
) -> Array:
    """Commands (w, past + future, nu) on the model's timestep around each start."""
    at = starts[:, None] + timestep * np.arange(-past, future)
    columns = [hold(recording.time, recording[f"ctrl/{name}"], at) for name in actuator_names(model)]
    return np.stack(columns, axis=-1) if columns else np.empty((*at.shape, 0))


def _rounding(recordings: Sequence[Recording], column: str) -> float:
    """What a column is off by where it stands on one count; of several recordings, as the finest steps say."""
    found = [rounding_noise(recording[column]) for recording in recordings]
    return min((noise for noise in found if noise > 0), default=0.0)


def _is_usable(recording: Recording, grid: Recording, start: int, end: int) -> bool:
    """Whether a window holds no gap in time and no missing joint position at its start."""
    interval = longest_interval(recording.time, grid.time[start], min(grid.time[end], recording.time[-1]))
    continuous = interval <= GAP_PERIODS * recording.period
    known = all(np.isfinite(grid[name][start]) for name in grid.signals if name.startswith("qpos/"))
    return continuous and known


def _check_columns(model: mujoco.MjModel, recording: Recording, first: Recording, known: dict[str, Channel]) -> None:
    """Raise ValueError where a recording cannot be replayed."""
    actuators = actuator_names(model)
    if unnamed := [str(i) for i, name in enumerate(actuators) if not name]:
        raise ValueError(
            f"the model's actuators {', '.join(unnamed)} have no name; commands are read from columns ctrl/NAME: give"
            " them names in the MJCF"
        )
    if missing := [name for name in actuators if f"ctrl/{name}" not in recording.columns]:
        raise ValueError(
            f"{recording.name} has no command column for the actuators {', '.join(missing)}; it has"
            f" {', '.join(recording.commands) or 'none'}"
        )
    for name in recording.commands:
        if name in known and not np.isfinite(recording[name]).all():
            raise ValueError(f"{recording.name}: command {name} has values that are not finite")
    compared = [name for name in recording.signals if name in known]
    if not compared:
        raise ValueError(
            f"no column of {recording.name} names anything in the model: it has {', '.join(recording.columns)}; the"
            f" model has {', '.join(known)}"
        )
    if set(compared) != {name for name in first.signals if name in known}:
        raise ValueError(f"{recording.name} and {first.name} are compared in different columns; select common ones")


def _join(parts: list[Windows]) -> Windows:
    """Windows of several recordings as one set."""
    first = parts[0]

    def rows(attribute: str) -> NDArray[np.float64]:
        return np.concatenate([getattr(part, attribute) for part in parts])

    states = [np.concatenate([getattr(part.starts, field.name) for part in parts]) for field in fields(States)]
    return Windows(
        channels=first.channels,
        offsets=first.offsets,
        start_time=rows("start_time"),
        recording=tuple(name for part in parts for name in part.recording),
        measured=rows("measured"),
        commands=rows("commands"),
        past_commands=rows("past_commands"),
        starts=States(*states),
        stride=first.stride,
        rounding=first.rounding,
    )
