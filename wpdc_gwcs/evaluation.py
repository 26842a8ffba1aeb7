"""Residuals of calibrated frames: clipped moments, d80, maps, and drift of a stored table."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from astropy.stats import SigmaClip
from astropy.table import QTable, Table
from scipy.ndimage import median

__all__ = [
    "Drift",
    "ResidualStatistics",
    "binned_residuals",
    "d80",
    "detect_drift",
    "evaluate",
    "robust_scatter",
]

# Cells along each side of the detector in which a drift is looked for, coarse to fine.
_DRIFT_GRIDS = (2, 4, 8, 16)
_DRIFT_STARS = 8

# The uncertainty of a table is itself an estimate: taken this much larger, so that a false alarm is
# no more frequent than stated.
_TABLE_MARGIN = 1.5


@dataclass(frozen=True)
class ResidualStatistics:
    """Statistics of the residuals of a set of matched stars.

    Parameters
    ----------
    n : int
        Number of stars with finite residuals.
    n_clipped : int
        Stars left after the 3-sigma clipping, both axes together.
    mean_dx, mean_dy : float
        Means after clipping, px.
    sigma_dx, sigma_dy : float
        Standard deviations after clipping, px.
    scatter_dx, scatter_dy : float
        Robust scatter, 1.4826 times the median absolute deviation, of all stars, px.
    d80_dx, d80_dy : float
        Width between the 20 % and 80 % levels of the cumulative distribution, px.
    rms : float
        Root mean square of the total (two-axis) residual after clipping, px.
    """

    n: int
    n_clipped: int
    mean_dx: float
    sigma_dx: float
    mean_dy: float
    sigma_dy: float
    scatter_dx: float
    scatter_dy: float
    d80_dx: float
    d80_dy: float
    rms: float


def robust_scatter(values):
    """Scatter of values that outliers do not move: 1.4826 times the median absolute deviation.

    Parameters
    ----------
    values : (N,) array_like
        Values in any unit; NaN are ignored.

    Returns
    -------
    float
        Scatter in the unit of the values, the standard deviation if they are normal; NaN if empty.

    Examples
    --------
    >>> from wpdc_gwcs.evaluation import robust_scatter
    >>> round(robust_scatter([1.0, 2.0, 3.0, 1000.0]), 4)
    1.4826
    """
    values = np.asarray(values, dtype=float)
    values = values[np.isfinite(values)]
    if values.size == 0:
        return np.nan
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def d80(values):
    """Width between the 20 % and 80 % levels of the cumulative distribution.

    Parameters
    ----------
    values : (N,) array_like
        Residuals of one axis in px; NaN are ignored.

    Returns
    -------
    float
        Width in px, the measure by which the paper compares weighting functions; NaN if empty.

    References
    ----------
    WPDC-2P, arXiv:2603.09193, section 3.2.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.evaluation import d80
    >>> round(d80(np.linspace(0.0, 1.0, 101)), 3)
    0.6
    """
    values = np.asarray(values, dtype=float)
    values = values[np.isfinite(values)]
    if values.size == 0:
        return np.nan
    low, high = np.percentile(values, [20, 80])
    return float(high - low)


def evaluate(dx, dy, *, sigma=3.0):
    """Statistics of the residuals of matched stars.

    Parameters
    ----------
    dx, dy : (N,) array_like
        Residuals X' - X_ref and Y' - Y_ref in px.
    sigma : float, optional
        Clipping limit of the moments in standard deviations; the default is the paper's 3.

    Returns
    -------
    ResidualStatistics
        All NaN, with ``n = 0``, where there are no stars.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs import evaluate
    >>> rng = np.random.default_rng(1)
    >>> s = evaluate(rng.normal(0.0, 0.05, 5000), rng.normal(0.01, 0.05, 5000))
    >>> s.n, round(s.sigma_dx, 2), round(s.mean_dy, 2)
    (5000, 0.05, 0.01)
    """
    if not sigma > 0:
        raise ValueError(f"sigma must be positive, got {sigma}")
    dx, dy = np.broadcast_arrays(np.asarray(dx, dtype=float), np.asarray(dy, dtype=float))
    finite = np.isfinite(dx) & np.isfinite(dy)
    dx, dy = dx[finite], dy[finite]
    if dx.size == 0:
        return ResidualStatistics(0, 0, *[np.nan] * 9)
    clip = SigmaClip(sigma=sigma, maxiters=None)
    keep = ~(np.ma.getmaskarray(clip(dx)) | np.ma.getmaskarray(clip(dy)))
    x, y = dx[keep], dy[keep]
    return ResidualStatistics(
        n=int(dx.size),
        n_clipped=int(keep.sum()),
        mean_dx=float(x.mean()),
        sigma_dx=float(x.std()),
        mean_dy=float(y.mean()),
        sigma_dy=float(y.std()),
        scatter_dx=robust_scatter(dx),
        scatter_dy=robust_scatter(dy),
        d80_dx=d80(dx),
        d80_dy=d80(dy),
        rms=float(np.sqrt(np.mean(x**2 + y**2))),
    )


def binned_residuals(x, y, dx, dy, *, image_shape, n_bins=20):
    """Mean residuals in the cells of a grid over the detector.

    Parameters
    ----------
    x, y : (N,) array_like
        Pixel coordinates, zero based.
    dx, dy : (N,) array_like
        Residuals in px.
    image_shape : (int, int)
        Shape of the detector, ``(ny, nx)``.
    n_bins : int, optional
        Cells along each axis; the paper shows 20 x 20.

    Returns
    -------
    mean_dx, mean_dy : (n_bins, n_bins) `numpy.ndarray`
        Means in px, indexed ``[iy, ix]``, NaN where a cell has no star.
    count : (n_bins, n_bins) `numpy.ndarray` of int
        Stars in each cell.

    Examples
    --------
    >>> from wpdc_gwcs.evaluation import binned_residuals
    >>> mean_dx, mean_dy, count = binned_residuals(
    ...     [10, 12, 90], [10, 10, 90], [0.1, 0.3, 0.5], [0, 0, 0], image_shape=(100, 100), n_bins=2
    ... )
    >>> mean_dx.round(3).tolist()
    [[0.2, nan], [nan, 0.5]]
    """
    if n_bins < 1:
        raise ValueError(f"n_bins must be at least 1, got {n_bins}")
    ny, nx = image_shape
    x, y, dx, dy = (np.asarray(a, dtype=float) for a in (x, y, dx, dy))
    good = np.isfinite(x) & np.isfinite(y) & np.isfinite(dx) & np.isfinite(dy)
    x, y, dx, dy = x[good], y[good], dx[good], dy[good]
    ix = np.clip(((x + 0.5) * n_bins / nx).astype(int), 0, n_bins - 1)
    iy = np.clip(((y + 0.5) * n_bins / ny).astype(int), 0, n_bins - 1)
    cell = iy * n_bins + ix
    count = np.bincount(cell, minlength=n_bins**2)
    safe = np.where(count, count, 1)

    def mean(values):
        total = np.bincount(cell, weights=values, minlength=n_bins**2)
        return np.where(count, total / safe, np.nan).reshape(n_bins, n_bins)

    return mean(dx), mean(dy), count.reshape(n_bins, n_bins)


@dataclass(frozen=True, eq=False)
class Drift:
    """Whether a stored solution still holds, where it does not, and by how much.

    Parameters
    ----------
    drifted : bool
        Whether the residuals contradict the solution.
    p_value : float
        Probability of residuals as unlikely as these if nothing has changed.
    false_alarm : float
        Limit on the p-value: how often an unchanged instrument is reported as changed.
    amplitude : float
        Root mean square of the mean residual in the cells that have changed, px; 0 without drift.
    n_stars : int
        Stars tested.
    cells : `~astropy.table.QTable`
        Cells in which the residuals were averaged, most significant first: ``x_min``, ``x_max``,
        ``y_min``, ``y_max`` in px, ``n``, means ``dx``, ``dy`` and their ``sigma_dx``,
        ``sigma_dy`` in px, ``p_value`` of each cell alone, and ``changed``.
    """

    drifted: bool
    p_value: float
    false_alarm: float
    amplitude: float
    n_stars: int
    cells: QTable


def detect_drift(solution, matches, *, false_alarm=0.01):
    """Test whether a stored solution still describes the detector.

    Parameters
    ----------
    solution : DistortionSolution
        The stored solution.
    matches : `~astropy.table.Table` or iterable of them
        Match tables of frames that were calibrated with this solution, attitude only: columns
        ``x``, ``y``, ``dx``, ``dy``, ``x_err``, ``y_err`` in px.
    false_alarm : float, optional
        Accepted probability of reporting a change where there is none.

    Returns
    -------
    Drift
        The verdict, its p-value and the cells behind it.

    Raises
    ------
    ValueError
        If ``false_alarm`` is not between 0 and 1, or no cell has enough stars for a test.

    Notes
    -----
    The residuals are averaged in 2 x 2 to 16 x 16 cells and compared with their own errors, scaled
    to the observed scatter, and with the uncertainty of the solution.  The most significant cell
    decides, its probability multiplied by the number of cells (Bonferroni), which holds whatever
    the correlation between cells.  A change that is linear over the detector is not seen: it is in
    the attitudes of the frames.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import Table
    >>> from wpdc_gwcs import DistortionSolution, PVPolynomial, detect_drift
    >>> cd = np.diag([-2e-5, 2e-5])
    >>> solution = DistortionSolution(
    ...     "d", (1000, 1000), np.array([499.5, 499.5]), cd, np.array([10.0, 20.0]), PVPolynomial()
    ... )
    >>> rng = np.random.default_rng(1)
    >>> x, y = rng.uniform(0, 999, (2, 4000))
    >>> dx, dy = rng.normal(0, 0.05, (2, 4000))
    >>> matches = Table({"x": x, "y": y, "dx": dx, "dy": dy, "x_err": dx * 0 + 0.05,
    ...                  "y_err": dx * 0 + 0.05})
    >>> detect_drift(solution, matches).drifted
    False
    >>> matches["dx"][(x < 500) & (y < 500)] += 0.02
    >>> detect_drift(solution, matches).drifted
    True
    """
    if not 0 < false_alarm < 1:
        raise ValueError(f"false_alarm must be between 0 and 1, got {false_alarm}")
    if isinstance(matches, Table) or not isinstance(matches, Iterable):
        matches = [matches]
    stars = np.concatenate([_drift_columns(table) for table in matches], axis=1)
    x, y, residual, sigma = stars[0], stars[1], stars[2:4], stars[4:6]
    cells = [
        _drift_cells(solution, x, y, residual, sigma, n_grid=n_grid) for n_grid in _DRIFT_GRIDS
    ]
    cells = QTable(np.concatenate(cells))
    if len(cells) == 0:
        raise ValueError(
            f"no part of the detector has {_DRIFT_STARS} stars: {x.size} stars are too few to test"
        )
    cells.sort("p_value")
    cells["changed"] = cells["p_value"] * len(cells) < false_alarm
    p_value = min(1.0, float(cells["p_value"][0]) * len(cells))
    changed = cells[cells["changed"]]
    amplitude = np.sqrt(np.mean(changed["dx"] ** 2 + changed["dy"] ** 2)) if len(changed) else 0.0
    for name in ("x_min", "x_max", "y_min", "y_max", "dx", "dy", "sigma_dx", "sigma_dy"):
        cells[name].unit = "pix"
    return Drift(bool(len(changed)), p_value, false_alarm, float(amplitude), x.size, cells)


def _drift_columns(table):
    """Take position, residual and error of the valid stars of a frame, errors as the scatter is."""
    names = ("x", "y", "dx", "dy", "x_err", "y_err")
    columns = np.array([np.asarray(table[name], dtype=float) for name in names])
    columns = columns[:, np.isfinite(columns).all(axis=0) & (columns[4:] > 0).all(axis=0)]
    for axis in range(2):
        scale = robust_scatter(columns[2 + axis] / columns[4 + axis])
        columns[4 + axis] *= max(1.0, scale) if np.isfinite(scale) else 1.0
    return columns


def _drift_cells(solution, x, y, residual, sigma, *, n_grid):
    """Mean residuals in n_grid x n_grid cells, and how unlikely each is."""
    ny, nx = solution.image_shape
    ix = np.clip(((x + 0.5) * n_grid / nx).astype(int), 0, n_grid - 1)
    iy = np.clip(((y + 0.5) * n_grid / ny).astype(int), 0, n_grid - 1)
    cell, labels = iy * n_grid + ix, np.arange(n_grid**2)
    # A wrong pair must not speak for its cell; a change that is large must.
    center = np.array([median(r, cell, labels) for r in residual])
    kept = (np.abs(residual - center[:, cell]) < 5 * sigma).all(axis=0)
    cell, residual, sigma = cell[kept], residual[:, kept], sigma[:, kept]
    n = np.bincount(cell, minlength=n_grid**2)
    full = np.flatnonzero(n >= _DRIFT_STARS)
    weight = [np.bincount(cell, 1 / s**2, minlength=n_grid**2)[full] for s in sigma]
    mean = [
        np.bincount(cell, r / s**2, minlength=n_grid**2)[full] / w
        for r, s, w in zip(residual, sigma, weight, strict=True)
    ]
    x_size, y_size = nx / n_grid, ny / n_grid
    x_min, y_min = (full % n_grid) * x_size - 0.5, (full // n_grid) * y_size - 0.5
    known = solution.covariance(x_min + x_size / 2, y_min + y_size / 2)
    known = [np.nan_to_num(known[i, i]) * _TABLE_MARGIN**2 for i in range(2)]
    variance = [1 / w + k for w, k in zip(weight, known, strict=True)]
    statistic = mean[0] ** 2 / variance[0] + mean[1] ** 2 / variance[1]
    p_value = np.exp(-statistic / 2)  # chi-square of two degrees of freedom
    return np.rec.fromarrays(
        [
            x_min, x_min + x_size, y_min, y_min + y_size, n[full], *mean,
            *np.sqrt(variance), p_value,
        ],
        names="x_min,x_max,y_min,y_max,n,dx,dy,sigma_dx,sigma_dy,p_value",
    )  # fmt: skip
