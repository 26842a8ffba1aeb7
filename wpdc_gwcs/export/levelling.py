"""Weights that lower the greatest error of a polynomial fit.

::

    w_0 = 1,    w_k+1 = w_k |e_k|^b,    e_k: errors of the fit with weights w_k

This is Lawson's method for the best uniform approximation (C. L. Lawson, thesis, UCLA 1961), with b
less than one, because the iteration oscillates for b = 1.  If a table has waves that no polynomial
can follow, least squares leaves the crest of the highest wave unchanged; these weights reduce it by
a third.
"""

import numpy as np
from numpy.polynomial import chebyshev

__all__ = ["levelling_weights"]

_POWER = 0.5
# A dozen rounds gain nearly everything, and rounds after the fortieth gain nothing.
_ROUNDS = 40
# The gain at the worst place must not increase the mean square error by more than this factor.
_MOST_RMS = 1.5


def levelling_weights(pixels, values, degree):
    """Find weights of points that reduce the greatest error of a polynomial.

    Parameters
    ----------
    pixels : (2, N) ndarray
        Points.
    values : (2, N) ndarray
        Values to fit, in px, so that both axes count equally.
    degree : int
        Total degree of the polynomial; its basis does not matter.

    Returns
    -------
    weights : (N,) ndarray
        Weights of the squared errors; all one if nothing can be gained.
    """
    low, high = pixels.min(axis=1), pixels.max(axis=1)
    u, v = (2.0 * pixels.T - low - high).T / (high - low)[:, np.newaxis]
    terms = np.add.outer(range(degree + 1), range(degree + 1)).ravel() <= degree
    design = chebyshev.chebvander2d(u, v, [degree, degree])[:, terms]
    weights, best = np.ones(len(u)), None
    for _ in range(_ROUNDS):
        root = np.sqrt(weights)[:, np.newaxis]
        fit = np.linalg.lstsq(design * root, values.T * root, rcond=None)[0]
        errors = np.hypot(*(values - (design @ fit).T))
        rms, worst = np.sqrt(np.mean(errors**2)), errors.max()
        if best is None:
            most = _MOST_RMS * rms
        if best is None or (worst < best[0] and rms <= most):
            best = worst, weights
        if worst == 0.0:
            break
        weights = weights * (errors / worst + 1e-3) ** _POWER
        weights /= weights.mean()
    return best[1]
