"""What no library of usual effects holds: a workflow should say that something is wrong and name none of its own."""

# ruff: noqa: D102 - the hooks are documented in truth.Law

from __future__ import annotations

from dataclasses import dataclass
from math import exp, sin

import mujoco
import numpy as np

from benchmarks.hidden_effects.catalogue import (
    OTHER,
    Built,
    Effect,
    columns_of,
    constant,
    joint_of,
    load_point,
    of_force,
    of_load,
    scales,
)
from benchmarks.hidden_effects.laws import AtDrive, AtJoint, Payload, Reading
from benchmarks.hidden_effects.plants import Array, Plant, nominal_model
from benchmarks.hidden_effects.truth import TIMESTEP, Law, World


@dataclass
class Crosstalk(AtJoint):
    """A share of the neighbouring drive's force acts here."""

    share: float

    def start(self, world: World) -> None:
        super().start(world)
        own = list(world.dof).index(self._dof)
        self._neighbour = own - 1 if own else own + 1

    def load(self, world: World) -> None:
        world.force[self._dof] += self.share * world.drive[self._neighbour]


@dataclass
class Fading(AtDrive):
    """The drive warms up and loses a share of its force in proportion to time: -share * time / 3 s."""

    share: float

    def drive(self, world: World) -> None:
        world.drive[self._i] *= 1 - self.share * max(world.time, 0.0) / 3


@dataclass
class Jitter(Law):
    """Each command arrives late by its own random time, up to ``most`` [s]."""

    most: float
    seed: int

    def start(self, world: World) -> None:
        self._rng, self._last = np.random.default_rng([self.seed, round(1e6 * abs(world.data.qpos.sum()))]), None

    def command(self, world: World, commands: Array) -> Array:
        late = round(self._rng.uniform(0, self.most) / TIMESTEP)
        last = commands[0] if self._last is None else self._last
        self._last = commands[-1]
        return np.concatenate([np.repeat(last[None], late, axis=0), commands])[: len(commands)]


@dataclass
class Hysteresis(AtJoint):
    """A Bouc-Wen element: springs back by ``yielding`` before it gives, far more than a friction contact."""

    force: float
    yielding: float

    def start(self, world: World) -> None:
        super().start(world)
        self._z = 0.0

    def load(self, world: World) -> None:
        _, v = self._state(world)
        step = v * TIMESTEP / self.yielding
        self._z = max(-1.0, min(1.0, self._z + step - 0.5 * abs(step) * self._z - 0.5 * step * abs(self._z)))
        world.force[self._dof] -= self.force * self._z


@dataclass
class SlewLimit(AtDrive):
    """The drive's input cannot change faster than this per second."""

    rate: float

    def start(self, world: World) -> None:
        super().start(world)
        self._held: float | None = None

    def command(self, world: World, commands: Array) -> Array:
        commands, most = commands.copy(), self.rate * TIMESTEP
        held = float(commands[0, self._i]) if self._held is None else self._held
        for row in commands:
            held += max(-most, min(most, float(row[self._i]) - held))
            row[self._i] = held
        self._held = held
        return commands


@dataclass
class SoftMount(Law):
    """The root body stands on a mass of its own and a spring along x."""

    body: str
    compliance: float
    mass: float

    def build(self, spec: mujoco.MjSpec) -> None:
        root = spec.body(self.body)
        kept = [
            {name: getattr(joint, name) for name in ("name", "type", "axis", "pos", "damping", "armature", "range")}
            for joint in root.joints
        ]
        for joint in list(root.joints):
            spec.delete(joint)
        # Joints act in the order in which they were added: the mount comes before the rest.
        root.add_joint(
            name="hidden_mount",
            type=mujoco.mjtJoint.mjJNT_SLIDE,
            axis=[1, 0, 0],
            stiffness=np.array([1 / self.compliance, 0, 0]),
            damping=np.array([0.1 * np.sqrt(self.mass / self.compliance), 0, 0]),
            armature=self.mass,
        )
        for properties in kept:
            root.add_joint(**properties)


@dataclass
class Pushes(AtJoint):
    """Somebody touches the machine: bumps of 0.15 s at random times, another set in each recording."""

    force: float
    seed: int

    def start(self, world: World) -> None:
        super().start(world)
        rng = np.random.default_rng([self.seed, round(1e6 * abs(world.data.qpos.sum()))])
        self._times, self._signs = rng.uniform(0.2, 2.8, 4), rng.choice([-1.0, 1.0], 4)

    def load(self, world: World) -> None:
        bumps = [s * exp(-(((world.time - t) / 0.075) ** 2)) for t, s in zip(self._times, self._signs, strict=True)]
        world.force[self._dof] += self.force * sum(bumps)


