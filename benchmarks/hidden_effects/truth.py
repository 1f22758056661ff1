"""The "real" system: the nominal MJCF with wrong plain parameters and hidden laws, stepped by explicit Euler at 0.5 ms.

Commands, latency, servos, friction and transmission are computed here; MuJoCo's own actuation is switched off.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from benchmarks.hidden_effects.plants import Array, Feedback, Motion, Plant, nominal_model

TIMESTEP = 5e-4
MAX_LATENCY = 2e-3
HALF_STEP = TIMESTEP / 2
"""Semi-implicit Euler's positions are ahead of its velocities by half a step: instruments read those of before."""
HALF_STEP_LEAD = 2e-3 / 2
"""The same of the nominal model, which needs a latency that is longer by it to match this system. Latencies are given
here as the nominal model sees them."""


class Diverged(RuntimeError):
    """The hidden laws made the simulation run away."""


class Law:
    """A piece of physics in the true system; every hook does nothing unless it is overridden."""

    def build(self, spec: mujoco.MjSpec) -> None:
        """Edit the model before it is compiled."""

    def start(self, world: World) -> None:
        """Look up addresses and forget all state."""

    def command(self, world: World, commands: Array) -> Array:
        """Change the commands (substeps, nu) that arrive within one sample period."""
        return commands

    def error(self, world: World) -> None:
        """Change ``world.error``, what the drives act on."""

    def drive(self, world: World) -> None:
        """Change ``world.drive``, the forces of the drives."""

    def load(self, world: World) -> None:
        """Add to ``world.force``, the generalised forces on the links."""

    def observe(self, name: str, time: Array, sample: Sampler) -> Array:
        """Values of a column at the sample times."""
        return sample(time)


class Sampler:
    """A column of a finished simulation as a function of time, laws applied from the inside out."""

    def __init__(self, world: World, name: str, laws: Sequence[Law]):
        self._world, self._name, self._laws = world, name, laws

    def __call__(self, time: Array) -> Array:
        """The column at these times [s]."""
        if self._laws:
            return self._laws[-1].observe(self._name, time, Sampler(self._world, self._name, self._laws[:-1]))
        return self._world.column(self._name, time)


@dataclass(frozen=True)
class Run:
    """One simulated recording.

    Attributes:
        commands: (n, nu) as logged.
        columns: (n, c) without noise.
        qpos: true positions at the samples, (n, nq), in the order of the true model.
        qvel: (n, nv).
        drive: forces of the drives just before the samples, (n, nu).
    """

    commands: Array
    columns: Array
    qpos: Array
    qvel: Array
    drive: Array


def plain_parameters(plant: Plant) -> dict[str, float]:
    """Names of what is allowed to be wrong in the nominal model, with the standard deviation of the relative error.

    ``latency`` is in seconds (within 0 to 2 ms; here the deviation of a uniform distribution over that).
    """
    model = nominal_model(plant.name)
    names: dict[str, float] = {}
    for body in range(1, model.nbody):
        if model.body_mass[body] > 0 and model.body_weldid[body] and not model.body(body).name.startswith(plant.exact):
            names |= {f"{kind}:{model.body(body).name}": 0.1 for kind in ("mass", "inertia")}
    for joint in range(model.njnt):
        dof = model.jnt_dofadr[joint]
        name = model.joint(joint).name
        if name.startswith(plant.exact):
            continue
        names |= {f"damping:{name}": 0.1} if model.dof_damping[dof] > 0 else {}
        names |= {f"armature:{name}": 0.1} if model.dof_armature[dof] > 0 else {}
    for actuator in range(model.nu):
        name = model.actuator(actuator).name
        names |= {f"kp:{name}": 0.03}
        names |= {f"kv:{name}": 0.03} if model.actuator_biasprm[actuator, 2] else {}
    return names | {"latency": MAX_LATENCY / np.sqrt(12)}


def draw_plain(plant: Plant, rng: np.random.Generator) -> dict[str, float]:
    """Errors of the nominal model's plain parameters (relative; latency in seconds)."""
    drawn = {name: float(np.clip(rng.normal(0, sd), -3 * sd, 3 * sd)) for name, sd in plain_parameters(plant).items()}
    return drawn | {"latency": float(rng.uniform(HALF_STEP_LEAD, MAX_LATENCY))}


