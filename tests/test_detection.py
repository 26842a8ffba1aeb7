import numpy as np
import pytest
from numpy.testing import assert_array_equal
from photutils.detection import DAOStarFinder
from scipy.special import erf

from wpdc_gwcs import detection
from wpdc_gwcs.detection import (
    FLAG_BAD_PIXEL,
    FLAG_BLENDED,
    FLAG_COSMIC,
    FLAG_EDGE,
    FLAG_EXTENDED,
    FLAG_SATURATED,
    detect_sources,
    mask_hits,
    subtract_background,
)
from wpdc_gwcs.exceptions import DetectionError

SHAPE = (300, 340)
RMS = 5.0


def gaussian_stars(shape, x, y, flux, sigma):
    """Gaussians integrated over every pixel: exact, by the error function."""
    image = np.zeros(shape)
    edges_y, edges_x = (np.arange(n + 1) - 0.5 for n in shape)
    for xi, yi, fi in zip(x, y, flux):
        cx = np.diff(erf((edges_x - xi) / sigma / np.sqrt(2))) / 2
        cy = np.diff(erf((edges_y - yi) / sigma / np.sqrt(2))) / 2
        image += fi * cy[:, None] * cx
    return image


def star_grid(rng, step=30, margin=20):
    """One star per cell, at random pixel phases; nobody near the edge or a neighbor."""
    gy, gx = np.mgrid[margin : SHAPE[0] - margin : step, margin : SHAPE[1] - margin : step]
    return gx.ravel() + rng.uniform(-3, 3, gx.size), gy.ravel() + rng.uniform(-3, 3, gx.size)


def nearest(sources, x, y):
    distance = np.hypot(np.subtract.outer(x, sources["x"]), np.subtract.outer(y, sources["y"]))
    return distance.argmin(axis=1), distance.min(axis=1)


@pytest.fixture
def field(rng):
    x, y = star_grid(rng)
    flux = 10 ** rng.uniform(3.2, 4.5, x.size)
    image = gaussian_stars(SHAPE, x, y, flux, 1.2) + rng.normal(1000, RMS, SHAPE)
    return image, x, y, flux


def test_all_stars_found_clean_and_in_place(field):
    image, x, y, flux = field
    sources = detect_sources(image)
    index, distance = nearest(sources, x, y)
    assert len(sources) == len(x)
    assert len(set(index)) == len(x)
    assert distance.max() < 0.3
    assert (sources["flags"] == 0).all()
    # a Gaussian of 1.2 px integrated over pixels
    assert sources.meta["fwhm"] == pytest.approx(2.3548 * np.hypot(1.2, 12**-0.5), rel=0.05)
    # a circle of 1.5 FWHM holds 99.6 % of a Gaussian
    np.testing.assert_allclose(sources["flux"][index] / flux, 1, atol=0.25)
    assert np.median(sources["flux"][index] / flux) == pytest.approx(0.996, abs=0.02)


def test_windowed_errors_are_honest(rng):
    x, y = star_grid(rng, step=20)
    pulls = []
    for _ in range(3):
        image = gaussian_stars(SHAPE, x, y, np.full(x.size, 1500.0), 1.3)
        sources = detect_sources(image + rng.normal(0, RMS, SHAPE))
        index, _ = nearest(sources, x, y)
        pulls += [(sources["x"][index] - x) / sources["x_err"][index]]
        pulls += [(sources["y"][index] - y) / sources["y_err"][index]]
    assert 0.85 < np.std(np.concatenate(pulls)) < 1.15


def test_snr_of_faint_star_is_the_matched_filters(rng):
    x, y = star_grid(rng, step=25)
    sigma = 1.5
    image = gaussian_stars(SHAPE, x, y, np.full(x.size, 1000.0), sigma)
    sources = detect_sources(image + rng.normal(0, RMS, SHAPE))
    # flux / (rms sqrt(4 pi) sigma), with the pixel's width in sigma
    expected = 1000 / RMS / np.sqrt(4 * np.pi * (sigma**2 + 1 / 12))
    assert np.median(sources["snr"]) == pytest.approx(expected, rel=0.05)


