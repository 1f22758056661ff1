"""Where windows start in a model to which effects have added joints, and what loads these."""

from __future__ import annotations

import mujoco
import numpy as np

from simopt_envs.measured.engines import settle_actuators
from simopt_envs.measured.states import States, reference_qpos
from simopt_envs.measured.windows import Windows
from simopt_envs.physics.effects import object_name
from simopt_envs.physics.effects.joints import scalar_joints
from simopt_envs.physics.parameters import Array

_NEW_JOINT_ERROR = 1e-3  # rad or m, rad/s or m/s: how well it is known where a joint that an effect adds starts


def starts_of(model: mujoco.MjModel, starts: States, given: mujoco.MjModel) -> States:
    """The starts of the model as given in a model with more joints, those at their reference."""
    if given.nq == model.nq:
        return starts
    w = len(starts)
    qpos = np.tile(reference_qpos(model), (w, 1))
    qvel, qacc = np.zeros((2, w, model.nv))
    errors = [np.full((w, model.nv), _NEW_JOINT_ERROR) for _ in range(2)]
    for j in range(given.njnt):
        new = model.joint(given.joint(j).name)
        old = given.joint(j)
        qpos[:, new.qposadr[0] : new.qposadr[0] + len(old.qpos0)] = starts.qpos[
            :, old.qposadr[0] : old.qposadr[0] + len(old.qpos0)
        ]
        of_new = slice(new.dofadr[0], new.dofadr[0] + len(old.damping))
        of_old = slice(old.dofadr[0], old.dofadr[0] + len(old.damping))
        sources = starts.qvel, starts.qpos_error, starts.qvel_error, starts.qacc
        for target, source in zip((qvel, *errors, qacc), sources, strict=True):
            target[:, of_new] = source[:, of_old]
    return States(qpos, qvel, errors[0], errors[1], qacc)


def loads(model: mujoco.MjModel, windows: Windows) -> dict[str, Array]:
    """The force with which the links that a hinge or slide carries pull at it at each start, (w,), by joint.

    What moves them in the model, which is a joint's whole drive less what its own armature and damping take.
    """
    data, all_forces = mujoco.MjData(model), np.empty((len(windows), model.nv))
    for w, forces in enumerate(all_forces):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = windows.starts.qpos[w], windows.starts.qvel[w]
        settle_actuators(model, data, windows.past_commands[w])
        data.ctrl[:] = windows.commands[w, 0]
        mujoco.mj_forward(model, data)
        mujoco.mj_rne(model, data, 1, forces)
        np.subtract(data.qfrc_constraint, forces, out=forces)
    joints = map(object_name, scalar_joints(model))
    return {joint: all_forces[:, int(model.joint(joint).dofadr[0])] for joint in joints}
