"""A drive that answers no small errors."""

from __future__ import annotations

import mujoco
import numpy as np

from simopt_envs.physics.effects.actuators import DEADBAND, affine_bias, affine_drives, drive_force, driven_joint, gear
from simopt_envs.physics.effects.effect import Effect, Motion, object_name
from simopt_envs.physics.effects.joints import position_unit
from simopt_envs.physics.parameters import Parameter, Write

_SHARED = (
    *("trntype", "target", "gear", "cranklength", "slidersite", "refsite", "lengthrange", "group"),
    *("dyntype", "dynprm", "actdim", "actlimited", "actrange", "actearly", "gaintype", "biastype"),
    *("ctrllimited", "ctrlrange", "inheritrange", "nsample", "interp", "delay"),
)
_CLOSED = 1e-12  # a force range must not be empty


class Deadband(Effect):
    """No force while a servo's error, or a motor's command, is within a width; beyond it, the force grows from zero.

    MuJoCo's drives have no dead band, and a law of the commands alone would not do for a servo, whose error is
    simulated. But a dead zone is what a saturation takes away from a line: dz(e) = e - clip(e, -w, w). So a second
    actuator, ``NAME.deadband``, pulls against the drive with the same stiffness and a force limit of stiffness times
    width. It has to get the drive's command (:func:`~simopt_envs.physics.effects.actuators.command_sources`), and what
    scales or delays the drive must do the same to it (:func:`~simopt_envs.physics.effects.actuators.on_all_parts`).
    Where the drive's own force is limited, its limit grows by as much as is pulled against it, so that the force of
    both ends where the drive's did. The damping of a position servo stays.
    """

    name = "deadband"
    law = "f = k (e - clip(e, -w, w)), e = u - q or u"

    def places(self, model: mujoco.MjModel) -> tuple[str, ...]:
        """See :meth:`Effect.places`."""
        drives = ((place, model.actuator(object_name(place))) for place in affine_drives(model))
        fixed = int(mujoco.mjtGain.mjGAIN_FIXED)
        return tuple(place for place, drive in drives if drive.gaintype[0] == fixed and drive.gainprm[0] != 0)

    def add(self, spec: mujoco.MjSpec, place: str) -> None:
        """See :meth:`Effect.add`."""
        drive, model = spec.actuator(object_name(place)), spec.copy().compile()
        second = spec.add_actuator(name=drive.name + DEADBAND)
        for attribute in _SHARED:
            setattr(second, attribute, getattr(drive, attribute))
        second.gainprm, second.biasprm = -drive.gainprm, -_error_terms(drive.gainprm, drive.biasprm)
        second.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
        second.forcerange = (-_CLOSED, _CLOSED)
        _tell_keyframes(spec, model, model.actuator(drive.name).id)

    def parameters(self, model: mujoco.MjModel, place: str) -> tuple[Parameter, ...]:
        """See :meth:`Effect.parameters`."""
        drive = object_name(place)
        stiffness = abs(float(model.actuator(drive).gainprm[0]))
        limited = [drive + DEADBAND, *([drive] if model.actuator(drive).forcelimited[0] else [])]
        writes = tuple(
            Write("actuator_forcerange", name, (side,), "add", factor=sign * stiffness)
            for name in limited
            for side, sign in enumerate((-1.0, 1.0))
        )
        return (Parameter("width", _unit(model, drive), 0.0, 0.0, 1e6, "linear", writes),)

    def probes(self, model: mujoco.MjModel, place: str, motion: Motion) -> tuple[dict[str, float], ...]:
        """Parts of the error, or of the command, that makes the drive's force."""
        drive = object_name(place)
        stiffness = abs(float(model.actuator(drive).gainprm[0]) * gear(model, drive))
        error = drive_force(model, drive, motion) / stiffness
        return ({"width": 0.1 * error}, {"width": 0.5 * error})


def _tell_keyframes(spec: mujoco.MjSpec, model: mujoco.MjModel, drive: int) -> None:
    """Give the command and activation that keyframes have for a drive to the actuator that was added to its model."""
    commanded, active = model.actuator_ctrladr[drive], model.actuator_actadr[drive]
    for key, ctrl, act in zip(spec.keys, model.key_ctrl, model.key_act, strict=True):
        if len(key.ctrl):
            key.ctrl = np.append(ctrl, ctrl[commanded])
        if len(key.act):
            key.act = np.append(act, act[active : active + model.actuator_actnum[drive]])


def _error_terms(gain: np.ndarray, bias: np.ndarray) -> np.ndarray:
    """The part of a drive's bias that makes an error of its command: the position's, or a velocity servo's."""
    terms = np.zeros_like(bias)
    terms[1] = bias[1]
    if bias[1] == 0 and bias[2] == -gain[0]:
        terms[2] = bias[2]
    return terms


def _unit(model: mujoco.MjModel, drive: str) -> str:
    """Of a servo's error; of a motor's command it is not known."""
    joint = driven_joint(model, drive)
    bias = affine_bias(model)[model.actuator(drive).id]
    position, velocity = _error_terms(model.actuator(drive).gainprm, bias)[1:] != 0
    if joint is None or not (position or velocity):
        return ""
    return position_unit(model, joint) + ("/s" if velocity else "")
