from dataclasses import replace

import numpy as np
import pytest
from astropy.wcs import WCS
from numpy.testing import assert_allclose

from wpdc_gwcs import Calibration, DistortionSolution, LookupTable, PVPolynomial

SHAPE = (1000, 2000)
CD = 1e-4 * np.array([[-1.0, 0.2], [0.2, 1.0]])


@pytest.fixture
def solution():
    return DistortionSolution(
        detector="d",
        image_shape=SHAPE,
        crpix=np.array([999.5, 499.5]),
        cd=CD,
        crval=np.array([10.0, 20.0]),
        pv=PVPolynomial(pv1_7=1e-3),
    )


@pytest.fixture
def with_table(solution):
    x, y = np.linspace(-0.5, 1999.5, 6), np.linspace(-0.5, 999.5, 5)
    sigma = np.stack([np.full((5, 6), 0.01), np.full((5, 6), 0.02), np.full((5, 6), 0.5)])
    return replace(
        solution,
        lookup_table=LookupTable(x, y, np.zeros((5, 6)), np.zeros((5, 6))),
        table_sigma=sigma,
    )


def frame(solution, **kwargs):
    return Calibration("f", solution, crval=np.array([11.0, 21.0]), cd=CD, **kwargs)


def test_wcs_of_both(with_table):
    assert_allclose(with_table.wcs(999.5, 499.5), (10.0, 20.0))
    assert_allclose(frame(with_table).wcs(999.5, 499.5), (11.0, 21.0))
    assert with_table.wcs is with_table.wcs


def test_undistorted_pixels_are_those_of_the_linear_wcs(with_table):
    x, y = np.array([3.0, 500.0, 1000.0]), np.array([990.0, 7.0, 500.0])
    linear = WCS(naxis=2)
    linear.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    linear.wcs.crpix = np.asarray(with_table.crpix) + 1
    linear.wcs.cd, linear.wcs.crval = with_table.cd, with_table.crval
    expected = linear.all_world2pix(*with_table.wcs(x, y), 0)
    assert_allclose(with_table.undistort(x, y), expected, rtol=0, atol=1e-6)


def test_attitude_and_table_add_up(with_table):
    covariance = np.diag([0.03, 1e-5, 0.0, 0.04, 0.0, 2e-5]) ** 2
    calibration = frame(with_table, attitude_covariance=covariance)
    sigma_x, sigma_y, rho = calibration.uncertainty([999.5, 1499.5], [499.5, 499.5])
    assert_allclose(sigma_x[0], np.hypot(0.01, 0.03))
    assert_allclose(sigma_y[0], np.hypot(0.02, 0.04))
    assert_allclose(rho[0], 0.5 * 0.01 * 0.02 / (sigma_x[0] * sigma_y[0]))
    # 500 px away, where the PV polynomial hardly matters.
    assert_allclose(sigma_x[1], np.sqrt(0.01**2 + 0.03**2 + (500e-5) ** 2), rtol=1e-3)
    assert_allclose(sigma_y[1], sigma_y[0], rtol=1e-3)


def test_correlated_attitude(with_table):
    covariance = np.zeros((6, 6))
    covariance[np.ix_([0, 3], [0, 3])] = 1e-2 * np.array([[1, -0.9], [-0.9, 1]])
    table = replace(with_table, table_sigma=np.zeros((3, 5, 6)))
    rho = frame(table, attitude_covariance=covariance).uncertainty(100.0, 200.0)[2]
    assert_allclose(rho, -0.9)
    nothing = frame(table, attitude_covariance=np.zeros((6, 6))).uncertainty(100.0, 200.0)
    assert_allclose(nothing, [0, 0, 0])


def test_table_uncertainty_is_interpolated(with_table):
    sigma = with_table.table_sigma.copy()
    sigma[0, :, 0] = 0.05
    table = replace(with_table, table_sigma=sigma)
    assert_allclose(np.sqrt(table.covariance(199.5, 300.0)[0, 0]), 0.03)


def test_polynomial_uncertainty_without_table(solution):
    """Against brute force: random coefficients, attitudes fitted over the detector."""
    rng = np.random.default_rng(2)
    sigma = np.array([1e-6, 1e-5, 1e-5, *[3e-4] * 3, *[1e-2] * 4]) * 0.03
    stored = replace(solution, pv_covariance=np.array([np.diag(sigma**2)] * 2))
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(0, 1999, 15), np.linspace(0, 999, 15)))
    plane = np.stack([np.ones_like(x), x, y], axis=1)
    xi, eta = CD @ (np.array([x, y]) - [[999.5], [499.5]])
    found = []
    for _ in range(400):
        coefficients = solution.pv.coefficients + rng.normal(size=(2, 10)) * sigma
        moved = PVPolynomial.from_coefficients(coefficients)
        error = np.linalg.solve(CD, np.array(moved(xi, eta)) - solution.pv(xi, eta))
        found.append(error - (plane @ np.linalg.lstsq(plane, error.T, rcond=None)[0]).T)
    found = np.array(found)
    calibration = frame(stored, attitude_covariance=np.zeros((6, 6)))
    sigma_x, sigma_y, rho = calibration.uncertainty(x, y)
    # 400 trials: 3.5 %.
    assert_allclose(np.std(found, axis=0) / [sigma_x, sigma_y], 1.0, atol=0.15)
    direct = np.mean(found[:, 0] * found[:, 1], axis=0) / (found.std(0)[0] * found.std(0)[1])
    assert_allclose(rho, direct, atol=0.2)


def test_own_polynomial(with_table):
    covariance = np.zeros((2, 10, 10))
    covariance[:, 0, 0] = (1e-4 * 0.05) ** 2
    plain = replace(with_table, cd=1e-4 * np.eye(2))
    calibration = frame(plain, pv_covariance=covariance)
    sigma_x, sigma_y, _ = calibration.uncertainty(700.0, 100.0)
    assert_allclose([sigma_x, sigma_y], [np.hypot(0.05, 0.01), np.hypot(0.05, 0.02)])


def test_shapes_and_edges(with_table):
    calibration = frame(with_table, attitude_covariance=1e-6 * np.eye(6))
    for shape in ((), (3,), (2, 3), (0,)):
        for value in calibration.uncertainty(np.full(shape, 5.0), np.full(shape, 6.0)):
            assert value.shape == shape
    x = np.array([-0.6, -0.5, 1999.5, 1999.6, np.nan])
    assert np.isnan(calibration.uncertainty(x, 10.0)[0]).tolist() == [
        True,
        False,
        False,
        True,
        True,
    ]


def test_unknown_is_nan(solution, with_table):
    assert np.isnan(frame(with_table).uncertainty(5.0, 5.0)[0])
    known = {"attitude_covariance": np.eye(6)}
    assert np.isnan(frame(solution, **known).uncertainty(5.0, 5.0)[0])
    assert np.isnan(frame(replace(with_table, table_sigma=None), **known).uncertainty(5.0, 5.0)[0])