class World:
    """One true system. The attributes below are what laws read and write; they are valid within a hook.

    Attributes:
        model: the compiled true model.
        data: its state.
        time: seconds since the recording began (negative during the lead).
        period: seconds between samples.
        substeps: of one sample period.
        position: of the joints as their drives' encoders see them, (nu,).
        velocity: (nu,).
        command: that has arrived, (nu,).
        error: what the drives act on: command minus position for a servo, the command itself for a motor, (nu,).
        drive: force of each drive at its joint, (nu,).
        force: generalised force on the links, (nv,).
        dof: of each actuator's joint, (nu,).
    """

    def __init__(self, plant: Plant, laws: Sequence[Law] = (), plain: dict[str, float] | None = None):
        self.plant, self.laws = plant, tuple(laws)
        self.plain = plain or {}
        spec = mujoco.MjSpec.from_string(plant.xml)
        spec.option.timestep = TIMESTEP
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
        self._set_plain(spec)
        for law in self.laws:
            law.build(spec)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._qpos, self._qvel, self._qfrc = self.data.qpos, self.data.qvel, self.data.qfrc_applied
        self._read_drives()
        self.period = 1 / plant.rate
        self.substeps = round(self.period / TIMESTEP)
        self._shape = _overriding(self.laws, "command")
        self._alter_error = _overriding(self.laws, "error")
        self._alter_drive = _overriding(self.laws, "drive")
        self._add_load = _overriding(self.laws, "load")
        self._observers = _overriding(self.laws, "observe")

    def joint_dof(self, name: str) -> int:
        """Degree of freedom of a joint."""
        return int(self.model.jnt_dofadr[self.model.joint(name).id])

    def joint_qpos(self, name: str) -> int:
        """Position address of a joint."""
        return int(self.model.jnt_qposadr[self.model.joint(name).id])

    def run(
        self,
        motion: Motion,
        noise: Array | None = None,
        *,
        commands: Array | None = None,
        first: int = 0,
        start: tuple[Array, Array] | None = None,
        shift: tuple[Array, Array] | None = None,
    ) -> Run:
        """Simulate one recording, or a stretch of it.

        Args:
            motion: what is asked for.
            noise: (n, c), of the columns; a feedback drive sees it. None: none.
            commands: those of an earlier run (lead + n, nu), replayed instead of the motion's.
            first: sample (from the beginning of the lead) at which the simulation starts.
            start: qpos and qvel there; set down at rest by default.
            shift: added to the state (tangent, velocity) when the recording begins, or at ``first`` if that is later.

        Raises:
            Diverged: if the state leaves all bounds.
        """
        model, data = self.model, self.data
        mujoco.mj_resetData(model, data)
        self._set_start(motion.qpos if start is None else start[0], None if start is None else start[1])
        total, lead = len(motion.reference), motion.lead
        logged = np.zeros((total, len(self.dof))) if commands is None else commands
        follow = commands is None
        steps = self.substeps
        self._fine_time = (np.arange((total - first) * steps + 1) + first * steps) * TIMESTEP - lead * self.period
        self._fine_qpos = np.empty((len(self._fine_time), model.nq))
        states = np.empty((total, model.nq + model.nv))
        drives = np.zeros((total, len(self.dof)))
        self.drive = drives[0]
        self.time = float(self._fine_time[0])
        self.latency = self._known_delay + self.plain.get("latency", HALF_STEP_LEAD) - HALF_STEP_LEAD
        self.encoder_bias[:] = 0
        self.rotors.clear()
        self._seen: Array | None = None
        for law in self.laws:
            law.start(self)
        self._bias_read = np.zeros(len(self._encoder_names))
        self._bias_read[self._encoders_driven] = self.encoder_bias[self._drives_encoded]
        self._from_rotor = [self._encoder_of_drive[drive] for drive in self.rotors]
        self._fine_rotors = np.empty((len(self._fine_time), len(self.rotors)))
        row = 0
        for k in range(first, total):
            if shift is not None and k == max(lead, first):
                mujoco.mj_integratePos(model, data.qpos, shift[0], 1.0)
                data.qvel += shift[1]
            if follow:
                logged[k] = self._feedback(motion, k, row, noise)
            states[k] = np.concatenate([data.qpos, data.qvel])
            drives[k] = self.drive
            arriving = self._arriving(logged, k)
            for law in self._shape:
                arriving = law.command(self, arriving)
            for s in range(steps):
                self._remember(row)
                self._step(arriving[s])
                row += 1
                self.time = float(self._fine_time[row])
            if not np.abs(data.qvel).max() < 1e3:
                raise Diverged(f"{self.plant.name}: speed {np.abs(data.qvel).max():g} at {self.time:.3g} s")
        self._remember(row)
        self._fine_encoders = self._fine_qpos[:, self._encoder_address]
        self._fine_encoders[:, self._from_rotor] = self._fine_rotors
        self._fine_encoders += self._bias_read
        begin = max(lead, first)
        time: Array = np.arange(begin - lead, total - lead, dtype=np.float64) * self.period
        columns = [Sampler(self, name, self._observers)(time) for name in self.plant.columns]
        sampled = states[begin:]
        return Run(logged, np.stack(columns, axis=1), sampled[:, : model.nq], sampled[:, model.nq :], drives[begin:])

    def column(self, name: str, time: Array) -> Array:
        """A column as a perfect instrument would read it at these times."""
        kind, what, *rest = name.split("/")
        if kind == "qpos":
            encoder = self._fine_encoders[:, self._encoder_names.index(what)]
            return np.interp(time - HALF_STEP, self._fine_time, encoder)
        site = self.model.site(what).id
        axis = "xyz".index(rest[0]) if kind == "site" else int(rest[0])
        return self._site_path(time)[:, site, axis]

    def _site_path(self, time: Array) -> Array:
        """Positions of all sites (n, nsite, 3), the last answer kept: columns come in triples."""
        key = (time.tobytes(), self._fine_qpos.ctypes.data)
        if self._sites_at is None or self._sites_at[0] != key:
            data, path = mujoco.MjData(self.model), np.empty((len(time), self.model.nsite, 3))
            joints = [np.interp(time - HALF_STEP, self._fine_time, q) for q in self._fine_qpos.T]
            for i, qpos in enumerate(np.stack(joints, axis=1)):
                data.qpos[:] = qpos
                mujoco.mj_kinematics(self.model, data)
                path[i] = data.site_xpos
            self._sites_at = (key, path)
        return self._sites_at[1]

    _sites_at: tuple[tuple[bytes, int], Array] | None = None

    def _set_plain(self, spec: mujoco.MjSpec) -> None:
        """Write the errors of masses, inertias, damping and armature; gains and latency are read later."""
        for name, value in self.plain.items():
            kind, _, where = name.partition(":")
            if kind == "mass":
                spec.body(where).mass *= 1 + value
            elif kind == "inertia":
                spec.body(where).inertia = spec.body(where).inertia * (1 + value)
            elif kind == "damping":
                spec.joint(where).damping = np.array(spec.joint(where).damping) * (1 + value)
            elif kind == "armature":
                spec.joint(where).armature *= 1 + value

    def _read_drives(self) -> None:
        """Gains, limits and addresses of the drives, wrong plain gains included."""
        model, plain = self.model, self.plain
        names = [model.actuator(i).name for i in range(model.nu)]
        joints = model.actuator_trnid[:, 0]
        self.dof = model.jnt_dofadr[joints].astype(int)
        self._address = model.jnt_qposadr[joints].astype(int)
        self._joint_of_drive = [model.joint(j).name for j in joints]
        kp = np.array([1 + plain.get(f"kp:{name}", 0.0) for name in names])
        kv = np.array([1 + plain.get(f"kv:{name}", 0.0) for name in names])
        self.gain = model.actuator_gainprm[:, 0] * kp
        self.is_servo = (model.actuator_biasprm[:, 1] != 0).astype(float)
        self.rate_gain = model.actuator_biasprm[:, 2] * kv
        self._known_delay = float(model.actuator_delay.max(initial=0.0))
        free = [-np.inf, np.inf]
        self._limited = bool(model.actuator_forcelimited.any())
        self._force_range = np.where(model.actuator_forcelimited[:, None], model.actuator_forcerange, free).T
        self._command_range = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, free).T
        self.encoder_bias = np.zeros(model.nu)
        self.force = np.zeros(model.nv)
        self._encoder_names = list(self.plant.encoders)
        self._encoder_address = [self.joint_qpos(name) for name in self._encoder_names]
        self._drives_encoded = [i for i, name in enumerate(self._joint_of_drive) if name in self._encoder_names]
        self._encoders_driven = [self._encoder_names.index(self._joint_of_drive[i]) for i in self._drives_encoded]
        self._encoder_of_drive = dict(zip(self._drives_encoded, self._encoders_driven, strict=True))
        self.rotors: dict[int, Rotor] = {}

    def _set_start(self, qpos: Array, qvel: Array | None) -> None:
        """Set down by the nominal model's joint order: laws may have added joints at the root."""
        nominal = nominal_model(self.plant.name)
        for j in range(nominal.njnt):
            self.data.qpos[self.joint_qpos(nominal.joint(j).name)] = qpos[nominal.jnt_qposadr[j]]
            if qvel is not None:
                self.data.qvel[self.joint_dof(nominal.joint(j).name)] = qvel[nominal.jnt_dofadr[j]]

    def _arriving(self, logged: Array, k: int) -> Array:
        """Mean command within each step of sample k, the latency in, (substeps, nu): a held signal, delayed exactly."""
        return delayed(np.clip(logged[: k + 1], *self._command_range), k, self.substeps, self.latency)

    def _feedback(self, motion: Motion, k: int, row: int, noise: Array | None) -> Array:
        """The command at sample k."""
        loop: Feedback | None = self.plant.feedback
        if loop is None:
            return motion.reference[k]
        seen = self._read_encoders()
        if noise is not None and k >= motion.lead:
            seen = seen + noise[k - motion.lead, : len(seen)]
        before = seen if self._seen is None else self._seen
        self._seen = seen
        step = motion.reference[k] - motion.reference[max(k - 1, 0)]
        return loop.stiffness * (motion.reference[k] - seen) + loop.damping * (step - seen + before) / self.period

    def _read_encoders(self) -> Array:
        """Positions by encoder: of the rotor where the joint has one apart from the link; biases in."""
        values = self._qpos[self._encoder_address]
        values[self._from_rotor] = [rotor.angle for rotor in self.rotors.values()]
        return values + self._bias_read

    def _remember(self, row: int) -> None:
        """Keep the positions of one step."""
        self._fine_qpos[row] = self._qpos
        if self.rotors:
            self._fine_rotors[row] = [rotor.angle for rotor in self.rotors.values()]

    def _step(self, command: Array) -> None:
        """One step of 0.5 ms."""
        model, data = self.model, self.data
        mujoco.mj_step1(model, data)
        self.command = command
        self.position, self.velocity = self._qpos[self._address], self._qvel[self.dof]
        for i, rotor in self.rotors.items():
            self.position[i], self.velocity[i] = rotor.angle, rotor.speed
        self.error = command - self.is_servo * (self.position + self.encoder_bias)
        for law in self._alter_error:
            law.error(self)
        self.drive = self.gain * self.error + self.rate_gain * self.velocity
        if self._limited:
            np.clip(self.drive, *self._force_range, out=self.drive)
        for law in self._alter_drive:
            law.drive(self)
        self.force[:] = 0
        self.force[self.dof] = self.drive
        for i, rotor in self.rotors.items():
            self.force[self.dof[i]] = rotor.step(self._qpos[self._address[i]], self._qvel[self.dof[i]], self.drive[i])
        for law in self._add_load:
            law.load(self)
        self._qfrc[:] = self.force
        mujoco.mj_step2(model, data)


