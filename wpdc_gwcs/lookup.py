"""The look-up table: what the polynomial leaves, averaged over many exposures and interpolated.

::

    residuals of a frame --ResidualMap.from_residuals--> bins --"+" over frames--> bins
    --build_lookup_table--> LookupTable
"""

import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial.legendre import legvander
from scipy.interpolate import CubicSpline, RBFInterpolator, RectBivariateSpline
from scipy.linalg import eigh, lapack, qr

from wpdc_gwcs.exceptions import FitError
from wpdc_gwcs.models import LookupTable

__all__ = ["ResidualMap", "TableChoice", "TableInfo", "build_lookup_table", "choose_table"]

log = logging.getLogger(__name__)

# Sums kept in every bin; w = 1 / sigma^2 with sigma^2 the mean of both axes.
_SUMS = (
    "n", "w", "wx", "wy", "wxx", "wxy", "wyy",
    "wdx", "wdy", "wdxdx", "wdxdy", "wdydy", "wwvx", "wwvy",
)  # fmt: skip

# Bins along the longer side of the detector; 128 px for the paper's 9216.
_BINS = 72

# Bins are made in multiples of this number, so that they can be joined by 2, 3 or 4.
_BLOCK = 12

# Stars per bin below which bins are joined further for the choice of settings.
_STARS_PER_BIN = 4

# Groups of exposures (or of stars, for one exposure) that cross-validation leaves out in turn.
N_FOLDS = 5


