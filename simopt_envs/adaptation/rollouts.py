"""Running many episodes of a policy side by side, and what they leave behind."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv, VectorWrapper
from numpy.typing import NDArray

from simopt_envs.adaptation.protocols import Policy
from simopt_envs.measured.trajectory import Trajectory
from simopt_envs.physics.parameters import Array


@dataclass(frozen=True)
class Rollouts:
    """Episodes of up to T steps; the leading axes, here ``...``, count them.

    Attributes:
        observations: (..., T + 1, o), NaN after an episode's end and where a sensor dropped out.
        actions: (..., T, a), NaN after an episode's end.
        lengths: (...), steps of each episode.
        diverged: (...), whether the simulation broke down.
        success: (...), 1 where the episode ended in success, 0 where it did not, NaN where it was cut off before its
            end; None where the environment does not tell.
    """

    observations: Array
    actions: Array
    lengths: NDArray[np.int64]
    diverged: NDArray[np.bool_]
    success: Array | None

    @classmethod
    def concatenate(cls, parts: Sequence[Rollouts]) -> Rollouts:
        """Joined along the first axis; the shorter ones padded with NaN."""
        steps = max(part.actions.shape[-2] for part in parts)

        def padded(arrays: Iterable[Array], length: int) -> Array:
            return np.concatenate(
                [
                    np.pad(x, [*[(0, 0)] * (x.ndim - 2), (0, length - x.shape[-2]), (0, 0)], constant_values=np.nan)
                    for x in arrays
                ]
            )

        return cls(
            padded((part.observations for part in parts), steps + 1),
            padded((part.actions for part in parts), steps),
            np.concatenate([part.lengths for part in parts]),
            np.concatenate([part.diverged for part in parts]),
            None
            if any(part.success is None for part in parts)
            else np.concatenate([part.success for part in parts if part.success is not None]),
        )

    def map(self, function: Callable[[np.ndarray], np.ndarray]) -> Rollouts:
        """Every array sent through a function of its leading axes, to pick episodes or to reshape."""
        return Rollouts(
            function(self.observations),
            function(self.actions),
            function(self.lengths),
            function(self.diverged),
            None if self.success is None else function(self.success),
        )

    def trajectory(self, *index: int) -> Trajectory:
        """One of the episodes."""
        steps = int(self.lengths[index])
        success = None if self.success is None or np.isnan(self.success[index]) else bool(self.success[index])
        return Trajectory(self.observations[index][: steps + 1].copy(), self.actions[index][:steps].copy(), success)

    def success_rate(self) -> float | None:
        """The share of successes among the episodes of which it is known; None where it is of none."""
        known = None if self.success is None else self.success[np.isfinite(self.success)]
        return None if known is None or not known.size else float(known.mean())


def run_episodes(
    env: VectorEnv,
    policy: Policy,
    max_steps: NDArray[np.int64] | None = None,
    *,
    seed: list[int],
    options: dict[str, Any] | None = None,
    sensor: Callable[[Array], Array] | None = None,
) -> Rollouts:
    """Run one episode in every world of a vector environment that resets its worlds by itself in the next step.

    Args:
        env: n worlds.
        policy: decides on all of them at once.
        max_steps: where each episode is cut off, (n,); None leaves its end to the environment.
        seed: of each world's episode, n.
        options: of ``reset``.
        sensor: observations (n, o) -> what is measured of them, NaN where nothing is: there the policy goes on seeing
            the last value. None measures exactly.

    Returns:
        Rollouts with one leading axis, n.

    Raises:
        ValueError: for a policy that does not return one action per world.
    """
    measure = sensor or (lambda observation: observation)
    first, _ = env.reset(seed=seed, options=options)  # type: ignore[arg-type]  # a list, as every VectorEnv takes it
    seen = measure(np.array(first, dtype=np.float64))
    n = env.num_envs
    observations, actions = [seen], list[Array]()
    lengths = np.zeros(n, dtype=np.int64)
    limits = np.full(n, np.inf) if max_steps is None else max_steps
    running = limits > 0
    ended, diverged = np.zeros((2, n), dtype=bool)
    success: Array | None = None
    while running.any():
        action = np.asarray(policy.act(seen))
        if action.shape[:1] != (n,):
            raise ValueError(f"a policy must return one action for each of {n} observations, got shape {action.shape}")
        observation, _, terminated, truncated, info = env.step(action)
        measured = measure(np.array(observation, dtype=np.float64))
        observations.append(np.where(running[:, None], measured, np.nan))
        actions.append(np.where(running[:, None], action.reshape(n, -1), np.nan))
        seen = np.where(np.isnan(measured), seen, measured)
        lengths += running
        diverged |= running & np.asarray(info.get("diverged", False), dtype=bool)
        if "is_success" in info:
            success = np.zeros(n) if success is None else success
            success = np.where(running, np.asarray(info["is_success"], dtype=bool), success)
        ended |= running & (terminated | truncated)
        running &= ~ended & (len(actions) < limits)
    if success is not None:
        success = np.where(ended, success, np.nan)
    return Rollouts(np.stack(observations, 1), np.stack(actions, 1), lengths, diverged, success)


class Counted(VectorWrapper):
    """Reports the control steps taken in a vector environment."""

    def __init__(self, env: VectorEnv, count: Callable[[int], None]):
        super().__init__(env)
        self._count = count

    def step(self, actions: Any) -> Any:
        """As the environment's."""
        self._count(self.num_envs)
        return self.env.step(actions)


def require_measured(real: Sequence[Trajectory], names: Sequence[str]) -> None:
    """ValueError unless there are episodes, with channels of these names, that simulations can start from."""
    if not real:
        raise ValueError("the real system returned no trajectory")
    for i, trajectory in enumerate(real):
        if trajectory.observations.shape[1] != len(names):
            raise ValueError(
                f"real trajectory {i} has {trajectory.observations.shape[1]} observed channels, the simulator"
                f" {len(names)}: {', '.join(names)}"
            )
        if not np.isfinite(trajectory.observations[0]).all():
            raise ValueError(
                f"real trajectory {i} has no complete first observation, which simulations start from: "
                f"{trajectory.observations[0]}"
            )
