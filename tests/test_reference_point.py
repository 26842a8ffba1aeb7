"""Reference points off the detector are moved onto it, exactly, whatever the projection."""

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable
from astropy.wcs import WCS

from wpdc_gwcs import calibrate, read_catalog
from wpdc_gwcs.calibration import Settings
from wpdc_gwcs.calibration.start import header_reference_point, linear_wcs
from wpdc_gwcs.frame import Frame

SHAPE = (2048, 2000)

# 0.45 arcsec / px, turned by 12 degrees, the reference point beyond a corner.
CD = 1.26e-4 * np.array([[-0.978, 0.208], [0.208, 0.978]])
CRPIX = (2184.0, -60.0)
CRVAL = (352.1, 33.4)


def header(projection, **cards):
    h = fits.Header()
    h["CTYPE1"], h["CTYPE2"] = f"RA---{projection}", f"DEC--{projection}"
    h["CUNIT1"] = h["CUNIT2"] = "deg"
    h["CRPIX1"], h["CRPIX2"] = CRPIX
    h["CRVAL1"], h["CRVAL2"] = CRVAL
    for i in (0, 1):
        for j in (0, 1):
            h[f"CD{i + 1}_{j + 1}"] = CD[i, j]
    h["RADESYS"] = "ICRS"
    h.update(cards)
    return h


CUBIC = {
    "PV1_0": 2e-4, "PV1_1": 1.012, "PV1_2": -3e-3, "PV1_4": 8e-3, "PV1_5": -5e-3, "PV1_6": 3e-3,
    "PV1_7": -0.03, "PV1_8": 0.01, "PV1_9": -0.03, "PV1_10": 0.005,
    "PV2_0": -1e-4, "PV2_1": 1.009, "PV2_2": 2e-3, "PV2_4": -6e-3, "PV2_5": 4e-3, "PV2_6": 2e-3,
    "PV2_7": -0.03, "PV2_8": -0.004, "PV2_9": -0.03, "PV2_10": 0.008,
}  # fmt: skip
SIP = {
    "A_ORDER": 3, "B_ORDER": 3, "A_2_0": 3e-7, "A_1_1": -2e-7, "A_3_0": 4e-11, "A_1_2": 5e-11,
    "B_0_2": -3e-7, "B_1_1": 1e-7, "B_0_3": 6e-11, "B_2_1": 4e-11,
}  # fmt: skip
PROJECTIONS = {
    "TAN": header("TAN"),
    "TPV": header("TPV", **CUBIC),
    "TAN-SIP": header("TAN-SIP", **SIP),
    "SIN": header("SIN"),
    "STG": header("STG"),
    "ARC": header("ARC"),
    "ZEA": header("ZEA"),
    "ZPN": header("ZPN", PV2_1=1.0, PV2_3=20.0),
    "turned": header("TAN", LONPOLE=150.0),
}


def local_frame(wcs, crpix):
    """Sky and CD at a pixel, from astropy alone: TAN about it, derivatives by Richardson."""
    crval = np.array(wcs.all_pix2world(*crpix, 0))
    plane = WCS(naxis=2)
    plane.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    plane.wcs.crval, plane.wcs.crpix = crval, [0, 0]
    plane.wcs.cdelt = [1, 1]

    def slope(h):
        x, y = crpix[0] + np.array([h, -h, 0, 0]), crpix[1] + np.array([0, 0, h, -h])
        xi, eta = plane.wcs_world2pix(*wcs.all_pix2world(x, y, 0), 0)
        return np.array([[xi[0] - xi[1], xi[2] - xi[3]], [eta[0] - eta[1], eta[2] - eta[3]]]) / (
            2 * h
        )

    return crval, (4 * slope(4.0) - slope(8.0)) / 3


@pytest.mark.parametrize("name", PROJECTIONS)
def test_anchored_wcs_is_exact_at_its_point(name):
    wcs = WCS(PROJECTIONS[name])
    for crpix in (np.array([999.5, 1023.5]), np.array([37.25, 1801.75])):
        found = linear_wcs(wcs, crpix)
        crval, cd = local_frame(wcs, crpix)
        np.testing.assert_allclose(found.crpix, crpix, rtol=0, atol=0)
        np.testing.assert_allclose(found.crval, crval, rtol=0, atol=1e-9)
        np.testing.assert_allclose(found.cd, cd, rtol=0, atol=1e-12)


def frame_of(wcs, sources, **changes):
    return Frame(
        name="e", detector="ccd", image_shape=SHAPE, wcs=wcs, source="e",
        load_sources=lambda: sources, **changes,
    )  # fmt: skip


@pytest.mark.parametrize("name", ["TPV", "TAN-SIP"])
@pytest.mark.parametrize("where", ["nearest-source", "center", "header"])
def test_solution_is_anchored_on_the_detector(name, where):
    """Noise-free stars: CRPIX is the chosen point, CRVAL and CD those of the header there."""
    truth = WCS(PROJECTIONS[name])
    rng = np.random.default_rng(4)
    x, y = rng.uniform(-0.5, 1999.5, 1200), rng.uniform(-0.5, 2047.5, 1200)
    ra, dec = truth.all_pix2world(x, y, 0)
    flux = 10 ** rng.uniform(2, 5, x.size)
    catalog = QTable({"ra": ra, "dec": dec})
    catalog["ra"].unit = catalog["dec"].unit = "deg"
    start = header(name, **(CUBIC if name == "TPV" else SIP))
    start["CRVAL1"] += 0.001
    frame = frame_of(WCS(start), QTable({"x": x, "y": y, "flux": flux}))
    np.testing.assert_allclose(header_reference_point(frame), [999.5, 1023.5])
    settings = Settings(reference_point=where, r0=1200.0, lut="none")
    run = calibrate(frame, read_catalog(catalog), settings=settings)
    calibration = run.calibrations[0]
    crpix = calibration.solution.crpix
    nearest = np.argmin(np.hypot(x - 999.5, y - 1023.5))
    expected = [x[nearest], y[nearest]] if where == "nearest-source" else [999.5, 1023.5]
    np.testing.assert_allclose(crpix, expected, rtol=0, atol=1e-12)
    crval, cd = local_frame(truth, crpix)
    # A cubic about one point is one about another but for the change of the tangent plane, whose
    # quartic term is 1e-3 px here.
    scale = 1.26e-4
    np.testing.assert_allclose(calibration.crval, crval, rtol=0, atol=2e-3 * scale)
    np.testing.assert_allclose(calibration.cd, cd, rtol=0, atol=1e-5 * scale)
    gx, gy = (a.ravel() for a in np.meshgrid(np.linspace(0, 1999, 30), np.linspace(0, 2047, 30)))
    true, found = truth.all_pix2world(gx, gy, 0), calibration.wcs(gx, gy)
    error = np.array(found) - true
    assert np.sqrt(np.mean(np.sum(error**2, axis=0))) / scale < 5e-3