class ResidualMap:
    """Weighted residuals of any number of stars, binned over the detector, in constant memory.

    Parameters
    ----------
    image_shape : (int, int)
        Shape ``(ny, nx)`` of the detector in px.
    sums : (K, 14, my, mx) ndarray, optional
        Sums of an existing map, in the order of `ResidualMap.columns`; empty if not given.
    shape : (int, int), optional
        Bins ``(my, mx)``; about 72 along the longer side, in multiples of 12, if not given.

    Notes
    -----
    Each bin holds the count, the weights, the weighted moments of position up to the second and of
    the residuals up to the second, and the variance of the mean; separately for K = 5 groups of
    exposures, which cross-validation leaves out in turn.  Maps of the same geometry add up, in any
    order and grouping.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs import ResidualMap
    >>> x, y = np.random.default_rng(1).uniform(0, 2047, (2, 5000))
    >>> maps = [
    ...     ResidualMap.from_residuals(x[i::2], y[i::2], 0.1, -0.2, x_err=0.05, y_err=0.05,
    ...                                image_shape=(2048, 2048), fold=i) for i in range(2)
    ... ]
    >>> total = maps[0] + maps[1]
    >>> total.n_stars, float(np.nanmax(total.mean[0]))
    (5000, 0.1)
    """

    columns = _SUMS

    def __init__(self, image_shape, sums=None, *, shape=None):
        ny, nx = (int(n) for n in image_shape)
        if min(ny, nx) < 1:
            raise ValueError(f"image_shape must be two positive sizes, got {image_shape}")
        self.image_shape = (ny, nx)
        if sums is None:
            if shape is None:
                size = max(ny, nx) * _BLOCK / _BINS
                shape = (_BLOCK * max(1, round(ny / size)), _BLOCK * max(1, round(nx / size)))
            sums = np.zeros((N_FOLDS, len(_SUMS), *shape))
        sums = np.asarray(sums, dtype=float)
        if sums.ndim != 4 or sums.shape[:2] != (N_FOLDS, len(_SUMS)):
            raise ValueError(
                f"sums must have shape ({N_FOLDS}, {len(_SUMS)}, my, mx), got {sums.shape}"
            )
        self.sums = sums

    @classmethod
    def from_residuals(cls, x, y, dx, dy, *, x_err, y_err, image_shape, fold=0, shape=None):
        """Map of the residuals of one frame.

        Parameters
        ----------
        x, y : (N,) array_like
            Positions on the detector, px, zero based.
        dx, dy : (N,) or float array_like
            Residuals X' - X_ref and Y' - Y_ref, px.
        x_err, y_err : (N,) or float array_like
            1-sigma errors of the residuals, px.
        image_shape : (int, int)
            Shape ``(ny, nx)`` of the detector.
        fold : int or (N,) array_like of int, optional
            Group of the exposure (or of each star) in cross-validation; any integer.
        shape : (int, int), optional
            Bins ``(my, mx)``.

        Returns
        -------
        ResidualMap
            Stars off the detector, or with NaN or non-positive errors, are left out.
        """
        self = cls(image_shape, shape=shape)
        ny, nx = self.image_shape
        my, mx = self.shape
        values = np.broadcast_arrays(
            *(np.asarray(v, dtype=float).ravel() for v in (x, y, dx, dy, x_err, y_err)),
            np.asarray(fold).ravel(),
        )
        x, y, dx, dy, x_err, y_err, fold = values
        variance = 0.5 * (x_err**2 + y_err**2)
        good = np.isfinite(x + y + dx + dy + variance) & (variance > 0)
        good &= (x >= -0.5) & (x <= nx - 0.5) & (y >= -0.5) & (y <= ny - 0.5)
        x, y, dx, dy, x_err, y_err, fold, variance = (
            v[good] for v in (x, y, dx, dy, x_err, y_err, fold, variance)
        )
        ix = np.minimum(((x + 0.5) * (mx / nx)).astype(int), mx - 1)
        iy = np.minimum(((y + 0.5) * (my / ny)).astype(int), my - 1)
        index = ((fold.astype(int) % N_FOLDS) * my + iy) * mx + ix
        # Moments of position about the bin's centre, or the second ones would be differences of
        # large numbers.
        u = x - ((ix + 0.5) * (nx / mx) - 0.5)
        v = y - ((iy + 0.5) * (ny / my) - 0.5)
        w = 1.0 / variance
        terms = (
            np.ones_like(w), w, w * u, w * v, w * u * u, w * u * v, w * v * v, w * dx, w * dy,
            w * dx * dx, w * dx * dy, w * dy * dy, w * w * x_err**2, w * w * y_err**2,
        )  # fmt: skip
        for k, term in enumerate(terms):
            self.sums[:, k] = np.bincount(index, weights=term, minlength=N_FOLDS * my * mx).reshape(
                N_FOLDS, my, mx
            )
        return self

    def __add__(self, other):
        if not isinstance(other, ResidualMap):
            return NotImplemented
        if (self.image_shape, self.shape) != (other.image_shape, other.shape):
            raise ValueError(
                f"residual maps must be of one geometry: detector {self.image_shape} in "
                f"{self.shape} bins "
                f"and {other.image_shape} in {other.shape}"
            )
        return ResidualMap(self.image_shape, self.sums + other.sums)

    def __eq__(self, other):
        if not isinstance(other, ResidualMap):
            return NotImplemented
        return self.image_shape == other.image_shape and np.array_equal(self.sums, other.sums)

    __hash__ = None

    def __repr__(self):
        return f"<ResidualMap {self.image_shape} in {self.shape} bins, {self.n_stars} stars>"

    @property
    def shape(self):
        """Bins ``(my, mx)``."""
        return self.sums.shape[2:]

    @property
    def n_stars(self):
        """Stars in the map."""
        return int(round(self.sums[:, 0].sum()))

    @property
    def counts(self):
        """Stars in every bin ``(my, mx)``."""
        return self.sums[:, 0].sum(0)

    @property
    def folds(self):
        """Groups that hold stars."""
        return np.flatnonzero(self.sums[:, 0].sum((1, 2)) > 0)

    @property
    def mean(self):
        """Weighted mean residuals ``(2, my, mx)``, px; NaN where there are no stars."""
        total = self.sums.sum(0)
        with np.errstate(invalid="ignore", divide="ignore"):
            return total[7:9] / total[1]

    @property
    def sigma(self):
        """Standard errors of the mean residuals ``(2, my, mx)``, px, from the stars' errors."""
        total = self.sums.sum(0)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.sqrt(total[12:14]) / total[1]

    @property
    def centroid(self):
        """Weighted mean positions ``(2, my, mx)`` of the stars in every bin, px."""
        total = self.sums.sum(0)
        with np.errstate(invalid="ignore", divide="ignore"):
            return total[2:4] / total[1] + self._centers()

    def _centers(self):
        (ny, nx), (my, mx) = self.image_shape, self.shape
        cx = (np.arange(mx) + 0.5) * (nx / mx) - 0.5
        cy = (np.arange(my) + 0.5) * (ny / my) - 0.5
        return np.array(np.meshgrid(cx, cy))

    def coarsen(self, factor=2):
        """Join bins along both axes.

        Parameters
        ----------
        factor : int, optional
            Bins joined along each axis.

        Returns
        -------
        ResidualMap
            The same residuals in larger bins.

        Raises
        ------
        ValueError
            If the factor does not divide the numbers of bins.
        """
        my, mx = self.shape
        if my % factor or mx % factor:
            raise ValueError(f"factor {factor} does not divide the numbers of bins {self.shape}")
        ky, kx = my // factor, mx // factor
        coarse = ResidualMap(self.image_shape, shape=(ky, kx))
        s = self.sums
        # Moments move from the centres of the small bins to those of the large ones.
        ox, oy = self._centers() - coarse._centers().repeat(factor, axis=1).repeat(factor, axis=2)
        moved = s.copy()
        moved[:, 2] += s[:, 1] * ox
        moved[:, 3] += s[:, 1] * oy
        moved[:, 4] += 2 * s[:, 2] * ox + s[:, 1] * ox**2
        moved[:, 5] += s[:, 2] * oy + s[:, 3] * ox + s[:, 1] * ox * oy
        moved[:, 6] += 2 * s[:, 3] * oy + s[:, 1] * oy**2
        coarse.sums = moved.reshape(*s.shape[:2], ky, factor, kx, factor).sum((3, 5))
        return coarse

    def without(self, fold):
        """Leave one group out, for cross-validation.

        Parameters
        ----------
        fold : int
            Group left out.

        Returns
        -------
        ResidualMap
            Of the other groups.
        """
        sums = self.sums.copy()
        sums[fold] = 0.0
        return ResidualMap(self.image_shape, sums)

    def only(self, fold):
        """Keep one group alone.

        Parameters
        ----------
        fold : int
            Group kept.

        Returns
        -------
        ResidualMap
            Of that group.
        """
        sums = np.zeros_like(self.sums)
        sums[fold] = self.sums[fold]
        return ResidualMap(self.image_shape, sums)

    def to_tree(self):
        """Plain dictionary of numbers and arrays, for files.

        Returns
        -------
        dict
            Accepted by `from_tree`.
        """
        return {"image_shape": list(self.image_shape), "columns": list(_SUMS), "sums": self.sums}

    @classmethod
    def from_tree(cls, tree):
        """Inverse of `to_tree`.

        Parameters
        ----------
        tree : dict
            As given by `to_tree`.

        Returns
        -------
        ResidualMap
            Equal to the one written.

        Raises
        ------
        ValueError
            If the tree is of another layout.
        """
        if list(tree["columns"]) != list(_SUMS):
            raise ValueError(f"columns of the residual map must be {_SUMS}, got {tree['columns']}")
        return cls(tuple(tree["image_shape"]), np.array(tree["sums"], dtype=float))


