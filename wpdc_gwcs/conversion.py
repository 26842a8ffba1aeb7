"""Conversion of any WCS of an image: a polynomial and a look-up table are fitted to it.

::

    any WCS --pixels to ICRS--> tangent plane --polynomial, table of the rest--> Calibration
"""

import warnings

import numpy as np
from astropy.coordinates import SkyCoord
from astropy.wcs.wcsapi import HighLevelWCSWrapper

from wpdc_gwcs.detector import UNNAMED
from wpdc_gwcs.exceptions import WPDCWarning
from wpdc_gwcs.export import deviation
from wpdc_gwcs.frozen import with_statistics
from wpdc_gwcs.models import LookupTable, PVPolynomial, project, pv_terms
from wpdc_gwcs.models.powers import fit_polynomial, shift_origin
from wpdc_gwcs.solution import Calibration, DistortionSolution

__all__ = ["fit_wcs"]

# A polynomial of this accuracy (px) needs no table; a table of this accuracy no more nodes.
_ENOUGH_PX = 1e-4
_TABLE_ENOUGH_PX = 5e-4
# A larger deviation than this (px) causes a warning.
_TOLERANCE_PX = 1e-3
_FIT_POINTS = 64
# Numbers of nodes along each axis of the table, tried in turn.
_TABLE_NODES = (50, 99, 197, 393)


def fit_wcs(wcs, *, image_shape=None, detector=UNNAMED, frame="converted"):
    """Fit a polynomial and a look-up table to any celestial WCS.

    Parameters
    ----------
    wcs : APE 14 WCS, or ``starlink.Ast.FrameSet``
        WCS from two pixel axes to the sky: a `gwcs.wcs.WCS` of any models, an `astropy.wcs.WCS`
        with SIP, look-up tables or ``-TAB``, any other WCS with the shared interface of Astropy, or
        an AST frame set from a grid to a sky frame.
    image_shape : (int, int), optional
        Shape of the image, (ny, nx); by default that of the WCS.
    detector, frame : str, optional
        Names of the detector and of the frame.

    Returns
    -------
    calibration : Calibration
        Calibration with the fast WCS; ``statistics["conversion_deviation"]`` is the largest
        deviation from ``wcs`` over the image, px.

    Raises
    ------
    TypeError
        If it is not such a WCS.
    ValueError
        If the shape is unknown, the axes are not two of pixels and the sky, or the WCS has no value
        somewhere on the image.

    Warns
    -----
    WPDCWarning
        If the deviation is more than 1e-3 px.

    Notes
    -----
    The tangent point is the sky position of the center of the image, or that of the WCS itself if
    it is a TAN WCS of astropy.  If a polynomial of degree 3 or less is accurate enough, there is no
    table; otherwise a cubic gets a table of 50 x 50 nodes, or more if needed.  Positions are
    converted to ICRS.  If the bounding box is smaller than the image, the WCS is used beyond it.

    Examples
    --------
    >>> from astropy.wcs import WCS
    >>> from wpdc_gwcs import fit_wcs
    >>> wcs = WCS(naxis=2)
    >>> wcs.wcs.ctype, wcs.wcs.cdelt = ["RA---ZEA", "DEC--ZEA"], [-1e-4, 1e-4]
    >>> wcs.wcs.crval, wcs.wcs.crpix = [10.0, 20.0], [100.0, 100.0]
    >>> calibration = fit_wcs(wcs, image_shape=(200, 200))
    >>> calibration.statistics["conversion_deviation"] < 1e-3
    True
    >>> ra, dec = calibration.wcs(99.0, 99.0)
    >>> round(float(ra), 8), round(float(dec), 8)
    (10.0, 20.0)
    """
    sky = _sky_function(wcs)
    shape = _image_shape(wcs, image_shape)
    ny, nx = shape
    crpix, crval = _reference(wcs, sky, shape)
    t = np.cos(np.pi * (np.arange(_FIT_POINTS) + 0.5) / _FIT_POINTS)
    x, y = np.meshgrid(0.5 * (nx - 1) + 0.5 * nx * t, 0.5 * (ny - 1) + 0.5 * ny * t)
    pixels = np.array([x.ravel(), y.ravel()]) - crpix[:, np.newaxis]
    plane = _plane(sky, pixels + crpix[:, np.newaxis], crval)
    linear = shift_origin(*fit_polynomial(pixels, plane, 1))
    cd = np.column_stack([linear[:, 1, 0], linear[:, 0, 1]])

    def calibration(pv, table=None):
        solution = DistortionSolution(detector, shape, crpix, cd, crval, pv, lookup_table=table)
        return Calibration(frame, solution, crval, cd)

    for degree in (1, 2, 3):
        found = calibration(_fit_pv(cd @ pixels, plane, degree))
        worst = deviation(found, sky)
        if worst <= _ENOUGH_PX:
            break
    else:
        found, worst = _with_table(found, sky, calibration)
    if not worst <= _TOLERANCE_PX:
        warnings.warn(
            f"{frame}: the converted WCS deviates by up to {worst:.2g} px from the given one",
            WPDCWarning,
        )
    return with_statistics(found, conversion_deviation=worst)


