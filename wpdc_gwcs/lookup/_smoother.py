"""Smooth surfaces through binned residuals.

The numerical methods for the table: kernels as in `scipy.interpolate.RBFInterpolator`, spectra for
cross-validation, and pilot surfaces for the curvature within bins.
"""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import legvander
from scipy.interpolate import RectBivariateSpline
from scipy.linalg import eigh, lapack, lu_factor, lu_solve, qr

MAX_DEGREE = 7

# Gaussians up to this epsilon are worth a low-rank factor; what it leaves out of a unit diagonal.
_FULL_RANK_EPSILON = 3.5
_LOW_RANK_TOLERANCE = 1e-11

# Parameters that a kernel adds to its polynomial, below which it adds nothing.
_FLAT = 0.1

# Nodes of the pilot surface along each axis.
_PILOT_NODES = 51


@dataclass(frozen=True)
class TableChoice:
    """Settings for the interpolation of a look-up table from the bins.

    Parameters
    ----------
    kernel : str
        Kernel of `scipy.interpolate.RBFInterpolator`, or ``none`` for no table.
    degree : int
        Degree of the polynomial that the interpolator adds.
    smoothing : float
        Smoothing of a bin divided by the variance of its mean (px^2), for positions in units of
        half the longer side.
    epsilon : float
        Shape parameter of the kernel for positions in this unit; 1 for kernels without a scale.
    score : float
        Cross-validated mean square of the normalized residuals; NaN if not measured.
    freedom : float
        Effective number of parameters per axis.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs import ResidualMap
    >>> from wpdc_gwcs.lookup import choose_table
    >>> x, y = np.random.default_rng(1).uniform(0, 1000, (2, 1500))
    >>> dx, dy = np.sin(x / 100) + np.random.default_rng(2).normal(0, 0.1, (2, 1500))
    >>> bins = ResidualMap.from_residuals(
    ...     x, y, dx, dy, x_err=0.1, y_err=0.1, image_shape=(1000, 1000)
    ... )
    >>> choice, candidates = choose_table(bins)
    >>> choice.kernel, choice.freedom > 10, choice.score <= candidates[-1].score
    ('gaussian', True, True)
    """

    kernel: str
    degree: int = -1
    smoothing: float = np.nan
    epsilon: float = 1.0
    score: float = np.nan
    freedom: float = 0.0

    @property
    def flat(self):
        """Whether the smoothing leaves nothing but the polynomial."""
        return 0 <= self.freedom - n_terms(self.degree) < _FLAT


class Bins:
    """Occupied bins in normalized coordinates: centroids, means, variances, second moments."""

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


class Pilot:
    """Smooth surface on a grid of nodes: values for a draft table, curvature for the bins."""

    def __init__(self, surface, bins):
        grids = [np.linspace(-1.0, 1.0, _PILOT_NODES) * m for m in (bins.middle + 0.5) / bins.half]
        u, v = np.meshgrid(*grids)
        values = surface(u.ravel(), v.ravel()).reshape(*u.shape, 2)
        self.splines = [RectBivariateSpline(*grids, values[:, :, k].T) for k in range(2)]

    def __call__(self, u, v):
        """Evaluate the surface, ``(N, 2)``."""
        return np.stack([f(u, v, grid=False) for f in self.splines], axis=1)

    def hessian(self, u, v):
        """Second derivatives (xx, xy, yy), each ``(N, 2)``."""
        return [
            np.stack([f(u, v, dx=i, dy=2 - i, grid=False) for f in self.splines], axis=1)
            for i in (2, 1, 0)
        ]


def kernel_matrix(name, epsilon, u, v, u2, v2):
    """Kernel matrix with the signs and scales of `scipy.interpolate.RBFInterpolator`."""
    square = (epsilon * (u[:, None] - u2)) ** 2
    square += (epsilon * (v[:, None] - v2)) ** 2
    if name == "gaussian":
        return np.exp(np.negative(square, out=square), out=square)
    if name == "quintic":
        return -(square**2) * np.sqrt(square)
    # thin plate spline: r^2 log r
    return 0.5 * square * np.log(np.maximum(square, np.finfo(float).tiny))


def polynomials(u, v, degree):
    """Products of Legendre polynomials up to a total degree, ``(N, p)``, lowest degrees first."""
    a, b = legvander(u, degree), legvander(v, degree)
    return np.stack(
        [a[:, n - j] * b[:, j] for n in range(degree + 1) for j in range(n + 1)], axis=1
    )


def n_terms(degree):
    """Count the polynomials up to a total degree."""
    return (degree + 1) * (degree + 2) // 2