@dataclass(frozen=True)
class TableChoice:
    """How a look-up table is interpolated from the bins.

    Parameters
    ----------
    kernel : str
        Kernel of `scipy.interpolate.RBFInterpolator`, or ``none`` for no table.
    degree : int
        Degree of the polynomial that the interpolator adds.
    smoothing : float
        Smoothing of a bin divided by the variance of its mean (px^2); positions in units of half
        the longer side.
    epsilon : float
        Shape parameter of the kernel in the same unit; 1 for kernels without a scale.
    score : float
        Cross-validated mean square of the normalised residuals; NaN if not measured.
    freedom : float
        Effective number of parameters per axis.
    """

    kernel: str
    degree: int = -1
    smoothing: float = np.nan
    epsilon: float = 1.0
    score: float = np.nan
    freedom: float = 0.0


# Kernel, shape parameter and least degree of its polynomial.  The Gaussian of length l has
# epsilon = 1 / (sqrt(2) l): from three times the detector to a thirteenth of it.
_BROAD_KERNELS = tuple(("gaussian", epsilon, 1) for epsilon in (0.25, 0.5, 1.0, 2.0))
_OPEN_KERNELS = (("thin_plate_spline", 1.0, 1), ("gaussian", 4.0, 1))
_NARROW_KERNELS = tuple(("gaussian", epsilon, 1) for epsilon in (3.0, 5.0, 6.0, 7.5, 9.0))
_MAX_DEGREE = 7

