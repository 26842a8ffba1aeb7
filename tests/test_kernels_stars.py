"""Kernels of stars: C and NumPy agree to rounding, at the rims of grids and images as well."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.interpolate import BSpline

from wpdc_gwcs.centroids._profile import spline_taps
from wpdc_gwcs.kernels import stars_in_numpy

SIZE, OVERSAMPLING, N_GRIDS = 41, 4, 3
CENTER = SIZE // 2


@pytest.fixture
def compiled():
    return pytest.importorskip("wpdc_gwcs.kernels._compiled", reason="no compiler when installed")


@pytest.fixture
def grids(rng):
    return rng.normal(size=(N_GRIDS, SIZE, SIZE))


def phases(dx, dy):
    columns = [c for d in (dx, dy) for c in spline_taps(CENTER - OVERSAMPLING * np.asarray(d))]
    return np.column_stack(columns)


def stars(rng, n=60):
    """Stars within half a pixel of their central one, and some that ran away."""
    dx, dy = rng.uniform(-0.5, 0.5, (2, n))
    dx[:5] = 0.5, -4.0, 7.0, 300.0, -1e6
    dy[2:6] = -7.0, 0.0, 1e7, 5.0
    return dx, dy, rng.normal(size=(n, N_GRIDS))


def profiles(module, grids, dx, dy, shares, half, n_outputs):
    result = np.full((n_outputs, len(dx), (2 * half + 1) ** 2), 7.0)
    module.star_profiles(grids, OVERSAMPLING, phases(dx, dy), shares, half, result)
    return result


@pytest.mark.parametrize("half", [0, 3, 9])
@pytest.mark.parametrize("n_outputs", [1, 3])
def test_profiles_agree(half, n_outputs, compiled, grids, rng):
    args = (grids, *stars(rng), half, n_outputs)
    found, expected = (profiles(module, *args) for module in (compiled, stars_in_numpy))
    assert_allclose(found, expected, rtol=0, atol=3e-14)
    assert np.count_nonzero(expected[0].any(axis=1)) < len(expected[0])
    none = profiles(compiled, grids, np.empty(0), np.empty(0), np.empty((0, N_GRIDS)), half, 1)
    assert none.shape == (1, 0, (2 * half + 1) ** 2)


@pytest.mark.parametrize("name", ["compiled", "numpy"])
def test_profiles_are_sums_of_splines(name, request, grids, rng):
    module = request.getfixturevalue("compiled") if name == "compiled" else stars_in_numpy
    dx, dy, shares = (
        rng.uniform(-0.5, 0.5, 4),
        rng.uniform(-0.5, 0.5, 4),
        np.eye(N_GRIDS)[[0, 1, 2, 0]],
    )
    spline = BSpline.basis_element(np.arange(-2.0, 3.0), extrapolate=False)
    found = profiles(module, grids, dx, dy, shares, 2, 1)[0].reshape(4, 5, 5)
    for k in range(4):
        u, v = (OVERSAMPLING * (np.arange(-2, 3) - d[k]) + CENTER for d in (dx, dy))
        along_x, along_y = (np.nan_to_num(spline(w[:, None] - np.arange(SIZE))) for w in (u, v))
        expected = along_y @ grids[np.argmax(shares[k])] @ along_x.T
        assert_allclose(found[k], expected, rtol=0, atol=1e-13)


def test_a_position_that_is_no_number(compiled, grids):
    phase = phases([0.1, 0.2], [0.3, 0.4])
    phase[0] = np.nan
    for module in (compiled, stars_in_numpy):
        result = np.zeros((3, 2, 49))
        module.star_profiles(grids, OVERSAMPLING, phase, np.ones((2, N_GRIDS)), 3, result)
        assert np.isnan(result[:, 0]).all()
        assert np.isfinite(result[:, 1]).all()


@pytest.mark.parametrize("half", [0, 2, 30])
def test_painted_stars_agree(half, compiled, grids, rng):
    n = 200
    x, y = rng.uniform(-20, 70, n), rng.uniform(-20, 60, n)
    x[:3], y[3:6] = (-1e6, 1e12, 30.5), (1e7, -1e15, 10.5)
    center = np.rint(np.column_stack([x, y]))
    phase = phases(x - center[:, 0], y - center[:, 1])
    flux, shares = rng.uniform(1, 100, n), rng.normal(size=(n, N_GRIDS))
    images = rng.normal(size=(2, 40, 50)).astype(np.float32)
    images[1] = images[0]
    before = images[0].copy()
    for module, image in zip((compiled, stars_in_numpy), images):
        module.paint_stars(grids, OVERSAMPLING, phase, shares, half, center, flux, image)
    assert_allclose(*images, rtol=0, atol=2e-6 * np.abs(images).max())
    assert np.abs(images[0] - before).max() > 10


@pytest.mark.parametrize("name", ["compiled", "numpy"])
@pytest.mark.parametrize("half", [0, 2, 30])
def test_light_is_taken_off_once(name, half, request, rng):
    module = request.getfixturevalue("compiled") if name == "compiled" else stars_in_numpy
    center = np.rint(rng.uniform(-20, 70, (200, 2)))
    center[:3] = (-1e6, 5), (1e12, 5), (5, -1e15)
    light, before = rng.normal(size=(2, 40, 50)).astype(np.float32)
    y, x = np.mgrid[:40, :50]
    near = [(np.abs(x - a) <= half) & (np.abs(y - b) <= half) for a, b in center]
    lit = np.any(near, axis=0)
    changed = lit & (y >= 7) & (y < 33)
    expected = np.where(changed, before - light, before), np.where(lit, 0, light)
    image = before.copy()
    module.take_stars(center, half, 7, 33, light, image)
    assert_array_equal(image, expected[0])
    assert_array_equal(light, expected[1])
    assert 0 < changed.mean() < 1


@pytest.mark.parametrize("photons", [False, True])
def test_steps_agree(photons, compiled, rng):
    n, n_pixels = 50, 121
    basis, flux = rng.normal(size=(3, n, n_pixels)), rng.uniform(10, 1000, n)
    pixels = flux[:, None] * basis[0] + rng.normal(size=(n, n_pixels))
    use, variance = rng.random((n, n_pixels)) < 0.8, rng.uniform(1, 2, (n, n_pixels))
    response = rng.uniform(0.5, 2, (n, n_pixels)) if photons else None
    # No pixel; two pixels; derivatives that are multiples of each other; nothing but zeros; NaN
    # where a pixel is not used, and where it is.
    use[0], use[1, 2:] = False, False
    basis[1, 2] = 2 * basis[2, 2]
    basis[:, 3] = 0
    use[4, 0], pixels[4, 0] = False, 1e30
    results = []
    for module in (compiled, stars_in_numpy):
        outputs = [np.zeros((n, 3)), np.zeros((n, 3, 3)), np.zeros(n)]
        noise = np.array([0.5, 0.02])
        with np.errstate(all="ignore"):
            module.star_steps(basis, flux, pixels, use, variance, response, noise, *outputs)
        results.append(outputs)
    for found, expected in zip(*results):
        assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
    step, covariance, _ = results[0]
    assert_array_equal(np.isnan(covariance).all(axis=(1, 2)), np.arange(n) < 4)
    assert_array_equal((step == 0).all(axis=1), np.arange(n) < 4)


def test_compiled_functions_refuse_what_they_cannot_take(compiled, grids):
    phase, shares = phases([0.1], [0.2]), np.ones((1, N_GRIDS))
    good = [grids, OVERSAMPLING, phase, shares, 2, np.zeros((1, 1, 25))]
    compiled.star_profiles(*good)
    compiled.star_profiles(grids, np.int64(OVERSAMPLING), *good[2:])
    for position, value, error in (
        (0, grids[0].copy(), ValueError),
        (0, grids[:, :, :-1].copy(), ValueError),
        (1, 0, ValueError),
        (1, 4.0, TypeError),
        (2, phase[:, :-1].copy(), ValueError),
        (3, shares[:, :-1].copy(), ValueError),
        (4, -1, ValueError),
        (5, np.zeros((2, 1, 25)), ValueError),
        (5, np.zeros((1, 1, 25), dtype=np.float32), TypeError),
    ):
        args = list(good)
        args[position] = value
        with pytest.raises(error):
            compiled.star_profiles(*args)
    center, flux, image = np.zeros((1, 2)), np.ones(1), np.zeros((9, 9), np.float32)
    compiled.paint_stars(*good[:5], center, flux, image)
    for args in (
        (center[0][:1], flux, image),
        (center, np.ones(2), image),
        (center, flux, image.ravel()),
        (center, flux, image.astype(float)),
    ):
        with pytest.raises((TypeError, ValueError)):
            compiled.paint_stars(*good[:5], *args)
    compiled.take_stars(center, np.int64(2), 0, 9, image, image.copy())
    for args in (
        (center[0][:1], 2, 0, 9, image, image),
        (center, -1, 0, 9, image, image),
        (center, 2.0, 0, 9, image, image),
        (center, 2, 0, 9, image.ravel(), image),
        (center, 2, 0, 9, image, image[1:].copy()),
        (center, 2, 0, 9, image, image.astype(float)),
    ):
        with pytest.raises((TypeError, ValueError)):
            compiled.take_stars(*args)
