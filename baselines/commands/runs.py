"""Running the SimOpt loop from the command line: shown, resumable, reported."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import gymnasium as gym

from baselines.commands.progress import Display
from simopt_envs.adaptation import Iteration, SimOpt
from simopt_envs.report import Details, Run, write_report
from simopt_envs.report.film import STRIP, film_policies


def run_loop(
    loop: SimOpt,
    iterations: int,
    display: Display,
    details: Details,
    resume_with: str,
    *,
    resume: bool,
    film: str | None = None,
    enough: Callable[[Iteration], bool] = lambda iteration: False,
) -> Iteration:
    """Run the loop to its end, write the report of it, and return the last iteration.

    Args:
        loop: with a directory.
        iterations: at most so many after the first.
        display: shows it.
        details: for the report.
        resume_with: what to type to go on after Ctrl-C.
        resume: go on with the run in the directory.
        film: id of the environment to film the policy in, before and after, under ``details.truth``; None for no film.
        enough: ends the run early.

    Raises:
        KeyboardInterrupt: with a message that says how to go on.
    """
    steps = loop.run(iterations, resume=resume)  # raises before anything is written
    assert loop.directory is not None
    strip = loop.directory / STRIP
    details.save(loop.directory)
    with interruptible(resume_with):
        with display:
            for step in steps:
                if step.index == 0:
                    first = step
                display.iteration(step)
                if display.computed:
                    strip.unlink(missing_ok=True)  # it shows other policies
                if enough(step):
                    break
        if film is not None and not strip.exists():
            display.say("filming the policy on the target")
            details = _film(film, {"before adaptation": first, f"after iteration {step.index}": step}, loop, details)
    details.save(loop.directory)
    for line in (str(step.verdict), *details.notes):
        display.say(line)
    display.say(f"report: {write_report(loop.directory)}")
    return step


@contextmanager
def interruptible(resume_with: str) -> Iterator[None]:
    """Ctrl-C says what to type to go on."""
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"interrupted; go on with: {resume_with}") from None


def conclude(directory: Path, findings: Sequence[str], display: Display) -> None:
    """Add sentences to the report of a finished run, and print them."""
    details = Run.load(directory).details
    replace(details, notes=(*details.notes, *findings)).save(directory)
    write_report(directory)
    for finding in findings:
        display.say(finding)


def control_period(env_id: str) -> float | None:
    """Seconds between two actions, where the environment tells (``dt``)."""
    env = gym.make(env_id)
    try:
        period = getattr(env.unwrapped, "dt", None)
    finally:
        env.close()
    return None if period is None else float(period)


def _film(env_id: str, steps: Mapping[str, Iteration], loop: SimOpt, details: Details) -> Details:
    """Film the policies of some iterations under the hidden physics; where that cannot be done, note why."""
    assert loop.directory is not None
    policies = {label: step.policy for label, step in steps.items() if step.policy is not None}
    try:
        film_policies(env_id, policies, details.truth or {}, loop.directory, seed=loop.seed)
    except RuntimeError as error:
        return replace(details, notes=(*details.notes, f"No film: {error}"))
    return details
