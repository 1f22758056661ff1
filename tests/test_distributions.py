import json

import numpy as np
import pytest
from scipy import stats

from simopt_envs.distributions import Distribution, EpisodeDraws, Gaussian, Mixture, Uniform, distribution_from_dict
from simopt_envs.physics import Parameter, ParameterSpace

SPACE = ParameterSpace(
    [
        Parameter("mass", "kg", nominal=2.0, low=0.01, high=100.0),
        Parameter("damping", "N s/m", nominal=0.5, low=0.001, high=50.0),
        Parameter("offset", "m", nominal=0.0, low=-3.0, high=3.0, coordinate="linear"),
    ]
)
COVARIANCE = np.array([[0.09, 0.03, -0.01], [0.03, 0.04, 0.0], [-0.01, 0.0, 0.01]])


def gaussian(shift: float = 0.0) -> Gaussian:
    return Gaussian(SPACE, np.array([0.2, -0.5, 0.1]) + shift, COVARIANCE)


def mixture() -> Mixture:
    return Mixture([1.0, 3.0], [gaussian(-0.4), gaussian(0.4)])


def uniform() -> Uniform:
    return Uniform(SPACE, [1.0, 0.2, -0.5], [4.0, 1.0, 1.0])


def in_coordinates(distribution: Distribution, n: int) -> np.ndarray:
    return SPACE.to_unconstrained(distribution.sample(n, np.random.default_rng(1)))


def test_gaussian_density_and_entropy_equal_scipy():
    x = gaussian().sample(50, np.random.default_rng(0))
    reference = stats.multivariate_normal(gaussian().mean, COVARIANCE)
    np.testing.assert_allclose(gaussian().log_prob(x), reference.logpdf(SPACE.to_unconstrained(x)), rtol=1e-12)
    assert gaussian().log_prob(x[0]).shape == ()
    assert gaussian().entropy() == pytest.approx(reference.entropy(), rel=1e-12)
    assert gaussian().log_prob([-1.0, 0.5, 0.0]) == -np.inf


def test_gaussian_entropy_is_the_same_to_the_last_digit_wherever_its_arrays_lie():
    space, rng, held = SPACE.subset(["mass", "damping"]), np.random.default_rng(0), []
    for _ in range(10):
        covariance, entropies = np.diag(rng.uniform(0.01, 0.1, 2)), set()
        for _ in range(1000):
            held.append(np.empty(rng.integers(1, 8)))  # so that memory is given out and back in another order
            if rng.random() < 0.5:
                held.pop(rng.integers(len(held)))
            entropies.add(Gaussian(space, [0.0, 0.0], covariance).entropy())
        assert len(entropies) == 1


def test_gaussian_kl_equals_the_textbook_formula_and_a_sample_mean():
    p, q = gaussian(), Gaussian(SPACE, [0.0, -0.6, 0.2], np.diag([0.2, 0.05, 0.02]))
    inverse, shift = np.linalg.inv(q.covariance), q.mean - p.mean
    expected = 0.5 * (
        np.trace(inverse @ p.covariance)
        + shift @ inverse @ shift
        - 3
        + np.log(np.linalg.det(q.covariance) / np.linalg.det(p.covariance))
    )
    assert p.kl(q) == pytest.approx(expected, rel=1e-12)
    assert p.kl(p) == pytest.approx(0.0, abs=1e-12)
    x = p.sample(40_000, np.random.default_rng(0))
    assert np.mean(p.log_prob(x) - q.log_prob(x)) == pytest.approx(expected, abs=0.05)


@pytest.mark.parametrize("distribution", [gaussian(), uniform(), mixture()], ids=lambda d: d.kind)
def test_draws_have_the_moments_that_are_stated(distribution):
    z = in_coordinates(distribution, 40_000)
    spread = np.sqrt(np.diag(distribution.covariance))
    np.testing.assert_array_less(np.abs(z.mean(axis=0) - distribution.mean), 5 * spread / np.sqrt(len(z)))
    np.testing.assert_allclose(
        np.cov(z.T) / np.outer(spread, spread), distribution.covariance / np.outer(spread, spread), atol=0.05
    )


@pytest.mark.parametrize("distribution", [gaussian(), uniform(), mixture()], ids=lambda d: d.kind)
def test_the_density_integrates_to_one(distribution):
    proposal = Gaussian(SPACE, distribution.mean, 2 * distribution.covariance)
    x = proposal.sample(100_000, np.random.default_rng(0))
    assert np.mean(np.exp(distribution.log_prob(x) - proposal.log_prob(x))) == pytest.approx(1.0, abs=0.03)


