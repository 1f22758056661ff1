"""Effects of joints: neutral is the plain model, the law is the formula's, worlds of a batch do as single models."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import mujoco
import numpy as np
import pytest
from effect_arm import ARM, STEPS, TIMESTEP, structure, with_effect

from simopt_envs.physics import ModelWriter, ParameterSpace
from simopt_envs.physics.effects import EFFECTS, Effect, Motion
from simopt_envs.physics.effects.actuators import driven_joint
from simopt_envs.physics.spec_writer import write_spec

Batch = pytest.importorskip("mujoco.batch", reason="effects need MuJoCo >= 3.17").Batch

MOTION = Motion(*(np.array(row) for row in ([-0.8] * 3, [0.8] * 3, [1.5] * 3, [4.0] * 3, [0.5] * 3)))

# place, values, and whether recordings of the neutral structure are the plain model's to this [rad, m]
CASES: dict[str, tuple[str, dict[str, float], float]] = {
    "armature": ("joint:elbow", {"armature": 0.03}, 0.0),
    "asymmetric_friction": ("joint:drive", {"frictionloss": 4.0, "difference": 3.0}, 1e-12),
    "backlash": ("joint:elbow", {"play": 0.02}, 3e-4),
    "cogging": ("joint:elbow", {"amplitude": 0.6, "periods": 7.0, "phase": 0.4}, 1e-12),
    "detent": ("joint:elbow", {"force": 0.8, "width": 0.2, "position": 0.1}, 1e-8),
    "joint_coupling": ("joint:shoulder+elbow", {"stiffness": 5.0}, 1e-12),
    "joint_elasticity": ("joint:elbow", {"stiffness": 60.0}, 5e-7),
    "joint_spring": ("joint:elbow", {"stiffness": 6.0, "reference": 0.5}, 1e-12),
    "load_dependent_friction": ("joint:drive", {"coefficient": 0.15}, 5e-5),
    "quadratic_drag": ("joint:drive", {"drag": 8.0}, 1e-12),
    "stribeck_friction": ("joint:drive", {"frictionloss": 2.0, "breakaway": 4.0, "velocity": 0.2}, 1e-9),
}


def commands() -> np.ndarray:
    """(STEPS, 3): both servos swing, the drive pushes to and fro."""
    t = TIMESTEP * np.arange(STEPS)[:, None]
    return np.array([0.6, 0.5, 6.0]) * np.sin(np.array([3.0, 5.0, 4.0]) * t)


def rollout(model: mujoco.MjModel) -> np.ndarray:
    """Positions of the three joints and the tip's height, (STEPS, 4)."""
    data, rows = mujoco.MjData(model), []
    joints = [model.joint(name).qposadr[0] for name in ("shoulder", "elbow", "drive")]
    for command in commands():
        data.ctrl[:] = command
        mujoco.mj_step(model, data)
        rows.append([*data.qpos[joints], data.site("tip").xpos[2]])
    return np.array(rows)


@pytest.fixture(scope="module")
def plain() -> np.ndarray:
    """The rollout of the arm as given."""
    return rollout(mujoco.MjModel.from_xml_string(ARM))


@pytest.mark.parametrize("name", CASES)
def test_neutral_is_the_plain_model_and_the_effect_is_not(name: str, plain: np.ndarray) -> None:
    place, values, tolerance = CASES[name]
    assert np.abs(rollout(with_effect(name, place)) - plain).max() <= tolerance
    assert np.abs(rollout(with_effect(name, place, values)) - plain).max() > 2e-3


@pytest.mark.parametrize("name", CASES)
def test_no_command_is_added(name: str) -> None:
    model, _ = structure(name, CASES[name][0])
    assert model.nu == 3


