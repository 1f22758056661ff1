"""Many worlds on MuJoCo Warp (https://github.com/google-deepmind/mujoco_warp): thousands of them on one GPU.

:class:`WarpSimulation` is a :class:`~simopt_envs.physics.simulation.Simulation` whose arrays are torch tensors that
share their memory with Warp: what a task observes and rewards stays on the device. It computes in single precision.
"""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from simopt_envs.physics.parameters import Array, ParameterSpace
from simopt_envs.physics.simulation import CommandHistory
from simopt_envs.physics.writer import ModelWriter, model_field

if TYPE_CHECKING:
    from torch import Tensor

_UNUSED_BY_WARP = ("numeric_data", "site_size")
"""Fields that no dynamics depend on and that Warp keeps one of, or none: tasks still read them per world."""
_DERIVED = (
    "body_subtreemass",
    "body_invweight0",
    "dof_invweight0",
    "tendon_invweight0",
    "tendon_length0",
    "actuator_acc0",
    "eq_data",
    "geom_aabb",
    "geom_rbound",
)
"""Fields that Warp's ``set_const`` computes from those that ξ writes."""
_GREATEST_STATE = 1e10
"""Of a world that has not diverged, as in MuJoCo (mjMAXVAL)."""


class WarpSimulation:
    """n worlds on one device; see :class:`~simopt_envs.physics.simulation.Simulation`.

    Args:
        model: the model.
        space: the parameters that differ between worlds.
        num_worlds: n.
        device: of Warp: "cuda:0", "cpu", ...; None for its default, the first GPU where there is one.

    Raises:
        ImportError: without MuJoCo Warp.
        ValueError: for parameters that write a field that is not per world in Warp.
        NotImplementedError: by Warp, for models with features that it lacks.
    """

    def __init__(self, model: mujoco.MjModel, space: ParameterSpace, num_worlds: int, device: str | None = None):
        try:
            import mujoco_warp as mjw
            import torch
            import warp as wp
        except ImportError:
            raise ImportError('the backend "warp" needs MuJoCo Warp: pip install "simopt-envs[warp]"') from None
        self.model = model
        self.num_worlds = num_worlds
        self._writer = ModelWriter(model, space)
        self._history = CommandHistory(model)
        self._device = wp.get_device(device)
        self._torch_device = torch.device(wp.device_to_torch(self._device))
        per_world = {f.name for f in fields(mjw.Model) if "*" in getattr(f.type, "shape", ())[:1]}
        written = [name for name in self._writer.fields if name not in _UNUSED_BY_WARP]
        if shared := [name for name in written if name not in per_world]:
            raise ValueError(
                f"MuJoCo Warp {mjw.__version__} has the same {', '.join(shared)} in all worlds: "
                "no parameter may write that with the backend 'warp'"
            )
        batched = {*written, *(_DERIVED if self._writer.needs_set_const else ())} & per_world
        with wp.ScopedDevice(self._device):
            self._model = mjw.put_model(model, dict.fromkeys(batched, num_worlds))
            self._data = mjw.make_data(model, num_worlds)
        self._model.opt.warn_overflow = 0  # a world that overflows counts as diverged
        self._fields = {name: self._tensor(getattr(self._model, name), model_field(model, name)) for name in written}
        for name in set(self._writer.fields) - set(written):
            nominal = self.asarray(model_field(model, name))
            self._fields[name] = nominal.expand(num_worlds, *nominal.shape).clone()
        self._overflow = wp.to_torch(self._data.overflow)
        self._bound: dict[str, Tensor] = {}
        self._reference = mujoco.MjData(model)  # for the shapes of its fields
        self._graphs: dict[int, Any] = {}
        # Of bodies that only slide, Warp's set_const has other inverse weights than MuJoCo, by a factor without ξ.
        self._weights, self._factors = wp.to_torch(self._model.body_invweight0), self.asarray(model.body_invweight0)
        if self._writer.needs_set_const:
            with wp.ScopedDevice(self._device):
                mjw.set_const(self._model, self._data)
            self._factors = torch.where(self._weights[0] == 0.0, 1.0, self._factors / self._weights[0])
            self._weights *= self._factors

    def asarray(self, values: ArrayLike) -> Tensor:
        """See :meth:`Simulation.asarray`."""
        import torch

        tensor = torch.as_tensor(values, device=self._torch_device)
        return tensor.float() if tensor.is_floating_point() else tensor

    def data(self, field: str) -> Tensor:
        """See :meth:`Simulation.data`."""
        if field not in self._bound:
            self._bound[field] = self._tensor(getattr(self._data, field), getattr(self._reference, field))
        return self._bound[field]

    def model_field(self, field: str) -> Tensor:
        """See :meth:`Simulation.model_field`."""
        return self._fields[field] if field in self._fields else self.asarray(model_field(self.model, field)[None])

    def write(self, worlds: NDArray[np.intp], xi: Array) -> None:
        """See :meth:`Simulation.write`."""
        import mujoco_warp as mjw
        import warp as wp

        if not len(worlds):
            return
        rows = {name: model_field(self.model, name)[None].repeat(len(worlds), axis=0) for name in self._fields}
        self._writer.write(xi, rows.__getitem__)
        for name, values in rows.items():
            self._fields[name][worlds] = self.asarray(values)
        with wp.ScopedDevice(self._device):
            if self._writer.needs_set_const:
                mjw.set_const(self._model, self._data)
                self._weights *= self._factors
            # Kinematics leaves out the geoms of bodies that cannot move, but ξ does move some.
            welded_to, self._model.body_weldid = self._model.body_weldid, wp.full(self.model.nbody, -1, dtype=int)
            mjw.kinematics(self._model, self._data)
            self._model.body_weldid = welded_to

    def reset(self, worlds: NDArray[np.intp], qpos: Array, qvel: Array, ctrl: Array) -> None:
        """See :meth:`Simulation.reset`."""
        import mujoco_warp as mjw
        import warp as wp

        if not len(worlds):
            return
        chosen = np.zeros(self.num_worlds, dtype=bool)
        chosen[worlds] = True
        with wp.ScopedDevice(self._device):
            mjw.reset_data(self._model, self._data, wp.array(chosen, dtype=bool))
            for field, value in (("qpos", qpos), ("qvel", qvel), ("ctrl", ctrl)):
                self.data(field)[worlds] = self.asarray(value)
            if self.model.nhistory:
                filled = self.data("history")[worlds]
                self._history.fill(filled, self.asarray(ctrl))
                self.data("history")[worlds] = filled
            mjw.kinematics(self._model, self._data)

    def step(self, ctrl: Tensor, substeps: int) -> Tensor:
        """See :meth:`Simulation.step`."""
        import warp as wp

        self.data("ctrl").copy_(ctrl)
        with wp.ScopedDevice(self._device):
            if not self._device.is_cuda:
                self._advance(substeps)
            elif substeps not in self._graphs:
                self._advance(substeps)  # compiles the kernels, too
                with wp.ScopedCapture() as capture:
                    self._advance(substeps)
                self._graphs[substeps] = capture.graph
            else:
                wp.capture_launch(self._graphs[substeps])
        sound = self._overflow == 0
        for field in ("qpos", "qvel"):
            sound &= (self.data(field).abs() < _GREATEST_STATE).all(dim=1)  # False for NaN
        return ~sound

    def _advance(self, substeps: int) -> None:
        import mujoco_warp as mjw

        for _ in range(substeps):
            mjw.step(self._model, self._data)
        mjw.kinematics(self._model, self._data)

    def _tensor(self, array: Any, like: Any) -> Tensor:
        """A Warp array (n, ...) as a tensor of the same memory, each row shaped as in MuJoCo."""
        import warp as wp

        return wp.to_torch(array).reshape(self.num_worlds, *np.shape(like))