def test_gaussian_draws_pass_a_kolmogorov_test_and_a_wrong_law_does_not():
    z = in_coordinates(gaussian(), 5000)
    for i, (mean, std) in enumerate(zip(gaussian().mean, gaussian().std, strict=True)):
        assert stats.kstest(z[:, i], stats.norm(mean, std).cdf).pvalue > 1e-4
        assert stats.kstest(z[:, i], stats.norm(mean, 1.2 * std).cdf).pvalue < 1e-4


def test_draws_outside_the_bounds_are_drawn_again():
    space = ParameterSpace([Parameter("x", "m", 0.0, -1.0, 1.0, coordinate="linear")])
    x = Gaussian(space, [0.5], [[1.0]]).sample(20_000, np.random.default_rng(0))[:, 0]
    assert np.abs(x).max() <= 1.0
    assert stats.kstest(x, stats.truncnorm(-1.5, 0.5, loc=0.5).cdf).pvalue > 1e-4
    with pytest.raises(ValueError, match=r"within the parameters' bounds(.|\n)*x = 9 m"):
        Gaussian(space, [9.0], [[0.01]]).sample(1, np.random.default_rng(0))


def test_median_std_and_marginal():
    g = Gaussian.around_nominal(SPACE, [0.1, 0.2, 0.3])
    np.testing.assert_allclose(g.median, SPACE.nominal, rtol=1e-14)
    np.testing.assert_allclose(g.std, [0.1, 0.2, 0.3], rtol=1e-14)
    np.testing.assert_allclose(Gaussian.around_nominal(SPACE, 0.1).std, 0.1)
    part = gaussian().marginal(["offset", "mass"])
    assert part.space.names == ("offset", "mass")
    np.testing.assert_array_equal(part.covariance, [[0.01, -0.01], [-0.01, 0.09]])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([0, 0], np.eye(3)), r"mean must have shape \(3,\)"),
        (([0, 0, np.nan], np.eye(3)), "mean must be finite"),
        (([0, 0, 0], np.eye(2)), r"covariance must have shape \(3, 3\)"),
        (([0, 0, 0], np.diag([1, 1, -1])), "positive definite; its smallest eigenvalue is -1"),
        (([0, 0, 0], np.diag([1, 1, 0])), "positive definite"),
        (([0, 0, 0], [[1, 0.5, 0], [0, 1, 0], [0, 0, 1]]), "symmetric; mass with damping is 0.5"),
        (([0, 0, 0], np.full((3, 3), np.inf)), "covariance must be finite"),
    ],
)
def test_a_gaussian_that_cannot_be_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Gaussian(SPACE, *arguments)


@pytest.mark.parametrize("std", [0.0, -1.0, [0.1, 0.2], [0.1, np.nan, 0.1]])
def test_a_wrong_std_is_refused(std):
    with pytest.raises(ValueError, match="std must be"):
        Gaussian.around_nominal(SPACE, std)


def test_uniform_entropy_and_kl():
    widths = np.array([np.log(4), np.log(5), 1.5])
    assert uniform().entropy() == pytest.approx(np.log(widths).sum())
    wider = Uniform(SPACE, [0.5, 0.1, -1.0], [8.0, 2.0, 2.0])
    assert uniform().kl(wider) == pytest.approx(wider.entropy() - uniform().entropy())
    assert wider.kl(uniform()) == np.inf
    with pytest.raises(ValueError, match="'mass': low must be less than high"):
        Uniform(SPACE, [4.0, 0.2, 0.0], [1.0, 1.0, 1.0])
    with pytest.raises(ValueError, match="out of bounds"):
        Uniform(SPACE, [1.0, 0.2, 0.0], [1000.0, 1.0, 1.0])


def test_mixture_of_one_is_its_component_and_kl_is_that_of_the_closed_form():
    one = Mixture([2.0], [gaussian()])
    x = gaussian().sample(10, np.random.default_rng(0))
    np.testing.assert_allclose(one.log_prob(x), gaussian().log_prob(x), rtol=1e-12)
    assert one.entropy() == pytest.approx(gaussian().entropy(), abs=0.05)
    assert one.kl(gaussian(0.1)) == pytest.approx(gaussian().kl(gaussian(0.1)), abs=0.05)
    with pytest.raises(ValueError, match="positive and finite"):
        Mixture([1.0, -1.0], [gaussian(), gaussian()])


