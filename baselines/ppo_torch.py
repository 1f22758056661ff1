"""Proximal policy optimisation (Schulman et al. 2017) in one file of PyTorch, for continuous actions.

Trains on any `gymnasium.vector.VectorEnv` with a flat `Box` observation and a `Box` action, on the CPU:

    python -m baselines.ppo_torch --env-id Pendulum-v1

From Python, `TorchPPO` is a trainer: a callable `(make_vector_env, policy | None, rng) -> policy`.

What differs from the plainest PPO, and why:

* Observations and value targets are normalised by running statistics, which belong to the policy and its checkpoint.
* The step size follows the KL divergence of each update, so that it needs no schedule and no tuning per task.
* A truncated episode bootstraps from the value of its own last observation, not from that of the next episode.
* After the rollout, one pass over the batch gives values and reference log-probabilities; acting needs the actor only.
* All randomness comes from the generator passed in: the same generator gives the same weights, bit for bit.
"""

import copy
import os
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

try:
    import torch
    import tyro
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as ProgressBar
    from torch import Tensor, nn
except ImportError as error:
    raise ImportError('baselines.ppo_torch needs torch, tyro and rich: pip install "simopt-envs[torch]"') from error

MakeVectorEnv = Callable[[int], VectorEnv]
Array = NDArray[np.float64]

_WIDEST = 1e3  # bounds farther apart only stand for "none": they do not tell how far an observation moves