@dataclass
class UnevenGain(AtDrive):
    """The drive's force depends on where it stands: x (1 + share sin(turns * position))."""

    share: float
    turns: float

    def drive(self, world: World) -> None:
        world.drive[self._i] *= 1 + self.share * sin(self.turns * world.position[self._i])


@dataclass
class Vibration(AtJoint):
    """A machine next door: a force of one frequency [Hz], whatever this one does."""

    force: float
    frequency: float

    def load(self, world: World) -> None:
        world.force[self._dof] += self.force * sin(2 * np.pi * self.frequency * world.time)


def _crosstalk(plant: Plant, joint: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    return Crosstalk(joint, m), {"share": m}


def _fading(plant: Plant, actuator: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    return Fading(actuator, m), {"share": m}


def _jitter(plant: Plant, actuator: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    return Jitter(m, int(rng.integers(2**31))), {"most": m}


def _hysteresis(plant: Plant, joint: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    return Hysteresis(joint, m, 0.2 * scales(plant.name).range[joint]), {"force": m}


def _coarse(plant: Plant, place: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    return Reading(columns_of(plant, place), step=m), {"step": m}


def _slew(plant: Plant, actuator: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    model, joint = nominal_model(plant.name), joint_of(plant, actuator)
    usual = scales(plant.name)
    servo = model.actuator_biasprm[model.actuator(actuator).id, 1] != 0
    # At 1 the limit is what the plant usually asks for.
    rate = (usual.speed[joint] if servo else 10 * usual.force[joint]) / m
    return SlewLimit(actuator, rate), {"rate": rate}


def _mount(plant: Plant, body: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    return SoftMount(body, m, _mount_mass(plant, body)), {"compliance": m}


def _mount_mass(plant: Plant, body: str) -> float:
    model = nominal_model(plant.name)
    return 2 * float(model.body_subtreemass[model.body(body).id])


def _dropped(plant: Plant, body: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    release = float(rng.uniform(1.2, 1.8))
    return Payload(body, m, tuple(load_point(plant, body).tolist()), 0.02, release), {"mass": m, "release": release}


def _pushes(plant: Plant, joint: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    return Pushes(joint, m, int(rng.integers(2**31))), {"force": m}


def _uneven(plant: Plant, actuator: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    turns = 6 / scales(plant.name).range[joint_of(plant, actuator)]
    return UnevenGain(actuator, m, turns), {"share": m}


def _vibration(plant: Plant, joint: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    frequency = float(rng.uniform(3, 8))
    return Vibration(joint, m, frequency), {"force": m, "frequency": frequency}


def _resonance(frequency: float) -> Effect:
    """A soft mount whose resonance is not below this frequency [Hz]."""

    def compliance(plant: Plant, body: str) -> float:
        return 1 / (1.5 * _mount_mass(plant, body) * (2 * np.pi * frequency) ** 2)

    return Effect("soft_mount", "first", _mount, OTHER, lambda p, b: 0.1 * compliance(p, b), compliance)


def _coarse_step(plant: Plant, place: str) -> float:
    """Twenty times the noise."""
    return 20 * plant.noise[columns_of(plant, place).split("/")[0]]


OUTSIDE: dict[str, Effect] = {
    effect.name: effect
    for effect in (
        Effect("crosstalk", "neighbours", _crosstalk, OTHER, constant(0.01), constant(0.4)),
        Effect("thermal_drift", "actuator", _fading, OTHER, constant(0.02), constant(0.6)),
        Effect("command_jitter", "all", _jitter, OTHER, constant(0.003), lambda plant, place: 1 / plant.rate),
        Effect("hysteresis", "joint", _hysteresis, OTHER, of_force(0.02), of_force(0.6)),
        Effect("coarse_encoder", "reading", _coarse, OTHER, _coarse_step, _coarse_step),
        Effect("slew_limit", "actuator", _slew, OTHER, constant(0.5), constant(1.5)),
        _resonance(4.0),
        Effect("dropped_load", "body", _dropped, OTHER, of_load(0.02), of_load(1.0)),
        Effect("pushes", "joint", _pushes, OTHER, of_force(0.02), of_force(1.0)),
        Effect("uneven_gain", "actuator", _uneven, OTHER, constant(0.03), constant(0.6)),
        Effect("vibration", "joint", _vibration, OTHER, of_force(0.01), of_force(0.5)),
    )
}
"""Effects that the library does not have, by name."""
