"""The literal WPDC-2P: against its own definition, and against truth."""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.wcs import WCS
from scipy.interpolate import RBFInterpolator, RegularGridInterpolator

from wpdc_gwcs import RadialWeight, Settings, calibrate, read, simulate, to_stock_wcs, write
from wpdc_gwcs.exceptions import FitError
from wpdc_gwcs.models import PVPolynomial, deproject, project
from wpdc_gwcs.paper import build_raw_table, fit_exposure, solve_literally
from wpdc_gwcs.solve import Exposure

SHAPE = (1000, 1100)
CD = np.array([[-8e-5, 1e-6], [1e-6, 8e-5]])
CRPIX = np.array([549.5, 499.5])
CRVAL = (120.0, 30.0)


def distorted(n=1500, seed=1, amplitude=20.0):
    """Pairs of a quintic distortion without noise."""
    x, y = np.random.default_rng(seed).uniform([[0], [0]], [[SHAPE[1]], [SHAPE[0]]], (2, n))
    u, v = (x - CRPIX[0]) / 550, (y - CRPIX[1]) / 550
    shift = amplitude * np.array([u * (u**2 + v**2) ** 2 + u * v, v**3 - 0.3 * u**2])
    place = np.array([x, y]) - CRPIX[:, None] + shift
    ra, dec = deproject(*(CD @ place), CRVAL)
    return Exposure("e", x, y, ra, dec, crval=CRVAL, cd=CD, detector="d"), place


def weighted_cubic(exposure, place, r0):
    """Optimum of the paper's objective in pixels, by lstsq: same fit in other coordinates."""
    offset = np.array([exposure.x, exposure.y]) - CRPIX[:, None]
    r = np.hypot(*offset)
    w = np.where(r <= r0, 1.0, np.exp(-np.sqrt(np.maximum(r - r0, 0))))

    def rows(x, y):
        x, y = x / 550, y / 550
        return np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=1)

    root = np.sqrt(w)[:, None]
    solution = np.linalg.lstsq(rows(*offset) * root, place.T * root, rcond=None)[0]
    return lambda x, y: (rows(x - CRPIX[0], y - CRPIX[1]) @ solution).T + CRPIX[:, None]


def test_ten_damped_steps_leave_a_share_of_the_optimum():
    exposure, place = distorted()
    fit = fit_exposure(exposure, CRPIX, weight=RadialWeight("w1", r0=435.0))
    x, y = np.array([[0.0, 1099.0, 300.0, 549.5], [0.0, 999.0, 700.0, 499.5]])
    optimum = weighted_cubic(exposure, place, 435.0)(x, y)
    expected = optimum + ([x, y] - optimum) / 2**10
    assert fit.steps == 10
    np.testing.assert_allclose(fit.correct(x, y), expected, atol=1e-7)
    # X' - X_ref
    truth = place + CRPIX[:, None]
    np.testing.assert_allclose(
        fit.residuals(), fit.correct(exposure.x, exposure.y) - truth, atol=1e-7
    )


def test_small_distortion_is_at_rest_before_ten_steps():
    exposure, _ = distorted(amplitude=0.01)
    assert fit_exposure(exposure, CRPIX, weight=RadialWeight("w1", r0=435.0)).steps < 10


def test_matches_are_made_anew_after_each_step():
    exposure, _ = distorted()
    wrong = replace(exposure, ra=exposure.ra.copy())
    wrong.ra[:100] += 5e-3
    asked = []

    def rematch(correct):
        asked.append(correct(*CRPIX))
        return exposure

    fit = fit_exposure(wrong, CRPIX, weight=RadialWeight("w1", r0=435.0), rematch=rematch)
    right = fit_exposure(exposure, CRPIX, weight=RadialWeight("w1", r0=435.0))
    assert len(asked) == 9
    assert fit.exposure is exposure
    # What the first step had wrong is halved nine times.
    assert np.abs(fit.residuals() - right.residuals()).max() < 0.5


def test_too_few_stars_within_the_radius():
    exposure, _ = distorted(40)
    with pytest.raises(FitError, match="more than 10 stars within r0 = 90 px.*, has"):
        fit_exposure(exposure, CRPIX, weight=RadialWeight("w1", r0=90.0))
    few, _ = distorted(9)
    with pytest.raises(FitError, match="more than 10 stars in every exposure.*, has 9"):
        fit_exposure(few, CRPIX, weight=RadialWeight("uniform"))


