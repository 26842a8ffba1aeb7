"""The WCS object in other packages: reproject, drizzle, stcal and tweakwcs, beside a known sky.

Prints, for each of them, how far its answer is from the one that it must give, and ends with status
1 if one is too far off or fails.  ``wcs_outside.py`` does the same for FITS headers.
"""

import argparse
import sys
from importlib.metadata import version

import numpy as np
from astropy.table import Table
from astropy.wcs import WCS

from wpdc_gwcs import PVPolynomial, build_wcs

SHAPE = (256, 256)
CD = 5e-5 * np.diag([-1.0, 1.0])
CRVAL = (150.0, 30.0)
# A distortion of 20 px at the corners: not one of these packages could ignore it unseen.
PV = PVPolynomial(pv1_7=3000.0, pv2_7=3000.0)


def make_wcs(crval=CRVAL, **options):
    middle = ((SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2)
    return build_wcs(crpix=middle, cd=CD, crval=crval, pv=PV, image_shape=SHAPE, **options)


def make_target():
    """TAN without distortion, for the same sky."""
    target = WCS(naxis=2)
    target.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    target.wcs.crval = CRVAL
    target.wcs.crpix = [(n + 1) / 2 for n in SHAPE[::-1]]
    target.wcs.cd = CD
    target.array_shape = SHAPE
    return target


def sky_error(wcs, truth):
    """Greatest distance of two WCSs on a grid, px."""
    x, y = np.meshgrid(np.linspace(0, SHAPE[1] - 1, 9), np.linspace(0, SHAPE[0] - 1, 9))
    separation = wcs.pixel_to_world(x, y).separation(truth.pixel_to_world(x, y))
    return float(separation.deg.max() / abs(CD[1, 1]))


def try_reproject():
    """An image whose value is its own x comes out as x of each output pixel."""
    from reproject import reproject_interp

    wcs, target = make_wcs(), make_target()
    image = np.broadcast_to(np.arange(SHAPE[1], dtype=float), SHAPE).copy()
    made, _ = reproject_interp((image, wcs), target, shape_out=SHAPE)
    y, x = np.indices(SHAPE)
    expected, _ = wcs.world_to_pixel(target.pixel_to_world(x, y))
    return float(np.nanmax(np.abs(made - expected))), 1e-6


def try_drizzle():
    """The map of pixels that drizzle makes is that of the two WCSs."""
    from drizzle.utils import calc_pixmap

    wcs, target = make_wcs(), make_target()
    pixmap = calc_pixmap(wcs, target)
    y, x = np.indices(SHAPE)
    expected = np.stack(target.world_to_pixel(wcs.pixel_to_world(x, y)), axis=-1)
    return float(np.nanmax(np.abs(pixmap - expected))), 1e-6


def try_stcal():
    """The footprint has the corners of the detector."""
    from stcal.alignment.util import compute_s_region_keyword

    wcs = make_wcs()
    footprint = wcs.footprint(center=False)
    numbers = compute_s_region_keyword(footprint).split()[2:]
    x, y = wcs.invert(*np.array(numbers, float).reshape(-1, 2).T, with_bounding_box=False)
    low, (right, top) = -0.5, np.array(SHAPE[::-1]) - 0.5
    corners = [(low, low), (low, top), (right, top), (right, low)]
    # The keyword has nine decimals of a degree.
    return float(np.abs(np.column_stack([x, y]) - corners).max()), 1e-3


def try_tweakwcs():
    """A pointing that is off by some pixels is corrected."""
    from tweakwcs import JWSTWCSCorrector, XYXYMatch, align_wcs

    truth = make_wcs()
    off = (CRVAL[0] + 2e-4, CRVAL[1] - 1.5e-4)
    wcs = make_wcs(off, v2v3=(120.0, -496.0, 0.0))
    x, y = np.random.default_rng(1).uniform(5, SHAPE[0] - 6, (2, 60))
    ra, dec = truth(x, y)
    corrector = JWSTWCSCorrector(
        wcs,
        {"v2_ref": 120.0, "v3_ref": -496.0, "roll_ref": 0.0},
        meta={"catalog": Table({"x": x, "y": y}), "name": "a"},
    )
    match = XYXYMatch(searchrad=5.0, separation=0.1, tolerance=1.0)
    align_wcs([corrector], refcat=Table({"RA": ra, "DEC": dec}), match=match, fitgeom="rshift")
    return sky_error(corrector.wcs, truth), 0.01


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.parse_args()
    failed = False
    print(f"{'package':24} {'error px':>10} {'allowed':>8}")
    for name, attempt in (
        ("reproject", try_reproject),
        ("drizzle", try_drizzle),
        ("stcal", try_stcal),
        ("tweakwcs", try_tweakwcs),
    ):
        error, allowed = attempt()
        good = error < allowed
        failed |= not good
        label = f"{name} {version(name)}"
        print(f"{label:24} {error:10.2g} {allowed:8.0e} {'' if good else 'FAILED'}")
    sys.exit(int(failed))


if __name__ == "__main__":
    main()
