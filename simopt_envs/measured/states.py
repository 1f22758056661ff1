"""The state a recording was in at given samples, estimated from what was measured, with standard errors."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from simopt_envs.measured.channels import Channel, model_channels, read_channels
from simopt_envs.measured.recording import Recording
from simopt_envs.measured.resample import Array
from simopt_envs.measured.smoothing import Smoothed, smooth, smooth_with_rate
from simopt_envs.physics.parameters import unknown_name

_POSITION_PRIOR = 1.0  # sd of an unmeasured joint around the reference [rad, m]: decides only what nothing sees
_VELOCITY_PRIOR = 10.0  # the same of its velocity around rest [rad/s, m/s]
_SCALAR = (int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE))
_LEAST_ERROR = 1e-6  # no measurement counts as more exact than this


@dataclass(frozen=True)
class States:
    """w estimated states.

    Attributes:
        qpos: (w, nq).
        qvel: (w, nv).
        qpos_error, qvel_error: their standard errors along each degree of freedom, (w, nv).
        qacc: accelerations, (w, nv), of hinges and slides whose positions were measured, else 0.
    """

    qpos: Array
    qvel: Array
    qpos_error: Array
    qvel_error: Array
    qacc: Array

    def __len__(self) -> int:
        return len(self.qpos)

    def select(self, rows: NDArray[np.intp]) -> States:
        """Some of them, in the order given."""
        return States(*(values[rows] for values in vars(self).values()))


def reference_qpos(model: mujoco.MjModel, keyframe: str | None = None) -> Array:
    """The model's reference posture or that of a named keyframe, (nq,); ValueError if there is none so named."""
    if keyframe is None:
        return model.qpos0.copy()
    key = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, keyframe)
    if key < 0:
        raise ValueError(unknown_name("keyframe", keyframe, [model.key(i).name for i in range(model.nkey)]))
    return model.key_qpos[key].copy()


def estimate_states(
    model: mujoco.MjModel, recording: Recording, samples: NDArray[np.intp], keyframe: str | None = None
) -> States:
    """Estimate the states at some samples of a uniformly sampled recording.

    Measured positions and velocities are smoothed, both of a hinge or slide together; velocities that were not measured
    are derivatives of the smoothed positions. Joints without a column are fitted, from the reference or keyframe, to
    the sites and sensors that depend on positions, and their velocities to the rates of those and to velocity sensors;
    what nothing sees stays at the reference, at rest.

    Args:
        model: the model; its parameters matter only where joints are fitted to sites and sensors.
        recording: on a uniform grid, see :meth:`Recording.resample`.
        samples: (w,) indices into it.
        keyframe: name of the keyframe to start unmeasured joints from; None for the reference.

    Raises:
        ValueError: for an unknown keyframe, or a joint position that is missing at one of the samples.
    """
    channels = model_channels(model)
    seen = [channels[name] for name in recording.signals if name in channels]
    rate_of = {c.object: c for c in seen if c.kind == "qvel" and model.jnt_type[c.object] in _SCALAR}
    paired = {c.name: rate_of[c.object] for c in seen if c.kind == "qpos" and c.object in rate_of}
    smoothed = {c.name: smooth(recording[c.name], recording.period) for c in seen if c.name not in paired}
    for name, rate in paired.items():
        smoothed[name] = smooth_with_rate(recording[name], recording[rate.name], recording.period)
    qpos = np.tile(reference_qpos(model, keyframe), (len(samples), 1))
    rates = np.zeros_like(qpos)
    qpos_error = np.full((len(samples), model.nv), _POSITION_PRIOR)
    qvel_error = np.full((len(samples), model.nv), _VELOCITY_PRIOR)
    qacc = np.zeros((len(samples), model.nv))
    unseen = np.ones(model.nv, dtype=bool)
    for channel in (c for c in seen if c.kind == "qpos"):
        signal = smoothed[channel.name]
        qpos[:, channel.index] = signal.value[samples]
        rates[:, channel.index] = signal.velocity[samples]
        dofs = _dofs_of(model, channel)
        qpos_error[:, dofs] = signal.value_error[samples, None]
        qvel_error[:, dofs] = signal.velocity_error[samples, None]
        if model.jnt_type[channel.object] in _SCALAR:
            qacc[:, dofs] = signal.acceleration[samples, None]
        unseen[dofs] = False
    if np.isnan(qpos).any():
        raise ValueError(f"{recording.name}: a joint position is missing at a sample whose state is wanted")
    qvel = np.array([_tangent(model, q, rate) for q, rate in zip(qpos, rates, strict=True)]).reshape(-1, model.nv)
    states = States(qpos, qvel, qpos_error, qvel_error, qacc)
    if unseen.any():
        _fit_unseen(model, states, np.flatnonzero(unseen), seen, smoothed, samples)
    for channel in (c for c in seen if c.kind == "qvel" and c not in paired.values()):
        signal = smoothed[channel.name]
        measured = signal.value[samples]
        good = np.isfinite(measured)
        qvel[good, channel.index] = measured[good]
        qvel_error[good, channel.index] = signal.value_error[samples][good]
    return states


