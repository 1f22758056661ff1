"""The part of the audit that compares a recording with a model."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np
from scipy import signal

from simopt_envs.measured.channels import (
    Channel,
    actuator_names,
    commanded_actuators,
    model_channels,
)
from simopt_envs.measured.recording import Finding, Recording
from simopt_envs.measured.resample import Array
from simopt_envs.measured.smoothing import Smoothed, smooth
from simopt_envs.physics.effects.actuators import moments
from simopt_envs.physics.effects.joints import SCALAR_JOINTS
from simopt_envs.physics.parameters import unknown_name

LEAST_SAMPLES = 20  # fewer cannot be smoothed, let alone fitted
FASTEST_HINGE = 100.0  # [rad/s] = 955 rpm, beyond robot joints: what radians logged as degrees look like
FARTHEST_SLIDE = 20.0  # [m], beyond robot workspaces: what millimetres look like
FASTEST_SLIDE = 20.0  # [m/s]
BEYOND_RANGE = 0.25  # of a joint's range, outside it: more than compliance or a bad zero explains
CLEAR_MOTION = 5.0  # a velocity can be judged where its spread is this many times its standard error
ALIKE = 0.9  # correlation that a velocity column and the derivative of its position reach at the best lag
SAME_SCALE = 1.3  # ratio between the two, either way
VELOCITY_LAG = 0.005  # [s] and 2 samples: less is how drives compute a velocity
COMMAND_BAND = 3.0  # [Hz]: below it a torque computed from positions is more than differentiation noise
COMMAND_LAG = 0.010  # [s] and 2 samples
COMMAND_ALIKE = 0.9  # correlation of command and computed torque from which anything can be said
COMMAND_CLEARER = 1.5  # unexplained variance at no lag over that at the best lag: below it the lag is chance
COMMAND_SCALE = 5.0  # ratio of the two: a wrong unit, not a wrong mass
LONGEST_LAG = 0.1  # [s] that is looked for


def against_model(recording: Recording, model: mujoco.MjModel, broken: set[str]) -> Iterator[Finding]:
    """Checks that need the model; the values of broken columns are left alone."""
    known = model_channels(model)
    unknown = [name for name in recording.columns if name not in known]
    if not any(name in known for name in recording.signals):
        yield Finding.error("", "columns", f"no measured column names anything in the model; it has {', '.join(known)}")
        return
    for name in unknown:
        yield Finding.warning(name, "columns", "left out: " + unknown_name("column", name, known))
    if nameless := [str(i) for i, name in enumerate(actuator_names(model)) if not name]:
        told = f"the model's actuators {', '.join(nameless)} have no name, so that no column ctrl/NAME can be theirs"
        yield Finding.error("", "columns", f"{told}: give them names in the MJCF")
    for name in (c.name for c in known.values() if c.kind == "ctrl" and c.name not in recording.columns):
        yield Finding.error(
            name, "columns", f"the actuator has no command column; the log has {', '.join(recording.columns)}"
        )
    channels = [known[name] for name in recording.columns if name in known and name not in broken]
    for channel in channels:
        yield from _units(recording, model, channel)
    yield from _motion(recording, model, channels)


def _units(recording: Recording, model: mujoco.MjModel, channel: Channel) -> Iterator[Finding]:
    values = recording[channel.name]
    values = values[np.isfinite(values)]
    low, high = float(values.min()), float(values.max())
    farthest = float(np.percentile(np.abs(values), 99))
    if channel.kind == "ctrl":
        if model.actuator_ctrllimited[channel.object]:
            least, most = model.actuator_ctrlrange[channel.object]
            slack = 1e-6 * (most - least)
            if low < least - slack or high > most + slack:
                outside = 100 * float(np.mean((values < least - slack) | (values > most + slack)))
                yield Finding.warning(
                    channel.name,
                    "range",
                    f"commands from {low:g} to {high:g} leave the actuator's range [{least:g}, {most:g}],"
                    f" {outside:.2g} % of them: the model would clip them",
                )
        return
    if channel.kind == "qpos" and channel.unit in ("rad", "m"):
        small, factor = ("degrees", 180 / np.pi) if channel.unit == "rad" else ("millimetres", 1e3)
        limited = bool(model.jnt_limited[channel.object])
        least, most = model.jnt_range[channel.object]
        slack = BEYOND_RANGE * (most - least)
        if limited and (low < least - slack or high > most + slack):
            message = f"{low:g} to {high:g} {channel.unit} is far outside the joint's range [{least:g}, {most:g}]"
            fits = least - slack <= low / factor and high / factor <= most + slack
            if fits and farthest > 5 * max(abs(least), abs(most)):
                yield Finding.error(channel.name, "units", f"{message}: it is in {small}")
                return
            yield Finding.warning(channel.name, "range", message)
    speed = _speed(recording, channel)
    if channel.unit in ("rad", "rad/s") and channel.kind in ("qpos", "qvel") and speed > FASTEST_HINGE:
        yield Finding.warning(
            channel.name, "units", f"moves at {speed:.4g} rad/s ({speed * 30 / np.pi:.0f} rpm): is it in degrees?"
        )
    elif channel.unit == "m" and farthest > FARTHEST_SLIDE:
        yield Finding.warning(channel.name, "units", f"reaches {farthest:.4g} m: is it in millimetres?")
    elif channel.unit in ("m", "m/s") and channel.kind in ("qpos", "qvel") and speed > FASTEST_SLIDE:
        yield Finding.warning(channel.name, "units", f"moves at {speed:.4g} m/s: is it in millimetres?")


def _speed(recording: Recording, channel: Channel) -> float:
    """99th percentile of how fast a position changes, over tenths of a second, or of a velocity."""
    values = recording[channel.name]
    if channel.kind == "qvel":
        return float(np.nanpercentile(np.abs(values), 99))
    rows = max(1, round(0.1 / recording.period))
    spans = recording.time[rows:] - recording.time[:-rows]
    if not len(spans) or np.isnan(moved := np.abs(values[rows:] - values[:-rows])).all():
        return 0.0
    return float(np.nanpercentile(moved[spans > 0] / spans[spans > 0], 99))


def _motion(recording: Recording, model: mujoco.MjModel, channels: list[Channel]) -> Iterator[Finding]:
    """Velocities against derivatives of positions, and commands against the torques that the motion needed."""
    grid = recording.resample(recording.period)
    scalar = [c for c in channels if c.kind == "qpos" and model.jnt_type[c.object] in SCALAR_JOINTS]
    if any(np.isfinite(grid[c.name]).sum() < LEAST_SAMPLES for c in channels):
        return
    joints = {c.object: smooth(grid[c.name], grid.period) for c in scalar}
    for channel in channels:
        if channel.kind == "qvel" and channel.object in joints:
            yield from _velocity(grid, model, channel, joints)
    everything_known = len(joints) == model.nv == model.njnt and not (model.na or model.nhistory)
    commanded = {f"ctrl/{name}" for name in actuator_names(model)} <= {c.name for c in channels}
    if model.nu and everything_known and commanded:
        yield from _commands(grid, model, joints)


def _velocity(
    grid: Recording, model: mujoco.MjModel, channel: Channel, joints: dict[int, Smoothed]
) -> Iterator[Finding]:
    position = joints[channel.object]
    measured, derivative = _common(grid[channel.name], position.velocity)
    if len(derivative) < LEAST_SAMPLES or derivative.std() < CLEAR_MOTION * np.median(position.velocity_error):
        return
    name = f"qpos/{model.joint(channel.object).name}"
    correlation, lag = _best_lag(measured, derivative, grid.period)
    if correlation < ALIKE:
        others = {j: _best_lag(*_common(grid[channel.name], s.velocity), grid.period)[0] for j, s in joints.items()}
        best = max(others, key=lambda joint: others[joint])
        if others[best] > max(ALIKE, abs(correlation)):
            hint = f"it is that of qpos/{model.joint(best).name}: are columns swapped?"
        elif correlation < -ALIKE:
            hint = "it has the opposite sign"
        else:
            hint = "leave it out and it is estimated"
        yield Finding.warning(
            channel.name, "velocity", f"is not the derivative of {name} (correlation {correlation:.2f}); {hint}"
        )
        return
    ratio = float(measured.std() / derivative.std())
    if not 1 / SAME_SCALE < ratio < SAME_SCALE:
        hint = next(
            (text for factor, text in _SCALES if 1 / SAME_SCALE < ratio / factor < SAME_SCALE),
            "a unit, or the rate of the time stamps, is wrong",
        )
        yield Finding.warning(channel.name, "velocity", f"is {ratio:.4g} times the derivative of {name}: {hint}")
    if abs(lag) > max(VELOCITY_LAG, 2 * grid.period):
        way = "behind" if lag > 0 else "ahead of"
        yield Finding.warning(
            channel.name,
            "latency",
            f"is {1e3 * abs(lag):.3g} ms {way} the derivative of {name}; leave it out and it is estimated",
        )


_SCALES = (
    (180 / np.pi, "it is in degrees per second"),
    (np.pi / 180, "the position is in degrees"),
    (30 / np.pi, "it is in revolutions per minute"),
    (1e3, "it is in millimetres per second, or time in milliseconds"),
    (1e-3, "the position is in millimetres, or time in milliseconds"),
)


def _commands(grid: Recording, model: mujoco.MjModel, joints: dict[int, Smoothed]) -> Iterator[Finding]:
    """Compare each joint's torque from its commands with the one that its motion needed, by inverse dynamics."""
    needed, given = _torques(grid, model, joints)
    usable = np.isfinite(needed).all(axis=1) & np.isfinite(given).all(axis=(1, 2))
    edge = round(1 / (COMMAND_BAND * grid.period))  # where the filter has not seen a whole cycle
    cut_off = 2 * COMMAND_BAND * grid.period
    if not usable.all() or cut_off >= 1 or len(grid) < 6 * edge:
        return  # a filter cannot run across holes, nor be judged on a few cycles
    low_pass = signal.butter(4, cut_off, output="sos")
    stride = max(1, edge // 40)

    def slow(values: Array) -> Array:
        return signal.sosfiltfilt(low_pass, values, axis=0)[edge:-edge:stride]

    period, commands = stride * grid.period, _command_columns(model)
    for dof in range(model.nv):
        joint = int(model.dof_jntid[dof])
        velocity = joints[joint].velocity
        # Friction and a constant load, which the model may lack, are projected out.
        nuisance = slow(np.stack([np.ones_like(velocity), velocity, np.sign(velocity)], axis=1))
        want = slow(needed[:, dof])
        spread = given[:, dof].std(axis=0)
        for actuator in np.flatnonzero(spread > 0.5 * spread.max()):  # others would be drowned
            name = commands[int(actuator)]
            have = slow(given[:, dof, actuator])
            still = _partial_correlation(want, have, nuisance)
            correlation, lag = _best_lag(want, have, period, nuisance)
            yield from _command(name, model.joint(joint).name, want, have, (still, correlation, lag, grid.period))
            for other in set(range(len(commands))) - {int(actuator)} if still < COMMAND_ALIKE else ():
                foreign = slow(grid[commands[other]])
                alike = _partial_correlation(want, foreign, nuisance)
                if alike > COMMAND_ALIKE and (1 - still**2) > COMMAND_CLEARER * (1 - alike**2):
                    yield Finding.warning(
                        name,
                        "command",
                        f"{model.joint(joint).name} moves with {commands[other]} instead: are columns swapped?",
                    )


def _command(
    name: str, joint: str, want: Array, have: Array, alike: tuple[float, float, float, float]
) -> Iterator[Finding]:
    """What follows from a torque that the motion needed and the one that a command gave."""
    still, correlation, lag, period = alike
    if still < -COMMAND_ALIKE:
        yield Finding.warning(
            name, "command", f"acts against the motion of {joint} (correlation {still:.2f}): its sign?"
        )
    elif correlation > COMMAND_ALIKE:
        clearer = (1 - still**2) > COMMAND_CLEARER * (1 - correlation**2)
        if clearer and abs(lag) > max(COMMAND_LAG, 2 * period):
            way = "follows" if lag > 0 else "precedes"
            yield Finding.warning(
                name, "latency", f"the motion of {joint} {way} it by {1e3 * abs(lag):.3g} ms more than in the model"
            )
        scale = float(want.std() / have.std())
        if not 1 / COMMAND_SCALE < scale < COMMAND_SCALE:
            yield Finding.warning(
                name, "units", f"the motion of {joint} needed {scale:.3g} times what it gives: its unit?"
            )


def _command_columns(model: mujoco.MjModel) -> list[str]:
    """The columns of commands, each once: a drive with a dead band has two actuators."""
    return list(dict.fromkeys(f"ctrl/{name}" for name in actuator_names(model)))


def _torques(grid: Recording, model: mujoco.MjModel, joints: dict[int, Smoothed]) -> tuple[Array, Array]:
    """Generalised forces that the motion needed, (T, nv), and that each command column gave, (T, nv, c)."""
    data = mujoco.MjData(model)
    order = [joints[int(model.dof_jntid[dof])] for dof in range(model.nv)]
    state = [np.stack([getattr(s, what) for s in order], axis=1) for what in ("value", "velocity", "acceleration")]
    columns, names = _command_columns(model), [f"ctrl/{name}" for name in actuator_names(model)]
    commands = np.stack([grid[name] for name in names], axis=1)
    needed, given = np.full((len(grid), model.nv), np.nan), np.zeros((len(grid), model.nv, len(columns)))
    drives, parts = commanded_actuators(model), np.array([[name == column for column in columns] for name in names])
    for t in np.flatnonzero(np.isfinite(np.concatenate(state, axis=1)).all(axis=1)):
        data.qpos[:], data.qvel[:], data.qacc[:] = (part[t] for part in state)
        data.ctrl[:] = 0
        mujoco.mj_inverse(model, data)
        mujoco.mj_fwdActuation(model, data)
        idle, idle_force = data.qfrc_actuator.copy(), data.actuator_force.copy()
        data.ctrl[:] = commands[t]
        mujoco.mj_fwdActuation(model, data)
        needed[t] = data.qfrc_inverse - idle
        given[t] = (moments(model, data) * (data.actuator_force - idle_force)[:, None])[drives].T @ parts
    return needed, given


def _best_lag(late: Array, early: Array, period: float, nuisance: Array | None = None) -> tuple[float, float]:
    """Correlation and lag [s] at which ``late`` (T,) follows ``early`` (T,) best, between samples by a parabola.

    With a nuisance (T, k), at the times of ``late``, both are taken after its projection.
    """
    most = max(2, min(round(LONGEST_LAG / period), len(late) // 4))
    nuisance = np.ones((len(late), 1)) if nuisance is None else nuisance
    correlations = np.zeros(2 * most + 1)
    for k, lag in enumerate(range(-most, most + 1)):
        later = slice(max(lag, 0), len(late) + min(lag, 0))
        earlier = slice(max(-lag, 0), len(early) + min(-lag, 0))
        correlations[k] = _partial_correlation(late[later], early[earlier], nuisance[later])
    best = int(np.argmax(np.abs(correlations)))
    offset = 0.0
    if 0 < best < 2 * most:
        before, peak, after = correlations[best - 1 : best + 2]
        bend = before - 2 * peak + after
        offset = 0.5 * (before - after) / bend if bend else 0.0
    return float(correlations[best]), float((best - most + offset) * period)


def _partial_correlation(first: Array, second: Array, nuisance: Array) -> float:
    """Correlation of two signals (T,) after the projection of a nuisance (T, k); 0 where nothing is left."""
    basis, _ = np.linalg.qr(nuisance)
    left = [x - basis @ (basis.T @ x) for x in (first, second)]
    norms = [float(np.linalg.norm(x)) for x in left]
    return float(left[0] @ left[1] / (norms[0] * norms[1])) if min(norms) > 0 else 0.0


def _common(first: Array, second: Array) -> tuple[Array, Array]:
    both = np.isfinite(first) & np.isfinite(second)
    return first[both], second[both]