@pytest.mark.parametrize("name", CASES)
def test_the_repaired_spec_can_be_saved(name: str) -> None:
    place, values, _ = CASES[name]
    spec = mujoco.MjSpec.from_string(ARM)
    EFFECTS[name].add(spec, place)
    model = spec.compile()
    space = ParameterSpace(EFFECTS[name].parameters(model, place))
    write_spec(spec, model, space, space.values(values))
    expected = rollout(with_effect(name, place, values))[:200]
    assert rollout(spec.compile())[:200] == pytest.approx(expected, abs=1e-9)
    saved = mujoco.MjModel.from_xml_string(spec.to_xml())  # six digits
    assert rollout(saved)[:200] == pytest.approx(expected, abs=2e-3)


@pytest.mark.parametrize("name", CASES)
def test_worlds_of_a_batch_do_as_single_models(name: str) -> None:
    place, values, _ = CASES[name]
    model, space = structure(name, place)
    xi = space.values({key: np.array([value, 0.7 * value]) for key, value in values.items()}, num_worlds=2)
    batch, writer = Batch(model, 2, 1), ModelWriter(model, space)
    fields = {field: batch.expand(field) for field in writer.fields}
    writer.write(xi, fields.__getitem__)
    if writer.needs_set_const:
        batch.set_const(np.arange(2))
    batch.reset()
    records = batch.rollout(
        STEPS,
        control=np.tile(commands(), (2, 1, 1)),
        control_spec=int(mujoco.mjtState.mjSTATE_CTRL),
        record=["qpos"],
        ids=np.arange(2),
    )
    joints = [model.joint(joint).qposadr[0] for joint in ("shoulder", "elbow", "drive")]
    ends = records["qpos"][:, -1, joints]
    for world in range(2):
        single = rollout(with_effect(name, place, space.as_dict(xi[world])))
        assert ends[world] == pytest.approx(single[-1, :3], abs=1e-12)
    assert np.abs(ends[0] - ends[1]).max() > 1e-6


@pytest.mark.parametrize("name", CASES)
def test_probes_are_within_bounds_and_move_every_parameter(name: str) -> None:
    place, _, _ = CASES[name]
    model, space = structure(name, place)
    probes = np.array([space.values(probe) for probe in EFFECTS[name].probes(model, place, MOTION)])
    assert (probes != space.nominal).any(axis=0).all()


POINTER = """
<mujoco><worldbody><body name="base"><joint name="turn"/><geom size="0.01" mass="0.001"/>
  <body name="hand"><joint name="point"/><geom size="0.003" mass="0.00003"/></body>
</body></worldbody>
<actuator><motor name="turn" joint="turn"/><position name="point" joint="point" kp="1e-6"/></actuator></mujoco>
"""


@pytest.mark.parametrize("effect", EFFECTS.values(), ids=EFFECTS)
def test_small_parts_can_have_every_effect(effect: Effect) -> None:
    """Of 1e-10 kg m2: what an effect adds to a model must not be too light for the compiler."""
    for place in effect.places(mujoco.MjModel.from_xml_string(POINTER)):
        spec = mujoco.MjSpec.from_string(POINTER)
        effect.add(spec, place)
        spec.compile()


def test_places() -> None:
    model = mujoco.MjModel.from_xml_string(ARM)
    assert EFFECTS["cogging"].places(model) == ("joint:shoulder", "joint:elbow", "joint:drive")
    assert EFFECTS["joint_coupling"].places(model) == ("joint:shoulder+elbow",)
    odd, place = ARM.replace('"shoulder"', '"a+b"').replace('"elbow"', '"c+"'), "joint:a+b+c+"
    assert EFFECTS["joint_coupling"].places(mujoco.MjModel.from_xml_string(odd)) == (place,)
    assert EFFECTS["joint_coupling"].probes(structure("joint_coupling", place, odd)[0], place, MOTION)
    explicit = mujoco.MjModel.from_xml_string(ARM.replace("implicitfast", "RK4"))
    assert EFFECTS["joint_elasticity"].places(model) == ("joint:shoulder", "joint:elbow", "joint:drive")
    assert EFFECTS["joint_elasticity"].places(explicit) == ()
    ways = "".join(f'<joint name="{i}" type="slide" axis="1 0 {i}"/>' for i in range(6))
    loose = f'<mujoco><worldbody><body>{ways}<geom size="0.1"/></body></worldbody></mujoco>'
    assert EFFECTS["backlash"].places(mujoco.MjModel.from_xml_string(loose)) == (), "a body has six joints at most"