def test_gain_adds_photon_noise(field):
    image, *_ = field
    without, with_gain = detect_sources(image), detect_sources(image, gain=1.0)
    bright = without["flux"] > 10000
    assert (with_gain["x_err"] > without["x_err"]).all()
    assert (with_gain["snr"][bright] < 0.9 * without["snr"][bright]).all()


@pytest.mark.parametrize("fwhm", [2.2, 3.5, 5.0])
def test_roundness_and_sharpness_are_daofinds(rng, fwhm):
    x, y = star_grid(rng)
    image = gaussian_stars(SHAPE, x, y, np.full(x.size, 8000.0), fwhm / 2.3548)
    image += rng.normal(0, RMS, SHAPE)
    sigma = fwhm / 2.3548
    stars = DAOStarFinder(50.0, fwhm, sharpness_range=None, roundness_range=None)(image)
    names = stars.colnames
    xs, ys = (
        stars["x_centroid" if "x_centroid" in names else "xcentroid"],
        stars["y_centroid" if "y_centroid" in names else "ycentroid"],
    )
    # the peak that DAOFIND cuts out around, of its convolved image, is not always the pixel's
    xp, yp = np.rint(xs).astype(int), np.rint(ys).astype(int)
    roundness, sharpness = detection._shapes.daofind_shape(image, xp, yp, sigma)
    same = np.isclose(image[yp, xp], stars["peak"])
    assert same.sum() > 60
    np.testing.assert_allclose(roundness[same], stars["roundness2"][same], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(sharpness[same], stars["sharpness"][same], rtol=1e-5)


def test_saturated_edge_and_bad_pixels(field):
    image, x, y, _ = field
    image = image + gaussian_stars(SHAPE, [170.2, 1.0], [155.1, 200.0], [2e6, 2e4], 1.2)
    image = np.minimum(image, 30000.0)
    image[int(y[3].round()), int(x[3].round()) + 1] = np.nan
    sources = detect_sources(image, saturation=30000)
    index, _ = nearest(sources, np.array([170.2, 1.0, x[3]]), np.array([155.1, 200.0, y[3]]))
    flags = sources["flags"][index]
    assert flags[0] & FLAG_SATURATED
    assert flags[1] & FLAG_EDGE
    assert flags[2] & FLAG_BAD_PIXEL
    far = (np.hypot(sources["x"] - 170, sources["y"] - 155) > 25) & (sources["x"] > 10)
    assert np.count_nonzero(sources["flags"][far]) == 1


def test_saturation_level_is_found_by_its_plateau(field):
    image, *_ = field
    assert detect_sources(image).meta["saturation"] is None
    full = 0.4 * image.max()
    sources = detect_sources(np.minimum(image, full))
    assert sources.meta["saturation"] == pytest.approx(full, rel=2e-3)
    given = detect_sources(np.minimum(image, full), saturation=0.999 * full)
    assert_array_equal(sources["flags"] & FLAG_SATURATED, given["flags"] & FLAG_SATURATED)
    assert (sources["flags"] & FLAG_SATURATED).any()


def test_dead_pixels_are_masked(field):
    image, x, y, _ = field
    image = image.copy()
    dead = (slice(100, None, 40), slice(100, None, 40))
    image[dead] = 0
    background = subtract_background(image)
    assert background.mask.sum() == image[dead].size
    assert background.mask[dead].all()
    # One beside a star: known, not a star of strange shape.
    k = np.argmin(np.hypot(x - 150, y - 150))
    image[int(y[k].round()), int(x[k].round()) + 1] = -1000
    sources = detect_sources(image)
    row, distance = nearest(sources, x[k : k + 1], y[k : k + 1])
    assert distance[0] < 0.5
    assert sources["flags"][row[0]] & FLAG_BAD_PIXEL


def test_field_full_of_light(rng):
    # More pixels above the threshold than sep has room for by default.
    shape = (400, 5000)
    image = rng.normal(0, 1, shape)
    image[40:360, 40:-40] += 30 * (1 + np.cos(np.arange(320) / 2))[:, None]
    assert len(detect_sources(image)) > 0


def test_cosmic_rays_and_galaxies_flagged(field, rng):
    image, x, y, _ = field
    image = image.copy()
    image[100, 35] += 3000
    for t in range(9):  # a track
        image[215 + t // 2, 185 + t] += 2500
    image += gaussian_stars(SHAPE, [245.3], [96.4], [40000.0], 3.5)
    sources = detect_sources(subtract_background(image))
    index, distance = nearest(sources, np.array([35, 189, 245.3]), np.array([100, 217, 96.4]))
    assert distance.max() < 3
    assert sources["flags"][index[0]] & FLAG_COSMIC
    assert sources["flags"][index[1]] & FLAG_COSMIC
    assert sources["flags"][index[2]] & FLAG_EXTENDED
    star, distance = nearest(sources, x, y)
    alone = distance < 0.3
    assert alone.sum() >= len(x) - 3
    assert np.mean(sources["flags"][star[alone]] == 0) > 0.97


def test_blends_flagged_only_where_they_disturb(rng):
    x, y = star_grid(rng)
    flux = np.full(x.size, 20000.0)
    image = gaussian_stars(SHAPE, x, y, flux, 1.2)
    image += gaussian_stars(SHAPE, x[:1] + 4, y[:1], [20000.0], 1.2)  # 1.4 FWHM away
    image += gaussian_stars(SHAPE, x[1:2] + 9, y[1:2], [4000.0], 1.2)  # harmless
    sources = detect_sources(image + rng.normal(0, RMS, SHAPE))
    assert len(sources) == x.size + 2
    index, _ = nearest(sources, x, y)
    assert sources["flags"][index[0]] & FLAG_BLENDED
    assert sources["flags"][index[1]] == 0
    assert (sources["flags"][index[2:]] == 0).all()


def test_crowded_field_stays_mostly_clean(rng):
    n = 500  # one per 200 px
    x, y = rng.uniform(5, SHAPE[1] - 5, n), rng.uniform(5, SHAPE[0] - 5, n)
    flux = 10 ** rng.uniform(3.2, 4.5, n)
    image = gaussian_stars(SHAPE, x, y, flux, 0.8) + rng.normal(0, RMS, SHAPE)
    sources = detect_sources(image)
    assert len(sources) > 0.85 * n
    assert np.mean(sources["flags"] == 0) > 0.7


@pytest.mark.parametrize("dtype", [">f4", "<f8", ">i2", "<u2", ">i4"])
def test_types_and_byte_orders_agree(field, dtype):
    image = np.clip(field[0], 0, 30000).round()
    given = image.astype(dtype)
    before = given.copy()
    sources = detect_sources(given)
    expected = detect_sources(image)
    np.testing.assert_allclose(sources["x"], expected["x"], atol=1e-5)
    np.testing.assert_array_equal(given, before)
    assert given.dtype == np.dtype(dtype)


def test_read_only_strided_input(field):
    image = np.repeat(field[0], 2, axis=1)[:, ::2]
    image.flags.writeable = False
    assert len(detect_sources(image)) == len(field[1])


def test_nan_borders_and_dead_regions(field):
    image, x, y, _ = field
    image = image.copy()
    image[:, :60] = np.nan
    image[:70] = 0
    image[200, 200] = np.inf
    background = subtract_background(image)
    assert background.mask[70:, :60].all()
    assert np.isfinite(background.image).all()
    sources = detect_sources(background)
    inside = (x > 80) & (y > 90)
    _, distance = nearest(sources, x[inside], y[inside])
    assert np.mean(distance < 0.3) > 0.97
    assert (sources["x"] > 55).all()


def test_memory_is_used_only_where_it_may_be(field):
    image = np.array(field[0], np.float32)
    before = image.copy()
    expected = mask_hits(subtract_background(image))
    np.testing.assert_array_equal(image, before)
    background = subtract_background(image, overwrite=True)
    assert np.shares_memory(background.image, image)
    found = mask_hits(background, overwrite=True)
    np.testing.assert_array_equal(found.image, expected.image)
    np.testing.assert_array_equal(found.rms, expected.rms)


def test_rows_are_views_and_know_their_bright_pixels(rng):
    image = rng.normal(100, 5, (90, 70)).astype(np.float32)
    image[33, 20:24] = 6000
    background = subtract_background(image)
    strip = background.rows(30, 60)
    assert np.shares_memory(strip.image, background.image)
    full = background.saturated(5000)
    assert np.argwhere(full).tolist() == [[33, x] for x in range(20, 24)]
    np.testing.assert_array_equal(strip.saturated(5000), full[30:60])
    assert not background.rows(40, 60).saturated(5000).any()
    # At the very value of the pixels too.
    assert background.saturated(6000).sum() == 4
    assert not background.saturated(6001).any()


def test_mask_hides_sources(field):
    image, x, y, _ = field
    mask = np.zeros(SHAPE, bool)
    mask[:, :170] = True
    sources = detect_sources(image, mask=mask)
    assert len(sources) == pytest.approx((x > 170).sum(), abs=3)


def test_background_follows_gradients(rng):
    slope = np.linspace(100, 140, SHAPE[1])
    background = subtract_background(rng.normal(0, RMS, SHAPE) + slope)
    inner = background.image[40:-40, 40:-40]
    assert abs(np.median(inner)) < 1
    assert np.std(inner) == pytest.approx(RMS, rel=0.1)
    assert np.median(background.rms) == pytest.approx(RMS, rel=0.15)
    assert background.mask is None


def test_small_noise_on_a_high_pedestal(rng):
    image = rng.normal(3e6, 0.5, SHAPE)
    background = subtract_background(image)
    assert np.median(background.rms) == pytest.approx(0.5, rel=0.1)


@pytest.mark.parametrize(
    ("image", "match"),
    [
        (np.full((100, 100), np.nan), "no finite"),
        (np.full((100, 100), 7.0), "flat"),
        (np.zeros((100, 100), np.int16), "flat"),
        (np.random.default_rng(1).normal(100, 5, (64, 64)), "no source above 8 sigma"),
    ],
)
def test_images_without_stars(image, match):
    with pytest.raises(DetectionError, match=match):
        detect_sources(image, threshold=8)


@pytest.mark.parametrize(
    ("kwargs", "match"),
    [
        ({"threshold": 0}, "threshold must be positive"),
        ({"gain": -1}, "gain must be positive"),
        ({"saturation": np.nan}, "saturation must be positive"),
        ({"mask": np.zeros((3, 3), bool)}, "mask has shape"),
    ],
)
def test_wrong_options(field, kwargs, match):
    with pytest.raises(ValueError, match=match):
        detect_sources(field[0], **kwargs)


def test_wrong_images():
    with pytest.raises(ValueError, match="2-D"):
        detect_sources(np.zeros(100))
    with pytest.raises(TypeError, match="real numbers"):
        detect_sources(np.zeros((50, 50), complex))
    with pytest.raises(ValueError, match="mesh"):
        subtract_background(np.zeros((50, 50)), mesh=0)
    noise = np.random.default_rng(1).normal(size=(50, 50))
    with pytest.raises(ValueError, match="mask must be given to subtract_background"):
        detect_sources(subtract_background(noise), mask=np.zeros((50, 50), bool))


def test_one_star(rng):
    image = gaussian_stars((80, 80), [40.3], [37.8], [9000.0], 1.1) + rng.normal(0, RMS, (80, 80))
    sources = detect_sources(image)
    assert len(sources) == 1
    assert float(sources["x"][0]) == pytest.approx(40.3, abs=0.05)
    assert float(sources["y"][0]) == pytest.approx(37.8, abs=0.05)
