"""The command line ``simopt-envs``.

What a user got wrong is told in one line, with exit code 2, before any work starts. Python's development mode
(``python -X dev -m baselines.cli ...``) shows where it was raised.
"""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Sequence

import gymnasium as gym

_PROGRAM = "simopt-envs"
_EXTRAS = {
    "tyro": "report",
    "rich": "report",
    "matplotlib": "report",
    "jinja2": "report",
    "imageio": "report",
    "torch": "torch",
    "stable_baselines3": "sb3",
    "yaml": "measured",
    "pyarrow": "measured",
}
"""Optional package -> the extra that installs it."""


def main(argv: Sequence[str] | None = None) -> None:
    """Run a command; ``argv`` is what follows the program's name, from the shell by default.

    Ctrl-C there ends the process at once: threads may still simulate, and must not while Python takes itself down.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        _run(arguments)
    except KeyboardInterrupt as interrupt:
        print(f"\n{_PROGRAM}: {interrupt.args[0] if interrupt.args else 'interrupted'}", file=sys.stderr)
        if argv is None:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(130)
        sys.exit(130)
    except (ValueError, TypeError, OSError, ImportError, RuntimeError, gym.error.Error) as error:
        if sys.flags.dev_mode:
            raise
        print(f"{_PROGRAM}: error: {_one_line(error)}", file=sys.stderr)
        sys.exit(2)


def _run(arguments: list[str]) -> None:
    import tyro

    from baselines.commands.adapt import Adapt
    from baselines.commands.demo import Demo
    from baselines.commands.gap import Gap
    from baselines.commands.logs import Inspect, Replay, Report

    command = tyro.cli(
        Adapt | Demo | Gap | Inspect | Replay | Report,  # the subcommands
        prog=_PROGRAM,
        description="Simulations with randomizable physics, adapted to real systems by SimOpt.",
        args=arguments,
    )
    command.run(shlex.join([_PROGRAM, *arguments]))


def _one_line(error: Exception) -> str:
    if isinstance(error, ModuleNotFoundError) and error.name:
        package = error.name.partition(".")[0]
        if package in _EXTRAS:
            return f'{package} is not installed: pip install "simopt-envs[{_EXTRAS[package]}]"'
    return " ".join(str(error).split()) or type(error).__name__


if __name__ == "__main__":
    main()
