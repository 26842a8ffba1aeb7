"""Residuals of a frame about an instrument, with only the attitude free.

::

    residuals of a calibration --map of its own?--> positions of its stars --fit_attitude--> new
              '--same map, field------------------> field added back, minus its linear part -> new
"""

import numpy as np

from wpdc_gwcs.fitting import fit_attitude
from wpdc_gwcs.models import deproject

__all__ = ["has_map_of", "residuals_of_attitude"]

# Minimum number of stars to fit the six numbers of an attitude and have some to spare.
_LEAST_STARS = 8

# Maps of a detector that differ by less are the same, px: more than rounding, and less than any
# change that the stars of a survey can show.
_SAME_PX = 1e-4

# Points along each side of the detector at which maps are compared: closer than the waves of a
# table.
_POINTS = 65


def has_map_of(calibration, solution):
    """Return whether a frame was calibrated with the map of a solution.

    Parameters
    ----------
    calibration : Calibration
        Calibration of the frame.
    solution : DistortionSolution
        Solution of the same detector.

    Returns
    -------
    bool
        True if the undistorted pixels of both, by polynomial and table and without the field of the
        frame, are a linear map of each other to 1e-4 px all over the detector.

    Examples
    --------
    >>> from dataclasses import replace
    >>> import numpy as np
    >>> from wpdc_gwcs import Calibration, DistortionSolution, PVPolynomial
    >>> from wpdc_gwcs.evaluation import has_map_of
    >>> cd, crpix, crval = np.diag([-2e-5, 2e-5]), np.array([499.5, 499.5]), np.array([10.0, 20.0])
    >>> solution = DistortionSolution("d", (1000, 1000), crpix, cd, crval, PVPolynomial())
    >>> frame = Calibration("a", solution, crval=crval, cd=cd)
    >>> has_map_of(frame, solution), has_map_of(frame, replace(solution, pv=PVPolynomial(pv1_7=9)))
    (True, False)
    """
    own = calibration.solution
    ny, nx = solution.image_shape
    x, y = (
        c.ravel()
        for c in np.meshgrid(
            np.linspace(-0.5, nx - 0.5, _POINTS), np.linspace(-0.5, ny - 0.5, _POINTS)
        )
    )
    mine, other = np.array(own.undistort(x, y)), np.array(solution.undistort(x, y))
    rows = np.stack([np.ones_like(x), *mine], axis=1)
    rest = other.T - rows @ np.linalg.lstsq(rows, other.T)[0]
    return bool(np.abs(rest).max() < _SAME_PX)


def residuals_of_attitude(calibration, matches, *, solution=None):
    """Return the residuals that a frame would have if only its attitude were its own.

    Parameters
    ----------
    calibration : Calibration
        Calibration of the frame.
    matches : `~astropy.table.Table`
        Its matches.
    solution : DistortionSolution, optional
        Solution about which the residuals are wanted.  Default: that of the calibration.

    Returns
    -------
    `~astropy.table.Table`
        The matches, or a copy with other ``dx`` and ``dy``.  If the frame was calibrated with the
        solution, its field is added back without its linear part, which the attitude absorbs; this
        is needed because a field also absorbs a drift.  Otherwise, the attitude is fitted to its
        stars with the map of the solution, and these residuals are returned: those about another
        map say nothing about this one.

    Raises
    ------
    FitError
        If the frame was calibrated with another map and has fewer than ten stars.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import Table
    >>> from wpdc_gwcs import Calibration, DistortionSolution, LookupTable, PVPolynomial
    >>> from wpdc_gwcs.evaluation import residuals_of_attitude
    >>> cd, crpix, crval = np.diag([-2e-5, 2e-5]), np.array([499.5, 499.5]), np.array([10.0, 20.0])
    >>> solution = DistortionSolution("d", (1000, 1000), crpix, cd, crval, PVPolynomial())
    >>> grid = np.linspace(-0.5, 999.5, 20)
    >>> shift = np.tile(0.1 * np.sin(grid / 100), (20, 1))
    >>> wave = LookupTable(grid, grid, shift, 0 * shift)
    >>> frame = Calibration("a", solution, crval=crval, cd=cd, field=wave)
    >>> x, y = np.random.default_rng(1).uniform(0, 999, (2, 500))
    >>> matches = Table({"x": x, "y": y, "dx": 0 * x, "dy": 0 * x, "used": x >= 0})
    >>> matches["x_err"] = matches["y_err"] = 0.05
    >>> without_field = residuals_of_attitude(frame, matches)
    >>> float(matches["dx"].std()), float(without_field["dx"].std().round(2))
    (0.0, 0.07)
    """
    if solution is not None and not has_map_of(calibration, solution):
        return _about(solution, calibration, matches)
    if calibration.field is None:
        return matches
    x, y = (np.asarray(matches[name], float) for name in ("x", "y"))
    used = np.asarray(matches["used"], bool)
    found = matches.copy()
    rows = np.stack([np.ones_like(x), *(2 * c / c.max(initial=1.0) - 1 for c in (x, y))], axis=1)
    for axis, field in zip("xy", calibration.field(x, y), strict=True):
        residual = np.asarray(matches[f"d{axis}"], float) + field
        error = np.asarray(matches[f"{axis}_err"], float)
        good = used & np.isfinite(residual) & (error > 0)
        if good.sum() >= _LEAST_STARS:
            weight = 1.0 / error[good, None]
            linear = np.linalg.lstsq(rows[good] * weight, residual[good] * weight[:, 0])[0]
            residual = residual - rows @ linear
        found[f"d{axis}"] = residual
        found[f"d{axis}"].unit = matches[f"d{axis}"].unit
    return found


def _about(solution, calibration, matches):
    """Residuals about the map of another solution, with the attitude that fits it best."""
    x, y, dx, dy, x_err, y_err = (
        np.asarray(matches[name], float) for name in ("x", "y", "dx", "dy", "x_err", "y_err")
    )
    # Where the reference stars are seen by the calibration: with their colors, unlike the catalog.
    place = np.array(calibration.undistort(x, y)) - [dx, dy]
    plane = calibration.cd @ (place - calibration.solution.crpix[:, None])
    fit = fit_attitude(
        *solution.undistort(x, y),
        *deproject(*plane, calibration.crval),
        crpix=solution.crpix,
        crval=calibration.crval,
        cd=calibration.cd,
        x_err=x_err,
        y_err=y_err,
        # The calibration has left out wrong pairs.  A change of the detector must not be left out.
        clip=np.inf,
        used=matches["used"],
    )
    found = matches.copy()
    for name, residual in (("dx", fit.dx), ("dy", fit.dy)):
        found[name] = residual
        found[name].unit = matches[name].unit
    return found
