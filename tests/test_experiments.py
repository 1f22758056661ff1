"""The experiments without their cost: cells are declared, run once, and told as tables, figures and sentences."""

import re
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
import pytest

pytest.importorskip("torch", reason="the experiments train with torch")

from baselines.experiments import ablations, iterations, update_rules
from baselines.experiments.__main__ import QUESTIONS, Experiments
from baselines.experiments.cell import Cell, Store, digest
from baselines.experiments.document import Table, write_document
from baselines.experiments.environments import DRAWER, Randomization, partway, simulator
from baselines.experiments.fits import Problem, adapt
from baselines.experiments.runner import run_cells
from baselines.experiments.settings import Cure
from baselines.experiments.statistics import mean_of, success_of
from baselines.experiments.workspace import SMOKE, Effort, Workspace
from simopt_envs.adaptation import REPS, Discrepancy, Rollouts
from simopt_envs.distributions import Gaussian
from simopt_envs.measured.trajectory import Trajectory

ALL = [cell for question in QUESTIONS.values() for cell in question.cells()]


@dataclass(frozen=True)
class Work:
    """Settings that count how often they run."""

    value: float
    log: str
    fails: type | None = None

    def run(self, seed, workspace):
        with open(self.log, "a") as log:
            log.write(f"{seed}\n")
        if self.fails is not None:
            raise self.fails("on purpose")
        return {"sum": self.value + seed}


def make_store(tmp_path, effort=SMOKE):
    return Store(tmp_path / "cells", effort)


def run(cells, store):
    return run_cells(cells, store, lambda tell: Workspace(store.folder, SMOKE, tell))


def runs(log):
    return [int(line) for line in log.read_text().split()] if log.exists() else []


# -- cells -------------------------------------------------------------------------------------------------------------


def test_cells_have_different_files_and_settings_that_json_holds(tmp_path):
    store = make_store(tmp_path)
    assert len({store.path(cell) for cell in ALL}) == len(ALL)
    for cell in ALL:
        assert store.path(cell).parent == tmp_path / "cells" / cell.question
    for cell in {cell.condition: cell for cell in ALL if cell.seed == 0}.values():
        store.save(cell, {}, 0.0)
        assert store.load(cell) == {}


@pytest.mark.parametrize("name", QUESTIONS)
def test_every_question_has_seeds_and_a_quick_part(name):
    cells = QUESTIONS[name].cells()
    quick = [cell for cell in cells if cell.quick]
    assert {cell.question for cell in cells} == {name}
    assert 0 < len(quick) < len(cells) / 2
    assert all(sum(cell.condition == c.condition for c in cells) >= 5 for cell in cells)


def test_what_the_issue_asks_for_is_declared():
    conditions = {question: {c.condition for c in ALL if c.question == question} for question in QUESTIONS}
    assert {f"{cm}cm-{n}rollouts" for cm in (5, 10, 15, 22) for n in (1, 3, 5)} < conditions["iterations"]
    assert {f"{r}-{n}" for r in ("REPS0.1", "REPS2", "CEM", "CMA-ES") for n in (120, 9600)} < conditions["update_rules"]
    tasks = {"drawer": ("none", "x2cm", "x10cm", "xyz10cm", "oracle-22cm", "SimOpt-22cm", "instance")}
    tasks["peg"] = ("none", "widerope", "widepeg", "widehole", "oracle-far", "SimOpt-far", "instance")
    assert {f"{task}-{name}" for task, names in tasks.items() for name in names} < conditions["randomization"]
    assert conditions["robots"] == {"drawer", "peg", "pendulum"}
    assert len(conditions["ablations"]) == 12


def test_quick_cells_of_different_questions_share_their_runs():
    """A run of SimOpt, the most expensive part, is made once for all questions that look at it."""
    cures = [(cell.settings, cell.seed) for cell in ALL if cell.quick and isinstance(cell.settings, Cure)]
    drawer = [cure for cure in cures if cure[0].start.env == DRAWER]
    assert len(drawer) == 7
    assert len({digest([repr(settings), seed]) for settings, seed in drawer}) == 3


# -- running -----------------------------------------------------------------------------------------------------------


def test_finished_cells_are_not_run_again(tmp_path):
    store, log = make_store(tmp_path), tmp_path / "log"
    cells = [Cell("q", "c", seed, Work(0.5, str(log))) for seed in range(3)]
    assert run(cells[:2], store) == []
    assert run(cells, store) == []
    assert runs(log) == [0, 1, 2]
    assert store.results(cells) == {"c": {0: {"sum": 0.5}, 1: {"sum": 1.5}, 2: {"sum": 2.5}}}


