"""Physical effects that an environment's model has beyond its MJCF, as the gap workflow names them."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.envs.registration import EnvSpec

from simopt_envs.physics.effects import EFFECTS, Effect, require_mujoco
from simopt_envs.physics.effects.actuator_delay import LONGEST
from simopt_envs.physics.parameters import Parameter, Write, unknown_name

Effects = Sequence[Mapping[str, Any]]
"""Entries of ``"effects"`` in ``gap.json``: ``{"effect": "coulomb_friction", "where": "joint:elbow",
"parameters": {"frictionloss": 0.3}}``. A parameter is a number or has one as its ``"value"``; what is not named is
neutral. Other keys are ignored. The share of a lag in a delay of commands is taken as dead time."""

_KEYS = ("effect", "where", "parameters")
_LAG = "command.lag_share"  # which the buffer of an actuator cannot hold


def add_effects(spec: mujoco.MjSpec, effects: Effects) -> tuple[Parameter, ...]:
    """Give a spec the structure of effects, in place.

    Returns:
        Their parameters as they join ξ: called ``"coulomb_friction.elbow.frictionloss"``, with the given values as
        nominal.

    Raises:
        ValueError: for an effect, a place or a parameter that there is not, a value that is out of bounds, or an effect
            that an environment cannot take.
    """
    read = [_read(spec, entry) for entry in effects]
    for effect, place, _ in read:
        effect.add(spec, place)
        for drive in _delayed(effect, spec, place):
            spec.actuator(drive).nsample += int(np.ceil(LONGEST / spec.option.timestep)) + 1  # room in its buffer
    if not read:
        return ()
    model = spec.compile()
    return tuple(p for effect, place, values in read for p in _parameters(effect, model, place, values))


def with_effects(env_id: str, effects: Effects) -> EnvSpec:
    """A registered environment with effects, for ``gym.make``, ``gym.make_vec`` and ``EnvSimulator``."""
    spec = copy.deepcopy(gym.spec(env_id))
    spec.kwargs["effects"] = list(effects)
    return spec


def _read(spec: mujoco.MjSpec, entry: Mapping[str, Any]) -> tuple[Effect, str, dict[str, float]]:
    """An entry as effect, place and values."""
    require_mujoco()
    for key in _KEYS:
        if key not in entry:
            raise ValueError(f"an effect needs the keys {', '.join(_KEYS)}; got {dict(entry)}")
    name, place = str(entry["effect"]), str(entry["where"])
    if name not in EFFECTS:
        raise ValueError(unknown_name("effect", name, EFFECTS))
    effect = EFFECTS[name]
    places = effect.places(spec.compile())
    if place not in places:
        raise ValueError(unknown_name(f"place of {name}", place, places))
    if obstacle := _obstacle(effect, place, spec):
        possible = (other.name for other in EFFECTS.values() if _can_be_taken(other, spec))
        raise ValueError(f"{name} at {place} {obstacle}. An environment takes {', '.join(possible)}")
    values = {k: v["value"] if isinstance(v, Mapping) else v for k, v in entry["parameters"].items()}
    for parameter, value in values.items():
        if not isinstance(value, int | float):
            raise ValueError(f"{name}: {parameter} must be a number, got {value!r}")
    return effect, place, values


def _parameters(effect: Effect, model: mujoco.MjModel, place: str, values: Mapping[str, float]) -> Iterator[Parameter]:
    """The parameters of an effect with values as their nominals."""
    neutral = effect.parameters(model, place)
    for name in values:
        if name not in (known := [p.name for p in neutral]):
            raise ValueError(unknown_name(f"parameter of {effect.name}", name, known))
    for p in neutral:
        if any(write.field == _LAG for write in p.writes):
            continue
        yield replace(
            p,
            name=effect.full_name(place, p.name),
            nominal=float(values.get(p.name, p.nominal)),
            baseline=p.nominal,
            writes=tuple(map(_native, p.writes)),
        )


def _native(write: Write) -> Write:
    """A delay of commands as the buffer of the actuator has it: an environment's commands do not pass any other."""
    return replace(write, field="actuator_delay") if write.field == "command.delay" else write


def _obstacle(effect: Effect, place: str, spec: mujoco.MjSpec) -> str | None:
    """Why an environment cannot take an effect, if it cannot."""
    before, changed = spec.compile(), spec.copy()
    effect.add(changed, place)
    model = changed.compile()
    if any(w.field.startswith("column.") for p in effect.parameters(model, place) for w in p.writes):
        return "changes what a sensor shows, not the model: wrap the environment, see SensorDelay in wrappers"
    if (model.nq, model.nu) != (before.nq, before.nu):
        return "adds joints or commands that a task does not know: load the model.repaired.xml of the gap workflow"
    return None


def _can_be_taken(effect: Effect, spec: mujoco.MjSpec) -> bool:
    return any(_obstacle(effect, place, spec) is None for place in effect.places(spec.compile())[:1])


def _delayed(effect: Effect, spec: mujoco.MjSpec, place: str) -> list[str]:
    """The actuators whose commands an effect delays."""
    writes = (w for p in effect.parameters(spec.compile(), place) for w in p.writes)
    return [w.object for w in writes if w.field == "command.delay" and w.object is not None]
