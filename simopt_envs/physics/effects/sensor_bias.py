"""A sensor whose zero is not where it should be."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco

from simopt_envs.physics.effects.effect import Effect, Motion, object_name
from simopt_envs.physics.effects.joints import dof, position_unit, scalar_joints
from simopt_envs.physics.effects.readings import columns, sensors
from simopt_envs.physics.parameters import Parameter, Write


class SensorBias(Effect):
    """A sensor reads too much by a constant. The bias of a joint's encoder is seen by its servo too (``ref``).

    A joint's position in the model is then what its encoder reads: the reference, the rest position of its spring, its
    limits, and the lengths of fixed tendons over it move along, and the mechanics stay where they are. Keyframes stay
    as they are, in what the encoder reads.
    """

    name = "sensor_bias"
    law = "y = x + b"
    of_reading = True

    def places(self, model: mujoco.MjModel) -> tuple[str, ...]:
        """See :meth:`Effect.places`."""
        return scalar_joints(model) + sensors(model)

    def add(self, spec: mujoco.MjSpec, place: str) -> None:
        """See :meth:`Effect.add`."""
        if place.startswith("joint:"):
            model = spec.copy().compile()
            for i, _ in _tendons(model, model.joint(object_name(place)).id):
                spec.tendons[i].name = spec.tendons[i].name or f"tendon.{i}"  # a parameter writes by name

    def parameters(self, model: mujoco.MjModel, place: str) -> tuple[Parameter, ...]:
        """``bias``; of a sensor with several numbers ``bias_0``, ``bias_1`` ..."""
        if place.startswith("joint:"):
            joint = object_name(place)
            return (Parameter("bias", position_unit(model, joint), 0.0, -10.0, 10.0, "linear", _writes(model, joint)),)
        shown = columns(model, place)
        names = ["bias"] if len(shown) == 1 else [f"bias_{i}" for i in range(len(shown))]
        return tuple(
            Parameter(name, "", 0.0, -1e6, 1e6, "linear", (Write("column.bias", column, operation="add"),))
            for name, column in zip(names, shown, strict=True)
        )

    def probes(self, model: mujoco.MjModel, place: str, motion: Motion) -> tuple[dict[str, float], ...]:
        """See :meth:`Effect.probes`."""
        if place.startswith("joint:"):
            i = dof(model, object_name(place))
            return ({"bias": 0.02 * float(motion.high[i] - motion.low[i])},)
        return tuple({parameter.name: 0.01} for parameter in self.parameters(model, place))


def _writes(model: mujoco.MjModel, joint: str) -> tuple[Write, ...]:
    """All that is counted in a joint's position."""
    j = model.joint(joint).id
    fields = ["qpos0", "qpos_spring"] + (["jnt_range"] if model.jnt_limited[j] else [])
    writes = [Write(field, joint, operation="add") for field in fields]
    for i, arm in _tendons(model, j):
        lengths = ["tendon_lengthspring"] + (["tendon_range"] if model.tendon_limited[i] else [])
        writes += [Write(field, model.tendon(i).name, operation="add", factor=arm) for field in lengths]
    return tuple(writes)


def _tendons(model: mujoco.MjModel, joint: int) -> Iterator[tuple[int, float]]:
    """The fixed tendons over a joint, and by how much they lengthen as it moves."""
    for i in range(model.ntendon):
        path = slice(model.tendon_adr[i], model.tendon_adr[i] + model.tendon_num[i])
        over = (model.wrap_type[path] == int(mujoco.mjtWrap.mjWRAP_JOINT)) & (model.wrap_objid[path] == joint)
        for arm in model.wrap_prm[path][over]:
            yield i, float(arm)
