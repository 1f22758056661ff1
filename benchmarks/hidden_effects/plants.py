"""The systems: a nominal MJCF, how it is moved, what is measured and how noisily."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

RECORDINGS = 8
STYLES = ("slow", "fast", "reversals", "holds", "fast", "slow", "holds", "reversals")
"""Of the eight recordings, so that either half holds each style once, split in the middle or by even and odd."""


@dataclass(frozen=True)
class Motion:
    """What one recording asks for.

    Attributes:
        reference: (lead + n, nu): commands, or the setpoints of a plant with feedback.
        lead: samples before the recording begins: the plant settles there, or is already moving when it begins.
        qpos: where the plant is set down, in the order of the nominal model.
    """

    reference: Array
    lead: int
    qpos: Array


@dataclass(frozen=True)
class Feedback:
    """A force-commanded drive's position loop: force = stiffness * error + damping * rate of the error."""

    stiffness: float
    damping: float


@dataclass(frozen=True)
class Plant:
    """A system and its measurement.

    Attributes:
        name: of the plant.
        xml: the nominal MJCF (implicitfast, 2 ms).
        rate: samples and commands per second.
        duration: of a recording [s].
        noise: standard deviation by column prefix ``"qpos"``, ``"site"``, ``"sensor"``.
        encoders: joints with a ``qpos/`` column.
        sites: with ``site/.../x|y|z`` columns.
        sensors: frame-position sensors with ``sensor/.../0|1|2`` columns.
        motion: draws the motion of recording i.
        feedback: None where the reference is the command.
        window: seconds within which a prediction from a measured start says something; None: a whole recording.
        exact: what the names of bodies and joints begin with whose parameters are not wrong.
        says_rest: whether the workflow is told which recordings begin at rest: where a rope is then, nothing else says.
        analysed: recordings from which the least detectable magnitudes are computed; the rest counts as alike.
        places: names of the joints, bodies and so on where effects are hidden; None: anywhere.
    """

    name: str
    xml: str
    rate: float
    duration: float
    noise: dict[str, float]
    encoders: tuple[str, ...]
    sites: tuple[str, ...]
    sensors: tuple[str, ...]
    motion: Callable[[int, np.random.Generator], Motion]
    feedback: Feedback | None = None
    window: float | None = None
    exact: tuple[str, ...] = ()
    says_rest: bool = False
    analysed: int = RECORDINGS
    places: frozenset[str] | None = None

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the measured columns."""
        return (
            *(f"qpos/{name}" for name in self.encoders),
            *(f"site/{name}/{axis}" for name in self.sites for axis in "xyz"),
            *(f"sensor/{name}/{i}" for name in self.sensors for i in range(3)),
        )

    @property
    def sigma(self) -> Array:
        """Noise of each column."""
        return np.array([self.noise[name.split("/")[0]] for name in self.columns])


def wander(
    rng: np.random.Generator, style: str, low: Array, high: Array, samples: int, rate: float, pace: float = 1.0
) -> Array:
    """A path between bounds, (samples, d), in one style: minimum-jerk moves with pauses, or sums of sines.

    Args:
        rng: draws targets, durations and phases.
        style: one of STYLES.
        low: (d,).
        high: (d,).
        samples: length.
        rate: samples per second.
        pace: 2 for twice as fast.
    """
    time: Array = np.arange(samples, dtype=np.float64) * (pace / rate)
    centre, half = (low + high) / 2, (high - low) / 2
    if style == "reversals":
        frequency = rng.uniform(0.3, 1.4, (3, len(low)))
        phase = rng.uniform(0, 2 * np.pi, (3, len(low)))
        weight = rng.dirichlet([2.0] * 3, len(low)).T
        waves = np.sin(2 * np.pi * frequency * time[:, None, None] + phase)
        swing = np.sum(weight * waves, axis=1) * _ease(time / 0.5)
        return centre + rng.uniform(0.5, 0.9, len(low)) * half * swing
    move, pause = {
        "slow": ((1.4, 2.2), (0.0, 0.2)),
        "fast": ((0.6, 1.0), (0.0, 0.2)),
        "holds": ((0.5, 1.2), (0.4, 0.8)),
    }[style]
    knots, targets = [0.0], [rng.uniform(low, high)]
    while knots[-1] < time[-1]:
        for seconds, target in ((rng.uniform(*pause), targets[-1]), (rng.uniform(*move), rng.uniform(low, high))):
            knots.append(knots[-1] + max(seconds, 1e-6))
            targets.append(target)
    index = np.clip(np.searchsorted(knots, time, side="right") - 1, 0, len(knots) - 2)
    start, end = np.array(knots)[index], np.array(knots)[index + 1]
    path = np.array(targets)
    return path[index] + (path[index + 1] - path[index]) * _ease((time - start) / (end - start))


def _ease(s: Array) -> Array:
    """From 0 to 1 with minimum jerk as s goes from 0 to 1, as a column."""
    s = np.clip(s, 0, 1)[:, None]
    return 10 * s**3 - 15 * s**4 + 6 * s**5


def _recorded(path: Array, rest: int, cut: int) -> tuple[Array, int]:
    """A path with ``rest`` samples of standing still before it; the recording leaves them out, and ``cut`` more."""
    return np.concatenate([np.repeat(path[:1], rest, axis=0), path]), rest + cut


def _cut(index: int, rng: np.random.Generator, rate: float) -> int:
    """Samples of motion before the recording begins."""
    return int(rng.uniform(0.3, 0.8) * rate) if begins_in_motion(index) else 0


def begins_in_motion(index: int) -> bool:
    """Whether a recording begins in motion, every third one, or where the plant has come to rest."""
    return index % 3 == 2


_OPTION = '<option timestep="0.002" integrator="implicitfast"/>'

_TWO_LINK = f"""
<mujoco model="two_link">
  {_OPTION}
  <default>
    <geom contype="0" conaffinity="0"/>
    <joint type="hinge" axis="0 1 0"/>
  </default>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" damping="0.8" armature="0.1"/>
      <inertial pos="0.18 0 0" mass="1.6" diaginertia="0.002 0.022 0.022"/>
      <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.03"/>
      <body name="fore" pos="0.4 0 0">
        <joint name="elbow" damping="0.5" armature="0.06"/>
        <inertial pos="0.15 0 0" mass="0.9" diaginertia="0.001 0.010 0.010"/>
        <geom type="capsule" fromto="0 0 0 0.35 0 0" size="0.025"/>
        <site name="tip" pos="0.35 0 0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="shoulder" joint="shoulder" kp="120" kv="5"/>
    <position name="elbow" joint="elbow" kp="50" kv="2"/>
  </actuator>
  <sensor>
    <framepos name="tip" objtype="site" objname="tip"/>
  </sensor>
