"""Headers of others, as they are: the reader against astropy.wcs, file by file."""

import warnings
from pathlib import Path

import astropy.wcs
import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from wpdc_gwcs.exceptions import FileFormatError
from wpdc_gwcs.io import read_wcs
from wpdc_gwcs.models import project


def plain_headers(path):
    """Headers of a conformance file as astropy gets them: not through this package."""
    data = path.read_bytes()
    if data[:9] == b"SIMPLE  =" and path.suffix in (".fits", ".wcs"):
        with fits.open(path) as hdus:
            return [h.header.copy() for h in hdus if "CTYPE1" in h.header]
    lines = data.decode("latin-1").splitlines()
    if len(lines) < 3:
        lines = [lines[0][i : i + 80] for i in range(0, len(lines[0]), 80)]
    keep = [
        line[:80].encode("ascii", "replace").decode()
        for line in lines
        if line[8:9] == "=" and not line.startswith("#")
    ]
    return [fits.Header([fits.Card.fromstring(line) for line in keep])]


CONFORMANCE = [
    "galsim_fits_registry/tpv.fits",
    "galsim_fits_registry/tanpv.fits",
    "galsim_fits_registry/tpv_odd.fits",
    "galsim_fits_registry/tanflip.fits",
    "galsim_fits_registry/DECam_00154912_12_header.fits",
    "galsim_fits_registry/scamp.head",
    "scamp_heads/example_scamp.head",
    "scamp_heads/example_externcat_scamp.head",
    "scamp_heads/example_externcat_scamp_tpv.head",
    "scamp_heads/wircam_scamp1.6.2_RA---TAN_PV.head.txt",
    "sip_tpv/PTF_r_chip01_tpv.txt",
    "astropy/tpvonly.hdr",
    "wcslib_keyrec/TPV3.keyrec",
    "wcslib_keyrec/TPV5.keyrec",
    "wcslib_keyrec/TPV7.keyrec",
]


def compare_with_astropy(header, ours):
    header = header.copy()
    if "CD1_1" not in header and "TPV" in header["CTYPE1"]:
        # astropy.wcs drops TPV distortions where the linear part is a bare CDELT.
        for i in (1, 2):
            header[f"CD{i}_{i}"] = header.pop(f"CDELT{i}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        theirs = WCS(header)
    nx, ny = (max(int(header.get(f"NAXIS{i}", 0)), 2048) for i in (1, 2))
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(0, nx, 21), np.linspace(0, ny, 21)))
    world = theirs.all_pix2world(np.column_stack([x, y]), 0)
    expected = world[:, theirs.wcs.lng], world[:, theirs.wcs.lat]
    got = ours(x, y, with_bounding_box=False)
    center = [header["CRVAL1"], header["CRVAL2"]]
    if theirs.wcs.lng == 1:
        center = center[::-1]
    difference = np.subtract(project(*got, center), project(*expected, center))
    linear = theirs.pixel_scale_matrix
    if theirs.wcs.lng == 1:
        linear = linear[::-1]
    return np.hypot(*np.linalg.solve(linear, difference)).max()


@pytest.mark.parametrize("name", CONFORMANCE)
def test_conformance_headers(shared_data, name):
    path = shared_data / "wcs_headers" / "conformance" / name
    (header,) = plain_headers(path)
    assert compare_with_astropy(header, read_wcs(path)) < 1e-6


def test_survey_headers(shared_data):
    folder = shared_data / "wcs_headers" / "legacysurvey"
    count = 0
    for path in sorted([*folder.glob("90prime/*.fits"), *folder.glob("*.wcs")]):
        with fits.open(path) as hdus:
            numbers = [i for i, h in enumerate(hdus) if "CTYPE1" in h.header]
            headers = [hdus[i].header.copy() for i in numbers]
        for number, header in zip(numbers[-3:], headers[-3:], strict=True):
            assert compare_with_astropy(header, read_wcs(f"{path}[{number}]")) < 1e-6, path
            count += 1
    assert count > 30


