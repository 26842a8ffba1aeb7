"""Residuals before a calibration: those of the linear WCS alone."""

import numpy as np
from astropy.table import Table

from wpdc_gwcs.models import project

__all__ = ["uncorrected_residuals"]


def uncorrected_residuals(calibration):
    """Return the residuals of a frame without its polynomial and table.

    Parameters
    ----------
    calibration : Calibration
        Calibration with ``matches``.

    Returns
    -------
    `~astropy.table.Table`
        The matches, with ``dx`` and ``dy`` (px) replaced by x - X_ref and y - Y_ref of the measured
        pixels in the linear WCS of the frame.

    Raises
    ------
    ValueError
        If the calibration has no matches.

    Examples
    --------
    >>> from wpdc_gwcs import calibrate, simulate
    >>> from wpdc_gwcs.evaluation import uncorrected_residuals
    >>> sky = simulate(1, image_shape=(1000, 1000), density=30, distortion=10, seed=2)
    >>> (c,) = calibrate([e.frame() for e in sky.exposures], sky.reference).calibrations
    >>> bool(max(abs(uncorrected_residuals(c)["dx"])) > 20 * max(abs(c.matches["dx"])))
    True
    """
    matches = calibration.matches
    if matches is None:
        raise ValueError(f"the calibration of {calibration.frame} has no matches")
    x, y, ra, dec = (
        np.asarray(getattr(matches[name], "value", matches[name]), float)
        for name in ("x", "y", "ra", "dec")
    )
    plane = np.array(project(ra, dec, calibration.crval))
    reference = np.linalg.solve(calibration.cd, plane) + calibration.solution.crpix[:, None]
    table = Table(matches, copy=True)
    for name, values in zip(("dx", "dy"), np.array([x, y]) - reference, strict=True):
        table[name] = values
        table[name].unit = "pix"
    return table
