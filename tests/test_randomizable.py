import gymnasium as gym
import mujoco
import numpy as np
import pytest
from conftest import needs_effects

from simopt_envs.physics import Parameter, Write
from simopt_envs.physics.effects import EFFECTS
from wrappers import RandomizablePhysics, model_parameters

XML = """
<mujoco>
  <option gravity="0 0 -9.81"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1"/>
    <body name="cart" pos="0 0 1">
      <joint name="rail" type="slide" axis="1 0 0" damping="2"/>
      <geom size="0.1" mass="3"/>
      <body name="pole" pos="0 0 0.1">
        <joint name="hinge" type="hinge" axis="0 1 0" damping="0.1" armature="0.01"/>
        <geom name="rod" type="capsule" fromto="0 0 0 0.1 0 0.6" size="0.02" mass="0.5"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="servo" joint="rail" kp="50"/>
    <motor name="motor" joint="hinge"/>
  </actuator>
</mujoco>
"""


class CartEnv(gym.Env):
    """A cart with a pole; ``hard`` builds a new model at each reset, as robosuite does."""

    def __init__(self, hard: bool = False):
        self.hard = hard
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (4,), np.float64)
        self.action_space = gym.spaces.Box(-1, 1, (2,), np.float64)
        self.build()

    def build(self):
        self.model = mujoco.MjModel.from_xml_string(XML)
        self.data = mujoco.MjData(self.model)

    def observe(self):
        return np.concatenate([self.data.qpos, self.data.qvel])

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        assert not options
        if self.hard:
            self.build()
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[1] = 0.3
        mujoco.mj_forward(self.model, self.data)
        return self.observe(), {}

    def step(self, action):
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, 10)
        return self.observe(), 0.0, False, False, {}


class PlacingEnv(CartEnv):
    """Draws where the cart stands at each reset."""

    def reset(self, *, seed=None, options=None):
        gym.Env.reset(self, seed=seed)
        self.model.body("cart").pos[0] = self.np_random.uniform(0.5, 1.0)
        return super().reset(options=options)


def all_fields(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    names = [n for n in dir(model) if not n.startswith("_") and isinstance(getattr(model, n), np.ndarray)]
    return {name: getattr(model, name).copy() for name in names} | {"gravity": model.opt.gravity.copy()}


def motion(env: gym.Env, parameters: dict[str, float], steps: int = 20) -> np.ndarray:
    env.reset(seed=0, options={"parameters": parameters} if parameters else None)
    return np.array([env.step(np.array([0.5, 0.1]))[0] for _ in range(steps)])


EVERYTHING = [
    "body_mass of *",
    "dof_damping of *",
    "dof_armature of *",
    "actuator_gain of *",
    "geom_friction of *",
    "gravity",
]


def test_patterns_find_named_objects_that_have_a_value():
    space = model_parameters(mujoco.MjModel.from_xml_string(XML), EVERYTHING)
    assert dict(zip(space.names, zip(space.nominal, space.units, strict=True), strict=True)) == {
        "body_mass of cart": (3.0, "kg"),
        "body_mass of pole": (0.5, "kg"),
        "dof_damping of rail": (2.0, "N s/m"),
        "dof_damping of hinge": (0.1, "N m s/rad"),
        "dof_armature of hinge": (0.01, "kg m^2"),
        "actuator_gain of servo": (50.0, "1"),
        "actuator_gain of motor": (1.0, "1"),
        "geom_friction of floor": (1.0, "1"),
        "geom_friction of rod": (1.0, "1"),
        "gravity": (9.81, "m/s^2"),
    }


@needs_effects
def test_actuators_that_come_after_one_without_a_command_are_found():
    spec = mujoco.MjSpec.from_string(XML)
    EFFECTS["cogging"].add(spec, "joint:hinge")
    spec.add_actuator(name="later", target="rail", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    assert "actuator_gain of later" in model_parameters(spec.compile(), ["actuator_gain of *"]).names


def test_the_kind_of_object_may_be_named():
    space = model_parameters(mujoco.MjModel.from_xml_string(XML), ["dof_damping of joint *", "body_mass of body pole"])
    assert space.names == ("dof_damping of joint rail", "dof_damping of joint hinge", "body_mass of body pole")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("body_mass of poles", "unknown body 'poles'; did you mean 'pole'"),
        ("dof_dampin of hinge", "unknown quantity 'dof_dampin'; did you mean 'dof_damping'"),
        ("geom_friction of foot*", r"unknown geom 'foot\*'.*floor, rod"),
        ("body_mass", "names no object"),
        ("dof_frictionloss of *", r"cannot be scaled: it is zero in the model for rail, hinge.*operation=\"set\""),
    ],
)
def test_what_does_not_exist_is_answered_with_what_does(text, message):
    with pytest.raises(ValueError, match=message):
        RandomizablePhysics(CartEnv(), [text])


