"""The drawer task: its contract, its physics, and that only a grasp and a pull solve it."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from conftest import needs_batch
from gymnasium.utils.env_checker import check_env

import simopt_envs  # noqa: F401 - registers the environments
from simopt_envs.tasks.arm import JOINTS

ENV_ID = "SimOpt/Drawer-v0"


def scripted_pull(env, speed=0.35, pull=True):
    """Reach for the handle, close the gripper, draw it back: resolved-rate control by the arm's Jacobian."""
    model, data = env.unwrapped.model, env.unwrapped.data
    grasp, handle = model.site("grasp").id, model.site("handle").id
    upright = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]], dtype=float)  # fingers forward, one above the other
    scaling = model.numeric("action_scaling").data
    jacobian = np.zeros((2, 3, model.nv))
    closed_for, success = 0, []
    for _ in range(50):
        to_handle = data.site_xpos[handle] - data.site_xpos[grasp]
        quat, turn = np.zeros(4), np.zeros(3)
        mujoco.mju_mat2Quat(quat, (upright @ data.site_xmat[grasp].reshape(3, 3).T).ravel())
        mujoco.mju_quat2Vel(turn, quat, 1.0)
        if closed_for == 0:
            velocity = np.clip(6 * to_handle, -0.6, 0.6)
        else:
            pulling = pull and closed_for >= 5 and data.joint("drawer").qpos[0] < 0.25
            velocity = np.array([-speed, *(2 * to_handle[1:])]) if pulling else 3 * to_handle
        closed_for += closed_for > 0 or np.linalg.norm(to_handle) < 0.012
        mujoco.mj_jacSite(model, data, jacobian[0], jacobian[1], grasp)
        j = jacobian.reshape(6, -1)[:, :7]
        joints = j.T @ np.linalg.solve(j @ j.T + 1e-3 * np.eye(6), np.concatenate([velocity, 4 * turn]))
        action = np.append(joints / scaling, -1.0 if closed_for else 1.0)
        *_, info = env.step(np.clip(action, -1, 1))
        success.append(info["is_success"])
    return success


def test_gymnasiums_check_passes_without_a_warning(recwarn):
    check_env(gym.make(ENV_ID).unwrapped, skip_render_check=True)
    assert [str(w.message) for w in recwarn] == []


def test_contract_of_spaces_and_horizon():
    env = gym.make(ENV_ID)
    assert env.observation_space.shape == (10,)
    assert env.action_space == gym.spaces.Box(-1, 1, (8,), np.float32)
    observation, info = env.reset(seed=0, options={"parameters": {"cabinet_x": 0.1}})
    assert info["parameters"]["cabinet_x"] == 0.1
    np.testing.assert_allclose(observation[7:], env.unwrapped.data.site("handle").xpos)
    for step in range(50):
        *_, terminated, truncated, info = env.step(env.action_space.sample())
        assert "is_success" in info
        assert not terminated
        assert truncated == (step == 49)


def test_paper_dimensions_are_there():
    names = gym.make(ENV_ID).unwrapped.parameters.names
    per_joint = [f"{p}_{i}" for p in ("joint_gain", "joint_damping", "action_scaling") for i in range(1, 8)]
    drawer = ["drawer_stiffness", "drawer_damping", "drawer_friction", "drawer_mass", "handle_friction"]
    assert {
        *per_joint,
        *drawer,
        "gripper_gain",
        "gripper_damping",
        "latency",
        "cabinet_x",
        "cabinet_y",
        "cabinet_z",
    } == {*names}


@pytest.mark.parametrize("cabinet_x", [0.0, 0.15, 0.22])
def test_a_grasp_and_a_pull_succeed(cabinet_x):
    env = gym.make(ENV_ID)
    env.reset(seed=0, options={"parameters": {"cabinet_x": cabinet_x}})
    success = scripted_pull(env)
    assert success[-1]
    assert not any(success[:15])


def test_holding_without_pulling_does_not_succeed():
    env = gym.make(ENV_ID)
    env.reset(seed=0)
    assert not any(scripted_pull(env, pull=False))


def test_an_open_drawer_out_of_the_gripper_does_not_count():
    env = gym.make(ENV_ID)
    env.reset(seed=0)
    env.unwrapped.data.qpos[env.unwrapped.model.joint("drawer").qposadr[0]] = 0.25
    *_, info = env.step(np.zeros(8))
    assert not info["is_success"]


@pytest.mark.parametrize("speed", [0.5, 1.0, 2.0])
def test_a_flung_drawer_stops_short(speed):
    """Faster than the arm can jerk it (0.6 m/s), and still not open."""
    env = gym.make(ENV_ID).unwrapped
    env.reset(seed=0)
    env.data.joint("drawer").qvel[0] = speed
    for _ in range(50):
        env.step(np.zeros(8))
    assert env.data.joint("drawer").qpos[0] < 0.2


