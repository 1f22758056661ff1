"""The state a recording was in at given samples, estimated from what was measured, with standard errors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from simopt_envs.measured.channels import Channel, model_channels, read_channels
from simopt_envs.measured.recording import Recording
from simopt_envs.measured.resample import Array
from simopt_envs.measured.smoothing import Smoothed, smooth, smooth_with_rate
from simopt_envs.physics.effects.joints import SCALAR_JOINTS
from simopt_envs.physics.parameters import unknown_name

_POSITION_PRIOR = 1.0  # sd of an unmeasured joint around the reference [rad, m]: decides only what nothing sees
_VELOCITY_PRIOR = 10.0  # the same of its velocity around rest [rad/s, m/s]
_REST_OFFSET, _REST_SPEED = 0.01, 0.1  # the same of what is said to be at rest: a rope that hangs swings a little
_LEARNT_FROM = 8  # samples of a recording
_TOLD = 5.0  # directions in all of these that sites and sensors must tell for that to tell of others
_CLOSE = 1e-5  # share of squares and offsets that a step of a fit changes when it ends: far less than noise
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
        if not model.nkey:
            raise ValueError(f"unknown keyframe {keyframe!r}: the model has none")
        raise ValueError(unknown_name("keyframe", keyframe, [model.key(i).name for i in range(model.nkey)]))
    return model.key_qpos[key].copy()


def estimate_states(
    model: mujoco.MjModel, recording: Recording, samples: NDArray[np.intp], keyframe: str | None = None
) -> States:
    """Estimate the states at some samples of a uniformly sampled recording.

    Measured positions and velocities are smoothed, both of a hinge or slide together; velocities that were not measured
    are derivatives of the smoothed positions. Joints without a column are fitted, from the reference or keyframe, to
    the sites and sensors that depend on positions, and their velocities to the rates of those and to velocity sensors;
    what nothing sees stays at the reference, at rest. Where the recording begins at rest, nothing moves at its first
    sample, and joints without a column are near the reference.

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
    rate_of = {c.object: c for c in seen if c.kind == "qvel" and model.jnt_type[c.object] in SCALAR_JOINTS}
    paired = {c.name: rate_of[c.object] for c in seen if c.kind == "qpos" and c.object in rate_of}
    smoothed = {c.name: smooth(recording[c.name], recording.period) for c in seen if c.name not in paired}
    for name, rate in paired.items():
        smoothed[name] = smooth_with_rate(recording[name], recording[rate.name], recording.period)
    if recording.at_rest:
        smoothed = {name: _from_rest(signal, recording[name][0]) for name, signal in smoothed.items()}
    states, unseen = _by_columns(model, seen, smoothed, samples, keyframe)
    if np.isnan(states.qpos).any():
        raise ValueError(f"{recording.name}: a joint position is missing at a sample whose state is wanted")
    if unseen.any():
        joints = _Unseen(model, np.flatnonzero(unseen), seen, smoothed)
        if joints.are_many:
            spread = np.linspace(0, len(recording) - 1, _LEARNT_FROM).round().astype(np.intp)
            joints.learn(_by_columns(model, seen, smoothed, spread, keyframe)[0], spread)
        joints.fit(states, samples, (samples == 0) & recording.at_rest)
    for channel in (c for c in seen if c.kind == "qvel" and c not in paired.values()):
        signal = smoothed[channel.name]
        measured = signal.value[samples]
        good = np.isfinite(measured)
        states.qvel[good, channel.index] = measured[good]
        states.qvel_error[good, channel.index] = signal.value_error[samples][good]
    return states


def _from_rest(signal: Smoothed, first: float) -> Smoothed:
    """With the first sample at rest, and as it was measured: smoothed, it would be on the way that it sets off on."""
    return replace(
        signal,
        value=np.append(first, signal.value[1:]),
        velocity=np.append(0.0, signal.velocity[1:]),
        acceleration=np.append(0.0, signal.acceleration[1:]),
        value_error=np.append(signal.noise, signal.value_error[1:]),
        velocity_error=np.append(min(signal.velocity_error[0], _REST_SPEED), signal.velocity_error[1:]),
    )


