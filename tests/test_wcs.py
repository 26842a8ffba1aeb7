"""The WCS: pipeline, inverse, interface, its stock form, whole images."""

import copy
import pickle
import tracemalloc

import asdf
import gwcs
import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.modeling.models import Scale, Shift
from astropy.utils.masked import Masked
from astropy.wcs import WCS
from astropy.wcs.wcsapi import HighLevelWCSWrapper, SlicedLowLevelWCS
from astropy.wcs.wcsapi.utils import wcs_info_str
from gwcs import coordinate_frames as cf
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from wpdc_gwcs.models import (
    DetectorToSky,
    DistortionCorrection,
    LookupTable,
    PVPolynomial,
    TangentSky,
    project,
    pv_terms,
)
from wpdc_gwcs.wcs import DetectorWCS, build_wcs, sky_map, to_stock_wcs
from wpdc_gwcs.wcs import stock as stock_module

NX, NY = 9216, 9232
SCALE = 0.074 / 3600
CRPIX = (4607.5, 4615.5)


def rotation(angle):
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    return np.array([[c, -s], [s, c]])


def camera_wcs(
    crval=(120.0, 30.0),
    roll=0.0,
    *,
    table="cubic",
    corner=200.0,
    shape=(NY, NX),
    pv_cd=None,
    seed=3,
):
    """A camera with a distortion of `corner` px at its corners and a wavy table."""
    rng = np.random.default_rng(seed)
    ny, nx = shape
    scale = SCALE * NX / nx
    cd0 = scale * np.array([[-1.0, 0.0], [0.0, 1.0]])
    half = scale * nx / 2
    terms = pv_terms(3)
    coefficients = rng.normal(size=(2, len(terms.index)))
    coefficients /= half ** (terms.own + terms.other - 1.0)
    coefficients[:, terms.own + terms.other < 2] = 0.0
    pv = PVPolynomial.from_coefficients(coefficients)
    corners = half * np.array([[-1, 1, 1, -1], [-1, -1, 1, 1]])
    coefficients *= corner * scale / np.hypot(*pv(*corners)).max()
    coefficients[:, 1] += 1.0
    if table is not None:
        x, y = np.linspace(-0.5, nx - 0.5, 50), np.linspace(-0.5, ny - 0.5, 50)
        gx, gy = np.meshgrid(x / nx, y / ny)
        dx = 0.1 * np.sin(25 * gx + 3 * gy) + 2 * (gx - 0.5) ** 4
        dy = 0.1 * np.cos(28 * gy - 9 * gx) - 3 * (gy - 0.5) ** 4
        table = LookupTable(x, y, dx, dy, method=table)
    return build_wcs(
        crpix=((nx - 1) / 2, (ny - 1) / 2),
        cd=cd0 @ rotation(roll) if pv_cd is None else pv_cd @ rotation(roll),
        pv_cd=cd0,
        crval=crval,
        pv=PVPolynomial.from_coefficients(coefficients),
        lookup_table=table,
        image_shape=shape,
    )


def detector_points(rng, n=2000, shape=(NY, NX)):
    """Points all over a detector, rim and corners included."""
    ny, nx = shape
    x, y = rng.uniform(-0.5, nx - 0.5, n), rng.uniform(-0.5, ny - 0.5, n)
    low, right, top = np.full(50, -0.5), np.full(50, nx - 0.5), np.full(50, ny - 0.5)
    ex, ey = np.linspace(-0.5, nx - 0.5, 50), np.linspace(-0.5, ny - 0.5, 50)
    x = np.concatenate([x, ex, ex, low, right])
    y = np.concatenate([y, low, top, ey, ey])
    return x, y


POINTINGS = [
    (0.0, 0.0),
    (120.0, 30.0),
    (359.9999, -45.0),
    (0.0, 89.9),
    (77.0, 90.0),
    (10.0, -90.0),
    (200.0, -89.97),
]


# --- pipeline


def test_pipeline_frames_and_shape():
    wcs = camera_wcs()
    assert isinstance(wcs, gwcs.WCS)
    assert wcs.available_frames == ["detector", "undistorted", "icrs"]
    assert wcs.pixel_shape == (NX, NY)
    assert wcs.array_shape == (NY, NX)
    assert wcs.pixel_bounds == ((-0.5, NX - 0.5), (-0.5, NY - 0.5))
    assert isinstance(wcs.get_transform("detector", "undistorted"), DistortionCorrection)
    assert isinstance(wcs.get_transform("undistorted", "icrs"), TangentSky)
    assert isinstance(wcs.forward_transform, DetectorToSky)