</mujoco>
"""


def _two_link(index: int, rng: np.random.Generator) -> Motion:
    rate, seconds, cut = 100.0, 3.0, _cut(index, rng, 100.0)
    samples = cut + int(seconds * rate) + 1
    path = wander(rng, STYLES[index], np.array([-0.4, -1.6]), np.array([1.5, 1.6]), samples, rate)
    reference, lead = _recorded(path, int(0.8 * rate), cut)
    return Motion(reference, lead, reference[0])


# A yaw, three pitches; the tip reaches into a slot of a drawer that slides along x.
_ARM3 = f"""
<mujoco model="arm3">
  {_OPTION}
  <default>
    <geom contype="0" conaffinity="0"/>
  </default>
  <worldbody>
    <body name="turret" pos="0 0 0.3">
      <joint name="yaw" axis="0 0 1" damping="1" armature="0.12"/>
      <inertial pos="0 0 -0.05" mass="2" diaginertia="0.008 0.008 0.008"/>
      <geom type="cylinder" size="0.05 0.1" pos="0 0 -0.1"/>
      <body name="upper">
        <joint name="shoulder" axis="0 1 0" damping="1" armature="0.12"/>
        <inertial pos="0.13 0 0" mass="1.4" diaginertia="0.002 0.012 0.012"/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03"/>
        <body name="fore" pos="0.3 0 0">
          <joint name="elbow" axis="0 1 0" damping="0.6" armature="0.08"/>
          <inertial pos="0.12 0 0" mass="0.9" diaginertia="0.001 0.008 0.008"/>
          <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.025"/>
          <body name="hand" pos="0.3 0 0">
            <joint name="wrist" axis="0 1 0" damping="0.25" armature="0.03"/>
            <inertial pos="0.05 0 0" mass="0.35" diaginertia="0.0003 0.0008 0.0008"/>
            <geom type="capsule" fromto="0 0 0 0.11 0 0" size="0.015"/>
            <geom name="finger" type="capsule" fromto="0.11 0 0 0.15 0 0" size="0.008" contype="1" conaffinity="2"
              friction="0.5 0.005 0.0001" mass="0"/>
            <site name="tip" pos="0.15 0 0"/>
          </body>
        </body>
      </body>
    </body>
    <body name="drawer" pos="0.42 0 0.1">
      <joint name="drawer" type="slide" axis="1 0 0" damping="8" armature="0"/>
      <!-- Off its frame's origin: MuJoCo scales the contacts of a body that a load makes lopsided differently. -->
      <inertial pos="0.05 0 -0.01" mass="1.5" diaginertia="0.004 0.004 0.004"/>
      <geom name="front" type="box" pos="-0.0195 0 0" size="0.01 0.12 0.03" contype="2" conaffinity="1"
        friction="0.05" solref="0.05 1" solimp="0.001 0.95 0.005"/>
      <geom name="back" type="box" pos="0.0195 0 0" size="0.01 0.12 0.03" contype="2" conaffinity="1"
        friction="0.05" solref="0.05 1" solimp="0.001 0.95 0.005"/>
      <site name="handle" pos="-0.03 0 0"/>
    </body>
  </worldbody>
  <actuator>
    <position name="yaw" joint="yaw" kp="120" kv="5"/>
    <position name="shoulder" joint="shoulder" kp="160" kv="6"/>
    <position name="elbow" joint="elbow" kp="80" kv="3"/>
    <position name="wrist" joint="wrist" kp="20" kv="0.6"/>
  </actuator>
