"""A force that comes and goes with the position of a joint."""

from __future__ import annotations

import itertools

import mujoco
import numpy as np

from simopt_envs.physics.effects.effect import Effect, Motion, Values, object_name
from simopt_envs.physics.effects.joints import (
    add_passive_motor,
    dof,
    force_unit,
    is_slide,
    probe_force,
    scalar_joints,
)
from simopt_envs.physics.parameters import Parameter, Write

_PERIODS = 0.7 * np.arange(2, 9)  # in the range of the motion: near enough for a fit to find those between
_LEAST_PERIODS = 1.0  # in the range of the motion
_PHASES = np.pi / 3 * np.arange(3)  # amplitudes below 0 are those between


class Cogging(Effect):
    """A force with a period in position: magnets against slots, teeth of a gear (a motor, ``NAME.cogging``)."""

    name = "cogging"
    law = "f = A sin(n q + phase)"
    shape = ("periods", "phase")

    def places(self, model: mujoco.MjModel) -> tuple[str, ...]:
        """See :meth:`Effect.places`."""
        return scalar_joints(model)

    def add(self, spec: mujoco.MjSpec, place: str) -> None:
        """See :meth:`Effect.add`."""
        joint = object_name(place)
        add_passive_motor(spec, f"{joint}.cogging", joint)

    def parameters(self, model: mujoco.MjModel, place: str) -> tuple[Parameter, ...]:
        """See :meth:`Effect.parameters`."""
        joint = object_name(place)
        motor = f"{joint}.cogging"
        amplitude = Write("actuator_biasprm", motor, (0,), "add")
        periods = Write("actuator_biasprm", motor, (1,))
        phase = Write("actuator_biasprm", motor, (2,))
        per = "rad/m" if is_slide(model, joint) else "1"  # n of a hinge is periods per revolution
        return (
            Parameter("amplitude", force_unit(model, joint), 0.0, -1e4, 1e4, "linear", (amplitude,)),
            Parameter("periods", per, 1.0, 0.0, 1e4, "linear", (periods,)),
            Parameter("phase", "rad", 0.0, -2 * np.pi, 2 * np.pi, "linear", (phase,)),
        )

    def probes(self, model: mujoco.MjModel, place: str, motion: Motion) -> tuple[dict[str, float], ...]:
        """Waves of several phases and numbers of periods in the range of the motion."""
        joint = object_name(place)
        i = dof(model, joint)
        base = 2 * np.pi / float(motion.high[i] - motion.low[i])
        force = probe_force(model, joint, motion)
        return tuple(
            {"amplitude": force, "periods": float(k) * base, "phase": float(phase)}
            for k, phase in itertools.product(_PERIODS, _PHASES)
        )

    def is_itself(self, model: mujoco.MjModel, place: str, motion: Motion, values: Values) -> bool:
        """A wave of which the motion does not see a whole period was not seen to come back: it is a bent spring."""
        i = dof(model, object_name(place))
        seen = values["periods"] * float(motion.high[i] - motion.low[i]) / (2 * np.pi)
        return seen > _LEAST_PERIODS

    def usual(self, values: Values) -> dict[str, float]:
        """Of a positive amplitude, with a phase between -pi and pi."""
        phase = values["phase"] + (np.pi if values["amplitude"] < 0 else 0.0)
        return {
            "amplitude": abs(values["amplitude"]),
            "periods": values["periods"],
            "phase": float(np.angle(np.exp(1j * phase))),
        }
