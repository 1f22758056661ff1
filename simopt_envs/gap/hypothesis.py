"""A hypothesis: the model with the structure of some effects, and a simulator of recordings for values of its ξ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import mujoco
import numpy as np

from simopt_envs.adaptation.checkpoint import digest
from simopt_envs.gap.plain import INTEGRATION_LEAD, Plain
from simopt_envs.gap.starts import loads, starts_of
from simopt_envs.gap.thresholds import FARTHEST
from simopt_envs.gap.unseen import UnseenJoints
from simopt_envs.measured.channels import Channel, actuator_names, model_channels
from simopt_envs.measured.states import States, depends_on_stage
from simopt_envs.measured.windows import Windows, WindowSimulator
from simopt_envs.physics.columns import ColumnModel, CommandModel, acts_on_columns
from simopt_envs.physics.effects import Effect, Motion
from simopt_envs.physics.effects.actuators import command_sources, on_all_parts
from simopt_envs.physics.effects.joints import on_bearing, scalar_joints
from simopt_envs.physics.parameters import Array, Parameter, ParameterSpace

_FREE = 100.0  # an effect's parameter has a prior this many probes wide: none to speak of


@dataclass(frozen=True)
class Candidate:
    """An effect at a place."""

    effect: Effect
    place: str

    def __str__(self) -> str:
        return f"{self.effect.name} at {self.place}"

    def full_name(self, parameter: str) -> str:
        """What its parameter is called in ξ: ``"coulomb_friction.elbow.frictionloss"``."""
        return self.effect.full_name(self.place, parameter)

    def parameters(self, model: mujoco.MjModel) -> tuple[Parameter, ...]:
        """Its parameters as they are called in ξ."""
        return tuple(replace(p, name=self.full_name(p.name)) for p in self.effect.parameters(model, self.place))


class Hypothesis:
    """A model with some effects: plain parameters first in ξ, then those of each effect.

    A fit's coordinates u are 0 at the prior's mean and there independent of one another with a standard deviation of 1,
    see :meth:`off`; an effect's parameters count the probes of their sizes instead, from the value that leaves the
    model as it was, and those of its shape the steps from one probe's to the next.

    Args:
        plain: the model and its plain parameters.
        candidates: the effects.
        motion: of the recordings, for the sizes of probes.

    Attributes:
        spec, model: with the structure of the effects, at neutral values.
        space: ξ.
        prior_std: of u, (d,).
        columns: of ξ that each candidate's parameters have.
    """

    def __init__(self, plain: Plain, candidates: Sequence[Candidate], motion: Motion):
        self.plain, self.candidates, self.motion = plain, tuple(candidates), motion
        self.spec = plain.spec.copy()
        for candidate in candidates:
            candidate.effect.add(self.spec, candidate.place)
        self.model = plain.compiled(self.spec)
        parameters = [self._where_it_acts(p) for p in plain.prior.space]
        self.columns: dict[Candidate, list[int]] = {}
        for candidate in candidates:
            added = [self._where_it_acts(p) for p in candidate.parameters(self.model)]
            self.columns[candidate] = list(range(len(parameters), len(parameters) + len(added)))
            parameters += added
        self.space = ParameterSpace(parameters)
        self.num_plain = len(plain.prior.space)
        reciprocal = {c.full_name(name) for c in candidates for name in c.effect.reciprocal}
        self._reciprocal = np.array([name in reciprocal for name in self.space.names])
        nominal = self._linear(self.space.nominal)
        self._centre, self._unit, self._least = nominal.copy(), np.ones(len(nominal)), np.ones(len(nominal))
        self._centre[: self.num_plain] = plain.prior.mean
        self._unit[: self.num_plain] = plain.prior.std
        self._prior_root = np.linalg.cholesky(plain.prior.correlation)
        for candidate, columns in self.columns.items():
            z = np.array([self._linear(self._probe(candidate, p)) for p in self._probes(candidate)])
            sizes = np.abs(z - nominal)[:, columns]
            size, smallest = sizes.max(axis=0), np.where(sizes > 0, sizes, np.inf).min(axis=0)
            self._unit[columns] = np.where(size > 0, size, 1.0)
            self._least[columns] = np.where(size > 0, smallest / self._unit[columns], 1.0)
            for i in set(columns) - set(self.amounts(candidate)):
                if len(tried := np.unique(z[:, i])) > 1:
                    self._unit[i] = np.median(np.diff(tried))
        self.prior_std = np.full(len(nominal), _FREE)
        self.prior_std[: self.num_plain] = 1.0
        bounds = [(self._linear(bound) - self._centre) / self._unit for bound in (self.space.low, self.space.high)]
        self.low, self.high = np.sort(bounds, axis=0)
        within = np.where(np.arange(len(nominal)) < self.num_plain, FARTHEST, np.inf)
        if self._is_correlated:  # their bounds are no bounds of u then; ξ is kept within them
            self.low[: self.num_plain], self.high[: self.num_plain] = -np.inf, np.inf
        self.low, self.high = np.maximum(self.low, -within), np.minimum(self.high, within)

    def __repr__(self) -> str:
        return " and ".join(map(str, self.candidates)) or "plain parameters alone"

    def _where_it_acts(self, parameter: Parameter) -> Parameter:
        """A parameter as it writes the model with the structure of the effects."""
        return on_bearing(self.model, on_all_parts(self.model, parameter))

    def xi(self, u: Array) -> Array:
        """Coordinates (n, d) -> physical values, within the bounds."""
        z = self._centre + self._unit * self.off(u)
        xi = self.space.from_unconstrained(z)
        xi[..., self._reciprocal] = 1 / np.maximum(z[..., self._reciprocal], 1 / self.space.high[self._reciprocal])
        return np.clip(xi, self.space.low, self.space.high)

    def coordinates(self, xi: Array) -> Array:
        """Physical values (..., d) -> u."""
        return self.at((self._linear(xi) - self._centre) / self._unit)

    def at(self, off: Array) -> Array:
        """The u (..., d) that is so far :meth:`off`."""
        if not self._is_correlated:
            return off
        plain = np.linalg.solve(self._prior_root, off[..., : self.num_plain, None])[..., 0]
        return np.concatenate([plain, off[..., self.num_plain :]], axis=-1)

    def off(self, u: Array) -> Array:
        """How far u (..., d) is from where it is 0, a plain parameter in standard deviations of its own prior.

        That is u itself, but where p(ξ) has correlations: u counts in directions that are independent in it.
        """
        if not self._is_correlated:
            return u
        return np.concatenate([u[..., : self.num_plain] @ self._prior_root.T, u[..., self.num_plain :]], axis=-1)

    @property
    def _is_correlated(self) -> bool:
        return bool(np.any(np.tril(self._prior_root, -1)))

    def _linear(self, xi: Array) -> Array:
        """Physical values (..., d) as laws take them: logarithms of log quantities, reciprocals of reciprocal ones."""
        z = self.space.to_unconstrained(xi)
        z[..., self._reciprocal] = 1 / xi[..., self._reciprocal]
        return z

    def probes(self, candidate: Candidate) -> Array:
        """The effect's probes (k, d) in u, the rest at 0."""
        nominal = self.coordinates(self.space.nominal)
        columns = self.columns[candidate]
        out = np.zeros((len(self._probes(candidate)), len(nominal)))
        for row, probe in zip(out, self._probes(candidate), strict=True):
            row[columns] = self.coordinates(self._probe(candidate, probe))[columns]
        return out

    def neutral(self) -> Array:
        """(d,): plain parameters at their prior's mean, no effect."""
        u = self.coordinates(self.space.nominal)
        u[: self.num_plain] = 0.0
        return u

    def is_itself(self, candidate: Candidate, u: Array) -> bool:
        """Whether a candidate's parameters at u (d,) are what its name means."""
        values = self.values(candidate, self.xi(u[None])[0])
        return candidate.effect.is_itself(self.plain.model, candidate.place, self.motion, values)

    def values(self, candidate: Candidate, xi: Array) -> dict[str, float]:
        """A candidate's parameters in ξ (d,), by the names that its effect gives them."""
        prefix = candidate.full_name("")
        return {self.space.names[i].removeprefix(prefix): float(xi[i]) for i in self.columns[candidate]}

    def grown(self, smaller: Hypothesis, u: Array) -> Array:
        """Coordinates (k, d) to go on from where a fit of another hypothesis ended, u.

        Args:
            smaller: has, for this one's last candidate, the one that that extends.
            u: its coordinates.
        """
        candidate, extended = self.candidates[-1], smaller.candidates[-1]
        found = smaller.values(extended, smaller.xi(u[None])[0])
        grown = candidate.effect.grown(self.plain.model, candidate.place, self.motion, found)
        starts = np.array([self.coordinates(self._probe(candidate, values)) for values in grown])
        shared = self.columns[candidate][0]
        starts[:, :shared] = u[:shared]
        return starts

    def usual(self, u: Array) -> Array:
        """Coordinates (d,) that mean the same, with each effect's values as people write them."""
        out, xi = u.copy(), self.xi(u[None])[0]
        for candidate, columns in self.columns.items():
            values = candidate.effect.usual(self.values(candidate, xi))
            named = {candidate.full_name(name): value for name, value in values.items()}
            out[columns] = self.coordinates(self.space.values(named))[columns]
        return out

    def amounts(self, candidate: Candidate) -> list[int]:
        """The columns of a candidate that say how much of the effect there is, not what shape it has."""
        shape = {candidate.full_name(name) for name in candidate.effect.shape}
        return [i for i in self.columns[candidate] if self.space.names[i] not in shape]

    def added(self, candidate: Candidate, smaller: Candidate) -> list[int]:
        """The columns of a candidate's parameters that the effect which it extends, at that place, has not."""
        names = [candidate.full_name(p.name) for p in smaller.effect.parameters(self.plain.model, smaller.place)]
        return [i for i in self.columns[candidate] if self.space.names[i] not in names]

    @property
    def products(self) -> list[tuple[int, int]]:
        """Columns of a shape in whose product with an amount a law is linear, each with that of the amount."""
        names = self.space.names
        return [
            (names.index(candidate.full_name(lever)), columns[0])
            for candidate, columns in self.columns.items()
            for lever in candidate.effect.levers
        ]

    def reach(self, u: Array) -> Array:
        """How far a difference of 1 goes along each coordinate at u (d,).

        Of an amount, no farther than there is of it, but as far as the smallest probe: plays of 10 um and of 1 mm are
        both looked for. Of a shape, less far the more there is of its effect: to move the rest position of a spring of
        50 probes by a hundredth of the motion changes half as much as a probe does.
        """
        reach, neutral = np.ones(len(u)), self.neutral()
        for candidate, columns in self.columns.items():
            amounts = self.amounts(candidate)
            shape = [i for i in columns if i not in amounts]
            off = np.abs(u - neutral)[amounts]
            reach[shape] = 1 / np.max(off, initial=1.0)
            reach[amounts] = np.clip(off, self._least[amounts], 1.0)
        return reach

    def without(self, candidate: Candidate, u: Array) -> Array:
        """Coordinates (d,) with those of one candidate left out."""
        return np.delete(u, self.columns[candidate])

    def is_built_as(self, other: Hypothesis) -> bool:
        """Whether its model, before parameters are written, is another's to the bit: at neutral it moves alike."""
        return digest(self.model) == digest(other.model)

    def simulator(self, windows: Windows, num_threads: int = 0) -> HypothesisSimulator:
        """A simulator of windows for values of ξ, on one thread per core by default."""
        return HypothesisSimulator(self, windows, num_threads)

    def __getstate__(self) -> dict[str, Any]:
        """For another process, where it can be simulated: without the spec, as :class:`Plain`."""
        return {name: value for name, value in self.__dict__.items() if name != "spec"}

    def _probes(self, candidate: Candidate) -> tuple[dict[str, float], ...]:
        return candidate.effect.probes(self.plain.model, candidate.place, self.motion)

    def _probe(self, candidate: Candidate, probe: dict[str, float]) -> Array:
        """ξ (d,) of a probe. Of a joint that hardly moved a size may be out of bounds, or none: no try."""
        values = {}
        for name, value in probe.items():
            parameter = self.space[candidate.full_name(name)]
            size = np.clip(value, parameter.low, parameter.high)
            values[parameter.name] = parameter.nominal if np.isnan(size) else float(size)
        return self.space.values(values)


