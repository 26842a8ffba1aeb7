"""How SWarp goes from sky to pixels, and the linear part for which it is accurate.

::

    X = PV(U):    U_0 = X,    U_k+1 = U_k - (PV(U_k) - X),    k = 0, 1, 2

SWarp (2.40 and later, ``pv_to_raw``) makes only these three steps.  The remaining error is the
distortion times the third power of its gradient.  It is negligible for most cameras, and 0.1 px for
200 px of distortion over 9,000 px.  The division of a mapping into a linear part and a polynomial
is arbitrary, and three steps come closer if the polynomial contains less distortion.
"""

import numpy as np
from scipy.optimize import least_squares

__all__ = ["nearer_linear_part", "step_errors"]

_STEPS = 3
# If the steps leave more than this, deg, SWarp uses a polynomial fitted to the inverse instead.
_MOST_DEG = 1e-3
# Nodes along each axis for the choice of the linear part; the worst errors are at the edges.
_NODES = 13
# Evaluations of the errors and their derivatives; a hundred give no better result.
_MOST_EVALUATIONS = 30


def step_errors(pv, u, plane):
    """Compute the errors of the three steps.

    Parameters
    ----------
    pv : callable
        Polynomial, ``pv(u, v)``.
    u : (2, N) ndarray
        Correct results of the steps, deg.
    plane : (2, N) ndarray
        Standard coordinates that the steps start from, deg.

    Returns
    -------
    errors : (2, N) ndarray or None
        Results minus correct results, deg; `None` if SWarp would not use the steps.
    """
    errors = _steps(pv, plane) - u
    return None if np.abs(errors).max(initial=0.0) > _MOST_DEG else errors


def nearer_linear_part(pv, cd, crpix, image_shape):
    """Choose the linear part before a polynomial for which the three steps are most accurate.

    Parameters
    ----------
    pv : callable
        Polynomial after the present linear part.
    cd : (2, 2) ndarray
        Present matrix, deg / px.
    crpix : (2,) ndarray
        Present reference point, px, zero based.
    image_shape : (int, int)
        Shape of the detector, (ny, nx).

    Returns
    -------
    cd, crpix : ndarray
        New matrix and reference point.  Old and new coordinates are related by ``U = M U' + t``.
    matrix : (2, 2) ndarray
        M.
    offset : (2,) ndarray
        t, deg.

    Notes
    -----
    The sum of the fourth powers of the errors over a grid is minimized, which nearly minimizes the
    greatest error.
    """
    ny, nx = image_shape
    x, y = np.meshgrid(np.linspace(-0.5, nx - 0.5, _NODES), np.linspace(-0.5, ny - 0.5, _NODES))
    u = cd @ (np.array([x.ravel(), y.ravel()]) - np.reshape(crpix, (2, 1)))
    plane = np.array(pv(*u))
    pixel = np.sqrt(abs(np.linalg.det(cd)))
    # Steps: a hundredth of the matrix, and a thousandth of the detector.
    steps = np.array([1e-2] * 4 + [1e-3 * max(nx, ny) * pixel] * 2)

    def parts(changes):
        changes = changes * steps
        return np.eye(2) + changes[:4].reshape(2, 2), changes[4:]

    def squares(changes):
        matrix, offset = parts(changes)
        shifted = offset[:, np.newaxis]
        end = matrix @ _steps(lambda *w: pv(*(matrix @ w + shifted)), plane) + shifted
        return ((end - u) ** 2).sum(axis=0)

    start = np.zeros(6)
    worst = squares(start).max()
    found = least_squares(lambda p: squares(p) / worst, start, max_nfev=_MOST_EVALUATIONS)
    matrix, offset = parts(found.x)
    return np.linalg.solve(matrix, cd), crpix + np.linalg.solve(cd, offset), matrix, offset


def _steps(pv, plane):
    u = plane
    for _ in range(_STEPS):
        u = u - (np.array(pv(*u)) - plane)
    return u
