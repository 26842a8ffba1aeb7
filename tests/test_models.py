"""Models against astropy.wcs, scipy and closed forms, and what Fittable2DModelTester checks."""

import copy
import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from astropy import units as u
from astropy.modeling.models import Identity, Mapping, Polynomial2D, Scale, Shift
from astropy.wcs import WCS
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.interpolate import RectBivariateSpline, RegularGridInterpolator

from wpdc_gwcs.models import (
    DetectorToSky,
    DistortionCorrection,
    DistortionInverse,
    LookupTable,
    PVInverse,
    PVPolynomial,
    SkyTangent,
    SkyToDetector,
    TangentSky,
    deproject,
    project,
    pv_terms,
)
from wpdc_gwcs.models.blocks import BLOCK_SIZE, evaluate_blocks

CD = np.array([[-2.05e-5, 1e-6], [1.2e-6, 2.06e-5]])
CRPIX = (511.5, 520.0)


def random_pv(rng, degree=3, radial=False, size=0.05):
    """A polynomial near the identity over the unit square of degrees."""
    coefficients = rng.normal(size=(2, len(pv_terms(degree, radial).index))) * size
    coefficients[:, 1] += 1.0
    return PVPolynomial.from_coefficients(coefficients, degree, radial)


def random_table(rng, method="cubic", nx=12, ny=9, size=0.3, n=1024):
    return LookupTable(
        np.linspace(-0.5, n - 0.5, nx),
        np.linspace(-0.5, n - 0.5, ny),
        *rng.normal(size=(2, ny, nx)) * size,
        method=method,
    )


@pytest.fixture
def models(rng):
    """One of each model, with points inside its domain."""
    pv = PVPolynomial(pv1_0=1e-4, pv1_4=0.3, pv2_5=-0.2, pv1_7=0.8, pv2_7=0.9, pv2_10=-0.5)
    table = random_table(rng)
    distortion = DistortionCorrection(CRPIX, CD, pv, table)
    sky = TangentSky(CRPIX, CD, (359.999, 89.9))
    pixels = rng.uniform(0, 1000, (2, 24))
    plane = rng.uniform(-0.1, 0.1, (2, 24))
    position = sky(*pixels)
    fused = DetectorToSky(distortion, sky)
    return [
        (pv, plane),
        (pv.inverse, plane),
        (table, pixels),
        (distortion, pixels),
        (distortion.inverse, pixels),
        (sky, pixels),
        (sky.inverse, position),
        (fused, pixels),
        (fused.inverse, position),
    ]


# --- PV polynomial


def tpv_header(pv):
    """The same polynomial as a wcslib TPV header with one degree per pixel."""
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TPV", "DEC--TPV"]
    wcs.wcs.crval = [30.0, -20.0]
    wcs.wcs.crpix = [1.0, 1.0]
    wcs.wcs.cd = np.eye(2)
    wcs.wcs.set_pv(
        [
            (axis + 1, int(j), float(pv.coefficients[axis, k]))
            for axis in (0, 1)
            for k, j in enumerate(pv.term_indices)
        ]
    )
    wcs.wcs.set()
    return wcs


@pytest.mark.parametrize("radial", [False, True])
@pytest.mark.parametrize("degree", range(1, 8))
def test_pv_polynomial_is_that_of_wcslib(degree, radial, rng):
    pv = random_pv(rng, degree, radial)
    xi, eta = rng.uniform(-1, 1, (2, 200))
    expected = tpv_header(pv).wcs_pix2world(xi, eta, 0)
    assert_allclose(deproject(*pv(xi, eta), (30.0, -20.0)), expected, rtol=0, atol=1e-11)


def test_pv_terms_of_the_default_degree():
    terms = pv_terms(3)
    assert terms.index.tolist() == [0, 1, 2, 4, 5, 6, 7, 8, 9, 10]
    assert PVPolynomial().param_names == tuple(f"pv{i}_{j}" for i in (1, 2) for j in terms.index)
    assert pv_terms(7, radial=True).index.tolist() == list(range(40))
    assert not terms.own.flags.writeable


@pytest.mark.parametrize("degree", [0, 8, 2.5, -1])
def test_pv_degree_out_of_range(degree):
    with pytest.raises(ValueError, match="degree must be an integer from 1 to 7"):
        PVPolynomial(degree)


