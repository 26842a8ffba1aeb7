"""Headers: every form of the same WCS against astropy.wcs, dates, and what is refused."""

import contextlib
import copy
import warnings

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import Table
from astropy.time import Time
from astropy.wcs import WCS
from hypothesis import given, settings
from hypothesis import strategies as st

from wpdc_gwcs.exceptions import FileFormatError, FrameError, WPDCWarning
from wpdc_gwcs.io import read, read_frames, read_wcs
from wpdc_gwcs.io.celestial import parse_wcs
from wpdc_gwcs.io.dates import header_epoch, header_start, read_epoch
from wpdc_gwcs.io.headers import (
    clean_header,
    header_number,
    header_shape,
    positive_number,
    read_headers,
)
from wpdc_gwcs.io.ldac import write_ldac
from wpdc_gwcs.io.tan import parse_tan
from wpdc_gwcs.models import PVPolynomial, project, pv_terms
from wpdc_gwcs.models.attitude import fold_attitude


def tpv_header(degree=3, *, radial=False, code="TPV", seed=0, **cards):
    rng = np.random.default_rng(seed)
    header = fits.Header()
    header["CTYPE1"], header["CTYPE2"] = f"RA---{code}", f"DEC--{code}"
    header["CUNIT1"], header["CUNIT2"] = "deg", "deg"
    header["CRPIX1"], header["CRPIX2"] = 1024.7, 980.2
    header["CRVAL1"], header["CRVAL2"] = 150.0, -30.0
    header["CD1_1"], header["CD1_2"] = -8e-5, 1e-5
    header["CD2_1"], header["CD2_2"] = 1.1e-5, 7.9e-5
    terms = pv_terms(degree, radial)
    for axis in (1, 2):
        for j, total in zip(terms.index, terms.own + terms.other + terms.radius, strict=True):
            value = rng.normal() * 1e-3 / 0.1**total / 10
            header[f"PV{axis}_{j}"] = value + (1.0 if j == 1 else 0.0)
    header.update(cards)
    return header


