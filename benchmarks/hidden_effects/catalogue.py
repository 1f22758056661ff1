"""The effects: where each can hide, which laws stand for it, and what a workflow should find as its parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import mujoco
import numpy as np

from benchmarks.hidden_effects import laws
from benchmarks.hidden_effects.plants import RECORDINGS, Plant, nominal_model, plants
from benchmarks.hidden_effects.truth import Law, World

Parameters = dict[str, float]
Built = tuple[Law, Parameters]
Build = Callable[[Plant, str, float, bool, np.random.Generator], Built]
"""(plant, name of the place, magnitude, same form, rng) to the law and the true parameters."""


@dataclass(frozen=True)
class Effect:
    """One effect of one scalar magnitude, neutral at 0.

    Attributes:
        name: of the contract.
        kind: of its places: ``joint``, driven ``neighbours``, ``pair`` of joints, ``actuator``, ``all`` of them,
            ``body``, ``root`` of the mechanism, ``first`` body that moves, ``site``, ``reading`` (joint, site or
            sensor), ``geom``.
        build: law and true parameters.
        forms: which variants there are: other laws (False), the usual law (True).
        guess: a magnitude to start the search for the least detectable one from, given plant and place.
        limit: the largest magnitude that leaves the system usable, given plant and place.
        driven: of joints, the driven ones only.
        forms_differ: whether the variants need different magnitudes to be seen.
        sets_apart: whether the law at magnitude 0 still holds motor and link apart, a trace that is not the effect's.
    """

    name: str
    kind: str
    build: Build
    forms: tuple[bool, ...]
    guess: Callable[[Plant, str], float]
    limit: Callable[[Plant, str], float] = lambda plant, place: np.inf
    driven: bool = False
    forms_differ: bool = False
    sets_apart: bool = False

    def places(self, plant: Plant) -> list[str]:
        """Names ``joint:elbow`` of the places in a plant."""
        model = nominal_model(plant.name)
        drives = [f"actuator:{model.actuator(i).name}" for i in range(model.nu)]
        bodies = [f"body:{name}" for name in _bodies(plant)]
        sites = [f"site:{name}" for name in plant.sites]
        measured = [f"joint:{name}" for name in plant.encoders]
        places = {
            "joint": [f"joint:{name}" for name in _joints(plant, self.driven)],
            "neighbours": [f"joint:{name}" for name in _joints(plant, True)] if model.nu > 1 else [],
            "pair": [f"joint:{a}+{b}" for a, b in zip(plant.encoders[:-1], plant.encoders[1:], strict=True)],
            "body": bodies,
            "root": [f"body:{_root(plant)}"],
            "first": bodies[:1],
            "actuator": drives,
            "all": drives[:1],
            "site": sites,
            "reading": measured
            + [f"site:{name}" for name in plant.sites]
            + [f"sensor:{name}" for name in plant.sensors],
            "geom": [f"geom:{name}" for name in _touching(plant)],
        }
        shown = plant.places
        return [
            place
            for place in places[self.kind]
            if self.kind in ("root", "all") or shown is None or set(place.split(":")[1].split("+")) <= shown
        ]


@dataclass(frozen=True)
class Scales:
    """What is usual in a plant, from a run of the nominal one.

    Attributes:
        force: the 98th percentile of each driven joint's |force|; for others what moves them, by joint.
        speed: root-mean-square speed while moving, by joint.
        range: from the 2nd to the 98th percentile of the position, by joint.
        centre: median position, by joint.
    """

    force: dict[str, float]
    speed: dict[str, float]
    range: dict[str, float]
    centre: dict[str, float]


@cache
def scales(name: str) -> Scales:
    """Scales of a plant."""
    plant, model = plants()[name], nominal_model(name)
    rng, world = np.random.default_rng(0), World(plants()[name])
    runs = [world.run(plant.motion(i, rng)) for i in range(RECORDINGS)]
    qpos, qvel, drive = (np.concatenate([getattr(run, f) for run in runs]) for f in ("qpos", "qvel", "drive"))
    force, speed, spread, centre = {}, {}, {}, {}
    for j in range(model.njnt):
        joint, dof, address = model.joint(j).name, model.jnt_dofadr[j], model.jnt_qposadr[j]
        v = np.abs(qvel[:, dof])
        moving = v[v > 0.05 * v.max()] if v.max() > 0 else v
        speed[joint] = float(np.sqrt(np.mean(np.square(moving))))
        low, middle, high = np.percentile(qpos[:, address], [2, 50, 98])
        spread[joint], centre[joint] = float(high - low), float(middle)
        driven = [i for i in range(model.nu) if model.actuator_trnid[i, 0] == j]
        reach = np.abs(drive[:, driven[0]]) if driven else model.dof_damping[dof] * moving + model.dof_M0[dof] * 1.0
        force[joint] = float(np.percentile(reach, 98))
    return Scales(force, speed, spread, centre)


def _joints(plant: Plant, driven: bool) -> list[str]:
    model = nominal_model(plant.name)
    has_drive = {int(j) for j in model.actuator_trnid[:, 0]}
    return [model.joint(j).name for j in range(model.njnt) if j in has_drive or not driven]


def _bodies(plant: Plant) -> list[str]:
    """Bodies that gravity or a load can move."""
    model = nominal_model(plant.name)
    return [model.body(b).name for b in range(1, model.nbody) if model.body_weldid[b] and model.body_dofnum[b]]


def _root(plant: Plant) -> str:
    """The body that the mechanism hangs from."""
    model = nominal_model(plant.name)
    return str(model.body(model.body_rootid[model.dof_bodyid[0]]).name)


def _touching(plant: Plant) -> list[str]:
    model = nominal_model(plant.name)
    return [model.geom(g).name for g in range(model.ngeom) if model.geom(g).name == "finger"]


def joint_of(plant: Plant, actuator: str) -> str:
    model = nominal_model(plant.name)
    return str(model.joint(model.actuator_trnid[model.actuator(actuator).id, 0]).name)


def usual_force(plant: Plant, place: str, share: float) -> float:
    return share * scales(plant.name).force[place]


def _presliding(plant: Plant, place: str) -> float:
    model = nominal_model(plant.name)
    slides = model.jnt_type[model.joint(place).id] == mujoco.mjtJoint.mjJNT_SLIDE
    return laws.PRESLIDING * (0.02 if slides and place in plant.encoders else 0.2 if slides else 1.0)


def _coulomb(plant: Plant, joint: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    law: Law = laws.NativeFriction(joint, m) if same else laws.LuGre(joint, m, m, presliding=_presliding(plant, joint))
    return law, {"frictionloss": m}


def _viscous(plant: Plant, joint: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    if same:
        return laws.Drag(joint, m, 1.0), {"damping": m}
    return laws.Drag(joint, m * scales(plant.name).speed[joint] ** 0.15, 0.85), {"damping": m}


def _asymmetric(plant: Plant, joint: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    sign = rng.choice([-1.0, 1.0])
    law = laws.LuGre(joint, m * (1 + sign / 2), m * (1 - sign / 2), presliding=_presliding(plant, joint))
    return law, {"frictionloss": m, "difference": sign * m}


def _stribeck(plant: Plant, joint: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    velocity = 0.15 * scales(plant.name).speed[joint]
    power = 2.0 if same else 1.0
    law = laws.LuGre(joint, m / 2, m / 2, m, velocity, power, _presliding(plant, joint))
    return law, {"frictionloss": m / 2, "breakaway": m, "velocity": velocity}


def _load_friction(plant: Plant, joint: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    return laws.LoadFriction(joint, m, 0.01 * scales(plant.name).speed[joint]), {"coefficient": m}


def _drag(plant: Plant, joint: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    if same:
        return laws.Drag(joint, m, 2.0), {"drag": m}
    return laws.Drag(joint, m * scales(plant.name).speed[joint] ** -0.2, 2.2), {"drag": m}


def _armature(plant: Plant, joint: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    return laws.NativeInertia(joint, m) if same else laws.Flywheel(joint, m), {"armature": m}


def load_point(plant: Plant, body: str) -> np.ndarray:
    """Where a body carries a load: at its site, else at its centre of mass."""
    model = nominal_model(plant.name)
    id = model.body(body).id
    sites = np.flatnonzero(model.site_bodyid == id)
    return np.array(model.site_pos[sites[0]] if len(sites) else model.body_ipos[id])


def _payload(plant: Plant, body: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    offset = rng.normal(size=3)
    offset *= (0.0 if same else 0.03) / np.linalg.norm(offset)
    position = load_point(plant, body) + offset
    law = laws.Payload(body, m, tuple(position.tolist()), radius=1e-3 if same else 0.03)
    return law, {"mass": m}


def _balance(plant: Plant, body: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    return laws.NativeBalance(body, m) if same else laws.Cable(body, m), {"fraction": m}


def _tilt(plant: Plant, body: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    angle = rng.uniform(0.25, 1.3) * rng.choice([-1, 1])
    x, y = m * np.cos(angle), m * np.sin(angle)
    return laws.Tilt(float(x), float(y)), {"x": float(x), "y": float(y)}


def _gain(plant: Plant, actuator: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    scale = 1 - m if rng.uniform() < 0.5 else 1 + m
    reference = scales(plant.name).force[joint_of(plant, actuator)]
    return laws.Gain(actuator, scale, 0.0 if same else 0.1 * m, reference), {"scale": scale}


def _bias(plant: Plant, actuator: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    force = m * rng.choice([-1.0, 1.0])
    return laws.Bias(actuator, force, 0.0 if same else 0.15), {"force": force}


def _delay(plant: Plant, actuator: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    law = laws.Delay((actuator,), m) if same else laws.Delay((actuator,), m / 2, m / 2)
    return law, {"delay": m}


def _saturation(plant: Plant, actuator: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    limit = usual_force(plant, joint_of(plant, actuator), 1 / m)
    return laws.Saturation(actuator, limit, soft=not same), {"limit": limit}


def _deadband(plant: Plant, actuator: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    return laws.Deadband(actuator, m, soft=not same), {"width": m}


def _transmission(plant: Plant, joint: str) -> tuple[float, float]:
    """Reduced inertia of motor against link, and the stiffness that counts as rigid: a resonance at 300 Hz."""
    model = nominal_model(plant.name)
    dof = model.jnt_dofadr[model.joint(joint).id]
    motor, total = float(model.dof_armature[dof]), float(model.dof_M0[dof])
    reduced = motor * (total - motor) / total
    return reduced, reduced * (2 * np.pi * 300) ** 2


def _backlash(plant: Plant, joint: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    inertia, rigid = _transmission(plant, joint)
    return laws.Transmission(joint, rigid, 0.3 * np.sqrt(rigid * inertia), play=m), {"play": m}


def _elasticity(plant: Plant, joint: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    inertia, rigid = _transmission(plant, joint)
    stiffness = 1 / (m + 1 / rigid)
    twist = scales(plant.name).force[joint] / stiffness
    damping = 0.2 * np.sqrt(stiffness * inertia)
    law = laws.Transmission(joint, stiffness, damping, hardening=np.inf if same else 2 * twist)
    return law, {"stiffness": stiffness}


def _spring(plant: Plant, joint: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    usual = scales(plant.name)
    reference = usual.centre[joint] + rng.uniform(-0.3, 0.3) * usual.range[joint]
    law = laws.Spring(joint, m, reference, np.inf if same else 1.5 * usual.range[joint])
    return law, {"stiffness": m, "reference": reference}


def _detent(plant: Plant, joint: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    """Of two laws, neither of which is the library's triangle."""
    width = 0.06 * scales(plant.name).range[joint]
    return laws.Detent(joint, m, width, 0.0, sharp=rng.random() < 0.5), {"force": m, "width": width}


