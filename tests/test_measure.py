"""Frames of any unit, gain and shape of the stars are measured alike."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from astropy.wcs import WCS
from scipy.special import erf

from wpdc_gwcs.calibration import Settings, measure_sources
from wpdc_gwcs.calibration.measure import quality_of
from wpdc_gwcs.detection import mask_hits, subtract_background
from wpdc_gwcs.exceptions import WPDCWarning
from wpdc_gwcs.flags import FLAG_SATURATED
from wpdc_gwcs.frame import Frame
from wpdc_gwcs.selection import select_sources

SHAPE = (420, 460)
GAIN = 2.0


def track(x, y, flux, length, sigma=0.8, angle=0.0, shape=SHAPE):
    """Draw stars as even tracks, by closed form: an error function along, a Gaussian across."""
    image = np.zeros(shape)
    c, s = np.cos(angle), np.sin(angle)
    for xi, yi, fi in zip(x, y, flux):
        x0, y0 = int(xi) - 20, int(yi) - 20
        rows, columns = np.mgrid[max(y0, 0) : y0 + 41, max(x0, 0) : x0 + 41]
        rows, columns = rows[: shape[0] - max(y0, 0)], columns[: shape[0] - max(y0, 0)]
        value = 0.0
        # Four points of Gauss per axis within a pixel: exact to 1e-6 for these widths.
        nodes, weights = np.polynomial.legendre.leggauss(4)
        for a, wa in zip(nodes / 2, weights / 2):
            for b, wb in zip(nodes / 2, weights / 2):
                u = (columns + a - xi) * c + (rows + b - yi) * s
                v = (rows + b - yi) * c - (columns + a - xi) * s
                along = erf((u + length / 2) / sigma / 2**0.5) - erf(
                    (u - length / 2) / sigma / 2**0.5
                )
                across = np.exp(-0.5 * (v / sigma) ** 2) / np.sqrt(2 * np.pi) / sigma
                value = value + wa * wb * along * across / 2 / length
        inside = (rows < shape[0]) & (columns < shape[1])
        image[rows[inside], columns[inside]] += fi * value[inside]
    return image


def frame_of(image, **cards):
    return Frame("a", "d", image.shape, WCS(naxis=2), load_image=lambda: image, **cards)


def sky_of(rng, length=0.01, angle=0.0, sky=200.0):
    gy, gx = np.mgrid[20:400:24, 20:440:24]
    x, y = gx.ravel() + rng.uniform(-3, 3, gx.size), gy.ravel() + rng.uniform(-3, 3, gx.size)
    flux = 10 ** rng.uniform(3.3, 5.0, x.size)
    light = track(x, y, flux, length, angle=angle) + sky
    return rng.poisson(light * GAIN) / GAIN + rng.normal(0, 2, SHAPE), x, y


@pytest.fixture(scope="module")
def plain():
    return sky_of(np.random.default_rng(5))


def errors(sources, x, y):
    distance = np.hypot(np.subtract.outer(x, sources["x"]), np.subtract.outer(y, sources["y"]))
    return distance.argmin(axis=1), distance.min(axis=1)


@pytest.mark.parametrize("scale", [1e-30, 1e-12, 1e-3, 2.0**60, 1e30])
def test_any_unit_gives_the_same(plain, scale):
    image, *_ = plain
    expected = measure_sources(frame_of(image))
    found = measure_sources(frame_of(image * scale))
    assert len(found) == len(expected)
    for name in ("x", "y", "x_err", "snr", "fwhm"):
        np.testing.assert_allclose(found[name], expected[name], rtol=2e-3)
    np.testing.assert_allclose(found["flux"], expected["flux"] * scale, rtol=2e-3)
    assert found.meta["noise"] == pytest.approx(expected.meta["noise"] * scale, rel=1e-3)


def test_half_precision_is_an_image(plain):
    image, x, _ = plain
    assert len(measure_sources(frame_of(image.astype(np.float16)))) > 0.9 * len(x)


@pytest.mark.parametrize("scale", [1 / 150, 1 / 65535])
def test_gain_of_other_pixels_is_left_aside(plain, scale):
    image, x, y = plain
    expected = measure_sources(frame_of(image, gain=GAIN))
    with pytest.warns(WPDCWarning, match="gain of 2 disagrees with the pixels"):
        found = measure_sources(frame_of(image * scale, gain=GAIN))
    assert len(found) > 0.97 * len(expected)
    rows, distance = errors(found, x, y)
    assert np.median(distance) < 0.03
    assert found.meta["gain"] == pytest.approx(GAIN / scale, rel=0.5)


def test_gain_that_is_too_low_or_high_by_four(plain):
    image, *_ = plain
    for factor in (0.25, 5.0):
        with pytest.warns(WPDCWarning, match="the noise in its stars implies a gain of"):
            found = measure_sources(frame_of(image, gain=factor * GAIN))
        assert found.meta["gain"] == pytest.approx(GAIN, rel=0.4)


def test_true_numbers_are_kept_and_given_ones_win(plain):
    image, *_ = plain
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        measure_sources(frame_of(image, gain=GAIN, saturation=6e4))
        given = Settings(gain=0.5, saturation=7e3)
        sources = measure_sources(frame_of(image, gain=1e-3, saturation=1.0), given)
    assert sources.meta["saturation"] == 7e3
    with pytest.raises(ValueError, match="gain must be positive, got -1"):
        Settings(gain=-1)


@pytest.mark.parametrize("saturation", [100.0, 205.0, 400.0])
def test_saturation_that_contradicts_the_pixels(plain, saturation):
    image, x, _ = plain
    with pytest.warns(WPDCWarning, match="saturation of"):
        sources = measure_sources(frame_of(image, saturation=saturation))
    assert select_sources(sources).sum() > 0.9 * len(x)


@pytest.mark.parametrize(("length", "angle"), [(3.0, 0), (6.0, 0.0), (5.0, 45.0), (6.0, 90.0)])
def test_trails_are_stars(rng, length, angle):
    image, x, y = sky_of(rng, length, np.radians(angle))
    sources = measure_sources(frame_of(image))
    usable = select_sources(sources)
    rows, distance = errors(sources, x, y)
    good = (distance < 1) & usable[rows]
    assert good.mean() > 0.9
    error = np.hypot(sources["x_err"], sources["y_err"])[rows[good]]
    assert 0.8 < np.sqrt(np.mean((distance[good] / error) ** 2)) < 1.25
    assert sources.meta["ellipticity"] > 0.3


@pytest.mark.parametrize("share", [0.001, 0.005])
def test_hot_pixels_are_no_stars(plain, rng, share):
    image, x, y = plain
    hot = rng.random(SHAPE) < share
    image = image + hot * rng.uniform(300, 30000, SHAPE)
    masked = mask_hits(subtract_background(image))
    bright = hot & (image > 500)
    bright[[0, -1]] = bright[:, [0, -1]] = False
    alone = bright & (track(x, y, np.full(len(x), 1e5), 0.01) < 50)
    assert masked.mask[alone].mean() > 0.98
    assert (masked.mask & ~hot).sum() < 5
    sources = measure_sources(frame_of(image))
    assert 1.6 < sources.meta["fwhm"] < 2.6
    usable = sources[select_sources(sources)]
    true = np.hypot(np.subtract.outer(usable["x"], x), np.subtract.outer(usable["y"], y)).min(1) < 1
    assert true.mean() > 0.98
    assert true.sum() > 0.85 * len(x)


def test_mosaic_of_colors(rng):
    _, x, y = sky_of(rng)
    light = track(x, y, 10 ** rng.uniform(4, 5, len(x)), 0.01, sigma=1.4)
    response = np.ones(SHAPE)
    response[::2, ::2], response[1::2, 1::2] = 0.45, 0.6
    raw = rng.poisson((light + 300) * response) + 500.0 + rng.normal(0, 3, SHAPE)
    background = subtract_background(raw)
    # Planes of one response, and each with its own noise.
    planes = [background.rms[j::2, i::2].mean() for j in (0, 1) for i in (0, 1)]
    mean = response.mean()
    expected = [np.sqrt(300 * r + 9) / r * mean for r in (0.45, 1, 1, 0.6)]
    np.testing.assert_allclose(planes, expected, rtol=0.1)
    sources = measure_sources(frame_of(raw, gain=1.0))
    rows, distance = errors(sources, x, y)
    good = (distance < 1) & select_sources(sources)[rows]
    assert good.mean() > 0.9
    error = np.hypot(sources["x_err"], sources["y_err"])[rows[good]]
    assert 0.8 < np.sqrt(np.mean((distance[good] / error) ** 2)) < 1.25


def test_plain_images_have_no_pattern(plain):
    image, *_ = plain
    assert subtract_background(image).photons is None


def test_weight_tells_the_noise(rng):
    relative = np.ones(SHAPE)
    relative[:, 230:] = 3.0
    image = rng.normal(100, 5 * relative)
    weight = 1 / relative**2
    weight[50:60, 50:60] = 0
    background = subtract_background(image, weight=weight)
    assert background.mask.sum() == 100
    # Sharply, where the mesh alone would have a slope of 64 px.
    np.testing.assert_allclose(background.rms[:, 200:220].mean(), 5, rtol=0.05)
    np.testing.assert_allclose(background.rms[:, 245:265].mean(), 15, rtol=0.05)
    with pytest.raises(ValueError, match="weight has shape"):
        subtract_background(image, weight=weight[1:])


def test_quality_of_a_frame(plain):
    image, *_ = plain
    frame = frame_of(image, gain=GAIN)
    quality = quality_of(frame, measure_sources(frame), Settings())
    assert quality["noise"] == pytest.approx(np.sqrt(200 / GAIN + 4), rel=0.05)
    assert quality["gain"] == pytest.approx(GAIN, rel=0.4)
    assert quality["fwhm"] == pytest.approx(2.355 * np.hypot(0.8, 12**-0.5), rel=0.1)
    assert quality["ellipticity"] < 0.1
    assert quality["mismatch"] < 0.03
    assert "sources left out" in quality["left_out"]
    assert np.isnan(quality_of(frame, None, Settings())["fwhm"])


def test_gain_is_tested_against_the_read_noise(plain):
    """Sums of ten seconds, given per second: half an electron of noise would not be impossible."""
    image, *_ = plain
    rate = image / 10
    kept = replace(frame_of(rate, gain=GAIN * 10), read_noise=2.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        measure_sources(kept)
    with pytest.warns(WPDCWarning, match="that of the readout alone is 8"):
        found = measure_sources(replace(frame_of(rate, gain=GAIN), read_noise=8.0))
    assert found.meta["gain"] == pytest.approx(10 * GAIN, rel=0.3)


def test_pixels_cut_off_below_the_stated_saturation(plain):
    image, *_ = plain
    top = 0.3 * image.max()
    with pytest.warns(WPDCWarning, match="saturation of 65535 .* are cut off at"):
        sources = measure_sources(frame_of(np.minimum(image, top), saturation=65535.0))
    assert sources.meta["saturation"] == pytest.approx(top, rel=0.01)
    assert np.any(np.asarray(sources["flags"]) & FLAG_SATURATED)


def test_a_psf_that_does_not_fit_is_no_proof_against_a_gain():
    """Stars of many widths scatter more than photons do, on a sky that was subtracted."""
    rng = np.random.default_rng(8)
    x, y = (v.ravel() + rng.uniform(-3, 3, v.size) for v in np.mgrid[20:492:22, 20:492:22])
    yy, xx = np.mgrid[:512, :512]
    image = np.zeros((512, 512))
    for x0, y0, f in zip(x, y, 10 ** rng.uniform(3.3, 5.0, x.size), strict=True):
        k = np.s_[max(int(y0) - 12, 0) : int(y0) + 13, max(int(x0) - 12, 0) : int(x0) + 13]
        lump = 1 + 0.04 * rng.normal(size=image[k].shape)  # response within pixels
        r2 = (xx[k] - x0) ** 2 + (yy[k] - y0) ** 2
        image[k] += f / (2 * np.pi * 1.44) * np.exp(-r2 / 2 / 1.44) * lump
    sky = 800.0
    image = rng.poisson((image + sky) * GAIN) / GAIN - sky
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sources = measure_sources(frame_of(image, gain=GAIN))
    assert sources.meta["gain"] == GAIN
