"""The exact WCS: exports are made from it and compared with it."""

import warnings
from typing import NamedTuple

import numpy as np
from astropy.io import fits
from astropy.wcs import WCS

from wpdc_gwcs.exceptions import FileFormatError
from wpdc_gwcs.models import project

__all__ = [
    "ExactWCS",
    "astropy_sky",
    "astropy_wcs",
    "description",
    "deviation",
    "image_shape_of",
    "require_shape",
    "sample_plane",
]


class ExactWCS(NamedTuple):
    """Instrument, matrix (deg / px), reference point (deg) and name of what is exported."""

    solution: object
    cd: np.ndarray
    crval: np.ndarray
    frame: str


def description(obj):
    """Return instrument and attitude of a calibration, or of a solution at its nominal pointing.

    Parameters
    ----------
    obj : Calibration or DistortionSolution
        What is exported.

    Returns
    -------
    exact : ExactWCS
        Instrument, matrix, reference point and name.

    Raises
    ------
    TypeError
        If the object is neither of these.
    """
    solution = getattr(obj, "solution", obj)
    if not all(hasattr(solution, name) for name in ("crpix", "pv", "lookup_table")):
        raise TypeError(f"must be a Calibration or a DistortionSolution, got {type(obj).__name__}")
    return ExactWCS(solution, np.asarray(obj.cd), np.asarray(obj.crval), getattr(obj, "frame", ""))


def image_shape_of(obj):
    """Return the shape of the detector, (ny, nx), or `None` if it is unknown.

    Parameters
    ----------
    obj : Calibration or DistortionSolution
        What is exported.

    Returns
    -------
    shape : (int, int) or None
        The stated shape, or else the one that the nodes of the table span.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs import DistortionSolution, LookupTable, PVPolynomial
    >>> from wpdc_gwcs.export import image_shape_of
    >>> cd, crpix, crval = np.diag([-8e-5, 8e-5]), np.array([49.5, 99.5]), np.array([10.0, 45.0])
    >>> table = LookupTable(np.linspace(-0.5, 99.5, 5), np.linspace(-0.5, 199.5, 5),
    ...                     np.zeros((5, 5)), np.zeros((5, 5)))
    >>> solution = DistortionSolution("d1", None, crpix, cd, crval, PVPolynomial(), table)
    >>> image_shape_of(solution)
    (200, 100)
    """
    shape, table = description(obj).solution.image_shape, obj.lookup_table
    if shape is None and table is not None:
        return tuple(round(grid[-1] - grid[0]) for grid in (table.y_grid, table.x_grid))
    return shape


def require_shape(obj):
    """Return the shape of the detector, for formats that are fitted over it.

    Parameters
    ----------
    obj : Calibration or DistortionSolution
        What is exported.

    Returns
    -------
    shape : (int, int)
        Shape ``(ny, nx)``, as from `image_shape_of`.

    Raises
    ------
    FileFormatError
        If the shape is unknown.
    """
    shape = image_shape_of(obj)
    if shape is None:
        raise FileFormatError("the shape of the detector must be known for this format, is unknown")
    return shape


def deviation(obj, sky, *, n=401):
    """Compute the greatest distance of another WCS from the exact one.

    Parameters
    ----------
    obj : Calibration or DistortionSolution
        Object with the exact WCS.
    sky : callable
        Other WCS: ``sky(x, y)`` returns RA and Dec in deg of zero-based pixels.
    n : int, optional
        Number of points along each side of the grid, which runs from edge to edge.

    Returns
    -------
    deviation : float
        Greatest distance in undistorted pixels; infinite if the other WCS returns NaN anywhere.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs import DistortionSolution, PVPolynomial
    >>> from wpdc_gwcs.export import deviation
    >>> from wpdc_gwcs.models import TangentSky
    >>> cd, crpix, crval = np.diag([-8e-5, 8e-5]), np.array([511.5, 511.5]), np.array([10.0, 45.0])
    >>> shifted = PVPolynomial(pv1_0=1.6e-4)  # by 2 px
    >>> solution = DistortionSolution("d1", (1024, 1024), crpix, cd, crval, shifted)
    >>> round(deviation(solution, TangentSky(crpix, cd, crval)), 6)
    2.0
    """
    exact = description(obj)
    ny, nx = require_shape(obj)
    x, y = np.meshgrid(np.linspace(-0.5, nx - 0.5, n), np.linspace(-0.5, ny - 0.5, n))
    x, y = x.ravel(), y.ravel()
    places = np.array(obj.undistort(x, y))
    plane = np.array(project(*sky(x, y), exact.crval))
    other = np.linalg.solve(exact.cd, plane) + np.asarray(exact.solution.crpix)[:, None]
    distance = np.hypot(*(other - places))[np.isfinite(places).all(axis=0)]
    return float(np.where(np.isfinite(distance), distance, np.inf).max(initial=0.0))


def astropy_wcs(header, tables=()):
    """Return the `~astropy.wcs.WCS` of a header.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        The keywords.
    tables : sequence of HDU, optional
        Extensions that belong to them.

    Returns
    -------
    wcs : `~astropy.wcs.WCS`
        The WCS, its tables included.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return WCS(header, fits.HDUList([fits.PrimaryHDU(), *tables]))


def astropy_sky(header, tables=()):
    """Return the WCS of a header as a function of zero-based pixels, evaluated by astropy.wcs.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        The keywords.
    tables : sequence of HDU, optional
        Extensions that belong to them.

    Returns
    -------
    sky : callable
        ``sky(x, y) -> ra, dec``.
    """
    wcs = astropy_wcs(header, tables)

    def sky(x, y):
        return wcs.all_pix2world(x, y, 0)

    return sky


def sample_plane(obj):
    """Return pixels all over the detector and their positions on the tangent plane, for a fit.

    Parameters
    ----------
    obj : Calibration or DistortionSolution
        What is exported.

    Returns
    -------
    pixels, plane : (2, N) ndarray
        Zero-based pixels; standard coordinates, deg.
    """
    exact = description(obj)
    ny, nx = require_shape(obj)
    # With Chebyshev points, least squares nearly minimizes the greatest error.
    t = np.cos(np.pi * (np.arange(64) + 0.5) / 64)
    x, y = np.meshgrid(0.5 * (nx - 1) + 0.5 * nx * t, 0.5 * (ny - 1) + 0.5 * ny * t)
    x, y = x.ravel(), y.ravel()
    places = np.array(obj.undistort(x, y)) - np.asarray(exact.solution.crpix)[:, None]
    return np.array([x, y]), exact.cd @ places
