"""Plain parameters: what a refit may move before anything is called missing, and how far (the prior)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from simopt_envs.distributions.gaussian import Gaussian
from simopt_envs.physics.columns import acts_on_columns
from simopt_envs.physics.effects.actuator_delay import LONGEST
from simopt_envs.physics.effects.actuators import actuators, affine_bias
from simopt_envs.physics.effects.effect import object_name
from simopt_envs.physics.effects.joints import is_slide, scalar_joints
from simopt_envs.physics.parameters import Parameter, ParameterSpace, Write
from simopt_envs.physics.spec_writer import keep_inertias
from simopt_envs.physics.writer import ModelWriter, actuator_rows

_INERTIAL_STD = 0.10  # relative, of masses, inertias, armature and damping: what a data sheet or CAD is off by
_GAIN_STD = 0.03
_LATENCY_MEAN, _LATENCY_STD = 1e-3, 0.6e-3  # s: uniform over 0 to 2 ms has this mean and this spread
_MOST_TAKEN = 0.9  # of an armature: a motor that turns alone, behind a spring, needs some
_WIDEST = 100.0  # factor within which a relative parameter may move

SPEAKS_FOR = {
    "mass": "payload",
    "inertia": "payload",
    "armature": "armature",
    "damping": "viscous_friction",
    "gain": "actuator_gain",
    "velocity_gain": "actuator_gain",
    "command_latency": "actuator_delay",
}
"""The effect that a kind of plain parameter, driven far outside its prior, stands for."""


INTEGRATION_LEAD = "integration_lead"
"""How far the positions of MuJoCo's semi-implicit integrators are ahead of the velocities [s]: half a step.

