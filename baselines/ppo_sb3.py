"""Stable-Baselines3 as a trainer: its PPO by default, its other algorithms for continuous actions alike.

    trainer = SB3()
    trainer = SB3(SAC, total_timesteps=200_000, num_envs=8, learning_starts=1000)

Like `baselines.ppo_torch.TorchPPO`, a trainer is a callable `(make_vector_env, policy | None, rng) -> policy`.
"""

import copy
import random
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

try:
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.policies import BasePolicy
    from stable_baselines3.common.running_mean_std import RunningMeanStd
    from stable_baselines3.common.vec_env import VecMonitor, VecNormalize
except ImportError as error:
    raise ImportError('baselines.ppo_sb3 needs Stable-Baselines3: pip install "simopt-envs[sb3]"') from error

from baselines.ppo_torch import MakeVectorEnv, one_torch_thread, save_atomically
from baselines.sb3_vec_env import SB3VecEnv
from simopt_envs.adaptation.checkpoint import identity

PPO_DEFAULTS: Mapping[str, Any] = {
    "n_steps": 50,
    "batch_size": 1280,
    "n_epochs": 10,
    "gamma": 0.98,
    "learning_rate": 1e-3,
    "target_kl": 0.02,
    "policy_kwargs": {"log_std_init": -0.7},
}
"""Arguments that differ from SB3's own, chosen for many worlds and short episodes."""

CLIP = 10.0
EPSILON = 1e-8


@dataclass(frozen=True)
class SB3Policy:
    """A policy that SB3 trained, with what is needed to act and to train on.

    Attributes:
        network: SB3's policy.
        parameters: State of all networks and optimisers of the algorithm.
        observation_statistics: Running mean and variance that observations are normalised by.
        return_statistics: Those of the discounted return, by which rewards are scaled.
        steps_trained: Control steps over all trainings.
        variables: What the algorithm learns beside its networks, by name: SAC's entropy coefficient.
    """

    network: BasePolicy
    parameters: dict[str, Any]
    observation_statistics: RunningMeanStd
    return_statistics: RunningMeanStd
    steps_trained: int
    variables: dict[str, torch.Tensor] = field(default_factory=dict)

    def act(self, observations: NDArray[np.floating]) -> NDArray[np.float32]:
        """The mean action of each observation: (n, observation_size) -> (n, action_size), within the bounds."""
        statistics = self.observation_statistics
        normalised = (observations - statistics.mean) / np.sqrt(statistics.var + EPSILON)
        return self.network.predict(np.clip(normalised, -CLIP, CLIP), deterministic=True)[0]


