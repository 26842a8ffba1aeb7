"""Weighted linear least squares by QR and SVD."""

from typing import NamedTuple

import numpy as np

from wpdc_gwcs.counts import counted
from wpdc_gwcs.exceptions import FitError

__all__ = ["LinearSolution", "solve_linear"]


class LinearSolution(NamedTuple):
    """Weighted linear least squares, see `solve_linear`.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.fitting import solve_linear
    >>> x = np.arange(5.0)
    >>> solution = solve_linear(np.column_stack([np.ones(5), x]), 3 + 2 * x, leverage=True)
    >>> solution.leverage.round(3).tolist()
    [0.6, 0.3, 0.2, 0.3, 0.6]
    >>> covariance = solution.root @ solution.root.T
    >>> covariance.round(3).tolist()
    [[0.6, -0.2], [-0.2, 0.1]]
    """

    parameters: np.ndarray
    rank: int
    condition: float
    root: np.ndarray  # (p, p): root @ root.T = inverse of the weighted normal matrix
    leverage: np.ndarray | None


def solve_linear(design, target, weight=None, *, leverage=False):
    """Minimize ``sum(weight * (target - design @ p)**2)`` by QR and SVD of scaled columns.

    Parameters
    ----------
    design : (N, p) ndarray
        Columns of the linear model.
    target : (N,) or (N, k) ndarray
        Values to fit; several right-hand sides share the factorization.
    weight : (N,) ndarray, optional
        Weights of the squared residuals.  Default: 1.
    leverage : bool, optional
        Whether to return the diagonal of the hat matrix as well.

    Returns
    -------
    LinearSolution
        Parameters ``(p,)`` or ``(p, k)``, and the rank and condition number of the scaled, weighted
        columns.

    Raises
    ------
    FitError
        If there are fewer rows of non-zero weight than columns, or the columns are not independent.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.fitting import solve_linear
    >>> x = np.arange(5.0)
    >>> solution = solve_linear(np.column_stack([np.ones(5), x]), 3 + 2 * x)
    >>> solution.parameters.round(12).tolist(), int(solution.rank)
    ([3.0, 2.0], 2)
    """
    n, p = design.shape
    if weight is not None:
        root_weight = np.sqrt(weight)
        n = int(np.count_nonzero(root_weight))
        design = design * root_weight[:, None]
        target = target * (root_weight if target.ndim == 1 else root_weight[:, None])
    if n < p:
        raise FitError(
            f"{counted(n, 'star')} of non-zero weight cannot determine {counted(p, 'coefficient')}"
        )
    scale = np.sqrt(np.einsum("ij,ij->j", design, design))
    if not np.all(scale > 0):
        raise FitError(
            f"{int(np.sum(~(scale > 0)))} of {p} coefficients cannot be determined: "
            "their terms or the weights are zero at all stars"
        )
    # After the QR, the SVD is that of a small triangle, for any number of stars.
    q, r = np.linalg.qr(design / scale)
    u, s, vt = np.linalg.svd(r)
    rank = int(np.sum(s > s[0] * p * np.finfo(float).eps))
    if rank < p:
        raise FitError(
            f"the {n} stars determine only {rank} of {p} coefficients: they lie too close "
            "together or on one line"
        )
    root = (vt.T / s) / scale[:, None]
    parameters = root @ (u.T @ (q.T @ target))
    hat = np.einsum("ij,ij->i", q, q) if leverage else None
    return LinearSolution(parameters, rank, float(s[0] / s[-1]), root, hat)