# Laws: the force that an effect adds at states, as the difference of two inverse dynamics.


def added_force(name: str, place: str, values: Mapping[str, float], q: float, v: float) -> np.ndarray:
    """What an effect adds to the smooth forces on shoulder, elbow and drive, all at a position and speed."""
    forces = []
    for model in (with_effect(name, place, values), mujoco.MjModel.from_xml_string(ARM)):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_forward(model, data)
        forces.append(data.qfrc_smooth.copy())
    return forces[0] - forces[1]


def triangle(x: float, force: float, width: float) -> float:
    return -force * np.sign(x) * max(0.0, 1 - abs(2 * abs(x) / width - 1))


LAWS: dict[str, tuple[str, dict[str, float], Callable[[float, float], list[float]]]] = {
    "cogging": (
        "joint:elbow",
        {"amplitude": 0.6, "periods": 7.0, "phase": 0.4},
        lambda q, v: [0, 0.6 * np.sin(7 * q + 0.4), 0],
    ),
    "detent": (
        "joint:elbow",
        {"force": 0.8, "width": 0.4, "position": 0.1},
        lambda q, v: [0, triangle(q - 0.1, 0.8, 0.4), 0],
    ),
    "joint_coupling": (
        "joint:shoulder+elbow",
        {"stiffness": 5.0},
        lambda q, v: [-5 * (2 * q - np.radians(10)), -5 * (2 * q - np.radians(10)), 0],
    ),
    "joint_spring": (
        "joint:drive",
        {"stiffness": 6.0, "reference": -0.3},
        lambda q, v: [0, 0, -6 * (q + 0.3)],
    ),
    "quadratic_drag": ("joint:elbow", {"drag": 0.8}, lambda q, v: [0, -0.8 * abs(v) * v, 0]),
}


@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize(("q", "v"), [(0.0, 0.0), (0.15, 1.3), (0.27, -0.4), (-0.06, 2.0), (0.9, -3.0)])
def test_the_force_is_the_law(name: str, q: float, v: float) -> None:
    place, values, law = LAWS[name]
    assert added_force(name, place, values, q, v) == pytest.approx(law(q, v), abs=1e-7)


def test_armature_adds_to_the_inertia() -> None:
    light, heavy = (with_effect("armature", "joint:elbow", {"armature": extra}) for extra in (0.0, 0.03))
    assert heavy.dof_M0 - light.dof_M0 == pytest.approx([0, 0.03, 0], abs=1e-12)


# Friction is felt by its motion: the drive alone, m dv/dt = u - d v + f(v), integrated by other means.


def drive_velocity(name: str, values: Mapping[str, float], push: Callable[[float], float], start: float) -> np.ndarray:
    """Speed of the drive [m/s], (STEPS,)."""
    model = with_effect(name, "joint:drive", values)
    data, speeds = mujoco.MjData(model), []
    dof = model.joint("drive").dofadr[0]
    data.qvel[dof] = start
    for i in range(STEPS):
        data.ctrl[2] = push(i * TIMESTEP) / 2  # the class's gear
        mujoco.mj_step(model, data)
        speeds.append(data.qvel[dof])
    return np.array(speeds)


