"""Free reference stars against a truth drawn here: exposures of one catalog that is off."""

import logging
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose

from wpdc_gwcs import Settings
from wpdc_gwcs.calibration.free_stars import solve_free_stars
from wpdc_gwcs.models import deproject, project
from wpdc_gwcs.solve import Exposure, solve

SIDE, CENTROID, CATALOG = 2048, 0.01, 0.08
CENTER, SCALE = 0.5 * (SIDE - 1), 2e-5
MAS = SCALE * 3.6e6  # per px
FIELD = (120.0, 60.0)


def undistorted(x, y):
    u, v = (x - CENTER) / 1024, (y - CENTER) / 1024
    return np.array([x - CENTER + 3 * u * (u**2 + v**2), y - CENTER + 2 * u * v - v**3])


def pixels(plane):
    """Inverse of the distortion by iteration."""
    x, y = plane + CENTER
    for _ in range(40):
        off = undistorted(x, y) - plane
        x, y = x - off[0], y - off[1]
    return x, y


class Night:
    """Six exposures, dithered and rolled, of stars whose catalog is off."""

    def __init__(self, rng, stars=400, centroid=CENTROID, stated=1.0):
        offset = rng.uniform(-0.035, 0.035, (2, stars))
        self.true = np.array(deproject(*offset, FIELD))
        self.off = rng.normal(size=(2, stars)) * CATALOG * SCALE
        east = self.off[0] / np.cos(np.radians(self.true[1]))
        ra, dec = self.true[0] + east, self.true[1] + self.off[1]
        self.pointings, self.exposures = [], []
        for k in range(6):
            turn, crval = rng.uniform(-0.02, 0.02), np.array(FIELD) + rng.uniform(-4e-3, 4e-3, 2)
            cd = SCALE * np.array([[-np.cos(turn), np.sin(turn)], [np.sin(turn), np.cos(turn)]])
            self.pointings.append((crval, cd))
            x, y = pixels(np.linalg.solve(cd, project(*self.true, crval)))
            seen = (
                (x > 0)
                & (x < SIDE - 1)
                & (y > 0)
                & (y < SIDE - 1)
                & (rng.uniform(size=stars) < 0.9)
            )
            noise = rng.normal(size=(2, stars)) * centroid
            error = np.full(seen.sum(), np.hypot(centroid * stated, CATALOG * stated))
            self.exposures.append(
                Exposure(
                    f"e{k}", (x + noise[0])[seen], (y + noise[1])[seen], ra[seen], dec[seen],
                    crval=crval, cd=cd, x_err=error, y_err=error,
                    reference_err=np.full(seen.sum(), CATALOG * stated),
                    star=np.flatnonzero(seen) + 1000,
                )
            )  # fmt: skip

    def errors(self, result):
        """Errors of the maps of all exposures at the same places of the sky, px of its axes."""
        grid = np.array(np.meshgrid(*[np.linspace(-0.012, 0.012, 7)] * 2)).reshape(2, -1)
        sky, found = deproject(*grid, FIELD), []
        for (crval, cd), fit in zip(self.pointings, result.exposures, strict=True):
            x, y = pixels(np.linalg.solve(cd, project(*sky, crval)))
            plane = fit.cd @ (np.array(result.solution.undistort(x, y)) - CENTER)
            found.append((plane - np.array(project(*sky, fit.crval))) / SCALE)
        return np.array(found)


def options():
    return {"image_shape": (SIDE, SIDE), "lut": "none", "degree": 3, "refine": "attitude"}


def rms(values):
    return np.sqrt(np.mean(np.square(values)))


def test_exposures_agree_and_stars_are_found(rng):
    apart, whole, left = [], [], []
    for _ in range(4):
        night = Night(rng)
        first = solve(night.exposures, **options())
        free = solve_free_stars(night.exposures, first, partial(solve, **options()))
        errors = [night.errors(r) for r in (first, free)]
        apart.append([rms(e - e.mean(axis=0)) for e in errors])
        whole.append([rms(e) for e in errors])
        for exposure, fit in zip(night.exposures, free.exposures, strict=True):
            # True place less that of the catalog; all exposures may share a little of both.
            difference = fit.reference_offset / MAS + night.off[:, exposure.star - 1000] / SCALE
            left.append(rms(difference - difference.mean(axis=1, keepdims=True)))
    apart, whole = np.mean(apart, axis=0), np.mean(whole, axis=0)
    # Centroids alone would leave 0.01 sqrt(3 / 250) = 0.0011 px.
    assert apart[1] < 0.5 * apart[0]
    assert apart[1] < 0.0025
    assert whole[1] < 1.05 * whole[0]
    assert np.mean(left) < 0.35 * CATALOG


def test_errors_are_those_of_the_catalog(rng):
    night = Night(rng)
    first = solve(night.exposures, **options())
    free = solve_free_stars(night.exposures, first, partial(solve, **options()))
    errors = night.errors(free)
    sigma = np.array([fit.sigma[:2].mean() for fit in free.exposures])
    assert 0.4 < rms(errors) / rms(sigma) < 1.5
    for fit in free.exposures:
        assert_allclose(fit.x_err, np.hypot(CENTROID, CATALOG), rtol=0.3)
        assert rms([fit.dx, fit.dy]) == pytest.approx(np.hypot(CENTROID, CATALOG), rel=0.15)
        assert 0.7 < fit.statistics["free_stars"]["catalog_scale"] < 1.3
        assert fit.statistics["free_stars"]["rms_offset_mas"] == pytest.approx(
            CATALOG * MAS, rel=0.2
        )


def test_wrong_errors_are_rescaled(rng):
    night = Night(rng, stated=0.4)
    first = solve(night.exposures, **options())
    free = solve_free_stars(night.exposures, first, partial(solve, **options()))
    scales = free.exposures[0].statistics["free_stars"]
    assert scales["catalog_scale"] == pytest.approx(2.5, rel=0.25)
    assert scales["centroid_scale"] == pytest.approx(2.5, rel=0.25)


def test_stars_that_nobody_shares_stay(rng, caplog):
    night = Night(rng)
    alone = night.exposures[:1]
    first = solve(alone, **options())
    with caplog.at_level(logging.WARNING):
        assert solve_free_stars(alone, first, partial(solve, **options())) is first
    assert "fewer than 20 stars" in caplog.text


def test_the_paper_has_no_free_stars():
    with pytest.raises(ValueError, match="free_stars must be False"):
        Settings(method="paper", free_stars=True)
