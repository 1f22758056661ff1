"""What the effects of sensors share: which there are, and the columns of a recording that they fill."""

from __future__ import annotations

import mujoco

from simopt_envs.physics.effects.effect import object_name


def sensors(model: mujoco.MjModel) -> tuple[str, ...]:
    """``"sensor:NAME"`` of every named sensor."""
    names = (model.sensor(i).name for i in range(model.nsensor))
    return tuple(f"sensor:{name}" for name in names if name)


def sites(model: mujoco.MjModel) -> tuple[str, ...]:
    """``"site:NAME"`` of every named site."""
    names = (model.site(i).name for i in range(model.nsite))
    return tuple(f"site:{name}" for name in names if name)


def columns(model: mujoco.MjModel, place: str) -> tuple[str, ...]:
    """The columns of a joint's encoder (position and velocity), of a sensor or of a site."""
    name = object_name(place)
    if place.startswith("joint:"):
        return (f"qpos/{name}", f"qvel/{name}")
    if place.startswith("site:"):
        return tuple(f"site/{name}/{axis}" for axis in "xyz")
    numbers = int(model.sensor(name).dim[0])
    return (f"sensor/{name}",) if numbers == 1 else tuple(f"sensor/{name}/{i}" for i in range(numbers))
