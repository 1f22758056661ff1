"""Inertia, and what gravity does to it: rotors, payloads, balances, a base that stands askew."""

# ruff: noqa: D102 - the hooks are documented in truth.Law

from __future__ import annotations

from dataclasses import dataclass
from math import cos, pi, sin

import mujoco
import numpy as np

from benchmarks.hidden_effects.laws.places import AtJoint
from benchmarks.hidden_effects.plants import Array
from benchmarks.hidden_effects.truth import Law, Rotor, World


@dataclass
class NativeInertia(AtJoint):
    """More armature."""

    inertia: float

    def build(self, spec: mujoco.MjSpec) -> None:
        spec.joint(self.joint).armature += self.inertia


@dataclass
class Flywheel(AtJoint):
    """An inertia on a stiff belt instead of a rigid one; the belt's resonance is at ``frequency``."""

    inertia: float
    frequency: float = 40.0

    def start(self, world: World) -> None:
        super().start(world)
        q, v = self._state(world)
        omega = 2 * pi * self.frequency
        stiffness, damping = self.inertia * omega**2, 2 * 0.3 * self.inertia * omega
        self._wheel = Rotor(self.inertia, lambda twist, rate: stiffness * twist + damping * rate, q, v)

    def load(self, world: World) -> None:
        world.force[self._dof] += self._wheel.step(*self._state(world), 0.0)


@dataclass
class Payload(Law):
    """A mass on a body, at its load point, or beside it with an inertia of its own; it may be let go.

    It goes into the body's own mass and inertia.

    Attributes:
        body: that carries it.
        mass: [kg].
        position: in the body's frame [m].
        radius: of gyration [m].
        release: time at which it is dropped [s].
    """

    body: str
    mass: float
    position: tuple[float, float, float]
    radius: float = 1e-3
    release: float = np.inf

    def build(self, spec: mujoco.MjSpec) -> None:
        body = spec.body(self.body)
        frame = np.empty(9)
        mujoco.mju_quat2Mat(frame, body.iquat)
        axes = frame.reshape(3, 3)
        parts = (
            (float(body.mass), np.array(body.ipos), axes @ np.diag(body.inertia) @ axes.T),
            (self.mass, np.array(self.position), self.mass * self.radius**2 * np.eye(3)),
        )
        mass = sum(m for m, _, _ in parts)
        centre = sum((m * at for m, at, _ in parts), np.zeros(3)) / mass
        inertia = np.zeros((3, 3))
        for m, at, own in parts:
            inertia += own + m * ((at - centre) @ (at - centre) * np.eye(3) - np.outer(at - centre, at - centre))
        moments, turn = np.linalg.eigh(inertia)
        turn[:, 0] *= np.sign(np.linalg.det(turn))
        self._empty = float(body.mass), np.array(body.ipos), np.array(body.iquat), np.array(body.inertia)
        body.mass, body.ipos, body.inertia = mass, centre, moments
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, turn.ravel())
        body.iquat = quaternion
        self._full = mass, centre, quaternion, moments

    def start(self, world: World) -> None:
        self._id = world.model.body(self.body).id
        if np.isfinite(self.release):
            self._write(world.model, self._full)

    def load(self, world: World) -> None:
        if world.time >= self.release:
            self._write(world.model, self._empty)

    def _write(self, model: mujoco.MjModel, inertial: tuple[float, Array, Array, Array]) -> None:
        model.body_mass[self._id], model.body_ipos[self._id] = inertial[:2]
        model.body_iquat[self._id], model.body_inertia[self._id] = inertial[2:]


@dataclass
class NativeBalance(Law):
    """An upward force on each body of a subtree in proportion to its weight."""

    body: str
    fraction: float

    def build(self, spec: mujoco.MjSpec) -> None:
        body = spec.body(self.body)
        for part in [body, *body.find_all(mujoco.mjtObj.mjOBJ_BODY)]:
            part.gravcomp += self.fraction


@dataclass
class Cable(Law):
    """A counterweight: constant tension straight up, on the body where the subtree's centre of mass is at the start."""

    body: str
    fraction: float

    def start(self, world: World) -> None:
        model, data = world.model, world.data
        mujoco.mj_forward(model, data)
        self._id = model.body(self.body).id
        frame = data.xmat[self._id].reshape(3, 3)
        self._point = frame.T @ (data.subtree_com[self._id] - data.xpos[self._id])
        self._tension = self.fraction * model.body_subtreemass[self._id] * -model.opt.gravity

    def load(self, world: World) -> None:
        data = world.data
        point = data.xpos[self._id] + data.xmat[self._id].reshape(3, 3) @ self._point
        mujoco.mj_applyFT(world.model, data, self._tension, np.zeros(3), point, self._id, world.force)


@dataclass
class Tilt(Law):
    """The base stands askew: it sees gravity turned about x, then y [rad]."""

    x: float
    y: float

    def build(self, spec: mujoco.MjSpec) -> None:
        g = np.linalg.norm(spec.option.gravity)
        spec.option.gravity = -g * np.array([sin(self.y) * cos(self.x), -sin(self.x), cos(self.y) * cos(self.x)])
