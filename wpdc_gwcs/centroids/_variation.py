"""Variation of the PSF over the detector, as polynomials of small changes."""

import numpy as np
from numpy.polynomial.legendre import legvander

from wpdc_gwcs.centroids._build import center_profile
from wpdc_gwcs.centroids._modes import blur_modes, odd_modes, reduced_normal
from wpdc_gwcs.centroids._profile import Profile

__all__ = ["vary_profile"]

# Number of places along each axis at which a varying profile is tabulated.
_N_NODES = 5

# Limits of the inverse square of the size of a group of amplitudes, from order one (a completely
# different profile) to unnoticeable; greatest number of rounds to find it.
_LEAST_PRECISION, _MOST_PRECISION = 10.0, 1e10
_MAX_ROUNDS = 100


def vary_profile(field, noise, stars, profile, fwhm, *, radius, degree):
    r"""Let the width and the shape of a profile vary smoothly over the detector.

    Parameters
    ----------
    field, noise
        As for `fit_stars`.
    stars : Stars
        Stars fitted with the constant profile.
    profile : Profile
        Constant profile.
    fwhm : float
        FWHM in px.
    radius : float
        Radius in px of the pixels that are used.
    degree : int
        Degree of the polynomials in position.

    Returns
    -------
    Profile
        Profile with places over the whole detector.

    Notes
    -----
    A little more or less blur changes a profile by its second derivatives and, in the next order,
    by its fourth derivatives:

    .. math::
        \psi(u, v; X, Y) = \psi + a_1 \psi_{uu} + a_2 \psi_{uv} + a_3 \psi_{vv}
                            + a_4 \nabla^4 \psi

    with polynomials :math:`a_k(X, Y)`.  Coma, which grows with the distance from the axis of any
    telescope, changes it by the third derivatives.  None of these terms has a first moment, so the
    meaning of the position is the same over the whole detector.

    The amplitudes of each kind and degree have a normal prior with the most likely width, given the
    data (empirical Bayes).  A free cubic would take noise for coma where there are few stars, in
    the corners.
    """
    scale = fwhm * profile.oversampling
    blur, odd = (f(profile.coefficients[0], scale) for f in (blur_modes, odd_modes))
    modes = blur + odd
    left, right = reduced_normal(field, profile, noise, stars, modes, radius)
    ny, nx = field.image.shape
    terms = _polynomial_terms(stars.x / nx, stars.y / ny, degree)
    k, p = len(modes), terms.shape[1]
    normal = np.einsum("sij,sp,sq->ipjq", left, terms, terms).reshape(k * p, k * p)
    vector = np.einsum("si,sp->ip", right, terms).reshape(k * p)
    # Blur and asymmetry each have their own size for each degree.
    powers = np.add(*_powers(degree))
    group = np.add.outer(np.repeat([0, degree + 1], [len(blur), len(odd)]), powers).ravel()
    amplitudes = _likely_amplitudes(normal, vector, group).reshape(k, p)
    nodes = np.linspace(0, 1, _N_NODES)
    x, y = (v.ravel() for v in np.meshgrid(nodes, nodes))
    local = _polynomial_terms(x, y, degree) @ amplitudes.T
    grids = profile.coefficients + np.einsum("gk,kji->gji", local, np.stack(modes))
    varying = Profile(grids, profile.oversampling, nodes * (nx - 1), nodes * (ny - 1))
    return center_profile(varying, fwhm)


def _likely_amplitudes(normal, vector, group):
    """Amplitudes with the most likely size of each group: empirical Bayes."""
    count = np.bincount(group)
    precision = np.full(len(count), _LEAST_PRECISION)
    for _ in range(_MAX_ROUNDS):
        covariance = np.linalg.inv(normal + np.diag(precision[group]))
        amplitudes = covariance @ vector
        # Number of values of a group that the data determine, divided by the sum of their squares.
        told = count - precision * np.bincount(group, np.diag(covariance))
        square = np.bincount(group, amplitudes**2)
        new = np.clip(told / np.maximum(square, 1e-30), _LEAST_PRECISION, _MOST_PRECISION)
        done = np.abs(np.log(new / precision)).max() < 0.01
        precision = new
        if done:
            break
    return np.linalg.solve(normal + np.diag(precision[group]), vector)


def _polynomial_terms(x, y, degree):
    """Legendre products up to a total degree, of positions in units of the detector's sides."""
    tx, ty = legvander(2 * x - 1, degree), legvander(2 * y - 1, degree)
    i, j = _powers(degree)
    return tx[:, i] * ty[:, j]


def _powers(degree):
    """Degrees in x and in y of the products up to a total degree."""
    each = np.arange(degree + 1)
    return np.nonzero(np.add.outer(each, each) <= degree)
