import json
import subprocess
import sys
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from conftest import needs_effects

from benchmarks.hidden_effects import laws
from benchmarks.hidden_effects.cases import FIRST_SEED, LEVELS, Case, Hidden, _are_one, _double, cases, table
from benchmarks.hidden_effects.catalogue import EFFECTS
from benchmarks.hidden_effects.detectability import Observability, reduced
from benchmarks.hidden_effects.generate import column_names, simulate, write_case
from benchmarks.hidden_effects.outside import OUTSIDE
from benchmarks.hidden_effects.plants import RECORDINGS, nominal_model, plants
from benchmarks.hidden_effects.run import recordings
from benchmarks.hidden_effects.score import Answer, Rate, confusion, magnitude_errors, plant_table, rates
from benchmarks.hidden_effects.truth import HALF_STEP_LEAD, TIMESTEP, World, delayed

pytestmark = needs_effects


FRICTION = Hidden("coulomb_friction", "joint:elbow", 0.05, False, 10.0, False)


def test_nothing_of_the_library_is_imported():
    modules = "generate, score, detectability, outside"
    code = f"import sys; before = {{*sys.modules}}; from benchmarks.hidden_effects import {modules}"
    code += "; print(*({*sys.modules} - before))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "benchmarks.hidden_effects.truth" in loaded
    assert not {name.split(".")[0] for name in loaded} & {"simopt_envs", "wrappers", "baselines", "gymnasium"}


def test_a_case_is_the_same_each_time_and_another_seed_is_another(tmp_path):
    case = Case(5, "two_link", "single", (FRICTION,))
    first, second = (write_case(case, tmp_path / name, tmp_path / f"{name}_labels") for name in ("a", "b"))
    for file in sorted(first.iterdir()):
        assert file.read_bytes() == (second / file.name).read_bytes()
    other, _, _ = simulate(Case(6, "two_link", "single", (FRICTION,)))
    mine = np.loadtxt(first / "rec_0.csv", delimiter=",", skiprows=1)
    assert np.abs(other[0] - mine).max() > 0.01


def test_the_case_folder_holds_model_and_recordings_and_no_word_of_the_label(tmp_path):
    case = Case(5, "two_link", "single", (FRICTION,))
    folder = write_case(case, tmp_path / "cases", tmp_path / "labels")
    assert {file.name for file in folder.iterdir()} == {"model.xml", *(f"rec_{i}.csv" for i in range(RECORDINGS))}
    assert (folder / "model.xml").read_text().strip() == plants()["two_link"].xml.strip()
    text = "".join(file.read_text() for file in folder.iterdir()) + folder.name
    label = json.loads((tmp_path / "labels" / f"{case.name}.json").read_text())
    words = {"coulomb", "friction", "hidden", "single", *map(str, label["plain"].values())}
    assert not [word for word in words if word in text]
    assert label["effects"][0]["where"] == "joint:elbow"
    assert label["effects"][0]["parameters"] == {"frictionloss": 0.05}
    assert column_names("two_link") == (folder / "rec_0.csv").read_text().splitlines()[0].split(",")


def test_cases_of_tasks_say_which_of_their_recordings_begin_at_rest(tmp_path):
    folder = write_case(Case(5, "drawer", "null", ()), tmp_path / "cases", tmp_path / "labels")
    read = recordings(folder)
    assert [recording.at_rest for recording in read] == [True, True, False, True, True, False, True, True]
    drawer = nominal_model("drawer")
    for recording in read:
        start = [recording[f"qpos/joint{i}"][0] for i in range(1, 8)]
        assert recording.at_rest == (np.abs(start - drawer.key_qpos[0][:7]).max() < 0.1)


