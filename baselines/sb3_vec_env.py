"""Any Gymnasium vector environment as a Stable-Baselines3 `VecEnv`.

    model = PPO("MlpPolicy", SB3VecEnv(gym.make_vec("SimOpt/Drawer-v0", num_envs=128)))

The two interfaces differ in when a world is reset, where its last observation is kept, how infos are laid out and
when seeds take effect; the adapter translates all four, so that an algorithm sees what SB3's own `DummyVecEnv` of
the same worlds would show it. For returns and lengths of episodes in SB3's log, put SB3's `VecMonitor` around it.
"""

from collections.abc import Iterable
from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

try:
    from stable_baselines3.common.env_util import is_wrapped
    from stable_baselines3.common.vec_env import VecEnv
except ImportError as error:
    raise ImportError('SB3VecEnv needs Stable-Baselines3: pip install "simopt-envs[sb3]"') from error

Indices = int | Iterable[int] | None


class SB3VecEnv(VecEnv):
    """Adapter from `gymnasium.vector.VectorEnv` to `VecEnv`.

    Attributes and methods are those of the sub-environments where there are any (`SyncVectorEnv`,
    `AsyncVectorEnv`); a natively batched env has none, so there the env itself, or the nearest vector wrapper, answers
    for all worlds at once.

    Args:
        env: The vector env. One that does not reset in the same step must understand
            `reset(options={"reset_mask": mask})`, as Gymnasium's own do.

    Raises:
        ValueError: The env does not name its autoreset mode.
    """

    def __init__(self, env: VectorEnv) -> None:
        mode = env.metadata.get("autoreset_mode")
        if not isinstance(mode, AutoresetMode):
            raise ValueError(f"{env} must have an AutoresetMode as metadata['autoreset_mode'], got {mode!r}")
        self.env = env
        self._same_step = mode is AutoresetMode.SAME_STEP
        self._has_sub_envs = hasattr(env.unwrapped, "call")
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> Any:
        """Reset all worlds, with the seeds and options set since the last reset."""
        if any(options != self._options[0] for options in self._options):
            raise ValueError(f"a vector env takes the same reset options for all worlds, got {self._options}")
        # Seeds are consecutive by SB3's definition, and so are those that a vector env makes from its first one.
        observations, infos = self.env.reset(seed=self._seeds[0], options=self._options[0] or None)
        self.reset_infos = infos_by_world(infos, self.num_envs)
        self._reset_seeds()
        self._reset_options()
        return deepcopy(observations)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Keep the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Step all worlds; those that are done are reset at once, their last observation kept in their info."""
        observations, rewards, terminated, truncated, vector_infos = self.env.step(self._actions)
        done = terminated | truncated
        infos = infos_by_world(vector_infos, self.num_envs)
        ended = np.flatnonzero(done).tolist()
        if ended and self._same_step:
            for world in ended:
                begun = infos[world]  # SAME_STEP: the info of the new episode, that of the last step within
                last, final_observation = begun.pop("final_info", begun), begun.pop("final_obs")
                self.reset_infos[world] = begun
                infos[world] = {**last, "terminal_observation": final_observation}
        elif ended:
            for world in ended:
                infos[world]["terminal_observation"] = _row(observations, world)
            observations = self._reset_worlds(done, observations)
        for info, cut_short in zip(infos, truncated & ~terminated, strict=True):
            info["TimeLimit.truncated"] = bool(cut_short)
        return deepcopy(observations), rewards.astype(np.float32), done, infos

    def _reset_worlds(self, done: NDArray[np.bool_], last_observations: Any) -> Any:
        last_observations = deepcopy(last_observations)
        observations, infos = self.env.reset(options={"reset_mask": done})
        for before, after in zip(_leaves(last_observations), _leaves(observations), strict=True):
            if not np.array_equal(before[~done], after[~done]):
                raise ValueError(
                    f"{self.env} reset worlds that were not done: it does not understand reset_mask; "
                    "make it with autoreset_mode=AutoresetMode.SAME_STEP"
                )
        reset_infos = infos_by_world(infos, self.num_envs)
        for world in np.flatnonzero(done).tolist():
            self.reset_infos[world] = reset_infos[world]
        return observations

    def close(self) -> None:
        """Close the vector env."""
        self.env.close()

    def get_images(self) -> list[Any]:
        """The frames that the vector env renders, one a world."""
        return list(self.env.render() or ())

    def has_attr(self, attr_name: str) -> bool:
        """Whether every sub-environment, or the native vector env, has the attribute."""
        if self._has_sub_envs:
            return all(self.env.unwrapped.call("has_wrapper_attr", attr_name))  # type: ignore[attr-defined]
        return self._layer_with(attr_name) is not None

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """The attribute of the chosen worlds.

        Raises:
            AttributeError: There is no such attribute.
        """
        if not self.has_attr(attr_name):
            raise AttributeError(f"{self.env} has no attribute {attr_name!r}")
        if self._has_sub_envs:
            values = self.env.unwrapped.get_attr(attr_name)  # type: ignore[attr-defined]
        else:
            values = [getattr(self._layer_with(attr_name), attr_name)] * self.num_envs
        return [values[world] for world in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Set an attribute where it lives, the same value in all worlds.

        Raises:
            NotImplementedError: `indices` leaves worlds out.
        """
        self._require_all("set_attr", indices)
        if self._has_sub_envs:
            self.env.unwrapped.set_attr(attr_name, [value] * self.num_envs)  # type: ignore[attr-defined]
        else:
            setattr(self._layer_with(attr_name) or self.env, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of every sub-environment, or once of the native vector env (its result stands for all).

        Raises:
            AttributeError: There is no such method.
            NotImplementedError: `indices` leaves worlds out.
        """
        self._require_all("env_method", indices)
        if not self.has_attr(method_name):
            raise AttributeError(f"{self.env} has no method {method_name!r}")
        if self._has_sub_envs:
            return list(self.env.unwrapped.call(method_name, *method_args, **method_kwargs))  # type: ignore[attr-defined]
        result = getattr(self._layer_with(method_name), method_name)(*method_args, **method_kwargs)
        return [result] * self.num_envs

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: Indices = None) -> list[bool]:
        """Whether the sub-environments within reach (those of a `SyncVectorEnv`) carry the wrapper."""
        sub_envs = getattr(self.env.unwrapped, "envs", None)
        return [
            sub_envs is not None and is_wrapped(sub_envs[world], wrapper_class) for world in self._get_indices(indices)
        ]

    def _require_all(self, method: str, indices: Indices) -> None:
        if set(self._get_indices(indices)) != set(range(self.num_envs)):
            raise NotImplementedError(
                f"{method} reaches all {self.num_envs} worlds of a Gymnasium vector env or none, got indices={indices}"
            )

    def _layer_with(self, attr_name: str) -> Any:
        """The outermost vector wrapper that has the attribute, or the env itself, or None."""
        layer: Any = self.env
        while not hasattr(layer, attr_name):
            if not isinstance(layer, gym.vector.VectorWrapper):
                return None
            layer = layer.env
        return layer


def infos_by_world(infos: dict[str, Any], num_envs: int) -> list[dict[str, Any]]:
    """Gymnasium's dictionary of arrays as one dictionary a world; `_key` marks the worlds that have `key`."""
    by_world: list[dict[str, Any]] = [{} for _ in range(num_envs)]
    for key, values in infos.items():
        if key.startswith("_") and key[1:] in infos:
            continue
        rows = infos_by_world(values, num_envs) if isinstance(values, dict) else values
        for world in np.flatnonzero(infos.get(f"_{key}", np.ones(num_envs, dtype=bool))):
            by_world[world][key] = rows[world]
    return by_world


def _row(observations: Any, world: int) -> Any:
    """The observation of one world out of a batch, copied."""
    if isinstance(observations, dict):
        return {key: _row(value, world) for key, value in observations.items()}
    return observations[world].copy()


def _leaves(observations: Any) -> list[NDArray[Any]]:
    """The arrays of a batch of observations, whatever dictionaries they lie in."""
    if isinstance(observations, dict):
        return [leaf for value in observations.values() for leaf in _leaves(value)]
    return [observations]