</mujoco>
"""


def _arm3_joints(tip: Array) -> Array:
    """Joint angles (n, 4) that put the tip (n, 3) in place with the hand pointing down."""
    x, y, z = tip.T
    reach, height = np.hypot(x, y), 0.3 - (z + 0.15)  # of the wrist, height downwards: pitches turn that way
    distance = np.hypot(reach, height)
    if np.any(distance > 0.6):
        raise ValueError(f"the wrist reaches 0.6 m, the path asks for {distance.max():.3g} m")
    elbow = np.arccos(distance**2 / 0.18 - 1)
    shoulder = np.arctan2(height, reach) - elbow / 2
    return np.stack([np.arctan2(y, x), shoulder, elbow, np.pi / 2 - shoulder - elbow], axis=1)


def _arm3(index: int, rng: np.random.Generator) -> Motion:
    rate, seconds, cut = 50.0, 3.0, _cut(index, rng, 50.0)
    samples = cut + int(seconds * rate) + 1
    in_slot = index in (1, 2, 5, 6)
    if in_slot:
        low, high = np.array([0.36, -0.06, 0.085]), np.array([0.50, 0.06, 0.105])
        path = wander(rng, STYLES[index], low, high, samples, rate)
        joints, drawer = _arm3_joints(path), path[0, 0] - 0.42
    else:
        low, high = np.array([-1.0, -0.9, 0.2, -0.4]), np.array([1.0, 0.2, 1.3, 1.2])
        joints, drawer = wander(rng, STYLES[index], low, high, samples, rate), 0.3
    reference, lead = _recorded(joints, int(0.8 * rate), cut)
    return Motion(reference, lead, np.append(reference[0], drawer))


# After the published EMPS benchmark: a carriage on a ball screw, force-commanded, its position loop closed outside.
_SLIDE_DRIVE = f"""
<mujoco model="slide_drive">
  {_OPTION}
  <worldbody>
    <body name="carriage">
      <joint name="carriage" type="slide" axis="1 0 0" damping="200" armature="25"/>
      <inertial pos="0 0 0" mass="70" diaginertia="1 1 1"/>
      <geom type="box" size="0.1 0.1 0.05" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="drive" joint="carriage"/>
  </actuator>
