"""Forces by position: springs, catches, cogging, hoses."""

# ruff: noqa: D102 - the hooks are documented in truth.Law

from __future__ import annotations

from dataclasses import dataclass
from math import exp, sin, tanh

import numpy as np

from benchmarks.hidden_effects.laws.places import AtJoint
from benchmarks.hidden_effects.truth import Law, World


@dataclass
class Spring(AtJoint):
    """-k x (1 + (x / hardening)^2), x from the reference."""

    stiffness: float
    reference: float
    hardening: float = np.inf

    def load(self, world: World) -> None:
        x = self._state(world)[0] - self.reference
        world.force[self._dof] -= self.stiffness * x * (1 + (x / self.hardening) ** 2)


@dataclass
class Detent(AtJoint):
    """A catch at ``position``: a pull that peaks and fades, as x exp(-x^2 / 2) or (sharp) tanh(x) / cosh(x)^2."""

    force: float
    width: float
    position: float = 0.0
    sharp: bool = False

    def load(self, world: World) -> None:
        x = (self._state(world)[0] - self.position) / self.width
        if abs(x) > 8:
            return
        shape = 2.598 * tanh(x) * (1 - tanh(x) ** 2) if self.sharp else x * exp(0.5 - x * x / 2)
        world.force[self._dof] -= self.force * shape


@dataclass
class Cogging(AtJoint):
    """A sin(n q + phase), with a second harmonic of this share."""

    amplitude: float
    periods: float
    phase: float
    second: float = 0.0

    def load(self, world: World) -> None:
        angle = self.periods * self._state(world)[0] + self.phase
        world.force[self._dof] += self.amplitude * (sin(angle) + self.second * sin(2 * angle + 1))


@dataclass
class Coupling(Law):
    """A hose across two joints: the same torque -k x (1 + (x / hardening)^2) on both, x the sum of their angles."""

    joints: tuple[str, str]
    stiffness: float
    reference: float = 0.0
    hardening: float = np.inf

    def start(self, world: World) -> None:
        self._dofs = [world.joint_dof(name) for name in self.joints]
        self._address = [world.joint_qpos(name) for name in self.joints]

    def load(self, world: World) -> None:
        x = float(world.data.qpos[self._address].sum()) - self.reference
        world.force[self._dofs] -= self.stiffness * x * (1 + (x / self.hardening) ** 2)
