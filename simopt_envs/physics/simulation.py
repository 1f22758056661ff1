"""A simulation of one or many worlds of one model, each with its own ξ, behind one narrow face.

Tasks, environments and the driver see only :class:`Simulation`. :class:`SingleSimulation` runs one world on any MuJoCo,
:class:`BatchSimulation` many on the threads of ``mujoco.batch`` (MuJoCo >= 3.17). Both give the same trajectories.
:class:`~simopt_envs.physics.warp_simulation.WarpSimulation` runs thousands on a GPU, in single precision.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from simopt_envs.physics.parameters import Array, ParameterSpace
from simopt_envs.physics.profiler import PROFILER_RESTS
from simopt_envs.physics.writer import ModelWriter, actuator_rows, model_field

_POSITIONS = int(mujoco.mjtStage.mjSTAGE_POS)
_DIVERGED = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)


class Simulation(Protocol):
    """n worlds of one model. Arrays have the worlds as first axis.

    What comes and goes with every step are arrays of the simulation's own kind, NumPy's or torch's on some device;
    what is told of worlds that begin an episode are NumPy's.
    """

    num_worlds: int
    model: mujoco.MjModel

    def asarray(self, values: Any) -> Any:
        """Values as an array of the simulation's kind; floating-point numbers in its precision."""
        ...

    def data(self, field: str) -> Any:
        """An ``MjData`` field of all worlds, (n, ...), live: it follows the simulation. Read only."""
        ...

    def model_field(self, field: str) -> Any:
        """An ``MjModel`` field of all worlds as ξ has it, (n, ...) or, where no parameter writes it, (1, ...)."""
        ...

    def write(self, worlds: NDArray[np.intp], xi: Array) -> None:
        """Give k worlds their values of the parameters, (k, d)."""
        ...

    def reset(self, worlds: NDArray[np.intp], qpos: Array, qvel: Array, ctrl: Array) -> None:
        """Put k worlds into a state, (k, nq), (k, nv), at time 0, with ``ctrl`` (k, nu) as the commands so far."""
        ...

    def step(self, ctrl: Any, substeps: int) -> Any:
        """Hold ``ctrl`` (n, nu) for some steps of the model; return which worlds diverged, (n,) bool.

        Positions, what follows from them, and velocities are current afterwards.
        """
        ...


class SingleSimulation:
    """One world on plain ``mujoco.mj_step``.

    Attributes:
        on_timestep: called after each step of the model within :meth:`step` with its number, from 1 on: a logger that
            is faster than the commands.
    """

    num_worlds = 1

    def __init__(self, model: mujoco.MjModel, space: ParameterSpace):
        self.on_timestep: Callable[[int], None] | None = None
        self.model = model
        self.mj_data = mujoco.MjData(model)
        self._writer = ModelWriter(model, space)
        self._history = CommandHistory(model)

    def asarray(self, values: ArrayLike) -> np.ndarray:
        """See :meth:`Simulation.asarray`."""
        return _asarray(values)

    def data(self, field: str) -> np.ndarray:
        """See :meth:`Simulation.data`."""
        return getattr(self.mj_data, field)[None]

    def model_field(self, field: str) -> np.ndarray:
        """See :meth:`Simulation.model_field`."""
        return model_field(self.model, field)[None]

    def write(self, worlds: NDArray[np.intp], xi: Array) -> None:
        """See :meth:`Simulation.write`."""
        if len(worlds):
            self._writer.write_model(xi[0], self.model, self.mj_data)

    def reset(self, worlds: NDArray[np.intp], qpos: Array, qvel: Array, ctrl: Array) -> None:
        """See :meth:`Simulation.reset`."""
        if len(worlds):
            mujoco.mj_resetData(self.model, self.mj_data)
            self.mj_data.qpos[:], self.mj_data.qvel[:], self.mj_data.ctrl[:] = qpos[0], qvel[0], ctrl[0]
            if self.model.nhistory:
                self._history.fill(self.mj_data.history[None], ctrl)
            mujoco.mj_forward(self.model, self.mj_data)

    def step(self, ctrl: Array, substeps: int) -> NDArray[np.bool_]:
        """See :meth:`Simulation.step`."""
        before = self._warnings()
        self.mj_data.ctrl[:] = ctrl[0]
        if self.on_timestep is None:
            mujoco.mj_step(self.model, self.mj_data, substeps)
        else:
            for number in range(1, substeps + 1):
                mujoco.mj_step(self.model, self.mj_data)
                self.on_timestep(number)
        mujoco.mj_step1(self.model, self.mj_data)
        return np.array([self._warnings() != before])

    def _warnings(self) -> int:
        return sum(int(self.mj_data.warning[int(w)].number) for w in _DIVERGED)


