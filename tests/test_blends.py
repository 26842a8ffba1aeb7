"""Stars beside stars, and stars under stars: what their fits say of them."""

import numpy as np
import pytest
from scipy.special import erf
from scipy.stats import norm

from wpdc_gwcs.centroids import build_epsf, fit_centroids, subtract_stars
from wpdc_gwcs.centroids._blends import _log_odds
from wpdc_gwcs.detection import detect_companions, detect_sources, subtract_background
from wpdc_gwcs.flags import FLAG_BLENDED, FLAG_EXTENDED, FLAG_FIT_FAILED

SHAPE, SKY, GAIN, SIGMA = (900, 900), 60.0, 1.5, 0.8
FWHM = SIGMA * np.sqrt(8 * np.log(2))


def draw(x, y, flux, sigma=SIGMA):
    """Gaussian stars, exactly integrated over the pixels."""
    image = np.zeros(SHAPE)
    sigma = np.broadcast_to(sigma, np.shape(x))
    for x0, y0, f, s in zip(x, y, flux, sigma, strict=True):
        ix, iy = (np.arange(round(c) - 12, round(c) + 13) for c in (x0, y0))
        lines = [
            np.diff(erf((np.append(i, i[-1] + 1) - 0.5 - c) / s / np.sqrt(2))) / 2
            for i, c in ((ix, x0), (iy, y0))
        ]
        image[iy[0] : iy[-1] + 1, ix[0] : ix[-1] + 1] += f * np.outer(lines[1], lines[0])
    return image


def grid(rng, step=25):
    y, x = (v.ravel() + rng.uniform(-3, 3, v.size) for v in np.mgrid[30:870:step, 30:870:step])
    return x, y


def measure(model, rng):
    image = rng.poisson((model + SKY) * GAIN) / GAIN
    background = subtract_background(image)
    sources = detect_sources(background, gain=GAIN)
    epsf = build_epsf(background, sources, gain=GAIN)
    fitted = fit_centroids(background, sources, epsf, gain=GAIN)
    residual = subtract_stars(background, fitted, epsf, gain=GAIN)
    found = detect_companions(residual, sources, gain=GAIN)
    return fit_centroids(background, found, epsf, gain=GAIN, refit=True, passes=6)


def nearest(table, x, y):
    distance = np.hypot(np.subtract.outer(x, table["x"]), np.subtract.outer(y, table["y"]))
    return table[distance.argmin(axis=1)], distance.min(axis=1)


def test_errors_of_pairs_are_those_of_both_fitted_together():
    rng = np.random.default_rng(1)
    x, y = grid(rng)
    angle = rng.uniform(0, 2 * np.pi, x.size)
    pair = np.arange(x.size) % 5 == 0
    flux = np.full(x.size, 4000.0)
    x2 = x[pair] + 1.8 * FWHM * np.cos(angle[pair])
    y2 = y[pair] + 1.8 * FWHM * np.sin(angle[pair])
    both = np.concatenate([x, x2]), np.concatenate([y, y2])
    table = measure(draw(*both, np.concatenate([flux, flux[pair]])), rng)
    errors = {}
    for name, k in (("alone", ~pair), ("paired", pair)):
        found, distance = nearest(table, x[k], y[k])
        clean = (distance < 0.5) & (np.asarray(found["flags"]) == 0)
        assert clean.mean() > 0.8
        pulls = [(found[c] - v[k]) / found[f"{c}_err"] for c, v in (("x", x), ("y", y))]
        assert np.std(np.concatenate(pulls)[np.tile(clean, 2)]) == pytest.approx(1, abs=0.1)
        errors[name] = np.median(found["x_err"][clean])
    # The closed form for Gaussians of one width: neighbors along the line of both cost the most.
    assert errors["paired"] > 1.02 * errors["alone"]


def test_hidden_companions_are_told_from_single_stars():
    rng = np.random.default_rng(2)
    x, y = grid(rng)
    angle = rng.uniform(0, 2 * np.pi, x.size)
    hidden = np.arange(x.size) % 5 == 0
    flux = 10 ** rng.uniform(4, 5, x.size)
    x2 = x[hidden] + 0.62 * FWHM * np.cos(angle[hidden])
    y2 = y[hidden] + 0.62 * FWHM * np.sin(angle[hidden])
    both = np.concatenate([x, x2]), np.concatenate([y, y2])
    table = measure(draw(*both, np.concatenate([flux, 0.12 * flux[hidden]])), rng)
    found, distance = nearest(table, x, y)
    assert distance.max() < 0.8
    unlike = np.asarray(found["flags"]) & (FLAG_EXTENDED | FLAG_FIT_FAILED | FLAG_BLENDED) > 0
    assert unlike[hidden].mean() > 0.8
    assert unlike[~hidden].mean() < 0.04


