"""Errors of bright stars whose profiles differ: what moves them, and what does not."""

import numpy as np
import pytest
from scipy.special import erf

from wpdc_gwcs.centroids import build_epsf, fit_centroids
from wpdc_gwcs.centroids._profile import Profile
from wpdc_gwcs.centroids._variation import _likely_amplitudes
from wpdc_gwcs.detection import detect_sources, subtract_background

SHAPE, SKY, GAIN, SIGMA = (840, 840), 40.0, 2.0, 1.0
BRIGHT = 3e5


def spot(x, y, flux, sigma, image):
    """Add a Gaussian, integrated over the pixels."""
    ix, iy = (np.arange(round(c) - 12, round(c) + 13) for c in (x, y))
    lines = [
        np.diff(erf((np.append(i, i[-1] + 1) - 0.5 - c) / sigma / np.sqrt(2))) / 2
        for i, c in ((ix, x), (iy, y))
    ]
    image[iy[0] : iy[-1] + 1, ix[0] : ix[-1] + 1] += flux * np.outer(lines[1], lines[0])


def measure(seed, *, width=0.0, lean=0.0, coma=0.0):
    """Errors in px and stated errors of bright stars of some scatter in width or asymmetry."""
    rng = np.random.default_rng(seed)
    y, x = (v.ravel() + rng.uniform(-3, 3, v.size) for v in np.mgrid[30:820:30, 30:820:30])
    flux = 10 ** rng.uniform(4, 6.3, x.size)
    sigma = SIGMA * (1 + rng.normal(0, width, x.size))
    # A fifth of the light beside the rest, the center of all in its place.
    off = rng.normal(0, lean, (2, x.size)) + coma * np.stack([x, 0 * x]) / SHAPE[1]
    image = np.zeros(SHAPE)
    for k in range(x.size):
        spot(x[k] - 0.2 * off[0, k], y[k] - 0.2 * off[1, k], 0.8 * flux[k], sigma[k], image)
        spot(x[k] + 0.8 * off[0, k], y[k] + 0.8 * off[1, k], 0.2 * flux[k], sigma[k], image)
    background = subtract_background(rng.poisson((image + SKY) * GAIN) / GAIN)
    sources = detect_sources(background, gain=GAIN)
    epsf = build_epsf(background, sources, gain=GAIN)
    fitted = fit_centroids(background, sources, epsf, gain=GAIN)
    index = np.hypot(np.subtract.outer(x, fitted["x"]), np.subtract.outer(y, fitted["y"])).argmin(
        axis=1
    )
    k = index[(flux > BRIGHT) & (np.asarray(fitted["flags"])[index] == 0)]
    row = np.flatnonzero(np.isin(index, k))
    error = np.concatenate([fitted["x"][index[row]] - x[row], fitted["y"][index[row]] - y[row]])
    stated = np.concatenate([fitted["x_err"][index[row]], fitted["y_err"][index[row]]])
    # Photons alone, of a Gaussian without a sky.
    limit = np.tile(SIGMA / np.sqrt(flux[row] * GAIN), 2)
    if coma:
        # The center of an asymmetric profile is a matter of definition.
        half = len(row)
        error[:half] -= np.polyval(np.polyfit(x[row], error[:half], 4), x[row])
    return error, stated, limit


def scatter(values):
    return 1.4826 * np.median(np.abs(values - np.median(values)))


def test_bright_stars_have_the_errors_of_their_photons():
    error, stated, limit = measure(1)
    assert scatter(error / stated) == pytest.approx(1, abs=0.15)
    # A floor under the error of the PSF would make it half as much again.
    assert 1 < np.median(stated / limit) < 1.2


def test_stars_of_many_widths_have_the_errors_of_that():
    """The fits of undersampled stars by a profile of another width depend on the pixel phase."""
    error, stated, limit = measure(2, width=0.03)
    assert scatter(error / limit) > 2.5
    assert scatter(error / stated) == pytest.approx(1, abs=0.35)


