"""``simopt-envs adapt``: the SimOpt loop against a hidden system or against recordings."""

from __future__ import annotations

import json
import shlex
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import tyro

from baselines.commands import inputs
from baselines.commands.engines import EngineOptions
from baselines.commands.gap import explain, told, ways_on
from baselines.commands.progress import Display
from baselines.commands.recordings import HeldOut, read_split
from baselines.commands.runs import conclude, control_period, interruptible, run_loop
from baselines.logged_system import LoggedSystem
from simopt_envs.adaptation import CEM, REPS, EnvSimulator, Event, HiddenSystem, RecordedSystem, ReplaySimulator, SimOpt
from simopt_envs.adaptation.checkpoint import write_json
from simopt_envs.adaptation.fitting import CMAES, LeastSquares, WindowMisfit, untold_combinations
from simopt_envs.adaptation.updates import Update
from simopt_envs.distributions import Gaussian
from simopt_envs.distributions.parameter_file import read_parameters
from simopt_envs.engine import ThreadEngine
from simopt_envs.physics import ModelWriter
from simopt_envs.physics.effects import require_mujoco
from simopt_envs.report import Details, Run

MODEL_SUFFIXES = (".xml", ".mjcf", ".urdf")
_XI_PER_UPDATE = 200
_FITS = ("cmaes", "least-squares")
_GAP = "gap"
_MOST_LOGS = 12  # the latest, that are looked at: the search takes its time