def integrated(friction: Callable[[float], float], push: Callable[[float], float], start: float) -> np.ndarray:
    """The same by Euler steps of a twentieth of the timestep; ``friction`` is at a speed > 0, which it must stay."""
    v, speeds, fine = start, [], TIMESTEP / 20
    for i in range(20 * STEPS):
        v += fine * (push(i // 20 * TIMESTEP) - 5 * v + friction(v)) / 2.0
        speeds.append(v)
    return np.array(speeds[19::20])


@pytest.mark.parametrize("difference", [3.0, -3.0])
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_asymmetric_friction_slows_one_direction_more(difference: float, direction: float) -> None:
    def push(t: float) -> float:
        return direction * (9.0 + 2.0 * np.sin(5 * t))

    moved = direction * drive_velocity(
        "asymmetric_friction", {"frictionloss": 4.0, "difference": difference}, push, 0.5 * direction
    )
    expected = integrated(lambda v: -(4.0 + direction * difference / 2), lambda t: direction * push(t), 0.5)
    assert expected.min() > 0.1
    assert moved == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize(("push", "sticks"), [(5.0, True), (2.0, True), (6.0, False), (-2.0, True), (-3.5, False)])
def test_asymmetric_friction_holds_at_rest(push: float, sticks: bool) -> None:
    speed = drive_velocity("asymmetric_friction", {"frictionloss": 4.0, "difference": 3.0}, lambda t: push, 0.0)
    assert (abs(speed[-1]) < 2e-3) == sticks
    assert sticks or np.sign(speed[-1]) == np.sign(push)


@pytest.mark.parametrize(
    ("level", "difference", "is_itself"),
    [(4.0, 3.0, True), (4.0, -7.9, True), (4.0, 1.9, False), (4.0, 8.1, False), (4.0, -8.1, False), (0.0, 1.0, False)],
)
def test_a_friction_that_pushes_is_no_asymmetric_friction(level: float, difference: float, is_itself: bool) -> None:
    model = mujoco.MjModel.from_xml_string(ARM)
    values = {"frictionloss": level, "difference": difference}
    assert EFFECTS["asymmetric_friction"].is_itself(model, "joint:drive", MOTION, values) is is_itself


@pytest.mark.parametrize(
    ("rest", "is_itself"), [(0.0, True), (0.8, True), (-2.3, True), (2.3, True), (-2.5, False), (2.5, False)]
)
def test_a_spring_that_rests_far_from_where_its_joint_moves_is_a_constant_force(rest: float, is_itself: bool) -> None:
    model = mujoco.MjModel.from_xml_string(ARM)
    values = {"stiffness": 1.0, "reference": rest}
    assert EFFECTS["joint_spring"].is_itself(model, "joint:drive", MOTION, values) is is_itself


@pytest.mark.parametrize(("seen", "is_itself"), [(0.06, False), (0.98, False), (1.02, True), (5.0, True)])
def test_a_wave_of_which_the_motion_sees_no_whole_period_is_no_cogging(seen: float, is_itself: bool) -> None:
    model = mujoco.MjModel.from_xml_string(ARM)
    cogging, i = EFFECTS["cogging"], model.joint("drive").dofadr[0]
    values = {"amplitude": 1.0, "periods": seen * float(2 * np.pi / (MOTION.high[i] - MOTION.low[i])), "phase": 0.0}
    assert cogging.is_itself(model, "joint:drive", MOTION, values) is is_itself
    assert all(
        cogging.is_itself(model, place, MOTION, probe)
        for place in cogging.places(model)
        for probe in cogging.probes(model, place, MOTION)
    )


def test_stribeck_friction_has_its_peak_at_low_speed() -> None:
    def push(t: float) -> float:
        return 8.0 - 5.0 * t

    values = {"frictionloss": 2.0, "breakaway": 4.0, "velocity": 0.2}
    moved = drive_velocity("stribeck_friction", values, push, 1.0)
    expected = integrated(lambda v: -(2 + 4 * np.exp(-((v / 0.2) ** 2))), push, 1.0)
    moving = np.cumprod(expected > 0.05).astype(bool)
    assert STEPS / 2 < moving.sum() < STEPS
    coulomb = integrated(lambda v: -2.0, push, 1.0)
    assert np.abs(coulomb - expected)[moving].max() > 0.1
    assert moved[moving] == pytest.approx(expected[moving], abs=0.025)


@pytest.mark.parametrize(("push", "sticks"), [(5.5, True), (3.0, True), (6.6, False)])
def test_stribeck_friction_holds_up_to_its_peak(push: float, sticks: bool) -> None:
    values = {"frictionloss": 2.0, "breakaway": 4.0, "velocity": 0.2}
    speed = drive_velocity("stribeck_friction", values, lambda t: push * min(1.0, 2 * t), 0.0)
    assert (abs(speed[-1]) < 5e-3) == sticks


LOADED = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body pos="0.1 0.2 0.3" euler="0 0 40">
      <body name="arm" pos="0.1 0 0" euler="10 0 50">
        <joint name="hinge" type="hinge" axis="0 1 0" pos="-0.1 0 0" armature="0.02"/>
        <geom type="box" size="0.1 0.02 0.02" mass="0.5"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="hinge"/>
  </actuator>
</mujoco>
"""

# The same: MuJoCo takes the first two bodies for one, and the joint is said in a frame within its body.
FUSED = LOADED.replace("<option", '<compiler fusestatic="true"/><option')
FRAMED = LOADED.replace(
    '<joint name="hinge" type="hinge" axis="0 1 0" pos="-0.1 0 0" armature="0.02"/>',
    '<frame pos="-0.1 0 0" euler="90 0 0"><joint name="hinge" axis="0 0 -1" armature="0.02"/></frame>',
)

CARRIAGE = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body>
      <joint name="carriage" type="slide" axis="1 0 0" damping="200" armature="25"/>
      <geom type="box" size="0.1 0.1 0.05" mass="70"/>
    </body>
  </worldbody>
  <actuator>
    <motor joint="carriage" gear="300"/>
  </actuator>
</mujoco>
"""


@pytest.mark.parametrize(
    ("model", "joint", "coefficient", "tolerance"),
    [
        (LOADED, "hinge", 0.02, 0.05),
        (LOADED, "hinge", 0.1, 0.4),  # at 13 rad/s
        (FUSED, "hinge", 0.02, 0.05),
        (FRAMED, "hinge", 0.02, 0.05),
        (CARRIAGE, "carriage", 0.003, 0.1),
        (CARRIAGE, "carriage", 0.1, 0.1),
    ],
)
def test_load_dependent_friction_is_that_of_the_drive(
    model: str, joint: str, coefficient: float, tolerance: float
) -> None:
    """What a motor swings by a force T: I dv/dt = T + gravity - mu |T| sign(v), integrated finely."""
    plain = mujoco.MjModel.from_xml_string(model)
    fine = mujoco.MjSpec.from_string(model)
    fine.option.timestep = TIMESTEP / 20
    expected = fine.compile()

    def swing(model: mujoco.MjModel, mu: float = 0.0) -> np.ndarray:
        data, out, substeps = mujoco.MjData(model), [], round(TIMESTEP / model.opt.timestep)
        for i in range(500):
            data.ctrl[0] = np.cos(5 * i * TIMESTEP)
            force = float(data.ctrl[0] * model.actuator_gear[0, 0])
            for _ in range(substeps):
                data.qfrc_applied[0] = -mu * abs(force) * np.tanh(data.qvel[0] / 0.003)
                mujoco.mj_step(model, data)
            out.append(data.qpos[0])
        return np.array(out)

    effect = swing(expected, coefficient) - swing(expected)
    braked = with_effect("load_dependent_friction", f"joint:{joint}", {"coefficient": coefficient}, model)
    found = swing(braked) - swing(plain)
    assert np.abs(effect).max() > 5e-4
    assert found == pytest.approx(effect, abs=tolerance * np.abs(effect).max())


def test_a_drive_that_brakes_its_joint_still_counts_as_its_drive() -> None:
    named = ARM.replace('<position joint="elbow"', '<position name="servo" joint="elbow"')
    assert driven_joint(with_effect("load_dependent_friction", "joint:elbow", arm=named), "servo") == "elbow"


# A joint behind the motor's: the motor is what is read, the link is what moves.
