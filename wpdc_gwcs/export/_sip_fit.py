"""SIP polynomials fitted to any smooth map of pixels to the tangent plane.

::

    plane = CD (u + A(u)),   u = x - CRPIX,   A with terms of degree 2 and more
"""

from typing import NamedTuple

import numpy as np
from numpy.polynomial import polynomial

__all__ = ["SipFit", "fit_sip", "fit_sip_inverse"]


class SipFit(NamedTuple):
    """A SIP approximation: CRPIX (zero based), CD (deg / px) and the terms ``[axis, p, q]``."""

    crpix: np.ndarray
    cd: np.ndarray
    terms: np.ndarray


def fit_sip(pixels, plane, degree, weights=None):
    """Fit CRPIX, CD and the SIP polynomials of one degree.

    Parameters
    ----------
    pixels : (2, N) ndarray
        Zero-based pixels.
    plane : (2, N) ndarray
        Their tangent-plane coordinates, deg.
    degree : int
        Degree, 2 or more.
    weights : (N,) ndarray, optional
        Weights of the squared errors.  Default: equal weights.

    Returns
    -------
    sip : SipFit
        The least-squares fit; ``terms[:, p, q]`` multiply ``u**p v**q``.

    Notes
    -----
    A SIP polynomial has no constant and no linear terms (Shupe et al. 2005, ASP Conf. Ser. 347,
    491).  The linear terms go into CD.  CRPIX is the point where the fitted map is zero, which
    leaves no constant term.
    """
    center = pixels.mean(axis=1)
    scale = np.abs(pixels - center[:, np.newaxis]).max()
    u = pixels - center[:, np.newaxis]
    terms = _fit_terms(*u, plane, scale, degree, least=0, weights=weights)
    crpix = center + _root(terms)
    u = pixels - crpix[:, np.newaxis]
    terms = _fit_terms(*u, plane, scale, degree, least=1, weights=weights)
    cd = np.column_stack([terms[:, 1, 0], terms[:, 0, 1]])
    return SipFit(crpix, cd, np.einsum("ij,jpq->ipq", np.linalg.inv(cd), terms))


def fit_sip_inverse(sip, pixels, plane, degree):
    """Fit the inverse polynomials, which viewers use.

    Parameters
    ----------
    sip : SipFit
        The forward polynomials.
    pixels, plane : (2, N) ndarray
        Zero-based pixels and their tangent-plane coordinates, deg.
    degree : int
        Degree.

    Returns
    -------
    terms : (2, degree + 1, degree + 1) ndarray
        AP and BP, which may have constant and linear terms.
    worst : float
        Greatest distance from the pixels, px.
    """
    u = pixels - sip.crpix[:, np.newaxis]
    w = np.linalg.solve(sip.cd, plane)
    terms = _fit_terms(*w, u - w, np.abs(w).max(), degree, least=0)
    back = w + np.array([polynomial.polyval2d(*w, c) for c in terms])
    return terms, float(np.hypot(*(back - u)).max())


def _fit_terms(u, v, values, scale, degree, *, least, weights=None):
    """Fit coefficients [axis, p, q] of u^p v^q with least <= p + q <= degree."""
    root = 1.0 if weights is None else np.sqrt(weights)[:, np.newaxis]
    powers = [(p, q) for p in range(degree + 1) for q in range(degree + 1 - p) if p + q >= least]
    # Scaled coordinates keep all powers of the same size.
    design = np.column_stack([(u / scale) ** p * (v / scale) ** q for p, q in powers])
    solution = np.linalg.lstsq(design * root, values.T * root, rcond=None)[0]
    terms = np.zeros((2, degree + 1, degree + 1))
    for (p, q), value in zip(powers, solution, strict=True):
        terms[:, p, q] = value / scale ** (p + q)
    return terms


def _root(terms):
    """Find the zero of a fitted polynomial map."""
    z = -np.linalg.solve(np.column_stack([terms[:, 1, 0], terms[:, 0, 1]]), terms[:, 0, 0])
    for _ in range(50):
        value = np.array([polynomial.polyval2d(*z, c) for c in terms])
        jacobian = np.array(
            [
                [polynomial.polyval2d(*z, polynomial.polyder(c, axis=axis)) for axis in (0, 1)]
                for c in terms
            ]
        )
        step = np.linalg.solve(jacobian, value)
        z -= step
        if np.abs(step).max() < 1e-10:
            break
    return z