class HypothesisSimulator:
    """Runs a hypothesis through windows; see :class:`~simopt_envs.measured.windows.WindowSimulator`."""

    def __init__(self, hypothesis: Hypothesis, windows: Windows, num_threads: int = 0):
        self._given, self._sources = windows, command_sources(hypothesis.model)
        channels = model_channels(hypothesis.model)  # a joint that an effect adds shifts those after it
        self.windows = replace(
            windows,
            channels=tuple(channels[name] for name in windows.names),
            commands=windows.commands[..., self._sources],
            past_commands=windows.past_commands[..., self._sources],
            starts=starts_of(hypothesis.model, windows.starts, hypothesis.plain.model),
        )
        self._hypothesis, self._nominal = hypothesis, hypothesis.space.nominal[None]
        given = hypothesis.plain.model
        self._loads = loads(given, windows) if given.nq < hypothesis.model.nq else {}
        self._model, self._period = hypothesis.model, float(windows.offsets[1])
        self._scalar = scalar_joints(hypothesis.model)
        self._velocity_measured = {channel.object for channel in self.windows.channels if channel.kind == "qvel"}
        self._lead = [i for i, p in enumerate(hypothesis.space) if p.name == INTEGRATION_LEAD]
        self._ahead = [c for c, channel in enumerate(self.windows.channels) if _is_position(hypothesis.model, channel)]
        self._columns = ColumnModel(hypothesis.space, windows.names)
        self._commands = CommandModel(hypothesis.space, actuator_names(given))
        self._timestep = float(hypothesis.model.opt.timestep)
        self._of_model = [i for i, p in enumerate(hypothesis.space) if not acts_on_columns(p)]
        space = ParameterSpace(hypothesis.space.parameters[i] for i in self._of_model)
        self._simulate = WindowSimulator(hypothesis.model, self.windows, space, num_threads)
        self._unseen = UnseenJoints(hypothesis.model, space, self.windows, given) if hypothesis.candidates else None

    def __call__(self, xi: Array | None = None, starts: States | None = None) -> Array:
        """Predicted columns (n, w, S, c) for ξ (n, d), by default the nominal one; NaN from where it diverged."""
        xi = self._nominal if xi is None else xi
        starts = self.windows.starts if starts is None else starts
        true = self._simulate(xi[:, self._of_model], self._meant(starts, xi), self._arriving(xi))
        lead = np.sum(xi[:, self._lead], axis=1)[:, None, None, None]
        true[..., self._ahead] = _without_lead(true[..., self._ahead], lead, self._period)
        return self._columns.shown(true, xi, self._period) if self._columns else true

    def _is_scalar(self, channel: Channel) -> bool:
        return f"joint:{self._model.joint(channel.object).name}" in self._scalar

    def _dof(self, channel: Channel) -> int:
        return int(self._model.jnt_dofadr[channel.object])

    def _arriving(self, xi: Array) -> Array:
        """Commands of the model's controls for each ξ and window, (n w, N, nu)."""
        given = self._given
        late = self._commands.arriving(given.past_commands, given.commands, xi, self._timestep)
        return late[..., self._sources].reshape(len(xi) * len(given), given.commands.shape[1], len(self._sources))

    def _meant(self, starts: States, xi: Array) -> States:
        """The states to start from, for each ξ, so that sensors show the measured starts."""
        repeated = starts.select(np.tile(np.arange(len(starts)), len(xi)))
        for c, channel in enumerate(self.windows.channels if self._columns else ()):
            if channel.kind not in ("qpos", "qvel") or not self._is_scalar(channel):
                continue
            dof = self._dof(channel)
            velocity, acceleration = starts.qvel[:, dof], starts.qacc[:, dof]
            if channel.kind == "qpos":
                position = starts.qpos[:, channel.index]
                repeated.qpos[:, channel.index] = self._columns.meant(c, xi, position, velocity, acceleration).ravel()
                if channel.object not in self._velocity_measured:
                    repeated.qvel[:, dof] = self._columns.meant_rate(c, xi, velocity, acceleration).ravel()
            else:
                repeated.qvel[:, dof] = self._columns.meant(c, xi, velocity, acceleration).ravel()
        if self._loads:
            self._deflect(repeated.qpos, xi)
        if self._unseen:
            self._unseen.place(repeated.qpos, starts, xi, self._of_model, self._columns)
        leads = np.repeat(np.sum(xi[:, self._lead], axis=1), len(starts))
        for qpos, qvel, lead in zip(repeated.qpos, repeated.qvel, leads, strict=True):
            mujoco.mj_integratePos(self._model, qpos, qvel, float(lead))
        return repeated

    def _deflect(self, qpos: Array, xi: Array) -> None:
        """Move the joints that effects add to where they rest under their loads, in place."""
        per_xi = qpos.reshape(len(xi), len(self._given), -1)
        for candidate in self._hypothesis.candidates:
            for at_xi, row in zip(per_xi, xi, strict=True):
                values = self._hypothesis.values(candidate, row)
                for name, position in candidate.effect.rest(candidate.place, values, self._loads).items():
                    at_xi[:, int(self._model.joint(name).qposadr[0])] += position


def _without_lead(ahead: Array, lead: Array, period: float) -> Array:
    """Positions x (n, w, S, c) of which these are x + lead x', to second order in the lead, (n, 1, 1, 1)."""
    rate = partial(np.gradient, axis=2, edge_order=2)
    return ahead - lead * rate(ahead - lead * rate(ahead, period), period)


def _is_position(model: mujoco.MjModel, channel: Channel) -> bool:
    """Whether a column follows from positions alone."""
    return channel.kind == "qpos" or depends_on_stage(model, channel, mujoco.mjtStage.mjSTAGE_POS)