class SB3:
    """A trainer around any Stable-Baselines3 algorithm for continuous actions.

    Observations are normalised and rewards scaled by SB3's `VecNormalize`. SB3 draws from the global generators of
    Python, NumPy and PyTorch; each call seeds them from its `rng`, and leaves them as they were.

    Args:
        algorithm: The class, such as `PPO` or `SAC`.
        total_timesteps: Control steps, over all worlds, of a training from scratch.
        warm_start_timesteps: Those of a training that continues from a given policy; None for as many again.
        num_envs: Worlds side by side.
        policy: SB3's name of the network.
        **kwargs: Arguments of the algorithm; those of PPO that are not given come from `PPO_DEFAULTS`.
    """

    def __init__(
        self,
        algorithm: type[BaseAlgorithm] = PPO,
        total_timesteps: int = 400_000,
        warm_start_timesteps: int | None = None,
        num_envs: int = 128,
        policy: str = "MlpPolicy",
        **kwargs: Any,
    ) -> None:
        self.algorithm = algorithm
        self.total_timesteps = total_timesteps
        self.warm_start_timesteps = total_timesteps if warm_start_timesteps is None else warm_start_timesteps
        self.num_envs = num_envs
        self.policy = policy
        self.kwargs = {"device": "cpu", **(PPO_DEFAULTS if algorithm is PPO else {}), **kwargs}

    def __call__(self, make_vector_env: MakeVectorEnv, policy: SB3Policy | None, rng: np.random.Generator) -> SB3Policy:
        """Train from scratch, or go on from the networks, optimisers and statistics of `policy`, which stays as it is.

        Args:
            make_vector_env: From a number of worlds to a vector env, which is closed at the end.
            policy: Where to start; None for new weights.
            rng: Seeds SB3's own generators.
        """
        with untouched_generators(), closing(make_vector_env(self.num_envs)) as env, one_torch_thread():
            model, worlds = self._model(env, seed=int(rng.integers(2**31)))
            if policy is not None:
                model.set_parameters(copy.deepcopy(policy.parameters))  # Adam goes on in the very tensors it is given
                _set_variables(model, policy.variables)
                worlds.obs_rms = policy.observation_statistics.copy()  # type: ignore[assignment]
                worlds.ret_rms = policy.return_statistics.copy()
            model.learn(self.total_timesteps if policy is None else self.warm_start_timesteps)
        return SB3Policy(
            network=model.policy,
            parameters=model.get_parameters(),
            observation_statistics=cast(RunningMeanStd, worlds.obs_rms),
            return_statistics=worlds.ret_rms,
            steps_trained=model.num_timesteps + (0 if policy is None else policy.steps_trained),
            variables=_variables(model),
        )

    def identity(self) -> dict[str, Any]:
        """What identifies it in a checkpoint: its type and all arguments."""
        return {"type": identity(type(self)), **identity(vars(self))}

    def save(self, policy: SB3Policy, path: Path) -> None:
        """Write a policy as plain tensors; a file already there is replaced at once or not at all."""
        content = {
            "spaces": [_describe(policy.network.observation_space), _describe(policy.network.action_space)],
            "parameters": policy.parameters,
            "variables": policy.variables,
            "observation_statistics": _to_tensors(policy.observation_statistics),
            "return_statistics": _to_tensors(policy.return_statistics),
            "steps_trained": policy.steps_trained,
        }
        save_atomically(content, path)

    def load(self, path: Path) -> SB3Policy:
        """Read what `save` of a trainer with the same algorithm and network wrote.

        Raises:
            FileNotFoundError: No such file.
        """
        content = torch.load(path, weights_only=True)
        spaces_only = VectorEnv()
        spaces_only.num_envs = self.num_envs
        spaces_only.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        spaces_only.single_observation_space, spaces_only.single_action_space = map(_box, content["spaces"])
        with untouched_generators():
            model, _ = self._model(spaces_only, seed=0)
        model.set_parameters(content["parameters"])
        return SB3Policy(
            network=model.policy,
            parameters=model.get_parameters(),
            observation_statistics=_from_tensors(content["observation_statistics"]),
            return_statistics=_from_tensors(content["return_statistics"]),
            steps_trained=content["steps_trained"],
            variables=content.get("variables", {}),  # which older files lack
        )

    def _model(self, env: VectorEnv, seed: int) -> tuple[BaseAlgorithm, VecNormalize]:
        gamma = self.kwargs.get("gamma", 0.99)
        worlds = VecNormalize(VecMonitor(SB3VecEnv(env)), gamma=gamma, clip_obs=CLIP, epsilon=EPSILON)
        return self.algorithm(self.policy, worlds, seed=seed, **self.kwargs), worlds


@contextmanager
def untouched_generators() -> Iterator[None]:
    """Put the global generators of Python, NumPy and PyTorch back as they were: SB3 seeds them all."""
    python, numpy = random.getstate(), np.random.get_state()  # noqa: NPY002 - the very generator SB3 draws from
    gpus = range(torch.cuda.device_count() if torch.cuda.is_initialized() else 0)
    try:
        with torch.random.fork_rng(gpus):
            yield
    finally:
        random.setstate(python)
        np.random.set_state(numpy)  # noqa: NPY002


def _variables(model: BaseAlgorithm) -> dict[str, torch.Tensor]:
    """Copies of the tensors that are learned and that `get_parameters` leaves out."""
    tensors = {name: attrgetter(name)(model) for name in model._get_torch_save_params()[1]}
    return {name: tensor.detach().clone() for name, tensor in tensors.items() if tensor.requires_grad}


@torch.no_grad()
def _set_variables(model: BaseAlgorithm, variables: Mapping[str, torch.Tensor]) -> None:
    for name, tensor in variables.items():
        attrgetter(name)(model).copy_(tensor)


def _describe(space: gym.Space) -> dict[str, Any]:
    if not isinstance(space, gym.spaces.Box):
        raise TypeError(f"only Box spaces can be saved, got {space}")
    return {"low": space.low.tolist(), "high": space.high.tolist(), "dtype": str(space.dtype)}


def _box(description: dict[str, Any]) -> gym.spaces.Box:
    dtype = np.dtype(description["dtype"])
    return gym.spaces.Box(np.array(description["low"], dtype), np.array(description["high"], dtype), dtype=dtype.type)


def _to_tensors(statistics: RunningMeanStd) -> dict[str, Any]:
    return {
        "mean": torch.as_tensor(statistics.mean),
        "var": torch.as_tensor(statistics.var),
        "count": float(statistics.count),
    }


def _from_tensors(content: dict[str, Any]) -> RunningMeanStd:
    statistics = RunningMeanStd()
    statistics.mean, statistics.var, statistics.count = (
        content["mean"].numpy(),
        content["var"].numpy(),
        content["count"],
    )
    return statistics
