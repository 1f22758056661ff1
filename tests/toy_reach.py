"""A toy for the SimOpt loop, fast and exact: a mass on a line, a hidden constant force, a motor of hidden gain."""

import json
from pathlib import Path

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from simopt_envs.physics import Parameter, ParameterSpace

STEPS, DT, GOAL = 40, 0.1, 1.0
SPACE = ParameterSpace(
    [
        Parameter("gain", "N", 1.0, 0.1, 10.0),
        Parameter("force", "N", 0.0, -3.0, 3.0, coordinate="linear"),
        Parameter("drag", "N s/m", 1.0, 0.1, 10.0),
    ]
)
OBSERVATION, ACTION = spaces.Box(-np.inf, np.inf, (2,), np.float64), spaces.Box(-2.0, 2.0, (1,), np.float64)


def advance(state, action, xi, time, disturbance, latch=-np.inf):
    """One step of n worlds: states (n, 2), actions (n, 1), ξ (n, 3)."""
    push = xi[:, 0] * np.clip(action[:, 0], -2, 2) + xi[:, 1] - xi[:, 2] * state[:, 1]
    velocity = state[:, 1] + DT * (push + disturbance * np.sin(1.5 * DT * time))
    velocity = np.where(xi[:, 1] < latch, 0.0, velocity)
    return np.stack([state[:, 0] + DT * velocity, velocity], 1)


class ReachVectorEnv(gym.vector.VectorEnv):
    """Observation: position, velocity. Success: at the goal at the end. ``explode_above``: a gain that diverges."""

    def __init__(self, num_envs=1, autoreset_mode=AutoresetMode.NEXT_STEP, disturbance=0.0, explode_above=np.inf):
        self.num_envs, self.mode = num_envs, AutoresetMode(autoreset_mode)
        self.disturbance, self.explode_above = disturbance, explode_above
        self.parameters, self.parameter_source = SPACE, None
        self.single_observation_space, self.single_action_space = OBSERVATION, ACTION
        self.observation_space, self.action_space = batch_space(OBSERVATION, num_envs), batch_space(ACTION, num_envs)
        self.metadata = {"autoreset_mode": self.mode}
        self.rngs = [np.random.default_rng() for _ in range(num_envs)]

    def reset(self, *, seed=None, options=None):
        options = options or {}
        if seed is not None:
            seeds = [seed + i for i in range(self.num_envs)] if np.ndim(seed) == 0 else seed
            self.rngs = [np.random.default_rng(s) for s in seeds]
        self.state, self.xi, self.time = np.zeros((self.num_envs, 2)), np.tile(SPACE.nominal, (self.num_envs, 1)), 0
        self.done = np.zeros(self.num_envs, dtype=bool)
        self._begin(options.get("parameters"), options.get("initial_observation"))
        return self.state.copy(), {"parameters": self.xi.copy()}

    def _begin(self, xi=None, state=None):
        worlds, self.time = np.arange(self.num_envs), 0
        drawn = np.stack([rng.uniform(-0.2, 0.2, 2) for rng in self.rngs])
        self.state = drawn if state is None else np.array(state)
        if xi is None and self.parameter_source is not None:
            xi = self.parameter_source(worlds)
        self.xi = np.tile(SPACE.nominal, (self.num_envs, 1)) if xi is None else SPACE.validate(xi)

    def step(self, actions):
        zeros, over = np.zeros(self.num_envs), np.zeros(self.num_envs, dtype=bool)
        if self.mode is AutoresetMode.NEXT_STEP and self.done.any():
            assert self.done.all()  # all episodes have the same length
            self._begin()
            self.done = over
            return self.state.copy(), zeros, over, over.copy(), {"is_success": over, "diverged": over}
        self.state = advance(self.state, actions, self.xi, self.time, self.disturbance)
        self.time += 1
        success = np.abs(self.state[:, 0] - GOAL) < 0.05
        self.done = np.full(self.num_envs, self.time >= STEPS)
        info = {"is_success": success, "diverged": self.done & (self.xi[:, 0] > self.explode_above)}
        reward, done = -np.abs(self.state[:, 0] - GOAL), self.done
        if self.mode is AutoresetMode.SAME_STEP and done.all():
            info |= {"final_obs": np.array([*self.state, None], dtype=object)[:-1], "final_info": dict(info)}
            self._begin()
        return self.state.copy(), reward, over, done.copy(), info | {"parameters": self.xi.copy()}


class ReachEnv(gym.Env):
    """One world. ``latch``: the force that it takes to let go of the mass."""

    observation_space, action_space, parameters = OBSERVATION, ACTION, SPACE
    discrepancy_weights = np.array([1.0, 0.5])
    observation_names = ("position", "velocity")

    def __init__(self, disturbance=0.0, latch=-np.inf):
        self.disturbance, self.latch = disturbance, latch

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        options = options or {}
        self.xi = SPACE.values(options.get("parameters", {}))[None]
        self.state = np.random.default_rng(seed).uniform(-0.2, 0.2, 2)[None]
        if "initial_observation" in options:
            self.state = np.array(options["initial_observation"])[None]
        self.time = 0
        return self.state[0].copy(), {"parameters": SPACE.as_dict(self.xi[0])}

    def step(self, action):
        self.state = advance(self.state, np.asarray(action)[None], self.xi, self.time, self.disturbance, self.latch)
        self.time += 1
        distance = abs(self.state[0, 0] - GOAL)
        return self.state[0].copy(), -distance, False, self.time >= STEPS, {"is_success": bool(distance < 0.05)}


def parameter_array(info):
    """ξ (n, d) in force, from the info of a native vector environment or of one of single environments."""
    xi = info["parameters"]
    return np.stack([xi[name] for name in SPACE.names], axis=1) if isinstance(xi, dict) else xi


class PushPolicy:
    """Drives to the goal, and leans against a constant force."""

    def __init__(self, lean=0.0, trainings=0):
        self.lean, self.trainings = lean, trainings

    def act(self, observations):
        return 2.0 * (GOAL - observations[:, :1]) - 1.0 * observations[:, 1:] + self.lean


class LeanTrainer:
    """ "Trains" by looking at the ξ of some episodes: what lean holds the mass at the goal on average."""

    def __call__(self, make_vector_env, policy, rng):
        env = make_vector_env(64)
        _, info = env.reset(seed=int(rng.integers(2**31)))
        xi = parameter_array(info)
        for _ in range(STEPS):
            env.step(np.zeros((64, 1)))
        env.close()
        trainings = 0 if policy is None else policy.trainings
        return PushPolicy(float(-np.mean(xi[:, 1]) / np.mean(xi[:, 0])), trainings + 1)

    def save(self, policy, path):
        Path(path).write_text(json.dumps(vars(policy)))

    def load(self, path):
        return PushPolicy(**json.loads(Path(path).read_text()))


if "Toy/Reach-v0" not in gym.registry:
    gym.register("Toy/Reach-v0", entry_point=ReachEnv, vector_entry_point=ReachVectorEnv)
