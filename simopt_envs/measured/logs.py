"""Inspecting and replaying log files: what the commands ``simopt-envs inspect`` and ``replay`` do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from simopt_envs.measured.audit import audit, audited
from simopt_envs.measured.channels import model_channels
from simopt_envs.measured.mapping import LogMapping
from simopt_envs.measured.plots import plot_error, plot_recording, plot_replay
from simopt_envs.measured.readers import load_recordings
from simopt_envs.measured.recording import Finding, Recording
from simopt_envs.measured.replay import Replay, replay


@dataclass(frozen=True)
class Inspection:
    """What there is in a log, and what is wrong with it.

    Attributes:
        recordings: its recordings; none if it cannot be read.
        findings: name of the recording -> what the audit found; under the file's name why it cannot be read.
    """

    recordings: tuple[Recording, ...]
    findings: dict[str, tuple[Finding, ...]]

    @property
    def ok(self) -> bool:
        """Whether there is no error."""
        return not any(finding.severity == "error" for found in self.findings.values() for finding in found)

    def __str__(self) -> str:
        rows = []
        for recording in self.recordings:
            rate = f"{1 / recording.period:.4g} Hz" if recording.duration > 0 else "no rate"
            rows.append(f"{recording.name}: {len(recording)} samples, {recording.duration:.4g} s, {rate}")
            for name, values in recording.columns.items():
                known = values[np.isfinite(values)]
                span = f"{known.min():12.5g} to {known.max():12.5g}" if len(known) else "no value"
                rows.append(f"  {name:<28} {span}")
            rows += [f"  {finding}" for finding in self.findings[recording.name]] or ["  nothing found"]
        named = {recording.name for recording in self.recordings}
        rows += [f"{name}: {f}" for name, found in self.findings.items() if name not in named for f in found]
        return "\n".join(rows)


def load_model(path: str | Path) -> mujoco.MjModel:
    """Compile an MJCF or URDF file; FileNotFoundError or ValueError, naming it, where that fails."""
    if not Path(path).exists():
        raise FileNotFoundError(f"there is no model {path}")
    return mujoco.MjModel.from_xml_path(str(path))


def inspect_log(
    log: str | Path,
    model: str | Path | None = None,
    mapping: LogMapping | str | Path | None = None,
    out: str | Path | None = None,
) -> Inspection:
    """Audit a log, and plot its columns into a folder.

    A log that cannot be read is an error among the findings, not an exception.

    Args:
        log: a file or data set, see :func:`load_recordings`.
        model: an MJCF file to check it against.
        mapping: names the columns of a foreign log.
        out: folder for one plot per recording and ``findings.txt``; None for none.

    Raises:
        FileNotFoundError, ValueError: for the model or the mapping, which the caller gave.
    """
    compiled = None if model is None else load_model(model)
    mapping = LogMapping.from_yaml(mapping) if isinstance(mapping, str | Path) else mapping
    try:
        recordings = tuple(load_recordings(log, mapping))
    except (ValueError, OSError) as error:
        unreadable = Finding.error("", "read", str(error))
        inspection = Inspection((), {Path(log).name: (unreadable,)})
    else:
        inspection = Inspection(recordings, {r.name: tuple(audit(r, compiled)) for r in recordings})
    if out is not None:
        folder = Path(out)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "findings.txt").write_text(f"{inspection}\n")
        known = {} if compiled is None else model_channels(compiled)
        units = {name: channel.unit for name, channel in known.items()}
        for recording in inspection.recordings:
            plot_recording(recording, folder / f"{recording.name}.png", inspection.findings[recording.name], units)
    return inspection


def replay_log(
    model: str | Path,
    logs: Sequence[str | Path],
    mapping: LogMapping | str | Path | None = None,
    out: str | Path | None = None,
    seconds: float | None = None,
    keyframe: str | None = None,
) -> Replay:
    """Audit logs, replay them on a model, and write the errors and plots into a folder.

    Args:
        model: an MJCF file.
        logs: files or data sets, see :func:`load_recordings`.
        mapping: names the columns of foreign logs.
        out: folder for ``errors.csv`` (channel by horizon), ``summary.txt``, ``error.png`` and a plot per recording.
        seconds: length of the windows; None for each recording as a whole.
        keyframe: where joints without a column start.

    Raises:
        ValueError: if the audit found an error, or the logs cannot be replayed on the model.
    """
    compiled = load_model(model)
    recordings = [audited(recording, compiled) for log in logs for recording in load_recordings(log, mapping)]
    result = replay(compiled, recordings, seconds=seconds, keyframe=keyframe)
    if out is not None:
        folder = Path(out)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "summary.txt").write_text(f"{result}\n")
        result.save_table(folder / "errors.csv")
        plot_error(result, folder / "error.png")
        for name in dict.fromkeys(result.windows.recording):
            plot_replay(result, folder / f"{name}.png", name)
    return result
