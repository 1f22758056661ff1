"""The swing-peg task: its contract, its physics under ξ, and its judgement."""

from dataclasses import replace

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from conftest import needs_batch
from gymnasium.utils.env_checker import check_env
from scipy.optimize import minimize

import simopt_envs  # noqa: F401 - registers the environments
from simopt_envs.physics.simulation import SingleSimulation
from simopt_envs.physics.writer import ModelWriter
from simopt_envs.tasks.arm import JOINTS
from simopt_envs.tasks.env import TaskEnv
from simopt_envs.tasks.swingpeg.model import LENGTH_FACTOR, SEGMENTS, WALLS, Dimensions, make_model, make_spec
from simopt_envs.tasks.swingpeg.parameters import swingpeg_parameters
from simopt_envs.tasks.swingpeg.task import SwingPegTask

ENV_ID = "SimOpt/SwingPeg-v0"
NOMINAL = Dimensions()


@pytest.fixture(scope="module")
def task():
    return SwingPegTask()


def written(parameters, dimensions=NOMINAL):
    """The model as ξ makes it from the nominal one."""
    model = make_model()
    space = swingpeg_parameters(model)
    ModelWriter(model, space).write_model(space.values(parameters), model, mujoco.MjData(model))
    return model


def compiled_with_box(scale):
    spec = make_spec()
    for part in (*(spec.geom(wall) for wall in WALLS), spec.site("hole")):
        part.pos, part.size = scale * part.pos, scale * part.size
    return spec.compile()


COMPILED = {
    "rope_width": (1.5, lambda d: make_model(replace(d, rope_width=1.5 * d.rope_width))),
    "rope_segment_length": (0.7, lambda d: make_model(replace(d, rope_segment_length=0.7 * d.rope_segment_length))),
    "rope_density": (3.0, lambda d: make_model(replace(d, rope_density=3.0 * d.rope_density))),
    "peg_density": (2.0, lambda d: make_model(replace(d, peg_density=2.0 * d.peg_density))),
    "peg_mass": (2.0, lambda d: make_model(replace(d, peg_density=2.0 * d.peg_density))),
    "peg_scale": (
        1.3,
        lambda d: make_model(replace(d, peg_radius=1.3 * d.peg_radius, peg_length=1.3 * d.peg_length)),
    ),
    "box_scale": (1.4, lambda d: compiled_with_box(1.4)),
    "peg_friction": (3.0, lambda d: make_model(replace(d, peg_friction=3.0 * d.peg_friction))),
    "rope_friction": (3.0, lambda d: make_model(replace(d, rope_friction=3.0 * d.rope_friction))),
    **{
        f"rope_{bend}_{kind}": (
            2.0,
            lambda d, name=f"rope_{bend}_{kind}": make_model(replace(d, **{name: 2.0 * getattr(d, name)})),
        )
        for bend in ("torsion", "bending")
        for kind in ("stiffness", "damping")
    },
    "box_friction": (3.0, lambda d: make_model(replace(d, box_friction=3.0 * d.box_friction))),
}
# Spheres are made larger on purpose (dof_length, for sleeping alone, follows them); pairs do not use the boxes.
_BOUNDING = {"geom_rbound", "dof_length", "geom_aabb", "bvh_aabb"}


@pytest.mark.parametrize("name", COMPILED)
def test_writing_a_parameter_equals_compiling_with_it(name):
    factor, compile_with = COMPILED[name]
    model, reference, nominal = (
        written({name: factor * SwingPegTask().parameters[name].nominal}),
        compile_with(NOMINAL),
        make_model(),
    )
    fields = [f for f in dir(model) if isinstance(getattr(model, f, None), np.ndarray) and f not in _BOUNDING]
    assert len(fields) > 300
    changed = 0
    for field in fields:
        ours, theirs = getattr(model, field), getattr(reference, field)
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-15, err_msg=field)
        changed += not np.array_equal(getattr(nominal, field), theirs)
    assert changed


def test_broad_phase_holds_the_largest_geoms():
    """A sphere that is too small drops contacts without a word."""
    d = NOMINAL
    largest = make_spec(
        replace(
            d,
            **{
                name: LENGTH_FACTOR * getattr(d, name)
                for name in ("rope_width", "rope_segment_length", "peg_radius", "peg_length")
            },
        )
    ).compile()
    model = make_model()
    for name in ("peg", *SEGMENTS):
        assert model.geom(name).rbound >= largest.geom(name).rbound
    for name in WALLS:
        assert model.geom(name).rbound >= compiled_with_box(LENGTH_FACTOR).geom(name).rbound


def test_gymnasiums_check_passes_without_a_warning(recwarn):
    check_env(gym.make(ENV_ID).unwrapped, skip_render_check=True)
    assert [str(w.message) for w in recwarn] == []


def test_contract_of_spaces_parameters_and_horizon():
    env = gym.make(ENV_ID)
    assert env.observation_space.shape == (10,)
    assert env.action_space == gym.spaces.Box(-1, 1, (7,), np.float32)
    paper = [name for name in env.unwrapped.parameters.names if name != "latency" and not name.startswith("hole_")]
    assert len(paper) == 35
    observation, info = env.reset(seed=0, options={"parameters": {"hole_x": 0.05}})
    assert info["parameters"]["hole_x"] == 0.05
    np.testing.assert_allclose(observation[7:], env.unwrapped.data.geom("peg").xpos)
    for step in range(50):
        *_, terminated, truncated, info = env.step(env.action_space.sample())
        assert "is_success" in info
        assert not terminated
        assert truncated == (step == 49)