def test_pv_unknown_or_unusable_parameter():
    with pytest.raises(TypeError, match="degree 3 without radial terms has no parameter 'pv1_3'"):
        PVPolynomial(pv1_3=1.0)
    with pytest.raises(TypeError, match="pv1_1 must be a plain number"):
        PVPolynomial(pv1_1=1 * u.deg)
    with pytest.raises(TypeError, match="pv2_0 must be a plain number"):
        PVPolynomial(pv2_0=[1.0, 2.0])
    with pytest.raises(ValueError, match=r"shape \(2, 10\), not \(2, 3\)"):
        PVPolynomial.from_coefficients(np.zeros((2, 3)))


def test_pv_defaults_are_the_identity(rng):
    points = rng.normal(size=(2, 5))
    for degree in (1, 3, 7):
        assert_allclose(PVPolynomial(degree)(*points), points, rtol=0, atol=0)


def test_pv_models_of_different_degree_do_not_disturb_each_other():
    high = PVPolynomial(7, pv1_31=1.0)
    low = PVPolynomial(1)
    assert not hasattr(low, "pv1_31")
    assert high.pv1_31 == 1.0
    assert PVPolynomial(pv1_7=2.0).pv1_7 == 2.0
    assert PVPolynomial().pv1_7 == 0.0


def test_pv_parameters_can_be_set():
    pv = PVPolynomial(2)
    pv.pv1_4 = 0.5
    assert_allclose(pv(2.0, 0.0), (4.0, 0.0))
    pv.parameters = np.arange(12.0)
    assert_allclose(pv.coefficients, np.arange(12.0).reshape(2, 6))
    assert pv.pv2_6 == 11.0
    pv = PVPolynomial(fixed={"pv1_0": True}, name="chip 7")
    assert pv.fixed["pv1_0"]
    assert pv.name == "chip 7"


@pytest.mark.parametrize("radial", [False, True])
@pytest.mark.parametrize("degree", [1, 3, 7])
def test_pv_design_matrix_and_jacobian(degree, radial, rng):
    pv = random_pv(rng, degree, radial)
    xi, eta = rng.uniform(-1, 1, (2, 50))
    matrices = pv.design_matrix(xi, eta)
    assert_allclose(
        [m @ c for m, c in zip(matrices, pv.coefficients, strict=True)], pv(xi, eta), atol=1e-14
    )
    # Central differences: error of the step squared, and of rounding over the step.
    step = 1e-5
    jacobian = pv.jacobian(xi, eta)
    by_xi = (np.array(pv(xi + step, eta)) - pv(xi - step, eta)) / (2 * step)
    by_eta = (np.array(pv(xi, eta + step)) - pv(xi, eta - step)) / (2 * step)
    assert_allclose(jacobian[:, 0], by_xi, atol=1e-7)
    assert_allclose(jacobian[:, 1], by_eta, atol=1e-7)
    assert pv.jacobian(0.1, 0.2).shape == (2, 2)
    assert np.all(np.isfinite(pv.jacobian(0.0, 0.0)))


@pytest.mark.parametrize("radial", [False, True])
@pytest.mark.parametrize("degree", range(1, 8))
def test_pv_inverse_is_exact(degree, radial, rng):
    pv = random_pv(rng, degree, radial, size=0.02)
    points = rng.uniform(-0.5, 0.5, (2, 500))
    assert_allclose(pv.inverse(*pv(*points)), points, rtol=0, atol=1e-13)


def test_pv_inverse_is_nan_where_there_is_none():
    # xi' = xi + xi^2 is never less than -1/4, and left of xi = -1/2 the plane is folded over.
    inverse = PVPolynomial(2, pv1_4=1.0).inverse
    assert_allclose(inverse(0.75, 0.0), (0.5, 0.0))
    assert np.all(np.isnan(inverse(-1.0, 0.0)))
    assert np.all(np.isnan(inverse(np.nan, 0.0)))
    assert np.all(np.isnan(inverse(np.inf, 0.0)))


