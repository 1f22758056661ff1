"""Beginning an episode of any MuJoCo environment in the state that an observation shows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from simopt_envs.physics.parameters import Array
from wrappers.randomizable import model_and_data

# All in standard deviations of the coordinates of the states that the environment begins in.
_ACCURACY = 1e-9
_DIFFERENCE = 1e-4
_MOST_ITERATIONS = 30


class StartFromObservation(gym.Wrapper, RecordConstructorArgs):
    """Takes ``options["initial_observation"]``, so that a simulated episode can repeat a measured one.

    The environment's own resets show along which directions the states differ that episodes begin in. Along these, the
    episode is moved from where the reset put it to the state whose observation is nearest (least squares), and of
    several such to the least distant one. So measurement noise does not push a robot into its table, and what no
    channel shows stays as it was drawn. A state is the positions and velocities of the model, and of environments that
    have them the ``goal`` (gymnasium-robotics) and the arrays in ``start_variables`` (the robosuite tasks of this
    package).

    Between this wrapper and the environment may be wrappers that transform single observations, such as
    ``FlattenObservation``; those that remember earlier ones belong outside.

    Args:
        env: an environment with a MuJoCo model and a method ``_get_obs``, as those of Gymnasium and
            gymnasium-robotics have. Its outermost observation must be a Box with one axis.

    Raises:
        TypeError: for an environment without these, or whose observation is not a function of the state.
        ValueError: by ``reset``, for an observation of a wrong shape or that is not finite.
    """

    def __init__(self, env: gym.Env):
        RecordConstructorArgs.__init__(self)
        super().__init__(env)
        model_and_data(env)
        if not hasattr(env.unwrapped, "_get_obs"):
            raise TypeError(f"{env} has no method _get_obs, which tells what a state looks like")
        if len(env.observation_space.shape or ()) != 1:
            raise TypeError(
                f"observations must be a Box with one axis, got {env.observation_space}; flatten them first"
            )
        self._layers: list[gym.ObservationWrapper] = []
        layer: Any = env
        while layer is not env.unwrapped:
            if isinstance(layer, gym.ObservationWrapper):
                self._layers.insert(0, layer)
            layer = layer.env
        drawn, _ = env.reset(seed=0)
        if not np.allclose(self._observe(), drawn, rtol=0.0, atol=1e-6):
            raise TypeError(f"the observation of {env} is not a function of its state, so no start can be found")
        self._directions = _start_directions(env)
        env.unwrapped.np_random = np.random.default_rng()  # as if it had never been seeded

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; ``options["initial_observation"]`` is used here, other options are passed on."""
        options = dict(options or {})
        target = options.pop("initial_observation", None)
        drawn, info = self.env.reset(seed=seed, options=options or None)
        if target is None:
            return drawn, info
        target = np.asarray(target, dtype=np.float64)
        if target.shape != drawn.shape or not np.isfinite(target).all():
            raise ValueError(f"initial_observation must be finite and of shape {drawn.shape}, got {target}")
        state = _State(self.env)

        def observe(x: Array) -> Array:
            state.move(self._directions @ x)
            return self._observe()

        observe(_nearest(observe, target, np.zeros(self._directions.shape[1])))
        state.settle()
        return self._observe().astype(drawn.dtype), info

    def _observe(self) -> Any:
        base: Any = self.env.unwrapped
        observation = base._get_obs()
        for layer in self._layers:
            observation = layer.observation(observation)
        return observation


class _State:
    """The state of an environment as coordinates (size,), which are zero in the state it was in at first.

    They are displacements of the positions (along the tangent space, for the sake of quaternions), of the velocities,
    and of the environment's own variables.
    """

    def __init__(self, env: gym.Env):
        self._env: Any = env.unwrapped
        self._model, self._data = model_and_data(env)
        self._origin = [x.copy() for x in self._variables()]
        self._sizes = [self._model.nv, *(x.size for x in self._origin[1:])]
        self.size = sum(self._sizes)

    def coordinates(self) -> Array:
        """Where the environment is now."""
        positions, *others = self._variables()
        displacement = np.zeros(self._model.nv)
        mujoco.mj_differentiatePos(self._model, displacement, 1.0, self._origin[0], positions)
        return np.concatenate([displacement, *(x - o for x, o in zip(others, self._origin[1:], strict=True))])

    def move(self, coordinates: Array) -> None:
        """Go there, and compute what follows from it."""
        displacement, *changes = np.split(coordinates, np.cumsum(self._sizes)[:-1])
        positions, *others = self._variables()
        positions[:] = self._origin[0]
        mujoco.mj_integratePos(self._model, positions, displacement, 1.0)
        for x, origin, change in zip(others, self._origin[1:], changes, strict=True):
            x[:] = origin + change
        mujoco.mj_forward(self._model, self._data)

    def settle(self) -> None:
        """Let the environment know, if it wants to: its controllers may hold on to where an episode begins."""
        if hasattr(self._env, "set_state"):
            self._env.set_state(self._data.qpos.copy(), self._data.qvel.copy())

    def _variables(self) -> list[np.ndarray]:
        """The live arrays that hold the state, positions first."""
        goal = getattr(self._env, "goal", None)  # which is another array after each reset
        return [
            self._data.qpos,
            self._data.qvel,
            *getattr(self._env, "start_variables", ()),
            *([goal] if isinstance(goal, np.ndarray) else []),
        ]


def _start_directions(env: gym.Env) -> Array:
    """Directions (size, k) in which the states differ that ``env`` begins in; unit vectors where each std is 1."""
    state = _State(env)
    starts = []
    for seed in range(1, state.size + 3):
        env.reset(seed=seed)
        starts.append(state.coordinates())
    std = np.std(starts, axis=0)
    differences = np.diff(starts, axis=0) / np.where(std > 1e-9, std, np.inf)
    _, extent, directions = np.linalg.svd(differences, full_matrices=False)
    return (directions[extent > 1e-6] * std).T


def _nearest(observe: Callable[[Array], Array], target: Array, x: Array) -> Array:
    """The x near the given one whose observation is nearest to a target: Gauss-Newton steps of least norm.

    The Jacobian costs far more than all else, so it is kept for as long as the steps with it shrink quickly.
    """
    value, inverse, last = observe(x), None, 1.0
    for _ in range(_MOST_ITERATIONS):
        if inverse is None:
            columns = [observe(x + dx) - value for dx in _DIFFERENCE * np.eye(len(x))]
            jacobian = np.reshape(columns, (len(x), len(target))).T / _DIFFERENCE
            inverse = np.linalg.pinv(jacobian, rcond=1e-6)
        step = inverse @ (target - value)
        x = x + step
        size = float(np.abs(step).max(initial=0.0))
        if size < _ACCURACY:
            break
        value = observe(x)
        inverse, last = (inverse if size < 0.1 * last else None), size
    return x