@pytest.mark.parametrize("table", [None, "linear", "cubic"])
def test_forward_is_the_equation(table, rng):
    wcs = camera_wcs(table=table, roll=20.0)
    distortion, sky = (step.transform for step in wcs.pipeline[:-1])
    x, y = rng.uniform(0, 9000, (2, 500))
    # The equation with matrices of numpy and the polynomial and TAN of wcslib.
    cd0, cd, crpix = distortion.cd.value, sky.cd.value, np.reshape(CRPIX, (2, 1))
    shift = 0.0 if table is None else np.array(distortion.lookup_table(x, y))
    undistorted = np.linalg.inv(cd0) @ np.array(distortion.pv(*(cd0 @ ([x, y] - crpix)))) - shift
    tan = WCS(naxis=2)
    tan.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    tan.wcs.crval, tan.wcs.crpix, tan.wcs.cd = [120.0, 30.0], np.add(CRPIX, 1), cd
    expected = tan.wcs_pix2world(*(undistorted + crpix), 0)
    assert_allclose(wcs(x, y), expected, rtol=0, atol=1e-12)
    steps = wcs.get_transform("undistorted", "icrs")(
        *wcs.get_transform("detector", "undistorted")(x, y)
    )
    assert_allclose(wcs(x, y), steps, rtol=0, atol=1e-12)
    assert_allclose(wcs.get_transform("detector", "icrs")(x, y), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("table", ["cubic", "linear"])
@pytest.mark.parametrize("crval", [*POINTINGS, (5.0, 60.0), (5.0, -85.0), (5.0, 88.0)])
def test_one_pass_is_as_good_as_the_steps(crval, table, rng):
    """The projection is taken into the cells only where that keeps to 1e-7 px."""
    wcs = camera_wcs(crval, 40.0, table=table)
    x, y = detector_points(rng, n=50_000)
    ra, dec = wcs(x, y)
    assert ra.min() >= 0
    assert ra.max() < 360
    distortion, sky = (step.transform for step in wcs.pipeline[:-1])
    exact = sky(*distortion(x, y))
    away = np.subtract(project(ra, dec, crval), project(*exact, crval))
    # At a pole nothing is bicubic: the formulae themselves.
    assert np.hypot(*away).max() < (5e-9 if abs(crval[1]) > 89.5 else 1.5e-7) * SCALE


def test_one_pass_follows_the_pointing(rng):
    wcs = camera_wcs((120.0, 30.0))
    x, y = detector_points(rng, n=100)
    wcs(x, y)
    for crval in ((120.001, 30.0), (359.99, -2.0)):
        wcs.pipeline[1].transform.crval = crval
        assert_allclose(wcs(x, y), camera_wcs(crval)(x, y), rtol=0, atol=1e-12)


def test_both_ways_follow_every_change(rng):
    # Whatever way a number is changed in, a second call must not answer as the first one.
    x, y = detector_points(rng, n=100)
    wcs = camera_wcs()
    distortion, sky = (step.transform for step in wcs.pipeline[:-1])

    def set_in_place():
        distortion.lookup_table.displacement.value[0] += 0.5

    changes = [
        lambda: setattr(distortion, "crpix", CRPIX + np.array([3.0, 4.0])),
        lambda: setattr(distortion.pv, "pv1_0", 1e-4),
        lambda: setattr(distortion.pv.pv2_4, "value", 1e-3),
        lambda: setattr(sky, "cd", 1.001 * sky.cd.value),
        lambda: setattr(wcs, "bounding_box", ((-0.5, 400.0), (-0.5, 300.0))),
        set_in_place,
    ]
    position = wcs(x, y)
    found = wcs.invert(*position)
    for change in changes:
        change()
        fresh = wcs.forward_transform
        box = wcs.bounding_box.bounding_box(order="F")
        new_position, new_found = wcs(x, y), wcs.invert(*position)
        assert not np.array_equal(new_position, position, equal_nan=True)
        assert not np.array_equal(new_found, found, equal_nan=True)
        inside = ~np.isnan(new_position[0])
        assert_array_equal(inside, (x <= box[0][1]) & (y <= box[1][1]))
        assert_allclose(
            np.array(new_position)[:, inside],
            np.array(sky(*distortion(x, y)))[:, inside],
            rtol=0,
            atol=1e-10,
        )
        assert_allclose(wcs.invert(*fresh(x, y)), np.where(inside, (x, y), np.nan), atol=1e-6)
        found = new_found
        position = fresh(x, y)


def test_polynomial_alone_is_a_tpv_header(rng):
    wcs = camera_wcs(table=None)
    distortion, sky = (step.transform for step in wcs.pipeline[:-1])
    tpv = WCS(naxis=2)
    tpv.wcs.ctype = ["RA---TPV", "DEC--TPV"]
    tpv.wcs.crval, tpv.wcs.crpix, tpv.wcs.cd = sky.crval.value, np.add(CRPIX, 1), sky.cd.value
    pv = distortion.pv
    tpv.wcs.set_pv(
        [
            (i + 1, int(j), pv.coefficients[i, k])
            for i in (0, 1)
            for k, j in enumerate(pv.term_indices)
        ]
    )
    x, y = detector_points(rng)
    assert_allclose(wcs(x, y), tpv.wcs_pix2world(x, y, 0), rtol=0, atol=1e-12)


# --- inverse


@pytest.mark.parametrize("roll", [0.0, 33.0, 90.0, -147.0])
@pytest.mark.parametrize("crval", POINTINGS)
def test_round_trip_everywhere(crval, roll, rng):
    wcs = camera_wcs(crval, roll)
    x, y = detector_points(rng)
    sky = wcs(x, y)
    assert np.all(np.isfinite(sky))
    for found in (
        wcs.invert(*sky),
        wcs.world_to_pixel_values(*sky),
        wcs.world_to_pixel(wcs.pixel_to_world(x, y)),
        wcs.get_transform("icrs", "detector")(*sky),
        wcs.invert(*sky, with_bounding_box=False),
        wcs.invert(sky[0] - 360.0, sky[1]),
    ):
        # Right ascension resolves 6e-14 deg at 360 deg, 3e-9 px here.
        assert_allclose(found, (x, y), rtol=0, atol=2e-8)


@pytest.mark.parametrize("table", [None, "linear", "cubic"])
def test_round_trip_without_and_with_a_table(table, rng):
    wcs = camera_wcs((5.0, 89.99), 45.0, table=table)
    x, y = detector_points(rng)
    assert_allclose(wcs.invert(*wcs(x, y)), (x, y), rtol=0, atol=2e-8)


@given(
    ra=st.floats(0, 360),
    dec=st.floats(-90, 90),
    roll=st.floats(0, 360),
    corner=st.floats(0.01, 220),
    seed=st.integers(0, 1000),
)
@settings(deadline=None, max_examples=40)
def test_round_trip_of_any_pointing(ra, dec, roll, corner, seed):
    wcs = camera_wcs((ra, dec), roll, corner=corner, seed=seed)
    x, y = detector_points(np.random.default_rng(seed), 200)
    assert_allclose(wcs.invert(*wcs(x, y)), (x, y), rtol=0, atol=1e-7)


def test_attitude_far_from_the_nominal_one(rng):
    """The exposure's matrix may differ from the instrument's by degrees and per cents."""
    stretched = SCALE * np.array([[-1.03, 0.01], [0.02, 0.97]])
    wcs = camera_wcs((30.0, -20.0), 5.0, pv_cd=stretched)
    x, y = detector_points(rng)
    assert_allclose(wcs.invert(*wcs(x, y)), (x, y), rtol=0, atol=2e-8)


def test_outside_is_nan_and_never_a_number(rng):
    wcs = camera_wcs((0.0, 89.9))
    assert np.all(np.isnan(wcs(-0.6, 10.0)))
    assert np.all(np.isnan(wcs(10.0, NY - 0.4)))
    assert wcs(-5.0, 3.0, fill_value=-1.0) == (-1.0, -1.0)
    x, y = detector_points(rng)
    outward = 1.0 + 10.0 / NX
    ra, dec = camera_wcs((0.0, 89.9), table=None)(
        CRPIX[0] + outward * (x[-200:] - CRPIX[0]),
        CRPIX[1] + outward * (y[-200:] - CRPIX[1]),
        with_bounding_box=False,
    )
    assert np.all(np.isfinite(ra))
    assert np.all(np.isnan(wcs.invert(ra, dec)))
    # All over the sky: whatever comes back maps to where it was asked for.
    ra, dec = rng.uniform(0, 360, 5000), np.degrees(np.arcsin(rng.uniform(-1, 1, 5000)))
    ra[:2000], dec[:2000] = rng.uniform(0, 360, 2000), rng.uniform(89.0, 90.0, 2000)
    x, y = wcs.invert(ra, dec)
    found = np.isfinite(x)
    assert 50 < np.count_nonzero(found) < 1000
    assert np.array_equal(found, np.isfinite(y))
    back = project(*wcs(x[found], y[found]), (0.0, 89.9))
    assert_allclose(back, project(ra[found], dec[found], (0.0, 89.9)), rtol=0, atol=1e-12)
    # And none is missing: the undistorted position is on the detector where it was found.
    assert np.all(np.isnan(wcs.invert([np.nan, 0.0, np.inf], [0.0, np.nan, 0.0])))


def test_inverse_masks_both_coordinates_and_fills():
    wcs = camera_wcs(table=None)
    sky = wcs(-20.0, 100.0, with_bounding_box=False)
    assert np.all(np.isnan(wcs.invert(*sky)))
    assert wcs.invert(*sky, fill_value=-9.0) == (-9.0, -9.0)
    assert_allclose(wcs.invert(*sky, with_bounding_box=False), (-20.0, 100.0), atol=1e-8)
    assert wcs.in_image(*wcs(5.0, 5.0))
    assert not wcs.in_image(*sky)


def test_scalar_and_array_calls_agree(rng):
    wcs = camera_wcs()
    x, y = rng.uniform(0, 9000, (2, 20))
    sky = np.array(wcs(x, y))
    pixels = np.array(wcs.invert(*sky))
    for k in range(20):
        assert_allclose(wcs(x[k], y[k]), sky[:, k], rtol=1e-15)
        assert_allclose(wcs.invert(*sky[:, k]), pixels[:, k], rtol=1e-14)
    assert_allclose(wcs(*(v.reshape(4, 5) for v in (x, y))), sky.reshape(2, 4, 5), rtol=1e-15)
    assert [v.shape for v in wcs(np.zeros(0), np.zeros(0))] == [(0,)] * 2
    assert [v.shape for v in wcs.invert(np.zeros(0), np.zeros(0))] == [(0,)] * 2
    assert [np.ndim(v) for v in (*wcs(1, 2), *wcs.invert(*wcs(1, 2)))] == [0] * 4


# --- the shared interface, as gwcs tests its own


def test_low_level_interface():
    wcs = camera_wcs()
    assert (wcs.pixel_n_dim, wcs.world_n_dim) == (2, 2)
    assert tuple(wcs.world_axis_physical_types) == ("pos.eq.ra", "pos.eq.dec")
    assert tuple(wcs.world_axis_units) == ("deg", "deg")
    assert tuple(wcs.pixel_axis_names) == ("x", "y")
    assert wcs.axis_correlation_matrix.tolist() == [[True, True], [True, True]]
    assert wcs.world_axis_object_components[0][:2] == ("celestial", 0)
    assert wcs.world_axis_object_classes["celestial"][0] is SkyCoord
    assert not wcs.serialized_classes
    assert_allclose(wcs.pixel_to_world_values(10, 20), wcs(10, 20), rtol=0)
    assert_allclose(wcs.array_index_to_world_values(20, 10), wcs(10, 20), rtol=0)
    assert wcs.world_to_array_index_values(*wcs(10, 20)) == (20, 10)


def test_high_level_interface():
    wcs = camera_wcs()
    sky = wcs.pixel_to_world([10.0, 20.0], [30.0, 40.0])
    assert isinstance(sky, SkyCoord)
    assert sky.frame.name == "icrs"
    assert_allclose(sky.ra.deg, wcs([10.0, 20.0], [30.0, 40.0])[0])
    assert_allclose(wcs.world_to_pixel(sky), ([10.0, 20.0], [30.0, 40.0]), atol=1e-8)
    # Another frame is transformed first.
    assert_allclose(wcs.world_to_pixel(sky.galactic), ([10.0, 20.0], [30.0, 40.0]), atol=1e-7)
    assert [int(i) for i in wcs.world_to_array_index(sky[0])] == [30, 10]
    with pytest.raises(TypeError):
        wcs.invert(sky)


@pytest.mark.parametrize("box", [True, False])
def test_masked_arrays_keep_their_mask(box):
    wcs = camera_wcs()
    x, y = np.array([10.0, 20.0, -99.0]), np.array([30.0, 40.0, 50.0])
    mask = np.array([False, True, False])
    expected = wcs(x, y, with_bounding_box=box)
    for made in (np.ma.array, Masked):
        both = wcs(made(x, mask=mask), y, with_bounding_box=box)
        back = wcs.invert(made(both[0], mask=mask), both[1], with_bounding_box=box)
        for values, plain in ((both, expected), (back, wcs.invert(*expected))):
            assert all(isinstance(value, type(made(x, mask=mask))) for value in values)
            assert all(value.mask.tolist() == mask.tolist() for value in values)
            if box:
                assert_allclose([np.asarray(v)[[0, 2]] for v in values], np.array(plain)[:, [0, 2]])
    ra, dec = wcs(Masked(x * u.pix, mask=mask), y * u.pix)
    assert ra.mask.tolist() == dec.mask.tolist() == mask.tolist()
    assert_allclose(ra[0].unmasked.to_value(u.deg), expected[0][0])


def test_it_is_described_as_that_of_gwcs():
    """astropy writes the name of the class; a test of gwcs compares it."""
    wcs = camera_wcs()
    words = SlicedLowLevelWCS(wcs, Ellipsis), to_stock_wcs(wcs), wcs
    assert [str(one).splitlines()[0] for one in map(wcs_info_str, words)] == [
        "SlicedLowLevelWCS Transformation",
        "WCS Transformation",
        "WCS Transformation",
    ]


def test_repr_shows_the_parameters():
    shown = repr(camera_wcs(crval=(120.5, 30.25)))
    for text in ("120.5", "30.25", "pv1_7=", "4607.5", "50 x 50 nodes", "cubic"):
        assert text in shown
    assert "50 x 50" not in repr(camera_wcs(table=None))


def test_axes_are_named():
    wcs = camera_wcs()
    assert tuple(wcs.world_axis_names) == ("ra", "dec")
    assert tuple(to_stock_wcs(wcs).world_axis_names) == ("ra", "dec")


def test_the_bounding_box_alone_masks(rng):
    """Outside the nodes the WCS goes on, and so do footprints that ask half a pixel farther out."""
    wcs = camera_wcs(roll=30.0)
    x, y = detector_points(rng, 200)
    x, y = (1.3 * (v - c) + c for v, c in zip((x, y), CRPIX, strict=True))
    sky = wcs(x, y, with_bounding_box=False)
    distortion, tangent = (step.transform for step in wcs.pipeline[:-1])
    assert_allclose(sky, tangent(*distortion(x, y)), rtol=0, atol=1e-12)
    assert_allclose(sky, tangent(*distortion.composed(x, y)), rtol=0, atol=1e-11)
    assert_allclose(wcs.invert(*sky, with_bounding_box=False), (x, y), rtol=0, atol=1e-6)
    off = (x < -0.5) | (x > NX - 0.5) | (y < -0.5) | (y > NY - 0.5)
    assert np.isnan(wcs(x, y)[0]).tolist() == off.tolist()
    assert np.isnan(wcs.invert(*sky)[0]).tolist() == off.tolist()
    # No step at the rim.
    assert_allclose(
        wcs(-0.5 - 1e-6, 100.0, with_bounding_box=False), wcs(-0.5, 100.0), rtol=0, atol=1e-9
    )
    for w in (wcs, to_stock_wcs(wcs)):
        corners = w.footprint(center=True)
        assert np.isfinite(corners).all()
        assert_allclose(corners, w.footprint(), rtol=0, atol=SCALE)


def test_whole_images_may_be_larger_than_the_table():
    wcs = camera_wcs(shape=(301, 517))
    y, x = np.mgrid[:330, :540].astype(float)
    expected = wcs(x, y, with_bounding_box=False)
    assert_allclose(sky_map(wcs, image_shape=(330, 540)), expected, rtol=0, atol=1e-12)


def test_pipelines_of_others_are_those_of_gwcs():
    """The class adds nothing to a pipeline without our models."""
    detector, icrs = (camera_wcs().pipeline[k].frame for k in (0, 2))
    transform = Shift(-5.0) & Shift(3.0) | Scale(1e-3) & Scale(1e-3)
    theirs, ours = (kind([(detector, transform), (icrs, None)]) for kind in (gwcs.WCS, DetectorWCS))
    for wcs in (theirs, ours):
        wcs.bounding_box = ((-0.5, 9.5), (-0.5, 19.5))
    x, y = np.array([1.0, 15.0, 2.0]), np.array([2.0, 3.0, 50.0])
    for a, b in (
        (theirs(x, y), ours(x, y)),
        (theirs.out_of_bounds((x, y)), ours.out_of_bounds((x, y))),
        (theirs.invert(1e-3 * x, 1e-3 * y), ours.invert(1e-3 * x, 1e-3 * y)),
    ):
        assert_allclose(a, b)


@pytest.mark.parametrize("v2v3", [(120.5, -496.0, 0.0), (-300.0, 20.0, 200.0), (0.0, 0.0, -75.0)])
def test_v2v3(v2v3, rng):
    """The frame of telescopes: their own matrix leads from it to the sky (JWST-STScI-001550)."""
    wcs = camera_wcs(crval=(250.0, -61.0), roll=12.0)
    distortion, sky = (step.transform for step in wcs.pipeline[:-1])
    parts = {"crpix": CRPIX, "cd": sky.cd.value, "crval": (250.0, -61.0)}
    parts |= {"pv": distortion.pv, "pv_cd": distortion.cd.value, "image_shape": (NY, NX)}
    with_frame = build_wcs(**parts, lookup_table=distortion.lookup_table, v2v3=v2v3)
    assert with_frame.available_frames == ["detector", "undistorted", "v2v3", "icrs"]
    x, y = detector_points(rng, 200)
    assert_allclose(with_frame(x, y), wcs(x, y), rtol=0, atol=1e-11)
    assert_allclose(with_frame.invert(*wcs(x, y)), (x, y), rtol=0, atol=1e-5)
    v2, v3 = np.radians(np.array(with_frame.get_transform("detector", "v2v3")(x, y)) / 3600)
    assert_allclose(
        np.degrees(with_frame.get_transform("undistorted", "v2v3")(*CRPIX)),
        np.degrees(v2v3[:2]),
        atol=1e-6,
    )

    def turn(axis, angle):
        c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        matrix = np.eye(3)
        i, j = [k for k in range(3) if k != axis]
        matrix[[i, i, j, j], [i, j, i, j]] = c, -s, s, c
        return matrix

    # M = R3(RA) R2(-Dec) R1(-roll) R2(V3) R3(-V2), as a product of turns of axes.
    a, b, c, d = (250.0, -61.0, v2v3[2], v2v3[1] / 3600)
    matrix = turn(2, a) @ turn(1, b) @ turn(0, -c) @ turn(1, -d) @ turn(2, -v2v3[0] / 3600)
    unit = np.array([np.cos(v2) * np.cos(v3), np.sin(v2) * np.cos(v3), np.sin(v3)])
    px, py, pz = matrix @ unit
    found = np.degrees(np.arctan2(py, px)) % 360, np.degrees(np.arcsin(pz))
    assert_allclose(found, wcs(x, y), rtol=0, atol=1e-10)


def test_v2v3_arguments():
    for bad in ((1.0, 2.0), (0.0, 0.0, np.nan), (0.0, 4e5, 0.0)):
        with pytest.raises(ValueError, match="v2v3 must be V2 and V3 in arcsec"):
            build_wcs(crpix=(1, 1), cd=np.eye(2), crval=(0, 0), v2v3=bad)


def test_quantities():
    wcs = camera_wcs()
    for ra, dec in ((120.0 * u.deg, 30 * u.deg), ((120 * u.deg).to(u.rad), 108000 * u.arcsec)):
        assert_allclose([v.to_value(u.pix) for v in wcs.invert(ra, dec)], wcs.invert(120.0, 30.0))
    ra, dec = wcs(10 * u.pix, 20 * u.pix)
    assert ra.unit == dec.unit == u.deg
    assert_allclose((ra.value, dec.value), wcs(10, 20))
    x, y = wcs.invert(ra, dec)
    assert_allclose((x.to_value(u.pix), y.to_value(u.pix)), (10, 20), atol=1e-8)
    outside = wcs.invert(0 * u.deg, 0 * u.deg, fill_value=-1.0)
    assert outside == (-1 * u.pix, -1 * u.pix)


def test_slicing_and_footprint():
    wcs = camera_wcs()
    footprint = wcs.footprint()
    assert footprint.shape == (4, 2)
    corners = ([-0.5, -0.5, NX - 0.5, NX - 0.5], [-0.5, NY - 0.5, NY - 0.5, -0.5])
    assert_allclose(footprint.T, wcs(*corners))
    sliced = SlicedLowLevelWCS(wcs, (slice(100, 200), slice(50, 80)))
    assert sliced.pixel_shape == (30, 100)
    assert_allclose(sliced.pixel_to_world_values(0, 0), wcs(50, 100))
    assert_allclose(HighLevelWCSWrapper(sliced).world_to_pixel(wcs.pixel_to_world(55, 107)), (5, 7))
    wcs.bounding_box = ((99.5, 199.5), (49.5, 79.5))
    assert np.all(np.isnan(wcs(90, 60)))
    assert_allclose(wcs.invert(*wcs(110, 60)), (110, 60), atol=1e-8)
    assert np.all(np.isnan(wcs.invert(*wcs(90, 60, with_bounding_box=False))))
    wcs.bounding_box = None
    assert np.all(np.isfinite(wcs(90, 60)))
    assert_allclose(wcs.invert(*wcs(90, 60)), (90, 60), atol=1e-8)


def test_without_an_image_shape(rng):
    wcs = build_wcs(crpix=CRPIX, cd=SCALE * np.eye(2), crval=(10, 20), pv=PVPolynomial(pv1_4=0.1))
    assert wcs.bounding_box is None
    assert wcs.pixel_shape is None
    points = rng.uniform(-1e4, 2e4, (2, 100))
    assert_allclose(wcs.invert(*wcs(*points)), points, rtol=0, atol=2e-8)


def test_other_steps_can_be_inserted(rng):
    """A user's own frames and transforms: slower, and as right as before."""
    wcs = camera_wcs()
    x, y = detector_points(rng, 100)
    expected = wcs(x, y)
    box = wcs.bounding_box.bounding_box(order="F")
    mosaic = cf.Frame2D(name="mosaic", unit=(u.pix, u.pix))
    wcs.insert_frame(mosaic, Shift(-100.0) & Shift(50.0), wcs.detector)
    wcs.bounding_box = tuple(
        (low + d, high + d) for (low, high), d in zip(box, (100, -50), strict=True)
    )
    assert not isinstance(wcs.forward_transform, DetectorToSky)
    assert_allclose(wcs(x + 100, y - 50), expected, rtol=0, atol=1e-12)
    assert_allclose(wcs.invert(*expected), (x + 100, y - 50), rtol=0, atol=2e-8)


def test_pickle_and_copy_of_a_wcs(rng):
    wcs = camera_wcs()
    points = detector_points(rng, 50)
    expected = wcs(*points)
    for other in (pickle.loads(pickle.dumps(wcs)), copy.deepcopy(wcs)):
        assert isinstance(other, DetectorWCS)
        assert_allclose(other(*points), expected, rtol=0, atol=0)
        assert other.pixel_shape == wcs.pixel_shape
        assert_allclose(other.invert(*expected), points, atol=2e-8)


def test_build_wcs_arguments():
    wcs = build_wcs(crpix=(1, 2), cd=np.eye(2), crval=SkyCoord(10 * u.deg, 20 * u.deg))
    assert_allclose(wcs(1, 2), (10, 20))
    with pytest.raises(ValueError, match="cd must be invertible"):
        build_wcs(crpix=(1, 2), cd=np.zeros((2, 2)), crval=(10, 20))
    with pytest.raises(ValueError, match="image_shape must be positive"):
        build_wcs(crpix=(1, 2), cd=np.eye(2), crval=(10, 20), image_shape=(0, 5))
    with pytest.raises(TypeError, match="lookup_table must be a LookupTable"):
        build_wcs(crpix=(1, 2), cd=np.eye(2), crval=(10, 20), lookup_table=np.zeros((5, 5)))


# --- stock form


def deviation_px(wcs, ra, dec, expected):
    """Distance of two sets of positions in pixels along the axes."""
    sky = wcs.pipeline[1].transform
    offset = np.subtract(project(ra, dec, sky.crval.value), project(*expected, sky.crval.value))
    return np.linalg.inv(sky.cd.value) @ offset


@pytest.mark.parametrize("crval", [(120.0, 30.0), (0.0, -90.0), (0.0, 89.97)])
@pytest.mark.parametrize("table", [None, "linear", "cubic"])
def test_stock_wcs_is_the_same(table, crval, rng):
    wcs = camera_wcs(crval, 25.0, table=table)
    stock = to_stock_wcs(wcs)
    assert type(stock) is gwcs.WCS
    assert stock.available_frames == wcs.available_frames
    assert stock.pixel_shape == wcs.pixel_shape
    assert stock.pixel_bounds == wcs.pixel_bounds
    x, y = detector_points(rng, 500)
    expected = wcs(x, y)
    assert_allclose(deviation_px(wcs, *stock(x, y), expected), 0, atol=1e-7)
    undistorted = wcs.get_transform("detector", "undistorted")(x, y)
    assert_allclose(stock.get_transform("detector", "undistorted")(x, y), undistorted, atol=1e-7)
    assert np.all(np.isnan(stock(-5.0, 3.0)))
    # A bilinear table has kinks that no smooth inverse follows.
    found = stock.invert(*expected, with_bounding_box=False)
    assert_allclose(found, (x, y), rtol=0, atol=5e-3 if table == "linear" else 2e-4)


def test_stock_wcs_with_radial_terms(rng):
    # Amplitudes of some px on a field of 0.1 deg.
    pv = PVPolynomial(7, radial=True, pv1_3=1e-3, pv2_3=-2e-3, pv1_11=0.2, pv2_23=9.0, pv1_32=300.0)
    wcs = build_wcs(
        crpix=CRPIX, cd=SCALE * rotation(30.0), crval=(50, 60), pv=pv, image_shape=(NY, NX)
    )
    stock = to_stock_wcs(wcs)
    x, y = detector_points(rng, 500)
    expected = wcs(x, y)
    assert_allclose(deviation_px(wcs, *stock(x, y), expected), 0, atol=1e-7)


def test_stock_wcs_as_a_file(tmp_path, rng):
    wcs = camera_wcs()
    path = tmp_path / "stock.asdf"
    asdf.AsdfFile({"wcs": to_stock_wcs(wcs)}).write_to(path)
    assert path.stat().st_size < 1_000_000
    assert b"wpdc" not in path.read_bytes()
    with asdf.open(path, lazy_load=False) as file:
        stock = file["wcs"]
    x, y = detector_points(rng, 300)
    assert_allclose(deviation_px(wcs, *stock(x, y), wcs(x, y)), 0, atol=1e-7)
    assert_allclose(stock.invert(*wcs(x, y), with_bounding_box=False), (x, y), atol=2e-4)


def test_stock_wcs_without_a_range_or_an_inverse():
    wcs = build_wcs(crpix=CRPIX, cd=SCALE * np.eye(2), crval=(10, 20))
    stock = to_stock_wcs(wcs)
    assert_allclose(stock(10.0, 20.0), wcs(10.0, 20.0), rtol=1e-14)
    with pytest.raises(NotImplementedError):
        _ = stock.get_transform("detector", "undistorted").inverse
    with pytest.raises(ValueError, match="wcs must consist of the steps"):
        to_stock_wcs(stock)


def test_stock_forms_of_a_camera_are_made_once_for_each_detector(monkeypatch):
    """The frames of a camera come exposure by exposure, each with its own attitude."""
    made, inverse = [], stock_module._stock_inverse
    monkeypatch.setattr(stock_module, "_stock_inverse", lambda *a: made.append(a) or inverse(*a))
    stock_module._kept.clear()
    for roll in (0.0, 0.3):
        for seed in (3, 4, 5):
            wcs = camera_wcs(roll=roll, seed=seed, shape=(300, 200), corner=5.0)
            stock = to_stock_wcs(wcs)
            assert_allclose(stock(10.0, 250.0), wcs(10.0, 250.0), rtol=0, atol=1e-12)
            back = stock.invert(*wcs(10.0, 250.0), with_bounding_box=False)
            assert_allclose(back, (10.0, 250.0), rtol=0, atol=1e-4)
    assert len(made) == 3
    # Only the detectors used last are kept.
    monkeypatch.setattr(stock_module, "_KEPT", 2)
    for seed, n in ((5, 3), (4, 3), (3, 4)):
        to_stock_wcs(camera_wcs(roll=0.1, seed=seed, shape=(300, 200), corner=5.0))
        assert len(made) == n
    assert len(stock_module._kept) == 2


# --- whole images


def test_sky_map(tmp_path):
    shape = (301, 517)
    wcs = camera_wcs((0.0, 45.0), shape=shape)
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    expected = wcs(x, y)
    assert_allclose(sky_map(wcs), expected, rtol=0, atol=1e-12)
    out = np.zeros((2, *shape))
    ra, dec = sky_map(wcs, out=out)
    assert_allclose(out, expected, rtol=0, atol=1e-12)
    assert ra.base is out
    assert dec.base is out
    pair = (np.zeros(shape), np.zeros(shape))
    assert sky_map(wcs, out=pair)[0] is pair[0]
    assert_allclose(pair, expected, rtol=0, atol=1e-12)
    path = tmp_path / "map.npy"
    sky_map(wcs, out=path)
    assert_allclose(np.load(path), expected, rtol=0, atol=1e-12)
    assert_allclose(sky_map(wcs, image_shape=(3, 4))[0], expected[0][:3, :4], rtol=0, atol=1e-12)
    # Any other WCS goes the same way.
    stock = sky_map(to_stock_wcs(wcs), image_shape=(3, 4))
    px = np.sqrt(abs(np.linalg.det(wcs.pipeline[1].transform.cd.value)))
    assert_allclose(stock, np.array(expected)[:, :3, :4], rtol=0, atol=1e-7 * px)
    with pytest.raises(FileExistsError, match="out must be a new file"):
        sky_map(wcs, out=path)
    with pytest.raises(ValueError, match=r"out must hold two arrays of the shape \(301, 517\)"):
        sky_map(wcs, out=np.zeros((2, 3, 4)))
    with pytest.raises(ValueError, match="image_shape must be given"):
        sky_map(build_wcs(crpix=(1, 1), cd=np.eye(2), crval=(0, 0)))


def test_sky_map_needs_no_memory_of_its_own():
    shape = (1500, 1600)
    wcs = camera_wcs(shape=shape)
    out = np.zeros((2, *shape))
    sky_map(wcs, image_shape=(2, 2))
    tracemalloc.start()
    sky_map(wcs, out=out)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 0.3 * out.nbytes
