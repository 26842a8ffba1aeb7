"""The attitude of one exposure: CRVAL and CD with the instrument fixed."""

from dataclasses import dataclass

import numpy as np

from wpdc_gwcs.exceptions import FitError
from wpdc_gwcs.fitting.linear import solve_linear
from wpdc_gwcs.robust import robust_sigma

__all__ = ["MIN_STARS_ATTITUDE", "AttitudeFit", "fit_attitude"]


@dataclass(frozen=True, eq=False)
class AttitudeFit:
    """Attitude of one exposure: its pointing, scales and orientation.

    Parameters
    ----------
    crval : (2,) ndarray
        RA and Dec of the reference point, deg.
    cd : (2, 2) ndarray
        Linear matrix, deg / px.
    covariance : (6, 6) ndarray
        Covariance of (ax, bxx, bxy, ay, byx, byy), which describe the error of the attitude as an
        error of the undistorted position: dX = ax + bxx X + bxy Y and dY = ay + byx X + byy Y, with
        X, Y in px from the reference point.
    dx, dy : (N,) ndarray
        Residuals X - X_ref, Y - Y_ref of all given stars, in undistorted px.
    used : (N,) ndarray of bool
        Stars kept by the fit.
    scale : (2,) ndarray
        Robust scatter of the residuals of the stars that were kept, divided by their errors; in px
        if no errors were given.
    iterations : int
        Number of iterations until CRVAL no longer changed.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.fitting import fit_attitude
    >>> from wpdc_gwcs.models import deproject
    >>> cd, rng = np.array([[-2e-5, 0.0], [0.0, 2e-5]]), np.random.default_rng(1)
    >>> x, y = rng.uniform(0, 2000, (2, 200))
    >>> ra, dec = deproject(*(cd @ (x - 1000, y - 1000)), (120.0, 30.0))
    >>> x, y = [x, y] + rng.normal(0, 0.05, (2, 200))
    >>> fit = fit_attitude(x, y, ra, dec, crpix=(1000, 1000), crval=(120, 30), cd=cd)
    >>> float(np.sqrt(fit.covariance[0, 0]).round(4))  # of a_x: 0.05 px / sqrt(200) = 0.0035 px
    0.0037
    """

    crval: np.ndarray
    cd: np.ndarray
    covariance: np.ndarray
    dx: np.ndarray
    dy: np.ndarray
    used: np.ndarray
    scale: np.ndarray
    iterations: int


# With fewer stars, a single wrong pair could spoil the six numbers.
MIN_STARS_ATTITUDE = 10

_MAX_ITERATIONS = 50


