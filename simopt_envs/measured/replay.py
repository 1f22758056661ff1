"""How far a model is from a recording: the recorded commands through the model, window by window."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from simopt_envs.measured.recording import Finding, Recording, warnings_of, with_distinct_names
from simopt_envs.measured.resample import Array
from simopt_envs.measured.states import States
from simopt_envs.measured.windows import Windows, WindowSimulator, cut_windows
from simopt_envs.physics.parameters import ParameterSpace

_UNSEEN = 0.5  # standard error of a start [rad, m] above which its joint counts as unseen: half of its prior's


@dataclass(frozen=True)
class Replay:
    """Measured windows beside what the model made of their commands.

    Attributes:
        windows: the windows, with the measured channels (w, S, c).
        simulated: (n, w, S, c) for n vectors ξ; NaN from where a simulation diverged.
        start_spread: standard deviation of the simulated channels that comes of the errors of the estimated starts
            alone, (w, S, c), at the first ξ.
        warnings: of the recordings.
    """

    windows: Windows
    simulated: Array
    start_spread: Array
    warnings: tuple[Finding, ...] = ()

    @property
    def error(self) -> Array:
        """Simulated minus measured, (n, w, S, c)."""
        return self.simulated - self.windows.measured

    @property
    def rmse(self) -> Array:
        """Root-mean-square error of each channel over all windows, (n, c); infinite where a simulation diverged."""
        return _rms(self._penalised(), axis=(1, 2))

    @property
    def normalised_rmse(self) -> Array:
        """The same relative to each channel's standard deviation, (n, c); NaN for a constant channel."""
        scale = self.windows.channel_scale()
        return self.rmse / np.where(scale > 0, scale, np.nan)

    @property
    def rmse_by_horizon(self) -> Array:
        """Root-mean-square error against the time since the start, (n, S, c)."""
        return _rms(self._penalised(), axis=1)

    @property
    def start_rmse(self) -> Array:
        """The part of the error that the estimated starts alone would leave a perfect model with, (c,)."""
        return _rms(self.start_spread, axis=(0, 1))

    def _penalised(self) -> Array:
        diverged = np.isnan(self.simulated) & np.isfinite(self.windows.measured)
        return np.where(diverged, np.inf, self.error)

    def __str__(self) -> str:
        length = self.windows.offsets[-1]
        rows = [
            f"{len(self.windows)} windows of {length:g} s; RMSE, relative to the channel, and from the starts alone"
        ]
        for c, channel in enumerate(self.windows.channels):
            rows.append(
                f"  {channel.name:<24} {self.rmse[0, c]:10.4g} {channel.unit:<6} {self.normalised_rmse[0, c]:8.3g}"
                f" {self.start_rmse[c]:10.2g}"
            )
        return "\n".join([*rows, *(f"  {warning}" for warning in self.warnings)])

    def save_table(self, path: str | Path) -> Path:
        """Write the error of each channel at each horizon as CSV: offset [s], then one column a channel, first ξ."""
        with Path(path).open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["horizon", *self.windows.names])
            writer.writerows(
                [offset, *row]
                for offset, row in zip(self.windows.offsets, self.rmse_by_horizon[0].tolist(), strict=True)
            )
        return Path(path)


def replay(
    model: mujoco.MjModel,
    recordings: Recording | Sequence[Recording],
    *,
    seconds: float | None = None,
    step: float | None = None,
    keyframe: str | None = None,
    space: ParameterSpace | None = None,
    xi: ArrayLike | None = None,
) -> Replay:
    """Run the recorded commands through a model and compare.

    Args:
        model: the model; its object names are the recordings' column names.
        recordings: one or several with the same columns.
        seconds: length of the windows (multiple shooting); None for each recording as a whole.
        step: seconds between the starts of windows; their length by default.
        keyframe: where joints without a column start.
        space: the parameters that ``xi`` gives values of.
        xi: (n, d) or (d,); None for the model as it is.

    Raises:
        ValueError: where the recordings cannot be replayed on this model, see :func:`cut_windows`.
    """
    recordings = with_distinct_names([recordings] if isinstance(recordings, Recording) else recordings)
    windows = cut_windows(model, recordings, seconds, step, keyframe)
    simulator = WindowSimulator(model, windows, space)
    simulated = simulator(xi)
    first_xi = None if xi is None else np.atleast_2d(np.asarray(xi, dtype=np.float64))[:1]
    spread = np.sqrt(np.sum(start_sensitivity(model, simulator, first_xi, simulated[0]) ** 2, axis=0))
    warnings = (*warnings_of(recordings), *unseen_joints(model, windows.starts))
    return Replay(windows, simulated, spread, warnings)