# Gaussians up to this epsilon are worth a low-rank factor; what it leaves out of a unit diagonal.
_FULL_RANK_EPSILON = 4.5
_LOW_RANK_TOLERANCE = 1e-11

# Smoothings tried, in units of the largest eigenvalue: from following every bin to all but none.
_SMOOTHINGS = 10.0 ** np.arange(-10.0, 3.01, 0.5)

# Nodes of the pilot surface along each axis.
_PILOT_NODES = 51

# Gain of generalised cross-validation at which kernels of short length are tried.
_NARROW_GAIN = 0.998

# Candidates that go from generalised cross-validation on to cross-validation over exposures.
_N_SHORTLIST = 4

# Fewer stars than this do not carry a table.
_MIN_STARS_TABLE = 60


def build_lookup_table(
    residual_map, n_grid=50, *, choice=None, lut="auto", method="cubic", draft=False
):
    """Look-up table from binned residuals, with kernel, degree and smoothing chosen from the data.

    Parameters
    ----------
    residual_map : ResidualMap or sequence of ResidualMap
        Residuals of one detector.  Maps of single exposures are put into groups for
        cross-validation in turn.
    n_grid : int, optional
        Nodes of the table along each axis.
    choice : TableChoice, optional
        Settings to use; chosen by cross-validation if not given.
    lut : {'auto', 'always', 'none'}, optional
        ``auto``: no table where none predicts left-out exposures at least as well; ``always``: the
        best table; ``none``: no table.
    method : {'cubic', 'linear'}, optional
        How the table interpolates between its nodes.
    draft : bool, optional
        Interpolate larger bins, without uncertainty and with settings that only one kernel
        was tried for: a small part of the time, for iterations.

    Returns
    -------
    table : LookupTable or None
        Displacements to subtract, on nodes from one outer edge of the detector to the other; `None`
        for no table.
    info : TableInfo
        The choice made, all candidates with their scores, and the uncertainty of the table at the
        nodes.

    Raises
    ------
    FitError
        If a table is asked for and the map holds too few stars or bins.

    Notes
    -----
    1. Bins are represented by their inverse-variance means at their weighted centroids.  A mean
       over a bin is not the value at its centroid: half the trace of Hessian times second moments
       is taken off, with a pilot surface.
    2. On larger bins, every kernel and length is diagonalised once, so that generalised
       cross-validation over all smoothings (twelve decades) and polynomial degrees costs next to
       nothing.
    3. The best few, and no table at all, are compared by leaving out one group of exposures after
       the other.
    4. The winner is interpolated on the fine bins by `scipy.interpolate.RBFInterpolator`, with
       smoothing proportional to the variance of each bin, and the nodes are those whose spline
       comes closest to it.

    The same smoother is the posterior mean of a Gaussian process whose covariance is the kernel
    divided by the smoothing; its posterior covariance, without the linear part that the attitudes
    carry, is the uncertainty at the nodes.

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
    elif residual_map.n_stars < _MIN_STARS_TABLE:
        choice = TableChoice("none")
    coarse = _coarse(residual_map)
    if choice is None:
        choice = _first_choice(_Bins(coarse))
    if choice.kernel == "none":
        return None, TableInfo(choice, candidates, None, np.nan)
    bins = _Bins(coarse)
    pilot = _pilot(bins, choice)
    ny, nx = residual_map.image_shape
    x_grid, y_grid = np.linspace(-0.5, nx - 0.5, n_grid), np.linspace(-0.5, ny - 0.5, n_grid)
    sigma, chi2 = None, np.nan
    if draft:
        surface = pilot
    else:
        sigma, chi2 = _node_sigma(bins, pilot, choice, x_grid, y_grid)
        fine = _Bins(residual_map)
        surface = _interpolate(fine, fine.debiased(pilot), choice)
    dx, dy = _fit_nodes(surface, bins, x_grid, y_grid)
    return LookupTable(x_grid, y_grid, dx, dy, method=method), TableInfo(
        choice, candidates, sigma, chi2
    )


def choose_table(residual_map, *, lut="auto"):
    """Kernel, degree and smoothing of a look-up table, chosen from the data.

    Parameters
    ----------
    residual_map : ResidualMap
        Residuals of one detector.
    lut : {'auto', 'always'}, optional
        Whether the answer may be that no table predicts best.

    Returns
    -------
    choice : TableChoice
        The best settings, for `build_lookup_table`.
    candidates : tuple of TableChoice
        All that were compared by cross-validation, best first.

    Raises
    ------
    FitError
        If a table is asked for and the map holds too few stars.
    """
    n = residual_map.n_stars
    if n < _MIN_STARS_TABLE:
        if lut == "always":
            raise FitError(f"{n} stars cannot carry a look-up table, {_MIN_STARS_TABLE} are needed")
        return TableChoice("none"), ()
    return _choose(_coarse(residual_map), allow_none=lut == "auto")


@dataclass(frozen=True, eq=False)
class TableInfo:
    """How a look-up table came about.

    Parameters
    ----------
    choice : TableChoice
        Settings used.
    candidates : tuple of TableChoice
        All that were compared by cross-validation, best first.
    sigma : (3, n, n) ndarray or None
        sigma_x and sigma_y in px and their correlation at the nodes.
    chi2 : float
        Reduced chi square of the bins about the table; near 1 where the errors of the stars are
        right.
    """

    choice: TableChoice
    candidates: tuple
    sigma: np.ndarray | None
    chi2: float


def _assign_folds(maps):
    """Sum of maps, each put into one group of the cross-validation in turn."""
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


def _coarse(residual_map):
    """Larger bins, on which every setting is tried: a smoother on M bins costs M^3."""
    my, mx = residual_map.shape
    factors = [k for k in (2, 3, 4) if my % k == 0 and mx % k == 0] or [1]
    enough = [k for k in factors if residual_map.n_stars * k * k >= _STARS_PER_BIN * my * mx]
    return residual_map.coarsen(enough[0] if enough else factors[-1])


class _Bins:
    """Occupied bins in normalised coordinates: centroids, means, variances, second moments."""

    def __init__(self, residual_map):
        total = residual_map.sums.sum(0)
        occupied = total[0] > 0
        t = total[:, occupied]
        ny, nx = residual_map.image_shape
        # Weighted sums over all groups but one may leave rounding errors, never negative counts.
        self.half = 0.5 * max(ny, nx)
        self.middle = np.array([0.5 * (nx - 1), 0.5 * (ny - 1)])
        offset = t[2:4] / t[1]
        centroid = offset + residual_map._centers()[:, occupied]
        self.u, self.v = (centroid - self.middle[:, None]) / self.half
        self.value = (t[7:9] / t[1]).T
        self.weight = t[1]
        # One variance serves both axes; how their noise differs is a property of the detector.
        ratio = t[12:14].sum(1) / t[1].sum()
        self.axis_scale = np.sqrt(ratio)
        self.variance = 1.0 / t[1]
        mxx = t[4] / t[1] - offset[0] ** 2
        mxy = t[5] / t[1] - offset[0] * offset[1]
        myy = t[6] / t[1] - offset[1] ** 2
        self.moments = np.array([mxx, mxy, myy]) / self.half**2
        self.count = t[0]

    def __len__(self):
        return len(self.u)

    def debiased(self, pilot):
        """Values at the centroids: means less the curvature of the pilot surface over each bin."""
        mxx, mxy, myy = self.moments[:, :, None]
        xx, xy, yy = pilot.hessian(self.u, self.v)
        return self.value - 0.5 * (mxx * xx + 2 * mxy * xy + myy * yy)


class _Pilot:
    """Smooth surface on a grid of nodes: values for a draft table, curvature for the bins."""

    def __init__(self, surface, bins):
        grids = [np.linspace(-1.0, 1.0, _PILOT_NODES) * m for m in (bins.middle + 0.5) / bins.half]
        u, v = np.meshgrid(*grids)
        values = surface(u.ravel(), v.ravel()).reshape(*u.shape, 2)
        self.splines = [RectBivariateSpline(*grids, values[:, :, k].T) for k in range(2)]

    def __call__(self, u, v):
        return np.stack([f(u, v, grid=False) for f in self.splines], axis=1)

    def hessian(self, u, v):
        """Second derivatives (xx, xy, yy), each ``(N, 2)``."""
        return [
            np.stack([f(u, v, dx=i, dy=2 - i, grid=False) for f in self.splines], axis=1)
            for i in (2, 1, 0)
        ]


def _kernel(name, epsilon, u, v, u2, v2):
    """Kernel matrix with the signs and scales of scipy's `RBFInterpolator`."""
    square = (epsilon * (u[:, None] - u2)) ** 2
    square += (epsilon * (v[:, None] - v2)) ** 2
    if name == "gaussian":
        return np.exp(np.negative(square, out=square), out=square)
    if name == "quintic":
        return -(square**2) * np.sqrt(square)
    # thin plate spline: r^2 log r
    return 0.5 * square * np.log(np.maximum(square, np.finfo(float).tiny))


