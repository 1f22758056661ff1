"""What opposes motion: dry, lubricated, in proportion to load, in a fluid, at a contact."""

# ruff: noqa: D102 - the hooks are documented in truth.Law

from __future__ import annotations

from dataclasses import dataclass
from math import exp, sqrt, tanh

import mujoco
import numpy as np

from benchmarks.hidden_effects.laws.places import AtJoint
from benchmarks.hidden_effects.truth import TIMESTEP, Law, World

PRESLIDING = 5e-4
"""Deflection of a friction contact before it slides [rad or m]; a hundredth of it on the slide drive."""


@dataclass
class LuGre(AtJoint):
    """Bristle friction (Canudas de Wit 1995), its level by direction, plus a breakaway that fades with speed.

    Attributes:
        forward: Coulomb level for positive velocity [N or N m].
        backward: for negative velocity.
        breakaway: what the level has in excess at rest.
        velocity: at which a share 1/e of the breakaway is left.
        power: of the decay, 2 in Stribeck's usual form.
        presliding: deflection of the bristles.
    """

    forward: float
    backward: float
    breakaway: float = 0.0
    velocity: float = 1.0
    power: float = 1.0
    presliding: float = PRESLIDING

    def start(self, world: World) -> None:
        super().start(world)
        self._bristle = 0.0
        self._stiffness = (max(self.forward, self.backward) + self.breakaway) / self.presliding
        self._damping = 0.5 * sqrt(self._stiffness * world.model.dof_M0[self._dof])

    def load(self, world: World) -> None:
        _, v = self._state(world)
        level = (self.forward if v > 0 else self.backward) + self.breakaway * exp(
            -(abs(v / self.velocity) ** self.power)
        )
        if self._stiffness <= 0:
            return
        # The bristle relaxes towards its steady state exactly: explicit Euler is unstable at speed.
        steady = (1 if v > 0 else -1) * level / self._stiffness
        before = self._bristle
        self._bristle = steady + (before - steady) * exp(-self._stiffness * abs(v) * TIMESTEP / max(level, 1e-12))
        rate = (self._bristle - before) / TIMESTEP
        damping = self._damping * exp(-abs(v) / (100 * self.presliding))
        world.force[self._dof] -= self._stiffness * self._bristle + damping * rate


@dataclass
class NativeFriction(AtJoint):
    """Coulomb friction as MuJoCo solves it, by a constraint."""

    force: float

    def build(self, spec: mujoco.MjSpec) -> None:
        spec.joint(self.joint).frictionloss += self.force


@dataclass
class LoadFriction(AtJoint):
    """Friction in proportion to what the gear transmits: -coefficient |drive| tanh(v / v0)."""

    coefficient: float
    smooth: float = 0.01

    def start(self, world: World) -> None:
        super().start(world)
        self._drive = list(world.dof).index(self._dof)

    def load(self, world: World) -> None:
        _, v = self._state(world)
        world.force[self._dof] -= self.coefficient * abs(world.drive[self._drive]) * tanh(v / self.smooth)


@dataclass
class Drag(AtJoint):
    """-coefficient |v|^power sign(v): viscous at 1, thinning grease below, air above."""

    coefficient: float
    power: float

    def load(self, world: World) -> None:
        _, v = self._state(world)
        world.force[self._dof] -= self.coefficient * abs(v) ** self.power * (1 if v > 0 else -1)


@dataclass
class ContactFriction(Law):
    """Sliding friction of a geom x scale."""

    geom: str
    scale: float

    def build(self, spec: mujoco.MjSpec) -> None:
        geom = spec.geom(self.geom)
        friction = np.array(geom.friction)
        geom.friction = [friction[0] * self.scale, *friction[1:]]