@pytest.mark.parametrize("n", [500, 5000])
def test_table_is_scipy_s_surface_through_raw_residuals(n, rng):
    x, y = rng.uniform(0, 1000, (2, n))
    dx, dy = rng.normal(0, 0.05, (2, n))
    table = build_raw_table(x, y, dx, dy, image_shape=(1000, 1000), n_grid=12)
    grid = np.linspace(0, 1000, 12)
    nodes = np.stack(np.meshgrid(grid, grid), axis=-1)
    surface = RBFInterpolator(
        np.stack([x, y], axis=1), np.stack([dx, dy], axis=1), neighbors=None if n == 500 else 50
    )
    expected = surface(nodes.reshape(-1, 2)).reshape(12, 12, 2)
    np.testing.assert_allclose(table.dx, expected[..., 0], atol=1e-9)
    np.testing.assert_allclose(table.dy, expected[..., 1], atol=1e-9)
    at = rng.uniform(0, 1000, (2, 50))
    linear = RegularGridInterpolator((grid, grid), expected)(at[::-1].T)
    np.testing.assert_allclose(np.array(table(*at)), linear.T, atol=1e-9)


def test_stars_on_one_pixel_are_one(rng):
    x, y = rng.uniform(0, 1000, (2, 200))
    dx = rng.normal(0, 0.05, 200)
    once = build_raw_table(x, y, dx, dx, image_shape=(1000, 1000), n_grid=5)
    at = np.append(x, x[0]), np.append(y, y[0])
    values = np.append(dx, dx[0] + 0.2)
    values[0] -= 0.2
    twice = build_raw_table(*at, values, values, image_shape=(1000, 1000), n_grid=5)
    np.testing.assert_allclose(twice.dx, once.dx, atol=1e-9)


def test_stars_on_a_line_have_no_table():
    x = np.arange(50.0)
    with pytest.raises(FitError, match="stars that are not on one line, got 50"):
        build_raw_table(x, x, x, x, image_shape=(100, 100))


@pytest.fixture(scope="module")
def sky():
    return simulate(
        4, image_shape=SHAPE, density=40, distortion=30, roll_error=0.05 * u.deg, seed=3
    )


@pytest.fixture(scope="module")
def run(sky):
    return calibrate(
        [e.frame() for e in sky.exposures], sky.reference, settings=Settings(method="paper")
    )


def wcs_errors(sky, run):
    return [
        np.array(e.wcs_error(c.wcs)) for e, c in zip(sky.exposures, run.calibrations, strict=True)
    ]


def test_literal_method_solves_and_costs(sky, run):
    assert not run.failures
    ours = calibrate([e.frame() for e in sky.exposures], sky.reference)
    literal, default = (
        np.sqrt(np.mean([np.sum(e[2:] ** 2, axis=0) for e in wcs_errors(sky, r)]))
        for r in (run, ours)
    )
    # As bad as a star's centroid, where the default averages over all.
    assert 0.03 < literal < 0.2
    assert literal > 5 * default
    assert run.calibrations[0].settings["method"] == "paper"
    assert run.solutions["sim"].settings["method"] == "paper"


def test_errors_hold_what_they_say(sky, run):
    pulls = []
    for (x, y, dx, dy), c in zip(wcs_errors(sky, run), run.calibrations, strict=True):
        sigma_x, sigma_y, _ = c.uncertainty(x, y)
        pulls += [dx / sigma_x, dy / sigma_y]
    assert 0.6 < np.sqrt(np.mean(np.square(pulls))) < 1.3


