"""The model with what it lacked: an MJCF that plain MuJoCo loads, and the difference to the model as given."""

from __future__ import annotations

import difflib
import json
import os
from collections.abc import Collection
from pathlib import Path

import mujoco
import numpy as np

from simopt_envs.gap.hypothesis import Hypothesis
from simopt_envs.physics.columns import CommandModel, acts_on_columns
from simopt_envs.physics.effects.actuators import DEADBAND, actuators
from simopt_envs.physics.effects.effect import object_name
from simopt_envs.physics.parameters import Array, ParameterSpace
from simopt_envs.physics.spec_writer import write_spec

COLUMNS = "columns.yaml"
"""File of what MJCF cannot hold, beside the repaired model."""
_LINEAR = 1  # interpolation of MuJoCo's delays
_DIGITS = 6  # that MuJoCo writes
_CONTEXT = 1  # lines around a change


def repaired(hypothesis: Hypothesis, xi: Array) -> mujoco.MjSpec:
    """The hypothesis' spec with values of its ξ (d,), those of sensors' columns apart."""
    spec = hypothesis.spec.copy()
    of_model = [i for i, parameter in enumerate(hypothesis.space) if not acts_on_columns(parameter)]
    space = ParameterSpace(hypothesis.space.parameters[i] for i in of_model)
    write_spec(spec, spec.compile(), space, xi[of_model])
    _write_delays(spec, hypothesis, xi)
    return spec


def _write_delays(spec: mujoco.MjSpec, hypothesis: Hypothesis, xi: Array) -> None:
    """Put the delays of commands into a spec, where they are nearer to one timestep than to none.

    MuJoCo stores a command after it was used, so that its delays are one timestep long at least. A lag is the filter of
    a drive that has none; where it has one, it becomes dead time.
    """
    timestep = float(spec.option.timestep)
    drives = [object_name(place) for place in actuators(hypothesis.plain.model)]
    late = CommandModel(hypothesis.space, drives)
    for drive, total, lag in zip(drives, late.delays(xi[None])[0], late.lags(xi[None])[0], strict=True):
        for part in (drive, drive + DEADBAND):
            actuator, delay = spec.actuator(part), total
            if actuator is None:
                continue
            if lag > timestep / 2 and actuator.dyntype == mujoco.mjtDyn.mjDYN_NONE:
                actuator.dyntype, actuator.actearly = mujoco.mjtDyn.mjDYN_FILTEREXACT, True
                actuator.dynprm[0] = lag
                delay -= timestep / np.expm1(timestep / lag)  # by which the filter delays what is held in each step
            if delay > timestep / 2:
                actuator.delay += max(float(delay), timestep)
                actuator.nsample = max(actuator.nsample, int(np.ceil(actuator.delay / timestep)) + 1)
                actuator.interp = max(actuator.interp, _LINEAR)


def to_xml_in(spec: mujoco.MjSpec, folder: Path) -> str:
    """MJCF of a spec to be saved in a folder: from there it finds meshes and textures where they are."""
    files = [asset.file for asset in (*spec.meshes, *spec.hfields, *spec.skins, *spec.textures)]
    if any((*files, *(side for texture in spec.textures for side in texture.cubefiles))):
        spec = spec.copy()
        for kind in ("meshdir", "texturedir"):
            there = Path(spec.modelfiledir, getattr(spec.compiler, kind)).absolute()
            setattr(spec.compiler, kind, os.path.relpath(there, folder.absolute()))
        spec.modelfiledir = str(folder.absolute())
    return str(spec.to_xml())


def observation_model(hypothesis: Hypothesis, xi: Array, columns: Collection[str]) -> str:
    """What MJCF cannot hold of ξ (d,): the mapping by which recordings' columns are read as the model means them.

    Empty for nothing, else the YAML of a :class:`~simopt_envs.measured.mapping.LogMapping` with the key ``shown``.
    """
    shown: dict[str, dict[str, str]] = {}
    for parameter, value in zip(hypothesis.space, xi, strict=True):
        for write in (w for w in parameter.writes if w.field.startswith("column.") and w.object in columns):
            shown.setdefault(str(write.object), {})[write.field.removeprefix("column.")] = f"{value:#.{_DIGITS}g}"
    lines = [
        f"  {json.dumps(column)}: {{{', '.join(f'{key}: {value}' for key, value in numbers.items())}}}"
        for column, numbers in shown.items()
    ]
    return "\n".join(["shown:", *lines, ""]) if lines else ""


def difference(given: mujoco.MjSpec, spec: mujoco.MjSpec, columns: str) -> str:
    """A unified diff of two specs as MuJoCo writes them, with the observation model, if any, after it."""
    before, after = (s.to_xml().splitlines() for s in (given, spec))
    lines = list(difflib.unified_diff(before, after, "model.xml", "model.repaired.xml", n=_CONTEXT, lineterm=""))
    lines += difflib.unified_diff([], columns.splitlines(), "/dev/null", COLUMNS, lineterm="")
    return "\n".join(lines) + "\n"
