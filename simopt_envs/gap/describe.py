"""What a misfit that nothing explains looks like: a missing force, or a wrong reading, as a function of one variable.

The whitened errors e of windows are linear in a small force on a joint and in an offset of a reading. So for each
carrier (a joint's force, a column's reading) and each variable x (a position, a velocity, a load, time, ...) the curve
φ(x) β that takes most of e away is a linear least-squares fit, φ being hat functions between quantiles of x. Curves are
fitted to all recordings but one and judged on that one: R² is the share of the squared errors above those of noise that
they take away there.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import mujoco
import numpy as np
from numpy.typing import NDArray

from simopt_envs.adaptation.fitting import Noise
from simopt_envs.gap.circumstances import Circumstances, circumstances
from simopt_envs.gap.hypothesis import Hypothesis
from simopt_envs.measured.windows import Windows
from simopt_envs.physics.effects import object_name
from simopt_envs.physics.effects.joints import dof, force_unit, is_slide, scalar_joints
from simopt_envs.physics.parameters import Array

_KNOTS = 16
_STRETCHES = 10  # of a window, on each of which a force is constant
_PULSE = 0.02  # of a joint's force in the recordings: small enough to act linearly
_RIDGE = 1e-5  # of the mean information about a knot: decides only what the data do not
_SMOOTHNESS = (0.0, 1e-3, 1e-2, 1e-1)  # of the same, for a bend at a knot; what predicts best is taken
_CURVE_POINTS = 60
_LEAST_R2 = 0.25  # below it a variable does not describe the misfit
_SIMPLER = 0.03  # of what the best explains, that a simpler description or one of the joint's own motion may lack
_NEARLY = 0.1  # of what the best variable explains, that another may lack to do nearly as well
_NOT = 0.2  # of what the best variable explains: one that explains less does not matter
_LEAST_EXCESS = 3.0  # standard errors of the squared errors over those of noise, for there to be something to describe
_MOST_STRETCHES = 50  # for readings
_CONSTANT = "a constant"
_MOTOR = "missing force on "
_STEEP = 0.01  # of a variable's range, within which a curve may jump at zero
_NEAR_ZERO = 0.06  # of a variable's range
_JUMP = 0.6  # of a curve's range, from which a step at zero is a jump
_TURN = 0.25  # of a curve's range, by which it must go back to have turned round
_OSCILLATES = 3  # turns
_MONOTONE = 0.9  # correlation with a curve's argument from which it grows or falls


@dataclass(frozen=True)
class Residual:
    """What a fitted model leaves of some windows.

    Attributes:
        windows: w of them.
        errors: whitened, simulated minus measured, (w, S, c).
        noise: that they are whitened with.
    """

    windows: Windows
    errors: Array
    noise: Noise


@dataclass(frozen=True, eq=False)
class Variable:
    """What a misfit may depend on.

    Attributes:
        name: ``"velocity of elbow"``.
        unit: of its values.
        of: the joint or actuator, empty for none.
        rank: simpler ones come first where they do as well.
        values: at each sample, one (w, S) for each set of windows.
    """

    name: str
    unit: str
    of: str
    rank: int
    values: tuple[Array, ...]


@dataclass(frozen=True, eq=False)
class Carrier:
    """Where the misfit may enter, piecewise constant on k stretches of each window.

    With J (m, k) the whitened errors that units of it make, and e (m,) those that there are:

    Attributes:
        name: ``"force on elbow"`` or ``"reading of qpos/elbow"``.
        unit: of the curve.
        of: the joint, empty for readings.
        information: Jᵀ J, one (w, k, k) for each set of windows.
        slope: Jᵀ e, one (w, k) for each set of windows.
    """

    name: str
    unit: str
    of: str
    information: tuple[Array, ...]
    slope: tuple[Array, ...]


@dataclass(frozen=True)
class Curve:
    """A carrier as a function of a variable.

    Attributes:
        carrier, carrier_unit, variable, variable_unit: names and units.
        r2: share of the squared errors above those of noise that it takes away from recordings it was not fitted to.
        x: arguments, (g,).
        y: values, (g,), in all recordings together.
        by_recording: the same fitted to each recording alone, (r, g), NaN outside of its range.
    """

    carrier: str
    carrier_unit: str
    variable: str
    variable_unit: str
    r2: float
    x: Array
    y: Array
    by_recording: Array


@dataclass(frozen=True)
class Description:
    """A misfit in words.

    Attributes:
        text: one sentence.
        curve: of the best variable; None where no variable describes it.
        table: (carrier, variable, R²) of all that was tried, best first.
    """

    text: str
    curve: Curve | None
    table: tuple[tuple[str, str, float], ...]


def describe(hypothesis: Hypothesis, u: Array, residuals: Sequence[Residual]) -> Description:
    """What a fitted hypothesis leaves unexplained, in words.

    Args:
        hypothesis: plain parameters and effects.
        u: their fitted coordinates, (d,).
        residuals: what it leaves, of two recordings or more.
    """
    around = [circumstances(hypothesis.plain.model, r.windows) for r in residuals]
    carriers = [*_forces(hypothesis, u, residuals), *_readings(residuals)]
    recordings = [r.windows.recording for r in residuals]
    if len({name for names in recordings for name in names}) < 2:
        return Description("One recording alone cannot tell what its errors depend on.", None, ())
    samples = sum(int(np.isfinite(r.windows.measured).sum()) for r in residuals)
    excess = sum(float(np.sum(r.errors**2)) for r in residuals) - samples
    if excess < _LEAST_EXCESS * np.sqrt(2 * samples):
        return Description("No more is left than noise.", None, ())
    return describe_errors(carriers, variables(hypothesis.plain.model, around), recordings, excess)


def describe_errors(
    carriers: Sequence[Carrier],
    variables: Sequence[Variable],
    recordings: Sequence[Sequence[str]],
    excess: float,
) -> Description:
    """The same for any carriers and variables.

    Args:
        carriers: where it may enter.
        variables: what it may depend on.
        recordings: names of the recordings that the windows are of, for each set of windows.
        excess: of the squared errors over those of noise.
    """
    constant = Variable(_CONSTANT, "", "", -1, tuple(np.ones_like(values) for values in variables[0].values))
    tried = [_equations(carrier, variable, recordings) for carrier in carriers for variable in (constant, *variables)]
    ranked = sorted(((trial, float(trial.gains.max()) / excess) for trial in tried), key=lambda scored: -scored[1])
    table = tuple((trial.carrier.name, trial.variable.name, r2) for trial, r2 in ranked)
    best, most = ranked[0]
    if most < _LEAST_R2:
        carrier, variable, _ = table[0]
        text = f"No one variable describes it: the {carrier} as a function of {variable} comes closest (R² {most:.2f})."
        return Description(text, None, table)
    of_constant = max(0.0, *(r2 for t, r2 in ranked if t.carrier is best.carrier and t.variable is constant))
    # What a variable tells is what it adds to a constant.
    least = most - _SIMPLER * (most - of_constant) if most - of_constant > _SIMPLER else of_constant
    chosen, r2 = min(
        (scored for scored in ranked if scored[1] >= least),
        key=lambda scored: (scored[0].variable.rank, not scored[0].is_own, -scored[1]),
    )
    curve = chosen.curve(r2)
    others = {
        trial: (value - of_constant) / max(most - of_constant, 1e-9)
        for trial, value in ranked
        if trial.carrier is chosen.carrier and trial is not chosen
    }
    return Description(_sentence(chosen, curve, others), curve, table)


def variables(model: mujoco.MjModel, around: Sequence[Circumstances]) -> list[Variable]:
    """What misfits are held against."""
    first = around[0]
    found = [Variable("time in the recording", "s", "", 3, tuple(c.time for c in around))]
    for j, joint in enumerate(first.joints):
        metre = "m" if is_slide(model, joint) else "rad"
        for name, unit, rank, of in (
            ("direction", "", 0, [c.direction() for c in around]),
            ("position", metre, 1, [c.position for c in around]),
            ("velocity", f"{metre}/s", 1, [c.velocity for c in around]),
            ("|velocity|", f"{metre}/s", 0, [np.abs(c.velocity) for c in around]),
            ("acceleration", f"{metre}/s²", 2, [c.acceleration for c in around]),
            ("load", force_unit(model, joint), 2, [c.load for c in around]),
        ):
            found.append(Variable(f"{name} of {joint}", unit, joint, rank, tuple(values[..., j] for values in of)))
    for a, actuator in enumerate(first.actuators):
        found.append(Variable(f"command of {actuator}", "", actuator, 2, tuple(c.command[..., a] for c in around)))
    return [v for v in found if any(np.ptp(values) > 0 for values in v.values)]


@dataclass(frozen=True, eq=False)
class _Trial:
    """A carrier as a function of a variable: the normal equations of each recording."""

    carrier: Carrier
    variable: Variable
    knots: Array
    information: Array  # (r, b, b)
    slope: Array  # (r, b): of the squared errors, halved, at β = 0
    ranges: Array  # (r, 2) of the variable

    @property
    def is_own(self) -> bool:
        """Whether the variable is of the joint that the force acts on."""
        return bool(self.carrier.of) and self.carrier.of == self.variable.of

    @cached_property
    def priors(self) -> Array:
        """What is added to the information of a fit, (p, b, b): next to nothing, and ever smoother curves."""
        size = max(float(np.trace(self.information.sum(axis=0))), 1e-12) / len(self.knots)
        bends = _bends(self.knots)
        smooth = [np.eye(len(self.knots)) * _RIDGE + weight * bends.T @ bends for weight in _SMOOTHNESS]
        return size * np.array(smooth)

    def solve(self, rows: NDArray[np.intp], prior: Array) -> Array:
        """β (b,) of some recordings."""
        return -np.linalg.solve(self.information[rows].sum(axis=0) + prior, self.slope[rows].sum(axis=0))

    @cached_property
    def gains(self) -> Array:
        """Squared errors that curves of the other recordings take away from each, for each prior, (p,)."""
        everyone, gains = np.arange(len(self.slope)), np.zeros(len(self.priors))
        for left_out in everyone:
            for p, prior in enumerate(self.priors):
                beta = self.solve(everyone[everyone != left_out], prior)
                gains[p] -= 2 * self.slope[left_out] @ beta + beta @ self.information[left_out] @ beta
        return gains

    def curve(self, r2: float) -> Curve:
        """The curve of all recordings, and of each."""
        everyone = np.arange(len(self.slope))
        x = self.knots if len(self.knots) <= 2 else np.linspace(self.knots[0], self.knots[-1], _CURVE_POINTS)
        hats, beta = _hats(x, self.knots), self.solve(everyone, self.priors[np.argmax(self.gains)])
        alone = []
        for r in everyone:
            # Towards the common curve, where a recording alone does not tell.
            prior = 0.1 * np.diag(np.diag(self.information.mean(axis=0)) + 1e-12)
            own = beta - np.linalg.solve(self.information[r] + prior, self.slope[r] + self.information[r] @ beta)
            inside = (x >= self.ranges[r, 0]) & (x <= self.ranges[r, 1])
            alone.append(np.where(inside, hats @ own, np.nan))
        return Curve(
            self.carrier.name,
            self.carrier.unit,
            self.variable.name,
            self.variable.unit,
            r2,
            x,
            hats @ beta,
            np.array(alone),
        )


def _equations(carrier: Carrier, variable: Variable, recordings: Sequence[Sequence[str]]) -> _Trial:
    """The normal equations of each recording for hat functions of a variable."""
    knots = _knots(np.concatenate([values.ravel() for values in variable.values]))
    names = list(dict.fromkeys(name for of_set in recordings for name in of_set))
    information, slope = np.zeros((len(names), len(knots), len(knots))), np.zeros((len(names), len(knots)))
    ranges = np.tile([np.inf, -np.inf], (len(names), 1))
    for values, of_set, gram, gradient in zip(
        variable.values, recordings, carrier.information, carrier.slope, strict=True
    ):
        stretches = _stretches(values.shape[1], gram.shape[-1])
        basis = np.einsum("wsb,sk->wkb", _hats(values, knots), stretches / stretches.sum(axis=0))
        rows = np.array([names.index(name) for name in of_set])
        np.add.at(information, rows, np.swapaxes(basis, 1, 2) @ gram @ basis)
        np.add.at(slope, rows, np.einsum("wkb,wk->wb", basis, gradient))
        np.minimum.at(ranges[:, 0], rows, values.min(axis=1))
        np.maximum.at(ranges[:, 1], rows, values.max(axis=1))
    return _Trial(carrier, variable, knots, information, slope, ranges)


def _forces(hypothesis: Hypothesis, u: Array, residuals: Sequence[Residual]) -> list[Carrier]:
    """A force on each joint: the hypothesis with one more motor there, whose command is a pulse in each stretch."""
    plain = hypothesis.plain
    places = scalar_joints(plain.model)
    joints = [object_name(place) for place in places]
    spec = plain.spec.copy()
    for joint in joints:
        motor = spec.add_actuator(name=f"{_MOTOR}{joint}", target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_motor()
    driven = Hypothesis(replace(plain, spec=spec, model=spec.compile()), hypothesis.candidates, hypothesis.motion)
    sizes = [_PULSE * float(hypothesis.motion.force[dof(plain.model, joint)]) for joint in joints]
    # One list of (information, slope), joint by joint, for each set of windows.
    parts = [_pulsed(driven, u, residual, sizes) for residual in residuals]
    return [
        Carrier(
            f"force on {joint}",
            force_unit(plain.model, joint),
            joint,
            tuple(part[j][0] for part in parts),
            tuple(part[j][1] for part in parts),
        )
        for j, joint in enumerate(joints)
    ]


def _pulsed(driven: Hypothesis, u: Array, residual: Residual, sizes: Sequence[float]) -> list[tuple[Array, Array]]:
    """Information (w, k, k) and slope (w, k) of a force on each joint."""
    windows, joints = residual.windows, len(sizes)
    w, steps = windows.commands.shape[:2]
    k = min(_STRETCHES, len(windows.offsets) - 1)
    active = np.arange(k)[:, None] == np.arange(steps) * k // steps
    errors = residual.errors.reshape(w, -1)
    found = []
    for j, size in enumerate(sizes):  # one joint at a time, as every pulse is a world for each window
        pulses = np.zeros((k + 1, steps, joints))  # the last is none
        pulses[:k, :, j] = size * active
        commands = np.concatenate([np.tile(windows.commands, (k + 1, 1, 1)), np.repeat(pulses, w, axis=0)], axis=2)
        simulate = driven.simulator(_repeated(windows, commands, joints))
        simulated = simulate(driven.xi(u[None]))[0].reshape(k + 1, *windows.measured.shape)
        change = np.where(np.isfinite(windows.measured), np.nan_to_num(simulated[:k] - simulated[k]), 0.0)
        jacobian = np.moveaxis(residual.noise.whiten(change).reshape(k, w, -1), 0, -1) / size
        found.append((np.swapaxes(jacobian, 1, 2) @ jacobian, np.einsum("wmk,wm->wk", jacobian, errors)))
    return found


def _repeated(windows: Windows, commands: Array, new: int) -> Windows:
    """Windows as often as there are commands (n w, N, nu + new) for them."""
    times = len(commands) // len(windows)
    past = np.concatenate([windows.past_commands, np.zeros((*windows.past_commands.shape[:2], new))], axis=2)
    return replace(
        windows,
        start_time=np.tile(windows.start_time, times),
        recording=windows.recording * times,
        measured=np.tile(windows.measured, (times, 1, 1)),
        commands=commands,
        past_commands=np.tile(past, (times, 1, 1)),
        starts=windows.starts.select(np.tile(np.arange(len(windows)), times)),
    )


def _readings(residuals: Sequence[Residual]) -> Iterator[Carrier]:
    """An offset of each column's reading: whitening W makes Wᵀ W of the units, and Wᵀ e of the errors."""
    for c, channel in enumerate(residuals[0].windows.channels):
        information, slope = [], []
        for residual in residuals:
            noise, shape = residual.noise, residual.errors.shape
            counted = np.isfinite(residual.windows.measured[..., c])
            units = counted[..., None] * _stretches(shape[1], min(shape[1], _MOST_STRETCHES)) / noise.scale[c]
            basis = noise.basis.reshape(*shape, -1)[..., c, :]
            seen = np.einsum("wsk,wsm->wmk", units, basis)
            information.append(
                np.swapaxes(units, 1, 2) @ units
                - np.einsum("wmk,wm,wml->wkl", seen, noise.shrink * (2 - noise.shrink), seen)
            )
            twice = noise.whiten((residual.errors * noise.scale)[None])[0, ..., c]
            slope.append(np.einsum("wsk,ws->wk", units, twice))
        yield Carrier(f"reading of {channel.name}", channel.unit, "", tuple(information), tuple(slope))


