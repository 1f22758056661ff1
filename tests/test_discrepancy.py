"""Eq. 4 against a slow literal reading of it, and the verdict."""

import math

import numpy as np
import pytest

from simopt_envs.adaptation.discrepancy import Discrepancy, judge, noise_std
from simopt_envs.adaptation.rollouts import Rollouts
from simopt_envs.measured.trajectory import Trajectory

WEIGHTS, PREVIOUS = (0.5, 1.0, 2.0), (0.0, 0.3, 1.0)


def measured(rng, steps=30, channels=3, dropout=0.0):
    walk = np.cumsum(rng.standard_normal((steps + 1, channels)), axis=0) * 0.1
    lost = rng.random((steps + 1, 1)) < dropout
    lost[0] = False
    return Trajectory(np.where(lost, np.nan, walk), np.zeros((steps, 1)))


def simulated(rng, n, real, lengths=None, diverged=None):
    """n ξ x r rollouts near the measured ones, of the given numbers of steps (n, r)."""
    longest = max(map(len, real))
    base = np.zeros((len(real), longest + 1, real[0].observations.shape[1]))
    observations = base + rng.standard_normal((n, *base.shape))
    lengths = np.full((n, len(real)), longest) if lengths is None else np.array(lengths)
    observations[np.arange(longest + 1) > lengths[..., None]] = np.nan
    actions = np.zeros((*observations.shape[:2], longest, 1))
    diverged = np.zeros((n, len(real)), dtype=bool) if diverged is None else diverged
    return Rollouts(observations, actions, lengths, diverged, None)


def literal_cost(sim, real, weights, previous, l1, l2, std, truncate):
    """Eq. 4 for one pair of episodes, step by step and channel by channel."""
    steps = min(len(sim), len(real))
    radius = int(truncate * std + 0.5)
    smooth = np.zeros((steps, len(weights)))
    for t in range(steps):
        for c in range(len(weights)):
            total = mass = 0.0
            for s in range(max(0, t - radius), min(steps, t + radius + 1)):
                if not math.isnan(real[s, c]):
                    g = math.exp(-0.5 * ((s - t) / std) ** 2)
                    total, mass = total + g * (sim[s, c] - real[s, c]), mass + g
            smooth[t, c] = 0.0 if math.isnan(real[t, c]) else total / mass
    cost = 0.0
    for t in range(steps):
        step = [w * x for w, x in zip(weights, smooth[t], strict=True)]
        if t > 0:
            step += [w * x for w, x in zip(previous, smooth[t - 1], strict=True)]
        cost += l1 * sum(map(abs, step)) + l2 * sum(x * x for x in step)
    return cost * len(real) / steps


@pytest.mark.parametrize("dropout", [0.0, 0.3])
def test_equals_the_literal_equation(dropout):
    rng = np.random.default_rng(1)
    real = [measured(rng, dropout=dropout), measured(rng, steps=22, dropout=dropout)]
    sim = simulated(rng, 4, real, lengths=[[30, 22], [30, 30], [11, 22], [30, 5]])
    discrepancy = Discrepancy(WEIGHTS, l1=0.5, l2=1.5, filter_std=2.0, previous_step_weights=PREVIOUS)
    expected = [
        np.mean(
            [
                literal_cost(
                    sim.trajectory(i, j).observations, real[j].observations, WEIGHTS, PREVIOUS, 0.5, 1.5, 2.0, 4.0
                )
                for j in range(2)
            ]
        )
        for i in range(4)
    ]
    np.testing.assert_allclose(discrepancy(sim, real), expected, rtol=1e-10)


def test_zero_for_equal_episodes_and_infinite_for_broken_ones():
    rng = np.random.default_rng(2)
    real = [measured(rng, dropout=0.2)]
    complete = np.nan_to_num(real[0].observations, nan=7.0)  # what was not measured may be anything
    diverged = np.array([[False], [True], [False]])
    sim = simulated(rng, 3, real, diverged=diverged)
    sim.observations[:] = complete
    sim.observations[2, 0, 4, 1] = np.nan  # breaks down without saying so
    np.testing.assert_array_equal(Discrepancy()(sim, real), [0.0, np.inf, np.inf])


