import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
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


def test_positions_without_the_checks_of_the_wcs(with_table):
    calibration = frame(with_table)
    x, y = np.array([[0.0, 500.0, -0.5], [999.25, 1.0, 1999.5]]), np.array([10.0, 999.5, 20.0])
    sky = calibration.pixel_to_sky(x, y)
    np.testing.assert_array_equal(sky, calibration.wcs(x, y))
    np.testing.assert_array_equal(calibration.sky_to_pixel(*sky), calibration.wcs.invert(*sky))
    # Scalars of any kind, floats in return, NaN off the detector.
    for pixel in ((10.0, 20.0), (10, 20), (np.float32(10), np.array(20.0)), (10 * u.pix, 20.0)):
        found = calibration.pixel_to_sky(*pixel)
        assert [type(value) for value in found] == [float, float]
        assert found == calibration.wcs(10.0, 20.0)
    back = calibration.sky_to_pixel(*found)
    assert [type(value) for value in back] == [float, float]
    assert_allclose(back, (10.0, 20.0), rtol=0, atol=1e-8)
    ra, dec = found * u.deg
    assert calibration.sky_to_pixel(ra.to(u.arcsec), dec.to(u.rad)) == pytest.approx(back)
    assert np.isnan(
        [*calibration.pixel_to_sky(-1.0, 5.0), *calibration.sky_to_pixel(0.0, 0.0)]
    ).all()
    assert np.isnan(calibration.pixel_to_sky(np.nan, 5.0)).all()
    masked = calibration.pixel_to_sky(np.ma.array([1.0, 2.0], mask=[True, False]), 3.0)
    assert masked[0].mask.tolist() == masked[1].mask.tolist() == [True, False]


def test_positions_are_those_of_the_calibration_whatever_becomes_of_its_wcs(with_table):
    calibration = frame(with_table)
    calibration.wcs.pipeline[1].transform.crval = (1.0, 2.0)
    assert_allclose(calibration.pixel_to_sky(999.5, 499.5), (11.0, 21.0))
    for other in (pickle.loads(pickle.dumps(calibration)), copy.deepcopy(calibration)):
        assert_allclose(other.pixel_to_sky(999.5, 499.5), (11.0, 21.0))
        assert_allclose(other.sky_to_pixel(11.0, 21.0), (999.5, 499.5))


def test_undistorted_pixels_are_those_of_the_linear_wcs(with_table):
    x, y = np.array([3.0, 500.0, 1000.0]), np.array([990.0, 7.0, 500.0])
    linear = WCS(naxis=2)
    linear.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    linear.wcs.crpix = np.asarray(with_table.crpix) + 1
    linear.wcs.cd, linear.wcs.crval = with_table.cd, with_table.crval
    expected = linear.all_world2pix(*with_table.wcs(x, y), 0)
    assert_allclose(with_table.undistort(x, y), expected, rtol=0, atol=1e-6)


def grid(*values, n=3):
    """The same sigma_x, sigma_y and correlation everywhere."""
    return np.stack([np.full((n, n), float(v)) for v in values])


def test_uncertainty_is_that_of_the_frame(with_table):
    """Its grid holds everything; that of the instrument is not added again."""
    calibration = frame(with_table, sigma=grid(0.03, 0.04, -0.9))
    sigma_x, sigma_y, rho = calibration.uncertainty([999.5, 1499.5], [499.5, 499.5])
    assert_allclose(sigma_x, 0.03)
    assert_allclose(sigma_y, 0.04)
    assert_allclose(rho, -0.9)


def test_uncertainty_is_interpolated(solution):
    """Linear between the nodes, from one outer edge of the detector to the other."""
    sigma = grid(0.01, 0.02, 0.0)
    sigma[0, :, 2] = 0.05  # right edge
    sigma[1, 0, :] = 0.06  # lower edge
    sigma_x, sigma_y, rho = frame(solution, sigma=sigma).uncertainty(
        [1999.5, 999.5, 1499.5, 0.0], [300.0, 499.5, 499.5, 249.5]
    )
    assert_allclose(sigma_x, [0.05, 0.01, 0.03, 0.01])
    assert_allclose(sigma_y[1:], [0.02, 0.02, 0.04])
    assert_allclose(rho, 0)


def test_nothing_is_uncertain(solution):
    nothing = frame(solution, sigma=grid(0, 0, 0)).uncertainty(100.0, 200.0)
    assert_allclose(nothing, [0, 0, 0])


def test_table_uncertainty_is_interpolated(with_table):
    sigma = with_table.table_sigma.copy()
    sigma[0, :, 0] = 0.05
    table = replace(with_table, table_sigma=sigma)
    assert_allclose(np.sqrt(table.covariance(199.5, 300.0)[0, 0]), 0.03)