def _stretches(samples: int, k: int) -> Array:
    """Which of k stretches each sample is in, (S, k) of 0 and 1."""
    stretch = np.minimum(np.arange(samples) * k // max(samples - 1, 1), k - 1)
    return (stretch[:, None] == np.arange(k)).astype(np.float64)


def _knots(values: Array) -> Array:
    """Where hat functions of a variable peak: its values where there are two, else quantiles, (b,).

    Around zero there are two more, close together, so that a curve may jump there.
    """
    unique = np.unique(values)
    if len(unique) <= 2:
        return unique
    inner = np.quantile(values, np.linspace(0, 1, _KNOTS)[1:-1])
    zero = _STEEP * (inner[-1] - inner[0]) * np.array([-1.0, 1.0])
    if inner[0] < zero[0] and zero[1] < inner[-1]:
        inner = np.concatenate([inner[(inner < 2 * zero[0]) | (inner > 2 * zero[1])], zero])
    knots = np.unique(np.concatenate([unique[[0]], inner, unique[[-1]]]))
    return knots[np.append(True, np.diff(knots) > 1e-9 * np.ptp(knots))]


def _hats(values: Array, knots: Array) -> Array:
    """Hat functions at values (...,), (..., b)."""
    return np.stack([np.interp(values, knots, unit) for unit in np.eye(len(knots))], axis=-1)


def _bends(knots: Array) -> Array:
    """Changes of a curve's slope at its knots, in units of its values, (n, b); none where it may jump."""
    spacing, steep = np.diff(knots), 3 * _STEEP * np.ptp(knots)
    rows = []
    for i in range(1, len(knots) - 1):
        if min(spacing[i - 1], spacing[i]) > steep or len(knots) < _KNOTS:
            row = np.zeros(len(knots))
            row[i - 1 : i + 2] = 1 / spacing[i - 1], -1 / spacing[i - 1] - 1 / spacing[i], 1 / spacing[i]
            rows.append(row * spacing[i - 1 : i + 1].mean())
    return np.array(rows).reshape(-1, len(knots))


def _sentence(trial: _Trial, curve: Curve, others: Mapping[_Trial, float]) -> str:
    """The best curve in words, what does nearly as well, and what does not matter.

    ``others`` gives what other variables explain beyond a constant, as a share of what the best one does.
    """
    quality = f"(R² {curve.r2:.2f} on recordings not used)"
    if trial.variable.name == _CONSTANT:
        return f"The {trial.carrier.name} is constant, {curve.y[0]:.3g} {trial.carrier.unit} {quality}."
    text = f"The {trial.carrier.name} {_shape(curve)} {trial.variable.name} {quality}"
    without = [t.variable.name for t, share in others.items() if t.is_own and t.variable.rank <= 1 and share < _NOT]
    as_well = [t.variable.name for t, share in others.items() if share > 1 - _NEARLY]
    if without:
        text += f", not with {' or '.join(without[:2])}"
    if as_well:
        text += f"; {' or '.join(as_well[:2])} would do nearly as well"
    return text + "."


def _shape(curve: Curve) -> str:
    """What the curve does with the variable, as a verb with its preposition."""
    x, y = curve.x, curve.y
    if len(x) <= 2:
        return "changes with the"
    span = np.ptp(y)
    if span == 0:
        return "does not depend on"
    if _turns(y, _TURN * span) >= _OSCILLATES:
        return "oscillates with"
    slope = float(np.corrcoef(x, y)[0, 1])
    if abs(slope) > _MONOTONE:
        return "grows with" if slope > 0 else "falls with"
    near = _NEAR_ZERO * np.ptp(x)
    if x[0] < -near and x[-1] > near and abs(np.diff(np.interp([-near, near], x, y))[0]) > _JUMP * span:
        return "jumps at the zero of"
    return "depends on"


def _turns(y: Array, least: float) -> int:
    """How often a curve turns round, by at least so much each time."""
    count, direction, extreme = 0, 0.0, y[0]
    for value in y[1:]:
        if direction * (value - extreme) >= 0 and (direction or abs(value - extreme) > least):
            direction, extreme = direction or np.sign(value - extreme), value
        elif abs(value - extreme) > least:
            count, direction, extreme = count + 1, -direction, value
    return count
