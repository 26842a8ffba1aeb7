"""Which frames are taken as one exposure."""

import numpy as np
import pytest
from astropy.wcs import WCS

from wpdc_gwcs.calibration.exposures import tie_exposures
from wpdc_gwcs.exceptions import WPDCWarning
from wpdc_gwcs.frame import Frame

SCALE = 1e-4


def make(detector, exposure="7", *, ra=150.0, start=57388.5, camera="C", file=None):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.cd = SCALE * np.diag([-1.0, 1.0])
    wcs.wcs.crpix, wcs.wcs.crval = [500.5, 500.5], [ra, 0.0]
    source = f"{detector}.fits" if file is None else f"{file}[{detector}]"
    meta = {} if start is None else {"start": start}
    return Frame(
        source, detector, (1000, 1000), wcs, source=source, exposure=exposure, camera=camera,
        meta=meta, load_image=lambda: None,
    )  # fmt: skip


def exposures(frames):
    return [f.exposure for f in tie_exposures(frames)]


def test_detectors_of_one_exposure_stay_together():
    # 14 diagonals of 0.141 deg lie between the outermost detectors of the largest camera
    frames = [make("A"), make("B", ra=152.0), make("A", "8"), make("B", "8", ra=152.0)]
    assert tie_exposures(frames) == frames
    assert exposures([make("A", None), make("A", None)]) == [None, None]
    assert exposures([make("A", camera=None), make("A", camera=None)]) == ["7", "7"]


def test_one_identifier_of_several_exposures():
    second, minute = 1 / 86400, 1 / 1440
    frames = [
        make("A"),
        make("A", start=57388.5 + minute),
        make("B", start=57388.5 + minute + second),
        make("B", start=57388.5 + second),
    ]
    assert exposures(frames) == ["7", "7#2", "7#2", "7"]


def test_one_detector_cannot_be_in_an_exposure_twice():
    with pytest.warns(WPDCWarning, match="3 frames of camera C .* include a detector twice"):
        assert exposures([make("A"), make("B"), make("A"), make("A", "8")]) == [None] * 3 + ["8"]


def test_files_and_tangent_points_tell_exposures_of_one_key_apart():
    frames = [make(d, file=f, start=None) for f in ("x.fits", "y.fits") for d in "AB"]
    assert exposures(frames) == ["7", "7", "7#2", "7#2"]
    frames = [make(d, ra=ra) for d in "AB" for ra in (150.0, 150.01)]
    assert exposures(frames) == ["7", "7#2"] * 2


def test_detectors_that_point_elsewhere_are_another_exposure():
    frames = [make("A"), make("B", ra=170.0), make("C", ra=150.1), make("A", ra=170.1)]
    with pytest.warns(WPDCWarning, match="point to different parts of the sky"):
        assert exposures(frames) == ["7", "7#2", "7", "7#2"]
