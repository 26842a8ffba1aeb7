"""Test whether a stored solution is still valid, and where and by how much it has changed.

::

    residuals --means in cells--> most significant cell, whole detector --> verdict
        '--minus the linear part of the unchanged cells--> changed cells, size of the change
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from astropy.table import QTable, Table
from scipy.ndimage import median
from scipy.special import chdtrc

from wpdc_gwcs.counts import counted
from wpdc_gwcs.robust import robust_scatter

__all__ = ["Drift", "detect_drift", "mean_in_cells"]

# Cells along each side of the detector in the search for a drift; stars needed per cell.
_GRIDS = (2, 4, 8, 16)
_MIN_STARS = 8

# Cells along each side for the test of the whole detector.
_WHOLE_GRID = 8

# The uncertainty of a table is itself an estimate.  It is inflated by this factor, so that false
# alarms are not more frequent than stated.
_TABLE_MARGIN = 1.5

# Stars per cell of the grid that is used to find the linear part of the unchanged cells.
_LINEAR_STARS = 200

# Chi-square (two axes) above which a cell is excluded from this fit: 1 in 1000.
_CHANGED_CHI2 = 13.8

# A cell has changed as a whole if the differences within it are at least this probable.
_UNIFORM = 1e-3

# Minimum fraction of unchanged cells for which their linear part is attributed to the attitudes.
_UNCHANGED_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class Drift:
    """Result of a test whether a stored solution is still valid.

    Parameters
    ----------
    drifted : bool
        Whether the residuals contradict the solution.
    p_value : float
        Probability of such residuals, or less likely ones, if nothing has changed.
    false_alarm : float
        Limit on the p-value: how often an unchanged instrument is reported as changed.
    amplitude : float
        Root mean square of the change over the cells that have changed, both axes together, px; 0
        without drift.
    area : float
        Fraction of the stars that are in these cells.
    n_stars : int
        Stars tested.
    cells : `~astropy.table.QTable`
        Cells in which the residuals were averaged, most significant first: ``x_min``, ``x_max``,
        ``y_min``, ``y_max`` in px, ``n``, means ``dx``, ``dy`` and their ``sigma_dx``,
        ``sigma_dy`` in px, ``p_value`` of each cell alone, and ``changed``.  If there is a drift,
        the linear part of the unchanged cells is subtracted, and the stars of a changed cell are
        not used in larger cells around it.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import Table
    >>> from wpdc_gwcs import DistortionSolution, PVPolynomial, detect_drift
    >>> cd, crpix, crval = np.diag([-2e-5, 2e-5]), np.array([499.5, 499.5]), np.array([10.0, 20.0])
    >>> solution = DistortionSolution("d", (1000, 1000), crpix, cd, crval, PVPolynomial())
    >>> rng = np.random.default_rng(1)
    >>> x, y = rng.uniform(0, 999, (2, 4000))
    >>> dx, dy = rng.normal(0, 0.05, (2, 4000))
    >>> dx[(x < 500) & (y < 500)] += 0.03  # one quarter has moved
    >>> matches = Table({"x": x, "y": y, "dx": dx, "dy": dy})
    >>> matches["x_err"] = matches["y_err"] = 0.05
    >>> drift = detect_drift(solution, matches)
    >>> drift.drifted, drift.p_value < drift.false_alarm, round(drift.area, 2)
    (True, True, 0.25)
    >>> print(drift.cells["x_min", "x_max", "y_min", "y_max"][:1])
    x_min x_max y_min y_max
     pix   pix   pix   pix
    ----- ----- ----- -----
     -0.5 499.5  -0.5 499.5
    """

    drifted: bool
    p_value: float
    false_alarm: float
    amplitude: float
    area: float
    n_stars: int
    cells: QTable


def detect_drift(solution, matches, *, false_alarm=0.01):
    """Test whether a stored solution still describes the detector.

    Parameters
    ----------
    solution : DistortionSolution
        The stored solution.
    matches : `~astropy.table.Table` or iterable of them
        Match tables with residuals about this solution: columns ``x``, ``y``, ``dx``, ``dy``,
        ``x_err``, ``y_err`` in px.  Tables of frames that were calibrated with it, attitude only,
        have them; for any others, with fields or solutions of their own,
        `~wpdc_gwcs.evaluation.residuals_of_attitude` computes them.
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
    1. The residuals are averaged in 2 x 2 to 16 x 16 cells.  Their variance is the sum of two: the
       variance from the errors of the stars and that of the solution.  The former is scaled to the
       observed scatter and, with several frames, to the scatter of the means from frame to frame
       (turbulence is common to the stars of one cell).  A single frame may differ by as much as the
       frames of the solution did.
    2. The most significant cell, its probability multiplied by the number of cells (Bonferroni,
       which holds for any correlation between cells), and the chi-square of the whole
       detector, which accounts for correlated errors of the table, share the false alarms equally.
    3. The attitudes of the frames have absorbed the linear part of a change.  It is found from the
       largest set of cells that agree on a linear map, by a robust fit from many starting points.
       It is subtracted, and cells are tested again: large cells that have changed as a whole, then
       small ones, then the rest of larger ones.

    A change that is linear over the whole detector is not seen, because the attitudes absorb it.

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
    >>> matches["dx"][(x < 500) & (y < 500)] += 0.03
    >>> drift = detect_drift(solution, matches)
    >>> drift.drifted, round(drift.amplitude, 2), round(drift.area, 2)
    (True, 0.03, 0.25)
    """
    if not 0 < false_alarm < 1:
        raise ValueError(f"false_alarm must be between 0 and 1, got {false_alarm}")
    if isinstance(matches, Table) or not isinstance(matches, Iterable):
        matches = [matches]
    stars = _Stars(solution, [_columns_of(table) for table in matches])
    grids = {n: stars.average(n) for n in _GRIDS}
    p_values = np.concatenate([g.p_value for g in grids.values()])
    if len(p_values) == 0:
        raise ValueError(
            f"no part of the detector has {_MIN_STARS} stars: {counted(stars.x.size, 'star')} in "
            "all, too few to test"
        )
    p_value = float(min(1.0, 2 * min(p_values.min() * len(p_values), _whole(solution, grids))))
    drifted = bool(p_value < false_alarm)
    parts = [(n, g, np.zeros(len(g.index), bool)) for n, g in grids.items()]
    amplitude = area = 0.0
    if drifted:
        parts, gone = _localize(stars, grids, false_alarm / len(p_values))
        area = float(gone.mean())
        amplitude = _amplitude(parts)
    cells = QTable(np.concatenate([_rows(solution, *part) for part in parts]), copy=False)
    cells.sort("p_value")
    for name in ("x_min", "x_max", "y_min", "y_max", "dx", "dy", "sigma_dx", "sigma_dy"):
        cells[name].unit = "pix"
    return Drift(drifted, p_value, false_alarm, amplitude, area, stars.x.size, cells)


def mean_in_cells(solution, matches, n_grid):
    """Average residuals in the cells of a grid.

    Parameters
    ----------
    solution : DistortionSolution
        Solution of the detector.
    matches : iterable of `~astropy.table.Table`
        As for `detect_drift`.
    n_grid : int
        Cells along each side.

    Returns
    -------
    `~astropy.table.Table`
        One row per cell with eight or more stars: ``x_min``, ``x_max``, ``y_min``, ``y_max``,
        ``n``, ``dx``, ``dy``, ``sigma_dx``, ``sigma_dy``, in px.
    """
    stars = _Stars(solution, [_columns_of(table) for table in matches])
    cells = stars.average(n_grid)
    table = Table(_rows(solution, n_grid, cells, np.zeros(len(cells.index), bool)))
    table.remove_columns(["p_value", "changed"])
    for name in table.colnames:
        if name != "n":
            table[name].unit = "pix"
    return table


def _columns_of(table):
    """Positions, residuals and errors of the valid stars; errors are scaled to the scatter."""
    names = ("x", "y", "dx", "dy", "x_err", "y_err")
    columns = np.array([np.asarray(table[name], dtype=float) for name in names])
    columns = columns[:, np.isfinite(columns).all(axis=0) & (columns[4:] > 0).all(axis=0)]
    for axis in range(2):
        scale = robust_scatter(columns[2 + axis] / columns[4 + axis])
        columns[4 + axis] *= max(1.0, scale) if np.isfinite(scale) else 1.0
    return columns


class _Stars:
    """Residuals of all frames, and their means in the cells of any grid."""

    def __init__(self, solution, frames):
        columns = np.concatenate(frames, axis=1)
        self.solution = solution
        self.x, self.y, self.residual, self.sigma = (
            columns[0],
            columns[1],
            columns[2:4],
            columns[4:],
        )
        self.frame = np.repeat(np.arange(len(frames)), [f.shape[1] for f in frames])
        self.n_frames = len(frames)

    def cell(self, n_grid):
        """Index of the cell of every star."""
        ny, nx = self.solution.image_shape
        ix = np.clip(((self.x + 0.5) * n_grid / nx).astype(int), 0, n_grid - 1)
        iy = np.clip(((self.y + 0.5) * n_grid / ny).astype(int), 0, n_grid - 1)
        return iy * n_grid + ix

    def average(self, n_grid, *, residual=None, use=None, inflation=None):
        """Means in n_grid x n_grid cells, optionally of other residuals or of some of the stars."""
        residual = self.residual if residual is None else residual
        cell, m = self.cell(n_grid), n_grid**2
        rows = np.arange(len(cell)) if use is None else np.flatnonzero(use)
        # A wrong pair must not dominate its cell, but a large change must count.
        center = np.array([median(r[rows], cell[rows], np.arange(m)) for r in residual])
        near = np.abs(residual[:, rows] - center[:, cell[rows]]) < 5 * self.sigma[:, rows]
        rows = rows[near.all(axis=0)]
        cell, residual, weight = cell[rows], residual[:, rows], self.sigma[:, rows] ** -2
        count = np.bincount(cell, minlength=m)
        full = np.flatnonzero(count >= _MIN_STARS)
        total = np.array([np.bincount(cell, w, minlength=m) for w in weight])
        safe = np.where(total > 0, total, 1.0)
        mean = (
            np.array([np.bincount(cell, r * w, minlength=m) for r, w in zip(residual, weight)])
            / safe
        )
        if inflation is None:
            inflation = self._inflation(cell, rows, residual, weight, mean, m)
        known = self._known(n_grid)[:, full]
        return _Cells(
            full, count[full], mean[:, full], inflation / total[:, full], known, inflation
        )

    def _known(self, n_grid):
        """Variances of the cell means due to the uncertainty of the solution, (2, cells).

        A smoother with p parameters has its mean variance at a point, and at most the fraction
        cells / p of that in the mean over a cell: the squared means of p orthonormal functions
        over a cell add up to at most the number of cells.
        """
        ny, nx = self.solution.image_shape
        m = 3 * n_grid
        x, y = np.meshgrid((np.arange(m) + 0.5) * nx / m - 0.5, (np.arange(m) + 0.5) * ny / m - 0.5)
        covariance = self.solution.covariance(x, y)
        variance = np.nan_to_num(np.array([covariance[0, 0], covariance[1, 1]]))
        variance = variance.reshape(2, n_grid, 3, n_grid, 3).mean(axis=(2, 4)).reshape(2, -1)
        freedom = self.solution.statistics.get("table", {}).get("freedom") or 0.0
        share = min(1.0, n_grid**2 / freedom) if freedom else 1.0
        variance = variance * share
        if self.n_frames == 1:
            # With several frames, their differences show the variance of single frames.
            variance = variance + _field_variance(self.solution)
        return variance * _TABLE_MARGIN**2

    def _inflation(self, cell, rows, residual, weight, mean, m):
        """Ratio (at least 1) of the scatter of frame means to that expected from star errors.

        The attitude of a frame absorbs three of the means along each axis.
        """
        if self.n_frames < 2 or m <= 4:
            return 1.0
        key = self.frame[rows] * m + cell
        size = self.n_frames * m
        excess = freedom = 0.0
        for r, w, mean_of in zip(residual, weight, mean):
            total = np.bincount(key, w, minlength=size).reshape(self.n_frames, m)
            first = np.bincount(key, w * r, minlength=size).reshape(self.n_frames, m)
            there = total > 0
            own = first / np.where(there, total, 1.0)
            excess += np.sum(np.where(there, total * (own - mean_of) ** 2, 0.0))
            freedom += there.sum() - there.any(axis=0).sum() - 3 * (self.n_frames - 1)
        return max(1.0, excess / freedom) if freedom > 0 else 1.0


def _field_variance(solution):
    """Variance per axis of the field of a single frame beyond its attitude, px^2.

    From a von Karman spectrum, without waves longer than the detector.
    """
    fields = solution.statistics.get("fields")
    if not fields:
        return 0.0
    lowest = (0.5 * fields["scale"] / max(solution.image_shape)) ** 2
    return fields["amplitude"] ** 2 * (1 + lowest) ** (-5 / 6)


@dataclass(frozen=True, eq=False)
class _Cells:
    """Means in the cells of a grid with enough stars, and their variances (2, M)."""

    index: np.ndarray
    n: np.ndarray
    mean: np.ndarray
    noise: np.ndarray
    known: np.ndarray
    inflation: float

    def take(self, mask):
        """Select some of the cells."""
        return _Cells(
            self.index[mask], self.n[mask], self.mean[:, mask], self.noise[:, mask],
            self.known[:, mask], self.inflation,
        )  # fmt: skip

    @property
    def variance(self):
        return self.noise + self.known

    @property
    def p_value(self):
        return np.exp(-0.5 * np.sum(self.mean**2 / self.variance, axis=0))

    def place(self, n_grid):
        """Centers of the cells from -1 to 1, as columns (1, u, v)."""
        u, v = (2 * (i + 0.5) / n_grid - 1 for i in (self.index % n_grid, self.index // n_grid))
        return np.stack([np.ones_like(u), u, v], axis=1)


def _whole(solution, grids):
    """Probability of the chi-square of all cells together.

    Neighboring cells share the errors of the table.  These have no more independent values than
    the table has parameters, so the chi-square scatters more.
    """
    cells = grids[_WHOLE_GRID]
    n = len(cells.index)
    if n <= 6:
        return 1.0
    value = np.sum(cells.mean**2 / cells.variance)
    freedom = solution.statistics.get("table", {}).get("freedom") or 6.0
    common = max(1.0, n / max(freedom, 1.0))
    share = cells.known / cells.variance
    # Chi-square scaled to the mean and the variance of the sum (Satterthwaite).
    mean, variance = (
        2.0 * n,
        2.0 * np.sum((1 - share) ** 2 + common * share**2 + 2 * share * (1 - share)),
    )
    return float(chdtrc(2 * mean**2 / variance, 2 * value * mean / variance))


def _localize(stars, grids, limit):
    """Find the changed cells, after subtraction of the linear part that attitudes absorb.

    First large cells that have changed as a whole, then small ones, then the rest of larger ones.
    Returns (grid, cells, mask of changed cells) and the stars in those.
    """
    linear = _unchanged_linear(grids)
    ny, nx = stars.solution.image_shape
    place = [np.ones_like(stars.x), (2 * stars.x + 1) / nx - 1, (2 * stars.y + 1) / ny - 1]
    residual = stars.residual - linear @ place
    gone = np.zeros(stars.x.size, bool)
    parts = []
    means = {
        n: stars.average(n, residual=residual, inflation=g.inflation) for n, g in grids.items()
    }
    for n_grid, cells in means.items():
        there = np.zeros(n_grid**2, bool)
        there[stars.cell(n_grid)[gone]] = True
        finer = {n: c for n, c in means.items() if n > n_grid}
        whole = (cells.p_value < limit) & ~there[cells.index] & _uniform(n_grid, cells, finer)
        parts.append((n_grid, cells.take(whole), np.ones(whole.sum(), bool)))
        gone |= np.isin(stars.cell(n_grid), cells.index[whole])
    for n_grid in sorted(grids, reverse=True):
        cells = stars.average(
            n_grid, residual=residual, use=~gone, inflation=grids[n_grid].inflation
        )
        changed = cells.p_value < limit
        parts.append((n_grid, cells, changed))
        gone |= np.isin(stars.cell(n_grid), cells.index[changed])
    if not gone.any():
        # Significant together, but no cell by itself: report the cells found so far.
        best = min(g.p_value.min(initial=1.0) for g in grids.values())
        parts = [(n, g, g.p_value == best) for n, g in grids.items()]
        for n_grid, cells, changed in parts:
            gone |= np.isin(stars.cell(n_grid), cells.index[changed])
    return parts, gone


def _uniform(n_grid, cells, finer):
    """Whether the smaller cells within each cell agree with its mean."""
    mean = np.zeros((2, n_grid**2))
    mean[:, cells.index] = cells.mean
    good = np.ones(n_grid**2, bool)
    for n, small in finer.items():
        parent = small.index // n * n_grid // n * n_grid + small.index % n * n_grid // n
        square = np.sum((small.mean - mean[:, parent]) ** 2 / small.variance, axis=0)
        total = np.bincount(parent, square, minlength=n_grid**2)
        freedom = 2 * (np.bincount(parent, minlength=n_grid**2) - 1)
        good &= chdtrc(np.maximum(freedom, 1), total) > _UNIFORM
    return good[cells.index]


def _unchanged_linear(grids):
    """Linear part (2, 3) of the unchanged cells: the largest set that agrees on one."""
    # Only cells that show a change by themselves are excluded.
    good = [n for n, g in grids.items() if len(g.index) >= 9 and np.median(g.n) >= _LINEAR_STARS]
    if not good:
        return np.zeros((2, 3))
    n_grid = max(good)
    cells = grids[n_grid]
    rows = cells.place(n_grid)
    best, best_loss = np.zeros((2, 3)), np.inf
    for kept in _starts(rows[:, 1], rows[:, 2]):
        for _ in range(30):
            if kept.sum() < 9:
                break
            fit = np.array(
                [
                    np.linalg.lstsq(rows[kept] / s[kept, None], m[kept] / s[kept], rcond=None)[0]
                    for m, s in zip(cells.mean, np.sqrt(cells.variance))
                ]
            )
            chi = np.sum((cells.mean - fit @ rows.T) ** 2 / cells.variance, axis=0)
            before, kept = kept, chi < _CHANGED_CHI2
            loss = np.minimum(chi, _CHANGED_CHI2).sum()
            if loss < best_loss and kept.mean() >= _UNCHANGED_SHARE:
                best, best_loss = fit, loss
            if np.array_equal(before, kept):
                break
    return best


def _starts(u, v):
    """Parts of the detector to start from: all, all but a quarter, halves, the outer ring."""
    yield np.ones(u.size, bool)
    for a, b in ((u, v), (-v, u), (-u, -v), (v, -u)):
        yield ~((a > 0) & (b > 0))
        yield a < 0.5
        yield a < 0
        yield (a < 0) | (a > 0.5)
    yield np.maximum(np.abs(u), np.abs(v)) > 0.5
    yield np.maximum(np.abs(u), np.abs(v)) < 0.75
    yield np.abs(u) > 0.3
    yield np.abs(v) > 0.3


def _amplitude(parts):
    """Root mean square of the change over the changed cells, minus the noise."""
    n = np.concatenate([cells.n[changed] for _, cells, changed in parts])
    square = np.concatenate(
        [np.sum(cells.mean**2 - cells.noise, axis=0)[changed] for _, cells, changed in parts]
    )
    return float(np.sqrt(max(np.sum(n * square) / np.sum(n), 0.0)))


def _rows(solution, n_grid, cells, changed):
    """Rows of the table of cells."""
    ny, nx = solution.image_shape
    x_min = (cells.index % n_grid) * (nx / n_grid) - 0.5
    y_min = (cells.index // n_grid) * (ny / n_grid) - 0.5
    return np.rec.fromarrays(
        [
            x_min, x_min + nx / n_grid, y_min, y_min + ny / n_grid, cells.n, *cells.mean,
            *np.sqrt(cells.variance), cells.p_value, changed,
        ],
        names="x_min,x_max,y_min,y_max,n,dx,dy,sigma_dx,sigma_dy,p_value,changed",
    )  # fmt: skip