def test_every_exposure_has_its_polynomial_about_its_header(sky, run):
    for exposure, c in zip(sky.exposures, run.calibrations, strict=True):
        header = WCS(exposure.header)
        np.testing.assert_allclose(c.crval, header.wcs.crval)
        np.testing.assert_allclose(c.cd, header.wcs.cd, atol=1e-13)
        np.testing.assert_array_equal(c.solution.cd, c.cd)
        np.testing.assert_allclose(c.solution.crpix, header.wcs.crpix - 1)
        # The pointing is in the constants, the roll in the linear terms.
        assert c.solution.pv.pv1_0 != 0
        assert c.solution.pv.pv1_2 != 0
    tables = {id(c.solution.lookup_table) for c in run.calibrations}
    assert len(tables) == 1
    table = run.solutions["sim"].lookup_table
    assert table.method == "linear"
    assert table.x_grid[[0, -1]].tolist() == [0, 1100]
    assert table.y_grid[[0, -1]].tolist() == [0, 1000]
    assert table.dx.shape == (50, 50)


def test_residuals_are_those_of_the_delivered_wcs(run):
    c = run.calibrations[1]
    m = c.matches
    place = c.undistort(m["x"].value, m["y"].value)
    plane = np.linalg.solve(c.cd, np.array(project(m["ra"].value, m["dec"].value, c.crval)))
    expected = np.array(place) - c.solution.crpix[:, None] - plane
    np.testing.assert_allclose([m["dx"].value, m["dy"].value], expected, atol=1e-8)


def test_stored_mean_polynomial_is_that_of_the_exposures(sky, run):
    solution = run.solutions["sim"]
    pv = solution.pv
    assert (pv.pv1_0, pv.pv1_1, pv.pv1_2, pv.pv2_0, pv.pv2_1, pv.pv2_2) == (0, 1, 0, 0, 1, 0)
    x, y = np.array([[100.0, 900, 500], [100.0, 200, 800]])
    found = np.array(solution.undistort(x, y))
    # About the optimum without constant and linear part, which the attitude carries.
    exposure = sky.exposures[0]
    true = np.array(exposure.distortion.undistort(x, y))
    assert np.abs(found - true).max() < 1.0
    assert np.abs(np.array([x, y]) - true).max() > 3.0


@pytest.mark.parametrize("form", ["fits", "cpdis", "tpv", "head", "tab", "sip", "stock"])
@pytest.mark.filterwarnings("ignore::wpdc_gwcs.exceptions.WPDCWarning")
def test_every_form_of_file(run, tmp_path, form):
    deviation = write(run.calibrations[0], tmp_path / "frame", format=form)
    # Of a table of noise, polynomials are as far off as the noise.
    assert deviation is None or deviation < 1.0


def test_files_give_it_back(run, tmp_path):
    c = run.calibrations[2]
    x, y = np.meshgrid(np.linspace(-0.5, 1099.5, 21), np.linspace(-0.5, 999.5, 21))
    write(c, tmp_path / "a.wcs.asdf")
    write(c, tmp_path / "a.fits", format="fits")
    for path in ("a.wcs.asdf", "a.fits"):
        back = read(tmp_path / path)
        np.testing.assert_allclose(back.wcs(x, y), c.wcs(x, y), rtol=0, atol=1e-12)
        assert back.solution.lookup_table.method == "linear"
    np.testing.assert_allclose(to_stock_wcs(c.wcs)(x, y), c.wcs(x, y), rtol=0, atol=1e-11)
    header = fits.getheader(tmp_path / "a.fits")
    assert header["CTYPE1"] == "RA---TPV"
    assert header["PV1_0"] == c.solution.pv.pv1_0.value
    write(run.solutions["sim"], tmp_path / "s.solution.asdf")
    assert read(tmp_path / "s.solution.asdf").settings["method"] == "paper"


def test_stored_table_is_used_as_it_is(sky, run):
    frame = sky.exposures[3].frame()
    new = calibrate([frame], sky.reference, solution=run.solutions["sim"],
                    settings=Settings(method="paper"))  # fmt: skip
    (c,) = new.calibrations
    assert c.solution.lookup_table is run.solutions["sim"].lookup_table
    np.testing.assert_allclose(
        c.solution.pv.parameters, run.calibrations[3].solution.pv.parameters, atol=1e-4
    )
    x, y, dx, dy = sky.exposures[3].wcs_error(c.wcs)
    assert np.sqrt(np.mean(dx**2 + dy**2)) < 0.2


