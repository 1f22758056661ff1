"""What a misfit that nothing explains looks like: a missing force, or a wrong reading, as a function of one variable.

The whitened errors e of windows are linear in a small force on a joint and in an offset of a reading. So for each
carrier (a joint's force, a column's reading) and each variable x (a position, a velocity, a load, time, ...) the curve
φ(x) β that takes most of e away is a linear least-squares fit, φ being hat functions between quantiles of x. Curves are
fitted to all recordings but one and judged on that one: R² is the share of the squared errors above those of noise that
they take away there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from simopt_envs.gap.carriers import Carrier, Residual, forces, readings
from simopt_envs.gap.circumstances import Circumstances, circumstances
from simopt_envs.gap.curves import Curve, Regression, Variable, regress
from simopt_envs.gap.hypothesis import Hypothesis
from simopt_envs.gap.localise import EVERYWHERE, Row, partitions, split_regime, tabulate
from simopt_envs.physics.effects.joints import force_unit, is_slide
from simopt_envs.physics.parameters import Array

_LEAST_R2 = 0.25  # below it a variable does not describe the misfit
_SIMPLER = 0.03  # of what the best explains, that a simpler description or one of the joint's own motion may lack
_NEARLY = 0.1  # of what the best variable explains, that another may lack to do nearly as well
_NOT = 0.2  # of what the best variable explains: one that explains less does not matter
_CLEARLY = 1.5  # times its mean square that a channel has where a sentence says most is left
_LEAST_EXCESS = 3.0  # standard errors of the squared errors over those of noise, for there to be something to describe
_CONSTANT = "a constant"
_NEAR_ZERO = 0.06  # of a variable's range
_JUMP = 0.6  # of a curve's range, from which a step at zero is a jump
_TURN = 0.25  # of a curve's range, by which it must go back to have turned round
_OSCILLATES = 3  # turns
_MONOTONE = 0.9  # correlation with a curve's argument from which it grows or falls


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
        residuals: what it leaves, of two recordings or more; those held out last.
    """
    around = [circumstances(hypothesis.plain.model, r.windows) for r in residuals]
    carriers = [*forces(hypothesis, u, residuals), *readings(residuals)]
    recordings = [r.windows.recording for r in residuals]
    if len({name for names in recordings for name in names}) < 2:
        return Description("One recording alone cannot tell what its errors depend on.", None, ())
    samples = sum(int(np.isfinite(r.windows.measured).sum()) for r in residuals)
    excess = sum(float(np.sum(r.errors**2)) for r in residuals) - samples
    if excess < _LEAST_EXCESS * np.sqrt(2 * samples):
        return Description("No more is left than noise.", None, ())
    found = describe_errors(carriers, variables(hypothesis.plain.model, around), recordings, excess)
    if found.curve is not None:
        return found
    last = residuals[-1].windows
    rows = tabulate(last.names, residuals[-1].errors, np.isfinite(last.measured), partitions(around[-1]))
    return replace(found, text=found.text + _where(rows))


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
    tried = [regress(carrier, variable, recordings) for carrier in carriers for variable in (constant, *variables)]
    ranked = sorted(
        ((regression, float(regression.gains.max()) / excess) for regression in tried), key=lambda scored: -scored[1]
    )
    table = tuple((regression.carrier.name, regression.variable.name, r2) for regression, r2 in ranked)
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
        regression: (value - of_constant) / max(most - of_constant, 1e-9)
        for regression, value in ranked
        if regression.carrier is chosen.carrier and regression is not chosen
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


def _where(rows: Sequence[Row]) -> str:
    """A sentence on the regime in which most is left, if that is clearly more than elsewhere."""
    regimes = [row for row in rows if row.regime != EVERYWHERE and row.lift > _CLEARLY]
    row = max(regimes, key=lambda row: row.telling, default=None)
    if row is None or not row.telling:
        return ""
    partition, part = split_regime(row.regime)
    return (
        f" Most is left of {row.channel} with the {partition} {part}: there its mean square is {row.lift:.1f} times"
        f" that of all its samples, {row.z:.0f} standard errors above noise."
    )


def _sentence(regression: Regression, curve: Curve, others: Mapping[Regression, float]) -> str:
    """The best curve in words, what does nearly as well, and what does not matter.

    ``others`` gives what other variables explain beyond a constant, as a share of what the best one does.
    """
    quality = f"(R² {curve.r2:.2f} on recordings not used)"
    if regression.variable.name == _CONSTANT:
        return f"The {regression.carrier.name} is constant, {curve.y[0]:.3g} {regression.carrier.unit} {quality}."
    text = f"The {regression.carrier.name} {_shape(curve)} {regression.variable.name} {quality}"
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
