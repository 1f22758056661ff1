"""Hidden physics: laws as a real machine has them, and in the forms that the usual models give them."""

# ruff: noqa: D102 - the hooks are documented in truth.Law

from __future__ import annotations

from dataclasses import dataclass
from math import cos, exp, pi, sin, sqrt, tanh

import mujoco
import numpy as np

from benchmarks.hidden_effects.plants import Array
from benchmarks.hidden_effects.truth import TIMESTEP, Law, Rotor, Sampler, World

PRESLIDING = 5e-4
"""Deflection of a friction contact before it slides [rad or m]; a hundredth of it on the slide drive."""


@dataclass
class AtJoint(Law):
    """A law at one joint."""

    joint: str

    def start(self, world: World) -> None:
        self._dof, self._qpos = world.joint_dof(self.joint), world.joint_qpos(self.joint)

    def _state(self, world: World) -> tuple[float, float]:
        return float(world.data.qpos[self._qpos]), float(world.data.qvel[self._dof])


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


@dataclass
class AtDrive(Law):
    """A law at one actuator."""

    actuator: str

    def start(self, world: World) -> None:
        self._i = world.model.actuator(self.actuator).id


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


@dataclass
class ContactFriction(Law):
    """Sliding friction of a geom x scale."""

    geom: str
    scale: float

    def build(self, spec: mujoco.MjSpec) -> None:
        geom = spec.geom(self.geom)
        friction = np.array(geom.friction)
        geom.friction = [friction[0] * self.scale, *friction[1:]]


@dataclass
class EncoderBias(Law):
    """A joint's encoder reads too much by this; the drive believes it."""

    joint: str
    bias: float

    def start(self, world: World) -> None:
        world.encoder_bias[list(world.dof).index(world.joint_dof(self.joint))] += self.bias


@dataclass
class Reading(Law):
    """A column, or the columns of a site or sensor, show scale * (1 + curve x^2) x + bias, late by delay and lag [s].

    Attributes:
        prefix: of the columns.
        scale: of the reading.
        bias: added.
        delay: pure.
        lag: first order.
        curve: nonlinearity [1/unit^2].
        step: of a quantiser; 0 for none.
    """

    prefix: str
    scale: float = 1.0
    bias: float = 0.0
    delay: float = 0.0
    lag: float = 0.0
    curve: float = 0.0
    step: float = 0.0

    def observe(self, name: str, time: Array, sample: Sampler) -> Array:
        if not name.startswith(self.prefix):
            return sample(time)
        if self.lag:
            ages = self.lag * -np.log1p(-(np.arange(20) + 0.5) / 20)  # quantiles of the exponential kernel
            values = np.mean([sample(time - self.delay - age) for age in ages], axis=0)
        else:
            values = sample(time - self.delay)
        values = self.scale * values * (1 + self.curve * values**2) + self.bias
        return np.round(values / self.step) * self.step if self.step else values


@dataclass
class FrameOffset(Law):
    """A site is really elsewhere on its body."""

    site: str
    offset: tuple[float, float, float]

    def build(self, spec: mujoco.MjSpec) -> None:
        site = spec.site(self.site)
        site.pos = np.array(site.pos) + self.offset


def rms(values: Array) -> float:
    """Root of the mean square."""
    return sqrt(float(np.mean(np.square(values))))