def _dofs_of(model: mujoco.MjModel, channel: Channel) -> slice:
    """Degrees of freedom that a position column determines; a quaternion's parts determine three together."""
    joint = channel.object
    start, offset = int(model.jnt_dofadr[joint]), channel.index - int(model.jnt_qposadr[joint])
    match mujoco.mjtJoint(model.jnt_type[joint]):
        case mujoco.mjtJoint.mjJNT_FREE:
            return slice(start + offset, start + offset + 1) if offset < 3 else slice(start + 3, start + 6)
        case mujoco.mjtJoint.mjJNT_BALL:
            return slice(start, start + 3)
    return slice(start, start + 1)


def _tangent(model: mujoco.MjModel, qpos: Array, rate: Array) -> Array:
    """Velocity (nv,) of a posture (nq,) whose coordinates, quaternions included, change at a rate (nq,)."""
    step, qvel = 1e-4, np.empty(model.nv)
    here, later = qpos.copy(), qpos + 1e-4 * rate
    mujoco.mj_normalizeQuat(model, here)
    mujoco.mj_normalizeQuat(model, later)
    mujoco.mj_differentiatePos(model, qvel, step, here, later)
    return qvel


def _fit_unseen(
    model: mujoco.MjModel,
    states: States,
    dofs: NDArray[np.intp],
    seen: list[Channel],
    smoothed: dict[str, Smoothed],
    samples: NDArray[np.intp],
) -> None:
    """Fit the degrees of freedom without a column, in place: positions by least squares, then velocities linearly."""
    data = mujoco.MjData(model)
    position = [c for c in seen if depends_on_stage(model, c, mujoco.mjtStage.mjSTAGE_POS)]
    velocity = [c for c in seen if depends_on_stage(model, c, mujoco.mjtStage.mjSTAGE_VEL)]

    def measured(channels: list[Channel], attribute: str, sample: int) -> Array:
        return np.array([getattr(smoothed[c.name], attribute)[sample] for c in channels])

    offset = np.zeros(len(dofs))
    for w, sample in enumerate(samples):
        reference, known_velocity = states.qpos[w].copy(), states.qvel[w].copy()
        targets = measured(position, "value", sample)
        position_error = np.maximum(measured(position, "value_error", sample), _LEAST_ERROR)
        rate_error = np.append(
            measured(position, "velocity_error", sample), measured(velocity, "value_error", sample)
        ).clip(_LEAST_ERROR)

        def posture(offset: Array, reference: Array = reference) -> Array:
            qpos, tangent = reference.copy(), np.zeros(model.nv)
            tangent[dofs] = offset
            mujoco.mj_integratePos(model, qpos, tangent, 1.0)
            return qpos

        def misfit(offset: Array, targets: Array = targets, error: Array = position_error) -> Array:
            values = read_state(model, data, posture(offset), np.zeros(model.nv), position)
            return np.append(np.nan_to_num((values - targets) / error), offset / _POSITION_PRIOR)

        fit = least_squares(misfit, offset)
        offset = fit.x  # the next window starts from here
        states.qpos[w] = qpos = posture(offset)
        states.qpos_error[w, dofs] = np.sqrt(np.diag(np.linalg.inv(fit.jac.T @ fit.jac)))

        base = np.where(np.isin(np.arange(model.nv), dofs), 0.0, known_velocity)
        rates = np.append(measured(position, "velocity", sample), measured(velocity, "value", sample))

        def predicted_rates(qvel: Array, qpos: Array = qpos) -> Array:
            step, later = 1e-5, qpos.copy()
            mujoco.mj_integratePos(model, later, qvel, step)
            moved = read_state(model, data, later, qvel, position) - read_state(model, data, qpos, qvel, position)
            return np.append(moved / step, read_state(model, data, qpos, qvel, velocity))

        at_base = predicted_rates(base)
        unit = np.eye(model.nv)[dofs]
        slope = np.array([predicted_rates(base + direction) - at_base for direction in unit]).T.reshape(-1, len(dofs))
        finite = np.isfinite(rates)
        rows = slope[finite] / rate_error[finite, None]
        precision = rows.T @ rows + np.eye(len(dofs)) / _VELOCITY_PRIOR**2
        states.qvel[w, dofs] = np.linalg.solve(precision, rows.T @ ((rates - at_base)[finite] / rate_error[finite]))
        states.qvel_error[w, dofs] = np.sqrt(np.diag(np.linalg.inv(precision)))


def depends_on_stage(model: mujoco.MjModel, channel: Channel, stage: mujoco.mjtStage) -> bool:
    """Whether a column is a sensor of this stage, or a site, which is of the position stage."""
    if channel.kind == "site_xpos":
        return stage == mujoco.mjtStage.mjSTAGE_POS
    return channel.kind == "sensordata" and int(model.sensor_needstage[channel.object]) == int(stage)


def read_state(model: mujoco.MjModel, data: mujoco.MjData, qpos: Array, qvel: Array, channels: list[Channel]) -> Array:
    """What some position and velocity columns read in a state, (c,)."""
    if not channels:
        return np.empty(0)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_sensorPos(model, data)
    mujoco.mj_fwdVelocity(model, data)
    mujoco.mj_sensorVel(model, data)
    return read_channels(channels, {"sensordata": data.sensordata, "site_xpos": data.site_xpos})