def test_polynomial_alone_says_what_it_leaves(sky):
    run = calibrate([e.frame() for e in sky.exposures[:2]], sky.reference,
                    settings=Settings(method="paper", lut="none"))  # fmt: skip
    c = run.calibrations[0]
    assert c.lookup_table is None
    assert c.statistics["status"] == "degraded"
    assert "the map is uncertain by more than 0.25 px" in c.statistics["reasons"][0]
    x, y, dx, dy = sky.exposures[0].wcs_error(c.wcs)
    sigma = np.hypot(*c.uncertainty(x, y)[:2])
    assert 0.5 < np.sqrt(np.mean(dx**2 + dy**2) / np.mean(sigma**2)) < 2


def test_held_out_stars_have_no_part(sky):
    settings = Settings(method="paper", holdout=0.3)
    run = calibrate([e.frame() for e in sky.exposures], sky.reference, settings=settings)
    for c in run.calibrations:
        held, used = c.matches["holdout"], c.matches["used"]
        assert 0.2 < held.mean() < 0.4
        assert not (held & used).any()
    # A table through the noise of its own stars flatters them.
    pooled = {
        name: np.concatenate([c.matches["dx"].value[c.matches[name]] for c in run.calibrations])
        for name in ("used", "holdout")
    }
    assert np.std(pooled["holdout"]) > np.std(pooled["used"])


def test_reference_point_of_the_nearest_source(sky):
    settings = Settings(method="paper", reference_point="nearest-source")
    run = calibrate([e.frame() for e in sky.exposures], sky.reference, settings=settings)
    points = np.array([c.solution.crpix for c in run.calibrations])
    assert len(np.unique(points, axis=0)) == 4
    for c, exposure in zip(run.calibrations, sky.exposures, strict=True):
        m = c.matches
        row = np.argmin(np.hypot(m["x"].value - 549.5, m["y"].value - 499.5))
        np.testing.assert_array_equal(c.solution.crpix, [m["x"].value[row], m["y"].value[row]])
        np.testing.assert_allclose(c.crval, [m["ra"].value[row], m["dec"].value[row]])
        _, _, dx, dy = exposure.wcs_error(c.wcs)
        assert np.sqrt(np.mean(dx**2 + dy**2)) < 0.2


def test_detectors_are_solved_apart_and_fail_alone():
    one, _ = distorted()
    few = replace(distorted(12)[0], name="f", detector="other")
    shape = {"d": SHAPE, "other": SHAPE}
    weight = dict.fromkeys(shape, RadialWeight("w1", r0=435.0))
    result, last = solve_literally([one, few], [CRPIX] * 2, image_shape=shape, weight=weight)
    assert set(result.solutions) == {"d"}
    assert "more than 10 stars within r0 = 435 px" in result.rejected["f"]
    assert result.exposures[1].reason == result.rejected["f"]
    assert last[0] is one


def test_wrong_options(sky):
    with pytest.raises(ValueError, match="method must be one of wpdc, paper, got 'scamp'"):
        Settings(method="scamp")
    with pytest.raises(ValueError, match="refine must be 'auto' or 'pv' with method='paper'"):
        Settings(method="paper", refine="field")
    with pytest.raises(ValueError, match="update needs method='wpdc'"):
        calibrate([sky.exposures[0].frame()], sky.reference, update=True,
                  settings=Settings(method="paper"))  # fmt: skip
    with pytest.raises(ValueError, match="lut must be 'auto' or 'none', got 'always'"):
        solve_literally([], [], image_shape={}, weight={}, lut="always")


def test_weights_by_the_paper_s_numbers():
    names = {"w1": "exp-sqrt", "w2": "gaussian", "w3": "inverse", "w4": "inverse-square"}
    for number, name in names.items():
        assert RadialWeight(number, r0=100.0) == RadialWeight(name, r0=100.0)
        assert Settings(weight=number).weight == name
    with pytest.raises(ValueError, match="or w1 to w4, got 'w0'"):
        RadialWeight("w0")


def test_degree_is_that_asked_for(sky):
    run = calibrate([e.frame() for e in sky.exposures[:2]], sky.reference,
                    settings=Settings(method="paper", degree=5))  # fmt: skip
    assert {c.solution.pv.degree for c in run.calibrations} == {5}
    assert run.solutions["sim"].pv.degree == 5
    assert isinstance(run.solutions["sim"].pv, PVPolynomial)
