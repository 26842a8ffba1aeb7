"""Errors of reference stars that all exposures share, against simulated catalogs."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from wpdc_gwcs.models import deproject, project
from wpdc_gwcs.solve import Exposure, solve
from wpdc_gwcs.solve.errors import repetition
from wpdc_gwcs.solve.represent import N_SIGMA

SIDE, CENTROID, CATALOG = 2048, 0.01, 0.06
CENTER = 0.5 * (SIDE - 1)
CD = np.array([[-2e-5, 0.0], [0.0, 2e-5]])


def undistorted(x, y):
    """Focal plane of a detector with a distortion of 6 px, from its center."""
    u, v = (x - CENTER) / 1024, (y - CENTER) / 1024
    return np.array([x - CENTER + 3 * u * (u**2 + v**2), y - CENTER + 2 * u * v - v**3])


def exposures_of(rng, *, n, known, stars=400):
    """Exposures of the same stars, a few px apart, with one catalog for all of them."""
    x, y = rng.uniform(0, SIDE - 1, (2, stars))
    sky = np.array(deproject(*(CD @ undistorted(x, y)), (120.0, 30.0)))
    # The catalog is wrong by as much for every exposure.
    off = rng.normal(size=(2, stars)) * CATALOG * 2e-5
    ra, dec = sky[0] + off[0] / np.cos(np.radians(sky[1])), sky[1] + off[1]
    frames = []
    for k in range(n):
        noise = rng.normal(size=(2, stars)) * CENTROID
        error = np.full(stars, np.hypot(CENTROID, CATALOG))
        frames.append(
            Exposure(
                f"e{k}", x + noise[0], y + noise[1], ra, dec, crval=(120.0, 30.0), cd=CD,
                x_err=error, y_err=error,
                reference_err=np.full(stars, CATALOG) if known else None,
                star=np.arange(stars) if known else None,
            )
        )  # fmt: skip
    return frames


def pulls_of(frames):
    """Error over uncertainty of the delivered maps, on a grid."""
    result = solve(frames, image_shape=(SIDE, SIDE), lut="none", degree=3)
    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(-0.5, SIDE - 0.5, N_SIGMA)] * 2))
    found = []
    for fit in result.exposures:
        plane = fit.cd @ (np.array(result.solution.undistort(x, y)) - CENTER)
        true = project(*deproject(*(CD @ undistorted(x, y)), (120.0, 30.0)), fit.crval)
        error = np.linalg.solve(fit.cd, plane - np.array(true))
        found.append(error / fit.sigma[:2].reshape(2, -1))
    return np.array(found)


def rms(values):
    return np.sqrt(np.mean(np.square(values)))


def test_errors_of_the_catalog_do_not_average_out(rng):
    known, unknown = (
        rms([pulls_of(exposures_of(rng, n=9, known=known)) for _ in range(6)])
        for known in (True, False)
    )
    # Nine exposures of one catalog are hardly better than one.
    assert 0.7 < known < 1.4
    assert unknown > 1.4 * known


def test_repetition_counts_what_stars_have_in_common():
    star, one = np.repeat(np.arange(50), 4), np.ones(200)
    assert repetition(star, one, 0 * one) == 1.0
    assert repetition(np.full(200, -1), one, one) == 1.0
    assert_allclose(repetition(star, one, one), 4.0)
    # sigma_catalog^2 = sigma^2 = 1/2: a mean of four has 1/2 + 1/8, one alone 1.
    assert_allclose(repetition(star, one, 0.5 * one), 4 * 0.625)
    assert repetition(np.zeros(0, int), np.zeros(0), np.zeros(0)) == 1.0


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_repetition_of_single_stars_is_one(share):
    star = np.arange(30)
    assert_allclose(repetition(star, np.full(30, 2.0), np.full(30, share)), 1.0)