def deviation(header, ours=None):
    """Greatest distance in px from astropy.wcs over 2048 x 2048 px."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        theirs = WCS(header)
    ours = read_wcs(header) if ours is None else ours
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(0, 2047, 15), np.linspace(0, 2047, 15)))
    world = theirs.all_pix2world(np.column_stack([x, y]), 0)
    lng, lat = theirs.wcs.lng, theirs.wcs.lat
    center = theirs.wcs.crval[lng], theirs.wcs.crval[lat]
    call = getattr(ours, "pixel_to_world_values", ours)
    difference = np.subtract(
        project(*call(x, y), center), project(world[:, lng], world[:, lat], center)
    )
    scale = np.sqrt(abs(np.linalg.det(theirs.pixel_scale_matrix)))
    return np.hypot(*difference).max() / scale


@pytest.mark.parametrize("radial", [False, True])
@pytest.mark.parametrize("degree", [1, 2, 3, 4, 5, 6, 7])
def test_all_degrees(degree, radial):
    header = tpv_header(degree, radial=radial)
    assert deviation(header) < 1e-6
    pv = parse_tan(header).pv
    assert (pv.degree, pv.radial) == (degree, radial)


@pytest.mark.parametrize("degree", [3, 4])
def test_tan_with_pv_is_tpv(degree):
    header = tpv_header(degree, code="TAN")
    assert deviation(header) < 1e-6
    assert deviation(header, read_wcs(tpv_header(degree))) < 1e-6
    # SCAMP of degree 1 has PV on the Dec axis too, where no TAN has any.
    assert parse_tan(tpv_header(1, code="TAN")).pv.degree == 1


def test_native_pole_in_pv_is_left_to_wcslib():
    header = tpv_header(1, code="TAN")
    for key in list(header["PV*"]):
        del header[key]
    header["PV1_3"] = 170.0
    assert parse_tan(header) is None
    assert deviation(header) < 1e-6


def swapped(header):
    """The same WCS with Dec on the first axis."""
    other = header.copy()
    for one, two in (
        ("CTYPE1", "CTYPE2"),
        ("CRVAL1", "CRVAL2"),
        ("CD1_1", "CD2_1"),
        ("CD1_2", "CD2_2"),
    ):
        other[one], other[two] = header[two], header[one]
    for key in header["PV*"]:
        other[f"PV{3 - int(key[2])}{key[3:]}"] = header[key]
    return other


@pytest.mark.parametrize("code", ["TPV", "TAN"])
def test_swapped_axes(code):
    header = tpv_header(code=code)
    if code == "TAN":
        for key in list(header["PV*"]):
            del header[key]
    other = swapped(header)
    if code == "TAN":
        assert deviation(other) < 1e-6
    # Of swapped TPV axes, wcslib 8.4 takes each for the other: even the identity moves the sky.
    one, two = read_wcs(header), read_wcs(other)
    np.testing.assert_allclose(one(100.0, 200.0), two(100.0, 200.0), rtol=1e-13)


def test_swapped_axes_of_sip():
    header = tpv_header(code="TAN-SIP")
    for key in list(header["PV*"]):
        del header[key]
    header.update({"A_ORDER": 2, "B_ORDER": 2, "A_2_0": 1e-6, "B_0_2": -2e-6, "A_1_1": 3e-6})
    assert deviation(header) < 1e-6
    other = swapped(header)
    assert deviation(other) < 1e-6
    np.testing.assert_allclose(
        read_wcs(header).pixel_to_world_values(10.0, 900.0),
        read_wcs(other).pixel_to_world_values(10.0, 900.0),
        rtol=1e-13,
    )


@pytest.mark.parametrize("crval2", [-90.0, -89.99, 0.0, 90.0])
@pytest.mark.parametrize("lonpole", [None, 0.0, 137.0, 180.0])
def test_lonpole(lonpole, crval2):
    header = tpv_header(CRVAL2=crval2)
    if lonpole is not None:
        header["LONPOLE"] = lonpole
    assert deviation(header) < 1e-6


@pytest.mark.parametrize("form", ["PC", "PC of the draft", "CROTA", "plain", "arcsec"])
def test_forms_of_the_linear_part(form):
    header = tpv_header(code="TAN")
    for key in [*header["PV*"], *header["CD*"]]:
        del header[key]
    header["CDELT1"], header["CDELT2"] = -8e-5, 7.9e-5
    if form == "PC":
        header.update({"PC1_1": 0.99, "PC1_2": 0.1, "PC2_1": -0.1})  # PC2_2 defaults to 1
    elif form == "PC of the draft":
        header.update({"PC001001": -0.99, "PC001002": 0.1, "PC002001": -0.1, "PC002002": 1.0})
    elif form == "CROTA":
        header["CROTA2"] = 33.0
    elif form == "arcsec":
        for axis in (1, 2):
            header[f"CUNIT{axis}"] = "arcsec"
            header[f"CDELT{axis}"] *= 3600
            header[f"CRVAL{axis}"] *= 3600
    assert deviation(header) < 1e-6


def test_rotation_is_that_of_the_latitude_axis():
    header = fits.Header(
        {
            "CTYPE1": "DEC--TAN", "CTYPE2": "RA---TAN", "CRVAL1": -30.0, "CRVAL2": 150.0,
            "CRPIX1": 1000.0, "CRPIX2": 900.0, "CDELT1": 8e-5, "CDELT2": -7e-5,
            "CROTA1": 33.0, "CROTA2": 5.0,
        }
    )  # fmt: skip
    assert deviation(header) < 1e-6


def test_sip_that_ctype_does_not_tell():
    """astropy applies it, and so do we."""
    header = tpv_header(code="TAN")
    for key in list(header["PV*"]):
        del header[key]
    header.update({"A_ORDER": 2, "B_ORDER": 2, "A_2_0": 1e-5, "B_0_2": -2e-5})
    assert deviation(header) < 1e-6


@settings(deadline=None, max_examples=25)
@given(
    st.floats(0, 360),
    st.floats(-89.9, 89.9),
    st.floats(0, 360),
    st.integers(1, 7),
    st.booleans(),
    st.integers(0, 99),
)
def test_any_header(ra, dec, roll, degree, radial, seed):
    header = tpv_header(degree, radial=radial, seed=seed, CRVAL1=ra, CRVAL2=dec)
    c, s = 8e-5 * np.cos(np.radians(roll)), 8e-5 * np.sin(np.radians(roll))
    header.update({"CD1_1": -c, "CD1_2": s, "CD2_1": s, "CD2_2": c})
    assert deviation(header) < 1e-6
    assert deviation(header, parse_tan(header).to_wcs()) < 1e-6


def test_sparse_pv_has_defaults():
    """Writers that leave out zeros."""
    header = tpv_header()
    for key in ("PV1_0", "PV2_0", "PV1_2", "PV2_9"):
        del header[key]
    assert deviation(header) < 1e-6
    assert parse_tan(header).pv.pv1_2 == 0.0


@pytest.mark.parametrize("matrix", [[[0.9, 0.2], [-0.1, 1.1]], [[0.0, 1.0], [-1.0, 0.0]]])
@pytest.mark.parametrize("degree", [1, 3, 7])
def test_fold_attitude(matrix, degree):
    rng = np.random.default_rng(3)
    n = len(pv_terms(degree).index)
    pv = PVPolynomial.from_coefficients(rng.normal(size=(2, n)), degree=degree)
    folded = fold_attitude(pv, matrix)
    u = rng.uniform(-1, 1, (2, 50))
    expected = matrix @ np.array(pv(*np.linalg.solve(matrix, u)))
    np.testing.assert_allclose(folded(*u), expected, rtol=1e-10, atol=1e-10)


def test_fold_attitude_with_radial_terms():
    rng = np.random.default_rng(3)
    n = len(pv_terms(3, True).index)
    pv = PVPolynomial.from_coefficients(rng.normal(size=(2, n)), degree=3, radial=True)
    matrix = 1.3 * np.array([[np.cos(1), -np.sin(1)], [np.sin(1), np.cos(1)]])
    u = rng.uniform(-1, 1, (2, 50))
    np.testing.assert_allclose(
        fold_attitude(pv, matrix)(*u), matrix @ np.array(pv(*np.linalg.solve(matrix, u)))
    )
    assert fold_attitude(pv, np.eye(2)) is pv
    with pytest.raises(FileFormatError, match="radial terms can only be rotated and scaled"):
        fold_attitude(pv, [[1.0, 0.1], [0.0, 1.0]])


class TestRefused:
    @pytest.mark.parametrize(
        "key",
        ["PV1_7", "PV2_10", "PV1_0", "CRVAL1", "CRPIX2", "CD1_1", "CD2_1", "CTYPE2"],
    )
    def test_missing_card(self, key):
        header = tpv_header()
        del header[key]
        with pytest.raises(FileFormatError, match=key):
            parse_tan(header)

    def test_missing_axis(self):
        header = tpv_header()
        for key in list(header["PV2*"]):
            del header[key]
        with pytest.raises(FileFormatError, match="card PV2_0 is missing"):
            parse_tan(header)

    @pytest.mark.parametrize("key", ["PV1_5", "CRVAL2", "CD2_2", "CRPIX1", "LONPOLE"])
    @pytest.mark.parametrize("image", ["'abc     '", "T", "1.2.3", "", "(1.0, 2.0)"])
    def test_card_that_is_no_number(self, key, image):
        header = tpv_header(LONPOLE=180.0)
        header.remove(key)
        header.append(fits.Card.fromstring(f"{key:<8}= {image}"))
        with pytest.raises(FrameError, match=f"a.fits: card {key} must be a finite number, got"):
            parse_tan(header, name="a.fits", error=FrameError)

    @pytest.mark.parametrize(
        ("one", "two"),
        [
            ("RA---TPV", "FREQ"),
            ("RA---TPV", "RA---TPV"),
            ("RA---TPV", "GLAT-TPV"),
            ("LINEAR", "LINEAR"),
            ("PIXEL", ""),
            ("XLON-TAN", "XLAT-TAN"),
        ],
    )
    def test_axes_that_are_not_celestial(self, one, two):
        header = tpv_header(CTYPE1=one, CTYPE2=two)
        with pytest.raises(FileFormatError, match=f"celestial pair.*got '{one}' and '{two}'"):
            parse_tan(header)

    def test_two_projections(self):
        with pytest.raises(FileFormatError, match="same projection, got 'RA---TPV' and 'DEC--TAN'"):
            parse_tan(tpv_header(CTYPE2="DEC--TAN"))

    @pytest.mark.parametrize("cd", [(0, 0, 0, 0), (1e-4, 1e-4, 1e-4, 1e-4), (1e-4, 0, 0, 0)])
    def test_singular_cd(self, cd):
        keys = ("CD1_1", "CD1_2", "CD2_1", "CD2_2")
        with pytest.raises(FileFormatError, match="CD matrix must not be singular, got"):
            parse_tan(tpv_header(**dict(zip(keys, map(float, cd), strict=True))))

    def test_no_linear_part(self):
        header = tpv_header()
        for key in list(header["CD*"]):
            del header[key]
        with pytest.raises(FileFormatError, match="pixel scale in CD, PC"):
            parse_tan(header)
        header["CDELT1"] = 1e-4
        with pytest.raises(FileFormatError, match="card CDELT2 is missing"):
            parse_tan(header)

    def test_units(self):
        with pytest.raises(FileFormatError, match="CUNIT1 must be an angle, got 'Hz'"):
            parse_tan(tpv_header(CUNIT1="Hz"))

    def test_index_beyond_the_convention(self):
        with pytest.raises(FileFormatError, match="PV index must not exceed 39, got 40"):
            parse_tan(tpv_header(PV1_40=1.0))

    def test_declination(self):
        with pytest.raises(FileFormatError, match=r"must lie in \[-90, 90\] deg, got 91"):
            parse_tan(tpv_header(CRVAL2=91.0))

    @pytest.mark.parametrize("projection", ["-TAN", "-STG", "-TAN-SIP"])
    @pytest.mark.parametrize("crval1", [-1e30, 721.0, 1e9])
    def test_a_longitude_of_noise(self, projection, crval1):
        header = tpv_header(1, CRVAL1=crval1)
        for axis, name in ((1, "RA--"), (2, "DEC-")):
            header[f"CTYPE{axis}"] = f"{name}{projection}"
        for key in [key for key in header if key.startswith("PV")]:
            del header[key]
        with pytest.raises(FileFormatError, match="longitude CRVAL must lie within 720"):
            parse_wcs(header)

    def test_a_longitude_of_another_turn(self):
        here, there = (parse_wcs(tpv_header(CRVAL1=ra)) for ra in (10.0, 370.0))
        np.testing.assert_allclose(
            here.wcs_pix2world(3.0, 4.0, 0), there.wcs_pix2world(3.0, 4.0, 0), rtol=1e-12
        )

    @pytest.mark.parametrize(
        ("code", "message"), [("TAN-SIP", "matrix is singular"), ("ZPN", "Invalid parameters")]
    )
    def test_what_wcslib_refuses(self, code, message):
        header = tpv_header(code=code)
        for key in list(header["PV*"]):
            del header[key]
        header["CD1_1"] = header["CD1_2"] = header["CD2_1"] = header["CD2_2"] = 0.0
        with pytest.raises(FileFormatError, match=f"h: not a usable WCS: .*{message}"):
            parse_wcs(header, name="h")


# --- celestial frames ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cards", "frame"),
    [
        ({"RADESYS": "FK4", "EQUINOX": 1950.0}, "fk4"),
        ({"RADESYS": "FK5", "EQUINOX": 1975.0}, "fk5"),
        ({"EQUINOX": 1950.0}, "fk4"),
        ({"RADECSYS": "FK5", "EQUINOX": "J2000"}, "icrs"),
        ({"RADESYS": "ICRS"}, "icrs"),
        ({"RADESYS": "GAIA-CRF3", "EQUINOX": 2016.0}, "icrs"),
        ({"RADESYS": "FK4-NO-E"}, "fk4noeterms"),
        ({"RADESYS": "fk4_no_e", "EQUINOX": "B1950.0"}, "fk4noeterms"),
        ({"RADESYS": "J2000"}, "icrs"),
        ({"RADESYS": "UNKNOWN"}, "icrs"),
        ({}, "icrs"),
    ],
)
def test_starting_wcs_is_in_icrs(cards, frame):
    header = tpv_header(**cards)
    wcs = parse_wcs(header)
    ra, dec = wcs.pixel_to_world_values(10.0, 2000.0)
    raw = read_wcs(header)(10.0, 2000.0)
    options = {"fk5": {"equinox": "J1975"}}.get(frame, {})
    options = {"equinox": "B1950"} if frame.startswith("fk4") else options
    expected = SkyCoord(*raw, unit="deg", frame=frame, **options).icrs
    # FK4's terms of aberration are not a rotation; over a frame they leave some 0.01 arcsec.
    assert SkyCoord(ra, dec, unit="deg").separation(expected).arcsec < 0.03


@pytest.mark.parametrize("system", ["GAPPT", "Apparent", "TETE", "true-of-date"])
def test_apparent_places_are_those_of_their_equinox(system):
    header = tpv_header(RADESYS=system, EQUINOX=2016.5)
    with pytest.warns(WPDCWarning, match=f"{system}'.*taken for mean places of 2016.5"):
        wcs = parse_wcs(header)
    got = SkyCoord(*wcs.pixel_to_world_values(10.0, 2000.0), unit="deg")
    raw = read_wcs(tpv_header())(10.0, 2000.0)
    expected = SkyCoord(*raw, unit="deg", frame="fk5", equinox="J2016.5").icrs
    assert got.separation(expected).arcsec < 1e-6
    with pytest.raises(FileFormatError, match="needs the EQUINOX"):
        parse_wcs(tpv_header(RADESYS=system))


def test_unknown_system_is_named():
    with pytest.warns(WPDCWarning, match="got 'XYZ': it is taken for FK5 of 1990.0"):
        parse_wcs(tpv_header(RADESYS="XYZ", EQUINOX=1990.0))


def test_warning_of_an_open_file_is_shown(tmp_path):
    fits.PrimaryHDU(np.zeros((9, 9)), tpv_header(RADESYS="XYZ")).writeto(tmp_path / "a.fits")
    with pytest.warns(WPDCWarning, match="a.fits: RADESYS must be ICRS"):
        read_frames(tmp_path / "a.fits")


@pytest.mark.parametrize("cards", [{"PV2_1": 0.0, "PV2_2": 0}, {"PV1_1": 0.0}])
def test_zeros_beside_tan_say_nothing(cards):
    header = tpv_header(code="TAN")
    for key in list(header["PV*"]):
        del header[key]
    plain = parse_tan(header)
    header.update(cards)
    zeros = parse_tan(header)
    np.testing.assert_array_equal(zeros.pv.coefficients, plain.pv.coefficients)
    assert deviation(header, parse_wcs(header)) < 1e-6


def test_scale_is_one_beside_pc():
    header = tpv_header()
    for i in (1, 2):
        for j in (1, 2):
            header[f"PC{i}_{j}"] = header.pop(f"CD{i}_{j}")
    np.testing.assert_array_equal(parse_tan(header).cd, parse_tan(tpv_header()).cd)


@pytest.mark.parametrize("code", ["TPV", "SIN"])
def test_pixel_scale_by_hand(code):
    header = tpv_header(code=code)
    if code == "SIN":
        for key in list(header["PV*"]):
            del header[key]
    scaled = parse_wcs(header, pixel_scale=0.5)
    matrix = scaled.pixel_scale_matrix
    assert np.sqrt(abs(np.linalg.det(matrix))) == pytest.approx(0.5 / 3600, rel=1e-12)
    ratio = matrix / parse_wcs(header).pixel_scale_matrix
    np.testing.assert_allclose(ratio, ratio[0, 0], rtol=1e-12)
    for key in list(header["CD*"]):
        del header[key]
    matrix = parse_wcs(header, pixel_scale=0.5).pixel_scale_matrix
    np.testing.assert_allclose(matrix, np.diag([-0.5, 0.5]) / 3600, rtol=1e-12)


def test_galactic_axes():
    header = tpv_header(code="TAN")
    for key in list(header["PV*"]):
        del header[key]
    header["CTYPE1"], header["CTYPE2"] = "GLON-TAN", "GLAT-TAN"
    wcs = read_wcs(header)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        expected = WCS(header).pixel_to_world(10, 2000).icrs
    assert list(wcs.wcs.ctype) == ["RA---TAN", "DEC--TAN"]
    got = SkyCoord(*wcs.pixel_to_world_values(10, 2000), unit="deg")
    assert got.separation(expected).arcsec < 1e-6


@settings(deadline=None, max_examples=200)
@given(
    st.dictionaries(
        st.sampled_from(
            "CTYPE1 CTYPE2 CRVAL1 CRVAL2 CRPIX1 CD1_1 CD1_2 CD2_1 CDELT1 CDELT2 PC1_1 CROTA2 "
            "CUNIT1 RADESYS EQUINOX EPOCH LONPOLE LATPOLE PV1_1 PV2_1 PV1_5 A_ORDER NAXIS1 NAXIS2 "
            "DATE-OBS MJD-OBS EXPTIME TIMESYS OBSMJD WCSAXES".split()
        ),
        st.one_of(
            st.sampled_from(["RA---TAN", "DEC--TAN", "RA---SIP", "GLON-CAR", "FK4", "ICRS", "deg"]),
            st.floats(allow_nan=False, allow_infinity=False),
            st.integers(-10, 10),
            st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=20),
            st.booleans(),
        ),
        max_size=6,
    )
)
def test_no_other_error_whatever_the_header(cards):
    header = tpv_header(code="TAN")
    for key, value in cards.items():
        header[key] = value
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with contextlib.suppress(FileFormatError):
            parse_wcs(header)
        header_epoch([header])
        header_start([header])


# --- text ---------------------------------------------------------------------------------------


def test_text_headers(tmp_path):
    header = tpv_header()
    cards = [card.image for card in header.cards]
    dirty = [*cards[:3], "COMMENT é à", "HISTORY SCAMP \xa9", "garbage", *cards[3:]]
    text = "\n".join([*dirty, "END     ", *cards, "END"]).encode("latin-1")
    (tmp_path / "a.head").write_bytes(text)
    headers = read_headers(tmp_path / "a.head")
    assert len(headers) == 2
    for one in headers:
        assert deviation(header, read_wcs(one)) < 1e-9
    np.testing.assert_array_equal(
        read_wcs(f"{tmp_path / 'a.head'}[1]")(1.0, 2.0), read_wcs(header)(1.0, 2.0)
    )
    with pytest.raises(FileFormatError, match="has 2 WCS headers; choose one"):
        read_wcs(tmp_path / "a.head")
    with pytest.raises(FileFormatError, match="header number must be below 2, got 2"):
        read_headers(f"{tmp_path / 'a.head'}[2]")


def test_cards_without_line_ends_and_with_nuls():
    text = tpv_header().tostring().encode().replace(b"END" + b" " * 77, b"END" + b"\0" * 77)
    (header,) = clean_header(text)
    assert deviation(tpv_header(), read_wcs(header)) < 1e-9


def test_extensions(tmp_path):
    images = [fits.ImageHDU(np.zeros((4, 5)), tpv_header(seed=i), name=f"CCD{i}") for i in (1, 2)]
    fits.HDUList([fits.PrimaryHDU(), *images]).writeto(tmp_path / "a.fits")
    for key in ("1", "CCD1", "ccd1", "CCD1,1"):
        (header,) = read_headers(f"{tmp_path / 'a.fits'}[{key}]")
        assert header["EXTNAME"] == "CCD1"
    with pytest.raises(FileFormatError, match="must be one of 0 PRIMARY, 1 CCD1, 2 CCD2, got 7"):
        read_headers(f"{tmp_path / 'a.fits'}[7]")
    with pytest.raises(FileFormatError, match="got 'CCD3'"):
        read_headers(f"{tmp_path / 'a.fits'}[CCD3]")
    with pytest.raises(FileFormatError, match="found none"):
        read_headers(f"{tmp_path / 'a.fits'}[0]")


def test_numbers_and_shapes():
    header = fits.Header()
    header["A"], header["B"], header["C"], header["D"] = -1.0, "x", True, 2
    assert positive_number([header], ("A", "B", "C", "D")) == 2.0
    assert positive_number([fits.Header()], ("A",)) is None
    assert header_number(header, "Z", required=False, default=3.0) == 3.0
    with pytest.raises(FileFormatError, match="h: card Z is missing"):
        header_number(header, "Z", name="h")
    assert header_shape(header) is None
    header["IMAGEW"], header["IMAGEH"] = 10, 20.0
    assert header_shape(header) == (20, 10)
    header["NAXIS1"], header["NAXIS2"] = 30, 0
    assert header_shape(header) == (20, 10)
    header["NAXIS2"] = 40
    assert header_shape(header) == (40, 30)
    header["ZNAXIS1"], header["ZNAXIS2"] = 5, 6
    assert header_shape(header) == (6, 5)


def test_tan_header_pickles_and_copies():
    import pickle

    tan = parse_tan(tpv_header(NAXIS1=100, NAXIS2=200))
    assert tan.image_shape == (200, 100)
    for other in (copy.deepcopy(tan), pickle.loads(pickle.dumps(tan))):
        np.testing.assert_array_equal(other.cd, tan.cd)
        np.testing.assert_array_equal(other.pv.coefficients, tan.pv.coefficients)


# --- dates --------------------------------------------------------------------------------------


def epoch(*headers, **cards):
    header = fits.Header()
    for key, value in cards.items():
        header[key.replace("_", "-")] = value
    return header_epoch([header, *headers], name="a.fits")


@pytest.mark.parametrize(
    ("cards", "mid"),
    [
        ({"MJD_OBS": 57388.5, "EXPTIME": 172800.0}, "2016-01-02T12:00:00"),
        ({"DATE_OBS": "2016-01-01T12:00:00"}, "2016-01-01T12:00:00"),
        ({"DATE_OBS": "2016-01-01T12:00:00.123", "EXPTIME": 7200}, "2016-01-01T13:00:00.123"),
        ({"DATE_OBS": "2016-01-01T12:00:00Z"}, "2016-01-01T12:00:00"),
        ({"DATE_OBS": "2016-01-01", "TIME_OBS": "18:30:00.5"}, "2016-01-01T18:30:00.5"),
        ({"DATE_OBS": "2016-01-01", "UT": "6:30"}, "2016-01-01T06:30:00"),
        ({"DATE_OBS": "2016-01-01"}, "2016-01-01T00:00:00"),
        ({"DATE_OBS": "31/12/85"}, "1985-12-31T00:00:00"),
        ({"DATE_AVG": "2016-06-01T00:00:00", "MJD_OBS": 50000.0}, "2016-06-01T00:00:00"),
        ({"MJD_AVG": 57000.0, "DATE_OBS": "2001-01-01"}, "2014-12-09T00:00:00"),
        (
            {"DATE_BEG": "2016-01-01T00:00:00", "DATE_END": "2016-01-01T02:00:00"},
            "2016-01-01T01:00:00",
        ),
        ({"DATE_BEG": "2016-01-01T00:00:00", "EXPTIME": 60.0}, "2016-01-01T00:00:30"),
        ({"JD": 2457389.0}, "2016-01-01T12:00:00"),
        ({"MJD_OBS": "57388.5"}, "2016-01-01T12:00:00"),
    ],
)
def test_dates(cards, mid):
    expected = Time(mid, scale="utc").tt.jyear
    assert epoch(**cards) == pytest.approx(expected, abs=1e-6)  # leap seconds


@pytest.mark.parametrize("scale", ["UTC", "TAI", "TT", "TDB"])
def test_time_scales(scale):
    expected = Time("2020-03-01T01:02:03", scale=scale.lower()).tt.jyear
    got = epoch(DATE_OBS="2020-03-01T01:02:03", TIMESYS=scale)
    assert got == pytest.approx(expected, abs=1e-9)


def test_primary_header_comes_second():
    primary = fits.Header({"DATE-OBS": "2001-01-01T00:00:00", "EXPTIME": 0.0})
    assert epoch(primary, MJD_OBS=57388.5) == pytest.approx(2016.0, abs=1e-3)
    assert epoch(primary) == pytest.approx(2001.0, abs=2e-3)


NOON = Time("2020-09-24T10:21:45", scale="utc")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *((key, NOON.mjd) for key in ("OBSMJD", "MJD_OBS", "EXPSTART", "MJD-STRT", "MJDSTART")),
        *((key, NOON.mjd) for key in ("MJD_UTC", "SHUTOPEN", "OBS-MJD", "TAI-MJD", "MJD-MID")),
        *(
            (key, NOON.jd)
            for key in ("OBSJD", "JD-OBS", "JD_UTC", "JDSTART", "HJD", "JULDATE", "JD")
        ),
        *(
            (key, NOON.isot)
            for key in ("DATE_OBS", "SHUTOPEN", "DATEOBS", "UTDATE", "OBS-DATE", "DATE-BGN")
        ),
        *((key, NOON.isot) for key in ("DATE_BEG", "EXPSTART", "UTC-OBS", "OBSTIME", "TIME-BEG")),
        *((key, NOON.isot) for key in ("DATE-UTC", "TIMESTAMP", "MIDTIME", "OBSTART", "UTSHUT")),
        ("ESO OBS START", NOON.isot),
        ("XYZ EXP MJD-OBS", NOON.mjd),
        ("MJD-OBS", NOON.jd),
        ("JD", str(NOON.jd)),
        ("OBSEPOCH", NOON.tt.jyear),
    ],
)
def test_keywords_of_observatories(key, value):
    header = fits.Header()
    header.set(f"HIERARCH {key}" if len(key) > 8 else key, value)
    assert header_epoch([header]) == pytest.approx(NOON.tt.jyear, abs=3e-6)


@pytest.mark.parametrize(
    "text",
    [
        "2020-09-24T10:21:45Z",
        "2020-09-24T10:21:45+00:00",
        "2020-09-24T12:21:45+0200",
        "2020-09-24T10:21:45.000(UTC)",
        "2020-09-24 10:21:45 UTC",
        "2020-09-24 10:21:45 UT",
        "2020/09/24 10:21:45",
        "2020:09:24 10:21:45",
        "2020.09.24 10:21:45",
        "2020-9-24T10h21m45s",
        "20200924T102145",
        "24/09/2020 10:21:45",
        "24-09-2020T10:21:45",
        "09/24/2020 10:21:45 AM",
        "24/09/20 10:21:45",
        "24 Sep 2020 10:21:45",
        "24-SEP-2020 10:21:45",
        "September 24, 2020 10:21:45",
        "2020-Sep-24 10:21:45",
        "Thu Sep 24 10:21:45 2020",
        "Thursday, 24 September 2020 10:21:45 GMT",
        "2020:268:10:21:45",
        "2020-268T10:21:45",
        "2020-09-24T10:22:22(TAI)",
    ],
)
def test_forms_of_dates(text):
    header = fits.Header({"DATE-OBS": text})
    assert header_epoch([header]) == pytest.approx(NOON.tt.jyear, abs=5e-8)
    assert header_start([header]) == pytest.approx(NOON.mjd, abs=5e-4)


@pytest.mark.parametrize("text", ["2020/09/24", "24/09/2020", "20200924", "24-Sep-20", "2020-268"])
def test_days_without_time(text):
    header = fits.Header({"DATE-OBS": text})
    assert header_epoch([header]) == pytest.approx(NOON.tt.jyear, abs=0.5 / 365)
    assert header_start([header]) is None
    header["UT"] = "10:21:45"
    assert header_epoch([header]) == pytest.approx(NOON.tt.jyear, abs=5e-8)


@pytest.mark.parametrize(
    "cards",
    [
        {"DATE": "2024-01-01T00:00:00", "DATE-MAP": "2024-01-01", "MJDREF": 55197.0},
        {"UTSTART": 50000.0, "EXPTIME": 50000.0, "EXP": 50001, "INT": 50002, "FRAME": 50003.0},
        {"DATE-PRC": "2024-01-01", "PROCTIME": "2024-01-01", "CALDATE": "2024-01-01"},
        {"UT": "10:21:45", "TIME-OBS": "10:21:45", "LST": "10:21:45", "EQUINOX": 2000.0},
    ],
)
def test_what_is_no_date_of_the_exposure(cards):
    assert header_epoch([fits.Header(cards)]) is None
    cards = {"OBSMJD": NOON.mjd, **cards, "EXPTIME": 0.0}
    assert header_epoch([fits.Header(cards)]) == pytest.approx(NOON.tt.jyear, abs=3e-6)


@pytest.mark.parametrize(
    ("text", "year"), [("J2016.5", 2016.5), ("2016-07-02", 2016.5), (57571.5, 2016.5)]
)
def test_epoch_by_hand(text, year):
    assert read_epoch(text) == pytest.approx(year, abs=2e-3)
    for bad in ("soon", "12", "nan", "2016-13-01", ""):
        with pytest.raises(ValueError, match="epoch must be a Julian year"):
            read_epoch(bad)


def test_no_date():
    assert epoch() is None
    assert epoch(EXPTIME=100.0) is None


@pytest.mark.parametrize(
    ("cards", "year", "message"),
    [
        ({"DATE_OBS": "soon"}, None, "DATE-OBS='soon'; no epoch is used"),
        ({"DATE_OBS": "2016-13-40T00:00:00"}, None, "DATE-OBS='2016-13-40"),
        ({"DATE_OBS": "2016-01-01T25:00:00"}, None, "DATE-OBS="),
        (
            {"MJD_OBS": 0.0, "DATE_OBS": "2016-01-01T12:00:00"},
            2016.0,
            "MJD-OBS='0.0'; the epoch 2016",
        ),
        ({"MJD_OBS": 1e9}, None, "MJD-OBS="),
        ({"MJD_OBS": True}, None, "MJD-OBS="),
        ({"DATE_OBS": "2016-01-01T12:00:00", "EXPTIME": -5.0}, 2016.0, "EXPTIME=-5.0"),
        ({"DATE_OBS": "2016-01-01T12:00:00", "EXPTIME": "long"}, 2016.0, "EXPTIME='long'"),
        ({"DATE_OBS": "2016-01-01T12:00:00", "TIMESYS": "LOCAL"}, 2016.0, "TIMESYS='LOCAL'"),
        ({"DATE_OBS": 2016}, None, "DATE-OBS='2016'"),
    ],
)
def test_dates_that_make_no_sense(cards, year, message):
    with pytest.warns(WPDCWarning, match=f"a.fits: dates that make no sense.*{message}"):
        got = epoch(**cards)
    assert got == (None if year is None else pytest.approx(year, abs=1e-5))


def test_a_list_has_the_header_of_its_image(tmp_path):
    """As written by simulations and, with one string for the header, by SExtractor."""
    header = tpv_header()
    header["NAXIS"], header["NAXIS1"], header["NAXIS2"] = 2, 2048, 2000
    objects = Table({"X_IMAGE": [1.0], "Y_IMAGE": [2.0]})
    write_ldac(objects, header, tmp_path / "a.ldac")
    x, y = np.random.default_rng(1).uniform(0, 2000, (2, 50))
    truth = WCS(header).all_pix2world(x, y, 0)
    for path in (tmp_path / "a.ldac", f"{tmp_path / 'a.ldac'}[LDAC_OBJECTS]"):
        (found,) = read_headers(path)
        assert header_shape(found) == (2000, 2048)
        np.testing.assert_allclose(read_wcs(path)(x, y), truth, rtol=0, atol=1e-10)
        np.testing.assert_allclose(read(path).wcs(x, y), truth, rtol=0, atol=1e-10)
    # An image whose own header points elsewhere starts from it.
    wrong = tpv_header(CRVAL1=20.0)
    fits.writeto(tmp_path / "a.fits", np.zeros((2000, 2048), np.int16), wrong)
    (frame,) = read_frames(tmp_path / "a.fits", wcs=tmp_path / "a.ldac")
    found = frame.wcs.pixel_to_world_values(x, y)
    np.testing.assert_allclose(found, truth, rtol=0, atol=1e-8)


def test_a_list_without_a_wcs_is_refused(tmp_path):
    write_ldac(Table({"X_IMAGE": [1.0]}), fits.Header({"OBJECT": "a"}), tmp_path / "a.ldac")
    with pytest.raises(FileFormatError, match="must hold a header with CTYPE1"):
        read_headers(tmp_path / "a.ldac")
