"""Real headers of 90Prime as the truth of simulations, and SCAMP beside."""

import shutil
from dataclasses import replace

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from wpdc_gwcs.exceptions import WPDCError
from wpdc_gwcs.reproduction import reproduce_bass
from wpdc_gwcs.reproduction.headers import chip_distortion, find_headers, header_camera
from wpdc_gwcs.reproduction.scale import QUICK
from wpdc_gwcs.reproduction.scamp import has_scamp, solve_with_scamp
from wpdc_gwcs.simulation import Distortion, simulate

# A TPV header of the kind of 90Prime's cut-outs: y towards the west, the reference point beyond the
# upper left corner, some 15 px of distortion over a chip.
CARDS = {
    "NAXIS": 0, "CTYPE1": "RA---TPV", "CTYPE2": "DEC--TPV", "CUNIT1": "deg", "CUNIT2": "deg",
    "CRPIX1": -150.5, "CRPIX2": 700.0, "CRVAL1": 30.0, "CRVAL2": 20.0,
    "CD1_1": -1.1e-6, "CD1_2": -1.258e-4, "CD2_1": -1.257e-4, "CD2_2": 6e-7,
    "PV1_0": 1e-5, "PV1_1": 1.0002, "PV1_4": 4e-4, "PV1_5": -2e-4, "PV1_7": 1.4e-2, "PV1_9": 1.2e-2,
    "PV2_0": -2e-5, "PV2_1": 0.9999, "PV2_2": 1e-4, "PV2_6": 3e-4, "PV2_7": 1.3e-2, "PV2_9": 1.5e-2,
}  # fmt: skip


@pytest.fixture
def header(tmp_path, monkeypatch):
    folder = tmp_path / "wcs_headers" / "legacysurvey" / "90prime"
    folder.mkdir(parents=True)
    monkeypatch.setenv("WPDC_GWCS_DATA", str(tmp_path))
    fits.PrimaryHDU(header=fits.Header(CARDS)).writeto(folder / "night-ccd2.fits")
    return folder / "night-ccd2.fits"


def test_headers_are_where_the_variable_says(header, monkeypatch):
    assert find_headers() == [header]
    monkeypatch.delenv("WPDC_GWCS_DATA")
    assert find_headers() == []


def test_distortion_of_a_header_against_astropy(header):
    distortion, crpix, degree = chip_distortion(header)
    assert degree == 3
    # Beyond the upper left corner of 4032 x 4096 px.
    np.testing.assert_array_equal(crpix, [-184, 4156])
    cards = {**CARDS, "NAXIS": 2, "CRPIX1": -183.0, "CRPIX2": 4157.0}
    truth = WCS(fits.Header(cards))
    linear = WCS(naxis=2)
    linear.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    for name in ("crpix", "crval", "cd"):
        setattr(linear.wcs, name, getattr(truth.wcs, name))
    x, y = np.random.default_rng(1).uniform(0, 4000, (2, 200))
    expected = linear.wcs_world2pix(*truth.all_pix2world(x, y, 0), 0)
    found = distortion.undistort(x, y)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert 5 < np.hypot(*np.subtract(found, [x, y])).max() < 60
    np.testing.assert_allclose(distortion.distort(*found), [x, y], atol=1e-8)


def test_camera_of_a_header(header):
    camera, degree = header_camera(header)
    (chip,) = camera.detectors
    assert (degree, chip.name, chip.image_shape) == (3, "night-ccd2", (4096, 4032))
    (exposure,) = simulate(1, camera=camera, density=0.1).exposures
    assert [exposure.header[f"CRPIX{i}"] for i in (1, 2)] == [-183, 4157]


def test_map_that_is_no_polynomial():
    with pytest.raises(ValueError, match="must be a polynomial of degree 3, is .* px off one"):
        Distortion.from_map((100, 100), lambda x, y: (x + np.sin(x / 20), y), degree=3)


def test_real_headers_are_reproduced(header, tmp_path):
    bass = {"image_shape": (300, 300), "distortion": 3.0, "density": 150.0}
    scale = replace(QUICK, n_bass=2, r0_bass=140.0, bass=bass)
    results = reproduce_bass(tmp_path, scale, seed=3)
    numbers = {(r["item"], r["quantity"]): (r["literal"], r["ours"]) for r in results}
    assert numbers["night-ccd2", "degree"] == (3, 3)
    # The header is a cubic: the default needs no table to follow it.  454 mas to the pixel.
    for axis, limit in (("alpha", 5.5), ("delta", 10.0)):
        for item in ("night-ccd2", "night-ccd2 cubic"):
            assert numbers[item, f"wcs_{axis}"][1] < limit
    assert not any(item == "scamp" for item, _ in numbers)


def small_chip():
    return simulate(
        1, camera="bass-90prime", detectors=["CCD1"], seed=2, image_shape=(1500, 1500),
        distortion=3.0, density=3.0, proper_motion=30 * u.mas / u.yr,
    )  # fmt: skip


def test_without_scamp(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert not has_scamp()
    with pytest.raises(WPDCError, match="scamp must be installed"):
        solve_with_scamp(small_chip(), degree=3)


def test_scamp_that_gives_nothing(monkeypatch, tmp_path):
    program = tmp_path / "scamp"
    program.write_text("#!/bin/sh\necho 'no luck' >&2\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(WPDCError, match="must give a header for each list, gave: no luck"):
        solve_with_scamp(small_chip(), degree=3)


@pytest.mark.skipif(shutil.which("scamp") is None, reason="SCAMP is not installed")
def test_scamp_solves_what_is_easy_for_it():
    simulation = small_chip()
    solved = solve_with_scamp(simulation, degree=3)
    (exposure,) = simulation.exposures
    _, _, dx, dy = exposure.wcs_error(solved[exposure.name])
    # A distortion of 3 px is nearly a cubic; at 2017.33 motions of 40 mas would show as 0.1 px.
    assert np.sqrt(np.mean(dx**2 + dy**2)) < 0.1
