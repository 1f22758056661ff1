"""Reading and checking what a user gives to the commands, before any work starts."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

from simopt_envs.adaptation.first import FIRST_STD, first_distribution
from simopt_envs.adaptation.protocols import Trainer
from simopt_envs.distributions import Gaussian
from simopt_envs.distributions.parameter_file import is_number, read_text
from simopt_envs.physics import ParameterSpace
from simopt_envs.physics.parameters import unknown_name

UPDATES = 20
"""Updates of p(ξ) per iteration: at most 1.4 standard deviations each, they cross several centimetres of cabinet, or
the 15 standard deviations between a swing-peg and one with a longer rope and a weaker arm."""


@dataclass(frozen=True)
class Target:
    """A hidden system, as ``target.json`` describes it.

    Attributes:
        parameters: name -> physical value of what differs from nominal.
        noise, dropout: of the sensors, a number for all channels or by name or pattern; see ``HiddenSystem``.
    """

    parameters: Mapping[str, float]
    noise: float | Mapping[str, float] = 0.0
    dropout: float | Mapping[str, float] = 0.0

    @classmethod
    def read(cls, path: Path) -> Target:
        """Read ``target.json``.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: for a key that does not exist, with the nearest that does, or a value that is not a number.
        """
        try:
            content = json.loads(read_text(path, "target file"))
        except ValueError as error:
            raise ValueError(f"{path} is not valid JSON: {error}") from None
        if not isinstance(content, dict):
            raise ValueError(f'{path} must hold an object such as {{"parameters": {{...}}}}')
        known = [field.name for field in fields(cls)]
        for key, value in content.items():
            if key not in known:
                raise ValueError(f"{path}: {unknown_name('key', key, known)}")
            if key == "parameters" and not isinstance(value, dict):
                raise ValueError(f"{path}: 'parameters' must be an object of name to number, got {value!r}")
            for name, number in value.items() if isinstance(value, dict) else [("", value)]:
                if not is_number(number):
                    where = f"{key}[{name!r}]" if name else repr(key)
                    raise ValueError(f"{path}: {where} must be a number, got {number!r}")
        if "parameters" not in content:
            raise ValueError(f"{path} lacks the key 'parameters'")
        return cls(**content)


def distribution(env_id: str, space: ParameterSpace, vary: Sequence[str]) -> Gaussian:
    """The first p(ξ) around nominal.

    Args:
        env_id: whose defaults apply where ``vary`` is empty.
        space: the parameters that there are.
        vary: texts "NAME=STD"; NAME may be a pattern such as ``joint_gain_*``.

    Raises:
        ValueError: for a text of another form, a name that matches nothing, or no default for this environment.
    """
    if not vary and env_id not in FIRST_STD:
        raise ValueError(f"say what varies with --vary NAME=STD ...; {env_id} has {', '.join(space.names)}")
    std = dict(map(_name_and_std, vary)) if vary else FIRST_STD[env_id]
    try:
        return first_distribution(space, std)
    except ValueError as error:
        raise ValueError(f"--vary: {error}") from None


def make_trainer(name: Literal["torch", "sb3"], on_progress: Any = None) -> Trainer[Any]:
    """The PPO of a name; ImportError saying what to install."""
    if name == "sb3":
        from baselines.ppo_sb3 import SB3

        return SB3()
    from baselines.ppo_torch import TorchPPO

    return TorchPPO(on_progress=on_progress)


def require_free(directory: Path, resume: bool | None = None) -> None:
    """FileExistsError if an output folder holds anything that is not a run to resume; None where none can be."""
    if directory.exists() and not directory.is_dir():
        raise FileExistsError(f"{directory} is a file; --out names a folder")
    held = sorted(p.name for p in directory.iterdir() if not p.name.startswith(".")) if directory.exists() else []
    if held and not (resume and "run.json" in held):
        listed = ", ".join(held[:4]) + (" ..." if len(held) > 4 else "")
        advice = "choose another folder" + (", or add --resume to go on with its run" if resume is False else "")
        raise FileExistsError(f"{directory} is not empty ({listed}); {advice}")


def existing(paths: Iterable[Path]) -> list[Path]:
    """The paths; FileNotFoundError naming the first that does not exist."""
    found = list(paths)
    for path in found:
        if not path.exists():
            raise FileNotFoundError(f"there is no file {path}")
    return found


def _name_and_std(text: str) -> tuple[str, float]:
    name, _, std = text.partition("=")
    try:
        return name, float(std)
    except ValueError:
        raise ValueError(f"--vary takes NAME=STD, such as cabinet_x=0.02, got {text!r}") from None
