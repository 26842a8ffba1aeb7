"""Sources on the sky: positions, with the errors of centroid and calibration together.

::

    x, y +- centroid --distortion, its uncertainty--> undistorted px --CD, sphere--> RA, Dec +- both
"""

from dataclasses import replace

import numpy as np

from wpdc_gwcs.columns import numbers_or_none
from wpdc_gwcs.models import deproject, project

__all__ = ["sky_positions", "with_sky_positions"]

_UNITS = {"ra": "deg", "dec": "deg", "ra_error": "mas", "dec_error": "mas", "ra_dec_corr": None}
_MAS = 3.6e6
# Step of the derivatives between plane and sphere, deg: errors of 1e-9 of them.
_STEP = 1e-4


def sky_positions(calibration, x, y, x_err, y_err):
    """Return the positions of sources on the sky, with their errors.

    Parameters
    ----------
    calibration : Calibration
        Calibration of the frame.
    x, y : (N,) array_like
        Zero-based pixels.
    x_err, y_err : (N,) array_like
        Standard deviations of the centroids along x and y, px; their errors are independent.

    Returns
    -------
    positions : dict of str to (N,) ndarray
        ``ra``, ``dec`` in deg; ``ra_error`` (times cos Dec) and ``dec_error`` in mas, and their
        correlation ``ra_dec_corr``: of centroid and calibration together, as in Gaia's catalogs.
        Errors are NaN where those of the centroid or of the calibration are unknown.

    Notes
    -----
    The covariance on the sky is ``T CD (J S J^T + U) CD^T T^T``, with the covariance S of the
    centroid, the derivatives J of the undistorted position with respect to the pixel, the
    covariance U of the undistorted position (`~wpdc_gwcs.Calibration.uncertainty`), and the
    derivatives T of the local plane, east and north, with respect to the tangent plane.
    """
    x, y, x_err, y_err = (np.asarray(v, dtype=float) for v in (x, y, x_err, y_err))
    distortion = calibration.wcs.get_transform("detector", "undistorted")
    ra, dec = calibration.wcs(x, y, with_bounding_box=False)
    jacobian = np.moveaxis(distortion.jacobian(x, y), -1, 0)
    centroid = np.zeros((len(x), 2, 2))
    centroid[:, 0, 0], centroid[:, 1, 1] = x_err**2, y_err**2
    covariance = jacobian @ centroid @ jacobian.swapaxes(1, 2)
    sigma_x, sigma_y, rho = calibration.uncertainty(x, y)
    covariance[:, 0, 0] += sigma_x**2
    covariance[:, 1, 1] += sigma_y**2
    covariance[:, 0, 1] += rho * sigma_x * sigma_y
    covariance[:, 1, 0] += rho * sigma_x * sigma_y
    to_sky = _plane_to_local(ra, dec, calibration.crval) @ np.asarray(calibration.cd)
    covariance = to_sky @ covariance @ to_sky.swapaxes(1, 2)
    ra_error, dec_error = np.sqrt(covariance[:, 0, 0]), np.sqrt(covariance[:, 1, 1])
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = covariance[:, 0, 1] / (ra_error * dec_error)
    values = ra, dec, ra_error * _MAS, dec_error * _MAS, correlation
    return dict(zip(_UNITS, values, strict=True))


def with_sky_positions(calibration):
    """Add the positions on the sky to the tables of sources and of matches.

    Parameters
    ----------
    calibration : Calibration
        Calibration of a frame.

    Returns
    -------
    calibration : Calibration
        Copy whose ``sources`` have the columns of `sky_positions`, and whose ``matches`` have
        ``source_ra``, ``source_dec`` and their errors; there, ``ra`` and ``dec`` are those of the
        reference star.

    Notes
    -----
    Centroid errors have the scale and the floor that the solution found.
    """
    matches, sources = calibration.matches, calibration.sources
    if matches is None:
        return calibration
    typical = [np.nanmedian(np.asarray(matches[name], float)) for name in ("x_err", "y_err")]
    if sources is not None:
        sources = _extended(sources, _of_table(calibration, sources, typical), {})
        positions = {
            name: np.asarray(sources[name])[np.asarray(matches["source_index"])] for name in _UNITS
        }
    else:
        positions = _of_table(calibration, matches, typical)
    names = {"ra": "source_ra", "dec": "source_dec"}
    return replace(calibration, sources=sources, matches=_extended(matches, positions, names))


def _of_table(calibration, table, typical):
    x, y = (np.asarray(table[name], float) for name in "xy")
    errors = [numbers_or_none(table, name) for name in ("x_err", "y_err")]
    if any(error is None for error in errors):
        # The errors that the solution found.
        errors = [np.full(len(x), value) for value in typical]
    elif table is not calibration.matches:
        statistics = calibration.solution.statistics
        scale, floor = statistics.get("error_scale", 1.0), statistics.get("error_floor", 0.0)
        errors = [np.hypot(scale * error, floor) for error in errors]
    return sky_positions(calibration, x, y, *errors)


def _extended(table, positions, names):
    table = table.copy(copy_data=False)
    for name, values in positions.items():
        column = names.get(name, name)
        table[column] = values
        table[column].unit = _UNITS[name]
    return table


def _plane_to_local(ra, dec, crval):
    """Differentiate the local plane at each point, east and north, by the tangent plane."""
    xi, eta = project(ra, dec, crval)
    derivatives = np.empty((len(xi), 2, 2))
    for axis, (du, dv) in enumerate(((_STEP, 0.0), (0.0, _STEP))):
        ahead, behind = deproject(xi + du, eta + dv, crval), deproject(xi - du, eta - dv, crval)
        difference = (ahead[0] - behind[0] + 180.0) % 360.0 - 180.0
        derivatives[:, 0, axis] = difference * np.cos(np.radians(dec)) / (2 * _STEP)
        derivatives[:, 1, axis] = (ahead[1] - behind[1]) / (2 * _STEP)
    return derivatives
