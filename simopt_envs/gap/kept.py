"""Finished fits on disk, so that a search that was killed goes on from them."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

import simopt_envs
from simopt_envs.adaptation.checkpoint import Checkpoint, digest
from simopt_envs.gap.hypothesis import Hypothesis
from simopt_envs.gap.plain import Plain
from simopt_envs.measured.windows import Windows
from simopt_envs.physics.effects import Motion
from simopt_envs.physics.parameters import Array


def kept_fits(directory: str | Path | None, plain: Plain, motion: Motion, *windows: Windows) -> Checkpoint:
    """Where fits are kept: in a folder, or nowhere.

    Raises:
        ValueError: if the folder holds fits of another model, other priors or other recordings, or of other versions.
    """
    if directory is None:
        return Checkpoint(None, {}, resume=True)
    settings = {
        "model": digest(plain.model),
        "priors": digest(plain.prior.to_dict(), tuple(plain.prior.space)),
        "recordings": digest(motion, *windows),
        "versions": [simopt_envs.__version__, mujoco.__version__, np.__version__],
    }
    return Checkpoint(Path(directory), settings, resume=True)


def key_of(hypothesis: Hypothesis, *given: Array) -> str:
    """What a fit of a hypothesis is called, for all that its result depends on besides the data."""
    return digest(list(map(str, hypothesis.candidates)), *given)
