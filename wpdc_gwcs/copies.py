"""Rows of a list that are the same star, from stacked lists or overlapping cones.

A star that occurs twice in a list is ambiguous for its partner, so it cannot be matched.
"""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

__all__ = ["group_copies"]

# Two positions of a star differ by less than this many of their errors in 0.99999 of all cases.
_N_SIGMA = 5.0
# Largest distance of two copies, in units of the distance to the sixth neighbor, which is a tenth
# of the distance between stars.  By chance, 3 of 100 stars have another star as close as this.
_REACH = 0.07
# Pairs beyond their errors are copies only if there are too many for chance and double stars: 1 to
# 2 of 100 stars are double within an arcsecond, and few of these have the same brightness.
_LEAST_COPIES, _LEAST_SHARE, _LEAST_SHARE_ALIKE = 10, 0.05, 0.02
# Largest distance of two copies, in units of the median distance.
_SPREAD = 4.0
# Differences in magnitude: of a star in two bands, and of a star that is measured again.
_MOST_APART, _ALIKE = 1.0, 0.1
# Number of neighbors examined per row, and neighbor whose distance gives the spacing of stars.
_NEAR, _DISTANT = 6, 6
# By chance, there are as many pairs between a radius and 1.4 times the radius as within it (for
# stars on a line, 0.4 of them).  Copies are closer to each other than that.
_ANNULUS, _CROWDING = 2**0.5, 3.5


def group_copies(points, *, reach, errors=None, mag=None, links=None):
    """Group rows that are the same star.

    Parameters
    ----------
    points : (N, d) ndarray
        Positions in a plane or as unit vectors; all are finite.
    reach : float
        Largest distance of two copies, in the unit of the positions.
    errors : (N,) ndarray, optional
        Errors of the positions per axis, in the same unit; NaN where unknown.
    mag : (N,) ndarray, optional
        Magnitudes; NaN where unknown.
    links : (i, j), optional
        Pairs of rows that are known to be the same star.

    Returns
    -------
    (N,) ndarray of int
        Number of the star of each row.

    Notes
    -----
    Rows at exactly the same position are the same star, and so are the pairs in ``links``.  Other
    pairs have to be closer than ``reach`` and than about a tenth of the distance between stars.
    They are the same star in two cases:

    1. Their distance is less than five times their errors, and their magnitudes, if known, differ
       by at most one.
    2. Their magnitudes, if known, agree to 0.1 mag, and there are far more such pairs than chance
       and double stars can explain.  Pairs with more than four times the median distance are not
       included.
    """
    n = len(points)
    i, j = (np.empty(0, int), np.empty(0, int)) if links is None else links
    places, place_of = np.unique(points, axis=0, return_inverse=True)
    place_of = place_of.reshape(-1)
    first = np.zeros(len(places), int)
    first[place_of[::-1]] = np.arange(n - 1, -1, -1)
    edges = [(i, j), (np.arange(n), first[place_of])]
    if len(places) > 1:
        # The first row at each position represents the others.
        some = None if errors is None else np.asarray(errors, float)[first]
        brightness = None if mag is None else np.asarray(mag, float)[first]
        near = _near_pairs(places, reach, some, brightness)
        edges.append((first[near[0]], first[near[1]]))
    i, j = (np.concatenate(side) for side in zip(*edges, strict=True))
    graph = coo_array((np.ones(len(i), bool), (i, j)), shape=(n, n))
    return connected_components(graph, directed=False)[1]


def _near_pairs(points, reach, errors, mag):
    """Pairs of different positions that are the same star."""
    n = len(points)
    tree = cKDTree(points)
    distant = tree.query(points, k=[min(_DISTANT, n - 1) + 1])[0][:, 0]
    # The distance of the sixth neighbor is 1.4 times that between stars; with two copies of each
    # star, it is about the same.
    limit = np.minimum(_REACH * distant, reach)
    distance, other = tree.query(
        points, k=min(_NEAR, n), distance_upper_bound=float(limit.max()) * _ANNULUS * (1 + 1e-12)
    )
    rows = np.repeat(np.arange(n), distance.shape[1])
    distance, other = distance.ravel(), other.ravel()
    near = (rows < other) & (other < n)
    rows, other, distance = rows[near], other[near], distance[near]
    apart = np.zeros(len(rows)) if mag is None else np.abs(mag[rows] - mag[other])
    known = np.isfinite(apart) & (mag is not None)
    alike = ~known | (apart <= _ALIKE)
    share = distance / np.minimum(limit[rows], limit[other])
    n_alike = np.count_nonzero(alike & (share <= 1.0))
    n_around = np.count_nonzero(alike & (share > 1.0) & (share <= _ANNULUS))
    one = np.zeros(len(rows), bool)
    if errors is not None:
        sigma = np.hypot(errors[rows], errors[other])
        one |= (distance <= _N_SIGMA * sigma) & ~(known & (apart > _MOST_APART))
    least = n * (_LEAST_SHARE_ALIKE if known.sum() > 0.5 * len(rows) else _LEAST_SHARE)
    if n_alike > max(_LEAST_COPIES, least, _CROWDING * n_around):
        # Most of them are copies, so their distances show how far apart copies are.
        typical = np.median(distance[alike & (share <= 1.0)])
        one |= alike & (distance <= _SPREAD * typical)
    one &= share <= 1.0
    return rows[one], other[one]
