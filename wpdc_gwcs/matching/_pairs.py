"""One-to-one nearest pairs of two point lists."""

import numpy as np
from scipy.spatial import cKDTree

from wpdc_gwcs.threads import count_threads

__all__ = ["find_edges", "find_nearest", "one_to_one", "pair_nearest"]

# Minimum number of neighbors to find for a second thread.
_THREADED = 60_000


def find_nearest(tree, points, k, **options):
    """Query a tree with a useful number of threads."""
    workers = min(2, count_threads()) if len(points) * np.max(k) > _THREADED else 1
    return tree.query(points, k=k, workers=workers, **options)


def find_edges(points, tree, radius, *, limit=None, slack=1.0):
    """List the points and partners within reach of each other.

    Parameters
    ----------
    points : (N, 2) ndarray
        Positions.
    tree : `~scipy.spatial.cKDTree`
        Tree of the possible partners.
    radius : (N,) ndarray
        Reach of each point; a point with radius <= 0 or NaN has no partners.
    limit : (M,) ndarray, optional
        Largest radius at each partner; where partners are close to each other, a wide radius is
        meaningless.
    slack : float, optional
        Up to this factor, a radius larger than the limit of a partner counts as the limit.  Beyond
        it, the partner is out of reach.

    Returns
    -------
    i, j : (n,) ndarray of int
        Edges: ``i`` is a row of `points`, ``j`` a row of the tree.  There are at most three edges
        per point, because two already make it ambiguous.
    distance : (n,) ndarray
        Length of each edge.
    """
    active = np.flatnonzero(radius > 0)
    if len(active) == 0 or tree.n == 0:
        empty = np.empty(0, int)
        return empty, empty.copy(), np.empty(0)
    reach = radius[active]
    distance, partner = find_nearest(
        tree, points[active], min(3, tree.n), distance_upper_bound=reach.max() * (1 + 1e-12)
    )
    distance = distance.reshape(len(active), -1)
    partner = partner.reshape(len(active), -1)
    inside = distance <= reach[:, None]
    if limit is not None:
        # The tree returns index n if there is no partner.
        allowed = np.append(limit, 0.0)[partner]
        inside &= (reach[:, None] <= slack * allowed) & (distance <= allowed)
    row, column = np.nonzero(inside)
    return active[row], partner[row, column], distance[row, column]


def one_to_one(i, j, n_points, n_partners):
    """Select the edges whose ends have no other edge.

    Returns
    -------
    keep : (n,) ndarray of bool
        The unambiguous edges.
    n_ambiguous : int
        Points that have a partner in reach but no unambiguous one.
    """
    degree_i = np.bincount(i, minlength=n_points)
    degree_j = np.bincount(j, minlength=n_partners)
    keep = (degree_i[i] == 1) & (degree_j[j] == 1)
    return keep, int(np.count_nonzero(degree_i) - np.count_nonzero(keep))


def pair_nearest(xs, ys, xr, yr, radius):
    """Pair two lists of positions one to one within a radius, without ambiguous ones.

    A pair is returned if the source has exactly one reference star within its radius and no
    other source reaches the same reference star.  Nothing is guessed: if two candidates lie
    within the radius, on either side, none of them is paired.

    Parameters
    ----------
    xs, ys : (N,) array_like
        Positions of the sources, px.
    xr, yr : (M,) array_like
        Positions of the reference stars in the same system, px.
    radius : float or (N,) array_like
        Largest distance of a pair, px; one number or one per source.

    Returns
    -------
    i_src, i_ref : (n,) ndarray of int
        Rows of the pairs, in order of the source row.  Positions that are not finite are never
        paired.
    n_ambiguous : int
        Number of sources that had a reference star within reach and were left out.

    Raises
    ------
    ValueError
        If the lengths of the coordinates differ or the radius is negative or not a number.

    Examples
    --------
    >>> from wpdc_gwcs.matching import pair_nearest
    >>> x, x_reference = [10, 50, 90], [90.1, 10.2, 50, 50.3]
    >>> i, j, n_ambiguous = pair_nearest(x, [7] * 3, x_reference, [7] * 4, 1.0)
    >>> i, j, n_ambiguous
    (array([0, 2]), array([1, 0]), 1)
    """
    points = _as_points("xs", "ys", xs, ys)
    partners = _as_points("xr", "yr", xr, yr)
    radius = np.asarray(radius, float)
    if np.isnan(radius).any() or (radius < 0).any():
        raise ValueError("radius must be a non-negative number of pixels")
    good_i = np.flatnonzero(np.isfinite(points).all(axis=1))
    good_j = np.flatnonzero(np.isfinite(partners).all(axis=1))
    reach = np.broadcast_to(radius, (len(points),))[good_i]
    tree = cKDTree(partners[good_j])
    i, j, _ = find_edges(points[good_i], tree, reach)
    keep, n_ambiguous = one_to_one(i, j, len(good_i), len(good_j))
    return good_i[i[keep]], good_j[j[keep]], n_ambiguous


def _as_points(name_x, name_y, x, y):
    x = np.asarray(x, float)
    y = np.asarray(y, float)
    if x.ndim != 1 or x.shape != y.shape:
        raise ValueError(
            f"{name_x} and {name_y} must be one-dimensional and of equal length; "
            f"got {x.shape}, {y.shape}"
        )
    return np.column_stack([x, y])
