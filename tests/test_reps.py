import numpy as np
import pytest
from scipy.optimize import minimize, minimize_scalar

from simopt_envs.adaptation.trust_region import fit_gaussian, moment_scores, relevance
from simopt_envs.adaptation.updates import CEM, REPS, reps_temperature
from simopt_envs.distributions import Gaussian
from simopt_envs.physics import Parameter, ParameterSpace

RULES = [REPS(), CEM()]


def start(d: int, std: float = 1.0) -> Gaussian:
    space = ParameterSpace(Parameter(f"p{i}", "1", 0.0, -100.0, 100.0, coordinate="linear") for i in range(d))
    return Gaussian.around_nominal(space, std)


def correlated(d: int, rng: np.random.Generator) -> Gaussian:
    factor = rng.standard_normal((d, d)) / np.sqrt(d) + np.eye(d)
    return Gaussian(start(d).space, rng.standard_normal(d), factor @ factor.T * rng.uniform(0.01, 1.0))


def weights_kl(weights: np.ndarray) -> float:
    positive = weights[weights > 0]
    return float(np.sum(positive * np.log(positive * len(weights))))


def test_temperature_of_two_costs_has_a_closed_form():
    # Two draws: KL = log 2 - H(w), so epsilon fixes w, and w = 1 / (1 + exp(-1 / t)).
    w = 0.8
    epsilon = np.log(2) + w * np.log(w) + (1 - w) * np.log(1 - w)
    assert reps_temperature(np.array([5.0, 6.0]), epsilon, 1e-3) == pytest.approx(1 / np.log(w / (1 - w)), rel=1e-9)


@pytest.mark.parametrize("scale", [1e-1, 1.0, 1e6])
def test_temperature_minimises_the_dual(scale):
    costs = scale * np.random.default_rng(0).gamma(2.0, size=200)

    def dual(t: float) -> float:
        return t * 0.7 + t * np.log(np.mean(np.exp(-(costs - costs.min()) / t)))

    best = minimize_scalar(dual, bounds=(1e-2 * scale, 10 * scale), method="bounded", options={"xatol": 1e-9 * scale})
    assert reps_temperature(costs, 0.7, 1e-3) == pytest.approx(best.x, rel=1e-4)


def test_weights_solve_the_constrained_problem():
    costs = np.random.default_rng(1).uniform(0, 3, 12)
    result = REPS(epsilon=0.5)(start(2), np.random.default_rng(2).standard_normal((12, 2)), costs, None)
    assert weights_kl(result.weights) == pytest.approx(0.5, abs=1e-9)
    constraints = [
        {"type": "eq", "fun": lambda w: w.sum() - 1},
        {"type": "ineq", "fun": lambda w: 0.5 - np.sum(w * np.log(w * 12))},
    ]
    best = minimize(
        lambda w: w @ costs,
        np.full(12, 1 / 12),
        bounds=[(1e-9, 1)] * 12,
        constraints=constraints,
        options={"ftol": 1e-14, "maxiter": 1000},
    )
    np.testing.assert_allclose(result.weights, best.x, atol=1e-4)
    assert result.effective_sample_size == pytest.approx(1 / np.sum(result.weights**2))


def test_the_minimum_temperature_holds_where_the_bound_does_not_bind():
    assert REPS()(start(1), [[0.0], [1.0]], [0.0, 1.0], None).temperature == 0.001  # log 2 < epsilon
    assert REPS(minimum_temperature=50.0)(start(1), np.ones((9, 1)), np.arange(9.0), None).temperature == 50.0


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize(("n", "d"), [(1, 3), (2, 3), (5, 26), (40, 26), (128, 26), (960, 26), (128, 1)])
def test_the_realised_kl_obeys_the_bound(rule, n, d):
    rng = np.random.default_rng(n + d)
    for trial in range(8):
        old = correlated(d, rng)
        xi = old.sample(n, rng)
        target = rng.standard_normal(d) * 3
        costs = [
            rng.standard_cauchy(n),
            np.sum((xi - target) ** 2, axis=1) ** rng.uniform(0.5, 2),
            1e6 * np.abs(xi[:, 0] - target[0]),
            rng.integers(0, 2, n).astype(float),
        ][trial % 4]
        result = rule(old, xi, costs, rng)
        assert result.kl <= rule.epsilon + 1e-6
        assert result.kl == pytest.approx(result.distribution.kl(old), abs=1e-9)
        assert np.linalg.eigvalsh(result.distribution.covariance)[0] > 0
        assert result.weights.sum() == pytest.approx(1.0)
        assert ((result.relevance >= 0) & (result.relevance <= 1)).all()


