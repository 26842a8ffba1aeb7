"""The WCS as objects of astropy; truth is the exact WCS."""

import numpy as np
import pytest
from astropy import units as u
from astropy.nddata import CCDData, Cutout2D
from astropy.wcs import WCS
from test_io_formats import distance, grid, make_calibration, smooth_calibration

from wpdc_gwcs import Calibration


@pytest.fixture(scope="module")
def calibration():
    return smooth_calibration(5, amplitude=20.0)


@pytest.mark.parametrize("form", ["tpv", "sip"])
def test_header(calibration, form):
    header = calibration.to_header(form)
    assert [header[k] for k in ("NAXIS", "NAXIS1", "NAXIS2", "WCSAXES")] == [2, 2048, 2064, 2]
    wcs = WCS(header)
    assert wcs.array_shape == (2064, 2048)
    found = distance(calibration, wcs.all_pix2world(*grid(calibration), 0))
    assert found <= 1.05 * header["WPDCDEV"] + 1e-6
    assert header["WPDCDEV"] < 2e-3
    assert calibration.to_header(form, degree=3)["WPDCDEV"] > 0.1


@pytest.mark.parametrize("form", ["tpv", "sip", "cpdis", "tab"])
def test_astropy_wcs(calibration, form):
    wcs = calibration.to_astropy_wcs(form)
    assert wcs.array_shape == (2064, 2048)
    assert distance(calibration, wcs.all_pix2world(*grid(calibration), 0)) < 2e-3
    sky = calibration.wcs.pixel_to_world(100.0, 200.0)
    np.testing.assert_allclose(wcs.world_to_pixel(sky), (100.0, 200.0), atol=0.01)
    of_solution = calibration.solution.to_astropy_wcs(form)
    moved = of_solution.pixel_to_world(5.0, 6.0).separation(wcs.pixel_to_world(5.0, 6.0))
    assert moved > 1 * u.arcsec


@pytest.mark.parametrize("form", ["tpv", "sip"])
def test_images_with_it_are_cut_and_written(tmp_path, calibration, form):
    """Polynomials follow where a cut-out goes, and into the file of a CCDData and back."""
    data = np.zeros((2064, 2048), np.float32)
    image = calibration.to_ccddata(data, form, unit="electron")
    assert isinstance(image, CCDData)
    assert image.unit == u.electron
    y, x = np.mgrid[900:1900:9j, 300:1100:9j]
    exact = calibration.wcs.pixel_to_world(x, y)
    cut = Cutout2D(image.data, (700, 1400), (1100, 1000), wcs=image.wcs)
    part = image[900:1900, 300:1100]
    image.write(tmp_path / "a.fits")
    back = CCDData.read(tmp_path / "a.fits")
    for wcs, origin in ((cut.wcs, cut.origin_original), (part.wcs, (300, 900)), (back.wcs, (0, 0))):
        found = wcs.pixel_to_world(x - origin[0], y - origin[1])
        assert found.separation(exact).max() < 2e-3 * 0.3 * u.arcsec
    quantity = calibration.to_ccddata(data * u.Jy)
    assert quantity.unit == u.Jy
    assert calibration.to_ccddata(data).unit == u.adu


def test_what_is_refused(calibration):
    with pytest.raises(ValueError, match="format of a header must be one of tpv, sip, got 'cpdis'"):
        calibration.to_header("cpdis")
    with pytest.raises(ValueError, match="format of an astropy WCS must be one of .*got 'stock'"):
        calibration.to_astropy_wcs("stock")
    with pytest.raises(ValueError, match="format of a CCDData must be one of"):
        calibration.to_ccddata(np.zeros((2064, 2048)), "tab")
    with pytest.raises(ValueError, match=r"data must have the shape of the detector, \(2064, 2048"):
        calibration.to_ccddata(np.zeros((10, 10)))


def test_without_a_shape():
    """What a header without NAXIS gave has a polynomial, and no deviation to tell."""
    whole = make_calibration(table=None)
    solution = whole.solution.__class__(
        **{**whole.solution.__dict__, "image_shape": None, "table_sigma": None}
    )
    plain = Calibration("a", solution, crval=whole.crval, cd=whole.cd)
    header = plain.to_header()
    assert "NAXIS1" not in header
    assert "WPDCDEV" not in header
    found = plain.to_astropy_wcs().pixel_to_world(5.0, 6.0)
    assert found.separation(plain.wcs.pixel_to_world(5.0, 6.0)) < 1e-6 * u.arcsec