def test_odds_are_those_of_normal_likelihoods():
    rng = np.random.default_rng(6)
    known = rng.uniform(1, 60, (20, 5))
    share = rng.normal(0, 3 / known)
    light = 10 ** (-0.4 * np.linspace(0, 4, 9))
    with_one = norm.pdf(share[:, :, None], light, 1 / known[:, :, None]).mean(axis=2)
    ratio = (with_one / norm.pdf(share, 0, 1 / known)).mean(axis=1)
    assert _log_odds(share, known) == pytest.approx(np.log(ratio), rel=1e-9)
    # Stars so bright that likelihoods are no numbers any more.
    assert _log_odds(np.array([[0.1]]), np.array([[1e4]]))[0] > 1e5


def test_stars_of_many_colors_are_not_taken_for_pairs():
    rng = np.random.default_rng(3)
    x, y = grid(rng)
    flux = 10 ** rng.uniform(3.3, 5.3, x.size)
    table = measure(draw(x, y, flux, SIGMA * (1 + rng.normal(0, 0.03, x.size))), rng)
    found, distance = nearest(table, x, y)
    clean = (distance < 0.5) & (np.asarray(found["flags"]) == 0)
    assert clean.mean() > 0.93
    assert clean[flux > 6e4].mean() > 0.9
    pulls = np.concatenate([(found[c] - v) / found[f"{c}_err"] for c, v in (("x", x), ("y", y))])
    assert 1.4826 * np.median(np.abs(pulls[np.tile(clean, 2)])) == pytest.approx(1, abs=0.12)


def test_a_part_of_the_frame_is_judged_by_its_own_stars():
    """The best measured stars are all elsewhere, and the PSF does not follow in a corner."""
    rng = np.random.default_rng(5)
    x, y = grid(rng, step=17)
    corner = (x > 550) & (y < 350)
    bright = (x < 450) & (y > 300)
    flux = np.where(bright, 10 ** rng.uniform(5.3, 5.8, x.size), 10 ** rng.uniform(4, 5, x.size))
    bump = np.exp(-((x - 750) ** 2 + (y - 150) ** 2) / (2 * 200**2))
    table = measure(draw(x, y, flux, SIGMA * (1 + 0.06 * bump)), rng)
    found, distance = nearest(table, x, y)
    broad = np.asarray(found["flags"]) & FLAG_EXTENDED > 0
    assert distance.max() < 0.5
    assert broad[corner].mean() < 0.15


def test_rings_are_no_blends():
    """Light between two rings that touch is not that of a Gaussian's wings."""
    rng = np.random.default_rng(4)
    gy, gx = (v.ravel() + rng.uniform(-2, 2, v.size) for v in np.mgrid[40:860:28, 40:860:40])
    x, y = np.concatenate([gx, gx[::3] + 12]), np.concatenate([gy, gy[::3]])
    model = np.zeros(SHAPE)
    step = (np.arange(4) + 0.5) / 4 - 0.5
    for x0, y0 in zip(x, y, strict=True):
        iy, ix = (np.arange(round(c) - 9, round(c) + 10) for c in (y0, x0))
        ring = np.zeros((19, 19))
        for v in step:
            for u in step:
                r = np.hypot((iy + v - y0)[:, None], ix + u - x0)
                ring += 1 / (1 + np.exp((r - 4) / 0.6)) / (1 + np.exp(-(r - 1.8) / 0.6))
        model[iy[0] : iy[-1] + 1, ix[0] : ix[-1] + 1] += 20000 * ring / ring.sum()
    table = measure(model, rng)
    found, distance = nearest(table, x, y)
    assert np.mean((distance < 0.5) & (np.asarray(found["flags"]) == 0)) > 0.9


@pytest.mark.parametrize(("ratio", "least"), [(0.3, 0.7), (1.0, 0.4)])
def test_close_bright_pairs_are_fitted_as_well_as_their_light_allows(ratio, least):
    """Found one after the other, at 1.5 to 1.8 FWHM, where each would take the other's light."""
    rng = np.random.default_rng(5)
    x, y = grid(rng)
    angle = rng.uniform(0, 2 * np.pi, x.size)
    pair = np.arange(x.size) % 4 == 0
    flux = 10 ** rng.uniform(4, 5.3, x.size)
    apart = rng.uniform(1.5, 1.8, pair.sum()) * FWHM
    x2, y2 = x[pair] + apart * np.cos(angle[pair]), y[pair] + apart * np.sin(angle[pair])
    both = np.concatenate([x, x2]), np.concatenate([y, y2])
    table = measure(draw(*both, np.concatenate([flux, ratio * flux[pair]])), rng)
    found, _ = nearest(table, x[pair], y[pair])
    other, _ = nearest(table, x2, y2)
    usable = np.asarray(found["flags"]) == 0
    assert usable.mean() > least
    error = np.hypot(found["x"] - x[pair], found["y"] - y[pair])
    assert np.median(error) < 0.01
    ratios = np.asarray(other["flux"]) / np.asarray(found["flux"])
    assert np.median(ratios[usable]) == pytest.approx(ratio, rel=0.02)
    pulls = np.concatenate(
        [((found[c] - v[pair]) / found[f"{c}_err"])[usable] for c, v in (("x", x), ("y", y))]
    )
    # The error of a neighbor's model is an upper limit.
    assert 0.5 < 1.4826 * np.median(np.abs(pulls)) < 1.1