def _with_table(found, sky, calibration):
    """Return a cubic with a table of its residuals, with as many nodes as needed."""
    pv, (ny, nx) = found.solution.pv, found.solution.image_shape
    crpix, cd = (np.asarray(v) for v in (found.solution.crpix, found.cd))
    best = None
    for n in _TABLE_NODES:
        nodes = [np.linspace(-0.5, size - 0.5, n) for size in (nx, ny)]
        x, y = (v.ravel() for v in np.meshgrid(*nodes))
        plane = _plane(sky, np.array([x, y]), found.crval)
        offset = cd @ (np.array([x, y]) - crpix[:, np.newaxis])
        dx, dy = np.linalg.solve(cd, np.array(pv(*offset)) - plane).reshape(2, n, n)
        trial = calibration(pv, LookupTable(*nodes, dx, dy))
        worst = deviation(trial, sky)
        if best is None or worst < best[1]:
            best = trial, worst
        if worst <= _TABLE_ENOUGH_PX:
            break
    return best


def _fit_pv(u, plane, degree):
    polynomial = shift_origin(*fit_polynomial(u, plane, degree))
    terms = pv_terms(degree)
    return PVPolynomial.from_coefficients(
        np.array([polynomial[0, terms.own, terms.other], polynomial[1, terms.other, terms.own]]),
        degree=degree,
    )


def _plane(sky, pixels, crval):
    plane = np.array(project(*sky(*pixels), crval))
    bad = ~np.isfinite(plane).all(axis=0)
    if bad.any():
        x, y = pixels[:, np.argmax(bad)]
        raise ValueError(
            "wcs must have a value everywhere on the image, within 90 deg of its center; it has "
            f"none at x {x:.1f}, y {y:.1f}"
        )
    return plane


def _image_shape(wcs, image_shape):
    if image_shape is None:
        image_shape = getattr(wcs, "array_shape", None)
    bounds = getattr(wcs, "pixel_bounds", None)
    if image_shape is None and bounds is not None and None not in bounds:
        image_shape = [round(high + 0.5) for _, high in bounds[::-1]]
    if image_shape is None:
        raise ValueError("image_shape must be given: the WCS does not know its shape")
    shape = tuple(int(n) for n in image_shape)
    if len(shape) != 2 or min(shape) < 2:
        raise ValueError(f"image_shape must be two numbers of 2 or more, not {shape}")
    return shape


def _reference(wcs, sky, shape):
    """Return reference pixel and tangent point: those of the WCS if its polynomials use them."""
    own = getattr(wcs, "wcs", None)
    if hasattr(own, "ctype") and all(c[4:].strip("-")[:3] in ("TAN", "TPV") for c in own.ctype):
        crpix = np.array(own.crpix, float) - 1.0
    else:
        crpix = 0.5 * (np.array(shape[::-1]) - 1.0)
    crval = np.array(sky(*crpix[:, np.newaxis]), float)[:, 0]
    if not np.isfinite(crval).all():
        crpix = 0.5 * (np.array(shape[::-1]) - 1.0)
        crval = np.array(sky(*crpix[:, np.newaxis]), float)[:, 0]
    if not np.isfinite(crval).all():
        raise ValueError("wcs must have a value at the center of the image, has none")
    return crpix, crval


def _sky_function(wcs):
    """Return a function of pixels that returns ICRS in deg."""
    if hasattr(wcs, "tran") and hasattr(wcs, "Nin"):
        return _sky_of_ast(wcs)
    if hasattr(wcs, "low_level_wcs"):
        wcs = wcs.low_level_wcs
    if not hasattr(wcs, "pixel_to_world_values"):
        raise TypeError(
            "wcs must have the shared interface of Astropy (APE 14) or be a FrameSet of AST, "
            f"got {type(wcs).__name__}"
        )
    if (wcs.pixel_n_dim, wcs.world_n_dim) != (2, 2):
        raise ValueError(
            "wcs must have two pixel axes and two of the sky, got "
            f"{wcs.pixel_n_dim} and {wcs.world_n_dim}"
        )
    wrapper = wcs if hasattr(wcs, "pixel_to_world") else HighLevelWCSWrapper(wcs)
    classes = wcs.world_axis_object_classes
    if len(classes) != 1 or next(iter(classes.values()))[0] not in (SkyCoord, "SkyCoord"):
        raise ValueError(
            f"wcs must lead to the sky, got the axes {list(wcs.world_axis_physical_types)}"
        )
    unbounded = getattr(wcs, "bounding_box", None) is not None

    def sky(x, y):
        if unbounded:
            box, wcs.bounding_box = wcs.bounding_box, None
        try:
            found = wrapper.pixel_to_world(x, y)
        finally:
            if unbounded:
                wcs.bounding_box = box
        found = found.icrs
        return found.ra.deg, found.dec.deg

    return sky


def _sky_of_ast(frames):
    frames = frames.copy()
    is_sky = frames.getframe(frames.Current).isaskyframe()
    if (frames.Nin, frames.Nout) != (2, 2) or not is_sky:
        raise ValueError("wcs must be a FrameSet of AST from two grid axes to the sky")
    frames.set("System=ICRS")
    lon = int(frames.get("LonAxis")) - 1

    def sky(x, y):
        # AST counts from one, uses radians, and has its own order of axes.
        world = np.degrees(frames.tran(np.array([x, y], float) + 1.0))
        return world[lon] % 360.0, world[1 - lon]

    return sky