def test_other_settings_or_another_effort_are_run_anew(tmp_path):
    store, log = make_store(tmp_path), tmp_path / "log"
    cell = Cell("q", "c", 7, Work(0.5, str(log)))
    run([cell], store)
    other = replace(cell, settings=Work(0.6, str(log)))
    assert store.load(other) is None
    assert make_store(tmp_path, Effort()).load(cell) is None
    run([other], store)
    assert (store.load(other), store.load(cell)) == ({"sum": 7.6}, None)
    assert runs(log) == [7, 7]


def test_a_failure_keeps_nothing_else_from_running(tmp_path, capsys):
    store, log = make_store(tmp_path), tmp_path / "log"
    cells = [Cell("q", "c", seed, Work(0.0, str(log), RuntimeError if seed == 0 else None)) for seed in range(2)]
    assert run(cells, store) == cells[:1]
    assert "q/c-0: failed, RuntimeError: on purpose" in capsys.readouterr().out
    assert [store.load(cell) for cell in cells] == [None, {"sum": 1.0}]
    run(cells, store)
    assert runs(log) == [0, 1, 0]


def test_an_interruption_keeps_what_is_finished_and_says_how_to_go_on(tmp_path):
    store, log = make_store(tmp_path), tmp_path / "log"
    cells = [Cell("q", "c", seed, Work(0.0, str(log), KeyboardInterrupt if seed == 1 else None)) for seed in range(3)]
    with pytest.raises(KeyboardInterrupt, match=r"in q/c-1; 1 of 3 cells are new. The same command goes on"):
        run(cells, store)
    assert [store.load(cell) for cell in cells] == [{"sum": 0.0}, None, None]
    assert [path.name for path in store.path(cells[0]).parent.iterdir()] == ["c-0.json"]


def test_an_unknown_question_is_refused_before_anything_runs(tmp_path):
    with pytest.raises(ValueError, match="unknown question 'iteration'; did you mean 'iterations'"):
        Experiments(("iteration",), out=tmp_path)


def test_nothing_finished_gives_no_page(tmp_path, capsys):
    assert Experiments(("robots",), out=tmp_path, docs=tmp_path / "docs", report=True).run() == 0
    assert "robots: nothing is finished yet" in capsys.readouterr().out
    assert not (tmp_path / "docs").exists()


# -- statistics --------------------------------------------------------------------------------------------------------


def test_bootstrap_of_the_mean_covers_it():
    """Nominal coverage 95 %; the percentile bootstrap of 20 normal numbers reaches about 93 %."""
    rng = np.random.default_rng(1)
    estimates = [mean_of(rng.normal(3.0, 2.0, 20).tolist()) for _ in range(300)]
    assert 0.89 < np.mean([e.low <= 3.0 <= e.high for e in estimates]) < 0.97
    assert all(e.low < e.mean < e.high for e in estimates)


def test_success_of_covers_rates_that_differ_from_seed_to_seed():
    rng = np.random.default_rng(2)
    true = rng.beta(4, 2, (150, 10))  # mean 2/3
    estimates = [success_of((rng.binomial(100, rates) / 100).tolist(), 100) for rates in true]
    assert 0.87 < np.mean([e.low <= 2 / 3 <= e.high for e in estimates]) < 0.98


def test_perfect_seeds_do_not_make_an_interval_of_zero_width():
    perfect, useless = success_of([1.0] * 5, 100), success_of([0.0] * 5, 100)
    assert (perfect.mean, perfect.seeds) == (1.0, 5)
    assert 0.98 < perfect.low < perfect.high <= 1.0
    assert perfect.above(useless)
    assert not useless.above(perfect)
    assert not success_of([1.0, 0.0], 100).above(success_of([0.5, 0.4], 100))
    assert success_of([1.0], 100).low < perfect.low  # fewer episodes tell less


def test_one_seed_has_no_interval_of_its_mean():
    assert mean_of([2.0]).text() == "2.0"
    assert mean_of([2.0, 4.0]).text() == "3.0 [2.0, 4.0]"
    assert success_of([1.0] * 5, 100).percent == "100 % [99, 100]"
    with pytest.raises(ValueError, match="a number per seed"):
        mean_of([])


# -- tables, figures and sentences from results ------------------------------------------------------------------------