def _cogging(plant: Plant, joint: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    periods = rng.uniform(2.5, 5.0) * 2 * np.pi / scales(plant.name).range[joint]
    if nominal_model(plant.name).jnt_type[nominal_model(plant.name).joint(joint).id] == mujoco.mjtJoint.mjJNT_HINGE:
        periods = np.round(periods)
    phase = rng.uniform(-np.pi, np.pi)
    law = laws.Cogging(joint, m, periods, phase, 0.0 if same else 0.25)
    return law, {"amplitude": m, "periods": float(periods), "phase": float(phase)}


def _coupling(plant: Plant, pair: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    a, b = pair.split("+")
    spread = scales(plant.name).range[a] + scales(plant.name).range[b]
    return laws.Coupling((a, b), m, 0.0, np.inf if same else 1.2 * spread), {"stiffness": m}


def _contact(plant: Plant, geom: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    scale = 1 + m if rng.uniform() < 0.5 or m > 0.8 else 1 - m
    return laws.ContactFriction(geom, scale), {"scale": scale}


def _sensor_bias(plant: Plant, place: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    bias = m * rng.choice([-1.0, 1.0])
    return laws.EncoderBias(place, bias), {"bias": bias}


def _sensor_scale(plant: Plant, place: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    scale = 1 + m * rng.choice([-1.0, 1.0])
    usual = scales(plant.name)
    largest = abs(usual.centre[place]) + usual.range[place] / 2 if place in usual.range else 0.5
    curve = 0.0 if same else 0.3 * (scale - 1) / largest**2
    return laws.Reading(columns_of(plant, place), scale, curve=curve), {"scale": scale}


def _sensor_delay(plant: Plant, place: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    law = laws.Reading(columns_of(plant, place), delay=m if same else m / 2, lag=0.0 if same else m / 2)
    return law, {"delay": m}


def columns_of(plant: Plant, place: str) -> str:
    """What the columns of a joint, site or sensor begin with."""
    for prefix, names in (("qpos", plant.encoders), ("site", plant.sites), ("sensor", plant.sensors)):
        if place in names:
            return f"{prefix}/{place}" + ("" if prefix == "qpos" else "/")
    raise ValueError(f"{plant.name} measures {', '.join(plant.columns)}, not {place!r}")


def _frame(plant: Plant, site: str, m: float, same: bool, rng: np.random.Generator) -> Built:
    direction = rng.normal(size=3)
    offset = m * direction / np.linalg.norm(direction)
    return laws.FrameOffset(site, tuple(offset.tolist())), dict(zip("xyz", offset.tolist(), strict=True))


def of_force(share: float) -> Callable[[Plant, str], float]:
    return lambda plant, place: usual_force(plant, place, share)


def of_drive(share: float) -> Callable[[Plant, str], float]:
    return lambda plant, place: usual_force(plant, joint_of(plant, place), share)


def constant(value: float) -> Callable[[Plant, str], float]:
    return lambda plant, place: value


def _per(quantity: str, share: float, power: float) -> Callable[[Plant, str], float]:
    """A coefficient whose force is this share of the usual one at the usual speed or range."""
    return lambda plant, place: usual_force(plant, place, share) / getattr(scales(plant.name), quantity)[place] ** power


def of_load(share: float) -> Callable[[Plant, str], float]:
    """A share of the mass of a body and all that it carries."""

    def mass(plant: Plant, body: str) -> float:
        model = nominal_model(plant.name)
        return share * float(model.body_subtreemass[model.body(body).id])

    return mass


def _inertia(plant: Plant, joint: str) -> float:
    model = nominal_model(plant.name)
    return float(model.dof_M0[model.jnt_dofadr[model.joint(joint).id]])


def _compliance(plant: Plant, joint: str) -> float:
    """At which the drive's usual force twists the joint by a tenth of its range."""
    return 0.1 * scales(plant.name).range[joint] / scales(plant.name).force[joint]


def _error_of(plant: Plant, actuator: str) -> float:
    """The error at which a drive gives its usual force."""
    model = nominal_model(plant.name)
    return usual_force(plant, joint_of(plant, actuator), 1.0) / float(
        model.actuator_gainprm[model.actuator(actuator).id, 0]
    )


BOTH, SAME, OTHER = (False, True), (True,), (False,)

EFFECTS: dict[str, Effect] = {
    effect.name: effect
    for effect in (
        Effect("coulomb_friction", "joint", _coulomb, BOTH, of_force(0.02), of_force(0.5)),
        Effect("viscous_friction", "joint", _viscous, BOTH, _per("speed", 0.05, 1), _per("speed", 2.0, 1)),
        Effect("asymmetric_friction", "joint", _asymmetric, OTHER, of_force(0.02), of_force(0.4)),
        Effect("stribeck_friction", "joint", _stribeck, BOTH, of_force(0.02), of_force(0.4)),
        Effect("load_dependent_friction", "joint", _load_friction, OTHER, constant(0.03), constant(0.5), True),
        Effect("quadratic_drag", "joint", _drag, BOTH, _per("speed", 0.05, 2), _per("speed", 2.0, 2)),
        Effect("armature", "joint", _armature, BOTH, lambda p, j: 0.1 * _inertia(p, j),
               lambda p, j: 5 * _inertia(p, j)),
        Effect("payload", "body", _payload, BOTH, of_load(0.02), of_load(2.0)),
        Effect("gravity_compensation", "body", _balance, BOTH, constant(0.01), constant(1.0)),
        Effect("base_tilt", "root", _tilt, SAME, constant(0.005), constant(0.5)),
        Effect("actuator_gain", "actuator", _gain, BOTH, constant(0.05), constant(0.6)),
        Effect("actuator_bias", "actuator", _bias, BOTH, of_drive(0.01), of_drive(0.5)),
        Effect("actuator_delay", "actuator", _delay, BOTH, constant(0.003), constant(0.08)),
        Effect("actuator_saturation", "actuator", _saturation, BOTH, constant(0.6), constant(2.0), forms_differ=True),
        Effect("deadband", "actuator", _deadband, BOTH, lambda p, a: 0.03 * _error_of(p, a),
               lambda p, a: _error_of(p, a) / 2, forms_differ=True),
        Effect("backlash", "joint", _backlash, OTHER, lambda p, j: 0.003 * scales(p.name).range[j],
               lambda p, j: 0.1 * scales(p.name).range[j], True, sets_apart=True),
        Effect("joint_elasticity", "joint", _elasticity, BOTH, lambda p, j: 0.05 * _compliance(p, j),
               _compliance, True, sets_apart=True),
        Effect("joint_spring", "joint", _spring, BOTH, _per("range", 0.02, 1), _per("range", 1.5, 1)),
        Effect("detent", "joint", _detent, OTHER, of_force(0.03), of_force(0.7)),
        Effect("cogging", "joint", _cogging, BOTH, of_force(0.02), of_force(0.5), True),
        Effect("joint_coupling", "pair", _coupling, BOTH,
               lambda p, pair: _per("range", 0.02, 1)(p, pair.split("+")[1]),
               lambda p, pair: _per("range", 1.0, 1)(p, pair.split("+")[1])),
        Effect("contact_friction", "geom", _contact, SAME, constant(0.2), constant(3.0)),
        Effect("sensor_bias", "joint", _sensor_bias, SAME, constant(0.001), constant(0.2), True),
        Effect("sensor_scale", "reading", _sensor_scale, BOTH, constant(0.002), constant(0.2)),
        Effect("sensor_delay", "reading", _sensor_delay, BOTH, constant(0.002), constant(0.06)),
        Effect("frame_offset", "site", _frame, SAME, constant(0.001), constant(0.1)),
    )
}  # fmt: skip
"""All effects by name."""
