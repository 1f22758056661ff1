"""Opening a cabinet drawer with a Franka Panda: observation, action, reward and success."""

from __future__ import annotations

from functools import cached_property
from importlib.resources import as_file, files
from typing import Any

import mujoco
import numpy as np
from gymnasium import spaces

from simopt_envs.physics.arrays import namespace
from simopt_envs.physics.parameters import Array, ParameterSpace
from simopt_envs.physics.simulation import Simulation
from simopt_envs.tasks.arm import JOINTS, VelocityArm
from simopt_envs.tasks.drawer.parameters import drawer_parameters
from simopt_envs.tasks.effects import Effects, add_effects
from simopt_envs.tasks.task import Outcome

OPEN = 0.2  # m, a drawer this far out counts as open
PULL = 0.25  # m, as far as the reward asks to pull: a margin beyond OPEN
_GRIP_DEPTH = 0.022  # m, how far along the fingers the bar may lie from the grasp point and still be held
_GRIP_SLACK = 0.004  # m, how much wider than the bar the closed fingers may stand
_LOOSE = 0.03  # m, standing wider than the bar by this much, the fingers earn nothing for being around it


class DrawerTask:
    """See the package's docstring.

    The paper's reward terms, with three changes that PPO with a tenth of the paper's samples needs to find the grasp
    and the pull. The opening is rewarded for what it is instead of punished for what it lacks: the same but for a
    constant, and a large constant in the reward is what a critic learns last. It counts only with the handle between
    the fingers, as one finger hooked behind the bar opens the drawer too. And the bonus for fingers around the handle
    grows as they close on it.

    Args:
        effects: what the model has beyond its MJCF, see :func:`~simopt_envs.tasks.effects.add_effects`.
    """

    substeps = 15
    camera = "side"
    weights = {  # noqa: RUF012 - a constant
        "distance": -5.0,
        "angle": -0.7,
        "opening": 30.0,
        "grasp": 1.0,
        "action": -0.02,
    }
    observation_names = (*JOINTS, "handle_x", "handle_y", "handle_z")
    discrepancy_weights = np.array([0.5] * 7 + [1.0] * 3)

    def __init__(self, effects: Effects = ()) -> None:
        self._effects = tuple(effects)
        self._spec = _scene()
        added = add_effects(self._spec, effects)
        model = self._nominal = self.make_model()
        self.arm = VelocityArm(model, float(model.opt.timestep) * self.substeps)
        self.parameters: ParameterSpace = ParameterSpace([*drawer_parameters(model), *added])
        lower, upper = model.jnt_range[[model.joint(name).id for name in JOINTS]].T
        reach = 2.0  # m, nothing of the scene lies farther from the robot's base
        low, high = np.concatenate([lower - 0.2, np.full(3, -reach)]), np.concatenate([upper + 0.2, np.full(3, reach)])
        self.observation_space: spaces.Box[Any] = spaces.Box(low, high, dtype=np.float64)
        self.action_space: spaces.Box[Any] = spaces.Box(-1.0, 1.0, (8,), np.float32)
        self._gripper = model.actuator("gripper").id
        self._gripper_range = model.actuator("gripper").ctrlrange.tolist()
        self._drawer = model.joint("drawer").qposadr[0]
        self._grasp, self._handle = model.site("grasp").id, model.site("handle").id
        self._fingers = [model.joint(name).qposadr[0] for name in ("finger_left", "finger_right")]
        self._bar_radius, self._bar_half_length = model.geom("handle").size[:2].tolist()

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self._effects,)  # a copy is built anew: an MjSpec cannot be pickled

    def make_spec(self) -> mujoco.MjSpec:
        """See :meth:`Task.make_spec`."""
        return self._spec.copy()

    def make_model(self, visual: bool = True) -> mujoco.MjModel:
        """See :meth:`Task.make_model`."""
        spec = self.make_spec()
        spec.compiler.discardvisual = not visual
        return spec.compile()

    @cached_property
    def _home(self) -> Array:
        return self._nominal.key("home").qpos.copy()

    def initial_qpos(self, rng: np.random.Generator) -> Array:
        """The keyframe ``home``, each arm joint off by up to 0.02 rad."""
        qpos = self._home.copy()
        qpos[self.arm.qpos] += rng.uniform(-0.02, 0.02, len(JOINTS))
        return qpos

    def qpos_from_observation(self, observation: Array) -> Array:
        """The arm as observed; the drawer shut and the gripper open."""
        qpos = self._home.copy()
        qpos[self.arm.qpos] = observation[: len(JOINTS)]
        return qpos

    def hold(self, qpos: Array) -> Array:
        """See :meth:`Task.hold`."""
        ctrl = np.empty((len(qpos), self._nominal.nu))
        ctrl[:, self.arm.ctrl] = qpos[:, self.arm.qpos]
        ctrl[:, self._gripper] = qpos[:, self._fingers[0]]
        return ctrl

    def control(self, simulation: Simulation, action: Array) -> Array:
        """Seven joint velocities, and the gripper: -1 closed, 1 open."""
        low, high = self._gripper_range
        gripper = low + (high - low) * (action[:, 7:] + 1.0) / 2.0
        return namespace(action).concatenate([self.arm.targets(simulation, action[:, :7]), gripper], axis=1)

    def observe(self, simulation: Simulation) -> Array:
        """Seven joint positions [rad] and the handle's position [m]."""
        positions, handle = self.arm.positions(simulation), simulation.data("site_xpos")[:, self._handle]
        return namespace(positions).concatenate([positions, handle], axis=1)

    def evaluate(self, simulation: Simulation, action: Array) -> Outcome:
        """See :meth:`Task.evaluate`."""
        xp = namespace(action)
        sites = simulation.data("site_xpos")
        hand = simulation.data("site_xmat")[:, self._grasp].reshape(-1, 3, 3)
        qpos = simulation.data("qpos")
        opening = qpos[:, self._drawer]
        to_handle = sites[:, self._handle] - sites[:, self._grasp]
        across, sideways, along = xp.einsum("nij,ni->jn", hand, to_handle)  # in the hand's frame; fingers close along y
        left, right = (qpos[:, finger] for finger in self._fingers)
        around = (
            (xp.abs(along) < _GRIP_DEPTH)
            & (xp.abs(across) < self._bar_half_length)
            & (sideways < left)
            & (-sideways < right)
        )
        gap = left + right - 2.0 * self._bar_radius
        held = around & (gap < _GRIP_SLACK)
        grip = around * xp.clip(1.0 - gap / _LOOSE, 0.0, 1.0)
        # The fingers are to point into the cabinet (+x) and to close along z, across the horizontal bar.
        misaligned = (1.0 - hand[:, 0, 2]) + (1.0 - xp.abs(hand[:, 2, 1]))
        measures = {
            "distance": xp.linalg.norm(to_handle, axis=1),
            "angle": misaligned,
            "opening": xp.clip(opening, 0.0, PULL) * grip,
            "grasp": grip,
            "action": xp.sum(action**2, axis=1),
        }
        terms = {name: self.weights[name] * value for name, value in measures.items()}
        return Outcome(reward=sum(terms.values()), terms=terms, success=held & (opening >= OPEN))


def _scene() -> mujoco.MjSpec:
    with as_file(files("simopt_envs.tasks.drawer")) as folder:
        return mujoco.MjSpec.from_file(str(folder / "model.xml"))
