"""Statistics of residuals: clipped moments, robust scatter, d80, maps."""

from dataclasses import dataclass

import numpy as np
from astropy.stats import SigmaClip
from astropy.table import QTable

from wpdc_gwcs.robust import robust_scatter

__all__ = [
    "ResidualStatistics",
    "binned_residuals",
    "d80",
    "evaluate",
    "running_statistics",
    "within_sigma",
]


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

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs import evaluate
    >>> dx, dy = np.random.default_rng(1).normal(0, 0.05, (2, 5000))
    >>> dx[:5] = 40.0  # wrong pairs
    >>> found = evaluate(dx, dy)
    >>> found.n - found.n_clipped >= 5, round(found.sigma_dx, 2), round(found.scatter_dx, 2)
    (True, 0.05, 0.05)
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


def d80(values):
    """Return the width between the 20 % and 80 % levels of the cumulative distribution.

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
    """Compute statistics of the residuals of matched stars.

    Parameters
    ----------
    dx, dy : (N,) array_like
        Residuals X' - X_ref and Y' - Y_ref in px.
    sigma : float, optional
        Clipping limit of the moments in standard deviations; the default is the paper's 3.

    Returns
    -------
    ResidualStatistics
        Statistics; all NaN, with ``n = 0``, if there are no stars.

    Raises
    ------
    ValueError
        If ``sigma`` is not positive.

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
    keep = within_sigma(dx, dy, sigma=sigma)
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


def within_sigma(dx, dy, *, sigma=3.0):
    """Mark the residuals that survive sigma clipping.

    Parameters
    ----------
    dx, dy : (N,) ndarray
        Finite residuals of both axes.
    sigma : float, optional
        Clipping limit in standard deviations.

    Returns
    -------
    (N,) ndarray of bool
        True for stars that are clipped on neither axis.
    """
    clip = SigmaClip(sigma=sigma, maxiters=None)
    return ~(np.ma.getmaskarray(clip(dx)) | np.ma.getmaskarray(clip(dy)))


def binned_residuals(x, y, dx, dy, *, image_shape, n_bins=20):
    """Average residuals in the cells of a grid over the detector.

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
        Means in px, indexed ``[iy, ix]``, NaN for empty cells.
    count : (n_bins, n_bins) `numpy.ndarray` of int
        Number of stars in each cell.

    Raises
    ------
    ValueError
        If ``n_bins`` is less than 1.

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


def running_statistics(values, dx, dy, *, n_bins=10):
    """Compute statistics of the residuals in bins of any quantity, such as magnitude.

    Parameters
    ----------
    values : (N,) array_like
        Quantity to bin by; stars without a finite value are left out.
    dx, dy : (N,) array_like
        Residuals in px.
    n_bins : int, optional
        Number of equally filled bins; fewer if a bin would have fewer than 10 stars.

    Returns
    -------
    `~astropy.table.QTable`
        One row per bin: ``low``, ``middle`` (median) and ``high`` of the values, and the fields of
        `ResidualStatistics`, in px.

    Raises
    ------
    ValueError
        If ``n_bins`` is less than 1.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.evaluation import running_statistics
    >>> rng = np.random.default_rng(1)
    >>> magnitude = rng.uniform(18, 24, 6000)
    >>> dx, dy = rng.normal(0, 0.01 * (magnitude - 17), (2, 6000))
    >>> table = running_statistics(magnitude, dx, dy, n_bins=3)
    >>> table["middle"].round(0).tolist(), table["sigma_dx"].round(2).tolist()
    ([19.0, 21.0, 23.0], [0.02, 0.04, 0.06])
    """
    if n_bins < 1:
        raise ValueError(f"n_bins must be at least 1, got {n_bins}")
    values, dx, dy = (np.asarray(a, dtype=float) for a in (values, dx, dy))
    good = np.isfinite(values) & np.isfinite(dx) & np.isfinite(dy)
    values, dx, dy = values[good], dx[good], dy[good]
    order = np.argsort(values, kind="stable")
    rows = []
    for i in np.array_split(order, max(1, min(n_bins, values.size // 10))):
        ends = [np.nan] * 3 if i.size == 0 else [values[i[0]], np.median(values[i]), values[i[-1]]]
        rows.append(
            dict(zip(("low", "middle", "high"), map(float, ends)), **vars(evaluate(dx[i], dy[i])))
        )
    return QTable(rows)