def test_an_environment_without_a_model_is_refused():
    with pytest.raises(TypeError, match="needs an environment with a MuJoCo 'model'"):
        RandomizablePhysics(gym.make("CartPole-v1"), ["gravity"])


@pytest.mark.parametrize(
    ("name", "value", "written"),
    [
        ("body_mass of pole", 1.5, {"body_mass", "body_inertia"}),
        ("body_mass of cart", 1.0, {"body_mass", "body_inertia"}),
        ("dof_damping of rail", 20.0, {"dof_damping"}),
        ("dof_armature of hinge", 0.1, {"dof_armature"}),
        ("actuator_gain of servo", 100.0, {"actuator_gainprm", "actuator_biasprm"}),
        ("actuator_gain of motor", 5.0, {"actuator_gainprm"}),
        ("geom_friction of rod", 0.2, {"geom_friction"}),
        ("gravity", 3.7, {"gravity"}),
    ],
)
def test_a_parameter_changes_its_fields_and_what_derives_from_them_and_nothing_else(name, value, written):
    env = RandomizablePhysics(CartEnv(), EVERYTHING)
    nominal, still = all_fields(env.unwrapped.model), motion(env, {})
    moved = motion(env, {name: value})
    changed = {
        field for field, was in nominal.items() if not np.array_equal(was, all_fields(env.unwrapped.model)[field])
    }
    derived = {"body_invweight0", "dof_invweight0", "dof_M0", "body_subtreemass", "actuator_acc0", "tendon_invweight0"}
    assert written <= changed <= written | derived
    assert np.array_equal(still, moved) == ("friction" in name)  # nothing touches the floor
    np.testing.assert_array_equal(motion(env, {}), still)
    for field, value in all_fields(env.unwrapped.model).items():
        np.testing.assert_array_equal(value, nominal[field], err_msg=field)


def test_a_mass_equals_that_of_a_model_compiled_with_it():
    env = RandomizablePhysics(CartEnv(), ["body_mass of *", "gravity"])
    compiled = CartEnv()
    compiled.model = mujoco.MjModel.from_xml_string(XML.replace('mass="0.5"', 'mass="1.2"'))
    compiled.data = mujoco.MjData(compiled.model)
    np.testing.assert_allclose(motion(env, {"body_mass of pole": 1.2}), motion(compiled, {}), rtol=1e-12)
    for field in (
        "body_mass",
        "body_inertia",
        "body_subtreemass",
        "body_invweight0",
        "dof_invweight0",
        "actuator_acc0",
    ):
        np.testing.assert_allclose(getattr(env.unwrapped.model, field), getattr(compiled.model, field), rtol=1e-12)


def test_a_servo_keeps_its_target_when_its_gain_changes():
    env = RandomizablePhysics(CartEnv(), ["actuator_gain of servo"])
    env.reset(options={"parameters": {"actuator_gain of servo": 80.0}})
    actuator = env.unwrapped.model.actuator("servo")
    assert (actuator.gainprm[0], actuator.biasprm[1]) == (80.0, -80.0)


def test_values_never_accumulate():
    env = RandomizablePhysics(CartEnv(), EVERYTHING)
    first = motion(env, {"body_mass of pole": 1.0, "gravity": 5.0})
    rng = np.random.default_rng(0)
    for _ in range(30):
        env.reset(options={"parameters": env.parameters.as_dict(env.parameters.nominal * rng.uniform(0.5, 2.0, 10))})
    np.testing.assert_array_equal(motion(env, {"body_mass of pole": 1.0, "gravity": 5.0}), first)


def test_a_hard_reset_gets_the_values_into_the_new_model():
    soft, hard = (RandomizablePhysics(CartEnv(hard=h), EVERYTHING) for h in (False, True))
    values = {"body_mass of pole": 1.0, "gravity": 5.0}
    for _ in range(3):
        model = hard.unwrapped.model
        np.testing.assert_array_equal(motion(hard, values), motion(soft, values))
        assert hard.unwrapped.model is not model
    np.testing.assert_array_equal(motion(hard, {}), motion(soft, {}))
    assert not np.array_equal(motion(hard, {}), motion(hard, values))