def _polynomials(u, v, degree):
    """Products of Legendre polynomials up to a total degree, ``(N, p)``, lowest degrees first."""
    a, b = legvander(u, degree), legvander(v, degree)
    return np.stack(
        [a[:, n - j] * b[:, j] for n in range(degree + 1) for j in range(n + 1)], axis=1
    )


def _n_terms(degree):
    return (degree + 1) * (degree + 2) // 2


class _Spectrum:
    """One kernel diagonalised on the bins: cross-validation for all smoothings and degrees.

    With D = diag(sigma), the smoother minimises |D^-1 (d - f)|^2 + s |f|^2 in the kernel's norm.
    In the space orthogonal to the polynomials of the kernel's least degree, D^-1 K D^-1 = U L U^T;
    polynomials of higher degree are added by generalised least squares.
    """

    def __init__(self, bins, kernel, epsilon, least_degree):
        root = np.sqrt(bins.weight)
        p = _n_terms(least_degree)
        basis = _polynomials(bins.u, bins.v, _MAX_DEGREE) * root[:, None]
        (reflectors, tau), _ = qr(basis[:, :p], mode="raw")

        def rotate(matrix, side="L", transpose="T"):
            matrix = np.asfortranarray(matrix)
            work = 64 * max(matrix.shape)
            return lapack.dormqr(side, transpose, reflectors, tau, matrix, work, overwrite_c=1)[0]

        k = _kernel(kernel, epsilon, bins.u, bins.v, bins.u, bins.v)
        if kernel == "gaussian" and epsilon < _FULL_RANK_EPSILON:
            # Long lengths have few modes: K = F F^T of low rank, and the Gram matrix of F is small.
            factor = rotate(_low_rank(k) * root[:, None])[p:]
            squares, vectors = eigh(factor.T @ factor, overwrite_a=True, driver="evd")
            good = squares > 1e-14 * squares[-1]
            eigenvalues = squares[good]
            vectors = (factor @ vectors[:, good]) / np.sqrt(eigenvalues)
        else:
            k *= root[:, None]
            k *= root
            k = rotate(rotate(k), "R", "N")[p:, p:]
            eigenvalues, vectors = eigh(k, overwrite_a=True, driver="evd", check_finite=False)
        self.kernel, self.epsilon, self.least_degree = kernel, epsilon, least_degree
        self.n = len(bins)
        self.eigenvalues = np.maximum(eigenvalues, 0.0)
        self._vectors, self._basis, self._root = vectors, basis[:, p:], root
        self._rotate = lambda matrix: rotate(matrix)[p:]

    def scores(self, value, smoothing, degrees):
        """Generalised cross-validation and effective parameters, one row per degree."""
        target = self._rotate(np.hstack([value * self._root[:, None], self._basis]))
        modes = self._vectors.T @ target
        # What no mode reaches is all residual.
        rest = target.T @ target - modes.T @ modes
        n_rest = len(target) - len(modes)
        g = smoothing[:, None] / (self.eigenvalues + smoothing[:, None])
        q = modes.shape[1]
        # Products of data (first two) and polynomials, once and twice through the residual matrix.
        products = (modes[:, :, None] * modes[:, None, :]).reshape(-1, q * q)
        once = (g @ products).reshape(-1, q, q) + rest
        twice = (g**2 @ products).reshape(-1, q, q) + rest
        square = twice[:, 0, 0] + twice[:, 1, 1]
        trace = g.sum(1) + n_rest
        for degree in degrees:
            e = slice(2, 2 + _n_terms(degree) - _n_terms(self.least_degree))
            inverse = np.linalg.pinv(once[:, e, e], rcond=1e-13, hermitian=True)
            c = inverse @ once[:, e, :2]
            twice_c = twice[:, e, e] @ c
            left = square + np.sum(c * (twice_c - 2 * twice[:, e, :2]), axis=(1, 2))
            freedom = trace - np.sum(inverse * twice[:, e, e], axis=(1, 2))
            yield left * self.n / (2 * freedom**2), self.n - freedom