class Simulator(Protocol):
    """Anything that simulates windows as :class:`WindowSimulator` does."""

    @property
    def windows(self) -> Windows:
        """What it is run through."""
        ...

    def __call__(self, xi: Array | None = None, starts: States | None = None) -> Array:
        """See :meth:`WindowSimulator.__call__`."""
        ...


def start_sensitivity(
    model: mujoco.MjModel, simulator: Simulator, xi: Array | None = None, nominal: Array | None = None
) -> Array:
    """How the predictions move when one number of the start moves by its standard error.

    Stacked as columns of S these give the covariance that uncertain starts leave on a window, S Sᵀ, with which a fit
    can whiten its residuals.

    Args:
        model: the simulator's model.
        simulator: of the windows.
        xi: one vector (1, d); None for the model as it is.
        nominal: the unperturbed prediction (w, S, c), where it is known.

    Returns:
        (2 nv, w, S, c): positions first, then velocities.
    """
    nominal = simulator(xi)[0] if nominal is None else nominal
    perturbed = [simulator(xi, starts)[0] for starts in _perturbed(model, simulator.windows.starts)]
    return np.array(perturbed).reshape(2 * model.nv, *nominal.shape) - nominal


def start_curvature(model: mujoco.MjModel, simulator: Simulator, xi: Array | None = None, errors: float = 1.0) -> Array:
    """What :func:`start_sensitivity`, which is linear, leaves out: half of the second derivative, (2 nv, w, S, c).

    Args:
        model: the simulator's model.
        simulator: of the windows.
        xi: one vector (1, d); None for the model as it is.
        errors: standard errors of the start that differences are taken over.
    """
    nominal, starts = simulator(xi)[0], simulator.windows.starts
    pairs = zip(_perturbed(model, starts, errors), _perturbed(model, starts, -errors), strict=True)
    both = [(simulator(xi, above)[0] + simulator(xi, below)[0]) / 2 for above, below in pairs]
    return (np.array(both).reshape(2 * model.nv, *nominal.shape) - nominal) / errors**2


def _perturbed(model: mujoco.MjModel, starts: States, errors: float = 1.0) -> Iterator[States]:
    """The starts with one degree of freedom after the other moved by so many of its standard errors."""
    for dof in range(model.nv):
        qpos = starts.qpos.copy()
        for row, error in zip(qpos, starts.qpos_error[:, dof], strict=True):
            mujoco.mj_integratePos(model, row, np.eye(model.nv)[dof], errors * float(error))
        yield replace(starts, qpos=qpos)
    for dof in range(model.nv):
        qvel = starts.qvel.copy()
        qvel[:, dof] += errors * starts.qvel_error[:, dof]
        yield replace(starts, qvel=qvel)


def unseen_joints(model: mujoco.MjModel, starts: States) -> Iterator[Finding]:
    """A warning for each joint whose start nothing in the recording determines."""
    for i in range(model.njnt):
        dof = int(model.jnt_dofadr[i])
        if np.median(starts.qpos_error[:, dof]) > _UNSEEN:
            message = "no column tells where it is: it starts at the model's reference"
            yield Finding.warning(f"qpos/{model.joint(i).name}", "start", message)


def _rms(values: Array, axis: int | tuple[int, ...]) -> Array:
    """Root of the mean square without the missing ones; NaN where all are missing."""
    known = ~np.isnan(values)
    total = np.sum(np.where(known, values, 0.0) ** 2, axis=axis)
    count = known.sum(axis=axis)
    return np.sqrt(np.divide(total, count, out=np.full(np.shape(total), np.nan), where=count > 0))
