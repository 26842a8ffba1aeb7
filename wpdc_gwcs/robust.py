"""Robust estimates of scatter."""

import numpy as np

__all__ = ["plane_scatter", "robust_scatter", "robust_sigma"]

# Standard deviation of normal values over the median of their absolute values.
_MAD_TO_SIGMA = 1.482602218505602


def robust_scatter(values, *, axis=None):
    """Return the robust scatter of values: 1.4826 times the median absolute deviation.

    Parameters
    ----------
    values : array_like
        Values in any unit; NaN are ignored.
    axis : int, optional
        Axis along which it is computed; all by default.

    Returns
    -------
    float or ndarray
        Scatter in the unit of the values, the standard deviation if they are normal; NaN if empty.

    Examples
    --------
    >>> from wpdc_gwcs.robust import robust_scatter
    >>> round(robust_scatter([1.0, 2.0, 3.0, 1000.0]), 4)
    1.4826
    """
    values = np.asarray(values, dtype=float)
    if axis is None:
        values = values[np.isfinite(values)]
        if values.size == 0:
            return np.nan
    deviation = np.abs(values - np.nanmedian(values, axis=axis, keepdims=True))
    scatter = _MAD_TO_SIGMA * np.nanmedian(deviation, axis=axis)
    return float(scatter) if axis is None else scatter


def robust_sigma(values):
    """Return the robust scatter about zero: 1.4826 times the median absolute value.

    Parameters
    ----------
    values : (N,) array_like
        Residuals.

    Returns
    -------
    float
        Scatter in the unit of the values; NaN if there are none.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.fitting import robust_sigma
    >>> values = np.random.default_rng(1).normal(0, 2, 10000)
    >>> values[:100] = 1e6
    >>> round(robust_sigma(values), 1)
    2.0
    """
    return _MAD_TO_SIGMA * float(np.median(np.abs(values))) if len(values) else np.nan


def plane_scatter(dx, dy):
    """Return the scatter per axis from the median length of two-dimensional residuals.

    Parameters
    ----------
    dx, dy : (N,) ndarray
        Residuals along both axes.

    Returns
    -------
    float
        Scatter in their unit; NaN if there are none.

    Notes
    -----
    For Gaussian noise the squared length has its median at ``2 ln 2`` variances.
    """
    if len(dx) == 0:
        return np.nan
    return float(np.sqrt(np.median(dx**2 + dy**2) / (2 * np.log(2))))