@needs_batch
def test_single_equals_batched():
    from simopt_envs.tasks.swingpeg import make_vector_env

    rng = np.random.default_rng(2)
    many, one = make_vector_env(num_envs=3), gym.make(ENV_ID).unwrapped
    space = one.parameters
    noise = rng.normal(0, np.where(space.is_log, 0.1, 0.001), (3, len(space)))
    xi = space.from_unconstrained(space.to_unconstrained(space.nominal) + noise)
    actions = rng.uniform(-1, 1, (30, 3, 7))
    observations = [many.reset(seed=4, options={"parameters": xi})[0], *(many.step(a)[0] for a in actions)]
    for world in range(3):
        first = one.reset(seed=4 + world, options={"parameters": space.as_dict(xi[world])})[0]
        alone = [first, *(one.step(a)[0] for a in actions[:, world])]
        np.testing.assert_allclose(np.array(observations)[:, world], alone, atol=1e-9)


def test_an_episode_begins_with_the_peg_at_rest():
    env = gym.make(ENV_ID)
    observation, _ = env.reset(seed=1)
    for _ in range(10):
        later = env.step(np.zeros(7))[0]
    np.testing.assert_allclose(later[7:], observation[7:], atol=2e-3)  # the arm settles under rope and peg


def test_a_measured_episode_starts_from_its_first_observation():
    env = gym.make(ENV_ID)
    observation, _ = env.reset(seed=5)
    repeated, _ = env.reset(seed=6, options={"initial_observation": observation})
    np.testing.assert_allclose(repeated, observation, atol=1e-9)


def hung_from_the_wall(dimensions=NOMINAL):
    """Rope and peg on a gripper that does not move: no actuators, no arm joints, so nothing puts energy in."""
    spec = make_spec(dimensions)
    for element in (*spec.actuators, *spec.keys, *(spec.joint(name) for name in JOINTS)):
        spec.delete(element)
    model = spec.compile()
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    return model


def energies(model, seconds=2.0):
    """Total energy [J] step by step, after letting go of the peg with the rope stretched out sideways."""
    data = mujoco.MjData(model)
    mujoco.mju_axisAngle2Quat(data.joint("grip").qpos, [0, 1, 0], np.deg2rad(80))
    values = []
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
        values.append(data.energy.sum())
    return np.array(values)


def test_energy_never_grows_without_input():
    energy = energies(hung_from_the_wall())
    assert energy[0] - energy[-1] > 1e-3  # the swing loses some by damping
    assert (energy - np.minimum.accumulate(energy)).max() < 1e-9


def test_energy_test_notices_a_source():
    """Control: joints that push a little in the direction in which they move."""
    energy = energies(hung_from_the_wall(replace(NOMINAL, rope_bending_damping=-1e-6)))
    assert (energy - np.minimum.accumulate(energy)).max() > 1e-6


@pytest.mark.parametrize(
    ("depth", "tilt", "solved"),
    [(0.055, 0.0, True), (0.045, 0.0, False), (0.055, 12.0, True), (0.055, 18.0, False), (-0.055, 0.0, False)],
)
def test_success_asks_for_depth_and_angle(task, depth, tilt, solved):
    """The box is moved to the hanging peg, its hole ``tilt`` degrees off the peg's axis, the tip ``depth`` [m] deep."""
    simulation = SingleSimulation(task.make_model(), task.parameters)
    model = simulation.model
    qpos = task.initial_qpos(np.random.default_rng(0))[None]
    simulation.reset(np.zeros(1, dtype=np.intp), qpos, np.zeros((1, model.nv)), task.hold(qpos))
    tip = simulation.mj_data.geom("peg").xpos - [0, 0, NOMINAL.peg_length / 2]
    box = model.body("box").id
    mujoco.mju_axisAngle2Quat(model.body_quat[box], [1, 0, 0], np.deg2rad(tilt))
    out = np.array([0, -np.sin(np.deg2rad(tilt)), np.cos(np.deg2rad(tilt))])
    model.body_pos[box] = tip + depth * out
    mujoco.mj_forward(model, simulation.mj_data)
    assert task.evaluate(simulation, np.zeros((1, 7))).success == [solved]


def test_rewards_begin_near_zero_and_rise_towards_the_hole(task):
    env = TaskEnv(task)
    env.reset(seed=0)
    *_, info = env.step(np.zeros(7))
    assert all(abs(term) < 0.5 for term in info["reward_terms"].values())


def test_the_arm_cannot_hold_the_peg_over_the_hole(task):
    """However it stretches, a peg that hangs at rest stays short of the hole; swung up to 45 degrees it gets there."""
    model = task.make_model()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    nearest_rim = data.site("hole").xpos[0] - model.site("hole").size.max()
    low, high = model.jnt_range[[model.joint(name).id for name in JOINTS]].T

    def farthest(joints):
        data.qpos[task.arm.qpos] = joints
        mujoco.mj_kinematics(model, data)
        return -data.site("grip").xpos[0]

    starts = np.random.default_rng(0).uniform(low, high, (500, 7))
    best = starts[np.argsort([farthest(q) for q in starts])[:5]]
    reach = max(-minimize(farthest, q, bounds=list(zip(low, high, strict=True))).fun for q in best)
    rope_and_peg = len(SEGMENTS) * NOMINAL.rope_segment_length + NOMINAL.peg_length
    assert reach + NOMINAL.peg_radius < nearest_rim
    assert reach + rope_and_peg * np.sin(np.deg2rad(45)) > nearest_rim
