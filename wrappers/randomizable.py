"""Named, settable physics for any environment that exposes a MuJoCo model."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from simopt_envs.physics.parameters import Array, Parameter, ParameterSpace
from simopt_envs.physics.writer import ModelWriter, field_elements, model_field
from wrappers.model_parameters import model_parameters

_RECOMPUTES_VOLUMES = hasattr(mujoco.MjModel, "_setconst_inputs")


class RandomizablePhysics(gym.Wrapper, RecordConstructorArgs):
    """Gives a MuJoCo environment the ``parameters`` face of this package's own.

    ``reset(options={"parameters": {name: value}})`` sets values for that episode, the rest nominal;
    ``info["parameters"]`` of reset says what is in force. Values are always written from the model as it was compiled,
    never on top of the last ones, and constants that follow from them are recomputed. An environment that replaces its
    model when it is reset (robosuite's hard reset) gets the values into the new model; its first observation is
    then what the environment saw before that.

    >>> env = RandomizablePhysics(gym.make("Hopper-v5"), ["body_mass of *", "gravity"])
    >>> env.parameters["body_mass of torso"].unit
    'kg'
    >>> _, info = env.reset(seed=0, options={"parameters": {"gravity": 3.7}})
    >>> info["parameters"]["gravity"]
    3.7

    Args:
        env: one with ``env.unwrapped.model`` and ``data``, or robosuite's ``sim``.
        parameters: texts such as ``"body_mass of *"``, see :func:`~wrappers.model_parameters.model_parameters`;
            :class:`~simopt_envs.physics.Parameter` objects for anything else.

    Attributes:
        parameters: the :class:`~simopt_envs.physics.ParameterSpace`.

    Raises:
        TypeError: for an environment without a MuJoCo model.
        ValueError: for parameters that the model does not have, or sizes of geoms before MuJoCo 4.0; by ``reset``, for
            one whose place in the model the environment writes itself when it is reset.
    """

    def __init__(self, env: gym.Env, parameters: Iterable[str | Parameter] | str):
        parameters = (parameters,) if isinstance(parameters, str) else tuple(parameters)
        RecordConstructorArgs.__init__(self, parameters=parameters)
        super().__init__(env)
        model, _ = model_and_data(env)
        self.parameters: ParameterSpace = model_parameters(model, parameters)
        for parameter in self.parameters:
            if not _RECOMPUTES_VOLUMES and any(write.field == "geom_size" for write in parameter.writes):
                raise ValueError(
                    f"parameter {parameter.name!r} writes geom_size, which needs MuJoCo 4.0: {mujoco.__version__} keeps"
                    " the bounding volumes of before, in which contacts are looked for"
                )
        self._bind(model)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; ``options["parameters"]`` is used here, other options are passed on."""
        options = dict(options or {})
        xi = self.parameters.values(options.pop("parameters", None) or {})
        self._write(xi)
        written = self._values()
        observation, info = self.env.reset(seed=seed, options=options or None)
        model, data = model_and_data(self.env)
        if model is self._model:
            self._refuse_changes(written)
        else:
            self._bind(model)
            self._write(xi)
            mujoco.mj_forward(model, data)
        return observation, {**info, "parameters": self.parameters.as_dict(xi)}

    def _bind(self, model: mujoco.MjModel) -> None:
        """Remember a model's values as nominal."""
        self._model = model
        self._writer = ModelWriter(model, self.parameters)
        self._places = [(p.name, w.field, field_elements(model, w)) for p in self.parameters for w in p.writes]
        self._scratch = mujoco.MjData(model)  # derived constants are computed at qpos0: not in the env's own state

    def _write(self, xi: Array) -> None:
        self._writer.write_model(xi, self._model, self._scratch)

    def _values(self) -> list[Array]:
        """What the model holds in each of the places that parameters write."""
        return [model_field(self._model, field).ravel()[elements] for _, field, elements in self._places]

    def _refuse_changes(self, written: list[Array]) -> None:
        """Raise where the reset undid a parameter; writing it once more would undo what the environment drew."""
        for (name, field, _), was, now in zip(self._places, written, self._values(), strict=True):
            if not np.allclose(now, was, rtol=1e-6, atol=1e-12, equal_nan=True):
                own = self.env.has_wrapper_attr("parameters")
                raise ValueError(
                    f"parameter {name!r} is not in force: it set {field} to {was}, and {self.env} writes {field} "
                    f"itself when it is reset, here {now}; "
                    + ("use its own parameters (DistributionWrapper alone)" if own else "choose one it leaves alone")
                )


def model_and_data(env: gym.Env) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """MuJoCo's model and data of an environment, robosuite's among them; TypeError where it has none."""
    base: Any = env.unwrapped
    if hasattr(base, "sim"):  # robosuite wraps both once more
        model, data = getattr(base.sim.model, "_model", None), getattr(base.sim.data, "_data", None)
    else:
        model, data = getattr(base, "model", None), getattr(base, "data", None)
    if not isinstance(model, mujoco.MjModel) or not isinstance(data, mujoco.MjData):
        raise TypeError(
            f"RandomizablePhysics needs an environment with a MuJoCo 'model' and 'data' (or robosuite's 'sim'), "
            f"{type(base).__name__} has model {type(model).__name__} and data {type(data).__name__}"
        )
    return model, data