def test_where_the_bound_binds_the_fit_is_a_mixture_of_moments_at_the_bound():
    old, rng = start(1), np.random.default_rng(3)
    z = old.sample(4000, rng)
    weights = np.exp(-5 * (z[:, 0] - 1) ** 2)
    weights /= weights.sum()
    b = relevance(moment_scores(z, weights))[0]
    m = b * (weights @ z[:, 0])
    s = b**2 * (weights @ (z[:, 0] - weights @ z[:, 0]) ** 2) + 1 - b**2
    fit = fit_gaussian(old, z, weights, epsilon=0.3)
    assert fit.kl == pytest.approx(0.3, abs=1e-9)
    r = fit.distribution.mean[0] / m  # 1 / (1 + lambda)
    assert 0 < r < 1
    mixture_variance = r * (s + m**2) + (1 - r) * 1.0 - (r * m) ** 2
    assert fit.distribution.covariance[0, 0] == pytest.approx(mixture_variance, rel=1e-9)


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("n", [1, 3, 200])
def test_equal_costs_leave_the_distribution_as_it_was(rule, n):
    rng = np.random.default_rng(0)
    old = correlated(5, rng)
    costs = np.full(n, 7.0)
    costs[1:2] = np.nan
    result = rule(old, old.sample(n, rng), costs, rng)
    np.testing.assert_allclose(result.distribution.mean, old.mean, atol=1e-12)
    np.testing.assert_allclose(result.distribution.covariance, old.covariance, rtol=1e-10, atol=1e-12)
    assert result.kl < 1e-12


@pytest.mark.parametrize("rule", RULES)
def test_draws_without_a_finite_cost_do_not_count(rule):
    rng = np.random.default_rng(0)
    old = start(3)
    xi = old.sample(60, rng)
    costs = np.sum(xi**2, axis=1)
    broken = costs.copy()
    broken[[3, 4, 5]] = np.nan, np.inf, -np.inf
    kept = np.isfinite(broken)
    result, expected = rule(old, xi, broken, rng), rule(old, xi[kept], costs[kept], rng)
    np.testing.assert_array_equal(result.weights[[3, 4, 5]], 0.0)
    np.testing.assert_array_equal(result.distribution.covariance, expected.distribution.covariance)
    with pytest.raises(ValueError, match="none of the 2 costs is finite"):
        rule(old, xi[:2], [np.nan, np.inf], rng)


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("n", [128, 384, 960])
def test_costs_that_say_nothing_keep_the_spread_and_one_informative_parameter_shrinks(rule, n):
    d = 26
    ratios, shifts = [], []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        old = correlated(d, rng)
        xi = old.sample(n, rng)
        new = rule(old, xi, rng.standard_normal(n), rng).distribution
        ratios.append(new.std / old.std)
        shifts.append((new.mean - old.mean) / old.std)
    assert np.median(np.max(np.abs(np.log(ratios)), axis=1)) < 0.02
    assert abs(np.mean(np.log(ratios))) < 0.005
    assert np.sqrt(np.mean(np.square(shifts))) < 0.06

    old = start(d)
    for seed in range(5):
        rng = np.random.default_rng(seed)
        xi = old.sample(n, rng)
        cost = (xi[:, 4] - 1.5) ** 2 + 0.1 * rng.standard_normal(n)
        result = rule(old, xi, cost, rng)
        others = np.delete(np.arange(d), 4)
        assert result.distribution.mean[4] > 0.8
        assert result.distribution.std[4] < 0.95
        assert result.relevance[4] > 0.8
        assert np.median(np.abs(np.log(result.distribution.std[others]))) < 0.02
        assert np.abs(result.distribution.mean[others]).mean() < 0.05


def test_a_raw_weighted_fit_would_not_keep_the_spread():
    """The negative control of the test above: the same kind of draws without relevance."""
    rng = np.random.default_rng(0)
    old = start(26)
    xi = old.sample(128, rng)
    weights = REPS()(old, xi, rng.standard_normal(128), rng).weights
    centred = xi - weights @ xi
    covariance = centred.T * weights @ centred
    assert np.abs(np.log(np.sqrt(np.diag(covariance)))).max() > 0.1
    assert np.linalg.eigvalsh(covariance)[0] < 0.3


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize(("d", "n", "updates"), [(3, 128, 15), (26, 960, 25)])
def test_repeated_updates_find_the_minimum_of_a_quadratic(rule, d, n, updates):
    rng = np.random.default_rng(d)
    target, stretch = rng.uniform(-1, 1, d), rng.uniform(0.5, 2.0, d)
    distribution = start(d)
    for _ in range(updates):
        xi = distribution.sample(n, rng)
        distribution = rule(distribution, xi, np.sum(stretch * (xi - target) ** 2, axis=1), rng).distribution
    np.testing.assert_allclose(distribution.mean, target, atol=0.25)
    assert np.sqrt(np.mean((distribution.mean - target) ** 2)) < 0.1
    assert distribution.std.max() < 0.5