def test_without_filter_it_is_the_plain_sum():
    real = [Trajectory(np.zeros((3, 1)), np.zeros((2, 1)))]
    sim = simulated(np.random.default_rng(3), 1, real)
    sim.observations[:] = np.array([1.0, -2.0, 3.0])[:, None]
    assert Discrepancy(filter_std=0)(sim, real)[0] == pytest.approx(0.5 * 6 + 14)


def test_noise_is_estimated_through_the_motion():
    rng = np.random.default_rng(4)
    t = np.linspace(0, 3, 61)[:, None]
    motion = np.hstack([0.4 * np.sin(2 * t), 0.2 * t**2])
    motion[30:, 1] += 0.5  # a contact
    std = np.array([0.002, 0.01])
    real = [Trajectory(motion + std * rng.standard_normal(motion.shape), np.zeros((60, 1))) for _ in range(20)]
    np.testing.assert_allclose(noise_std(real), std, rtol=0.15)
    # and its cost is what differences of pure noise cost
    discrepancy = Discrepancy()
    noise = std * rng.standard_normal((2000, 61, 2))
    noise -= noise[:, :1]
    expected = discrepancy.of_difference(noise, np.ones((61, 2), dtype=bool)).mean()
    assert discrepancy.of_noise(real, rng).mean() == pytest.approx(expected, rel=0.15)


def test_verdict():
    rng = np.random.default_rng(5)
    t = np.linspace(0, 3, 51)[:, None]
    real = [Trajectory(np.sin(t) + 0.002 * rng.standard_normal(t.shape), np.zeros((50, 1)))]
    discrepancy = Discrepancy()
    noise, motion = np.quantile(discrepancy.of_noise(real, rng), 0.95), discrepancy.of_motion(real)
    for costs, label in (
        ([0.9 * noise, motion], "explained"),
        ([0.9 * noise, 1.1 * noise], "uninformative"),
        ([0.2 * motion, motion], "unexplained"),
        ([0.2 * motion, np.inf], "unexplained"),
        ([0.9 * noise, np.inf], "uninformative"),
    ):
        verdict = judge(discrepancy, np.array(costs), real, rng)
        assert verdict.label == label, verdict
        assert label in str(verdict)


@pytest.mark.parametrize(("turning", "label"), [(True, "unexplained"), (False, "uninformative")])
def test_quick_motion_is_not_taken_for_noise(turning, label):
    """Reversing at every step looks like noise in third differences, but then it would not cancel so well over time."""
    rng = np.random.default_rng(6)
    size = np.ones(60) if turning else rng.standard_normal(60)
    velocity = np.concatenate([[0.0], size * (-1.0) ** np.arange(60)])[:, None]
    real, discrepancy = [Trajectory(velocity, np.zeros((60, 1)))], Discrepancy()
    costs = np.array([0.5, 1.0]) * discrepancy.of_motion(real)
    verdict = judge(discrepancy, costs, real, rng)
    assert (verdict.label, verdict.noise == 0.0) == (label, turning), verdict
    assert ("noise alone unknown" in str(verdict)) is turning


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"weights": [1.0, -1.0]}, "weights"),
        ({"weights": [0.0, 0.0]}, "weights"),
        ({"l1": 0.0, "l2": 0.0}, "l1 and l2"),
        ({"l2": np.nan}, "l1 and l2"),
        ({"filter_std": -1.0}, "filter_std"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        Discrepancy(**arguments)


def test_weights_must_fit_the_channels():
    assert Discrepancy().for_channels(["a", "b"], [0.5, 1.0]).weights == (0.5, 1.0)
    assert Discrepancy().for_channels(["a", "b"], None).weights == (1.0, 1.0)
    with pytest.raises(ValueError, match=r"2 \(a, b\), got 3"):
        Discrepancy(WEIGHTS).for_channels(["a", "b"], None)