def _low_rank(kernel):
    """Factor F of a positive semi-definite matrix, K = F F^T, by pivoted Cholesky decomposition."""
    factor, pivots, rank, _ = lapack.dpstrf(kernel, tol=_LOW_RANK_TOLERANCE, lower=1)
    factor = np.tril(factor)[:, :rank]
    out = np.empty_like(factor)
    out[pivots - 1] = factor
    return out


def _choose(coarse, *, allow_none):
    """Kernel, degree and smoothing by generalised cross-validation, then by groups of exposures."""
    bins = _Bins(coarse)
    quintic = _Spectrum(bins, "quintic", 1.0, 2)
    pilot = _pilot(bins, _first_choice(bins, quintic))
    value = bins.debiased(pilot)
    narrow = _best_of(quintic, value)
    del quintic

    def try_all(kernels):
        return [c for k in kernels for c in _best_of(_Spectrum(bins, *k), value)]

    broad = try_all(_BROAD_KERNELS)
    narrow += try_all(_OPEN_KERNELS)
    # Splines and the medium length take structure of every size: where they are no better than the
    # broad kernels there is none for the narrow ones.
    if min(c.score for c in narrow) < _NARROW_GAIN * min(c.score for c in broad):
        narrow += try_all(_NARROW_KERNELS)
    found = broad + narrow
    found.sort(key=lambda c: c.score)
    candidates = [TableChoice("none"), *_distinct(found)]
    scores = _cross_validate(coarse, candidates, pilot)
    ranked = sorted(
        (replace(c, score=float(s)) for c, s in zip(candidates, scores)), key=lambda c: c.score
    )
    best = next(c for c in ranked if allow_none or c.kernel != "none")
    log.info("look-up table: %s", best)
    return best, tuple(ranked)


