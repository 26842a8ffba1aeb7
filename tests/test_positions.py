"""Positions of sources on the sky and their errors; truth is a Monte Carlo of both parts."""

from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table
from test_io_formats import make_calibration

from wpdc_gwcs.calibration.positions import sky_positions, with_sky_positions
from wpdc_gwcs.models import deproject


def offsets_mas(ra, dec, center):
    """Offsets east and north of a position in mas; small angles."""
    east = (ra - center[0] + 180.0) % 360.0 - 180.0
    return 3.6e6 * np.array([east * np.cos(np.radians(center[1])), dec - center[1]])


@pytest.mark.parametrize("crval", [(294.6, 35.1), (0.0003, -72.0), (120.0, 89.2)])
def test_errors_are_the_scatter(crval, rng):
    """Centroids and the calibration scatter as they say; positions then as is said of them."""
    calibration = make_calibration(crval=crval, amplitude=100.0, roll=33.0)
    # Not too near to a pole: there RA and Dec are no plane over the errors.
    x, y = np.array([10.0, 1500.0, 700.0]), np.array([20.0, 300.0, 2000.0])
    x_err, y_err = np.array([0.02, 0.2, 0.05]), np.array([0.06, 0.1, 0.02])
    found = sky_positions(calibration, x, y, x_err, y_err)
    np.testing.assert_array_equal((found["ra"], found["dec"]), calibration.wcs(x, y))
    sigma_x, sigma_y, rho = calibration.uncertainty(x, y)
    crpix = np.asarray(calibration.solution.crpix)
    n = 40_000
    for k in range(3):
        moved = calibration.undistort(
            x[k] + x_err[k] * rng.normal(size=n), y[k] + y_err[k] * rng.normal(size=n)
        )
        cross = rho[k] * sigma_x[k] * sigma_y[k]
        own = [[sigma_x[k] ** 2, cross], [cross, sigma_y[k] ** 2]]
        moved = np.array(moved).T + rng.multivariate_normal((0, 0), own, n)
        sky = deproject(*(calibration.cd @ (moved - crpix).T), calibration.crval)
        scatter = np.cov(offsets_mas(*sky, (found["ra"][k], found["dec"][k])))
        np.testing.assert_allclose(found["ra_error"][k], np.sqrt(scatter[0, 0]), rtol=0.02)
        np.testing.assert_allclose(found["dec_error"][k], np.sqrt(scatter[1, 1]), rtol=0.02)
        correlation = scatter[0, 1] / np.sqrt(scatter[0, 0] * scatter[1, 1])
        assert abs(found["ra_dec_corr"][k] - correlation) < 0.03


def tables(errors=True):
    sources = Table({"x": [10.0, 700.0, -3.0], "y": [20.0, 900.0, 5.0]})
    if errors:
        sources["x_err"], sources["y_err"] = 0.03, 0.04
    matches = Table({"source_index": [1], "catalog_index": [7], "x": [700.0], "y": [900.0]})
    matches["x_err"], matches["y_err"], matches["ra"], matches["dec"] = 0.06, 0.08, 1.0, 2.0
    return {"sources": sources, "matches": matches}


def test_tables_of_a_frame():
    calibration = make_calibration()
    scaled = {"error_scale": 2.0, "error_floor": 0.0}
    solution = replace(calibration.solution, statistics=scaled)
    calibration = replace(calibration, solution=solution, **tables())
    with_sky = with_sky_positions(calibration)
    sources, matches = with_sky.sources, with_sky.matches
    assert "ra" not in calibration.sources.colnames  # the argument is left alone
    assert sources["ra_error"].unit == "mas"
    assert str(sources["ra"].unit) == "deg"
    np.testing.assert_allclose(
        [sources[n][:2] for n in ("ra", "dec")], calibration.wcs(*(sources[n][:2] for n in "xy"))
    )
    # Off the detector there is a position, and nothing known of its error.
    assert np.isfinite(sources["ra"][2])
    assert np.isnan(sources["ra_error"]).tolist() == [False, False, True]
    # The reference star keeps its place in the pairs.
    assert (matches["ra"][0], matches["dec"][0]) == (1.0, 2.0)
    for name in ("ra", "dec"):
        assert matches[f"source_{name}"][0] == sources[name][1]
    for name in ("ra_error", "dec_error", "ra_dec_corr"):
        assert matches[name][0] == sources[name][1]
    # Twice the centroid error, as the solution found.
    expected = sky_positions(calibration, [700.0], [900.0], [0.06], [0.08])
    assert matches["dec_error"][0] == pytest.approx(expected["dec_error"][0])


@pytest.mark.parametrize("kept", ["both", "matches"])
def test_frames_without_errors_or_sources(kept):
    """Then those of the pairs serve; a source list has no table of sources of ours."""
    found = tables(errors=False)
    if kept == "matches":
        del found["sources"]
    calibration = replace(make_calibration(), **found)
    matches = with_sky_positions(calibration).matches
    expected = sky_positions(calibration, [700.0], [900.0], [0.06], [0.08])
    for name in ("ra_error", "dec_error", "ra_dec_corr"):
        assert matches[name][0] == pytest.approx(expected[name][0])
    bare = replace(calibration, matches=None)
    assert with_sky_positions(bare) is bare