@dataclass
class Rotor:
    """A motor's inertia apart from its link, with the encoder on it.

    Attributes:
        inertia: in joint coordinates.
        torque: of the transmission on the link, given the twist (rotor minus link) and its rate.
        angle: of the rotor.
        speed: of the rotor.
    """

    inertia: float
    torque: Callable[[float, float], float]
    angle: float
    speed: float

    def step(self, position: float, velocity: float, drive: float) -> float:
        """Move the rotor by one step under the drive; returns the torque on the link."""
        torque = self.torque(self.angle - position, self.speed - velocity)
        self.speed += TIMESTEP * (drive - torque) / self.inertia
        self.angle += TIMESTEP * self.speed
        return torque


def delayed(signal: Array, k: int, substeps: int, delay: float) -> Array:
    """Mean of a held signal (n, d) over each step of sample k when it arrives ``delay`` seconds late, (substeps, d)."""
    edges = (np.arange(substeps + 1) / substeps + k) - delay / (substeps * TIMESTEP)
    whole = np.floor(edges).astype(int)
    low = max(int(whole[0]), 0)
    area = np.concatenate([np.zeros((1, signal.shape[1])), np.cumsum(signal[low : k + 1], axis=0)])
    inside = np.clip(whole - low, 0, k - low)
    integral = np.where(
        (whole < 0)[:, None],
        edges[:, None] * signal[0],
        area[inside] + (edges - whole)[:, None] * signal[np.clip(whole, 0, k)],
    )
    if whole[-1] > k:
        integral[-1] = area[-1]
    return np.diff(integral, axis=0) * substeps


def _overriding(laws: Sequence[Law], hook: str) -> list[Law]:
    """The laws that do something in a hook."""
    return [law for law in laws if getattr(type(law), hook) is not getattr(Law, hook)]
