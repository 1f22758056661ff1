"""The loop on a toy: it finds what is hidden, leaves alone what is right, and says when no ξ will do."""

import json
from functools import partial

import numpy as np
import pytest
from toy_reach import SPACE, LeanTrainer, PushPolicy, ReachEnv

from simopt_envs.adaptation import Discrepancy, EnvSimulator, HiddenSystem, RecordedSystem, SimOpt
from simopt_envs.adaptation.search import is_stuck, own_and_far, sample_further_out, update_further_out
from simopt_envs.adaptation.updates import REPS
from simopt_envs.distributions import Gaussian

XI = SPACE.subset(["gain", "force"])
START = Gaussian.around_nominal(XI, std=[0.2, 0.2])


def make(target=None, seed=0, **changes):
    system = changes.pop("real_system", None) or HiddenSystem("Toy/Reach-v0", target or {}, noise=0.002, dropout=0.05)
    arguments = {"trainer": LeanTrainer(), "simulated_rollouts": 300, "evaluation_episodes": 20} | changes
    return SimOpt(env_id="Toy/Reach-v0", distribution=START, real_system=system, seed=seed, **arguments)


@pytest.mark.parametrize("seed", range(5))
def test_finds_what_is_hidden(seed):
    """Three initial standard deviations away in one parameter, 1.3 in the other."""
    first, *_, last = make({"force": 0.6, "gain": 1.3}, seed).run(3)
    assert first.target_success == 0.0
    assert first.distribution is START
    assert (first.kl, first.effective_sample_size) == (0.0, None)
    assert last.target_success == 1.0
    np.testing.assert_allclose(last.distribution.median, [1.3, 0.6], atol=0.03)
    assert last.verdict.label != "unexplained"
    assert last.discrepancy_mean < 0.1 * first.discrepancy_mean
    assert last.policy.trainings == 4
    assert 0 < last.kl <= 1 + 1e-6
    assert 1 < last.effective_sample_size < 100
    assert (last.real_rollouts, last.sim_rollouts, last.train_steps) == (3, 900, 40 * 64)
    assert last.best_xi["force"] == pytest.approx(0.6, abs=0.05)


@pytest.mark.parametrize("seed", range(4))
def test_leaves_alone_what_is_right(seed):
    first, *_, last = make({}, seed).run(2)
    assert first.target_success == last.target_success == 1.0
    assert first.verdict.label == "explained"
    assert (np.abs(last.distribution.mean - START.mean) < 0.5 * START.std).all()


@pytest.mark.parametrize("looks_further", [True, False])
def test_looks_further_where_it_is_stuck(looks_further, monkeypatch):
    """Nothing moves in any simulation from within four standard deviations of nominal."""
    if not looks_further:
        monkeypatch.setattr("simopt_envs.adaptation.simopt.is_stuck", lambda lowest, explained: False)
    latched = partial(ReachEnv, latch=0.8)
    counts = {"simulated_rollouts": 120, "real_rollouts": 1, "updates_per_iteration": 12, "evaluation_episodes": 0}
    loop = SimOpt(
        EnvSimulator(latched),
        START,
        LeanTrainer(),
        HiddenSystem(latched, {"force": 1.0}, noise=0.002),
        seed=0,
        **counts,
    )
    *_, last = loop.run(1)
    found = last.distribution.median[1] == pytest.approx(1.0, abs=0.1)
    assert (found, last.verdict.label != "unexplained") == (looks_further, looks_further)


@pytest.mark.parametrize(
    ("lowest", "stuck"),
    [
        ([], False),
        ([9, 9, 9], False),
        ([9, 9, 9, 9], True),  # three brought nothing
        ([9, 8, 7, 6, 5], False),
        ([9, 8.7, 8.4, 8, 7.7, 7.4, 7.1], False),  # a tenth within three
        ([9, 9, 9, 9, (9, 4), (9, 4), (9, 4)], True),  # one that looked further out brought much
        ([9, 9, 9, 9, 9, 9, 9], False),  # three that looked further out brought nothing either
        ([9, 9, 9, 9, 9, 9, 9, 9, 9, 9], True),
        ([9, 9, 9, 9, (9, 0.5), (4, 0.5)], True),  # p(ξ) is on its way to what explains
        ([9, 9, 9, 9, (9, 0.5), (0.9, 0.5)], False),  # there
        ([9, 9, 9, 9, (0.9, 0.5), 9, 9, np.inf], False),
        ([9, 9, 9, 9, (0.9, 0.5), 9, 9, 9, np.inf], True),
    ],
)
def test_is_stuck(lowest, stuck):
    """Lowest costs of updates; of those that looked further out, of p(ξ)'s own draws and of the others."""
    assert is_stuck([np.broadcast_to(costs, 2).astype(float) for costs in lowest], explained=1.0) is stuck


