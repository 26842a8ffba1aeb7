"""The level of the sky and its scatter: against the truth, and the kernels against each other."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from wpdc_gwcs import kernels
from wpdc_gwcs.detection._levels import measure_levels
from wpdc_gwcs.kernels import levels_in_numpy

SHAPE = (450, 520)
Y, X = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)


def measure(image, mask=None, *, mesh=64, filter_size=3, scale=5.0):
    image = np.ascontiguousarray(image, dtype=np.float32)
    levels, _ = measure_levels(image, mask, mesh, filter_size, scale)
    left = image.copy()
    levels.subtract(left)
    return levels, image - left, levels.noise()


# ---- against the truth -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sky", "tolerance"),
    [
        (100 + 0 * X, 0.1),
        (100 + 2 * X - Y, 0.1),
        # The spline has no curvature at the edges.
        (300 - 2e-4 * ((X - 200) ** 2 + (Y - 300) ** 2), 0.35),
    ],
)
def test_smooth_skies_are_followed_to_the_edges(sky, tolerance, rng):
    levels, back, noise = measure(rng.normal(sky, 5))
    # The scatter within a cell has the slope in it.
    assert np.abs(back - sky).max() < tolerance * levels.scatter.max()
    assert noise.min() > 4.7
    assert levels.level.shape == (7, 8)
    assert np.diff(levels.rows).min() >= 64
    assert levels.rows[-1] == SHAPE[0]
    assert levels.columns[-1] == SHAPE[1]


@pytest.mark.parametrize("sigma", [0.8, 1.3, 2.0, 3.7, 12.0])
@pytest.mark.parametrize("offset", [0.0, 0.3, 0.5])
def test_whole_numbers_are_not_off_by_half_a_unit(sigma, offset, rng):
    image = np.rint(rng.normal(200 + offset, sigma, SHAPE))
    levels, _, noise = measure(image, scale=sigma)
    total = np.hypot(sigma, 12**-0.5)
    assert np.mean(levels.level) == pytest.approx(200 + offset, abs=0.12 * total)
    assert np.median(noise) == pytest.approx(total, rel=0.04)


@pytest.mark.parametrize("share", [0.02, 0.1])
def test_skies_of_few_photons_have_noise(share, rng):
    levels, _, noise = measure(rng.poisson(share, SHAPE), scale=1.0)
    assert np.mean(levels.level) == pytest.approx(share, abs=0.3 * share)
    assert np.median(noise) == pytest.approx(np.sqrt(share), rel=0.15)


@pytest.mark.parametrize("value", [0.0, 100.0, 3000.0])
def test_constant_parts_are_dead_and_have_the_sky_of_the_others(value, rng):
    image = rng.normal(100, 5, SHAPE).astype(np.float32)
    constant = (X < 270) & ((Y > 30) | (X < 130))
    constant &= rng.random(SHAPE) > 1e-3
    image[constant] = value
    levels, dead = measure_levels(image, None, 64, 3, 5.0)
    assert np.mean(dead[constant]) > 0.9
    assert np.mean(dead[~constant]) < 0.01
    assert np.mean(dead[:, :250][~constant[:, :250]]) < 0.02
    assert 4 < levels.noise().min() < levels.noise().max() < 6
    left = image.copy()
    levels.subtract(left)
    assert np.abs((image - left)[~constant] - 100).max() < 0.3 * 5
    assert measure_levels(image[:, 270:].copy(), None, 64, 3, 5.0)[1] is None


def test_the_middle_of_a_saturated_star_is_not_dead(rng, monkeypatch):
    light = 1e8 * np.exp(-np.hypot(X - 227, Y - 224) / 5)
    image = np.minimum(rng.normal(100, 5, SHAPE) + light, 6e4).astype(np.float32)
    _, mask = measure_levels(image, None, 64, 3, 5.0)
    assert mask is None
    # Most of its cell is equal: at another level it would be.
    monkeypatch.setattr("wpdc_gwcs.detection._levels._HIGH", np.inf)
    _, mask = measure_levels(image, None, 64, 3, 5.0)
    assert mask[224, 227]


def test_stars_lift_the_level_little(rng):
    image = rng.normal(100, 5, SHAPE)
    for x, y in rng.uniform(20, 430, (350, 2)):
        flux = 10 ** rng.uniform(2, 4)
        image += flux * np.exp(-((X - x) ** 2 + (Y - y) ** 2) / 4)
    levels, _, noise = measure(image)
    assert 0 < np.median(levels.level) - 100 < 0.15 * 5
    assert 4.8 < np.median(noise) < 1.15 * 5


def test_masked_pixels_do_not_count(rng):
    image = rng.normal(100, 5, SHAPE)
    mask = rng.random(SHAPE) < 0.6
    # A cell without pixels has the level of its neighbors, and so has one with few.
    mask[:64, :65] = True
    mask[200:270, 200:270] = True
    image[mask] = 1e4
    image[0, 0] = np.nan
    _, back, noise = measure(image, mask)
    assert np.abs((back - 100)[~mask]).max() < 0.25 * 5
    assert np.abs(noise / 5 - 1).max() < 0.1
    everything = np.ones(SHAPE, bool)
    levels, _, _ = measure(image, everything)
    assert np.isfinite(levels.level).all()


@pytest.mark.parametrize("shape", [(8, 8), (8, 300), (97, 95), (300, 8), (96, 70)])
def test_small_images_have_few_cells(shape, rng):
    levels, back, noise = measure(rng.normal(100, 5, shape))
    assert levels.level.shape == tuple(max(1, round(n / 64)) for n in shape)
    assert back.shape == noise.shape == shape
    assert np.abs(back - 100).max() < 4 * 5 / np.sqrt(min(shape) * 8)
    assert 3.5 < noise.min() <= noise.max() < 6.5


def test_the_filter_takes_out_single_cells(rng):
    image = rng.normal(100, 5, SHAPE)
    image[200:260, 200:260] += 30
    filtered, plain = (measure(image, filter_size=n)[0].level for n in (3, 1))
    assert filtered.max() < 101
    assert plain.max() > 120


def test_threads_change_nothing(rng, monkeypatch):
    image = rng.normal(100 + X, 5)
    expected = measure(image)[1:]
    monkeypatch.setattr("wpdc_gwcs.threads.count_threads", lambda: 3)
    for name in ("_CELL_ROWS", "_PIXEL_ROWS"):
        monkeypatch.setattr(f"wpdc_gwcs.detection._levels.{name}", 2)
    for found, wanted in zip(measure(image)[1:], expected, strict=True):
        assert_array_equal(found, wanted)


# ---- the kernels -----------------------------------------------------------------------------


@pytest.fixture
def compiled():
    return pytest.importorskip("wpdc_gwcs.kernels._compiled", reason="no compiler when installed")


def cells(rng):
    """An image with all kinds of values, a mask, and cells that leave out some of it."""
    image = rng.normal(0, 5, (40, 301)).astype(np.float32)
    image[::3, ::5] = [[np.nan, np.inf, -np.inf, 1e38, -1e38, 0.0] * 10 + [1.0]]
    rows, columns = np.array([2.0, 2, 17, 39]), np.array([1.0, 2, 150, 301])
    low, rate = rng.uniform(-10, -5, 9), rng.uniform(5, 60, 9)
    return image, rows, columns, low.astype(np.float32), rate.astype(np.float32)


@pytest.mark.parametrize("masked", [False, True])
def test_counts_are_the_same_and_those_of_histograms(masked, compiled, rng):
    image, rows, columns, low, rate = cells(rng)
    mask = rng.random(image.shape) < 0.3 if masked else None
    results = []
    for module in (compiled, levels_in_numpy):
        counts = np.full((9, kernels.N_STEPS), -1, np.intc)
        module.count_levels(image, mask, rows, columns, low, rate, counts)
        results.append(counts)
    assert_array_equal(*results)
    good = np.isfinite(image) if mask is None else np.isfinite(image) & ~mask
    part = np.s_[17:39, 150:301]
    values = image[part][good[part]].astype(float)
    edges = np.float64(low[8]) + np.arange(kernels.N_STEPS + 1) / np.float64(rate[8])
    expected, _ = np.histogram(values, edges)
    assert np.abs(results[0][8] - expected).sum() <= 2  # at edges of steps
    assert (results[0][:3] == 0).all()


@pytest.mark.parametrize("subtract", [False, True])
def test_cubics_are_the_same_and_those_of_polyval(subtract, compiled, rng):
    coefficients = rng.normal(size=(7, 3, 4)).astype(np.float32)
    edges, offset = np.array([0.0, 5, 5, 20]), rng.uniform(-1, 1, 20).astype(np.float32)
    start = rng.normal(size=(7, 20)).astype(np.float32)
    results = [start.copy(), start.copy()]
    for module, image in zip((compiled, levels_in_numpy), results, strict=True):
        module.put_cubics(coefficients, edges, offset, subtract, image)
    assert_array_equal(results[0].view(np.int32), results[1].view(np.int32))
    piece = np.repeat([0, 2], [5, 15])
    expected = np.stack([np.polyval(c[piece].T.astype(float), offset) for c in coefficients])
    expected = start - expected if subtract else expected
    np.testing.assert_allclose(results[0], expected, atol=2e-6)


def test_compiled_kernels_refuse_what_makes_no_cells(compiled, rng):
    image, rows, columns, low, rate = cells(rng)
    counts = np.empty((9, kernels.N_STEPS), np.intc)
    good = [image, None, rows, columns, low, rate, counts]
    compiled.count_levels(*good)
    for position, value, error in (
        (0, image.ravel(), ValueError),
        (0, image.astype(float), TypeError),
        (1, np.zeros((3, 3), bool), ValueError),
        (1, np.zeros(image.shape, np.uint8), TypeError),
        (2, np.array([0.0, 41.0]), ValueError),
        (2, np.array([-1.0, 3, 4, 5]), ValueError),
        (3, np.array([5.0, 2.0, 3.0, 4.0]), ValueError),
        (3, np.array([np.nan, 2.0, 3.0, 4.0]), ValueError),
        (3, np.array([1.0, np.nan, 3.0, 4.0]), ValueError),
        (3, np.array([1.0]), ValueError),
        (4, low[1:].copy(), ValueError),
        (6, counts[1:].copy(), ValueError),
        (6, counts.astype(np.int64), TypeError),
    ):
        args = list(good)
        args[position] = value
        with pytest.raises(error):
            compiled.count_levels(*args)
    coefficients, edges = np.zeros((40, 3, 4), np.float32), np.array([0.0, 5, 9, 301])
    offset = np.zeros(301, np.float32)
    good = [coefficients, edges, offset, True, image]
    compiled.put_cubics(*good)
    for position, value, error in (
        (0, coefficients[1:].copy(), ValueError),
        (1, np.array([0.0, 5, 9, 302]), ValueError),
        (2, offset[1:].copy(), ValueError),
        (4, image.astype(float), TypeError),
        (4, image[:, ::2], (BufferError, ValueError)),
    ):
        args = list(good)
        args[position] = value
        with pytest.raises(error):
            compiled.put_cubics(*args)
