"""Physical effects in the registered environments: in force at every reset, part of ξ, the same single and vector."""

import gymnasium as gym
import numpy as np
import pytest
from conftest import needs_batch, needs_effects

import simopt_envs  # noqa: F401 - registers the environments
from simopt_envs.physics.effects import EFFECTS

pytestmark = needs_effects


DRAWER, SWING_PEG = "SimOpt/Drawer-v0", "SimOpt/SwingPeg-v0"
ARM = [
    {"effect": "coulomb_friction", "where": "joint:joint4", "parameters": {"frictionloss": {"value": 5.0, "unit": ""}}},
    {"effect": "actuator_delay", "where": "actuator:joint2", "parameters": {"delay": 0.07, "lag_share": 0.4}},
    {"effect": "actuator_gain", "where": "actuator:joint1", "parameters": {"scale": 0.6}},
    {"effect": "payload", "where": "body:link5", "parameters": {"mass": 1.0}},
]
DETENT = {"effect": "detent", "where": "joint:drawer", "parameters": {"force": 30.0, "width": 0.02}}


def rollout(env, actions, seed=3, **reset):
    observations = [env.reset(seed=seed, **reset)[0]]
    return np.array(observations + [env.step(action)[0] for action in actions])


def actions(env, steps=30):
    return np.random.default_rng(0).uniform(-1, 1, (steps, *env.action_space.shape)).astype(np.float32)


@needs_batch
@pytest.mark.parametrize(("env_id", "effects"), [(DRAWER, [*ARM, DETENT]), (SWING_PEG, ARM)])
def test_single_and_vector_environment_agree_and_both_have_the_effects(env_id, effects):
    without, single = gym.make(env_id), gym.make(env_id, effects=effects)
    vector = gym.make_vec(env_id, num_envs=3, effects=effects)
    acts = actions(single)
    one, many = rollout(single, acts), rollout(vector, np.stack([acts] * 3, axis=1), seed=[3, 3, 4])
    np.testing.assert_allclose(many[:, 0], one, atol=1e-9)
    np.testing.assert_allclose(many[:, 1], one, atol=1e-9)
    assert np.abs(rollout(without, acts) - one).max() > 0.01


def test_effects_join_xi_with_their_values_as_nominal():
    without, env = gym.make(DRAWER), gym.make(DRAWER, effects=ARM)
    space = env.unwrapped.parameters
    names = [
        "coulomb_friction.joint4.frictionloss",
        "actuator_delay.joint2.delay",
        "actuator_gain.joint1.scale",
        "payload.link5.mass",
    ]
    assert list(space.names) == [*without.unwrapped.parameters.names, *names]
    np.testing.assert_array_equal(space.nominal[-4:], [5.0, 0.07, 0.6, 1.0])

    env.reset(seed=0)
    stiffness = without.unwrapped.model.actuator("joint1").gainprm[0]
    model = env.unwrapped.model
    assert model.joint("joint4").frictionloss[0] == 5.0
    assert model.actuator("joint1").gainprm[0] == pytest.approx(0.6 * stiffness)
    late = [m.actuator_delay[m.actuator("joint2").id] for m in (without.unwrapped.model, model)]
    assert late[1] == pytest.approx(late[0] + 0.07)

    env.reset(seed=0, options={"parameters": {names[0]: 2.0, names[2]: 1.5, "joint_gain_1": 2.0}})
    assert model.joint("joint4").frictionloss[0] == 2.0
    assert model.actuator("joint1").gainprm[0] == pytest.approx(3.0 * stiffness)


@pytest.mark.parametrize("env_id", [DRAWER, SWING_PEG])
def test_neutral_values_leave_the_environment_as_it_was(env_id):
    entries = [{**entry, "parameters": {}} for entry in ARM[:3]]
    without, env = gym.make(env_id), gym.make(env_id, effects=entries)
    acts = actions(env)
    np.testing.assert_allclose(rollout(env, acts), rollout(without, acts), atol=1e-9)


def test_friction_slows_a_joint_and_a_detent_holds_the_drawer():
    turn = np.zeros((10, 8), np.float32)
    turn[:, 3] = 0.5
    moved = [
        np.ptp(rollout(gym.make(DRAWER, effects=[{**ARM[0], "parameters": {"frictionloss": force}}]), turn)[:, 3])
        for force in (0.0, 10.0, 80.0)
    ]
    assert moved[0] > 1.1 * moved[1] > 2.0 * moved[2]

    force = 40.0
    opened = []
    for effects in ([], [{**DETENT, "parameters": {"force": 60.0, "width": 0.02}}]):
        env = gym.make(DRAWER, effects=effects)
        env.reset(seed=0)
        env.unwrapped.data.body("drawer").xfrc_applied[0] = -force
        for action in np.zeros((20, 8), np.float32):
            env.step(action)
        opened.append(float(env.unwrapped.data.joint("drawer").qpos[0]))
    assert opened[0] > 0.2
    assert opened[1] < 0.01


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"effect": "coulomb", "where": "joint:joint4", "parameters": {}}, "coulomb_friction.*Valid names"),
        ({"effect": "coulomb_friction", "where": "joint:joint9", "parameters": {}}, "joint:joint1, joint:joint2"),
        ({**ARM[0], "parameters": {"friction": 1.0}}, "'friction'.*Valid names: frictionloss"),
        ({**ARM[0], "parameters": {"frictionloss": -1.0}}, "frictionloss.*not within"),
        ({**ARM[0], "parameters": {"frictionloss": "much"}}, "must be a number, got 'much'"),
        ({"effect": "coulomb_friction", "where": "joint:joint4"}, "needs the keys effect, where, parameters"),
        ({"effect": "backlash", "where": "joint:joint4", "parameters": {}}, "model.repaired.xml.*coulomb_friction"),
        ({"effect": "deadband", "where": "actuator:joint4", "parameters": {}}, "commands that a task does not know"),
        ({"effect": "sensor_delay", "where": "joint:joint4", "parameters": {}}, "SensorDelay in wrappers"),
    ],
)
def test_what_cannot_be_is_told(entry, message):
    with pytest.raises(ValueError, match=message):
        gym.make(DRAWER, effects=[entry])


def test_every_effect_is_taken_or_refused_with_a_reason():
    task = gym.make(DRAWER).unwrapped.task
    taken = set()
    for effect in EFFECTS.values():
        entry = {"effect": effect.name, "where": effect.places(task.make_model())[0], "parameters": {}}
        try:
            gym.make(DRAWER, effects=[entry]).reset(seed=0)
            taken.add(effect.name)
        except ValueError as error:
            assert "An environment takes" in str(error)  # noqa: PT017 - either outcome is right
    assert set(EFFECTS) - taken == {
        *("backlash", "joint_elasticity", "load_dependent_friction", "deadband"),
        *("sensor_delay", "sensor_scale"),
    }
