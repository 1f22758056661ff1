"""Play in a gear."""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import numpy as np

from simopt_envs.physics.effects.effect import Effect, Motion, Values, object_name
from simopt_envs.physics.effects.joints import add_link_joint, dof, outermost_joints, position_unit
from simopt_envs.physics.parameters import Array, Parameter, Write

_REACH = 1e-5  # rad or m: how far before the end of its range a stop acts
_HELD = 0.95  # impedance of a stop: nearer to 1 it gives less under load, but chatters


class Backlash(Effect):
    """A link that is loose against the motor of its joint, where the encoder is, by a total width ``play``.

    Between the stops of the joint ``NAME.play``, nothing acts; the stops do not bounce. The joint's own spring and
    stops stay on the motor's side, which the encoder sees.
    """

    name = "backlash"
    law = "|q_link - q_motor| <= p/2"

    def places(self, model: mujoco.MjModel) -> tuple[str, ...]:
        """See :meth:`Effect.places`."""
        return outermost_joints(model)

    def add(self, spec: mujoco.MjSpec, place: str) -> None:
        """See :meth:`Effect.add`."""
        joint = object_name(place)
        link = add_link_joint(spec, joint, f"{joint}.play")
        in_degrees = link.type == mujoco.mjtJoint.mjJNT_HINGE and link.compiler.degree
        half = _REACH / 2  # so that without play both stops act, and hold the link
        half = np.degrees(half) if in_degrees else half
        link.limited = mujoco.mjtLimited.mjLIMITED_TRUE
        link.range = [-half, half]
        link.margin = _REACH
        link.solref_limit = [2 * spec.option.timestep, 1.0]  # as fast as is stable, without a bounce
        link.solimp_limit = [_HELD, _HELD, 0.001, 0.5, 2.0]

    def parameters(self, model: mujoco.MjModel, place: str) -> tuple[Parameter, ...]:
        """See :meth:`Effect.parameters`."""
        joint = object_name(place)
        writes = tuple(Write("jnt_range", f"{joint}.play", (i,), "add", factor=f) for i, f in ((0, -0.5), (1, 0.5)))
        return (Parameter("play", position_unit(model, joint), 0.0, 0.0, 1.0, "linear", writes),)

    def probes(self, model: mujoco.MjModel, place: str, motion: Motion) -> tuple[dict[str, float], ...]:
        """See :meth:`Effect.probes`."""
        i = dof(model, object_name(place))
        travel = float(motion.high[i] - motion.low[i])
        return tuple({"play": part * travel} for part in (0.0002, 0.001, 0.005, 0.02))

    def rest(self, place: str, values: Values, loads: Mapping[str, Array]) -> dict[str, Array]:
        """See :meth:`Effect.rest`."""
        joint = object_name(place)
        return {f"{joint}.play": 0.5 * values["play"] * np.sign(loads[joint])}