def body_x(body: str) -> Parameter:
    return Parameter(f"{body}_x", "m", 0.0, -0.2, 0.2, "linear", (Write("body_pos", body, (0,), "add"),))


def test_a_parameter_that_the_environment_writes_itself_is_refused():
    env = RandomizablePhysics(PlacingEnv(), [body_x("pole"), "gravity"])  # another place in the same field
    env.reset(seed=0, options={"parameters": {"pole_x": 0.1}})
    assert env.unwrapped.model.body("pole").pos[0] == 0.1
    env = RandomizablePhysics(PlacingEnv(), ["gravity", body_x("cart")])
    message = r"'cart_x' is not in force: it set body_pos to \[0.2\], and .*PlacingEnv.* itself.*leaves alone"
    with pytest.raises(ValueError, match=message):
        env.reset(seed=0, options={"parameters": {"cart_x": 0.2}})


def test_an_environment_with_parameters_of_its_own_points_to_these():
    env = RandomizablePhysics(gym.make("SimOpt/Drawer-v0"), ["dof_damping of joint1"])
    env.reset(seed=0)
    nominal = env.parameters["dof_damping of joint1"].nominal
    with pytest.raises(ValueError, match=r"set dof_damping to .* use its own parameters \(DistributionWrapper alone"):
        env.reset(seed=0, options={"parameters": {"dof_damping of joint1": 5 * nominal}})


def test_a_geom_grows_with_all_that_contacts_are_looked_for_in():
    size = Parameter("rod", "m", 0.02, 0.01, 0.5, writes=(Write("geom_size", "rod", (0,)),))
    if not hasattr(mujoco.MjModel, "_setconst_inputs"):
        with pytest.raises(ValueError, match="'rod' writes geom_size, which needs MuJoCo 4"):
            RandomizablePhysics(CartEnv(), [size])
        return
    env = RandomizablePhysics(CartEnv(), [size])
    env.reset(options={"parameters": {"rod": 0.4}})
    model = env.unwrapped.model
    assert model.geom_rbound[model.geom("rod").id] == pytest.approx(0.4 + model.geom("rod").size[1])


def test_the_environments_state_is_left_alone():
    env = RandomizablePhysics(CartEnv(), ["body_mass of *"])
    env.reset()
    env.step(np.ones(2))
    before = env.unwrapped.data.qpos.copy(), env.unwrapped.data.qvel.copy()
    env._write(env.parameters.nominal * 2)
    np.testing.assert_array_equal((env.unwrapped.data.qpos, env.unwrapped.data.qvel), before)


def test_own_parameters_may_set_what_is_zero():
    friction = Parameter("rail friction", "N", 0.0, 0.0, 50.0, "linear", (Write("dof_frictionloss", "rail"),))
    env = RandomizablePhysics(CartEnv(), [friction, "gravity"])
    assert np.abs(motion(env, {"rail friction": 50.0})[-1, 0]) < 0.1 * np.abs(motion(env, {})[-1, 0])


def test_info_echoes_all_and_wrong_values_are_refused():
    env = RandomizablePhysics(CartEnv(), ["body_mass of *", "gravity"])
    _, info = env.reset(options={"parameters": {"gravity": 5.0}})
    assert info["parameters"] == {"body_mass of cart": 3.0, "body_mass of pole": 0.5, "gravity": 5.0}
    for values, message in [({"gravityy": 1.0}, "did you mean 'gravity'"), ({"gravity": 1e6}, "out of bounds")]:
        with pytest.raises(ValueError, match=message):
            env.reset(options={"parameters": values})


@pytest.mark.parametrize("env_id", ["InvertedPendulum-v5", "Hopper-v5"])
def test_gymnasiums_own_environments(env_id):
    def episode(parameters):
        env.reset(seed=0, options={"parameters": parameters} if parameters else None)
        env.action_space.seed(0)
        return np.array([env.step(env.action_space.sample())[0] for _ in range(5)])

    env = RandomizablePhysics(gym.make(env_id), ["body_mass of *", "dof_damping of *", "gravity"])
    plain = gym.make(env_id)
    plain.reset(seed=0)
    plain.action_space.seed(0)
    untouched = np.array([plain.step(plain.action_space.sample())[0] for _ in range(5)])
    np.testing.assert_array_equal(episode({}), untouched)
    for parameter in env.parameters:
        assert not np.array_equal(episode({parameter.name: 2 * parameter.nominal}), untouched), parameter.name
    np.testing.assert_array_equal(episode({}), untouched)
    env.close()
    plain.close()
