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


def starts_of(model: mujoco.MjModel, starts: States, given: mujoco.MjModel) -> States:
    """The starts of the model as given in a model with more joints, those at their reference.

    A joint that an effect adds, ``NAME.what``, starts as exactly where it is thought to as the joint ``NAME`` does.
    """
    if given.nq == model.nq:
        return starts
    w = len(starts)
    qpos = np.tile(reference_qpos(model), (w, 1))
    qvel, qacc = np.zeros((2, w, model.nv))
    qpos_error, qvel_error = np.empty((2, w, model.nv))
    for j in range(model.njnt):
        new, name = model.joint(j), model.joint(j).name
        added = mujoco.mj_name2id(given, mujoco.mjtObj.mjOBJ_JOINT, name) < 0
        old = given.joint(name.rpartition(".")[0] if added else name)
        of_new = slice(new.dofadr[0], new.dofadr[0] + len(new.damping))
        of_old = slice(old.dofadr[0], old.dofadr[0] + len(new.damping))
        qpos_error[:, of_new], qvel_error[:, of_new] = starts.qpos_error[:, of_old], starts.qvel_error[:, of_old]
        if not added:
            qvel[:, of_new], qacc[:, of_new] = starts.qvel[:, of_old], starts.qacc[:, of_old]
            of_old = slice(old.qposadr[0], old.qposadr[0] + len(old.qpos0))
            qpos[:, new.qposadr[0] : new.qposadr[0] + len(new.qpos0)] = starts.qpos[:, of_old]
    return States(qpos, qvel, qpos_error, qvel_error, qacc)


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
