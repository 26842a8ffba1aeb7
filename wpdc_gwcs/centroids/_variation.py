"""How the PSF varies over the detector, as polynomials of small changes."""

import numpy as np
from numpy.polynomial.legendre import legvander

from wpdc_gwcs.centroids._build import center_profile
from wpdc_gwcs.centroids._modes import blur_modes, odd_modes, reduced_normal
from wpdc_gwcs.centroids._profile import Profile

__all__ = ["vary_profile"]

# Places along each axis at which a varying profile is tabulated.
_N_NODES = 5

# Inverse square of the size of a group of amplitudes: of order one, which would be a different
# star, and so small that nobody could tell; rounds at most to find it.
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
        Radius in px of the pixels used.
    degree : int
        Degree of the polynomials in position.

    Returns
    -------
    Profile
        Profile with places all over the detector.

    Notes
    -----
    A little more or less blur changes a profile by its second derivatives, and by its fourth in
    the next order:

    .. math::
        \psi(u, v; X, Y) = \psi + a_1 \psi_{uu} + a_2 \psi_{uv} + a_3 \psi_{vv}
                            + a_4 \nabla^4 \psi

    with polynomials :math:`a_k(X, Y)`.  Coma, which grows off the axis of any telescope, changes
    the third derivatives.  None of these has a first moment: the meaning of the position stays the
    same all over the detector.

    The amplitudes of a kind and a degree have a normal prior, as wide as the data make most likely
    (empirical Bayes): a free cubic would take noise for coma where stars are few, in the corners.
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
    # Blur and asymmetry have a size each, in the terms of each degree.
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
    """Amplitudes of the size, group by group, that the data make most likely: empirical Bayes."""
    count = np.bincount(group)
    precision = np.full(len(count), _LEAST_PRECISION)
    for _ in range(_MAX_ROUNDS):
        covariance = np.linalg.inv(normal + np.diag(precision[group]))
        amplitudes = covariance @ vector
        # As many of a group's numbers as the data tell, over their squares.
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