def test_stars_that_lean_have_errors_of_that():
    error, stated, limit = measure(3, lean=0.5)
    assert 0.6 < scatter(error / stated) < 1.2
    assert np.median(stated / limit) > 1.3


def test_coma_that_grows_over_the_frame_is_followed():
    error, stated, limit = measure(4, coma=1.5)
    assert np.median(stated / limit) < 1.6
    assert 0.5 < scatter(error / stated) < 1.2
    assert len(error) > 400


def test_stars_in_corners_are_not_led_by_noise_in_the_psf():
    """Width varies over the frame and asymmetry does not, whatever the few stars there say."""
    odd = []
    # Frames whose noise looks like coma.
    for seed in (15, 16):
        rng = np.random.default_rng(seed)
        y, x = (v.ravel() + rng.uniform(-9, 9, v.size) for v in np.mgrid[30:820:48, 30:820:48])
        r2 = ((x - 420) ** 2 + (y - 420) ** 2) / 420**2
        image = np.zeros(SHAPE)
        for k in range(x.size):
            spot(x[k], y[k], 10 ** rng.uniform(3.3, 5.3), 0.7 * (1 + 0.06 * r2[k]), image)
        background = subtract_background(rng.poisson((image + SKY) * GAIN) / GAIN)
        epsf = build_epsf(background, detect_sources(background, gain=GAIN), gain=GAIN)
        grids = np.atleast_3d(epsf.data)
        assert len(grids) > 1
        difference = grids[[0, 4, 20, 24]] - grids[[0, 4, 20, 24], ::-1, ::-1]
        odd.append(np.abs(difference).max() / grids.max() / 2)
    assert max(odd) < 0.0015


@pytest.mark.parametrize(("size", "expected"), [(0.0, 0.05), (0.02, 0.2), (0.3, 0.6)])
def test_amplitudes_are_as_large_as_the_data_say(size, expected):
    """Against the best linear estimate, which knows the size, and its error."""
    rng = np.random.default_rng(1)
    group = np.repeat([0, 1], 20)
    square, best = [], []
    for _ in range(200):
        truth = np.where(group == 0, rng.normal(0, size, 40), 0)
        factor = rng.normal(size=(120, 40))
        normal, vector = factor.T @ factor, factor.T @ (factor @ truth + rng.normal(size=120))
        found = _likely_amplitudes(normal, vector, group)
        square.append((found - truth) @ (found - truth))
        prior = np.diag(np.where(group == 0, 1 / max(size, 1e-5) ** 2, 1e10))
        known = np.linalg.solve(normal + prior, vector)
        best.append((known - truth) @ (known - truth))
    plain = 40 / 80
    assert np.mean(square) < np.mean(best) + 0.12 * plain
    assert np.mean(square) < expected * plain


@pytest.mark.parametrize(("sigma", "expected"), [(0.35, None), (0.8, 0.0)])
def test_wobble_is_that_of_the_center_of_light(sigma, expected):
    """Against centers of light of exact stars at many places in the pixel."""
    grid = np.arange(-48, 49) / 4
    edges = np.stack([grid - 0.5, grid + 0.5])
    line = np.diff(erf(edges / sigma / np.sqrt(2)), axis=0)[0] / 2
    profile = Profile.constant(np.outer(line, line), 4)
    place = (np.arange(40) + 0.5) / 40
    pixel = np.arange(-12, 14)
    edges = (np.append(pixel, 14) - 0.5 - place[:, None]) / sigma / np.sqrt(2)
    lean = np.diff(erf(edges)) / 2 @ pixel - place
    assert profile.wobble() == pytest.approx(np.sqrt(np.mean(lean**2)), rel=0.03, abs=2e-4)
    if expected is not None:
        assert profile.wobble() == pytest.approx(expected, abs=2e-4)