A step moves positions by the velocity at its end. From a start in (q, v), positions are those of a right model at
q - h/2 v, seen h/2 later; not to undo that would make every drive and sensor look late by it. A system that is such a
simulation itself has the same lead, so that a fit must be free to leave it.
"""


@dataclass(frozen=True)
class Plain:
    """The plain parameters of a model.

    Attributes:
        spec, model: the model, as a spec that keeps the masses that are written into it.
        prior: their distribution before the data.
    """

    spec: mujoco.MjSpec
    model: mujoco.MjModel
    prior: Gaussian

    @classmethod
    def of(cls, spec: mujoco.MjSpec, prior: Gaussian) -> Plain:
        """Parameters of a user's own, or the current p(ξ).

        Raises:
            ValueError: where there are none, or they cannot be written to the model.
        """
        spec = spec.copy()
        keep_inertias(spec)
        model = spec.compile()
        prior = _with_lead(model, prior)
        if not len(prior.space):
            raise ValueError(
                "nothing of the model may be refitted, so that all that data differ in would be called missing: give"
                " its bodies and actuators names in the MJCF, or declare plain parameters"
            )
        ModelWriter(model, ParameterSpace(p for p in prior.space if not acts_on_columns(p)))  # raises where it cannot
        return cls(spec, model, prior)

    def compiled(self, spec: mujoco.MjSpec) -> mujoco.MjModel:
        """The model of its spec, or of one with effects added, without geoms that are there only to be seen.

        It moves alike, bit by bit, in less time. Where rays may meet them, or ξ has one of them, they stay.
        """
        lean = spec.copy()
        lean.compiler.discardvisual = True
        model = lean.compile()
        needed = {write.object for p in self.prior.space for write in p.writes if write.field.startswith("geom_")}
        rays = int(mujoco.mjtSensor.mjSENS_RANGEFINDER) in model.sensor_type
        return spec.compile() if rays or needed - {model.geom(i).name for i in range(model.ngeom)} else model

    def __getstate__(self) -> dict[str, Any]:
        """For another process, without the spec: it cannot be sent, and its XML rounds to six digits."""
        return {name: value for name, value in self.__dict__.items() if name != "spec"}


def plain_parameters(spec: mujoco.MjSpec) -> Plain:
    """The plain parameters of any model, with priors as of a good data sheet.

    Link masses and inertias 10 %, armature and joint damping 10 %, servo gains 3 %, command latency 0-2 ms.
    """
    model = spec.copy().compile()
    drives = [object_name(place) for place in actuators(model)]
    parameters, std = [], []
    for body in _moving_bodies(model):
        for quantity, field in (("mass", "body_mass"), ("inertia", "body_inertia")):
            parameters.append(_factor(f"{quantity}.{body}", Write(field, body, operation="scale")))
            std.append(_INERTIAL_STD)
    for joint in map(object_name, scalar_joints(model)):
        dof = int(model.joint(joint).dofadr[0])
        inertia, numerical = float(model.dof_armature[dof]), _numerical_inertia(model, dof)
        if inertia:
            add = Write("dof_armature", joint, operation="add")
            unit = "kg" if is_slide(model, joint) else "kg m2"
            parameters.append(Parameter(f"armature.{joint}", unit, 0.0, -_MOST_TAKEN * inertia, 1e4, "linear", (add,)))
            std.append(float(np.hypot(_INERTIAL_STD * inertia, numerical)))
        if model.dof_damping[dof]:
            parameters.append(_factor(f"damping.{joint}", Write("dof_damping", joint, operation="scale")))
            std.append(_INERTIAL_STD)
    for drive in drives:
        _, stiffness, damping = affine_bias(model)[model.actuator(drive).id]
        if stiffness:
            writes = Write("actuator_gainprm", drive, (0,), "scale"), Write("actuator_biasprm", drive, (1,), "scale")
            parameters.append(_factor(f"gain.{drive}", *writes))
            std.append(_GAIN_STD)
        if damping:
            parameters.append(_factor(f"velocity_gain.{drive}", Write("actuator_biasprm", drive, (2,), "scale")))
            std.append(_GAIN_STD)
    if drives:
        late = tuple(Write("command.delay", drive, operation="add") for drive in drives)
        parameters.append(Parameter("command_latency", "s", 0.0, 0.0, LONGEST / 2, "linear", late))
        std.append(_LATENCY_STD)
    space = ParameterSpace(parameters)
    mean = space.to_unconstrained(space.nominal)
    if "command_latency" in space:
        mean[space.index("command_latency")] = _LATENCY_MEAN
    return Plain.of(spec, Gaussian(space, mean, np.diag(np.square(std))))


def _with_lead(model: mujoco.MjModel, prior: Gaussian) -> Gaussian:
    """The prior with the lead of the model's integrator, anywhere between none and half a step."""
    if model.opt.integrator == int(mujoco.mjtIntegrator.mjINT_RK4) or INTEGRATION_LEAD in prior.space:
        return prior
    half = 0.5 * float(model.opt.timestep)
    write = Write("clock.lead")
    lead = Parameter(INTEGRATION_LEAD, "s", 0.0, 0.0, half, "linear", (write,))
    covariance = np.zeros((len(prior.mean) + 1,) * 2)
    covariance[:-1, :-1], covariance[-1, -1] = prior.covariance, (half / 2) ** 2
    return Gaussian(ParameterSpace([*prior.space, lead]), np.append(prior.mean, half / 2), covariance)


def _numerical_inertia(model: mujoco.MjModel, dof: int) -> float:
    """The inertia that MuJoCo's implicit integrators add to a degree of freedom: its damping times the timestep.

    It is no property of the system, so that a fit must be free to take it away again.
    """
    drives = np.flatnonzero(
        (model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT))
        & (model.jnt_dofadr[model.actuator_trnid[:, 0]] == dof)
    )
    gears = model.actuator_gear[actuator_rows(model, "out")[0][drives], 0]
    damping = model.dof_damping[dof] - np.sum(affine_bias(model)[drives, 2] * gears**2)
    return float(model.opt.timestep * max(damping, 0.0))


def _factor(name: str, *writes: Write) -> Parameter:
    """A parameter that scales places of the model."""
    return Parameter(name, "1", 1.0, 1 / _WIDEST, _WIDEST, "log", writes)


def _moving_bodies(model: mujoco.MjModel) -> list[str]:
    """Named bodies with a mass that any joint moves."""
    bodies = (model.body(i) for i in range(1, model.nbody) if model.body_weldid[i] != 0 and model.body_mass[i] > 0)
    return [body.name for body in bodies if body.name]
