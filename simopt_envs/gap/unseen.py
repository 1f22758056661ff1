"""Joints without a column: where they start is told by sites and sensors, and so by what an effect makes of these."""

from __future__ import annotations

import copy

import mujoco
import numpy as np
from numpy.typing import NDArray

from simopt_envs.measured.states import States, depends_on_stage, read_state
from simopt_envs.measured.windows import Windows
from simopt_envs.physics.columns import ColumnModel
from simopt_envs.physics.parameters import Array, ParameterSpace
from simopt_envs.physics.writer import ModelWriter

_DIFFERENCE = 1e-6  # rad or m: moves joints to see what sites and sensors make of it
_EXACT = 1e-12  # rad or m: no farther from where they show it
_OFF = 1e-3  # of a parameter, or of its logarithm: what tells whether it moves anything
_STEPS = 10  # towards it, at most


class UnseenJoints:
    """Where joints without a column start in a model that an effect changes: where sites and sensors show the same.

    Starts were estimated with the model as given. If a site is elsewhere on a drawer, or a sensor is biased, what was
    measured means another position of the drawer. Velocities stay as they are: those of what is shown late would need
    accelerations.

    Args:
        model: with the structure of the effects; it is not changed.
        space: its parameters.
        windows: in this model.
        given: the model as given. What the effects add to it is no joint that a sensor could have.
    """

    def __init__(self, model: mujoco.MjModel, space: ParameterSpace, windows: Windows, given: mujoco.MjModel):
        seen = {channel.object for channel in windows.channels if channel.kind == "qpos"}
        theirs = {given.joint(j).name for j in range(given.njnt)}
        joints = [j for j in range(model.njnt) if j not in seen and model.joint(j).name in theirs]
        self._dofs = np.flatnonzero(np.isin(model.dof_jntid, joints))
        position = mujoco.mjtStage.mjSTAGE_POS
        self._columns = [c for c, channel in enumerate(windows.channels) if depends_on_stage(model, channel, position)]
        self._channels = [windows.channels[c] for c in self._columns]
        if not self:  # a model with meshes is large, and most have an encoder at every joint
            return
        self._model, self._data, self._nominal = copy.copy(model), mujoco.MjData(model), space.nominal
        self._writer = ModelWriter(self._model, space)
        self._moving = self._that_move(space, windows.starts.qpos[0])
        self._starts, self._told = windows.starts, self._tell(windows.starts)

    def __bool__(self) -> bool:
        return bool(len(self._dofs) and self._columns)

    def place(self, qpos: Array, starts: States, xi: Array, of_model: list[int], shown_by: ColumnModel) -> None:
        """Move them, in place, to where the columns come nearest to what they show at some starts without the effect.

        Args:
            qpos: postures, (n w, nq), all else in place.
            starts: the w of them without the effect.
            xi: (n, d).
            of_model: the places of the model's parameters in it.
            shown_by: what columns show.
        """
        shown, rates, gains = self._told if starts is self._starts else self._tell(starts)
        meant = np.stack(
            [shown_by.meant(c, xi, *told) for c, *told in zip(self._columns, shown.T, rates.T, strict=True)], axis=-1
        )
        placed: dict[bytes, Array] = {}  # most ξ differ in nothing that sites or sensors are moved by
        for at_xi, row, wanted in zip(qpos.reshape(len(xi), len(starts), -1), xi, meant, strict=True):
            told = np.concatenate([row[of_model][self._moving], wanted.ravel(), at_xi.ravel()]).tobytes()
            if told not in placed:
                self._writer.write_model(row[of_model], self._model, self._data)
                self._move(at_xi, gains, wanted)
                placed[told] = at_xi
            at_xi[:] = placed[told]

    def _move(self, postures: Array, gains: Array, wanted: Array) -> None:
        """Move the joints of postures (w, nq), in place, to where the columns read what is wanted, (w, c)."""
        tangent = np.zeros(self._model.nv)
        for posture, gain, values in zip(postures, gains, wanted, strict=True):
            for _ in range(_STEPS):
                tangent[self._dofs] = gain @ (values - self._read(posture))
                if np.max(np.abs(tangent)) < _EXACT:
                    break
                mujoco.mj_integratePos(self._model, posture, tangent, 1.0)

    def _that_move(self, space: ParameterSpace, posture: Array) -> NDArray[np.intp]:
        """Which parameters change what is read in a posture, where all others are off neutral.

        Few do. Of many that change nothing where all of them are neutral at once, none does.
        """
        neutral = space.to_unconstrained(space.nominal)
        more, less = (np.clip(space.from_unconstrained(neutral + d), space.low, space.high) for d in (_OFF, -_OFF))
        off = np.where(more != space.nominal, more, less)

        def read(at_neutral: NDArray[np.intp]) -> Array:
            row = off.copy()
            row[at_neutral] = space.nominal[at_neutral]
            self._writer.write_model(row, self._model, self._data)
            return self._read(posture)

        def moving(some: NDArray[np.intp]) -> list[int]:
            if np.array_equal(read(some), all_off):
                return []
            return some.tolist() if len(some) == 1 else [i for half in np.array_split(some, 2) for i in moving(half)]

        every = np.arange(len(space))
        all_off = read(every[:0])
        return np.array(moving(every), dtype=np.intp)

    def _tell(self, starts: States) -> tuple[Array, Array, Array]:
        """What columns show without the effect, (w, c), its rates, and how joints follow from it, (w, joints, c)."""
        self._writer.write_model(self._nominal, self._model, self._data)
        shown = np.array([self._read(start) for start in starts.qpos])
        units = np.eye(self._model.nv)[self._dofs]
        at = list(zip(starts.qpos, shown, strict=True))
        rates = np.array([self._rate(*here, qvel) for here, qvel in zip(at, starts.qvel, strict=True)])
        by_joint = np.array([[self._rate(*here, unit) for unit in units] for here in at])
        return shown, rates, np.linalg.pinv(by_joint.transpose(0, 2, 1), rcond=1e-6)

    def _read(self, qpos: Array) -> Array:
        return read_state(self._model, self._data, qpos, np.zeros(self._model.nv), self._channels)

    def _rate(self, qpos: Array, shown: Array, qvel: Array) -> Array:
        """Of what is shown in a posture, (c,), at a velocity (nv,)."""
        later = qpos.copy()
        mujoco.mj_integratePos(self._model, later, qvel, _DIFFERENCE)
        return (self._read(later) - shown) / _DIFFERENCE