def test_goes_on_from_further_out_only_where_that_is_better():
    """Half of the draws are three times as wide, all are valid, and p(ξ) keeps its width where costs are noise."""
    rng = np.random.default_rng(0)
    moved = Gaussian(XI, START.mean - np.array([0.0, 0.5]), START.covariance / 4)
    xi = sample_further_out(moved, START, 40_000, rng)
    assert XI.contains(xi).all()
    for drawn, p, width in zip(own_and_far(XI.to_unconstrained(xi)), (moved, START), (1, 3), strict=True):
        np.testing.assert_allclose(drawn.mean(axis=0), p.mean, atol=0.01)
        np.testing.assert_allclose(drawn.std(axis=0), width * p.std, rtol=0.03)
    force = xi[:, 1]
    better = update_further_out(REPS(), moved, START, xi, np.abs(force - 0.8), rng, 0.0).distribution
    assert better.mean[1] > START.mean[1] + 2 * START.std[1]
    assert better.std[0] == pytest.approx(START.std[0], rel=0.05)
    costs = np.abs(force + 0.5)
    own, own_costs = own_and_far(xi)[0], own_and_far(costs)[0]
    as_ever = update_further_out(REPS(), moved, START, xi, costs, rng, 0.0).distribution
    np.testing.assert_array_equal(as_ever.mean, REPS()(moved, own, own_costs, rng, 0.0).distribution.mean)


def test_says_when_no_parameter_explains_it():
    shaken = HiddenSystem(partial(ReachEnv, disturbance=4.0), {}, noise=0.002)
    *_, last = make(real_system=shaken).run(3)
    assert last.verdict.label == "unexplained"
    assert last.verdict.best > 3 * last.verdict.threshold


def test_says_when_the_measurements_tell_nothing():
    blind = HiddenSystem("Toy/Reach-v0", {}, noise=5.0)
    [first] = make(real_system=blind).run(0)
    assert first.verdict.label == "uninformative"


def test_runs_repeat_and_seeds_differ():
    target = {"force": 0.4}
    *_, a = make(target, 3).run(1)
    *_, b = make(target, 3).run(1)
    *_, c = make(target, 4).run(1)
    np.testing.assert_array_equal(a.distribution.mean, b.distribution.mean)
    np.testing.assert_array_equal(a.costs, b.costs)
    assert (a.distribution.mean != c.distribution.mean).all()


def test_a_foreign_environment_and_robot():
    """Single environments in Gymnasium's own vector environment, and a robot that only rolls out."""

    class Robot:
        def rollout(self, policy, n, rng):
            return HiddenSystem(ReachEnv, {"force": 0.6}).rollout(policy, n, rng)

    loop = SimOpt(EnvSimulator(ReachEnv), START, LeanTrainer(), Robot(), simulated_rollouts=90)
    first, *_, last = loop.run(2)
    assert loop.discrepancy.weights == (1.0, 0.5)
    assert (first.target_success, last.target_success) == (0.0, 1.0)


def test_a_fixed_policy_is_kept():
    policy = PushPolicy(lean=-0.3)
    *_, last = make({"force": 0.4}, trainer=None, policy=policy).run(2)
    assert last.policy is policy
    assert last.train_steps == 0
    assert last.distribution.median[1] == pytest.approx(0.4, abs=0.03)


@pytest.mark.parametrize("trainer", [None, LeanTrainer()])
def test_recordings_are_replayed(trainer):
    """Whatever policy made them, and also where one of another lean is trained."""
    recorder = HiddenSystem("Toy/Reach-v0", {"force": 0.4})
    recordings = RecordedSystem(recorder.rollout(PushPolicy(lean=-1.5), 3, np.random.default_rng(0)))
    *_, last = make(real_system=recordings, trainer=trainer).run(2)
    assert last.distribution.median[1] == pytest.approx(0.4, abs=0.05)
    assert last.verdict.label == "explained"
    assert last.discrepancy_min < 0.1
    np.testing.assert_array_equal(last.simulated[0].actions, last.real[0].actions)


def test_a_policy_that_recordings_were_made_with_acts():
    policy = PushPolicy(lean=-1.5)
    recordings = HiddenSystem("Toy/Reach-v0", {"force": 0.4}).rollout(policy, 3, np.random.default_rng(0))
    *_, last = make(real_system=RecordedSystem(recordings), trainer=None, policy=policy).run(2)
    assert last.distribution.median[1] == pytest.approx(0.4, abs=0.05)
    assert np.abs(last.simulated[0].actions - last.real[0].actions).max() > 0