def replay_error(law):
    """Mean square of a nominal replay's error in units of the noise, over the recordings that start at rest."""
    plant, model = plants()["two_link"], nominal_model("two_link")
    rng, world, data = np.random.default_rng(1), World(plant, law), mujoco.MjData(model)
    steps, squares = round(1 / plant.rate / model.opt.timestep), []
    for i in range(RECORDINGS):
        motion = plant.motion(i, rng)
        run = world.run(motion)
        measured = run.columns + rng.normal(size=run.columns.shape) * plant.sigma
        if i % 3 == 2:
            continue
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = run.qpos[0], run.qvel[0]
        share = HALF_STEP_LEAD / model.opt.timestep  # of the first step, in which the command before is in force
        for k, command in enumerate(run.commands[motion.lead :], motion.lead):
            mujoco.mj_kinematics(model, data)
            predicted = np.concatenate([data.qpos, data.site("tip").xpos])
            squares.append(((predicted - measured[k - motion.lead]) / plant.sigma) ** 2)
            for step in range(steps):
                data.ctrl[:] = command if step else share * run.commands[k - 1] + (1 - share) * command
                mujoco.mj_step(model, data)
    return np.mean(squares)


def test_the_nominal_model_replays_what_hides_nothing_and_not_what_hides_friction():
    assert replay_error(()) < 1.5  # the noise, and what steps four times longer do
    assert replay_error((laws.LuGre("elbow", 0.3, 0.3),)) > 10.0


def test_commands_arrive_late_by_exactly_the_delay():
    rng, substeps = np.random.default_rng(0), 20
    signal = rng.normal(size=(6, 2))
    for delay in (0.0, 0.3e-3, 7e-3, 23e-3):
        arrived = np.concatenate([delayed(signal[: k + 1], k, substeps, delay) for k in range(6)])
        fine = np.repeat(signal, substeps * 10, axis=0)  # a tenth of a step at a time
        shift = round(delay / TIMESTEP * 10)
        late = np.concatenate([np.repeat(signal[:1], shift, axis=0), fine])[: len(fine)]
        np.testing.assert_allclose(arrived, late.reshape(-1, 10, 2).mean(axis=1), atol=1e-12)


def test_nuisances_hide_their_own_direction_and_no_other():
    nuisance = np.zeros((5, 1))
    nuisance[0] = 3.0
    left = reduced(np.array([2.0, 1.0, 0, 0, 0]), nuisance)
    np.testing.assert_allclose(left, [2 / np.sqrt(10), 1, 0, 0, 0], atol=1e-12)
    rng = np.random.default_rng(0)
    vector, several = rng.normal(size=8), rng.normal(size=(8, 3))
    expected = vector @ np.linalg.solve(np.eye(8) + several @ several.T, vector)
    np.testing.assert_allclose(np.sum(reduced(vector, several) ** 2), expected, rtol=1e-10)


def any_place(effect):
    """The first plant that has a place for an effect, and the last place there."""
    return next((plant, places[-1]) for plant in plants().values() if (places := effect.places(plant)))


def columns(plant, law):
    motion = plant.motion(1, np.random.default_rng(0))
    return World(plant, law).run(motion).columns / plant.sigma


@pytest.mark.parametrize("name", [*EFFECTS, *OUTSIDE])
def test_every_effect_shows_and_fades_with_its_magnitude(name):
    effect = (EFFECTS | OUTSIDE)[name]
    plant, place = any_place(effect)
    where = place.split(":")[1]

    def change(magnitude):
        law, parameters = effect.build(plant, where, magnitude, effect.forms[0], np.random.default_rng(0))
        assert all(np.isfinite(value) for value in parameters.values())
        return np.abs(columns(plant, (law,)) - columns(plant, ())).max()

    guess = effect.guess(plant, where)
    assert change(min(5 * guess, effect.limit(plant, where))) > 0.3
    # Motor and link apart leave a trace; a touch begins a step earlier or later; a mount would be too stiff.
    if not effect.sets_apart and name not in ("contact_friction", "soft_mount"):
        assert change(1e-4 * guess) < 0.1