class Spectrum:
    """One kernel in modes of the bins: cross-validation for all smoothings and degrees.

    With D = diag(sigma), the smoother minimizes |D^-1 (d - f)|^2 + s |f|^2 in the kernel's norm.
    In the space orthogonal to the polynomials of the kernel's least degree, D^-1 K D^-1 = U T U^T
    with a tridiagonal T, which takes a third of the time of a diagonal one; polynomials of higher
    degree are added by generalized least squares.
    """

    def __init__(self, bins, kernel, epsilon, least_degree):
        root = np.sqrt(bins.weight)
        p = n_terms(least_degree)
        basis = polynomials(bins.u, bins.v, MAX_DEGREE) * root[:, None]
        (reflectors, tau), _ = qr(basis[:, :p], mode="raw")

        def rotate(matrix, side="L", transpose="T"):
            return _rotated(matrix, reflectors, tau, side, transpose)

        k = kernel_matrix(kernel, epsilon, bins.u, bins.v, bins.u, bins.v)
        if kernel == "gaussian" and epsilon < _FULL_RANK_EPSILON:
            # Kernels of long lengths have few modes: K = F F^T has low rank, and F^T F is small.
            factor = rotate(_low_rank(k) * root[:, None])[p:]
            squares, vectors = eigh(factor.T @ factor, overwrite_a=True, driver="evd")
            good = squares > 1e-14 * squares[-1]
            eigenvalues = squares[good]
            vectors = (factor @ vectors[:, good]) / np.sqrt(eigenvalues)
            self._tridiagonal = eigenvalues, np.zeros(len(eigenvalues) - 1)
            self._modes = lambda target: vectors.T @ target
        else:
            k *= root[:, None]
            k *= root
            k = np.asfortranarray(rotate(rotate(k), "R", "N")[p:, p:])
            work = int(lapack.dsytrd_lwork(len(k), lower=1)[0])
            k, *self._tridiagonal, taus, _ = lapack.dsytrd(k, lower=1, lwork=work, overwrite_a=1)
            eigenvalues, _ = lapack.dsterf(*self._tridiagonal)
            # The reflectors leave the first coordinate alone.
            k = np.asfortranarray(k[1:, :-1])
            self._modes = lambda target: np.vstack([target[:1], _rotated(target[1:], k, taus)])
        self.kernel, self.epsilon, self.least_degree = kernel, epsilon, least_degree
        self.n = len(bins)
        self.eigenvalues = np.maximum(eigenvalues, 0.0)
        self._basis, self._root = basis[:, p:], root
        self._rotate = lambda matrix: rotate(matrix)[p:]

    def scores(self, value, smoothing, degrees):
        """Generalized cross-validation and effective parameters, one row per degree."""
        target = self._rotate(np.hstack([value * self._root[:, None], self._basis]))
        modes = self._modes(target)
        # The part that no mode represents is all residual.
        rest = target.T @ target - modes.T @ modes
        n_rest = len(target) - len(modes)
        diagonal, beside = self._tridiagonal
        # Products of data (first two) and polynomials, once and twice through the residual matrix.
        once, twice = np.empty((2, len(smoothing), *rest.shape))
        for k, s in enumerate(smoothing):
            residual = s * lapack.dptsv(diagonal + s, beside, modes)[2]
            once[k] = modes.T @ residual + rest
            twice[k] = residual.T @ residual + rest
        square = twice[:, 0, 0] + twice[:, 1, 1]
        trace = (smoothing[:, None] / (self.eigenvalues + smoothing[:, None])).sum(1) + n_rest
        for degree in degrees:
            e = slice(2, 2 + n_terms(degree) - n_terms(self.least_degree))
            inverse = np.linalg.pinv(once[:, e, e], rcond=1e-13, hermitian=True)
            c = inverse @ once[:, e, :2]
            twice_c = twice[:, e, e] @ c
            left = square + np.sum(c * (twice_c - 2 * twice[:, e, :2]), axis=(1, 2))
            freedom = trace - np.sum(inverse * twice[:, e, e], axis=(1, 2))
            yield left * self.n / (2 * freedom**2), self.n - freedom


def _rotated(matrix, reflectors, tau, side="L", transpose="T"):
    """Matrix times the orthogonal matrix that these reflectors make."""
    matrix = np.asfortranarray(matrix)
    work = 64 * max(matrix.shape)
    return lapack.dormqr(side, transpose, reflectors, tau, matrix, work)[0]


def _low_rank(kernel):
    """Factor F of a positive semi-definite matrix, K = F F^T, by pivoted Cholesky decomposition."""
    factor, pivots, rank, _ = lapack.dpstrf(kernel, tol=_LOW_RANK_TOLERANCE, lower=1)
    factor = np.tril(factor)[:, :rank]
    out = np.empty_like(factor)
    out[pivots - 1] = factor
    return out


def saddle(bins, choice):
    """Kernel matrix with smoothing, bordered by the polynomials."""
    basis = polynomials(bins.u, bins.v, choice.degree)
    m, p = basis.shape
    matrix = np.zeros((m + p, m + p))
    matrix[:m, :m] = kernel_matrix(choice.kernel, choice.epsilon, bins.u, bins.v, bins.u, bins.v)
    matrix[np.arange(m), np.arange(m)] += choice.smoothing * bins.variance
    matrix[:m, m:], matrix[m:, :m] = basis, basis.T
    return matrix


class Smoother:
    """Maker of smoothed surfaces through the bins, for one choice of settings."""

    def __init__(self, bins, choice):
        self._bins, self._choice = bins, choice
        if choice.flat:
            root = np.sqrt(bins.weight)
            basis = polynomials(bins.u, bins.v, choice.degree)
            self._inverse = np.linalg.pinv(basis * root[:, None]) * root
        else:
            self._factors = lu_factor(saddle(bins, choice), overwrite_a=True, check_finite=False)

    def __call__(self, value):
        """Smooth values of the bins: a function of (u, v) that returns ``(N, 2)``."""
        bins, choice, n = self._bins, self._choice, len(self._bins)
        if choice.flat:
            coefficients = self._inverse @ value
            return lambda u, v: polynomials(u, v, choice.degree) @ coefficients
        right = np.zeros((len(self._factors[0]), 2))
        right[:n] = value
        solution = lu_solve(self._factors, right, check_finite=False)

        def surface(u, v):
            out = polynomials(u, v, choice.degree) @ solution[n:]
            cross = kernel_matrix(choice.kernel, choice.epsilon, u, v, bins.u, bins.v)
            return out + cross @ solution[:n]

        return surface


def pilot_surface(bins, choice):
    """Smooth surface on the coarse bins whose curvature corrects bin means, in two rounds."""
    smooth = Smoother(bins, choice)
    first = Pilot(smooth(bins.value), bins)
    return Pilot(smooth(bins.debiased(first)), bins)
