"""Where a law acts: a joint or a drive."""

# ruff: noqa: D102 - the hooks are documented in truth.Law

from __future__ import annotations

from dataclasses import dataclass

from benchmarks.hidden_effects.truth import Law, World


@dataclass
class AtJoint(Law):
    """A law at one joint."""

    joint: str

    def start(self, world: World) -> None:
        self._dof, self._qpos = world.joint_dof(self.joint), world.joint_qpos(self.joint)

    def _state(self, world: World) -> tuple[float, float]:
        return float(world.data.qpos[self._qpos]), float(world.data.qvel[self._dof])


@dataclass
class AtDrive(Law):
    """A law at one actuator."""

    actuator: str

    def start(self, world: World) -> None:
        self._i = world.model.actuator(self.actuator).id