def motion(name, value, steps=2):
    """Where everything is, after some pushes at the arm, the gripper and the drawer."""
    env = gym.make(ENV_ID).unwrapped
    env.reset(seed=0, options={"parameters": {name: value}} if name else {})
    env.data.joint("drawer").qvel[0] = 0.5
    for _ in range(steps):
        env.step(np.full(8, -0.5))
    return np.concatenate([env.data.qpos, env.data.site("handle").xpos])


def test_every_parameter_changes_the_motion_that_it_names():
    env = gym.make(ENV_ID).unwrapped
    space, model = env.parameters, env.model
    arm = [int(model.joint(j).qposadr[0]) for j in JOINTS]
    drawer = int(model.joint("drawer").qposadr[0])
    nominal = motion(None, None)
    for p in space:
        if p.name == "handle_friction":  # needs a grasp: see the next test
            continue
        value = 0.7 * p.high if p.coordinate == "linear" else 2 * p.nominal
        change = np.abs(motion(p.name, value) - nominal)
        if p.name.startswith(("joint", "action", "latency")):
            assert change[arm].max() > 1e-4, p.name
            assert change[drawer] < 1e-9, p.name
        elif p.name.startswith("gripper"):
            assert change[7:9].max() > 1e-5, p.name
            assert change[drawer] < 1e-9, p.name
        elif p.name.startswith("drawer"):
            assert change[drawer] > 1e-5, p.name
            assert change[arm].max() < 1e-9, p.name
        else:  # the cabinet's place
            expected = np.zeros(3)
            expected["xyz".index(p.name[-1])] = value
            np.testing.assert_allclose((motion(p.name, value) - nominal)[-3:], expected, atol=1e-9)
            assert change[:-3].max() < 1e-9, p.name


@pytest.mark.parametrize(("friction", "succeeds"), [(1.0, True), (0.12, False)])
def test_a_slippery_handle_slips(friction, succeeds):
    env = gym.make(ENV_ID)
    env.reset(seed=0, options={"parameters": {"handle_friction": friction}})
    assert scripted_pull(env)[-1] == succeeds


@needs_batch
def test_single_equals_batched_through_a_grasp():
    rng = np.random.default_rng(0)
    actions = np.clip(rng.normal([0.2, 0.6, 0, 0.5, 0, 0, 0, 1], 0.5, (50, 3, 8)), -1, 1)
    venv = gym.make_vec(ENV_ID, num_envs=3)
    low, high = venv.unwrapped.parameters.low, venv.unwrapped.parameters.high
    nominal = venv.unwrapped.parameters.nominal
    xi = np.clip(nominal * rng.uniform(0.8, 1.25, (3, len(nominal))), low, high)
    many = [venv.reset(seed=3, options={"parameters": xi})[0]]
    rewards = []
    for a in actions:
        observation, reward, *_ = venv.step(a)
        many.append(observation)
        rewards.append(reward)
    for world in range(3):
        env = gym.make(ENV_ID)
        named = dict(zip(venv.unwrapped.parameters.names, xi[world], strict=True))
        one = [env.reset(seed=3 + world, options={"parameters": named})[0]]
        for step, a in enumerate(actions):
            observation, reward, *_ = env.step(a[world])
            one.append(observation)
            assert reward == pytest.approx(rewards[step][world], abs=1e-9)
        np.testing.assert_allclose(np.array(many)[:, world], one, atol=1e-9)


@needs_batch
@pytest.mark.parametrize(("num_envs", "num_threads"), [(16, 1), (16, 2), (256, 1), (256, 2)])
def test_a_world_does_not_depend_on_how_many_there_are(num_envs, num_threads):
    actions = np.random.default_rng(1).uniform(-1, 1, (30, num_envs, 8))
    alone = gym.make_vec(ENV_ID, num_envs=1, num_threads=1)
    among = gym.make_vec(ENV_ID, num_envs=num_envs, num_threads=num_threads)
    np.testing.assert_array_equal(alone.reset(seed=7)[0][0], among.reset(seed=7)[0][0])
    for a in actions:
        np.testing.assert_array_equal(alone.step(a[:1])[0][0], among.step(a)[0][0])


def test_rendering_gives_a_picture_or_says_what_is_missing():
    env = gym.make(ENV_ID, render_mode="rgb_array")
    env.reset(seed=0)
    try:
        image = env.render()
    except RuntimeError as error:
        assert "OpenGL" in str(error) or "rendering needs" in str(error)  # noqa: PT017
        pytest.skip(f"no OpenGL: {error}")
    assert image.shape == (480, 640, 3)
    assert image.std() > 20