def test_the_splits_have_every_effect_twice_and_no_seed_in_common():
    names = {}
    for split, first in FIRST_SEED.items():
        all_cases = cases(split)
        assert all(first <= case.seed < first + 1000 for case in all_cases)
        singles = [case.hidden[0] for case in all_cases if case.kind == "single"]
        assert sorted(hidden.effect for hidden in singles) == sorted([*EFFECTS] * len(LEVELS))
        assert {kind: sum(case.kind == kind for case in all_cases) for kind in ("null", "outside", "double")} == {
            "null": 10,
            "outside": 10,
            "double": 10,
        }
        assert {case.plant for case in all_cases[:40]} == set(table())
        assert {case.plant for case in cases(split, ("two_link", "arm3"))} == {"two_link", "arm3"}
        names[split] = {case.name for case in all_cases}
        assert len(names[split]) == len(all_cases)
    assert not names["dev"] & names["test"]
    tasks = {hidden.effect for case in cases("dev", ("drawer", "swingpeg")) for hidden in case.hidden}
    assert {*EFFECTS} - tasks == {"contact_friction", "joint_coupling"}  # which have no place there
    with pytest.raises(ValueError, match="no such plants: three_link"):
        cases("dev", ("three_link",))


def test_a_joint_has_one_transmission():
    """Of this seed the first two drawn are its elasticity and its play."""
    hidden = {(h.effect, h.place) for h in _double(9305, "two_link").hidden}
    assert len(hidden) == 2
    assert not {("backlash", "joint:shoulder"), ("joint_elasticity", "joint:shoulder")} <= hidden


def test_a_constant_force_beside_a_spring_is_no_second_effect():
    """Of this seed the first two drawn are a spring of the carriage and a constant force of its drive."""
    hidden = _double(25301, "slide_drive").hidden
    assert len(hidden) == 2
    assert {h.effect for h in hidden} != {"joint_spring", "actuator_bias"}
    spring, force, tilt = (
        Hidden(effect, place, 1.0, True, 10.0, False)
        for effect, place in (
            ("joint_spring", "joint:carriage"),
            ("actuator_bias", "actuator:drive"),
            ("base_tilt", "body:carriage"),
        )
    )
    assert _are_one("slide_drive", (spring, force))
    assert _are_one("slide_drive", (tilt, spring))
    assert not _are_one("slide_drive", (force, tilt))
    assert not _are_one("slide_drive", (replace(spring, same_form=False), force))
    elbow, shoulder = (replace(force, place=f"actuator:{joint}") for joint in ("elbow", "shoulder"))
    spring = replace(spring, place="joint:elbow")
    assert _are_one("arm3", (elbow, spring))
    assert not _are_one("arm3", (shoulder, spring))


def answer(kind, hidden, verdict, named, value=1.0):
    def effect(name, number):
        what, where = name.split("@")
        return {"effect": what, "where": where, "parameters": {"frictionloss": number}, "same_form": True}

    label = {
        "case": "x",
        "plant": "two_link",
        "kind": kind,
        "effects": [effect(name, 1.0) for name in hidden],
        "ratio": 10.0,
        "detectable": kind == "single",
        "equivalents": ["payload@body:a"] if kind == "single" else [],
    }
    found = [effect(name, {"value": value, "unit": "N", "interval95": [value - 0.1, value + 0.1]}) for name in named]
    gap = {"whitened": {"refit": 2.0, "after": 1.1}}
    return Answer(label, {"verdict": verdict, "effects": found, "candidates": [], "gap": gap})


def shares(answers):
    return {rate.name.strip(): (rate.hits, rate.of) for rate in rates(answers)}


