"""The p(ξ) that adaptation begins with where nobody says what varies."""

from __future__ import annotations

from collections.abc import Mapping
from fnmatch import fnmatchcase

from simopt_envs.distributions import Gaussian
from simopt_envs.physics import ParameterSpace
from simopt_envs.physics.parameters import unknown_name

FIRST_STD: Mapping[str, Mapping[str, float]] = {
    # What differs from one kitchen to the next: where the cabinet stands, narrowly, as in the paper, and how its drawer
    # runs and grips. The arm is taken as calibrated; --vary "joint_gain_*=0.1" and the like say otherwise.
    "SimOpt/Drawer-v0": {
        "cabinet_*": 0.02,
        "drawer_damping": 0.2,
        "drawer_friction": 0.2,
        "drawer_mass": 0.2,
        "handle_friction": 0.2,
    },
    # A swing is over in a second and follows no correction, so little may vary at a time for a policy to work at all.
    "SimOpt/SwingPeg-v0": {
        "joint_gain_*": 0.03,
        "joint_damping_*": 0.03,
        "action_scaling_*": 0.02,
        "rope_segment_length": 0.03,
        "rope_bending_*": 0.1,
        "rope_density": 0.05,
        "peg_mass": 0.05,
        "peg_friction": 0.1,
    },
}
"""First standard deviations by environment: relative for logarithmic parameters, else in the parameter's unit."""


def first_distribution(space: ParameterSpace, std: Mapping[str, float]) -> Gaussian:
    """The first p(ξ), around nominal.

    Args:
        space: the parameters that there are.
        std: what varies, and by how much; names may be patterns such as ``joint_gain_*``, of which the last counts.

    Raises:
        ValueError: for a name that matches nothing.
    """
    chosen: dict[str, float] = {}
    for pattern, value in std.items():
        matching = [name for name in space.names if fnmatchcase(name, pattern)]
        if not matching:
            raise ValueError(unknown_name("parameter", pattern, space.names))
        chosen |= dict.fromkeys(matching, value)
    return Gaussian.around_nominal(space.subset(list(chosen)), list(chosen.values()))
