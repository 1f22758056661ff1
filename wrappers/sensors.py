"""What measuring adds to an observation: noise, delay, drop-outs.

In vector environments, wrap the sub-environments. Each sensor has a generator of its own, seeded by a seeded ``reset``
and apart from the environment's and those of other sensors, so that the same seed gives the same motion with and
without it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import ArrayLike, NDArray


class _Sensor(gym.Wrapper, RecordConstructorArgs):
    """An environment seen through a sensor.

    Args:
        env: the environment.
        stream: a number that sets the sensor's generator apart from those of other kinds of sensor.
        arguments: those of the subclass, to be recorded.
    """

    def __init__(self, env: gym.Env, stream: int, **arguments: Any):
        RecordConstructorArgs.__init__(self, **arguments)
        super().__init__(env)
        beneath, layer = 0, env
        while isinstance(layer, gym.Wrapper):
            beneath += isinstance(layer, _Sensor) and layer._spawn_key[0] == stream
            layer = layer.env
        self._spawn_key: tuple[int, ...] = (stream, beneath) if beneath else (stream,)
        self._rng = np.random.default_rng()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; a seed restarts the sensor's generator as well."""
        observation, info = self.env.reset(seed=seed, options=options)
        if seed is not None:
            self._rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=self._spawn_key))
        return self._first(observation), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment and measure."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._next(observation), reward, terminated, truncated, info

    def _first(self, observation: NDArray[Any]) -> NDArray[Any]:
        """Measure the first observation of an episode."""
        raise NotImplementedError

    def _next(self, observation: NDArray[Any]) -> NDArray[Any]:
        """Measure a later one."""
        raise NotImplementedError


class SensorNoise(_Sensor):
    """Adds independent Gaussian noise to each channel of each observation.

    As noise knows no bounds, the observation space has none.

    Args:
        env: an environment with Box observations of one axis, (o,).
        std: a number or (o,), not negative, in the units of the channels.
    """

    def __init__(self, env: gym.Env, std: ArrayLike):
        super().__init__(env, stream=1, std=std)
        space = _channels(env)
        self._std = np.asarray(std, dtype=np.float64)
        if self._std.shape not in ((), space.shape) or not (np.isfinite(self._std) & (self._std >= 0)).all():
            raise ValueError(f"std must be a number or {space.shape}, finite and not negative, got {std!r}")
        self.observation_space = spaces.Box(-np.inf, np.inf, space.shape, space.dtype.type)

    def _first(self, observation: NDArray[Any]) -> NDArray[Any]:
        return self._next(observation)

    def _next(self, observation: NDArray[Any]) -> NDArray[Any]:
        return (observation + self._std * self._rng.standard_normal(observation.shape)).astype(observation.dtype)


class SensorDelay(_Sensor):
    """Shows each observation some steps late; until then an episode shows its first one.

    Args:
        env: the environment.
        steps: how many steps late, at least 0.
    """

    def __init__(self, env: gym.Env, steps: int):
        super().__init__(env, stream=2, steps=steps)
        if steps != int(steps) or steps < 0:
            raise ValueError(f"steps must be a whole number, not negative, got {steps}")
        self._length = int(steps) + 1
        self._buffer: deque[NDArray[Any]] = deque(maxlen=self._length)

    def _first(self, observation: NDArray[Any]) -> NDArray[Any]:
        self._buffer.extend([observation] * self._length)
        return observation

    def _next(self, observation: NDArray[Any]) -> NDArray[Any]:
        self._buffer.append(observation)
        return self._buffer[0]


class SensorDropout(_Sensor):
    """Loses tracked channels now and then: in such a step they are all NaN, as from a tracker without sight.

    The first observation of an episode is complete: it begins once everything is in sight. NaN lies in no observation
    space.

    Args:
        env: an environment with Box observations of one axis, (o,).
        probability: of a drop-out in a step, within [0, 1].
        channels: indices of the tracked channels; None: all.
    """

    def __init__(self, env: gym.Env, probability: float, channels: Sequence[int] | None = None):
        super().__init__(env, stream=3, probability=probability, channels=channels)
        size = _channels(env).shape[0]
        if not 0 <= probability <= 1:
            raise ValueError(f"probability must lie within 0 and 1, got {probability}")
        self._channels = np.arange(size) if channels is None else np.asarray(channels, dtype=np.intp)
        if self._channels.ndim != 1 or ((self._channels < 0) | (self._channels >= size)).any():
            raise ValueError(f"channels must be indices from 0 to {size - 1}, got {channels}")
        self._probability = probability

    def _first(self, observation: NDArray[Any]) -> NDArray[Any]:
        return observation

    def _next(self, observation: NDArray[Any]) -> NDArray[Any]:
        if self._rng.random() < self._probability:
            observation = observation.copy()
            observation[self._channels] = np.nan
        return observation


def _channels(env: gym.Env) -> spaces.Box:
    """The space of the observations; TypeError where they are not floats along one axis."""
    space = env.observation_space
    if not isinstance(space, spaces.Box) or len(space.shape) != 1 or not np.issubdtype(space.dtype, np.floating):
        raise TypeError(f"the sensor needs observations that are a Box of floats with one axis, got {space}")
    return space
