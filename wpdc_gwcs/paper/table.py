"""Phase 2 as in the paper: raw residuals, interpolated onto the nodes of a bilinear table."""

import numpy as np
from scipy.interpolate import RBFInterpolator
from scipy.spatial import cKDTree

from wpdc_gwcs.exceptions import FitError
from wpdc_gwcs.models import LookupTable
from wpdc_gwcs.robust import robust_sigma

__all__ = ["build_raw_table", "raw_noise"]

# The paper names `RBFInterpolator` and no options.  Its default, one matrix of all n stars, takes
# n^2 numbers and n^3 steps: 130 MB and some seconds for this number, 170 GB for the 25 fields of
# the paper.  For more stars, only so many neighbors are used; 20 and 100 neighbors give the same
# table to 1 % of its error.
_MOST_TOGETHER, _NEIGHBORS = 4000, 50
# Number of stars around a point from which the scatter is computed.
_NOISE_NEIGHBORS = 50


def build_raw_table(x, y, dx, dy, *, image_shape, n_grid=50):
    """Interpolate raw residuals onto the nodes of a look-up table, as in the paper.

    Parameters
    ----------
    x, y : (N,) array_like
        Detector pixels of the stars of all exposures, zero based.
    dx, dy : (N,) array_like
        Residuals of their polynomials, px.
    image_shape : (int, int)
        Shape of the detector, ``(ny, nx)``.
    n_grid : int, optional
        Nodes along each axis; 50 in the paper.

    Returns
    -------
    LookupTable
        Table that is bilinear between nodes from 0 to n.

    Raises
    ------
    FitError
        If the stars do not determine a surface.

    Notes
    -----
    `scipy.interpolate.RBFInterpolator` is used with its defaults: a thin-plate spline through every
    residual, without smoothing and regardless of errors, so a node has the noise of the stars next
    to it.  For more than 4000 stars, only the 50 nearest ones are used for each node.  Stars at the
    same position are averaged.

    References
    ----------
    WPDC-2P, arXiv:2603.09193, section 3.3.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.paper import build_raw_table
    >>> x, y = np.random.default_rng(1).uniform(0, 1000, (2, 3000))
    >>> table = build_raw_table(x, y, np.sin(x / 300), 0 * y, image_shape=(1000, 1000))
    >>> table.x_grid[[0, -1]].tolist(), table.method
    ([0.0, 1000.0], 'linear')
    """
    place, value = np.array([x, y], float).T, np.array([dx, dy], float).T
    good = np.isfinite(place).all(axis=1) & np.isfinite(value).all(axis=1)
    place, same, count = np.unique(place[good], axis=0, return_inverse=True, return_counts=True)
    same = same.ravel()
    value = np.stack([np.bincount(same, weights=v) / count for v in value[good].T], axis=1)
    if len(place) < 3 or np.linalg.matrix_rank(place - place.mean(axis=0)) < 2:
        raise FitError(f"a table needs stars that are not on one line, got {len(place)}")
    ny, nx = image_shape
    x_grid, y_grid = np.linspace(0, nx, n_grid), np.linspace(0, ny, n_grid)
    nodes = np.stack([a.ravel() for a in np.meshgrid(x_grid, y_grid)], axis=1)
    neighbors = None if len(place) <= _MOST_TOGETHER else _NEIGHBORS
    try:
        found = RBFInterpolator(place, value, neighbors=neighbors)(nodes)
    except (ValueError, np.linalg.LinAlgError) as err:
        raise FitError(
            f"the residuals of {len(place)} stars do not determine a table: {err}"
        ) from err
    return LookupTable(x_grid, y_grid, *found.T.reshape(2, n_grid, n_grid), method="linear")


def raw_noise(x, y, dx, dy, at_x, at_y):
    """Compute the scatter of neighboring residuals: the noise of a table that goes through them.

    Parameters
    ----------
    x, y : (N,) array_like
        Detector pixels of the stars.
    dx, dy : (N,) array_like
        Their residuals, px.
    at_x, at_y : (M,) array_like
        Positions for which the scatter is computed, px.

    Returns
    -------
    (2, M) ndarray
        Standard deviations, px; NaN where there are not two stars.
    """
    place, value = np.array([x, y], float).T, np.array([dx, dy], float).T
    if len(place) < 2:
        return np.full((2, len(np.ravel(at_x))), np.nan)
    tree = cKDTree(place)
    _, nearest = tree.query(place, k=2)
    own = np.arange(len(place))
    other = np.where(nearest[:, 0] == own, nearest[:, 1], nearest[:, 0])
    difference = (value - value[other]) / np.sqrt(2)
    k = min(_NOISE_NEIGHBORS, len(place))
    _, around = tree.query(np.stack([np.ravel(at_x), np.ravel(at_y)], axis=1), k=k)
    around = np.reshape(around, (-1, k))
    return np.array([[robust_sigma(d[rows]) for rows in around] for d in difference.T])