@dataclass(frozen=True)
class Adapt:
    """Adapt p(ξ) to a real system: a hidden one that a target file describes, or recordings of one.

    "adapt SimOpt/Drawer-v0 --target target.json --out DIR" trains a policy, runs it on the hidden system, and so on.

    "adapt arm.xml --data run_1.csv run_2.csv --parameters xi.yaml --out DIR" replays the recorded commands.
    """

    system: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="ENV_ID|MODEL.xml")]
    """Id of a registered environment, or an MJCF or URDF file."""
    out: Path
    """Folder for result.json, checkpoints, plots and report.html."""
    target: Path | None = None
    """Environment: JSON file {"parameters": {name: value}, "noise": ..., "dropout": ...} of the hidden system."""
    trainer: Literal["torch", "sb3"] = "torch"
    """Environment: the PPO that trains the policy."""
    vary: tuple[str, ...] = ()
    """Environment: NAME=STD ..., what varies around nominal at first; relative for scale-like parameters, else in the
    parameter's unit. NAME may be a pattern (joint_gain_*). The drawer has defaults."""
    evaluation_episodes: int = 100
    """Environment: episodes that count successes on the target; they are never used to adapt."""
    explain: bool = True
    """Environment of this package: log the rollouts measured on the target (OUT/recordings) and, where the adapted p(ξ)
    leaves more of them than noise, look for the missing effect: gap.json, report.html and repaired model in OUT/gap."""
    data: tuple[Path, ...] = ()
    """Model: recordings of the real system (CSV, Parquet, NPZ, MAT, or minari:ID)."""
    parameters: Path | None = None
    """Model: YAML file that declares ξ."""
    mapping: Path | None = None
    """Model: YAML file that names the columns of foreign logs."""
    window: float = 0.5
    """Model: seconds of each stretch of a recording that is replayed."""
    keyframe: str | None = None
    """Model: where joints start that no column tells of; its reference by default."""
    held_out: tuple[Path, ...] = ()
    """Model: recordings that no fit sees, to say what the adapted model is worth."""
    held_out_fraction: float = 0.25
    """Model: without --held-out, the last part of each recording that no fit sees; 0 for none."""
    iterations: int = 5
    """Iterations after the first training. The fits cmaes and least-squares need one, and make no more."""
    real_rollouts: int | None = None
    """Rollouts measured on the target per iteration; 3 by default. Model: windows, all by default."""
    rollouts: int | None = None
    """Simulated rollouts per update; 200 ξ for each real one by default."""
    updates: int = inputs.UPDATES
    """Updates of p(ξ) per iteration, on the same measured rollouts."""
    update: Literal["reps", "cem", "cmaes", "least-squares"] = "reps"
    """How p(ξ) is updated. Model: also by a fit to all windows, with a Laplace covariance."""
    epsilon: float = 1.0
    """Bound of the KL divergence of an update, in nats."""
    where: Annotated[EngineOptions, tyro.conf.arg(name="")] = field(default_factory=EngineOptions)
    """What simulates the rollouts of an update."""
    seed: int = 0
    """Seed of everything random."""
    resume: bool = False
    """Go on with the run in the folder, if there is one."""

    def run(self, typed: str) -> None:
        """Adapt and report; ``typed`` is the command line."""
        inputs.require_free(self.out, self.resume)
        if Path(self.system).suffix in MODEL_SUFFIXES:
            self._adapt_model(typed)
        else:
            self._adapt_environment(typed)

    def _adapt_environment(self, typed: str) -> None:
        self._refuse("the model", "an environment", data=self.data, parameters=self.parameters, mapping=self.mapping)
        self._refuse("the model", "an environment", keyframe=self.keyframe, **{"held-out": self.held_out})
        if self.update in _FITS:
            raise ValueError(f"--update {self.update} fits recordings; for an environment take reps or cem")
        if self.target is None:
            raise ValueError(f"{self.system} needs --target target.json, the hidden system to adapt to")
        target = inputs.Target.read(self.target)
        display = Display()
        simulator = EnvSimulator(self.system, engine=self.where.make(display.tasks))
        real_rollouts = 3 if self.real_rollouts is None else self.real_rollouts
        prior = inputs.distribution(self.system, simulator.parameters, self.vary)
        robot = self._robot(target, prior, display)

        def note(event: Event) -> None:
            if event.status == "started":  # so that a gap found in fewer iterations is none of this run's
                shutil.rmtree(self.out / _GAP, ignore_errors=True)
            display.event(event)

        loop = SimOpt(
            simulator,
            prior,
            inputs.make_trainer(self.trainer, display.training),
            robot,
            update=self._update(),
            simulated_rollouts=_XI_PER_UPDATE * real_rollouts if self.rollouts is None else self.rollouts,
            real_rollouts=real_rollouts,
            updates_per_iteration=self.updates,
            evaluation_episodes=self.evaluation_episodes,
            seed=self.seed,
            directory=self.out,
            on_event=note,
        )
        last = run_loop(
            loop,
            self.iterations,
            display,
            Details(typed, self.system, control_period(self.system), target.parameters),
            resume_with(typed),
            resume=self.resume,
            film=self.system,
        )
        if isinstance(robot, LoggedSystem):
            with interruptible(resume_with(typed)):
                self._explain(robot, [last.distribution, prior], display)

    def _robot(self, target: inputs.Target, prior: Gaussian, display: Display) -> HiddenSystem | LoggedSystem:
        """The hidden system, with logs of its rollouts where the gap workflow can take them."""
        hidden = target.parameters, target.noise, target.dropout
        system = HiddenSystem(self.system, *hidden)
        if self.explain:
            try:
                require_mujoco()
                from simopt_envs.gap.environments import environment

                environment(self.system, prior)
            except (ImportError, ValueError) as reason:
                display.say(f"Nothing will look for what p(ξ) cannot explain: {reason}")
            else:
                return LoggedSystem(self.system, self.out / "recordings", *hidden)
        return system

    def _explain(self, robot: LoggedSystem, distributions: Sequence[Gaussian], display: Display) -> None:
        """Say whether a p(ξ) explains the rollouts of a finished run, and what is missing where none does."""
        run, folder = Run.load(self.out), self.out / _GAP
        measured = [trajectory for k in range(len(run.iterations)) for trajectory in run.real(k)]
        logs = [log for log in map(robot.log, measured) if log.exists()][-_MOST_LOGS:]
        ways: list[str] = []
        if len(logs) < 2:
            finding = f"To see what p(ξ) cannot explain takes two logged rollouts at least, here {len(logs)}."
        else:
            display.say("looking for what p(ξ) cannot explain")
            try:
                engine = self.where.make(local=ThreadEngine)
                explained = explain(self.system, distributions, logs, folder, display.console, engine)
            except ValueError as error:
                finding = f"What p(ξ) cannot explain could not be looked for: {error}"
            else:
                more = "p(ξ) leaves more of the measured rollouts than noise; the gap workflow:"
                finding = explained or f"{more} {told(folder)}"
                ways = [] if explained else ways_on(self.system, folder)
        conclude(self.out, [finding], display)
        for line in ways:
            display.say(line)

    def _adapt_model(self, typed: str) -> None:
        from simopt_envs.adaptation import window_trajectories
        from simopt_envs.measured import cut_windows
        from simopt_envs.measured.logs import load_model
        from simopt_envs.measured.recording import warnings_of

        self._refuse("an environment", "the model", target=self.target, vary=self.vary)
        if not self.data or self.parameters is None:
            raise ValueError(f"{self.system} needs --data LOG ... and --parameters xi.yaml to be adapted to recordings")
        model = load_model(self.system)
        prior = read_parameters(self.parameters)
        ModelWriter(model, prior.space)  # raises for places that the model does not have
        recordings, held_out = read_split(
            model, self.data, self.held_out, self.held_out_fraction, self.window, self.mapping
        )
        cut = partial(cut_windows, model, seconds=self.window, keyframe=self.keyframe)
        windows, held_out_windows = cut(recordings), cut(held_out) if held_out else None
        misfit = WindowMisfit(model, windows, prior)
        trajectories = window_trajectories(windows)
        is_fit = self.update in _FITS
        real_rollouts = len(trajectories) if self.real_rollouts is None else self.real_rollouts
        display = Display()
        loop = SimOpt(
            ReplaySimulator(model, prior.space, windows, self.where.make(display.tasks)),
            prior,
            None,
            RecordedSystem(trajectories),
            update=self._fit(misfit) if is_fit else self._update(),
            simulated_rollouts=_XI_PER_UPDATE * real_rollouts if self.rollouts is None else self.rollouts,
            real_rollouts=real_rollouts,
            updates_per_iteration=1 if is_fit else self.updates,
            seed=self.seed,
            directory=self.out,
            on_event=display.event,
        )
        warnings = tuple(map(str, warnings_of([*recordings, *held_out])))
        units = {channel.name: channel.unit for channel in windows.channels}
        details = Details(typed, Path(self.system).name, float(windows.offsets[1]), notes=warnings, channel_units=units)
        iterations = min(self.iterations, 1) if is_fit else self.iterations
        last = run_loop(loop, iterations, display, details, resume_with(typed), resume=self.resume)
        posterior = misfit.laplace(misfit.coordinates(last.distribution.mean))
        findings = untold_combinations(prior, posterior)
        result = json.loads((self.out / "result.json").read_text()) | {"untold": findings}
        if held_out_windows is not None:
            errors = HeldOut.of(model, held_out_windows, prior, last.distribution)
            findings = [str(errors), *findings]
            result["held_out"] = errors.to_dict()
        else:
            findings = ["Nothing was held out, so nothing here shows what the model is worth on new data.", *findings]
        write_json(self.out / "result.json", result)
        conclude(self.out, findings, display)
        options = {"--mapping": self.mapping, "--keyframe": self.keyframe, "--out": self.out / _GAP}
        given = [str(word) for option in options.items() if option[1] is not None for word in option]
        ask = shlex.join(["simopt-envs", "gap", self.system, "--data", *map(str, self.data), *given])
        display.say(f"what no ξ explains: {ask}")

    def _update(self) -> Update:
        return REPS(epsilon=self.epsilon) if self.update == "reps" else CEM(epsilon=self.epsilon)

    def _fit(self, misfit: WindowMisfit) -> Update:
        return CMAES(misfit) if self.update == "cmaes" else LeastSquares(misfit)

    def _refuse(self, owner: str, given: str, **options: object) -> None:
        """ValueError for an option that belongs to the other kind of system."""
        for name, value in options.items():
            if value:
                raise ValueError(f"--{name} belongs to {owner} form of adapt; {self.system} is taken for {given}")


def resume_with(typed: str) -> str:
    """The command line that goes on with what a command line began."""
    return typed if "--resume" in typed.split() else f"{typed} --resume"