def test_kl_needs_the_same_kind_and_space():
    with pytest.raises(TypeError, match="needs a Gaussian, got Uniform"):
        gaussian().kl(uniform())
    with pytest.raises(ValueError, match="equal spaces"):
        gaussian().kl(gaussian().marginal(["mass"]))


@pytest.mark.parametrize("distribution", [gaussian(), uniform(), mixture()], ids=lambda d: d.kind)
def test_a_description_survives_json(distribution):
    larger = ParameterSpace([Parameter("other", "1", 1.0, 0.1, 10.0), *SPACE])
    again = distribution_from_dict(json.loads(json.dumps(distribution.to_dict())), larger)
    assert type(again) is type(distribution)
    assert again.space == SPACE
    x = distribution.sample(5, np.random.default_rng(0))
    np.testing.assert_array_equal(again.sample(5, np.random.default_rng(0)), x)
    np.testing.assert_array_equal(again.log_prob(x), distribution.log_prob(x))


def test_a_wrong_description_is_refused():
    with pytest.raises(ValueError, match="did you mean 'gaussian'"):
        distribution_from_dict({"kind": "gausian"}, SPACE)
    with pytest.raises(ValueError, match="lacks 'mean'"):
        distribution_from_dict({"kind": "gaussian", "parameters": ["mass"]}, SPACE)
    with pytest.raises(ValueError, match="unknown parameter 'mas'; did you mean 'mass'"):
        distribution_from_dict({"kind": "gaussian", "parameters": ["mas"], "mean": [0], "covariance": [[1]]}, SPACE)


class Fixed:
    """A user's own distribution: nothing but ``sample``."""

    def __init__(self, row):
        self.row = row

    def sample(self, n, rng):
        return np.tile(self.row, (n, 1))


def test_draws_of_a_world_depend_on_its_seed_alone():
    alone, many = EpisodeDraws(SPACE, gaussian(), 1), EpisodeDraws(SPACE, gaussian(), 3)
    alone.seed(6)
    many.seed(5)
    second_world = many([0, 1, 2])[1], many([1])[0], many([2, 1])[1]
    np.testing.assert_array_equal([alone([0])[0] for _ in range(3)], second_world)
    alone.seed(7)
    assert not np.array_equal(alone([0])[0], second_world[0])
    many.seed([None, 6, None])
    np.testing.assert_array_equal(many([1])[0], second_world[0])


def test_draws_are_independent_of_the_stream_of_an_environment_with_that_seed():
    draws = EpisodeDraws(SPACE, Uniform(SPACE, SPACE.low, SPACE.high), 1)
    draws.seed(3)
    fraction = (draws([0])[0, 2] - SPACE.low[2]) / (SPACE.high[2] - SPACE.low[2])
    assert not np.isclose(np.random.default_rng(3).random(10), fraction).any()


def test_draws_of_some_parameters_leave_the_rest_nominal():
    draws = EpisodeDraws(SPACE, gaussian().marginal(["offset", "damping"]))
    xi = draws([0])[0]
    assert xi[0] == SPACE.nominal[0]
    assert (xi[1:] != SPACE.nominal[1:]).all()


def test_a_sampler_alone_is_enough_and_is_checked():
    np.testing.assert_array_equal(
        EpisodeDraws(SPACE, Fixed([1.0, 2.0, 0.5]), 2)([0, 1]), np.tile([1.0, 2.0, 0.5], (2, 1))
    )
    with pytest.raises(ValueError, match=r"Fixed.sample\(1, rng\) must have shape \(1, 3\)"):
        EpisodeDraws(SPACE, Fixed([1.0, 2.0]))([0])
    with pytest.raises(ValueError, match=r"'mass' .*out of bounds"):
        EpisodeDraws(SPACE, Fixed([-1.0, 2.0, 0.0]))([0])
    with pytest.raises(TypeError, match="needs a method sample"):
        EpisodeDraws(SPACE, object())
    other = ParameterSpace([Parameter("masses", "kg", 1.0, 0.1, 10.0)])
    with pytest.raises(ValueError, match="unknown parameter 'masses'; did you mean 'mass'"):
        EpisodeDraws(SPACE, Gaussian.around_nominal(other, 0.1))