</mujoco>
"""


def _slide_drive(index: int, rng: np.random.Generator) -> Motion:
    rate, seconds, cut = 250.0, 4.0, _cut(index, rng, 250.0)
    samples = cut + int(seconds * rate) + 1
    path = wander(rng, STYLES[index], np.array([-0.22]), np.array([0.22]), samples, rate, 0.6)
    time = np.arange(samples) / rate
    ripple = 0.004 * np.sin(2 * np.pi * rng.uniform(1.0, 3.0) * time)[:, None] * _ease(time / 0.5)
    reference, lead = _recorded(path + ripple * (STYLES[index] != "holds"), int(0.3 * rate), cut)
    return Motion(reference, lead, reference[0])


_TASKS = Path(__file__).with_name("tasks")


@cache
def _episodes(task: str) -> tuple[Array, Array]:
    """Commands (n, 50, nu) of a trained policy at 60 ms, and where each episode starts (n, nq)."""
    with np.load(_TASKS / "policies.npz") as arrays:
        return arrays[f"{task}_commands"].astype(float), arrays[f"{task}_starts"].astype(float)


def _task_motion(task: str, index: int, rng: np.random.Generator) -> Motion:
    """An episode of the policy, its commands each held for three samples of 20 ms."""
    commands, starts = _episodes(task)
    episode = rng.integers(len(commands))
    reference = np.repeat(commands[episode], 3, axis=0)
    model, qpos = nominal_model(task), starts[episode]
    at_rest = qpos[model.jnt_qposadr[model.actuator_trnid[:, 0]]]
    rest, cut = 15, _cut(index, rng, 50.0)
    return Motion(np.concatenate([np.repeat(at_rest[None], rest, axis=0), reference]), rest + cut, qpos)


def _task(name: str, site: str, fingers: tuple[str, ...], exact: tuple[str, ...], places: frozenset[str]) -> Plant:
    """A registered task as ``export_tasks`` wrote it, its robot's joints and fingers measured."""
    return Plant(
        name,
        (_TASKS / f"{name}.xml").read_text(),
        rate=50.0,
        duration=3.0,
        noise={"qpos": 5e-4, "site": 1e-3},
        encoders=(*(f"joint{i}" for i in range(1, 8)), *fingers),
        sites=(site,),
        sensors=(),
        motion=partial(_task_motion, name),
        exact=exact,
        says_rest=True,
        analysed=3,
        places=places,
    )


@cache
def plants() -> dict[str, Plant]:
    """All plants by name."""
    own = [
        Plant(
            "two_link",
            _TWO_LINK,
            rate=100.0,
            duration=3.0,
            noise={"qpos": 5e-4, "sensor": 1e-3},
            encoders=("shoulder", "elbow"),
            sites=(),
            sensors=("tip",),
            motion=_two_link,
        ),
        Plant(
            "arm3",
            _ARM3,
            rate=50.0,
            duration=3.0,
            noise={"qpos": 5e-4, "site": 1e-3},
            encoders=("yaw", "shoulder", "elbow", "wrist"),
            sites=("handle",),
            sensors=(),
            motion=_arm3,
        ),
        Plant(
            "slide_drive",
            _SLIDE_DRIVE,
            rate=250.0,
            duration=4.0,
            noise={"qpos": 1e-5},
            encoders=("carriage",),
            sites=(),
            sensors=(),
            motion=_slide_drive,
            feedback=Feedback(stiffness=15000.0, damping=2000.0),
            window=0.5,
        ),
        _task(
            "drawer",
            "handle",
            ("finger_left", "finger_right"),
            (),
            frozenset({"joint2", "joint4", "joint6", "link4", "hand", "drawer", "handle"}),
        ),
        _task("swingpeg", "peg", (), ("segment",), frozenset({"joint2", "joint4", "link4", "gripper", "peg"})),
    ]
    return {plant.name: plant for plant in own}


@cache
def nominal_model(name: str) -> mujoco.MjModel:
    """The compiled nominal model of a plant."""
    return mujoco.MjModel.from_xml_string(plants()[name].xml)
