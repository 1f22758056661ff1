"""Drives: gains, offsets, limits, delays, dead bands, and what lies between motor and link."""

# ruff: noqa: D102 - the hooks are documented in truth.Law

from __future__ import annotations

from dataclasses import dataclass
from math import exp, tanh

import mujoco
import numpy as np

from benchmarks.hidden_effects.laws.places import AtDrive, AtJoint
from benchmarks.hidden_effects.plants import Array
from benchmarks.hidden_effects.truth import TIMESTEP, Law, Rotor, World


@dataclass
class Gain(AtDrive):
    """The drive's force x scale, less where it works hard: x (1 - droop |force| / reference)."""

    scale: float
    droop: float = 0.0
    reference: float = 1.0

    def drive(self, world: World) -> None:
        force = world.drive[self._i]
        world.drive[self._i] *= self.scale * (1 - self.droop * tanh(abs(force) / self.reference))


@dataclass
class Bias(AtDrive):
    """A constant force of the drive; with ``slope`` it varies with position (a spring-loaded cable reel)."""

    force: float
    slope: float = 0.0

    def drive(self, world: World) -> None:
        world.drive[self._i] += self.force * (1 + self.slope * tanh(world.position[self._i]))


@dataclass
class Delay(Law):
    """Commands of all drives arrive later by ``delay`` and through a first-order lag [s]."""

    actuators: tuple[str, ...]
    delay: float
    lag: float = 0.0

    def start(self, world: World) -> None:
        self._index = [world.model.actuator(name).id for name in self.actuators]
        self._state: Array | None = None
        self._history: list[Array] = []

    def command(self, world: World, commands: Array) -> Array:
        commands = commands.copy()
        own = commands[:, self._index]
        self._history.append(own)
        past = np.concatenate(self._history[-2 - int(self.delay / world.period) :])
        at = np.arange(len(past) - len(own), len(past)) - self.delay / TIMESTEP
        grid = np.arange(len(past))
        own = np.stack([np.interp(at, grid, column) for column in past.T], axis=1)
        if self.lag:
            keep = exp(-TIMESTEP / self.lag)
            state = own[0] if self._state is None else self._state
            for row in own:
                state = row + (state - row) * keep
                row[:] = state
            self._state = state
        commands[:, self._index] = own
        return commands


@dataclass
class Saturation(AtDrive):
    """The force is clipped at the limit, or (soft) limit * tanh(force / limit)."""

    limit: float
    soft: bool = False

    def drive(self, world: World) -> None:
        force = world.drive[self._i] / self.limit
        world.drive[self._i] = self.limit * (tanh(force) if self.soft else max(-1.0, min(1.0, force)))


@dataclass
class Deadband(AtDrive):
    """The drive acts on error - clip(error, +-width), or (soft) on error - width tanh(error / width)."""

    width: float
    soft: bool = False

    def error(self, world: World) -> None:
        error = world.error[self._i]
        if self.soft:
            world.error[self._i] = error - self.width * tanh(error / self.width) if self.width else error
        else:
            world.error[self._i] = error - max(-self.width, min(self.width, error))


@dataclass
class Transmission(AtJoint):
    """Motor and link of a joint held together by play and a spring, the armature being the motor's.

    Attributes:
        stiffness: of the spring [N/m or N m/rad].
        damping: of the transmission while it transmits.
        play: total width within which nothing is transmitted [m or rad].
        hardening: cubic share: torque = k x (1 + (x / hardening)^2); infinite for a linear spring.
    """

    stiffness: float
    damping: float
    play: float = 0.0
    hardening: float = np.inf

    def start(self, world: World) -> None:
        super().start(world)
        q, v = self._state(world)
        drive = list(world.dof).index(self._dof)
        if not hasattr(self, "_inertia"):
            self._inertia = float(world.model.dof_armature[self._dof])
            self._link_share = 1 - self._inertia / float(world.model.dof_M0[self._dof])
            world.model.dof_armature[self._dof] = 0
            mujoco.mj_setConst(world.model, mujoco.MjData(world.model))  # a single slide's inertia is a constant
        world.rotors[drive] = Rotor(self._inertia, self._torque, q, v)
        self._drive, self._fresh = drive, True

    def drive(self, world: World) -> None:
        """Before the first step the transmission is twisted as it is when rotor and link speed up together."""
        if self._fresh:
            torque = world.drive[self._drive] * self._link_share
            world.rotors[self._drive].angle += torque / self.stiffness + self.play / 2 * np.sign(torque)
            self._fresh = False

    def _torque(self, twist: float, rate: float) -> float:
        half = self.play / 2
        if abs(twist) <= half:
            return 0.0
        x = twist - (half if twist > 0 else -half)
        return self.stiffness * x * (1 + (x / self.hardening) ** 2) + self.damping * rate