def _first_choice(bins, spectrum=None):
    """Reasonable settings at once: one kernel, generalised cross-validation."""
    if spectrum is None:
        spectrum = _Spectrum(bins, "quintic", 1.0, 2)
    return _best_of(spectrum, bins.value)[0]


def _best_of(spectrum, value):
    """Best smoothing of each degree, best first."""
    found = []
    smoothing = spectrum.eigenvalues.max() * _SMOOTHINGS
    degrees = [
        d for d in range(spectrum.least_degree, _MAX_DEGREE + 1) if 2 * _n_terms(d) <= spectrum.n
    ]
    for degree, (score, freedom) in zip(degrees, spectrum.scores(value, smoothing, degrees)):
        # A smoother that follows nearly every bin has no residuals to be judged by.
        score = np.where(freedom < 0.9 * spectrum.n, score, np.inf)
        k = int(np.argmin(score))
        found.append(
            TableChoice(
                spectrum.kernel,
                degree,
                float(smoothing[k]),
                spectrum.epsilon,
                float(score[k]),
                float(freedom[k]),
            )
        )
    return sorted(found, key=lambda c: c.score)


def _distinct(found):
    """Keep the best few of different kernels or lengths: neighbours in degree hardly differ."""
    kept = {}
    for c in found:
        kept.setdefault((c.kernel, c.epsilon), c)
    return list(kept.values())[:_N_SHORTLIST]


def _cross_validate(coarse, candidates, pilot):
    """Mean square normalised residual of left-out groups for each candidate."""
    folds = coarse.folds
    total = np.zeros(len(candidates))
    if len(folds) < 2:
        # One group alone: generalised cross-validation has the last word, and no table is judged by
        # the raw means.
        bins = _Bins(coarse)
        raw = np.sum(bins.value**2 * bins.weight[:, None]) / (2 * len(bins))
        return np.array([raw if c.kernel == "none" else c.score for c in candidates])
    n = 0
    for fold in folds:
        train, test = _Bins(coarse.without(fold)), _Bins(coarse.only(fold))
        value, truth = train.debiased(pilot), test.debiased(pilot)
        n += 2 * len(test)
        for k, candidate in enumerate(candidates):
            predicted = 0.0
            if candidate.kernel != "none":
                predicted = _solve(train, value, candidate)(test.u, test.v)
            total[k] += np.sum((truth - predicted) ** 2 * test.weight[:, None])
    return total / n