def cure(success, hidden=("cabinet_x",)):
    steps = len(success)
    return {
        "success": success,
        "simulated_success": [1.0] * steps,
        "discrepancy": [70.0 / 10**k for k in range(steps)],
        "medians": [dict.fromkeys(hidden, 0.2)] * steps,
        "steps": [300_000] + [150_000] * (steps - 1),
        "episodes": 100,
    }


def trained(success, steps_to_90=250_000):
    curve = [[3200, None], [250_000, 0.95], [320_000, 0.98]]
    return {
        "success": success,
        "episodes": 100,
        "own_success": 0.98,
        "steps": 320_000,
        "steps_to_90": steps_to_90,
        "curve": curve,
    }


def canned(cell):
    """A result of the kind that the cell's settings give, in which SimOpt works and wide randomization does not."""
    kind = type(cell.settings).__name__
    if kind == "Cure":
        return cure([0.0, 1.0] if cell.seed else [0.0, 0.1, 0.97], cell.settings.hidden)
    if kind in ("Train", "TrainLearned"):
        learned = "oracle" in cell.condition or "learned" in cell.condition
        return trained(dict.fromkeys(cell.settings.targets, 0.98 if learned else 0.02), 250_000 if learned else None)
    if kind == "Instance":
        xi = {"cabinet_x": 0.01 * cell.seed, "cabinet_z": 0.02, "hole_x": 0.01, "hole_z": 0.0}
        return {"xi": xi, "success": float(cell.seed % 3 > 0), "success_before": 0.0, "steps": 3200}
    error = 0.01 if "left_out" in cell.condition or "REPS1-" in cell.condition else 0.1
    path = {"cabinet_x": list(np.linspace(0, 0.15 - error, 11))}
    return {"cabinet_x_error": error * (1 + 0.01 * cell.seed), "distance": 50 * error, "cost": 1.0} | path


class Canned(Store):
    """All cells are finished."""

    def _record(self, cell):
        return {"result": canned(cell), "seconds": 360.0}


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """The pages of canned results, by question."""
    folder = tmp_path_factory.mktemp("experiments")
    store = Canned(folder, Effort())
    return {name: write_document(q, store, folder / "docs").read_text() for name, q in QUESTIONS.items()}, folder