def fit_attitude(x, y, ra, dec, *, crpix, crval, cd, x_err=None, y_err=None, clip=4.0, used=None):
    """Fit the attitude of one exposure, CRVAL and CD, with the instrument fixed.

    Parameters
    ----------
    x, y : (N,) array_like
        Undistorted pixel coordinates, zero based: PV and look-up table already applied.
    ra, dec : (N,) array_like
        Reference positions, deg.
    crpix : (2,) array_like
        Reference point, px, zero based.
    crval : (2,) array_like
        Starting RA and Dec of the reference point, deg.
    cd : (2, 2) array_like
        Starting matrix, deg / px.
    x_err, y_err : (N,) array_like, optional
        Total 1-sigma errors in px.  Default: equal weights.
    clip : float, optional
        Stars with a residual of more than this many robust standard deviations along either axis
        are left out.  The fit is iterated.
    used : (N,) array_like of bool, optional
        Mask of the stars that may be used.  Default: all.

    Returns
    -------
    AttitudeFit
        The attitude, its covariance and the residuals of all stars.

    Raises
    ------
    FitError
        If fewer than ten stars remain, or if they do not determine the six numbers.

    Notes
    -----
    The stars are projected about the current CRVAL, and ``CD^-1 (xi, eta) = a + B (X, Y)`` is
    solved by weighted least squares.  CD is replaced by CD B, and CRVAL by the sky position of the
    reference point.  This is repeated until CRVAL no longer changes, so the fit is exact on the
    sphere, for any dither and close to the poles.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.fitting import fit_attitude
    >>> from wpdc_gwcs.models import deproject
    >>> cd = np.array([[-2e-5, 0.0], [0.0, 2e-5]])
    >>> x, y = np.random.default_rng(1).uniform(0, 2000, (2, 200))
    >>> ra, dec = deproject(*(cd @ (x - 1000, y - 1000)), (120.0, 30.0))
    >>> fit = fit_attitude(x, y, ra, dec, crpix=(1000, 1000), crval=(120.001, 30.0), cd=1.001 * cd)
    >>> bool(np.allclose(fit.crval, (120.0, 30.0), rtol=0, atol=1e-10))
    True
    """
    # Not at module level: astropy imports this package while it imports its own modeling.
    from wpdc_gwcs.models import deproject, project

    z = np.array([np.asarray(x, float) - crpix[0], np.asarray(y, float) - crpix[1]])
    ra, dec = np.asarray(ra, float), np.asarray(dec, float)
    crval, cd = np.array(crval, dtype=float), np.array(cd, dtype=float)
    n = z.shape[1]
    has_errors = x_err is not None and y_err is not None
    sigma = np.array([x_err, y_err], dtype=float) if has_errors else np.ones((2, n))
    allowed = np.isfinite(z).all(0) & np.isfinite(ra) & np.isfinite(dec)
    allowed &= (np.isfinite(sigma) & (sigma > 0)).all(0)
    if used is not None:
        allowed &= np.asarray(used, bool)
    kept = allowed.copy()
    for iteration in range(1, _MAX_ITERATIONS + 1):
        plane = np.array(project(ra, dec, crval))
        kept &= np.isfinite(plane).all(0)
        if kept.sum() < MIN_STARS_ATTITUDE:
            raise FitError(
                f"{kept.sum()} of {n} stars are left to fit the attitude; at least "
                f"{MIN_STARS_ATTITUDE} are needed"
            )
        inverse = np.linalg.inv(cd)
        solution, covariance = _linear_attitude(
            z[:, kept], inverse @ plane[:, kept], sigma[:, kept]
        )
        # The position of the reference point on the tangent plane becomes the new CRVAL.
        shift = cd @ solution[:, 0]
        crval = np.array(deproject(*shift, crval))
        cd = cd @ solution[:, 1:]
        moved = (
            np.abs(solution[:, 0]).max()
            + np.abs(solution[:, 1:] - np.eye(2)).max() * np.abs(z[:, kept]).max()
        )
        plane = np.array(project(ra, dec, crval))
        residual = z - np.linalg.solve(cd, plane)
        normalized = np.abs(residual) / sigma
        scale = np.array([robust_sigma(a[kept]) for a in normalized])
        limit = clip * np.maximum(scale, 1e-10)
        keep = allowed & np.all(normalized <= limit[:, None], axis=0)
        settled = np.array_equal(keep, kept)
        kept = (
            keep if iteration < _MAX_ITERATIONS // 2 else kept
        )  # a star at the limit may be in and out in turn
        if moved < 1e-9 and (settled or iteration >= _MAX_ITERATIONS // 2):
            break
    if not has_errors:
        covariance = (
            covariance * np.mean(residual[:, kept] ** 2) * kept.sum() / max(kept.sum() - 3, 1)
        )
    return AttitudeFit(crval, cd, covariance, residual[0], residual[1], kept, scale, iteration)


def _linear_attitude(z, target, sigma):
    """Solve ``target = a + B z``; returns (2, 3) [a, B] and the (6, 6) covariance."""
    length = np.sqrt(np.mean(z**2)) or 1.0
    rows = np.stack([np.ones(z.shape[1]), z[0] / length, z[1] / length], axis=1)
    unit = np.array([1.0, length, length])
    solution, covariance = np.empty((2, 3)), np.zeros((6, 6))
    for axis in range(2):
        # The correction to the current attitude is a small number, the position is not.
        fit = solve_linear(rows, target[axis] - z[axis], sigma[axis] ** -2)
        solution[axis] = fit.parameters / unit
        root = fit.root / unit[:, None]
        covariance[3 * axis : 3 * axis + 3, 3 * axis : 3 * axis + 3] = root @ root.T
    solution[:, 1:] += np.eye(2)
    return solution, covariance
