"""``simopt-envs adapt``: the SimOpt loop against a hidden system or against recordings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from baselines.commands import inputs
from baselines.commands.parameter_file import read_parameters
from baselines.commands.progress import Display
from baselines.commands.runs import control_period, run_loop
from simopt_envs.adaptation import CEM, REPS, EnvSimulator, HiddenSystem, RecordedSystem, ReplaySimulator, SimOpt
from simopt_envs.adaptation.updates import Update
from simopt_envs.physics import ModelWriter
from simopt_envs.report import Details

MODEL_SUFFIXES = (".xml", ".mjcf", ".urdf")
_XI_PER_UPDATE = 200


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
    data: tuple[Path, ...] = ()
    """Model: recordings of the real system (CSV, Parquet, NPZ, MAT)."""
    parameters: Path | None = None
    """Model: YAML file that declares ξ."""
    mapping: Path | None = None
    """Model: YAML file that names the columns of foreign logs."""
    window: float = 0.5
    """Model: seconds of each stretch of a recording that is replayed."""
    iterations: int = 5
    """Iterations after the first training."""
    real_rollouts: int | None = None
    """Rollouts measured on the target per iteration; 3 by default. Model: windows, all by default."""
    rollouts: int | None = None
    """Simulated rollouts per update; 200 ξ for each real one by default."""
    updates: int = inputs.UPDATES
    """Updates of p(ξ) per iteration, on the same measured rollouts."""
    update: Literal["reps", "cem"] = "reps"
    """How p(ξ) is updated."""
    epsilon: float = 1.0
    """Bound of the KL divergence of an update, in nats."""
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
        if self.target is None:
            raise ValueError(f"{self.system} needs --target target.json, the hidden system to adapt to")
        target = inputs.Target.read(self.target)
        simulator = EnvSimulator(self.system)
        display = Display()
        real_rollouts = 3 if self.real_rollouts is None else self.real_rollouts
        loop = SimOpt(
            simulator,
            inputs.distribution(self.system, simulator.parameters, self.vary),
            inputs.make_trainer(self.trainer, display.training),
            HiddenSystem(self.system, target.parameters, target.noise, target.dropout),
            update=self._update(),
            simulated_rollouts=_XI_PER_UPDATE * real_rollouts if self.rollouts is None else self.rollouts,
            real_rollouts=real_rollouts,
            updates_per_iteration=self.updates,
            evaluation_episodes=self.evaluation_episodes,
            seed=self.seed,
            directory=self.out,
            on_event=display.event,
        )
        run_loop(
            loop,
            self.iterations,
            display,
            Details(typed, self.system, control_period(self.system), target.parameters),
            resume_with(typed),
            resume=self.resume,
            film=self.system,
        )

    def _adapt_model(self, typed: str) -> None:
        from simopt_envs.adaptation import window_trajectories
        from simopt_envs.measured import audited, cut_windows, load_recordings
        from simopt_envs.measured.logs import load_model

        self._refuse("an environment", "the model", target=self.target, vary=self.vary)
        if not self.data or self.parameters is None:
            raise ValueError(f"{self.system} needs --data LOG ... and --parameters xi.yaml to be adapted to recordings")
        model = load_model(self.system)
        distribution = read_parameters(self.parameters)
        ModelWriter(model, distribution.space)  # raises for places that the model does not have
        logs = [load_recordings(path, self.mapping) for path in inputs.existing(self.data)]
        recordings = [audited(recording, model) for log in logs for recording in log]
        windows = cut_windows(model, recordings, self.window)
        simulator = ReplaySimulator(model, distribution.space, windows)
        trajectories = window_trajectories(windows)
        real_rollouts = len(trajectories) if self.real_rollouts is None else self.real_rollouts
        display = Display()
        loop = SimOpt(
            simulator,
            distribution,
            None,
            RecordedSystem(trajectories),
            update=self._update(),
            simulated_rollouts=_XI_PER_UPDATE * real_rollouts if self.rollouts is None else self.rollouts,
            real_rollouts=real_rollouts,
            updates_per_iteration=self.updates,
            seed=self.seed,
            directory=self.out,
            on_event=display.event,
        )
        warnings = tuple(dict.fromkeys(str(finding) for recording in recordings for finding in recording.warnings))
        details = Details(typed, Path(self.system).name, float(windows.offsets[1]), notes=warnings)
        run_loop(loop, self.iterations, display, details, resume_with(typed), resume=self.resume)

    def _update(self) -> Update:
        return REPS(epsilon=self.epsilon) if self.update == "reps" else CEM(epsilon=self.epsilon)

    def _refuse(self, owner: str, given: str, **options: object) -> None:
        """ValueError for an option that belongs to the other kind of system."""
        for name, value in options.items():
            if value:
                raise ValueError(f"--{name} belongs to {owner} form of adapt; {self.system} is taken for {given}")


def resume_with(typed: str) -> str:
    """The command line that goes on with what a command line began."""
    return typed if "--resume" in typed.split() else f"{typed} --resume"