def test_a_symmetric_cost_narrows_without_moving():
    old, rng = start(3), np.random.default_rng(0)
    xi = old.sample(960, rng)
    new = REPS()(old, xi, xi[:, 1] ** 2, rng).distribution
    assert new.std[1] < 0.5
    assert np.abs(new.mean).max() < 0.1
    np.testing.assert_allclose(new.std[[0, 2]], 1.0, atol=0.05)


def test_a_correlated_cost_gives_a_correlated_distribution():
    distribution, rng = start(6), np.random.default_rng(0)
    for _ in range(4):
        xi = distribution.sample(500, rng)
        distribution = REPS()(distribution, xi, (xi[:, 0] + xi[:, 1] - 1) ** 2, rng).distribution
    assert distribution.correlation[0, 1] < -0.8
    assert np.abs(distribution.correlation[2:, :2]).max() < 0.2


@pytest.mark.parametrize("std_floor", [0.2, [0.2, 0.3, 2.0]])
def test_no_spread_falls_below_the_floor(std_floor):
    rng = np.random.default_rng(0)
    rule = REPS()
    distribution = start(3)
    for _ in range(12):
        xi = distribution.sample(300, rng)
        result = rule(distribution, xi, np.sum((xi - 0.5) ** 2, axis=1), rng, std_floor)
        assert result.kl <= 1 + 1e-6
        distribution = result.distribution
    reachable = np.minimum(np.broadcast_to(std_floor, 3), 1.0)  # a floor above the first spread does not widen it
    assert (distribution.std >= reachable - 1e-9).all()
    np.testing.assert_allclose(distribution.std[:2], reachable[:2], rtol=0.05)


def test_the_floor_of_default_is_a_thousandth_of_the_bounds():
    rng, distribution = np.random.default_rng(0), start(1)
    for _ in range(12):
        xi = distribution.sample(200, rng)
        distribution = REPS()(distribution, xi, 1e4 * xi[:, 0] ** 2, rng).distribution
    assert distribution.std[0] == pytest.approx(0.2, rel=1e-6)


def test_scores_are_chi_squared_by_chance():
    rng = np.random.default_rng(0)
    scores = []
    for _ in range(300):
        weights = rng.gamma(0.3, size=200)
        scores.append(moment_scores(rng.standard_normal((200, 5)), weights / weights.sum()))
    assert np.mean(scores) == pytest.approx(2.0, abs=0.2)
    np.testing.assert_array_equal(moment_scores(rng.standard_normal((8, 2)), np.full(8, 1 / 8)), 0.0)


def test_relevance_tells_a_strong_parameter_from_the_rest_and_sees_many_weak_ones():
    rng = np.random.default_rng(0)
    noise = rng.chisquare(2, (50, 26))
    assert np.mean([relevance(row) for row in noise]) < 0.1
    one = np.array([relevance(np.append(row, 60.0)) for row in noise])
    assert one[:, -1].mean() > 0.9
    assert one[:, :-1].mean() < 0.1
    assert np.mean([relevance(row + 10.0) for row in noise]) > 0.6


@pytest.mark.parametrize(
    ("rule", "message"),
    [
        (lambda: REPS(epsilon=0.0), "epsilon must be positive"),
        (lambda: REPS(minimum_temperature=np.nan), "minimum_temperature must be positive"),
        (lambda: CEM(elite_fraction=1.5), "elite_fraction must be at most 1"),
        (lambda: REPS()(start(2), np.zeros((4, 3)), np.zeros(4), None), r"xi \(n, 2\) and costs \(n,\)"),
        (lambda: REPS()(start(2), np.full((4, 2), np.nan), np.zeros(4), None), "not valid physics"),
        (lambda: REPS()(start(2), np.zeros((4, 2)), np.zeros(4), None, std_floor=-1.0), "std_floor must be"),
    ],
)
def test_wrong_arguments_are_refused(rule, message):
    with pytest.raises(ValueError, match=message):
        rule()