def test_shapes_and_edges(with_table):
    calibration = frame(with_table, sigma=grid(0.01, 0.02, 0.1))
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
    """A frame without a grid of its own, as of files of format version 1.0.0."""
    assert np.isnan(frame(with_table).uncertainty(5.0, 5.0)[0])
    assert np.isnan(solution.covariance(5.0, 5.0)).all()


class TestField:
    """Table of the instrument and field of the exposure together."""

    @pytest.fixture
    def both(self, solution):
        x, y = np.linspace(-0.5, 1999.5, 21), np.linspace(-0.5, 999.5, 13)
        u, v = np.meshgrid(x / 2000, y / 1000)
        table = LookupTable(x, y, np.sin(6 * u * v), np.cos(5 * u))
        x, y = np.linspace(-0.5, 1999.5, 9), np.linspace(-0.5, 999.5, 8)
        u, v = np.meshgrid(x / 2000, y / 1000)
        # Cubic: splines on the nodes of the table take it exactly.
        field = LookupTable(x, y, 0.2 * u**3 - 0.1 * v, 0.3 * u * v**2)
        return table, field, replace(solution, lookup_table=table)

    def test_are_subtracted_one_after_the_other(self, both, rng):
        table, field, solution = both
        calibration = frame(solution, field=field)
        x, y = rng.uniform(0, 1999, 50), rng.uniform(0, 999, 50)
        expected = np.subtract(solution.undistort(x, y), field(x, y))
        assert_allclose(calibration.undistort(x, y), expected, rtol=0, atol=1e-9)
        assert_allclose(calibration.lookup_table(x, y), np.add(table(x, y), field(x, y)), atol=1e-9)
        # The instrument itself is as before.
        assert_allclose(calibration.solution.lookup_table(x, y), table(x, y))

    def test_one_of_them_alone(self, both, solution):
        table, field, instrument = both
        assert frame(solution).lookup_table is None
        for calibration, one, given in (
            (c := frame(solution, field=field), c.field, field),
            (c := frame(instrument), c.solution.lookup_table, table),
        ):
            assert calibration.lookup_table is one
            np.testing.assert_array_equal(one.displacement.value, given.displacement.value)

    def test_round_trip(self, both):
        calibration = frame(both[2], field=both[1])
        x, y = np.array([3.0, 1000.0, 1990.0]), np.array([990.0, 500.0, 7.0])
        assert_allclose(calibration.wcs.invert(*calibration.wcs(x, y)), [x, y], atol=1e-6)


class TestColor:
    SHIFT = np.array([[0.1, 2e-5, -1e-5], [-0.2, 1e-5, 3e-5]])

    def test_moves_the_undistorted_place(self, with_table):
        """A star redder by 0.5 mag at the same pixel comes from that much further on the plane."""
        calibration = frame(with_table, color_shift=self.SHIFT, reference_color=0.8)
        other = calibration.at_color(1.3)
        x, y = np.meshgrid([0.0, 700.0, 1999.0], [0.0, 999.0])
        place = np.array(calibration.undistort(x, y)) - np.array([999.5, 499.5])[:, None, None]
        rows = np.stack([np.ones_like(x), *place])
        moved = place + 0.5 * np.tensordot(self.SHIFT, rows, axes=1)
        linear = WCS(naxis=2)
        linear.wcs.ctype = ["RA---TAN", "DEC--TAN"]
        linear.wcs.crpix, linear.wcs.cd, linear.wcs.crval = [1, 1], CD, [11.0, 21.0]
        expected = linear.all_pix2world(*moved, 0)
        # 0.1 px of another tangent point: third order.
        assert_allclose(other.wcs(x, y), expected, rtol=0, atol=1e-4 * 1e-3)
        assert other.reference_color == 1.3
        assert_allclose(calibration.crval, (11.0, 21.0))

    def test_there_and_back(self, with_table):
        calibration = frame(with_table, color_shift=self.SHIFT, reference_color=0.8)
        assert calibration.at_color(0.8).wcs(5.0, 6.0) == calibration.wcs(5.0, 6.0)
        back = calibration.at_color(2.8).at_color(0.8)
        # The second step starts from the matrix of the first: 2 mag of 3e-5 squared, 1000 px.
        assert_allclose(back.wcs(5.0, 6.0), calibration.wcs(5.0, 6.0), rtol=0, atol=1e-4 * 1e-2)

    def test_no_color_no_shift(self, with_table):
        calibration = frame(with_table)
        assert calibration.at_color(3.0) is calibration

    @pytest.mark.parametrize("color", [np.nan, np.inf])
    def test_must_be_a_number(self, with_table, color):
        with pytest.raises(ValueError, match="color must be a finite number, got"):
            frame(with_table).at_color(color)
