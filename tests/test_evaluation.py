"""Residual statistics against closed forms and brute force."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from wpdc_gwcs.evaluation import binned_residuals, d80, evaluate, robust_scatter


def test_moments_of_a_normal_distribution_with_wrong_matches():
    rng = np.random.default_rng(3)
    dx, dy = rng.normal(0.02, 0.05, 20000), rng.normal(-0.01, 0.03, 20000)
    dx[:100] += 5.0
    s = evaluate(dx, dy)
    # three sigma of the mean; the clipping at 3 sigma narrows a normal distribution by 1.4 %
    assert s.mean_dx == pytest.approx(0.02, abs=0.001)
    assert s.mean_dy == pytest.approx(-0.01, abs=0.001)
    assert s.sigma_dx == pytest.approx(0.05, rel=0.03)
    assert s.sigma_dy == pytest.approx(0.03, rel=0.03)
    assert s.scatter_dx == pytest.approx(0.05, rel=0.03)
    # 20 % and 80 % of a normal distribution are 0.8416 sigma from its mean
    assert s.d80_dx == pytest.approx(2 * 0.8416 * 0.05, rel=0.03)
    assert s.n == 20000
    assert s.n_clipped < 20000 - 100


def test_clipping_is_of_both_axes_together():
    dx = np.r_[np.tile([-0.1, 0.1], 50), 9.0]
    dy = np.r_[np.tile([-0.1, 0.1], 50), 0.0]
    s = evaluate(dx, dy)
    assert s.n_clipped == 100
    assert s.rms == pytest.approx(np.hypot(0.1, 0.1))


def test_nan_residuals_are_left_out():
    s = evaluate([0.1, np.nan, 0.3], [0.0, 0.0, np.nan])
    assert s.n == 1
    assert s.mean_dx == pytest.approx(0.1)


def test_no_stars():
    s = evaluate([], [])
    assert s.n == 0
    assert np.isnan([s.mean_dx, s.sigma_dy, s.d80_dx, s.rms]).all()
    assert np.isnan(robust_scatter([np.nan]))
    assert np.isnan(d80([]))


def test_wrong_sigma():
    with pytest.raises(ValueError, match="sigma must be positive, got 0"):
        evaluate([0.0], [0.0], sigma=0)


@given(
    values=arrays(float, st.integers(1, 50), elements=st.floats(-1e3, 1e3)),
    shift=st.floats(-10, 10),
    factor=st.floats(0.1, 10),
)
@settings(deadline=None, max_examples=50)
def test_widths_follow_shift_and_scale(values, shift, factor):
    for width in (robust_scatter, d80):
        assert width(values * factor + shift) == pytest.approx(width(values) * factor, abs=1e-9)


def test_binned_residuals_against_loops(rng):
    ny, nx, n = 60, 100, 4
    x, y = rng.uniform(-0.5, nx - 0.5, 300), rng.uniform(-0.5, ny - 0.5, 300)
    dx, dy = rng.normal(size=(2, 300))
    dx[0] = np.nan
    mean_dx, mean_dy, count = binned_residuals(x, y, dx, dy, image_shape=(ny, nx), n_bins=n)
    assert count.sum() == 299
    for iy in range(n):
        for ix in range(n):
            inside = (
                (x + 0.5 >= ix * nx / n)
                & (x + 0.5 < (ix + 1) * nx / n)
                & (y + 0.5 >= iy * ny / n)
                & (y + 0.5 < (iy + 1) * ny / n)
                & np.isfinite(dx)
            )
            assert count[iy, ix] == inside.sum()
            np.testing.assert_allclose(mean_dx[iy, ix], dx[inside].mean())
            np.testing.assert_allclose(mean_dy[iy, ix], dy[inside].mean())


def test_empty_cells_are_nan_and_bins_are_checked():
    mean_dx, mean_dy, count = binned_residuals([], [], [], [], image_shape=(10, 10), n_bins=3)
    assert np.isnan(mean_dx).all()
    assert np.isnan(mean_dy).all()
    assert count.sum() == 0
    with pytest.raises(ValueError, match="n_bins must be at least 1, got 0"):
        binned_residuals([], [], [], [], image_shape=(10, 10), n_bins=0)
