"""The look-up table: nodes, and their uncertainty."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline, RBFInterpolator

from wpdc_gwcs.exceptions import FitError
from wpdc_gwcs.lookup._smoother import (
    Bins,
    TableChoice,
    kernel_matrix,
    pilot_surface,
    polynomials,
    saddle,
)
from wpdc_gwcs.lookup.choice import carries_table, choose_table, first_choice, join_bins
from wpdc_gwcs.lookup.residual_map import N_FOLDS, ResidualMap
from wpdc_gwcs.models import LookupTable

__all__ = ["TableInfo", "build_lookup_table"]


def build_lookup_table(
    residual_map, n_grid=50, *, choice=None, lut="auto", method="cubic", draft=False
):
    """Build a look-up table from binned residuals, with settings chosen from the data.

    Parameters
    ----------
    residual_map : ResidualMap or sequence of ResidualMap
        Residuals of one detector.  Of several maps, one for each exposure, each goes into the next
        group of the cross-validation.
    n_grid : int, optional
        Nodes of the table along each axis.
    choice : TableChoice, optional
        Settings to use.  Default: chosen by cross-validation.
    lut : {'auto', 'always', 'none'}, optional
        ``auto``: the best table, unless left-out exposures are predicted as well without one;
        ``always``: the best table; ``none``: no table.
    method : {'cubic', 'linear'}, optional
        Interpolation of the table between its nodes.
    draft : bool, optional
        Whether to save time in iterations: larger bins, a single kernel, and no uncertainty.

    Returns
    -------
    table : LookupTable or None
        Displacements to subtract, px, on nodes from one outer edge of the detector to the other;
        `None` for no table.
    info : TableInfo
        The settings used, all candidates with their scores, and the uncertainty at the nodes.

    Raises
    ------
    FitError
        If ``lut`` is ``always`` and the map has too few stars or bins, or if there is no map.
    ValueError
        If ``lut`` has a wrong value, or ``n_grid`` is not between 4 and 1000.

    Notes
    -----
    1. Each bin is represented by its inverse-variance mean at its weighted centroid.  The mean over
       a bin differs from the value at its centroid by half the trace of the Hessian times the
       second moments; a pilot surface provides the Hessian, and the difference is subtracted.
    2. On larger bins, each kernel and length is diagonalized once.  Generalized cross-validation
       over all smoothings (thirteen decades) and polynomial degrees then costs almost nothing.
    3. The best few settings, and no table at all, are compared by leaving out one group of
       exposures at a time.
    4. `scipy.interpolate.RBFInterpolator` interpolates the fine bins with the best settings and a
       smoothing proportional to the variance of each bin.  The nodes are those whose spline is
       closest to this surface.

    The smoother is also the posterior mean of a Gaussian process whose covariance is the kernel
    divided by the smoothing.  The posterior covariance of this process, without the linear part
    that belongs to the attitudes, is the uncertainty at the nodes.

    References
    ----------
    WPDC-2P, arXiv:2603.09193, section 3.3; Wahba (1990), Spline Models for Observational Data,
    chapters 4 and 5.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs import ResidualMap, build_lookup_table
    >>> rng = np.random.default_rng(1)
    >>> x, y = rng.uniform(0, 2047, (2, 4000))
    >>> dx, dy = np.sin(x / 300) + rng.normal(0, 0.05, (2, 4000))
    >>> bins = ResidualMap.from_residuals(
    ...     x, y, dx, dy, x_err=0.05, y_err=0.05, image_shape=(2048, 2048)
    ... )
    >>> table, info = build_lookup_table(bins, 20)
    >>> bool(abs(table(1000.0, 1000.0)[0] - np.sin(1000 / 300)) < 0.02)
    True
    """
    if lut not in ("auto", "always", "none"):
        raise ValueError(f"lut must be 'auto', 'always' or 'none', got {lut!r}")
    if not 4 <= n_grid <= 1000:
        raise ValueError(f"n_grid must be between 4 and 1000, got {n_grid}")
    if not isinstance(residual_map, ResidualMap):
        residual_map = _assign_folds(residual_map)
    candidates = ()
    if lut == "none":
        choice = TableChoice("none")
    elif choice is None and not draft:
        choice, candidates = choose_table(residual_map, lut=lut)
    elif not carries_table(residual_map):
        choice = TableChoice("none")
    coarse = join_bins(residual_map)
    if choice is None:
        choice = first_choice(Bins(coarse))
    if choice.kernel == "none":
        return None, TableInfo(choice, candidates, None, np.nan)
    bins = Bins(coarse)
    pilot = pilot_surface(bins, choice)
    ny, nx = residual_map.image_shape
    x_grid, y_grid = np.linspace(-0.5, nx - 0.5, n_grid), np.linspace(-0.5, ny - 0.5, n_grid)
    sigma, chi2 = None, np.nan
    if draft:
        surface = pilot
    else:
        sigma, chi2 = _node_sigma(bins, pilot, choice, x_grid, y_grid)
        fine = Bins(residual_map)
        surface = _interpolate(fine, fine.debiased(pilot), choice)
    dx, dy = _fit_nodes(surface, bins, x_grid, y_grid)
    return LookupTable(x_grid, y_grid, dx, dy, method=method), TableInfo(
        choice, candidates, sigma, chi2
    )


@dataclass(frozen=True, eq=False)
class TableInfo:
    """Settings, scores and uncertainty of a look-up table.

    Parameters
    ----------
    choice : TableChoice
        Settings used.
    candidates : tuple of TableChoice
        All settings that were compared by cross-validation, best first.
    sigma : (3, n, n) ndarray or None
        sigma_x and sigma_y in px, and their correlation, at the nodes; `None` for a draft.
    chi2 : float
        Reduced chi square of the bins about the table, which is near 1 if the errors of the stars
        are correct.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs import ResidualMap, build_lookup_table
    >>> rng = np.random.default_rng(1)
    >>> x, y = rng.uniform(0, 1000, (2, 1500))
    >>> dx, dy = np.sin(x / 300) + rng.normal(0, 0.05, (2, 1500))
    >>> bins = ResidualMap.from_residuals(
    ...     x, y, dx, dy, x_err=0.05, y_err=0.05, image_shape=(1000, 1000)
    ... )
    >>> table, info = build_lookup_table(bins, 10)
    >>> info.choice == info.candidates[0], round(info.chi2), info.sigma.shape
    (True, 1, (3, 10, 10))
    """

    choice: TableChoice
    candidates: tuple
    sigma: np.ndarray | None
    chi2: float


def _assign_folds(maps):
    """Sum of maps, each of which goes into the next group of the cross-validation."""
    maps = list(maps)
    if not maps:
        raise FitError("no residual map was given")
    if len(maps) == 1:
        return maps[0]
    total = ResidualMap(maps[0].image_shape, shape=maps[0].shape)
    for k, one in enumerate(maps):
        moved = ResidualMap(one.image_shape, shape=one.shape)
        moved.sums[k % N_FOLDS] = one.sums.sum(0)
        total = total + moved
    return total


def _interpolate(bins, value, choice):
    """Interpolate the final surface with scipy: a function of (u, v)."""
    interpolator = RBFInterpolator(
        np.stack([bins.u, bins.v], axis=1),
        value,
        kernel=choice.kernel,
        degree=choice.degree,
        epsilon=choice.epsilon,
        smoothing=choice.smoothing * bins.variance,
    )
    return lambda u, v: interpolator(np.stack([u, v], axis=1))


def _fit_nodes(surface, bins, x_grid, y_grid):
    """Nodes whose cubic spline is closest to the surface, sampled twice as densely."""
    grids = [(g - m) / bins.half for g, m in zip((x_grid, y_grid), bins.middle)]
    fine = [np.linspace(g[0], g[-1], 2 * len(g) - 1) for g in grids]
    u, v = np.meshgrid(*fine)
    sampled = surface(u.ravel(), v.ravel()).reshape(*u.shape, 2)
    # The spline is linear in its nodes, so one pseudo-inverse per axis suffices.
    inverse = [np.linalg.pinv(CubicSpline(g, np.eye(len(g)))(f)) for g, f in zip(grids, fine)]
    nodes = np.einsum("ia,jb,abk->kij", inverse[1], inverse[0], sampled, optimize=True)
    return nodes


def _node_sigma(bins, pilot, choice, x_grid, y_grid):
    """Posterior sigma of the surface at the nodes without its linear part, and reduced chi2."""
    matrix = saddle(bins, choice)
    m, p = len(bins), len(matrix) - len(bins)
    u, v = (
        a.ravel()
        for a in np.meshgrid(*((g - c) / bins.half for g, c in zip((x_grid, y_grid), bins.middle)))
    )
    cross = np.zeros((m + p, len(u)))
    cross[:m] = kernel_matrix(choice.kernel, choice.epsilon, bins.u, bins.v, u, v)
    cross[m:] = polynomials(u, v, choice.degree).T
    right = np.zeros((m + p, 2))
    right[:m] = bins.debiased(pilot)
    solved = np.linalg.solve(matrix, np.hstack([cross, right, np.eye(m + p, m)]))
    fit = right[:m] - (choice.smoothing * bins.variance)[:, None] * solved[:m, len(u) : len(u) + 2]
    freedom = m - choice.smoothing * np.sum(bins.variance * np.diagonal(solved[:m, len(u) + 2 :]))
    residual = (right[:m] - fit) ** 2 * bins.weight[:, None]
    chi2 = float(residual.sum() / (2 * max(m - freedom, 1.0)))
    solved = solved[:, : len(u)]

    def apply(vectors):
        prior = kernel_matrix(choice.kernel, choice.epsilon, u, v, u, v) @ vectors
        return (prior - cross.T @ (solved @ vectors)) / choice.smoothing

    diagonal = np.diagonal(kernel_matrix(choice.kernel, choice.epsilon, u[:1], v[:1], u[:1], v[:1]))
    variance = (diagonal - np.einsum("ij,ij->j", cross, solved)) / choice.smoothing
    linear = np.linalg.qr(np.stack([np.ones_like(u), u, v], axis=1))[0]
    image = apply(linear)
    variance -= 2 * np.einsum("ij,ij->i", image, linear)
    variance += np.einsum("ij,jk,ik->i", linear, linear.T @ image, linear)
    sigma = np.sqrt(np.maximum(variance, 0.0) * max(chi2, 0.25)).reshape(len(y_grid), len(x_grid))
    return np.array(
        [sigma * bins.axis_scale[0], sigma * bins.axis_scale[1], np.zeros_like(sigma)]
    ), chi2