def test_pv_inverse_of_a_mirror_and_a_swap(rng):
    """Headers may turn and mirror the plane in the polynomial."""
    points = rng.uniform(-0.5, 0.5, (2, 50))
    for linear in ({"pv1_1": -1.0}, {"pv1_1": 0.0, "pv2_1": 0.0, "pv1_2": 1.0, "pv2_2": 1.0}):
        pv = PVPolynomial(pv1_4=0.05, pv2_7=0.02, **linear)
        assert_allclose(pv.inverse(*pv(*points)), points, rtol=0, atol=1e-13)


# --- look-up table


@pytest.mark.parametrize(("nx", "ny"), [(50, 50), (4, 4), (5, 31)])
def test_cubic_table_is_the_bicubic_spline(nx, ny, rng):
    table = random_table(rng, nx=nx, ny=ny)
    x, y = rng.uniform(-0.5, 1023.5, (2, 400))
    for values, found in zip((table.dx, table.dy), table(x, y), strict=True):
        spline = RectBivariateSpline(table.y_grid, table.x_grid, values)
        assert_allclose(found, spline.ev(y, x), rtol=0, atol=1e-12)


@pytest.mark.parametrize(("nx", "ny"), [(50, 50), (2, 2), (3, 8)])
def test_linear_table_is_bilinear(nx, ny, rng):
    table = random_table(rng, "linear", nx=nx, ny=ny)
    x, y = rng.uniform(-0.5, 1023.5, (2, 400))
    for values, found in zip((table.dx, table.dy), table(x, y), strict=True):
        expected = RegularGridInterpolator((table.y_grid, table.x_grid), values)((y, x))
        assert_allclose(found, expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize("method", ["cubic", "linear"])
def test_table_at_its_nodes_rim_and_outside(method, rng):
    table = random_table(rng, method)
    x, y = np.meshgrid(table.x_grid, table.y_grid)
    assert_allclose(table(x, y), (table.dx, table.dy), rtol=0, atol=1e-13)
    for nowhere in ((np.nan, 5.0), (5.0, np.inf)):
        assert np.all(~np.isfinite(table(*nowhere)))


@pytest.mark.parametrize("method", ["cubic", "linear"])
def test_table_goes_on_in_straight_lines(method, rng):
    """Outside, along each axis, with the value and the slope of the edge, and without a step."""
    table = random_table(rng, method)
    edge, away = rng.uniform(0, 1023, 50), rng.uniform(0, 5000, 50)
    for x0, sign in ((-0.5, -1), (1023.5, 1)):
        for axis in (0, 1):
            rim = (np.full(50, x0), edge) if axis == 0 else (edge, np.full(50, x0))
            out = (rim[0] + sign * away, edge) if axis == 0 else (edge, rim[1] + sign * away)
            inside = [np.where(p == x0, x0 - sign * 1e-6, p) for p in rim]
            slope = (np.array(table(*rim)) - table(*inside)) / (sign * 1e-6)
            expected = table(*rim) + slope * sign * away
            assert_allclose(table(*out), expected, rtol=1e-4, atol=1e-3)
            assert_allclose(table.jacobian(*out)[:, axis], slope, atol=1e-6)
    # Across the corners: values and slopes go on, too.
    for x, y in ((-0.5, -300.0), (1023.5, 1400.0), (-2000.0, 1023.5), (1500.0, -0.5)):
        near = [table.jacobian(x + d, y + d) for d in (-1e-7, 1e-7)]
        assert_allclose(*near, atol=1e-6)
        assert_allclose(table(x - 1e-7, y - 1e-7), table(x + 1e-7, y + 1e-7), atol=1e-5)


@pytest.mark.parametrize("method", ["cubic", "linear"])
def test_table_jacobian(method, rng):
    table = random_table(rng, method)
    x, y = rng.uniform(0, 1023, (2, 200))
    step = 1e-4
    jacobian = table.jacobian(x, y)
    by_x = (np.array(table(x + step, y)) - table(x - step, y)) / (2 * step)
    by_y = (np.array(table(x, y + step)) - table(x, y - step)) / (2 * step)
    assert_allclose(jacobian[:, 0], by_x, atol=1e-8)
    assert_allclose(jacobian[:, 1], by_y, atol=1e-8)


def test_table_follows_its_nodes(rng):
    table = random_table(rng)
    before = table(100.0, 100.0)
    table.displacement = 2 * table.displacement.value
    assert_allclose(table(100.0, 100.0), 2 * np.array(before))


def test_table_keeps_its_own_copy(rng):
    grid, values = np.linspace(0, 10, 5), rng.normal(size=(5, 5))
    table = LookupTable(grid, grid, values, values)
    before = table(3.0, 4.0)
    values[:] = 0
    grid[:] = 0
    assert table(3.0, 4.0) == before


def test_table_bad_input():
    grid, values = np.linspace(0, 10, 5), np.zeros((5, 5))
    uneven = np.array([0.0, 1, 2, 4, 8])
    cases = [
        ((uneven, grid, values, values), "x_grid must be increasing and equally spaced"),
        ((grid, grid[::-1], values, values), "y_grid must be increasing and equally spaced"),
        ((grid, [0, np.nan, 2, 3, 4], values, values), "y_grid must be finite"),
        ((grid[:3], grid, values[:, :3], values[:, :3]), "x_grid .* at least 4 nodes"),
        ((grid, grid, values[:4], values), r"dx must have the shape .*\(5, 5\) .* not \(4, 5\)"),
        ((grid, grid, values, np.where(values == 0, np.nan, 0)), "dy must be finite .* 25 nodes"),
    ]
    for arguments, message in cases:
        with pytest.raises(ValueError, match=message):
            LookupTable(*arguments)
    with pytest.raises(ValueError, match="method must be one of"):
        LookupTable(grid, grid, values, values, method="nearest")


# --- tangent plane


@pytest.mark.parametrize("crval", [(0.0, 0.0), (120.0, 30.0), (359.999, -89.99), (10.0, -90.0)])
def test_tangent_plane_is_that_of_wcslib(crval, rng):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crval, wcs.wcs.crpix, wcs.wcs.cd = crval, [1.0, 1.0], np.eye(2)
    xi, eta = rng.uniform(-3, 3, (2, 300))
    ra, dec = deproject(xi, eta, crval)
    assert np.all((ra >= 0) & (ra < 360))
    expected = wcs.wcs_pix2world(xi, eta, 0)
    offset = (ra - expected[0] + 180) % 360 - 180
    assert_allclose(offset * np.cos(np.radians(dec)), 0, atol=1e-12)
    assert_allclose(dec, expected[1], rtol=0, atol=1e-12)
    assert_allclose(project(ra, dec, crval), (xi, eta), rtol=0, atol=2e-13)


def test_north_pole_has_the_orientation_of_its_neighborhood():
    # FITS turns a header by half a circle at exactly +90 deg (default LONPOLE); the models do not.
    at_pole, beside = deproject(0.3, 0.4, (20.0, 90.0)), deproject(0.3, 0.4, (20.0, 90.0 - 1e-9))
    assert_allclose(at_pole, beside, rtol=0, atol=1e-6)


def test_far_hemisphere_has_no_projection():
    assert np.all(np.isnan(project([180.0, 90.0, 0.0], [0.0, 0.0, -90.0], (0.0, 0.0))))
    assert np.all(np.isfinite(project(89.0, 0.0, (0.0, 0.0))))


def test_tangent_sky_bad_input():
    with pytest.raises(ValueError, match="cd must be invertible"):
        TangentSky((0, 0), [[1, 2], [2, 4]], (0, 0))
    with pytest.raises(ValueError, match=r"cd must have the shape \(2, 2\)"):
        TangentSky((0, 0), [1, 2], (0, 0))
    with pytest.raises(ValueError, match="crval must be finite"):
        TangentSky((0, 0), CD, (0, np.nan))
    with pytest.raises(ValueError, match="between -90 and 90"):
        TangentSky((0, 0), CD, (0, 91))


def test_tangent_sky_of_pixels():
    sky = TangentSky((10, 20), CD, (120.0, 30.0))
    plane = CD @ [5.0, -7.0]
    assert_allclose(sky(15.0, 13.0), deproject(*plane, (120.0, 30.0)), rtol=1e-15)
    assert isinstance(sky.inverse, SkyTangent)
    assert isinstance(sky.inverse.inverse, TangentSky)
    assert_allclose(sky.inverse(*sky(15.0, 13.0)), (15.0, 13.0), atol=1e-8)


# --- distortion, composed


@pytest.mark.parametrize("method", ["cubic", "linear", None])
@pytest.mark.parametrize(
    ("degree", "radial"), [(1, False), (3, False), (3, True), (5, False), (7, True)]
)
def test_distortion_is_the_model_arithmetic(degree, radial, method, rng):
    pv = random_pv(rng, degree, radial)
    table = None if method is None else random_table(rng, method)
    distortion = DistortionCorrection(CRPIX, CD, pv, table)
    x, y = rng.uniform(0, 1023, (2, 300))
    expected = np.einsum(
        "ij,jn->in",
        np.linalg.inv(CD),
        pv(*np.einsum("ij,jn->in", CD, np.array([x - CRPIX[0], y - CRPIX[1]]))),
    ) + np.reshape(CRPIX, (2, 1))
    if table is not None:
        expected -= table(x, y)
    assert_allclose(distortion(x, y), expected, rtol=0, atol=1e-10)
    assert_allclose(distortion.composed(x, y), expected, rtol=0, atol=1e-10)
    assert_allclose(distortion.inverse(*distortion(x, y)), (x, y), rtol=0, atol=2e-9)
    step = 1e-3
    jacobian = distortion.jacobian(x, y)
    by_x = (np.array(distortion(x + step, y)) - distortion(x - step, y)) / (2 * step)
    by_y = (np.array(distortion(x, y + step)) - distortion(x, y - step)) / (2 * step)
    assert_allclose(jacobian[:, 0], by_x, atol=1e-7)
    assert_allclose(jacobian[:, 1], by_y, atol=1e-7)


def test_distortion_follows_its_parts(rng):
    distortion = DistortionCorrection(CRPIX, CD, PVPolynomial(), random_table(rng))
    x, y = 100.0, 200.0
    table = np.array(distortion.lookup_table(x, y))
    assert_allclose(distortion(x, y), (x, y) - table, atol=1e-11)
    distortion.pv.pv1_0 = 1e-3
    assert_allclose(distortion(x, y), (x, y) - table + np.linalg.inv(CD) @ [1e-3, 0], atol=1e-10)
    distortion.pv.pv1_0 = 0.0
    distortion.lookup_table.displacement = 0 * distortion.lookup_table.displacement.value
    assert_allclose(distortion(x, y), (x, y), atol=1e-11)
    distortion.crpix = [0.0, 0.0]
    assert_allclose(distortion(x, y), (x, y), atol=1e-11)


def test_distortion_bad_input(rng):
    with pytest.raises(TypeError, match="pv must be a PVPolynomial, not Identity"):
        DistortionCorrection(CRPIX, CD, Identity(2))
    with pytest.raises(TypeError, match="lookup_table must be a LookupTable"):
        DistortionCorrection(CRPIX, CD, PVPolynomial(), PVPolynomial())
    with pytest.raises(ValueError, match="cd must be invertible"):
        DistortionCorrection(CRPIX, np.zeros((2, 2)))
    with pytest.raises(ValueError, match="crpix must be finite"):
        DistortionCorrection((np.inf, 0), CD)
    with pytest.raises(ValueError, match="pv must be finite"):
        DistortionCorrection(CRPIX, CD, PVPolynomial(pv1_4=np.nan))
    with pytest.raises(ValueError, match=r"crpix must have the shape \(2,\)"):
        DistortionCorrection(1.0, CD)


def test_inverse_at_the_rim_and_outside(rng):
    distortion = DistortionCorrection(CRPIX, CD, PVPolynomial(pv1_7=50.0), random_table(rng))
    edge = np.linspace(-0.5, 1023.5, 50)
    rim = np.concatenate(
        [[edge, 0 * edge - 0.5], [edge, 0 * edge + 1023.5], [0 * edge - 0.5, edge]], axis=1
    )
    # A push of the size that rounding of the sky makes must not lose the rim.
    for push in (-2e-9, 0.0, 2e-9):
        found = np.array(distortion.inverse(*(np.array(distortion(*rim)) + push)))
        assert_allclose(found, rim, rtol=0, atol=1e-8)
    center = np.array([[511.5], [511.5]])
    for stretch in (1.001, 1.05, 1.5, 4.0):
        outside = center + (rim - center) * stretch
        assert_allclose(distortion.inverse(*distortion(*outside)), outside, rtol=0, atol=1e-7)
    assert np.all(np.isnan(distortion.inverse([np.inf, np.nan], [0.0, 5.0])))


def test_inverse_of_an_inverse_leaves_the_model_alone(rng):
    distortion = DistortionCorrection(CRPIX, CD, PVPolynomial(), random_table(rng))
    distortion.bounding_box = ((0, 10), (0, 20))
    again = distortion.inverse.inverse
    assert again(5.0, 6.0) == distortion(5.0, 6.0)
    assert distortion.bounding_box.bounding_box() == ((0, 10), (0, 20))


@given(
    corner=st.floats(1.0, 250.0),
    seed=st.integers(0, 10_000),
    degree=st.integers(1, 5),
    table=st.sampled_from([None, "linear", "cubic"]),
)
@settings(deadline=None, max_examples=40)
def test_round_trip_of_any_plausible_distortion(corner, seed, degree, table):
    """Distortion of up to 250 px at the corner of a 9k detector, anywhere on it."""
    rng = np.random.default_rng(seed)
    half = 4608.0
    scale = 0.074 / 3600
    cd = scale * np.array([[-1.0, 0.0], [0.0, 1.0]])
    terms = pv_terms(degree)
    # Each term in px at the corner, the sum of them scaled to the corner displacement.
    amplitude = rng.normal(size=(2, len(terms.index)))
    amplitude[:, 0] = 0.0
    coefficients = amplitude * scale / (half * scale) ** (terms.own + terms.other)
    pv = PVPolynomial.from_coefficients(coefficients, degree)
    corners = np.array([[-1, 1, 1, -1], [-1, -1, 1, 1]]) * half * scale
    largest = np.hypot(*pv(*corners)).max() / scale
    coefficients *= corner / largest
    coefficients[:, 1] += 1.0
    pv = PVPolynomial.from_coefficients(coefficients, degree)
    if table is not None:
        table = random_table(rng, table, nx=50, ny=50, size=0.1, n=9216)
    model = DetectorToSky(
        DistortionCorrection((half, half), cd, pv, table), TangentSky((half, half), cd, (0.0, 45.0))
    )
    points = rng.uniform(-0.5, 9215.5, (2, 300))
    points[0, :50] = -0.5
    points[1, 50:100] = 9215.5
    assert_allclose(model.inverse(*model(*points)), points, rtol=0, atol=1e-7)


# --- what astropy checks of a two-input model


def test_shapes(models):
    for model, (a, b) in models:
        expected = np.array(model(a, b))
        assert np.all(np.isfinite(expected)), model
        assert [np.ndim(value) for value in model(a[0], b[0])] == [0, 0]
        assert_allclose(model(a[0], b[0]), expected[:, 0], rtol=1e-15)
        two_d = model(a.reshape(4, 6), b.reshape(4, 6))
        assert [value.shape for value in two_d] == [(4, 6)] * 2
        assert_allclose(np.reshape(two_d, (2, 24)), expected, rtol=0, atol=0)
        assert [value.shape for value in model(np.zeros(0), np.zeros(0))] == [(0,)] * 2
        assert [value.shape for value in model(np.zeros((0, 3)), np.zeros((0, 3)))] == [(0, 3)] * 2
        # Broadcasting as astropy does it: a scalar with an array.
        assert_allclose(model(a[0], b)[0][0], expected[0, 0], rtol=1e-15)
        # Other types and layouts.
        backwards = model(a[::-1], b[::-1])
        assert_allclose(np.array(backwards)[:, ::-1], expected, rtol=0, atol=0)
        single = model(a.astype(np.float32), b.astype(np.float32))
        assert all(value.dtype == np.float64 for value in single)
        assert model(a.astype(">f8"), b)[0].dtype == np.dtype(float)
        assert_allclose(model(a.tolist(), b.tolist()), expected, rtol=0, atol=0)
        with pytest.raises(ValueError, match="shape"):
            model(a, b[:5])


def test_arguments_are_left_alone(models):
    for model, (a, b) in models:
        before = np.array([a, b])
        model(a, b)
        assert_allclose([a, b], before, rtol=0, atol=0)
        a.flags.writeable = b.flags.writeable = False
        model(a, b)


def test_large_input_is_the_same_as_small(models):
    """Blocks and threads change nothing."""
    for model, points in models:
        n = 5 * BLOCK_SIZE + 7
        index = np.arange(n) % points[0].size
        expected = np.array(model(*points))
        found = model(points[0][index], points[1][index])
        # An inverse may start elsewhere, and ends within its tolerance.
        inverse = isinstance(model, (PVInverse, DistortionInverse, SkyToDetector))
        assert_allclose(found, expected[:, index], rtol=1e-15, atol=1e-9 if inverse else 0)


def test_evaluate_is_the_call(models):
    for model, points in models:
        parameters = [getattr(model, name).value for name in model.param_names]
        assert_allclose(model.evaluate(*points, *parameters), model(*points), rtol=0, atol=0)


def test_models_are_unit_free(models):
    for model, _points in models:
        assert not model.uses_quantity
        assert model.n_inputs == model.n_outputs == 2
        assert len(model.inputs) == len(model.outputs) == 2


def test_pickle_and_copy(models):
    for model, points in models:
        expected = np.array(model(*points))
        for other in (
            pickle.loads(pickle.dumps(model)),
            copy.deepcopy(model),
            model.copy(),
            copy.copy(model),
        ):
            assert type(other) is type(model)
            assert_allclose(other(*points), expected, rtol=0, atol=0)
            assert_allclose(other.parameters, model.parameters, rtol=0, atol=0)
    # The folded coefficients are not carried along.
    distortion = models[3][0]
    assert len(pickle.dumps(distortion)) < 40_000


def test_repr_and_str(models):
    for model, _points in models:
        assert type(model).__name__ in repr(model)
        assert type(model).__name__ in str(model)


def test_bounding_box_of_a_model(models):
    for model, (a, b) in models:
        model = model.copy()
        low, high = np.sort(a)[[5, -5]]
        model.bounding_box = ((b.min(), b.max()), (low, high))
        outside = (a < low) | (a > high)
        found = np.isnan(model(a, b, with_bounding_box=True))
        assert found.tolist() == [outside.tolist()] * 2


def test_composition_with_stock_models(models, rng):
    pv, plane = models[0]
    table, pixels = models[2]
    shift = Shift(1.0) & Shift(2.0)
    assert_allclose((shift | table)(*pixels), table(pixels[0] + 1, pixels[1] + 2), rtol=0, atol=0)
    assert_allclose((Identity(2) - table)(*pixels), pixels - np.array(table(*pixels)))
    assert_allclose((Identity(2) + table)(*pixels), pixels + np.array(table(*pixels)))
    assert_allclose((pv | Scale(2.0) & Scale(3.0))(*plane), np.array(pv(*plane)) * [[2.0], [3.0]])
    both = (pv & table)(*plane, *pixels)
    assert_allclose(both, (*pv(*plane), *table(*pixels)), rtol=0, atol=0)
    poly = Mapping((0, 1, 0, 1)) | Polynomial2D(1, c0_0=1.0) & Polynomial2D(1, c1_0=1.0)
    assert_allclose((pv - poly)(*plane), np.array(pv(*plane)) - poly(*plane))
    # The inverse of a compound is made of those of its parts.
    chain = shift | models[3][0]
    assert_allclose(chain.inverse(*chain(*pixels)), pixels, atol=1e-8)


def test_threads_share_a_model(models):
    for model, points in models:
        fresh = model.copy()
        expected = np.array(model(*points))
        with ThreadPoolExecutor(8) as pool:
            for found in pool.map(lambda _, m=fresh, p=points: m(*p), range(32)):
                assert_allclose(found, expected, rtol=0, atol=0)


def test_dask_map_blocks(models):
    da = pytest.importorskip("dask.array")
    for model, (a, b) in models:
        expected = model(a, b)
        first = da.map_blocks(
            lambda x, y, m=model: m(x, y)[0], da.from_array(a, chunks=7), da.from_array(b, chunks=7)
        )
        assert_allclose(first.compute(), expected[0], rtol=1e-15)


def test_evaluate_blocks_broadcasts():
    def sum_and_product(a, b, total, product):
        total[:], product[:] = a + b, a * b

    found = evaluate_blocks(sum_and_product, np.arange(3.0)[:, np.newaxis], np.arange(4))
    assert_allclose(found[0], np.add.outer(np.arange(3), np.arange(4)))
    assert_allclose(found[1], np.multiply.outer(np.arange(3), np.arange(4)))
