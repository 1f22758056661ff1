"""Which number of a MuJoCo simulation a column of a recording stands for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np

from simopt_envs.measured.resample import Array
from simopt_envs.physics.effects.actuators import command_sources
from simopt_envs.physics.writer import actuator_rows

Kind = Literal["ctrl", "qpos", "qvel", "sensordata", "site_xpos"]


@dataclass(frozen=True)
class Channel:
    """A column's place in a simulation.

    Attributes:
        name: the column, ``"qpos/elbow"``.
        kind: the ``MjData`` field.
        index: position in that field, flattened for one world.
        object: id of the actuator, joint, sensor or site.
        unit: of its values, ``""`` where it is not known.
    """

    name: str
    kind: Kind
    index: int
    object: int
    unit: str


_SENSOR_UNITS = {
    mujoco.mjtSensor.mjSENS_JOINTVEL: "rad/s",
    mujoco.mjtSensor.mjSENS_GYRO: "rad/s",
    mujoco.mjtSensor.mjSENS_VELOCIMETER: "m/s",
    mujoco.mjtSensor.mjSENS_FRAMELINVEL: "m/s",
    mujoco.mjtSensor.mjSENS_FRAMEPOS: "m",
    mujoco.mjtSensor.mjSENS_ACCELEROMETER: "m/s^2",
    mujoco.mjtSensor.mjSENS_FORCE: "N",
    mujoco.mjtSensor.mjSENS_TORQUE: "N m",
}


_DRIVEN = {
    mujoco.mjtTrn.mjTRN_JOINT: mujoco.mjtObj.mjOBJ_JOINT,
    mujoco.mjtTrn.mjTRN_JOINTINPARENT: mujoco.mjtObj.mjOBJ_JOINT,
    mujoco.mjtTrn.mjTRN_TENDON: mujoco.mjtObj.mjOBJ_TENDON,
    mujoco.mjtTrn.mjTRN_SITE: mujoco.mjtObj.mjOBJ_SITE,
    mujoco.mjtTrn.mjTRN_SLIDERCRANK: mujoco.mjtObj.mjOBJ_SITE,
    mujoco.mjtTrn.mjTRN_BODY: mujoco.mjtObj.mjOBJ_BODY,
}


def commanded_actuators(model: mujoco.MjModel) -> list[int]:
    """The actuators that take a command, in the order of commands (nu,); some that effects add take none.

    Raises:
        ValueError: if an actuator takes several commands, as ``<pid>`` can.
    """
    _, takes = actuator_rows(model, "ctrl")
    if several := np.flatnonzero(takes > 1).tolist():
        raise ValueError(
            f"actuator {model.actuator(several[0]).name or several[0]!r} takes {takes[several[0]]} commands, "
            "expected one: give the model an actuator for each"
        )
    return np.flatnonzero(takes).tolist()


def actuator_names(model: mujoco.MjModel) -> list[str]:
    """What each command (nu,) is called in recordings: as its actuator, see :func:`commanded_actuators`.

    One without a name, as most of Gymnasium's, has that of what it acts on, where no other actuator has it; else "".
    The part that a dead band adds to a drive has the drive's, as it gets its command.
    """
    drives = commanded_actuators(model)
    given = [model.actuator(i).name for i in drives]
    kinds = [_DRIVEN.get(mujoco.mjtTrn(model.actuator_trntype[i]), mujoco.mjtObj.mjOBJ_UNKNOWN) for i in drives]
    targets = model.actuator_trnid[drives, 0].tolist()
    acts_on = [mujoco.mj_id2name(model, kind, i) or "" for kind, i in zip(kinds, targets, strict=True)]
    nameless = [target for name, target in zip(given, acts_on, strict=True) if not name]
    taken = {*given, *(target for target in nameless if nameless.count(target) > 1)}
    names = [name or ("" if target in taken else target) for name, target in zip(given, acts_on, strict=True)]
    return [names[source] for source in command_sources(model)]


def model_channels(model: mujoco.MjModel) -> dict[str, Channel]:
    """Every column a recording of this model can have, by name; unnamed objects have none, but see
    :func:`actuator_names`.

    Where a joint has several numbers (ball, free) they are ``/0``, ``/1`` ..., as for sensors.
    """
    channels: list[Channel] = []

    def add(prefix: str, kind: Kind, object_id: int, start: int, count: int, units: tuple[str, ...]) -> None:
        for k in range(count):
            name = prefix if count == 1 else f"{prefix}/{k}"
            channels.append(Channel(name, kind, start + k, object_id, units[min(k, len(units) - 1)]))

    commands = actuator_names(model)
    for i, name in enumerate(commands):
        if name and commands.index(name) == i:
            add(f"ctrl/{name}", "ctrl", i, i, 1, ("",))
    for i in range(model.njnt):
        if name := model.joint(i).name:
            joint = mujoco.mjtJoint(model.jnt_type[i])
            positions, velocities, unit, rate = {
                mujoco.mjtJoint.mjJNT_FREE: (7, 6, ("m", "m", "m", "1"), ("m/s", "m/s", "m/s", "rad/s")),
                mujoco.mjtJoint.mjJNT_BALL: (4, 3, ("1",), ("rad/s",)),
                mujoco.mjtJoint.mjJNT_SLIDE: (1, 1, ("m",), ("m/s",)),
                mujoco.mjtJoint.mjJNT_HINGE: (1, 1, ("rad",), ("rad/s",)),
            }[joint]
            add(f"qpos/{name}", "qpos", i, int(model.jnt_qposadr[i]), positions, unit)
            add(f"qvel/{name}", "qvel", i, int(model.jnt_dofadr[i]), velocities, rate)
    for i in range(model.nsensor):
        if name := model.sensor(i).name:
            sensor = mujoco.mjtSensor(model.sensor_type[i])
            unit_of_sensor = _SENSOR_UNITS.get(sensor, "")
            add(
                f"sensor/{name}", "sensordata", i, int(model.sensor_adr[i]), int(model.sensor_dim[i]), (unit_of_sensor,)
            )
    for i in range(model.nsite):
        if name := model.site(i).name:
            for k, axis in enumerate("xyz"):
                channels.append(Channel(f"site/{name}/{axis}", "site_xpos", 3 * i + k, i, "m"))
    return {channel.name: channel for channel in channels}


def read_channels(channels: list[Channel], fields: dict[str, np.ndarray]) -> Array:
    """The channels' values, (..., c), from fields of shape (..., n) or, for sites, (..., nsite, 3)."""
    columns = []
    for channel in channels:
        values = fields[channel.kind]
        if channel.kind == "site_xpos":
            values = values.reshape(*values.shape[:-2], -1)
        columns.append(values[..., channel.index])
    return np.stack(columns, axis=-1)
