"""Learnt variances against a direct maximization."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import minimize

from wpdc_gwcs.solve.errors import extrapolation
from wpdc_gwcs.solve.evidence import inflation, learn_sequence, truncation

DECAY, SCATTER = 2.5, 1.2


@pytest.mark.parametrize("groups", [1, 2, 6])
def test_is_the_maximum_of_the_posterior(rng, groups):
    count = rng.integers(3, 15, groups)
    square = count * 10.0 ** rng.uniform(-4, 2, groups)

    def cost(log):
        walk = (np.diff(log) + np.log(DECAY)) / SCATTER
        return np.sum(count * log + 0.5 * square * np.exp(-2 * log)) + 0.5 * np.sum(walk**2)

    start = 0.5 * np.log(square / count)
    expected = minimize(cost, start, method="BFGS", options={"gtol": 1e-9}).x
    found = learn_sequence(square, count, np.ones(groups), DECAY)
    assert_allclose(np.log(found), expected, atol=1e-4)
    # Wherever the iteration begins.
    assert_allclose(learn_sequence(square, count, np.full(groups, 1e-3), DECAY), found, rtol=1e-5)


def test_many_coefficients_speak_for_themselves():
    sigma = np.array([3.0, 0.01, 0.5])
    count = np.array([100_000] * 3)
    assert_allclose(learn_sequence(count * sigma**2, count, np.ones(3), DECAY), sigma, rtol=1e-3)


def test_what_no_star_tells_follows_the_degree_before():
    """Its posterior is its prior: the steps lead to a decay, and not to zero."""
    count = np.array([1000, 4, 5])
    sigma = np.array([2.0, 2.0, 2.0])
    for _ in range(500):
        sigma = learn_sequence(count * sigma**2 * [0, 1, 1] + [4000, 0, 0], count, sigma, DECAY)
    assert_allclose(sigma, [2.0, 2.0 / DECAY, 2.0 / DECAY**2], rtol=0.02)


def test_sizes_of_few_detectors_are_uncertain():
    """One independent number for two degrees: exp(1 / (2 n)) with n = 1/2 for each at most."""
    many = np.full((1, 2), 1e6)
    assert_allclose(inflation(many), np.exp(0.5), rtol=1e-5)
    assert_allclose(inflation(np.repeat(many, 100, axis=0)), np.exp(0.005), rtol=1e-3)
    # Detectors that the stars say nothing of do not count.
    nothing = np.zeros((50, 2))
    assert_allclose(inflation(np.concatenate([many, nothing])), np.exp(0.5), rtol=0.1)
    assert inflation(np.array([[1.0, 0.2]])) > inflation(np.array([[3.0, 2.0]]))
    assert np.isfinite(inflation(np.zeros((1, 3))))


def test_errors_grow_far_from_the_stars(rng):
    """None in between, none in the gaps of many stars, and no end."""
    stars = np.stack([rng.uniform(-1, 0, 50), rng.uniform(-1, 1, 50)])
    factor = extrapolation(stars, np.array([[-0.5, 0.1, 0.4, 1.0], [0.0, 0.0, 0.0, 0.0]]))
    assert factor[0] == pytest.approx(1.0, abs=0.3)
    assert np.all(np.diff(factor) >= 0)
    assert factor[3] == pytest.approx(2.3, abs=0.1)  # 3.5 spacings of 0.28
    assert np.all(extrapolation(stars, stars) == 1.0)
    many = rng.uniform(-1, 1, (2, 5000))
    assert np.all(extrapolation(many, rng.uniform(-1, 1, (2, 500))) == 1.0)
    assert np.all(extrapolation(np.zeros((2, 0)), many) > 1.0)


@pytest.mark.parametrize("ratio", [0.2, 0.6, 0.9])
def test_errors_grow_by_the_degrees_that_are_left_out(ratio):
    sigma = 3.0 * ratio ** np.arange(6)
    # The power of a degree and of all beyond it, which goes on for ever.
    power = np.sum(sigma[-1] ** 2 * ratio ** (2 * np.arange(1000)))
    assert_allclose(truncation(sigma, 50), np.sqrt(power) / sigma[-1], rtol=1e-9)
    # Four places for each of the 36 coefficients up to degree 7; with more, less is hidden.
    assert truncation(sigma, 144) == truncation(sigma, 0)
    assert_allclose(truncation(sigma, 288) ** 2 - 1, 0.5 * (truncation(sigma, 144) ** 2 - 1))
    assert truncation(sigma, 1e9) < 1.001


def test_degrees_that_do_not_fall():
    assert truncation(np.array([5.0, 1.0, 0.6, 0.6, 1.0, 0.7]), 50) < 3.3
    assert truncation(np.array([0.1, 0.1, 0.2, 0.4]), 50) < 3.3
    assert truncation(np.array([1.0]), 50) == 1.0