def _by_columns(
    model: mujoco.MjModel,
    seen: list[Channel],
    smoothed: dict[str, Smoothed],
    samples: NDArray[np.intp],
    keyframe: str | None,
) -> tuple[States, NDArray[np.bool_]]:
    """What columns of positions tell, all else at the reference, and which degrees of freedom that is, (nv,)."""
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
        errors = np.stack([signal.value_error, signal.velocity_error])[:, samples, None]
        if dofs.stop - dofs.start > 1:  # a quaternion has the sine of half the angle, and four numbers of three errors
            others = 0.0 if unseen[dofs].all() else np.stack([qpos_error, qvel_error])[..., dofs]
            errors = np.maximum(2 * errors, others)
        qpos_error[:, dofs], qvel_error[:, dofs] = errors
        if model.jnt_type[channel.object] in SCALAR_JOINTS:
            qacc[:, dofs] = signal.acceleration[samples, None]
        unseen[dofs] = False
    qvel = np.array([_tangent(model, q, rate) for q, rate in zip(qpos, rates, strict=True)]).reshape(-1, model.nv)
    return States(qpos, qvel, qpos_error, qvel_error, qacc), unseen


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


class _Unseen:
    """Degrees of freedom without a column, which are fitted: positions by least squares, then velocities linearly.

    Args:
        model: theirs.
        dofs: which they are.
        seen: what was measured.
        smoothed: the same by name.
    """

    def __init__(
        self, model: mujoco.MjModel, dofs: NDArray[np.intp], seen: list[Channel], smoothed: dict[str, Smoothed]
    ):
        self._model, self._data, self._dofs, self._smoothed = model, mujoco.MjData(model), dofs, smoothed
        self._position = [c for c in seen if depends_on_stage(model, c, mujoco.mjtStage.mjSTAGE_POS)]
        self._velocity = [c for c in seen if depends_on_stage(model, c, mujoco.mjtStage.mjSTAGE_VEL)]
        self._prior = np.array([_POSITION_PRIOR, _VELOCITY_PRIOR])[:, None] * np.ones(len(dofs))

    @property
    def are_many(self) -> bool:
        """Whether they are more than the sites' and sensors' columns, which then cannot tell all of them."""
        return len(self._dofs) > len(self._position) + len(self._velocity)

    def learn(self, states: States, samples: NDArray[np.intp]) -> None:
        """Narrow the priors to how far from the reference, and how fast, what is seen of these says that they are.

        Those directions of many joints that nothing tells are then about as far off as those that something does. Each
        window would start with all parts of a rope anywhere, at any speed, otherwise.

        Args:
            states: the rest of the state.
            samples: where.
        """
        squares, told = np.zeros((2, 2, len(self._dofs)))
        offset, known = np.zeros(len(self._dofs)), np.flatnonzero(np.isfinite(states.qpos).all(axis=1))
        for w in known:
            qpos, qvel = states.qpos[w], states.qvel[w]
            offset, offset_covariance = self._offset(qpos, samples[w], offset, self._prior)
            rate, rate_covariance = self._rate(self._moved(qpos, offset), qvel, samples[w], self._prior)
            squares += np.square([offset, rate])
            told += 1 - np.array([np.diag(offset_covariance), np.diag(rate_covariance)]) / self._prior**2
        turns = self._turns()
        for kind in (turns, ~turns):
            number = np.sum(told[:, kind], axis=1)
            size = np.sqrt(np.sum(squares[:, kind], axis=1) / np.maximum(number, _TOLD))
            size = np.where(number < _TOLD, np.inf, np.maximum(size, _LEAST_ERROR))
            self._prior[:, kind] = np.minimum(self._prior[:, kind], size[:, None])

    def fit(self, states: States, samples: NDArray[np.intp], resting: NDArray[np.bool_]) -> None:
        """Fit them at some samples, at some of which they rest, in place."""
        offset = np.zeros(len(self._dofs))
        at_rest = np.minimum(self._prior, np.array([[_REST_OFFSET], [_REST_SPEED]]))
        for w, sample in enumerate(samples):
            prior = at_rest if resting[w] else self._prior
            offset, covariance = self._offset(states.qpos[w], sample, offset, prior)  # the next starts from here
            states.qpos[w] = self._moved(states.qpos[w], offset)
            states.qpos_error[w, self._dofs] = np.sqrt(np.diag(covariance))
            rate, covariance = self._rate(states.qpos[w], states.qvel[w], sample, prior)
            states.qvel[w, self._dofs] = rate
            states.qvel_error[w, self._dofs] = np.sqrt(np.diag(covariance))

    def _turns(self) -> NDArray[np.bool_]:
        """Which of them are angles."""
        slides = int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_FREE)
        joints = self._model.dof_jntid[self._dofs]
        offset = self._dofs - self._model.jnt_dofadr[joints]
        return ~(np.isin(self._model.jnt_type[joints], slides) & (offset < 3))

    def _measured(self, channels: list[Channel], attribute: str, sample: int) -> Array:
        return np.array([getattr(self._smoothed[c.name], attribute)[sample] for c in channels])

    def _moved(self, reference: Array, offset: Array) -> Array:
        qpos, tangent = reference.copy(), np.zeros(self._model.nv)
        tangent[self._dofs] = offset
        mujoco.mj_integratePos(self._model, qpos, tangent, 1.0)
        return qpos

    def _offset(self, reference: Array, sample: int, start: Array, prior: Array) -> tuple[Array, Array]:
        """How far they are from a reference (nq,), and the covariance of that."""
        targets = self._measured(self._position, "value", sample)
        error = np.maximum(self._measured(self._position, "value_error", sample), _LEAST_ERROR)

        def misfit(offset: Array) -> Array:
            at_rest = np.zeros(self._model.nv)
            values = read_state(self._model, self._data, self._moved(reference, offset), at_rest, self._position)
            return np.append(np.nan_to_num((values - targets) / error), offset / prior[0])

        fit = least_squares(misfit, start, ftol=_CLOSE, xtol=_CLOSE)
        return fit.x, np.linalg.inv(fit.jac.T @ fit.jac)

    def _rate(self, qpos: Array, known_velocity: Array, sample: int, prior: Array) -> tuple[Array, Array]:
        """Their velocities in a posture, and the covariance of these."""
        error = np.append(
            self._measured(self._position, "velocity_error", sample),
            self._measured(self._velocity, "value_error", sample),
        ).clip(_LEAST_ERROR)
        base = np.where(np.isin(np.arange(self._model.nv), self._dofs), 0.0, known_velocity)
        rates = np.append(
            self._measured(self._position, "velocity", sample), self._measured(self._velocity, "value", sample)
        )
        read = partial(read_state, self._model, self._data)

        def predicted_rates(qvel: Array) -> Array:
            step, later = 1e-5, qpos.copy()
            mujoco.mj_integratePos(self._model, later, qvel, step)
            moved = read(later, qvel, self._position) - read(qpos, qvel, self._position)
            return np.append(moved / step, read(qpos, qvel, self._velocity))

        at_base = predicted_rates(base)
        unit = np.eye(self._model.nv)[self._dofs]
        slope = np.array([predicted_rates(base + direction) - at_base for direction in unit]).T.reshape(-1, len(unit))
        finite = np.isfinite(rates)
        rows = slope[finite] / error[finite, None]
        precision = rows.T @ rows + np.diag(prior[1] ** -2.0)
        pull = rows.T @ ((rates - at_base)[finite] / error[finite])
        return np.linalg.solve(precision, pull), np.linalg.inv(precision)


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
