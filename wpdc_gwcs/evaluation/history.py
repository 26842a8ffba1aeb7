"""A detector over time: residuals and drift, period by period, cell by cell.

::

    frames in order of time --periods--> statistics, test for a drift, means in cells --> History
"""

from dataclasses import dataclass

import numpy as np
from astropy.table import QTable, Table

from wpdc_gwcs.evaluation.drift import detect_drift, mean_in_cells
from wpdc_gwcs.evaluation.residuals import evaluate

__all__ = ["DriftHistory", "split_periods", "track_drift"]

# Cells along each side whose means are tracked: small enough to locate a change, large enough to
# have stars every night.
_GRID = 4
_DAYS_PER_YEAR = 365.25


@dataclass(frozen=True, eq=False)
class DriftHistory:
    """Residuals and drift of a detector with a stored solution over time.

    Parameters
    ----------
    detector : str
        Name of the detector.
    image_shape : (int, int)
        Shape ``(ny, nx)`` in px.
    periods : `~astropy.table.QTable`
        One row for each period: ``first_epoch``, ``last_epoch`` (Julian years), ``n_frames``,
        ``n_stars``, clipped ``mean_dx``, ``sigma_dx``, ``mean_dy``, ``sigma_dy`` (px), and from
        `detect_drift` ``p_value``, ``drifted``, ``amplitude`` (px) and ``area``; ``p_value`` is NaN
        for a period with too few stars.
    cells : `~astropy.table.QTable`
        Means in 4 x 4 cells for each period: ``period`` (row of ``periods``), ``x_min``,
        ``x_max``, ``y_min``, ``y_max``, ``n``, ``dx``, ``dy``, ``sigma_dx``, ``sigma_dy`` (px).

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import Table
    >>> from wpdc_gwcs import DistortionSolution, PVPolynomial, track_drift
    >>> cd, crpix, crval = np.diag([-2e-5, 2e-5]), np.array([499.5, 499.5]), np.array([10.0, 20.0])
    >>> solution = DistortionSolution("d", (1000, 1000), crpix, cd, crval, PVPolynomial())
    >>> rng, periods = np.random.default_rng(1), []
    >>> for year, bend in ((2020.0, 0.0), (2021.0, 0.03)):
    ...     x, y = rng.uniform(0, 999, (2, 4000))
    ...     dx, dy = rng.normal(0, 0.05, (2, 4000))
    ...     dx[x < 500] += bend * np.sin(y[x < 500] / 150)
    ...     table = Table({"x": x, "y": y, "dx": dx, "dy": dy, "used": x >= 0})
    ...     table["x_err"] = table["y_err"] = 0.05
    ...     periods.append(([year], [table]))
    >>> history = track_drift(solution, periods)
    >>> history.periods["drifted"].tolist(), len(history.cells) // len(history.periods)
    ([False, True], 16)
    """

    detector: str
    image_shape: tuple
    periods: QTable
    cells: QTable

    @property
    def alarms(self):
        """Rows of the periods in which the solution did not hold."""
        return self.periods[self.periods["drifted"]]


def split_periods(epochs, days):
    """Group frames into periods of equal length.

    Parameters
    ----------
    epochs : (N,) array_like
        Julian years.
    days : float
        Length of a period, counted from the first epoch.

    Returns
    -------
    list of (M,) ndarray of int
        Indices of the frames of each period that is not empty, in order of time.

    Raises
    ------
    ValueError
        If an epoch is not finite, or ``days`` not positive.

    Examples
    --------
    >>> from wpdc_gwcs.evaluation import split_periods
    >>> [p.tolist() for p in split_periods([2020.5, 2020.0, 2020.001], 30.0)]
    [[1, 2], [0]]
    """
    epochs = np.asarray(epochs, float)
    if not np.isfinite(epochs).all():
        raise ValueError("every frame must have an epoch")
    if not 0 < days < np.inf:
        raise ValueError(f"days must be positive, got {days}")
    if not epochs.size:
        return []
    # Rounding of epochs: microseconds.
    number = np.floor((epochs - epochs.min()) * _DAYS_PER_YEAR / days + 1e-9).astype(int)
    order = np.argsort(epochs, kind="stable")
    return [order[number[order] == k] for k in np.unique(number)]


def track_drift(solution, periods, *, false_alarm=0.01):
    """Test a stored solution over time, period by period.

    Parameters
    ----------
    solution : DistortionSolution
        The stored solution.
    periods : iterable of (epochs, matches)
        Epochs of the frames of a period (Julian years or NaN), and their match tables as for
        `detect_drift`: of frames that were calibrated with this solution, or else from
        `residuals_of_attitude`.  Periods are processed one by one and not kept.
    false_alarm : float, optional
        Accepted probability of an alarm in a period without a change; for many periods, divide
        the total by their number.

    Returns
    -------
    DriftHistory
        One row per period.

    Raises
    ------
    ValueError
        If there is no period, or ``false_alarm`` is not between 0 and 1.

    Examples
    --------
    >>> from wpdc_gwcs import calibrate, simulate, track_drift
    >>> sky = simulate(3, image_shape=(1000, 1000), density=30, distortion=10, seed=2)
    >>> run = calibrate([exposure.frame() for exposure in sky.exposures], sky.reference)
    >>> periods = [([2016.0], [calibration.matches]) for calibration in run.calibrations]
    >>> history = track_drift(run.solutions["sim"], periods)
    >>> len(history.periods)
    3
    """
    rows, cells = [], []
    for k, (epochs, matches) in enumerate(periods):
        matches = list(matches)
        used = [np.asarray(table["used"], bool) for table in matches]
        chosen = [table[mask] for table, mask in zip(matches, used, strict=True)]
        every = [
            np.concatenate([np.asarray(table[name], float) for table in chosen])
            for name in ("dx", "dy")
        ]
        statistics = evaluate(*every)
        row = {
            "first_epoch": float(np.min(epochs)), "last_epoch": float(np.max(epochs)),
            "n_frames": len(matches), "n_stars": len(every[0]),
            **{n: getattr(statistics, n) for n in ("mean_dx", "sigma_dx", "mean_dy", "sigma_dy")},
            "p_value": np.nan, "drifted": False, "amplitude": 0.0, "area": 0.0,
        }  # fmt: skip
        means = mean_in_cells(solution, matches, _GRID)
        if len(means):
            drift = detect_drift(solution, matches, false_alarm=false_alarm)
            row |= {n: getattr(drift, n) for n in ("p_value", "drifted", "amplitude", "area")}
        means.add_column(np.full(len(means), k), name="period", index=0)
        rows.append(row)
        cells.append(means)
    if not rows:
        raise ValueError("no period was given")
    table = QTable(rows)
    for name in ("mean_dx", "sigma_dx", "mean_dy", "sigma_dy", "amplitude"):
        table[name].unit = "pix"
    joined = Table(np.concatenate([np.asarray(c) for c in cells]))
    for name in cells[0].colnames:
        joined[name].unit = cells[0][name].unit
    shape = tuple(int(n) for n in solution.image_shape)
    return DriftHistory(solution.detector, shape, table, QTable(joined))
