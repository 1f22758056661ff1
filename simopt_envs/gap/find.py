"""The gap workflow: from a model and recordings to what the model lacks."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np

from simopt_envs.distributions.gaussian import Gaussian
from simopt_envs.distributions.parameter_file import read_parameters
from simopt_envs.engine import Engine
from simopt_envs.gap.carriers import Residual
from simopt_envs.gap.describe import describe
from simopt_envs.gap.environments import HOME, model_of
from simopt_envs.gap.error import held_out_errors, moving_channels
from simopt_envs.gap.explanation import Explanation
from simopt_envs.gap.fit import Misfit
from simopt_envs.gap.hypothesis import Candidate, Hypothesis
from simopt_envs.gap.localise import localise
from simopt_envs.gap.motion import motion_of
from simopt_envs.gap.muted import muted
from simopt_envs.gap.plain import Plain, plain_parameters
from simopt_envs.gap.recordings import longer_windows, of_one_system, read_windows, under_way, whole_from_rest
from simopt_envs.gap.result import Gap, judge, named_effects, repair
from simopt_envs.gap.search import Progress, Search
from simopt_envs.gap.separate import separate
from simopt_envs.gap.sizes import of_best_length
from simopt_envs.gap.thresholds import LARGE
from simopt_envs.gap.timestep import finer, halved, promises, takes_all, takes_most, with_warning
from simopt_envs.gap.trial import Base, Data
from simopt_envs.gap.wild_starts import of_linear_starts, without_wild_columns, without_wild_starts
from simopt_envs.measured.channels import actuator_names, commanded_actuators
from simopt_envs.measured.mapping import LogMapping
from simopt_envs.measured.readers import load_recordings
from simopt_envs.measured.recording import Finding, Recording
from simopt_envs.measured.windows import Windows
from simopt_envs.physics.effects import EFFECTS, Effect, Motion, require_mujoco
from simopt_envs.physics.effects.readings import columns

_SEED = 0  # of the bootstrap


@dataclass(frozen=True, repr=False)
class Problem:
    """A model and recordings that may disagree.

    Attributes:
        given: the model.
        plain: it, with what a refit may move.
        data: windows of the recordings, but for those in which, by the model as given, the start decides.
        motion: of the recordings.
        longer: the recordings in longer windows, the longest first, if they are that long.
        keyframe: where joints without a column start.
        began: when it was read, by ``time.perf_counter``.
        in_short_windows: reads it so, where the data are whole recordings from rest; None where they are not.
    """

    given: mujoco.MjSpec
    plain: Plain
    data: Data
    motion: Motion
    longer: tuple[Data, ...]
    keyframe: str | None
    began: float
    in_short_windows: Callable[[], Problem] | None = None


def find_gap(
    model: str | Path | mujoco.MjSpec,
    recordings: Sequence[str | Path | Recording],
    *,
    plain: Gaussian | None = None,
    config: str | Path | None = None,
    mapping: LogMapping | str | Path | None = None,
    keyframe: str | None = None,
    effects: Sequence[Effect] = tuple(EFFECTS.values()),
    progress: Progress = lambda *_: None,
    engine: Engine | None = None,
    directory: str | Path | None = None,
) -> Gap:
    """Find where a model and recordings disagree, and which physical effect is missing.

    Args:
        model: an MJCF file, a spec, or the id of an environment, of this package or one that runs an MJCF file.
        recordings: of the real system: files or what was read from them.
        plain: p(ξ) of the plain parameters before the data: what a refit may move before anything is called
            missing. None for those of a good data sheet, see :func:`~simopt_envs.gap.plain.plain_parameters`, or of an
            environment of this package for the first p(ξ) of ``adapt``.
        config: a YAML file of it instead, see :func:`~simopt_envs.distributions.parameter_file.read_parameters`.
        mapping: names the columns of foreign logs.
        keyframe: where joints without a column start; by default the model's reference, of an environment of this
            package where its episodes begin.
        effects: the library to search.
        progress: is told of what is being done.
        engine: fits the candidates; threads of this process by default. The result does not depend on it.
        directory: keeps finished fits, from which a call with the same arguments goes on; None for none.

    Raises:
        FileNotFoundError: for a file that does not exist, or an environment that is not registered.
        FailedTasksError: naming the candidate, where a fit fails.
        ImportError: where MuJoCo is older than 4.0.
        ValueError: for a model that does not compile, recordings that do not fit it, audits that found errors,
            effects none of which can act in the model, recordings of which those held out show no motion, a directory
            that keeps fits of something else, or a config beside plain.
    """
    problem = read(model, recordings, plain, mapping, keyframe, config)
    return solve(problem, effects=effects, progress=progress, engine=engine, directory=directory)


def read(
    model: str | Path | mujoco.MjSpec,
    recordings: Sequence[str | Path | Recording],
    plain: Gaussian | None = None,
    mapping: LogMapping | str | Path | None = None,
    keyframe: str | None = None,
    config: str | Path | None = None,
) -> Problem:
    """What :func:`find_gap` is given, read and checked."""
    require_mujoco()
    began = time.perf_counter()
    if config is not None:
        if plain is not None:
            raise ValueError(f"give plain parameters as p(ξ) or by {config}, not both")
        plain = read_parameters(Path(config))
    if isinstance(model, str) and model in gym.registry:
        model, first = model_of(model)
        if first is not None:
            plain, keyframe = first if plain is None else plain, keyframe or HOME
    given = _spec(model)
    start = plain_parameters(given) if plain is None else Plain.of(given, plain)
    logs = [
        r for item in recordings for r in ([item] if isinstance(item, Recording) else load_recordings(item, mapping))
    ]
    logs = of_one_system(start.model, logs)
    whole = whole_from_rest(start.model, logs, keyframe)
    logs = under_way(logs)
    motion = motion_of(start.model, logs, keyframe)
    hypothesis = Hypothesis(start, (), motion)

    def in_short_windows() -> Problem:
        data = _without_wild_starts(hypothesis, read_windows(start.model, logs, keyframe))
        return Problem(given, start, data, motion, longer_windows(start.model, data, keyframe), keyframe, began)

    with muted():
        data = None if whole is None else _from_rest(hypothesis, whole)
        if data is None:
            return in_short_windows()
    return Problem(given, start, data, motion, (), keyframe, began, in_short_windows)


def refitted(problem: Problem, progress: Progress = lambda *_: None) -> Base:
    """The model with its plain parameters fitted, which a search begins with."""
    with muted():
        return Search(problem.plain, problem.data, problem.motion, (), progress).base()


def solve(
    problem: Problem,
    effects: Sequence[Effect] = tuple(EFFECTS.values()),
    progress: Progress = lambda *_: None,
    engine: Engine | None = None,
    directory: str | Path | None = None,
    null: Base | None = None,
) -> Gap:
    """What is missing, see :func:`find_gap`; ``null``, if it is there already, is what :func:`refitted` gives."""
    model, fitted = problem.plain.model, problem.data.fitted
    seen = tuple(c for effect in effects for c in _places(effect, model) if _shows(c, model, fitted))
    there = [c for c in seen if _is_there(c, problem.given)]
    seen = tuple(c for c in seen if c not in there)
    if not seen:
        raise ValueError("there is nothing to search: no effect can act in this model and show in its data")
    null = null or refitted(problem, progress)
    if problem.in_short_windows is not None and null.excess >= LARGE:
        with muted():
            short = problem.in_short_windows()
        if short.data.fitted.names == problem.data.fitted.names:  # they show as much
            problem, null = short, refitted(short, progress)

    held_out = problem.data.held_out
    moving_channels(held_out.names, held_out.channel_scale(), null.sensor_noise)  # raises where nothing moves

    def searched(problem: Problem, null: Base, directory: str | Path | None) -> tuple[Search, Explanation]:
        given = problem.plain, problem.data, problem.motion, seen, progress, engine, directory, problem.longer, null
        search = Search(*given)
        return search, search.run()

    with muted():
        problem, null = at_a_timestep_that_fits(problem, null, problem.data, progress)
        search, found = searched(problem, null, directory)
        if len(found.stages) > 1 and (len(found.effects) > 1 or judge(found) != "named"):
            half, _ = at_a_timestep_that_fits(problem, found.stages[1].base, found.data, progress)
            if half.plain is not problem.plain:
                problem, kept = half, None if directory is None else Path(directory) / "half_the_timestep"
                search, found = searched(problem, refitted(problem, progress), kept)
            elif half is not problem:
                found = _warned(found, half.data.warnings[-1])
        if there:
            message = f"the model has {', '.join(map(str, there))} already: not looked for again"
            found = _warned(found, Finding.warning("", "effects", message))
        if judge(found) == "partly":
            final = of_best_length(found.final, found.data, search.fit, progress, problem.keyframe)
            found = replace(found, final=final)
        return _gap(problem, found)


def at_a_timestep_that_fits(
    problem: Problem, base: Base, data: Data, progress: Progress = lambda *_: None
) -> tuple[Problem, Base]:
    """With half the model's timestep, if that leaves no more than noise; with a warning, if it takes most.

    Args:
        problem: at the timestep that it has.
        base: the refitted model, or one with an effect, there.
        data: that it was fitted to.
        progress: is told of a fit.
    """
    plain, effects = halved(problem.plain), base.hypothesis.candidates
    with muted():
        if not promises(base, Hypothesis(plain, effects, problem.motion), finer(data)):
            return problem, base
        found = Search(plain, finer(data), problem.motion, (), progress).base(effects, base.fit.u if effects else None)
    if not takes_most(base, found):
        return problem, base
    warned = partial(with_warning, timestep=float(plain.model.opt.timestep), null=base, half=found)
    if not takes_all(found):
        return replace(problem, data=warned(problem.data), longer=tuple(map(warned, problem.longer))), base
    longer = tuple(warned(finer(long)) for long in problem.longer)
    return replace(problem, plain=plain, data=warned(finer(problem.data)), longer=longer), found


def _without_wild_starts(hypothesis: Hypothesis, data: Data) -> Data:
    """Without those that the model as given tells."""
    as_given = hypothesis.neutral()
    data = without_wild_columns(hypothesis, as_given, data, Misfit(hypothesis, data.fitted).noise_floor(as_given))
    return without_wild_starts(hypothesis, as_given, data, Misfit(hypothesis, data.fitted).noise_floor(as_given))


def _from_rest(hypothesis: Hypothesis, data: Data) -> Data | None:
    """Recordings from rest, where what is not known of their starts does nothing but what is linear."""
    as_given, every = hypothesis.neutral(), [np.full(len(w), True) for w in (data.fitted, data.held_out)]
    return of_linear_starts(hypothesis, as_given, data, Misfit(hypothesis, data.fitted).noise_floor(as_given), every)


def _gap(problem: Problem, explanation: Explanation) -> Gap:
    """What was found; where the model errs, and on what that depends, is told from half seconds in any case."""
    verdict, short = judge(explanation), problem.data
    null, unforeseen = explanation.null, explanation.final.unforeseen
    explained = explanation if verdict != "unexplained" else replace(explanation, final=null, effects=())
    final = explained.final
    as_given = null.hypothesis.space.nominal
    fitted = [base.hypothesis.xi(base.fit.u[None])[0] for base in (null, final)]
    models = [(null.hypothesis, as_given), (null.hypothesis, fitted[0]), (final.hypothesis, fitted[1])]
    errors = held_out_errors(explanation.data.held_out, models, null.sensor_noise, np.random.default_rng(_SEED))
    spec, columns, diff = repair(explained, problem.given, fitted[1])
    left_by_null = _left_by(null, short.held_out).errors
    rows = localise(short.held_out, left_by_null, null.hypothesis.plain.model, short.parts)
    residuals = [_left_by(final, windows) for windows in (short.fitted, short.held_out)]
    left = describe(final.hypothesis, final.fit.u, residuals)
    named = separate(named_effects(explained), explained, problem.keyframe)
    seconds = time.perf_counter() - problem.began
    return Gap(verdict, named, errors, rows, left, explained, unforeseen, spec, columns, diff, seconds)


def _left_by(base: Base, windows: Windows) -> Residual:
    """What a fitted hypothesis leaves of some windows, in units of the noise of sensors and starts."""
    u, misfit = base.fit.u, Misfit(base.hypothesis, windows)
    noise = misfit.noise_at(u, base.sensor_noise)
    return Residual(windows, misfit.with_noise(noise).errors(u[None])[0], noise)


def _spec(model: str | Path | mujoco.MjSpec) -> mujoco.MjSpec:
    """The model, its actuators called as in recordings."""
    if isinstance(model, mujoco.MjSpec):
        spec = model.copy()
    elif Path(model).exists():
        spec = mujoco.MjSpec.from_file(str(model))
    else:
        raise FileNotFoundError(f"there is no model {model}: no such file, and no environment of that id")
    compiled = spec.compile()
    for i, name in zip(commanded_actuators(compiled), actuator_names(compiled), strict=True):
        spec.actuators[i].name = spec.actuators[i].name or name  # a dead band's part is called as its drive there
    return spec


def _places(effect: Effect, model: mujoco.MjModel) -> list[Candidate]:
    return [Candidate(effect, place) for place in effect.places(model)]


def _warned(found: Explanation, warning: Finding) -> Explanation:
    return replace(found, data=replace(found.data, warnings=(*found.data.warnings, warning)))


def _is_there(candidate: Candidate, spec: mujoco.MjSpec) -> bool:
    """Whether a model has been given an effect that adds elements, which would have names that are taken."""
    try:
        candidate.effect.add(spec.copy(), candidate.place)
    except ValueError as error:
        if "repeated name" in str(error):
            return True
        raise
    return False


def _shows(candidate: Candidate, model: mujoco.MjModel, windows: Windows) -> bool:
    """Whether a candidate that acts on what a sensor shows acts on a column that there is."""
    return not candidate.effect.of_reading or not set(columns(model, candidate.place)).isdisjoint(windows.names)
