"""Exposures as they go into the joint solution, and as they come out."""

from dataclasses import dataclass, field

import numpy as np

from wpdc_gwcs.lookup import TableInfo
from wpdc_gwcs.models import PVPolynomial
from wpdc_gwcs.solution import DistortionSolution

__all__ = ["Exposure", "ExposureFit", "InstrumentResult"]


@dataclass(frozen=True, eq=False)
class Exposure:
    """Pairs of one exposure, and where it was thought to point.

    Parameters
    ----------
    name : str
        Name of the exposure, for messages.
    x, y : (N,) array_like
        Measured positions, px, zero based.
    ra, dec : (N,) array_like
        Reference positions at the epoch of the exposure, deg.
    crval : (2,) array_like
        Starting RA and Dec of the reference point, deg.
    cd : (2, 2) array_like
        Starting linear matrix, deg / px.
    x_err, y_err : (N,) array_like, optional
        Total 1-sigma errors (centroid and reference), px; estimated from the residuals if not
        given.
    use : (N,) array_like of bool, optional
        Stars that may be fitted; the others (held out) only get residuals.
    """

    name: str
    x: np.ndarray
    y: np.ndarray
    ra: np.ndarray
    dec: np.ndarray
    crval: np.ndarray
    cd: np.ndarray
    x_err: np.ndarray | None = None
    y_err: np.ndarray | None = None
    use: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class ExposureFit:
    """What the joint solution found for one exposure.

    Parameters
    ----------
    name : str
        Name of the exposure.
    crval : (2,) ndarray
        RA and Dec of the reference point, deg.
    cd : (2, 2) ndarray
        Linear matrix, deg / px.
    covariance : (6, 6) ndarray
        Of the errors (ax, bxx, bxy, ay, byx, byy), see `wpdc_gwcs.fitting.AttitudeFit`.
    dx, dy : (N,) ndarray
        Residuals X'' - X_ref, Y'' - Y_ref of all pairs given, undistorted px; NaN where a position
        is NaN.
    x_err, y_err : (N,) ndarray
        Errors of the pairs as the fit found them: those given, rescaled, with a floor.
    used : (N,) ndarray of bool
        Pairs that were fitted: allowed, valid and not clipped.
    pv : PVPolynomial or None
        The exposure's own polynomial with ``refine="pv"``.
    pv_covariance : (2, n, n) ndarray or None
        Covariance of its terms, deg^2.
    reason : str or None
        Why the exposure was left out; its numbers are then the starting values.
    statistics : dict
        Counts and scatter of the pairs used, px.
    """

    name: str
    crval: np.ndarray
    cd: np.ndarray
    covariance: np.ndarray
    dx: np.ndarray
    dy: np.ndarray
    x_err: np.ndarray
    y_err: np.ndarray
    used: np.ndarray
    pv: "PVPolynomial | None" = None
    pv_covariance: np.ndarray | None = None
    reason: str | None = None
    statistics: dict = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class InstrumentResult:
    """The instrument and all its exposures.

    Parameters
    ----------
    solution : DistortionSolution
        What the exposures share.
    exposures : tuple of ExposureFit
        One per exposure given, in that order.
    rejected : dict of str
        Names of the exposures that were left out, and why.
    table_info : TableInfo or None
        How the table came about; `None` where there was none to be made.
    """

    solution: DistortionSolution
    exposures: tuple
    rejected: dict
    table_info: TableInfo | None = None
