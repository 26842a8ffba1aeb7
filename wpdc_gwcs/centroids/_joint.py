"""Stars that share pixels: how their fits depend on each other, and joint steps."""

import numpy as np
from scipy.sparse import bsr_array
from scipy.sparse.linalg import spsolve
from scipy.spatial import KDTree

from wpdc_gwcs.centroids._fit import Stars, normal_step

__all__ = ["cross_products", "joint_step", "pairs_that_share"]

# Greatest distance of neighbors that share pixels with a fit, in radii of the fits.
_REACH = 1.8
# Number of pairs processed at a time, which limits the memory for their pixels.
_CHUNK = 4000
# Largest step in px, and the fraction of the diagonal that is added to it, so that stars that
# cannot be separated keep their positions.
_MAX_STEP, _DAMPING = 0.5, 0.02


def pairs_that_share(stars, radius):
    """Find the pairs of stars whose fits share pixels.

    Parameters
    ----------
    stars : Stars
        The stars.
    radius : float
        Radius in px of the pixels of a fit.

    Returns
    -------
    (P, 2) int ndarray
        Pairs; the second half has those of the first half in reverse order.
    """
    pairs = KDTree(np.column_stack([stars.x, stars.y])).query_pairs(
        _REACH * radius, output_type="ndarray"
    )
    return np.concatenate([pairs, pairs[:, ::-1]])


def cross_products(field, profile, noise, stars, pairs, radius):
    """Compute the weighted products of the derivatives of two stars over the pixels of the first.

    Parameters
    ----------
    field, profile, noise, radius
        As for `fit_stars`.
    stars : Stars
        The stars.
    pairs : (P, 2) int ndarray
        Pairs of stars.

    Returns
    -------
    (P, 3, 3) ndarray
        Products.
    """
    parts = [np.zeros((0, 3, 3))]
    for start in range(0, len(pairs), _CHUNK):
        one, other = (stars.take(rows) for rows in pairs[start : start + _CHUNK].T)
        parts.append(_products(field, profile, noise, one, other, radius))
    return np.concatenate(parts)


def _products(field, profile, noise, stars, others, radius):
    half = int(np.ceil(radius))
    xc, yc, _, use, sky = field.cut(stars, half, radius)
    sides = []
    for side in (stars, others):
        shares = profile.shares(side.x, side.y)
        value, by_x, by_y = profile.evaluate(side.x - xc, side.y - yc, half, shares)
        flux = side.flux[:, None]
        sides.append(np.stack([flux * by_x, flux * by_y, value], axis=1))
    model = stars.flux[:, None] * sides[0][:, 2]
    weight = use / noise.variance(sky, model)
    return (sides[0] * weight[:, None]) @ sides[1].transpose(0, 2, 1)


def joint_step(field, profile, noise, stars, rows, radius):
    r"""Improve the positions and fluxes of stars that share pixels, all together.

    Parameters
    ----------
    field : Field
        Pixels from which the models of all stars have been subtracted.
    profile, noise, radius
        As for `fit_stars`.
    stars : Stars
        All stars as they were subtracted.
    rows : (n,) int ndarray
        Rows of the stars to improve.

    Returns
    -------
    Stars
        The improved stars.

    Notes
    -----
    If two stars share most of their pixels, fitting one star at a time converges slowly.  Here the
    steps :math:`\delta` of all stars solve

    .. math::
        N_{ii} \delta_i + \sum_j N_{ij} \delta_j = g_i

    with the gradients g of the residuals and the products N of the derivatives over the pixels of
    star i.
    """
    some = stars.take(rows)
    half = int(np.ceil(radius))
    xc, yc, pixels, use, sky = field.cut(some, half, radius)
    basis = profile.evaluate(some.x - xc, some.y - yc, half, profile.shares(some.x, some.y))
    pixels += some.flux[:, None] * basis[0]
    alone, covariance, _ = normal_step(basis, some.flux, pixels, use, sky, noise)
    # In units of the errors of the steps; singular stars do not move.
    error = np.sqrt(np.einsum("sii->si", covariance))
    singular = ~np.isfinite(error).all(axis=1)
    error[singular], covariance[singular] = 1.0, np.eye(3)
    pairs = pairs_that_share(some, radius)
    cross = cross_products(field, profile, noise, some, pairs, radius)
    cross[singular[pairs].any(axis=1)] = 0.0
    blocks = covariance[pairs[:, 0]] @ cross
    blocks *= error[pairs[:, 1]][:, None, :] / error[pairs[:, 0]][:, :, None]
    own = np.tile((1 + _DAMPING) * np.eye(3), (len(rows), 1, 1))
    step = _solve(own, pairs, blocks, alone / error) * error
    shift = np.clip(step[:, :2], -_MAX_STEP, _MAX_STEP)
    flux = np.maximum(some.flux + step[:, 2], 0.2 * some.flux)
    return Stars(some.x + shift[:, 0], some.y + shift[:, 1], flux)


def _solve(own, pairs, blocks, right):
    """Solve sparse equations of 3 x 3 blocks on the diagonal and at the pairs."""
    n = len(own)
    row = np.concatenate([np.arange(n), pairs[:, 0]])
    column = np.concatenate([np.arange(n), pairs[:, 1]])
    order = np.lexsort([column, row])
    start = np.searchsorted(row[order], np.arange(n + 1))
    data = np.concatenate([own, blocks])[order]
    matrix = bsr_array((data, column[order], start), shape=(3 * n, 3 * n))
    return spsolve(matrix.tocsc(), right.ravel()).reshape(n, 3)