@dataclass(frozen=True)
class PPOConfig:
    """Arguments of the algorithm; the defaults train the tasks of `simopt_envs` in about a minute.

    Raises:
        ValueError: A count that is not positive, or an evaluation share outside [0, 1).
    """

    num_envs: int = 64
    """Worlds stepped side by side."""
    num_steps: int = 50
    """Control steps of every world in one iteration; whole episodes, where all worlds end theirs together."""
    iterations: int = 300
    """Most iterations (rollout and update) of a training from scratch."""
    warm_start_iterations: int = 150
    """Most iterations of a training that continues from a given policy."""
    epochs: int = 10
    """Passes over the batch in one update."""
    minibatches: int = 5
    """Gradient steps in one pass."""
    gamma: float = 0.98
    """Discount factor."""
    gae_lambda: float = 0.95
    """Decay of generalised advantage estimation."""
    clip: float = 0.2
    """The probability ratio is clipped to 1 ± this."""
    entropy_weight: float = 0.0
    """Weight of the entropy bonus."""
    bound_weight: float = 0.5
    """Weight of the squared distance by which mean actions exceed their bounds. Beyond them, exploration noise is
    clipped away, and a policy that has to be trained further learns nothing."""
    target_kl: float = 0.04
    """KL divergence of one update that the step size aims at."""
    learning_rate: float = 1e-3
    """Step size of Adam at the start."""
    learning_rate_bounds: tuple[float, float] = (3e-4, 3e-3)
    """Least and greatest step size."""
    scale_floor: float = 0.01
    """Observations are scaled by their standard deviation, or by this share of their range if that is more.
    A range over 1000 wide is taken for none."""
    max_grad_norm: float = 1.0
    """Gradients are scaled down to this norm."""
    hidden: int = 64
    """Width of the two hidden layers of the actor, and of those of the critic."""
    initial_log_std: float = -0.3
    """Logarithm of the exploration noise at the start, where the action range is ±1."""
    stuck_iterations: int = 15
    """A training that continues from a given policy starts from scratch if no episode of the first so many iterations
    succeeds: with its little exploration noise it will not find out how, and new weights do in a minute or two."""
    success_stop: float | None = 0.97
    """Training ends early at this success rate (mean of `info["is_success"]` at episode ends, where the env has it)."""
    evaluation_share: float = 0.125
    """This share of the worlds, rounded down, acts without noise and is measured instead of learned from."""
    evaluation_episodes: int = 64
    """Return and success are those of the last so many measured episodes; without a share, of those learned from."""

    def __post_init__(self) -> None:
        for name in ("num_envs", "num_steps", "epochs", "minibatches", "hidden", "evaluation_episodes"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if not 0 <= self.evaluation_share < 1:
            raise ValueError(f"evaluation_share must be within [0, 1), got {self.evaluation_share}")


@dataclass(frozen=True)
class Progress:
    """Where a training stands after an iteration."""

    steps: int
    """Control steps so far, over all worlds."""
    total_steps: int
    """Control steps of the whole training, if it does not stop early."""
    episode_return: float
    """Mean undiscounted return of the last measured episodes; NaN before the first."""
    success: float
    """Mean success at the end of the same episodes; NaN where the env reports none."""
    kl: float
    """KL divergence of the last update; NaN before the first."""
    learning_rate: float
    """Step size of Adam for the next update."""
    seconds: float
    """Wall time so far."""


class RunningNormaliser(nn.Module):
    """Running mean and variance of a stream of vectors (Chan et al. 1979), in double precision.

    `floor` is the least scale of each number. Without one, a channel that hardly moved in training would have its
    sensor noise blown up, and throw the policy off as soon as it does move.
    """

    floor: Tensor
    mean: Tensor
    variance: Tensor
    count: Tensor

    def __init__(self, size: int, clip: float) -> None:
        super().__init__()
        self.clip = clip
        self.register_buffer("floor", torch.full((size,), 1e-4, dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("variance", torch.ones(size, dtype=torch.float64))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    def update(self, x: Tensor) -> None:
        """Take in a batch (n, size)."""
        total = self.count + len(x)
        weight = len(x) / total
        shift = x.mean(0) - self.mean
        spread = x.var(0, correction=0)
        self.variance += weight * (spread - self.variance) + weight * (1 - weight) * shift.square()
        self.mean += weight * shift
        self.count.copy_(total)

    @property
    def scale(self) -> Tensor:
        """Standard deviation, or the floor."""
        return self.variance.sqrt().maximum(self.floor)

    def forward(self, x: Tensor) -> Tensor:
        """Normalise (n, size) to single precision, clipped to ± `clip`."""
        return ((x - self.mean) / self.scale).clamp_(-self.clip, self.clip).float()

    def denormalise(self, x: Tensor) -> Tensor:
        """The inverse of `forward` inside the clip range, in double precision."""
        return x * self.scale + self.mean


class TorchPolicy(nn.Module):
    """A Gaussian policy with its critic and normalisers: all that a training needs to go on.

    The networks work in normalised actions, ±1 over the range of the action space (an unbounded dimension
    keeps its own unit). `act` is the way to use the policy.

    Args:
        observation_size: Numbers in an observation.
        action_low: Lower bounds of the action space.
        action_high: Upper bounds of the action space.
        hidden: Width of the two hidden layers of each network.
        initial_log_std: Logarithm of the exploration noise at the start.
        generator: Draws the initial weights.

    Attributes:
        steps_trained: Control steps taken to train this policy, over all its trainings.
        optimizer_state: State of Adam, to continue with; empty before the first training.
    """

    low: Tensor
    high: Tensor
    centre: Tensor
    half_range: Tensor
    bounded: Tensor

    def __init__(
        self,
        observation_size: int,
        action_low: list[float],
        action_high: list[float],
        hidden: int,
        initial_log_std: float,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.steps_trained = 0
        self.optimizer_state: dict[str, Any] = {}
        self.observation_size = observation_size
        self.hidden = hidden
        self.actor = _network(observation_size, hidden, len(action_low), output_gain=0.01, generator=generator)
        self.critic = _network(observation_size, hidden, 1, output_gain=1.0, generator=generator)
        self.log_std = nn.Parameter(torch.full((len(action_low),), initial_log_std))
        self.observation_normaliser = RunningNormaliser(observation_size, clip=10.0)
        self.value_normaliser = RunningNormaliser(1, clip=float("inf"))
        low, high = torch.tensor(action_low), torch.tensor(action_high)
        bounded = low.isfinite() & high.isfinite()
        for name, values in (
            ("low", low),
            ("high", high),
            ("centre", torch.where(bounded, (low + high) / 2, 0.0)),
            ("half_range", torch.where(bounded, (high - low) / 2, 1.0)),
            ("bounded", bounded),
        ):
            self.register_buffer(name, values, persistent=False)

    @torch.inference_mode()
    def act(self, observations: NDArray[np.floating]) -> NDArray[np.float32]:
        """The mean action of each observation: (n, observation_size) -> (n, action_size), within the bounds."""
        with one_torch_thread():  # more of them only wait for the simulation's
            return self.to_env(self.actor(self.observation_normaliser(_tensor(observations)))).numpy()

    def to_env(self, actions: Tensor) -> Tensor:
        """Normalised actions in the units of the action space, clipped into it."""
        return (self.centre + self.half_range * actions).clamp(self.low, self.high)

    @torch.inference_mode()
    def values(self, observations: Tensor) -> Tensor:
        """Discounted return expected from each observation: (..., observation_size) -> (...)."""
        return self.value_normaliser.denormalise(self.critic(self.observation_normaliser(observations))).squeeze(-1)


def _tensor(values: NDArray[np.floating] | Tensor) -> Tensor:
    """A copy in double precision where the values are, whatever their memory layout."""
    values = values if isinstance(values, Tensor) else torch.from_numpy(np.array(values, dtype=np.float64, order="C"))
    return values.to(torch.float64, copy=True)


def _network(inputs: int, hidden: int, outputs: int, output_gain: float, generator: torch.Generator) -> nn.Sequential:
    """Two tanh layers and a linear one, orthogonal weights, zero biases."""

    def linear(size_in: int, size_out: int, gain: float) -> nn.Linear:
        layer = nn.utils.skip_init(nn.Linear, size_in, size_out)  # the plain constructor draws from the global RNG
        nn.init.orthogonal_(layer.weight, gain, generator=generator)
        nn.init.zeros_(layer.bias)
        return layer

    return nn.Sequential(
        linear(inputs, hidden, 2**0.5),
        nn.Tanh(),
        linear(hidden, hidden, 2**0.5),
        nn.Tanh(),
        linear(hidden, outputs, output_gain),
    )


@dataclass(frozen=True)
class Rollout:
    """Transitions of T steps in n worlds, each tensor (T, n) or (T, n, size), where the env's observations are."""

    observations: Tensor
    actions: Tensor
    """Normalised actions before clipping."""
    rewards: Tensor
    successors: Tensor
    """What each step led to: at the end of an episode its own last observation."""
    terminated: Tensor
    done: Tensor
    """Terminated or truncated."""
    valid: Tensor
    """False where a step is not to be learned from: evaluation, or a mere reset (`AutoresetMode.NEXT_STEP`)."""


class Collector:
    """Steps a vector env with a policy and keeps score; episodes run on from one rollout to the next.

    Args:
        env: A vector env that resets its worlds by itself, in the same step or in the next.
        seed: Seed of the one explicit reset.
        evaluation_envs: The last so many worlds act without noise; their steps are not for learning, and
            `episodes` are theirs alone. With 0 the episodes of all worlds count.
        window: How many of the last episodes are remembered.

    Attributes:
        episodes: (return, success) of the last episodes; success is NaN where the env reports none.
        best_success: The best success of any episode, with or without noise; NaN where the env reports none.

    Raises:
        ValueError: The env does not say that it resets its worlds by itself.
    """

    def __init__(self, env: VectorEnv, seed: int, evaluation_envs: int, window: int) -> None:
        mode = env.metadata.get("autoreset_mode")
        if mode not in (AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP):
            raise ValueError(
                f"{env} must have metadata['autoreset_mode'] AutoresetMode.SAME_STEP or AutoresetMode.NEXT_STEP, "
                f"got {mode!r}"
            )
        self.env = env
        self.same_step = mode == AutoresetMode.SAME_STEP
        observation, _ = env.reset(seed=seed)
        self._observation = _tensor(observation)
        self.takes_tensors = isinstance(observation, Tensor)
        self.device = self._observation.device
        self.exploring = torch.arange(env.num_envs, device=self.device) < env.num_envs - evaluation_envs
        self.measured = ~self.exploring if evaluation_envs else self.exploring
        self.episodes: deque[tuple[float, float]] = deque(maxlen=window)
        self.best_success = float("nan")
        self._return = torch.zeros(env.num_envs, dtype=torch.float64, device=self.device)
        self._resets_next = torch.zeros_like(self.exploring)

    @torch.inference_mode()
    def collect(self, policy: TorchPolicy, noise: Tensor) -> Rollout:
        """Act for T steps with exploration noise (T, n, action_size), standard normal numbers."""
        steps, worlds = noise.shape[:2]
        observations = self._observation.new_empty((steps, worlds, policy.observation_size))
        successors, rewards = torch.empty_like(observations), observations.new_empty((steps, worlds))
        actions = torch.empty_like(noise)
        terminated, done, valid = (torch.empty_like(rewards, dtype=torch.bool) for _ in range(3))
        deviations = policy.log_std.exp() * noise * self.exploring.unsqueeze(-1)
        for t in range(steps):
            observations[t] = self._observation
            normalised = policy.observation_normaliser(self._observation)
            torch.add(policy.actor(normalised), deviations[t], out=actions[t])
            action = policy.to_env(actions[t])
            stepped = self.env.step(action if self.takes_tensors else action.numpy())
            observation, reward, over, truncated, infos = stepped
            rewards[t], terminated[t] = torch.as_tensor(reward), torch.as_tensor(over)
            done[t] = terminated[t] | torch.as_tensor(truncated)
            valid[t] = self.exploring & ~self._resets_next
            successors[t] = self._observation = _tensor(observation)
            ended = bool(done[t].any())
            if self.same_step and ended:
                final = infos["final_obs"]
                final = final[done[t]] if self.takes_tensors else np.stack(final[done[t].numpy()])
                successors[t, done[t]] = _tensor(final)
            elif not self.same_step:
                self._resets_next = done[t]
            self._return += rewards[t]
            if ended:
                self._keep_score(done[t], infos)
        return Rollout(observations, actions, rewards, successors, terminated, done, valid)

    def _keep_score(self, done: Tensor, infos: dict[str, Any]) -> None:
        # Gymnasium's own vector envs move the info of an episode's last step into final_info.
        reported = infos.get("final_info", infos).get("is_success", np.full(len(done), np.nan))
        success = reported.cpu().numpy() if isinstance(reported, Tensor) else reported
        returns, finished, measured = (x.cpu().numpy() for x in (self._return, done, self.measured))
        for world in np.flatnonzero(finished & measured):
            self.episodes.append((float(returns[world]), float(success[world])))
        self.best_success = float(np.fmax(self.best_success, np.max(success[finished])))
        self._return[done] = 0.0

    def score(self) -> tuple[float, float]:
        """Mean return and success of the remembered episodes; NaN before the first."""
        episode_return, success = np.mean(self.episodes, axis=0) if self.episodes else (np.nan, np.nan)
        return float(episode_return), float(success)


def generalised_advantages(
    rollout: Rollout, values: Tensor, successor_values: Tensor, gamma: float, gae_lambda: float
) -> Tensor:
    """Generalised advantage estimation (Schulman et al. 2016, Eq. 16), cut at the end of each episode.

    Args:
        rollout: T steps of n worlds.
        values: Value of each observation, (T, n).
        successor_values: Value of each successor, (T, n); counts as zero where the episode terminated.
        gamma: Discount factor.
        gae_lambda: Decay λ.

    Returns:
        Advantages (T, n); meaningless where `rollout.valid` is False.
    """
    errors = rollout.rewards + gamma * successor_values.where(~rollout.terminated, 0.0) - values
    decays = gamma * gae_lambda * (~rollout.done).double()
    advantages = torch.empty_like(errors)
    advantage = torch.zeros_like(errors[0])
    for t in reversed(range(len(errors))):
        advantage = advantages[t] = errors[t] + decays[t] * advantage
    return advantages


@dataclass(frozen=True)
class Batch:
    """What an update learns from, all single precision with B rows; `means` and `log_probs` before the update."""

    observations: Tensor
    actions: Tensor
    means: Tensor
    log_probs: Tensor
    advantages: Tensor
    value_targets: Tensor

    def shuffled(self, parts: int, generator: torch.Generator) -> Iterator["Batch"]:
        """Disjoint minibatches that together hold every row once."""
        columns = [getattr(self, column.name) for column in fields(self)]
        rows = len(self.actions)
        order = torch.randperm(rows, generator=generator).to(self.actions.device)
        for minibatch in zip(*(column[order].split(-(-rows // parts)) for column in columns), strict=True):
            yield Batch(*minibatch)


def log_prob(actions: Tensor, means: Tensor, log_std: Tensor) -> Tensor:
    """Log-density of a diagonal Gaussian, (n,), up to a constant."""
    return -0.5 * ((actions - means) * (-log_std).exp()).square().sum(-1) - log_std.sum()


@torch.no_grad()
def prepare(policy: TorchPolicy, rollout: Rollout, config: PPOConfig) -> Batch:
    """Take the rollout into the policy's normalisers and evaluate it: advantages, value targets, log-probabilities."""
    valid = rollout.valid
    if not (rollout.observations.isfinite().all() and rollout.rewards.isfinite().all()):
        raise ValueError("the env gave an observation or a reward that is not finite")
    raw = rollout.observations[valid]
    policy.observation_normaliser.update(raw)

    old_values, successor_values = policy.values(rollout.observations), policy.values(rollout.successors)
    advantages = generalised_advantages(rollout, old_values, successor_values, config.gamma, config.gae_lambda)
    returns = (advantages + old_values)[valid].unsqueeze(-1)
    policy.value_normaliser.update(returns)
    kept = advantages[valid]
    observations = policy.observation_normaliser(raw)
    actions, means = rollout.actions[valid], policy.actor(observations)
    return Batch(
        observations,
        actions,
        means,
        log_prob(actions, means, policy.log_std),
        ((kept - kept.mean()) / (kept.std() + 1e-8)).float(),
        policy.value_normaliser(returns).squeeze(-1),
    )


def update(
    policy: TorchPolicy, optimizer: torch.optim.Optimizer, batch: Batch, config: PPOConfig, generator: torch.Generator
) -> float:
    """Clipped policy gradient and value regression on the batch; returns the KL divergence from old to new policy."""
    old_log_std = policy.log_std.detach().clone()
    parameters = list(policy.parameters())
    for _ in range(config.epochs):
        for part in batch.shuffled(config.minibatches, generator):
            means = policy.actor(part.observations)
            ratio = (log_prob(part.actions, means, policy.log_std) - part.log_probs).exp()
            clipped = ratio.clamp(1 - config.clip, 1 + config.clip)
            gain = torch.minimum(ratio * part.advantages, clipped * part.advantages).mean()
            value_error = (policy.critic(part.observations).squeeze(-1) - part.value_targets).square().mean()
            excess = (policy.bounded * (means.abs() - 1).clamp(min=0)).square().sum(-1).mean()
            loss = (
                0.5 * value_error - gain - config.entropy_weight * policy.log_std.sum() + config.bound_weight * excess
            )
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(parameters, config.max_grad_norm)
            optimizer.step()
    with torch.no_grad():
        shift = policy.log_std - old_log_std
        squares = (2 * old_log_std).exp() + (batch.means - policy.actor(batch.observations)).square()
        return float((shift + 0.5 * squares * (-2 * policy.log_std).exp() - 0.5).sum(-1).mean())


def adapted_learning_rate(learning_rate: float, kl: float, config: PPOConfig) -> float:
    """A smaller step size after an update of over twice the target KL, a greater one after one of under half."""
    if kl > 2.0 * config.target_kl:
        learning_rate /= 1.5
    elif kl < 0.5 * config.target_kl:
        learning_rate *= 1.5
    return min(max(learning_rate, config.learning_rate_bounds[0]), config.learning_rate_bounds[1])


class TorchPPO:
    """A trainer: makes worlds, trains a policy in them, and gives it back.

    Args:
        config: The arguments of the algorithm.
        on_progress: Called after each iteration.
        checkpoint: File that holds the policy after each iteration, whatever happens later.
    """

    def __init__(
        self,
        config: PPOConfig = PPOConfig(),
        on_progress: Callable[[Progress], None] | None = None,
        checkpoint: Path | None = None,
    ) -> None:
        self.config = config
        self.on_progress = on_progress
        self.checkpoint = checkpoint

    def __call__(
        self, make_vector_env: MakeVectorEnv, policy: TorchPolicy | None, rng: np.random.Generator
    ) -> TorchPolicy:
        """Train from scratch, or a copy of `policy` further (weights, normalisers and optimiser go on).

        Args:
            make_vector_env: From a number of worlds to a vector env, which is closed at the end.
            policy: Where to start; None for new weights.
            rng: The source of all randomness.

        Raises:
            ValueError: The env does not reset by itself, does not fit the policy, gives numbers that are not
                finite.
            TypeError: An observation or action space that is not a one-dimensional `Box`.
        """
        with closing(make_vector_env(self.config.num_envs)) as env, one_torch_thread():
            return self._train(env, policy, rng)

    def _train(self, env: VectorEnv, policy: TorchPolicy | None, rng: np.random.Generator) -> TorchPolicy:
        config, start, warm = self.config, time.perf_counter(), policy is not None
        iterations = config.warm_start_iterations if warm else config.iterations
        steps_per_iteration = config.num_envs * config.num_steps
        generator = torch.Generator().manual_seed(int(rng.integers(2**63)))
        policy = _starting_policy(env, policy, config, generator)
        seed, evaluation_envs = int(rng.integers(2**31)), int(config.evaluation_share * config.num_envs)
        collector = Collector(env, seed, evaluation_envs, config.evaluation_episodes)
        policy.to(collector.device)
        optimizer = torch.optim.Adam(policy.parameters(), lr=config.learning_rate, fused=True)
        if policy.optimizer_state:
            optimizer.load_state_dict(policy.optimizer_state)

        kl = float("nan")
        for iteration in range(1, iterations + 1):
            noise = torch.randn((config.num_steps, config.num_envs, len(policy.log_std)), generator=generator)
            rollout = collector.collect(policy, noise.to(collector.device))
            policy.steps_trained += steps_per_iteration
            episode_return, success = collector.score()
            measured_enough = len(collector.episodes) == config.evaluation_episodes
            solved = config.success_stop is not None and measured_enough and success >= config.success_stop
            if not solved:  # else the policy stays what was measured: a single update can undo much
                kl = update(policy, optimizer, prepare(policy, rollout, config), config, generator)
                for group in optimizer.param_groups:
                    group["lr"] = adapted_learning_rate(group["lr"], kl, config)
                policy.optimizer_state = optimizer.state_dict()
            if self.checkpoint is not None:
                self.save(policy, self.checkpoint)
            if self.on_progress is not None:
                self.on_progress(
                    Progress(
                        steps=iteration * steps_per_iteration,
                        total_steps=iterations * steps_per_iteration,
                        episode_return=episode_return,
                        success=success,
                        kl=kl,
                        learning_rate=optimizer.param_groups[0]["lr"],
                        seconds=time.perf_counter() - start,
                    )
                )
            if solved:
                break
            if warm and iteration == config.stuck_iterations and collector.best_success == 0.0:
                afresh = self._train(env, None, rng)
                afresh.steps_trained += policy.steps_trained
                return afresh
        return policy.cpu()

    def save(self, policy: TorchPolicy, path: Path) -> None:
        """Write a policy with its optimiser; a file already there is replaced at once or not at all."""
        content = {
            "architecture": {
                "observation_size": policy.observation_size,
                "action_low": policy.low.tolist(),
                "action_high": policy.high.tolist(),
                "hidden": policy.hidden,
            },
            "state": policy.state_dict(),
            "optimizer_state": policy.optimizer_state,
            "steps_trained": policy.steps_trained,
        }
        save_atomically(content, path)

    def load(self, path: Path) -> TorchPolicy:
        """Read what `save` wrote.

        Raises:
            FileNotFoundError: No such file.
        """
        content = torch.load(path, weights_only=True, map_location="cpu")
        policy = TorchPolicy(**content["architecture"], initial_log_std=0.0, generator=torch.Generator())
        policy.load_state_dict(content["state"])
        policy.optimizer_state = content["optimizer_state"]
        policy.steps_trained = content["steps_trained"]
        return policy


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Small networks gain nothing from more threads, and the simulation wants the cores."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def save_atomically(content: dict[str, Any], path: Path) -> None:
    """`torch.save`, but a file already there is replaced as a whole or not at all."""
    path = Path(path)
    unfinished = path.with_name(path.name + ".tmp")
    torch.save(content, unfinished)
    os.replace(unfinished, path)


def _starting_policy(
    env: VectorEnv, policy: TorchPolicy | None, config: PPOConfig, generator: torch.Generator
) -> TorchPolicy:
    """New weights for the spaces of the env, or a copy of the policy if it fits them."""
    for name, space in (("observation", env.single_observation_space), ("action", env.single_action_space)):
        if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
            raise TypeError(f"TorchPPO needs a one-dimensional Box as {name} space, got {space}")
    observation_size = env.single_observation_space.shape[0]  # type: ignore[index]
    low, high = _single_precision_bounds(env.single_action_space)  # type: ignore[arg-type]
    if policy is None:
        fresh = TorchPolicy(observation_size, low, high, config.hidden, config.initial_log_std, generator)
        observed = env.single_observation_space
        width = torch.from_numpy(observed.high - observed.low).double()  # type: ignore[attr-defined]
        telling = width <= _WIDEST
        fresh.observation_normaliser.floor[telling] = config.scale_floor * width[telling]
        return fresh
    given = (policy.observation_size, policy.low.tolist(), policy.high.tolist())
    if given != (observation_size, low, high):
        raise ValueError(
            f"the given policy is for (observation size, action low, action high) {given}, "
            f"{env} has {(observation_size, low, high)}"
        )
    return copy.deepcopy(policy)


def _single_precision_bounds(space: gym.spaces.Box) -> tuple[list[float], list[float]]:
    """The bounds as the policy keeps them, rounded inwards: no action may lie outside a `Box` in double precision."""
    exact_low, exact_high = torch.tensor(space.low), torch.tensor(space.high)
    low, high = exact_low.float(), exact_high.float()
    return (
        low.where((low >= exact_low) | low.isinf(), low.nextafter(high)).tolist(),
        high.where((high <= exact_high) | high.isinf(), high.nextafter(low)).tolist(),
    )


def evaluate(policy: TorchPolicy, env: VectorEnv, seed: int) -> Array:
    """Undiscounted return of the first episode of each world under the mean action, (num_envs,)."""
    observation, _ = env.reset(seed=seed)
    returns, running = np.zeros(env.num_envs), np.ones(env.num_envs, dtype=bool)
    while running.any():
        observation, reward, terminated, truncated, _ = env.step(policy.act(observation))
        returns += reward * running
        running &= ~(terminated | truncated)
    return returns


@dataclass(frozen=True)
class Arguments:
    """Train a policy with PPO and save it."""

    env_id: str
    """A registered Gymnasium environment, such as Pendulum-v1 or SimOpt/Drawer-v0."""
    out: Path = Path("policy.pt")
    """File that holds the policy after each iteration."""
    warm_start: Path | None = None
    """File of a policy to continue from."""
    seed: int = 0
    """Seed of everything random."""
    vectorization_mode: Literal["sync", "async"] | None = None
    """How worlds run together; by default the env's own batched simulation, or else sync."""
    ppo: Annotated[PPOConfig, tyro.conf.arg(name="")] = field(default_factory=PPOConfig)


def _score(progress: Progress) -> str:
    success = "" if np.isnan(progress.success) else f"  success {progress.success:4.0%}"
    return f"return {progress.episode_return:9.2f}{success}"


def _line(progress: Progress) -> str:
    return (
        f"{progress.steps:>9} steps  {_score(progress)}  KL {progress.kl:.4f}  "
        f"step size {progress.learning_rate:.1e}  {progress.seconds:5.1f} s"
    )


def main(arguments: Arguments) -> None:
    """Train, save after each iteration, and print the mean return of 20 episodes without noise."""

    def make_vector_env(num_envs: int) -> VectorEnv:
        mode = arguments.vectorization_mode
        if mode is None and gym.spec(arguments.env_id).vector_entry_point is not None:
            return gym.make_vec(arguments.env_id, num_envs=num_envs)
        same_step = {"autoreset_mode": AutoresetMode.SAME_STEP}
        return gym.make_vec(arguments.env_id, num_envs, vectorization_mode=mode or "sync", vector_kwargs=same_step)

    rng = np.random.default_rng(arguments.seed)
    console = Console()
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    with ProgressBar(
        TextColumn("{task.description}"),
        BarColumn(),
        TimeRemainingColumn(),
        console=console,
        disable=not console.is_terminal,
    ) as bar:
        task = bar.add_task("training")

        def show(progress: Progress) -> None:
            if console.is_terminal:
                bar.update(task, description=_score(progress), completed=progress.steps, total=progress.total_steps)
            else:
                print(_line(progress), flush=True)

        trainer = TorchPPO(arguments.ppo, on_progress=show, checkpoint=arguments.out)
        start = None if arguments.warm_start is None else trainer.load(arguments.warm_start)
        try:
            policy = trainer(make_vector_env, start, rng)
        except KeyboardInterrupt:
            sys.exit(f"interrupted; {arguments.out} holds the policy after the last whole iteration")
    env = make_vector_env(20)
    returns = evaluate(policy, env, seed=int(rng.integers(2**31)))
    env.close()
    print(f"mean return of 20 episodes {returns.mean():.2f} ± {returns.std():.2f}; policy in {arguments.out}")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
