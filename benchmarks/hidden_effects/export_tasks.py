"""Write the registered tasks for the benchmark: their nominal MJCF and what a trained policy commands in them.

    python -m benchmarks.hidden_effects.export_tasks --drawer POLICY --swingpeg POLICY

The only script here that imports the library; the benchmark itself reads the files that it writes: ``tasks/NAME.xml``,
and ``tasks/policies.npz`` with each task's commands in episodes of 60 ms steps (n, 50, nu) and starts (n, nq).
Policies are files of ``baselines.ppo_torch``. Their actions are disturbed a little, so that no two episodes are alike.
"""

from __future__ import annotations

import argparse
import re
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

import simopt_envs  # noqa: F401 - registers the environments
from baselines.ppo_torch import TorchPPO
from simopt_envs.tasks.swingpeg.model import make_spec

FOLDER = Path(__file__).with_name("tasks")
EPISODES = 48
TIMESTEP = 0.002
_DISTURBANCE = 0.15  # standard deviation of what is added to the actions, a walk that reverts within some steps


def write_model(spec: mujoco.MjSpec, name: str) -> None:
    """Write ``NAME.xml``: without what is there only to be seen, and with the benchmark's timestep."""
    model = spec.compile()
    for body in spec.bodies[1:]:  # masses that follow from the shapes of geoms are to be seen
        inertial = model.body(body.name)
        if not inertial.mass[0]:
            continue
        body.explicitinertial, body.mass, body.fullinertia = True, inertial.mass[0], np.full(6, np.nan)
        body.ipos, body.iquat, body.inertia = inertial.ipos, inertial.iquat, inertial.inertia
    for geom in list(spec.geoms):
        if geom.group == 2 and not geom.name:
            spec.delete(geom)
    for seen in (*spec.lights, *spec.cameras):
        spec.delete(seen)
    spec.option.timestep = TIMESTEP
    plain = re.sub(r' material="\w+"|\s*<(?:material|texture) [^>]*>', "", spec.to_xml())
    mujoco.MjModel.from_xml_string(plain)
    (FOLDER / f"{name}.xml").write_text(plain)


def export(env_id: str, spec: mujoco.MjSpec, policy_file: Path, name: str, seed: int = 0) -> dict[str, np.ndarray]:
    """Write ``NAME.xml`` and return the arrays for ``policies.npz``; episodes that fail are left out."""
    env: Any = gym.make(env_id)
    policy = TorchPPO().load(policy_file)
    write_model(spec, name)
    rng = np.random.default_rng(seed)
    commands: list[list[np.ndarray]] = []
    starts: list[np.ndarray] = []
    tried = 0
    while len(commands) < EPISODES and tried < 4 * EPISODES:
        observation, _ = env.reset(seed=1000 + tried)
        tried += 1
        start, episode, walk = env.unwrapped.data.qpos.copy(), [], np.zeros(env.action_space.sample().shape)
        for _ in range(50):
            walk = 0.8 * walk + _DISTURBANCE * 0.6 * rng.normal(size=walk.shape)
            action = np.clip(policy.act(observation[None])[0] + walk, -1, 1)
            observation, _, _, _, info = env.step(action.astype(np.float32))
            episode.append(env.unwrapped.data.ctrl.copy())
        if info["is_success"]:
            commands.append(episode)
            starts.append(start)
    print(f"{name}: {len(commands)} of {tried} episodes succeeded")
    return {f"{name}_commands": np.array(commands), f"{name}_starts": np.array(starts)}


def main() -> None:
    parser = argparse.ArgumentParser(description="Export the registered tasks.")
    parser.add_argument("--drawer", type=Path, required=True)
    parser.add_argument("--swingpeg", type=Path, required=True)
    arguments = parser.parse_args()
    FOLDER.mkdir(exist_ok=True)
    with as_file(files("simopt_envs.tasks.drawer")) as folder:
        drawer = mujoco.MjSpec.from_file(str(folder / "model.xml"))
    arrays = export("SimOpt/Drawer-v0", drawer, arguments.drawer, "drawer")
    swingpeg = make_spec()
    for pair in list(swingpeg.pairs):  # past the box: after a knock nothing repeats
        swingpeg.delete(pair)
    arrays |= export("SimOpt/SwingPeg-v0", swingpeg, arguments.swingpeg, "swingpeg")
    single = {name: array.astype(np.float32) for name, array in arrays.items()}
    np.savez_compressed(FOLDER / "policies.npz", allow_pickle=False, **single)


if __name__ == "__main__":
    main()