def test_the_score_of_right_answers_is_full_and_of_wrong_ones_empty():
    friction, drag = "coulomb_friction@joint:a", "quadratic_drag@joint:a"
    right = shares(
        [
            answer("single", [friction], "named", [friction]),
            answer("single", [friction], "named", ["payload@body:a"]),  # an equivalent
            answer("null", [], "none", []),
            answer("outside", ["crosstalk@joint:a"], "unexplained", []),
            answer("double", [friction, drag], "named", [drag, friction]),
        ]
    )
    wrong = shares(
        [
            answer("single", [friction], "named", [drag], value=2.0),
            answer("single", [friction], "named", [friction], value=2.0),
            answer("null", [], "named", [drag]),
            answer("outside", ["crosstalk@joint:a"], "named", [drag]),
            answer("double", [friction, drag], "named", [drag]),
        ]
    )
    assert right["named first, effect and place"] == (2, 2)
    assert wrong["named first, effect and place"] == (1, 2)
    assert right["wrong name given first"] == (0, 2)
    assert wrong["wrong name given first"] == (1, 2)
    assert right["false alarms on nulls"] == (0, 1)
    assert wrong["false alarms on nulls"] == (1, 1)
    assert right["outside the library: not named as something else"] == (1, 1)
    assert wrong["outside the library: not named as something else"] == (0, 1)
    assert right["two at once, both named"] == (1, 1)
    assert wrong["two at once, both named"] == (0, 1)
    assert right["95 % intervals that hold the truth (same form)"] == (3, 3)
    assert wrong["95 % intervals that hold the truth (same form)"] == (1, 2)
    assert right["excess gap removed by 80 % or more, when named"] == (2, 2)


def test_counts_by_plant():
    friction, drag = "coulomb_friction@joint:a", "quadratic_drag@joint:a"
    answers = [
        answer("single", [friction], "named", [friction]),
        answer("single", [friction], "named", [drag]),
        answer("null", [], "none", []),
        answer("outside", ["crosstalk@joint:a"], "unexplained", []),
        answer("double", [friction, drag], "named", [drag]),
    ]
    assert plant_table(answers)[-1] == "| two_link | 1 of 2 | 0 of 0 | 1 of 2 | 0 of 1 | 1 of 1 | 0 of 1 |"


def test_magnitude_errors_and_confusion_count_what_they_say():
    answers = [
        answer("single", ["coulomb_friction@joint:a"], "named", ["coulomb_friction@joint:a"], value=1.3),
        answer("single", ["quadratic_drag@joint:a"], "unexplained", []),
        answer("null", [], "none", []),
    ]
    assert magnitude_errors(answers)[True] == pytest.approx([0.3])
    rows, counts = confusion(answers)
    assert counts.sum() == 3
    assert counts[rows.index("coulomb_friction"), 0] == 1
    assert counts[rows.index("quadratic_drag"), -1] == 1
    assert counts[rows.index("nothing"), -2] == 1


def test_wilson_interval():
    low, high = Rate("", 9, 10).interval
    assert (low, high) == pytest.approx((0.5958, 0.9821), abs=1e-3)
    assert Rate("", 0, 0).interval == (0.0, 1.0)


def test_what_a_plain_parameter_does_too_counts_by_its_prior():
    plant = replace(plants()["slide_drive"], analysed=2)
    observability = Observability(plant)
    rng = np.random.default_rng(0)
    heavier, _ = EFFECTS["armature"].build(plant, "carriage", 3.0, True, rng)
    # 3 kg in standard deviations of mass (70 kg) and armature (25 kg) at 10 %, and of the drive's gain at 3 %
    by_prior = 3.0 / np.sqrt(7.0**2 + 2.5**2 + (0.03 * 95) ** 2)
    assert np.linalg.norm(observability.direction(heavier)[0]) == pytest.approx(by_prior, rel=0.05)
    rubbing, _ = EFFECTS["coulomb_friction"].build(plant, "carriage", 0.1, True, rng)
    assert np.linalg.norm(observability.direction(rubbing)[0]) > 20  # which no plain parameter does


def test_a_stiff_transmission_counts_the_motors_inertia_once():
    plant = plants()["slide_drive"]
    motion = plant.motion(2, np.random.default_rng(1))
    plain = World(plant).run(motion).columns
    law, _ = EFFECTS["joint_elasticity"].build(plant, "carriage", 0.0, True, np.random.default_rng(0))
    heavier = World(plant, (EFFECTS["armature"].build(plant, "carriage", 25.0, True, np.random.default_rng(0))[0],))
    change = np.abs(World(plant, (law,)).run(motion).columns - plain).max()
    assert change < 0.1 * np.abs(heavier.run(motion).columns - plain).max()