def _saddle(bins, choice):
    """Kernel matrix with smoothing, bordered by the polynomials."""
    basis = _polynomials(bins.u, bins.v, choice.degree)
    m, p = basis.shape
    matrix = np.zeros((m + p, m + p))
    matrix[:m, :m] = _kernel(choice.kernel, choice.epsilon, bins.u, bins.v, bins.u, bins.v)
    matrix[np.arange(m), np.arange(m)] += choice.smoothing * bins.variance
    matrix[:m, m:], matrix[m:, :m] = basis, basis.T
    return matrix


def _solve(bins, value, choice):
    """Smoothed surface through the bins: a function of (u, v) that returns ``(N, 2)``."""
    matrix = _saddle(bins, choice)
    right = np.zeros((len(matrix), 2))
    right[: len(bins)] = value
    solution = np.linalg.solve(matrix, right)

    def surface(u, v):
        out = _polynomials(u, v, choice.degree) @ solution[len(bins) :]
        return (
            out
            + _kernel(choice.kernel, choice.epsilon, u, v, bins.u, bins.v) @ solution[: len(bins)]
        )

    return surface


def _pilot(bins, choice):
    """Smooth surface on the coarse bins whose curvature corrects bin means, in two rounds."""
    first = _Pilot(_solve(bins, bins.value, choice), bins)
    return _Pilot(_solve(bins, bins.debiased(first), choice), bins)


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
    # The spline is linear in its nodes: one pseudo-inverse per axis.
    inverse = [np.linalg.pinv(CubicSpline(g, np.eye(len(g)))(f)) for g, f in zip(grids, fine)]
    nodes = np.einsum("ia,jb,abk->kij", inverse[1], inverse[0], sampled, optimize=True)
    return nodes


def _node_sigma(bins, pilot, choice, x_grid, y_grid):
    """Posterior sigma of the surface at the nodes without its linear part, and reduced chi2."""
    matrix = _saddle(bins, choice)
    m, p = len(bins), len(matrix) - len(bins)
    u, v = (
        a.ravel()
        for a in np.meshgrid(*((g - c) / bins.half for g, c in zip((x_grid, y_grid), bins.middle)))
    )
    cross = np.zeros((m + p, len(u)))
    cross[:m] = _kernel(choice.kernel, choice.epsilon, bins.u, bins.v, u, v)
    cross[m:] = _polynomials(u, v, choice.degree).T
    right = np.zeros((m + p, 2))
    right[:m] = bins.debiased(pilot)
    solved = np.linalg.solve(matrix, np.hstack([cross, right, np.eye(m + p, m)]))
    fit = right[:m] - (choice.smoothing * bins.variance)[:, None] * solved[:m, len(u) : len(u) + 2]
    freedom = m - choice.smoothing * np.sum(bins.variance * np.diagonal(solved[:m, len(u) + 2 :]))
    residual = (right[:m] - fit) ** 2 * bins.weight[:, None]
    chi2 = float(residual.sum() / (2 * max(m - freedom, 1.0)))
    solved = solved[:, : len(u)]

    def apply(vectors):
        prior = _kernel(choice.kernel, choice.epsilon, u, v, u, v) @ vectors
        return (prior - cross.T @ (solved @ vectors)) / choice.smoothing

    diagonal = np.diagonal(_kernel(choice.kernel, choice.epsilon, u[:1], v[:1], u[:1], v[:1]))
    variance = (diagonal - np.einsum("ij,ij->j", cross, solved)) / choice.smoothing
    linear = np.linalg.qr(np.stack([np.ones_like(u), u, v], axis=1))[0]
    image = apply(linear)
    variance -= 2 * np.einsum("ij,ij->i", image, linear)
    variance += np.einsum("ij,jk,ik->i", linear, linear.T @ image, linear)
    sigma = np.sqrt(np.maximum(variance, 0.0) * max(chi2, 0.25)).reshape(len(y_grid), len(x_grid))
    return np.array(
        [sigma * bins.axis_scale[0], sigma * bins.axis_scale[1], np.zeros_like(sigma)]
    ), chi2
