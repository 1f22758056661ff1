"""What a physical effect is: a law that a model may lack, the places where it can act, and how it enters a model."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import mujoco

from simopt_envs.physics.parameters import Array, Parameter

Values = Mapping[str, float]


@dataclass(frozen=True)
class Motion:
    """How a system moved in its recordings: it sets the size at which an effect is first tried.

    Attributes:
        low, high: range of each degree of freedom [rad, m], (nv,).
        speed: root mean square of its velocity [rad/s, m/s], (nv,).
        force: root mean square of the generalised force that moves it [N m, N], (nv,).
        command: root mean square of each actuator's command, less its mean, (nu,).
    """

    low: Array
    high: Array
    speed: Array
    force: Array
    command: Array


class Effect(ABC):
    """A physical effect. One subclass per effect, one file per subclass; a new file in this folder is all it takes.

    An effect enters a model in two steps. :meth:`add` gives an ``MjSpec`` the structure that the effect needs, if any,
    and :meth:`parameters` says which fields of the compiled model hold its numbers. At the parameters' nominal values
    the model behaves as it did without the effect.

    Attributes:
        name: as in reports and in ``gap.json``.
        law: one line, as a person would write it.
        shape: those of its parameters that say what it is like, not how much of it there is.
        levers: those of its shape in whose product with its amount, its first parameter, the law is linear.
        reciprocal: those of its parameters that are none at infinity, and in whose reciprocal the law is linear.
        extends: the effect that it is without some of its amounts, if any; their other parameters have the same names.
        of_reading: whether it is about what recordings show of its place, which must then be among their columns.
    """

    name: ClassVar[str]
    law: ClassVar[str]
    shape: ClassVar[tuple[str, ...]] = ()
    levers: ClassVar[tuple[str, ...]] = ()
    reciprocal: ClassVar[tuple[str, ...]] = ()
    extends: ClassVar[str] = ""
    of_reading: ClassVar[bool] = False

    @abstractmethod
    def places(self, model: mujoco.MjModel) -> tuple[str, ...]:
        """Where it can act, ``"joint:elbow"``: kind of object, colon, name."""

    def add(self, spec: mujoco.MjSpec, place: str) -> None:  # noqa: B027 - most effects need no structure
        """Give the spec what the effect needs, in place; nothing where MuJoCo's fields suffice.

        Joints, actuators, sites and sensors of the spec keep their names, since recordings are columns of them.
        """

    @abstractmethod
    def parameters(self, model: mujoco.MjModel, place: str) -> tuple[Parameter, ...]:
        """Its parameters at a place; ``model`` has the effect's structure. Nominal is what leaves the model as it was.

        Writes add to, or scale, what the model has: plain parameters move the same fields. A write to
        ``column.bias``, ``column.scale`` or ``column.delay`` of a column changes what a sensor shows, see
        :mod:`simopt_envs.physics.columns`.
        """

    def full_name(self, place: str, parameter: str) -> str:
        """What one of its parameters is called in ξ: ``"coulomb_friction.elbow.frictionloss"``.

        Of a reading with the kind of its place, ``"sensor_delay.site.tip.delay"``: a joint, a sensor and a site may
        have one name.
        """
        where = place.replace(":", ".", 1) if self.of_reading else object_name(place)
        return f"{self.name}.{where}.{parameter}"

    @abstractmethod
    def probes(self, model: mujoco.MjModel, place: str, motion: Motion) -> tuple[dict[str, float], ...]:
        """Values at which to try the effect first: sizes that would just show, one for each shape it may have.

        ``model`` is the one that ``motion`` is of, without the effect's structure.

        A probe and a multiple of it, in all but its :attr:`shape`, are told apart by the fit; another shape (width of
        a detent) needs a probe of its own. Every parameter differs from its nominal in at least one probe.
        """

    def grown(self, model: mujoco.MjModel, place: str, motion: Motion, values: Values) -> tuple[dict[str, float], ...]:
        """Values to go on from where those of the effect that it :attr:`extends` have been fitted."""
        return ()

    def rest(self, place: str, values: Values, loads: Mapping[str, Array]) -> dict[str, Array]:
        """Where the joints that it adds rest, by name, under the loads (w,) [N m, N] that joints carry."""
        return {}

    def is_itself(self, model: mujoco.MjModel, place: str, motion: Motion, values: Values) -> bool:
        """Whether fitted values are what the effect's name means, where other effects can look the same."""
        return True

    def usual(self, values: Values) -> dict[str, float]:
        """Of several sets of values that mean the same law, the one that people write."""
        return dict(values)


def object_name(place: str) -> str:
    """``"joint:elbow"`` -> ``"elbow"``."""
    return place.split(":", 1)[1]