def test_an_environment_that_does_not_begin_where_it_is_told_is_told_before_any_training():
    class Restless(ReachEnv):
        def reset(self, *, seed=None, options=None):
            return super().reset(seed=seed)

    with pytest.raises(ValueError, match="Restless ignores"):
        SimOpt(EnvSimulator(Restless), START, LeanTrainer(), HiddenSystem(ReachEnv, {}))


def test_diverged_simulations_do_not_count():
    import gymnasium as gym
    from toy_reach import ReachVectorEnv

    for limit, identifier in ((1.4, "Toy/Explodes-v0"), (0.0, "Toy/AlwaysExplodes-v0")):
        if identifier not in gym.registry:
            gym.register(
                identifier, entry_point=ReachEnv, vector_entry_point=partial(ReachVectorEnv, explode_above=limit)
            )
    system = HiddenSystem("Toy/Reach-v0", {"force": 0.4, "gain": 1.2})
    *_, last = SimOpt("Toy/Explodes-v0", START, LeanTrainer(), system, simulated_rollouts=300).run(1)
    np.testing.assert_allclose(last.distribution.median, [1.2, 0.4], atol=0.1)
    assert np.isinf(last.costs).sum() == (last.xi[:, 0] > 1.4).sum()
    with pytest.raises(RuntimeError, match="diverged for every one"):
        list(SimOpt("Toy/AlwaysExplodes-v0", START, LeanTrainer(), system).run(1))


def test_result_file(tmp_path):
    records = list(make({"force": 0.4}, 5, directory=tmp_path / "out").run(1))
    result = json.loads((tmp_path / "out/result.json").read_text())
    assert result["env_id"] == "Toy/Reach-v0"
    assert result["seed"] == 5
    assert result["parameter_names"] == ["gain", "force"]
    assert result["coordinates"] == ["log", "linear"]
    assert [entry["index"] for entry in result["iterations"]] == [0, 1]
    for entry, record in zip(result["iterations"], records, strict=True):
        assert entry == json.loads(json.dumps(record.to_dict()))
        assert entry["mean"] == record.distribution.mean.tolist()
        assert np.shape(entry["covariance"]) == (2, 2)
        np.testing.assert_allclose(entry["std"], np.sqrt(np.diag(entry["covariance"])))
        assert entry["discrepancy"]["min"] <= entry["discrepancy"]["mean"]
        contract = "kl effective_sample_size target_success sim_success train_seconds train_steps sim_rollouts"
        assert set(contract.split()) | {"real_rollouts"} <= entry.keys()


class Forgetful:
    def __call__(self, make_vector_env, policy, rng):
        raise AssertionError("no work may have begun")


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"real_rollouts": 0}, ValueError, "real_rollouts must be at least 1, got 0"),
        ({"simulated_rollouts": 5}, ValueError, "simulated_rollouts must be at least 6"),
        ({"updates_per_iteration": 0}, ValueError, "updates_per_iteration"),
        ({"discrepancy": Discrepancy([1.0, 1.0, 1.0])}, ValueError, "one per observed channel, 2"),
        ({"trainer": None}, ValueError, "give a trainer or a policy"),
        ({"trainer": Forgetful(), "directory": "out"}, TypeError, "Forgetful has no save and load"),
    ],
)
def test_bad_arguments(changes, error, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(error, match=message):
        make(**changes)
    assert not list(tmp_path.iterdir())


def test_unknown_parameters():
    from simopt_envs.physics import Parameter, ParameterSpace

    other = ParameterSpace([Parameter("forces", "N", 0.0, -1.0, 1.0, coordinate="linear")])
    with pytest.raises(ValueError, match="unknown parameter 'forces'; did you mean 'force'"):
        SimOpt("Toy/Reach-v0", Gaussian.around_nominal(other, 0.1), Forgetful(), HiddenSystem(ReachEnv, {}))
    with pytest.raises(ValueError, match="iterations must be >= 0"):
        make().run(-1)


def test_a_robot_of_other_channels():
    class Robot:
        def rollout(self, policy, n, rng):
            from simopt_envs.measured.trajectory import Trajectory

            return [Trajectory(np.zeros((4, 3)), np.zeros((3, 1)))]

    with pytest.raises(ValueError, match="3 observed channels, the simulator 2"):
        list(make(real_system=Robot()).run(0))