@pytest.mark.parametrize(
    "name",
    [
        "astropy/sip.fits",
        "astropy/siponly.hdr",
        "astropy/too_many_pv.hdr",
        "galsim_fits_registry/sipsample.fits",
        "sip_tpv/IRAC_3.6um_sip.txt",
        "wcslib_keyrec/SIP.keyrec",
    ],
)
def test_sip_headers(shared_data, name):
    path = shared_data / "wcs_headers" / "conformance" / name
    ours = read_wcs(path)
    (header,) = plain_headers(path)
    for key in [k for k in header if k.startswith("PV")]:
        del header[key]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        theirs = WCS(header, naxis=2)
    x, y = np.meshgrid(np.linspace(0, 2000, 11), np.linspace(0, 2000, 11))
    np.testing.assert_allclose(
        ours.pixel_to_world_values(x, y), theirs.all_pix2world(x, y, 0), rtol=1e-12
    )


def test_lookup_tables_of_astropy(shared_data):
    """SIP, CPDIS and D2IM together, from a compressed file."""
    path = shared_data / "wcs_headers" / "conformance" / "astropy" / "dist_lookup.fits.gz"
    ours = read_wcs(path)
    with warnings.catch_warnings(), fits.open(path) as hdus:
        warnings.simplefilter("ignore")
        theirs = WCS(hdus[1].header, hdus)
        expected = theirs.all_pix2world([10.0, 50.0], [20.0, 70.0], 0)
    np.testing.assert_allclose(ours.pixel_to_world_values([10.0, 50.0], [20.0, 70.0]), expected)


# --- the headers that come with astropy ---------------------------------------------------------

ASTROPY = Path(astropy.wcs.__file__).parent / "tests" / "data"

# What the reader refuses, and the beginning of why.
REFUSED = {
    "3d_cd.hdr": "card CRVAL1 is missing",
    "chandra-pixlist-wcs.hdr": "must hold a header with CTYPE1",
    "dist.fits": "must hold a header with CTYPE1",
    "header_with_time.fits": "must hold a header with CTYPE1",
    "header_with_time_wcslib71.fits": "must hold a header with CTYPE1",
    "j94f05bgq_flt.fits": "has 6 WCS headers; choose one",
    "nonstandard_units.hdr": "CUNIT2 must be an angle, got 'M/S'",
    "validate.fits": "has 2 WCS headers; choose one",
}


def astropy_files():
    names = [str(p.relative_to(ASTROPY)) for p in ASTROPY.rglob("*") if p.is_file()]
    return sorted(n for n in names if n.endswith((".hdr", ".fits", ".gz")))


def astropy_header(path):
    """What astropy itself makes of one of its files; `None` where it cannot."""
    if path.suffix == ".hdr":
        text = path.read_bytes().decode("latin-1")
        header = fits.Header.fromstring(text, sep="\n" if "\n" in text else "")
        try:
            return header, WCS(header)
        except fits.VerifyError:
            return None
    with fits.open(path) as hdus:
        (header,) = (hdu.header.copy() for hdu in hdus if "CTYPE1" in hdu.header)
        return header, WCS(header, hdus)


@pytest.mark.skipif(not astropy_files(), reason="astropy is installed without its tests")
@pytest.mark.parametrize("name", astropy_files())
def test_headers_of_astropy(name):
    """Every one is read as astropy reads it, in full, or refused with the reason."""
    path = ASTROPY / name
    reason = REFUSED.get(name, "must be a celestial pair" if "spectra" in name else None)
    if reason is not None:
        with pytest.raises(FileFormatError, match=reason):
            read_wcs(path)
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ours = read_wcs(path)
        found = astropy_header(path)
        if found is None:
            # Lines that are no cards: with them left out there is a WCS.
            assert np.isfinite(ours.pixel_to_world_values(0.0, 0.0)).all() or "outside" in name
            return
        header, theirs = found
        theirs = theirs.celestial if theirs.naxis > 2 else theirs
        ny, nx = ours.array_shape or (200, 200)
        pixels = np.meshgrid(np.linspace(0, nx - 1, 7), np.linspace(0, ny - 1, 7))
        expected = theirs.pixel_to_world(*pixels)
        got = np.array(ours.pixel_to_world_values(*pixels))
    # The reader turns other systems than equatorial ones to ICRS; FK5 stays as it is.
    target = "icrs" if expected.frame.name == "galactic" else expected.frame
    expected = expected.transform_to(target)
    good = np.isfinite(expected.spherical.lon.deg)
    np.testing.assert_array_equal(np.isfinite(got).all(axis=0), good)
    wrong = np.abs(got[0] - expected.spherical.lon.deg)
    wrong = np.minimum(wrong, np.abs(360.0 - wrong)) * np.cos(expected.spherical.lat)
    assert np.hypot(wrong, got[1] - expected.spherical.lat.deg)[good].max(initial=0.0) < 1e-10
