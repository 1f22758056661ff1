"""A finished or interrupted run, as a report sees it: read from the run's folder, whatever process wrote it."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from importlib import metadata
from pathlib import Path
from typing import Any, Self

import numpy as np

from simopt_envs.adaptation.checkpoint import write_json
from simopt_envs.adaptation.records import unpack_trajectories
from simopt_envs.measured.trajectory import Trajectory
from simopt_envs.physics.parameters import Array

_DETAILS = "details.json"
_PACKAGES = ("simopt-envs", "mujoco", "gymnasium", "numpy", "scipy", "torch", "stable-baselines3")


@dataclass(frozen=True)
class Details:
    """What the loop does not know and a reader wants to.

    Attributes:
        command: what was typed to start the run.
        system: what was adapted, where it has a better name than ``env_id`` of the result.
        control_period: seconds between two observations; None where it is not known.
        truth: the hidden parameters that differ from nominal; None where nobody knows them, as on a robot.
        notes: sentences for the reader: warnings about the data, why there is no film.
        versions: of Python and the packages that computed the run.
        channel_units: units of observed channels, by their names, where they are known.
    """

    command: str = ""
    system: str = ""
    control_period: float | None = None
    truth: Mapping[str, float] | None = None
    notes: tuple[str, ...] = ()
    versions: Mapping[str, str] = field(default_factory=lambda: installed_versions())
    channel_units: Mapping[str, str] = field(default_factory=dict)

    def save(self, directory: Path) -> None:
        """Write them into the run's folder."""
        write_json(directory / _DETAILS, asdict(self))


@dataclass(frozen=True)
class Run:
    """What the folder of a run holds; k iterations, the first of them before any adaptation, and d parameters.

    Attributes:
        directory: the folder.
        result: ``result.json``.
        settings: ``run.json``, what identifies the run.
        details: ``details.json``, or empty ones.
    """

    directory: Path
    result: Mapping[str, Any]
    settings: Mapping[str, Any]
    details: Details

    @classmethod
    def load(cls, directory: str | Path) -> Self:
        """Read a folder.

        Raises:
            FileNotFoundError: if it holds no result.
            ValueError: if the result is not one of this package's, or has no iteration yet.
        """
        directory = Path(directory)
        path = directory / "result.json"
        if not path.exists():
            raise FileNotFoundError(f"{directory} holds no result.json: no iteration of a run has finished there")
        result = _read(path)
        if not result.get("iterations") or "parameter_names" not in result:
            raise ValueError(f"{path} is not the result of an adaptation: it has no iterations or parameter_names")
        details = _read(directory / _DETAILS) if (directory / _DETAILS).exists() else {"versions": {}}
        settings = _read(directory / "run.json") if (directory / "run.json").exists() else {}
        return cls(directory, result, settings, Details(**details))

    @property
    def iterations(self) -> list[dict[str, Any]]:
        """The entries of ``result.json``."""
        return self.result["iterations"]

    @property
    def names(self) -> list[str]:
        """Names of the parameters, d."""
        return self.result["parameter_names"]

    @property
    def units(self) -> list[str]:
        """Their units, d."""
        return self.result["units"]

    @property
    def labels(self) -> list[str]:
        """Their names with units, d."""
        return [f"{name} [{unit}]" if unit != "1" else name for name, unit in zip(self.names, self.units, strict=True)]

    @property
    def channels(self) -> list[str]:
        """Names of the observed channels."""
        return self.result["observation_names"]

    @cached_property
    def mean(self) -> Array:
        """(k, d), unconstrained."""
        return np.array([entry["mean"] for entry in self.iterations])

    @cached_property
    def covariance(self) -> Array:
        """(k, d, d), unconstrained."""
        return np.array([entry["covariance"] for entry in self.iterations])

    @property
    def std(self) -> Array:
        """(k, d), unconstrained."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    def physical(self, z: Array) -> Array:
        """Unconstrained coordinates (..., d) in physical units."""
        is_log = np.array([coordinate == "log" for coordinate in self.result["coordinates"]])
        return np.where(is_log, np.exp(np.where(is_log, z, 0.0)), z)

    @property
    def truth(self) -> Array | None:
        """The hidden values, (d,), or None where nobody knows them."""
        if self.details.truth is None:
            return None
        nominal = dict(zip(self.names, self.result["nominal"], strict=True))
        return np.array([self.details.truth.get(name, nominal[name]) for name in self.names])

    def real(self, iteration: int) -> list[Trajectory]:
        """What was measured in an iteration; nothing where the file is gone."""
        return self._trajectories(iteration, "real")

    def simulated(self, iteration: int) -> list[Trajectory]:
        """The episodes of the best ξ drawn in an iteration, one for each measured; nothing where the file is gone."""
        return self._trajectories(iteration, "measure")

    def _trajectories(self, iteration: int, phase: str) -> list[Trajectory]:
        path = self.directory / "checkpoints" / f"{iteration:03d}_{phase}" / "result.npz"
        if not path.exists():
            return []
        with np.load(path, allow_pickle=False) as arrays:
            return unpack_trajectories(arrays)


def installed_versions() -> dict[str, str]:
    """Versions of Python and of what computes a run, as far as it is installed."""
    versions = {"python": sys.version.split()[0]}
    for package in _PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return versions


def _read(path: Path) -> dict[str, Any]:
    """A JSON object; ValueError naming the file where it is none."""
    try:
        content = json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path} is not valid JSON: {error}") from None
    if not isinstance(content, dict):
        raise ValueError(f"{path} must hold a JSON object, got {type(content).__name__}")
    return content