@pytest.mark.parametrize("name", QUESTIONS)
def test_a_page_shows_table_figure_command_and_seeds(pages, name):
    page, folder = pages[0][name], pages[1]
    cells = [cell for cell in ALL if cell.question == name]
    assert page.startswith(f"# {QUESTIONS[name].title}\n")
    assert f"![{QUESTIONS[name].title}]({name}.png)" in page
    assert (folder / "docs" / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    took = f"{6 * len(cells)} min" if len(cells) < 17 else f"{len(cells) / 10:.1f} h"
    assert f"`python -m baselines.experiments {name}`; seeds 0, 1, 2, 3, 4" in page
    assert f"{len(cells)} of {len(cells)} cells, which took {took} in all" in page
    assert "Not run yet" not in page
    assert "nan" not in page
    assert "inf" not in page.replace("infeasible", "").replace("informative", "")


def test_a_part_of_the_results_says_what_is_missing(tmp_path):
    store, question = make_store(tmp_path), QUESTIONS["iterations"]
    for cell in question.cells():
        if cell.quick:
            store.save(cell, canned(cell), 100.0)
    page = write_document(question, store, tmp_path).read_text()
    assert "`python -m baselines.experiments iterations --quick`; seeds 0, 1; 3 of 70 cells" in page
    assert "Not run yet: 5cm-1rollouts, " in page
    assert "| 15 cm | 3 | 2 | 0 % → 55 % → 98 % |" in page
    assert "as seeds differ in how hard they are: 15cm-3rollouts (0, 1); 22cm-3rollouts (0)." in page


def test_randomization_compares_with_the_best_fixed_one(pages):
    page = pages[0]["randomization"]
    assert "| SimOpt | 99 % [97, 100] | 99 % [97, 100] | 100 % [99, 100] | 99 % [97, 100] |" in page
    assert "drawer, 22 cm: SimOpt 99 % [97, 100], from 0 % [0, 1] of the policies it starts with. Its" in page
    assert "drawer: in its own simulations the policy succeeds in " in page
    assert "of 24 instances drawn from xyz 10 cm, a policy trained for each alone could not solve 8 (" in page


def test_iterations_are_counted_until_the_policy_works():
    assert iterations.needed(cure([0.0, 0.2, 0.95])) == 2
    assert iterations.needed(cure([0.92])) == 0
    assert iterations.needed(cure([0.0, 0.89])) == np.inf
    runs = [cure([0.0, 1.0]), cure([0.0, 0.2, 0.4])]
    assert iterations.over_iterations(runs, "success") == [[0.0, 0.0], [1.0, 0.2], [1.0, 0.4]]
    assert iterations.count([np.inf, np.inf, 1.0], runs) == "over 2"


def test_rows_of_a_table_are_as_long_as_its_header(pages):
    tables = [table for page in pages[0].values() for table in re.findall(r"(?:^\|.*\n)+", page, re.MULTILINE)]
    assert len(tables) >= len(pages[0])
    for table in tables:
        assert len({row.count("|") for row in table.splitlines()}) == 1, table


def test_learned_distribution_tells_of_trainings_that_never_succeed(pages):
    page = pages[0]["learned_distribution"]
    assert "| x 10 cm | 5 | 0 of 5 |  | 2 % [1, 4] | 2 % [1, 4] |" in page
    assert "takes 5,000 episodes, against over 6,400 (medians)" in page


def test_update_rules_and_ablations_name_the_best_and_the_worse(pages):
    assert "* 600 rollouts: REPS 1 comes nearest, to 1.0 cm" in pages[0]["update_rules"]
    assert "| REPS 1 | 5 of 5 | 5 of 5 | 5 of 5 | 5 of 5 |" in pages[0]["update_rules"]
    assert "15 cm, open loop: worse; the same seeds end 9.2 [9.1, 9.3] cm farther off" in pages[0]["ablations"]


@pytest.mark.parametrize(("seeds", "verdict"), [(2, "2 seeds, too few to tell"), (5, "worse")])
def test_a_few_seeds_that_agree_tell_nothing(seeds, verdict):
    errors = {"nothing left out": 0.01, "open loop": 0.02}
    results = {
        ablations._condition(name, 0.15): {seed: {"cabinet_x_error": error} for seed in range(seeds)}
        for name, error in errors.items()
    }
    (finding,) = ablations._findings(results)
    assert finding.startswith(f"15 cm, open loop: {verdict}; ")


def test_tables_are_markdown():
    table = Table("Caption.", ["a", "b"], [["1", "2"]])
    assert table.markdown() == "Caption.\n\n| a | b |\n| --- | --- |\n| 1 | 2 |"


# -- parts of the settings ---------------------------------------------------------------------------------------------


def test_randomizations():
    p = Randomization.default(DRAWER, {"cabinet_*": 0.05}).gaussian()
    assert p.std[p.space.index("cabinet_y")] == pytest.approx(0.05)
    assert p.std[p.space.index("drawer_mass")] == pytest.approx(0.2)
    np.testing.assert_allclose(p.median, p.space.nominal)
    truth = Randomization.exactly(DRAWER, {"cabinet_x": 0.22, "drawer_friction": 5.0}).gaussian()
    np.testing.assert_allclose(truth.sample(3, np.random.default_rng(0)), [[0.22, 5.0]] * 3, rtol=1e-4)
    with pytest.raises(ValueError, match="unknown parameter"):
        Randomization.exactly(DRAWER, {"cabinet_w": 0.1}).gaussian()


def test_partway_is_halfway_in_the_logarithm_of_scales():
    nominal = simulator(DRAWER).parameters["drawer_mass"].nominal
    half = partway(DRAWER, {"cabinet_x": 0.2, "drawer_mass": 4 * nominal}, 0.5)
    assert half == pytest.approx({"cabinet_x": 0.1, "drawer_mass": 2 * nominal})


class Line:
    """A simulator: a robot at rest, whose place is observed with ξ's offset added, unless it repeats what was done."""

    def __init__(self, space):
        self.parameters, self.discrepancy_weights, self.observation_names = space, None, ("joint", "handle_x")
        self.simulated = 0

    def make_vector_env(self, num_envs, distribution, seed):
        raise NotImplementedError

    def rollout(self, policy, space, xi, real, seed):
        n, r, steps = len(xi), len(real), len(real[0])
        self.simulated += n
        if policy is None:
            actions = np.tile([trajectory.actions for trajectory in real], (n, 1, 1, 1))
        else:
            actions = np.stack([policy.act(np.zeros((n * r, 2))) for _ in range(steps)], axis=1).reshape(n, r, steps, 1)
        observations = np.zeros((n, r, steps + 1, 2))
        observations[:, :, 1:, 0] = np.cumsum(actions[..., 0], axis=2)
        observations[..., 1] = xi[:, :1, None]
        return Rollouts(observations, actions, np.full((n, r), steps), np.zeros((n, r), bool), None)


class Still:
    def act(self, observations):
        return np.zeros((len(observations), 1))


@pytest.fixture
def problem():
    space = simulator(DRAWER).parameters.subset(["cabinet_x"])
    truth = np.array([0.15])
    noise = 0.001 * np.random.default_rng(0).standard_normal((21, 2))
    real = [Trajectory(np.array([0.0, 0.15]) + noise, np.zeros((20, 1)))]
    cost = Discrepancy().for_channels(("joint", "handle_x"), None)
    return Problem(Line(space), Still(), Gaussian.around_nominal(space, 0.02), truth, real, cost)


@pytest.mark.parametrize(("rule", "rollouts"), [("least squares", 30), ("random search", 300), ("CMA-ES", 300)])
def test_searches_find_an_offset_and_spend_no_more_than_they_may(problem, rule, rollouts):
    if rule == "CMA-ES":
        pytest.importorskip("cma")
        problem = two_dimensional(problem)
    search = update_rules.Search(problem, rollouts)
    with suppress(update_rules.BudgetSpentError):
        update_rules.SEARCHES[rule](search, np.random.default_rng(0))
    assert problem.simulator.simulated <= rollouts
    assert problem.simulator.simulated + search.left == rollouts
    assert search.best[0] == pytest.approx(0.15, abs=0.005)


def two_dimensional(problem):
    """pycma asks for two parameters at least; the second is without effect."""
    space = simulator(DRAWER).parameters.subset(["cabinet_x", "cabinet_y"])
    prior = Gaussian.around_nominal(space, 0.02)
    return replace(problem, simulator=Line(space), prior=prior, truth=np.array([0.15, 0.0]))


def test_the_loop_fits_with_a_fixed_policy(problem):
    medians = adapt(problem, REPS(), 1000, 0, lambda text: None)
    assert len(medians) == 11
    assert medians[0] == pytest.approx(0.0, abs=1e-12)
    assert medians[-1] == pytest.approx(0.15, abs=0.01)
    judged = problem.judge(medians[-1])
    assert judged["distance"] == pytest.approx(judged["cabinet_x_error"] / 0.02)


def test_open_loop_repeats_what_was_done_in_every_rollout(problem):
    done = [0.1 * np.ones((20, 1)), 0.2 * np.ones((20, 1))]
    real = [Trajectory(problem.real[0].observations, actions) for actions in done]
    xi = np.array([[0.0], [0.1], [0.2]])
    rollouts = ablations.OpenLoop(problem.simulator).rollout(Still(), problem.prior.space, xi, real, 0)
    assert rollouts.observations.shape == (3, 2, 21, 2)
    np.testing.assert_allclose(rollouts.observations[:, :, -1, 0], [[2.0, 4.0]] * 3)
    np.testing.assert_allclose(rollouts.observations[:, :, 0, 1], np.tile(xi, 2))
    assert rollouts.lengths.shape == (3, 2)


def test_diagonal_forgets_the_correlations(problem):
    space = two_dimensional(problem).prior.space
    old = Gaussian.around_nominal(space, 0.02)
    rng = np.random.default_rng(0)
    xi = old.sample(300, rng)
    costs = 1e4 * (xi[:, 0] + xi[:, 1] - 0.03) ** 2
    full, diagonal = (update(old, xi, costs, rng) for update in (REPS(), ablations.Diagonal(REPS())))
    assert full.distribution.correlation[0, 1] < -0.3
    assert diagonal.distribution.correlation[0, 1] == 0.0
    np.testing.assert_array_equal(diagonal.distribution.mean, full.distribution.mean)
    assert diagonal.kl == diagonal.distribution.kl(old)


@pytest.mark.slow
def test_all_quick_cells_run_with_next_to_no_effort(tmp_path):
    assert Experiments(quick=True, smoke=True, out=tmp_path).run() == 0
    docs = tmp_path / "docs"  # not where real results are
    assert {path.stem for path in docs.glob("*.md")} == set(QUESTIONS)
    assert {path.name for path in (docs / "cells").iterdir()} == set(QUESTIONS)