class BatchSimulation:
    """n worlds on the threads of ``mujoco.batch``; the same trajectories whatever n and the number of threads.

    Args:
        model: the model, copied.
        space: the parameters that differ between worlds.
        num_worlds: n.
        num_threads: 0 for one per core.

    Raises:
        ImportError: where MuJoCo is older than 3.17.
    """

    def __init__(self, model: mujoco.MjModel, space: ParameterSpace, num_worlds: int, num_threads: int = 0):
        try:
            from mujoco.batch import Batch
        except ImportError:
            raise ImportError(
                f"the native vector environment needs mujoco >= 3.17, found {mujoco.__version__}; "
                'use gym.make_vec(id, num_envs, vectorization_mode="async") instead'
            ) from None
        self.model = model
        self.num_worlds = num_worlds
        self._batch = Batch(model, num_worlds, num_threads)
        self._writer = ModelWriter(model, space)
        self._history = CommandHistory(model)
        self._bound: dict[str, np.ndarray] = {}
        self._fields = {name: self._batch.expand(name) for name in self._writer.fields}

    def asarray(self, values: ArrayLike) -> np.ndarray:
        """See :meth:`Simulation.asarray`."""
        return _asarray(values)

    def data(self, field: str) -> np.ndarray:
        """See :meth:`Simulation.data`."""
        if field not in self._bound:
            self._bound[field] = self._batch.bind(field)
            self._batch.forward(stage=_POSITIONS)  # what is bound between calls is zero until the next one
        return self._bound[field]

    def model_field(self, field: str) -> np.ndarray:
        """See :meth:`Simulation.model_field`."""
        return self._fields[field] if field in self._fields else model_field(self.model, field)[None]

    def write(self, worlds: NDArray[np.intp], xi: Array) -> None:
        """See :meth:`Simulation.write`."""
        if len(worlds):
            self._writer.write(xi, self._fields.__getitem__, worlds)
            if self._writer.needs_set_const:
                self._batch.set_const(worlds)

    def reset(self, worlds: NDArray[np.intp], qpos: Array, qvel: Array, ctrl: Array) -> None:
        """See :meth:`Simulation.reset`."""
        if len(worlds):
            self._batch.reset(worlds, stage=int(mujoco.mjtStage.mjSTAGE_NONE))
            for field, value in (("qpos", qpos), ("qvel", qvel), ("ctrl", ctrl)):
                self._batch.bind(field)[worlds] = value
            if self.model.nhistory:
                history = self._batch.bind("history")
                filled = history[worlds]
                self._history.fill(filled, ctrl)
                history[worlds] = filled
            self._batch.forward(worlds)

    def step(self, ctrl: Array, substeps: int) -> NDArray[np.bool_]:
        """See :meth:`Simulation.step`."""
        from mujoco.batch import SimulationError

        before = self._warnings()
        self._batch.bind("ctrl")[:] = ctrl
        failed = np.zeros(self.num_worlds, dtype=bool)
        try:
            with PROFILER_RESTS:
                self._batch.step(nstep=substeps, stage=_POSITIONS)
        except SimulationError as error:
            failed[error.ids] = True
        return failed | (self._warnings() != before)

    def world(self, index: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """One world's model and data, to render or inspect; they do not follow it."""
        model, data = self._batch.get_model(index), self._batch.get_data(index)
        mujoco.mj_forward(model, data)
        return model, data

    def _warnings(self) -> NDArray[np.int64]:
        return self._batch.warning[:, [int(w) for w in _DIVERGED], 1].sum(axis=1)


def _asarray(values: ArrayLike) -> np.ndarray:
    array = np.asarray(values)
    return array.astype(np.float64, copy=False) if array.dtype.kind == "f" else array


class CommandHistory:
    """Fills the buffers of delayed actuators, so that an episode starts as if its first command had always held.

    MuJoCo resets them to zero: a servo with a delay would first be driven towards joint position 0.
    """

    def __init__(self, model: mujoco.MjModel):
        # A buffer is [user slot, cursor, n times, n times the actuator's commands].
        lengths = np.ravel(model.actuator_history[:, 0])
        buffers = zip(model.actuator_historyadr, lengths, *actuator_rows(model, "ctrl"), strict=True)
        self._slots = [
            (int(first) + k, slice(int(adr + 2 + n) + k, int(adr + 2 + n + n * count), int(count)))
            for adr, n, first, count in buffers
            if n > 0
            for k in range(count)
        ]

    def fill(self, history: Any, ctrl: Any) -> None:
        """Write ``ctrl`` (k, nu) as every past command into ``history`` (k, nhistory), in place."""
        for command, past in self._slots:
            history[:, past] = ctrl[:, command, None]
