"""Sensors that show something else than what is."""

# ruff: noqa: D102 - the hooks are documented in truth.Law

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from benchmarks.hidden_effects.plants import Array
from benchmarks.hidden_effects.truth import Law, Sampler, World


@dataclass
class EncoderBias(Law):
    """A joint's encoder reads too much by this; the drive believes it."""

    joint: str
    bias: float

    def start(self, world: World) -> None:
        world.encoder_bias[list(world.dof).index(world.joint_dof(self.joint))] += self.bias


@dataclass
class Reading(Law):
    """A column, or the columns of a site or sensor, show scale * (1 + curve x^2) x + bias, late by delay and lag [s].

    Attributes:
        prefix: of the columns.
        scale: of the reading.
        bias: added.
        delay: pure.
        lag: first order.
        curve: nonlinearity [1/unit^2].
        step: of a quantiser; 0 for none.
    """

    prefix: str
    scale: float = 1.0
    bias: float = 0.0
    delay: float = 0.0
    lag: float = 0.0
    curve: float = 0.0
    step: float = 0.0

    def observe(self, name: str, time: Array, sample: Sampler) -> Array:
        if not name.startswith(self.prefix):
            return sample(time)
        if self.lag:
            ages = self.lag * -np.log1p(-(np.arange(20) + 0.5) / 20)  # quantiles of the exponential kernel
            values = np.mean([sample(time - self.delay - age) for age in ages], axis=0)
        else:
            values = sample(time - self.delay)
        values = self.scale * values * (1 + self.curve * values**2) + self.bias
        return np.round(values / self.step) * self.step if self.step else values


@dataclass
class FrameOffset(Law):
    """A site is really elsewhere on its body."""

    site: str
    offset: tuple[float, float, float]

    def build(self, spec: mujoco.MjSpec) -> None:
        site = spec.site(self.site)
        site.pos = np.array(site.pos) + self.offset
