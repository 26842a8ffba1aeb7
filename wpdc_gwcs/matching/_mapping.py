"""The smooth mapping from starting positions to the reference plane, and its robust fit."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

__all__ = [
    "SmoothFit",
    "SmoothMap",
    "count_terms",
    "find_narrow_axis",
    "fit_smooth_map",
    "turn_and_scale",
]

MAX_ORDER = 7
# Minimum number of pairs per term of a fit; with fewer, leave-one-out errors are meaningless.
PAIRS_PER_TERM = 2.0
# On a frame as narrow as this (short side divided by long side), the second and higher powers of
# the short direction are less than a pixel for a distortion of 250 px: 250 * 0.05**2 = 0.6.  While
# there are only enough pairs for this order, these powers are left out in favor of higher powers of
# the long direction.
_NARROW = 0.05
_NARROW_ORDER = 3
# Minimum scatter, px: smaller differences are rounding errors, and noise-free input would lead to a
# radius of zero.
SMALLEST_SCATTER = 1e-5
_BLOCK = 65536


def count_terms(order):
    """Count the terms per axis of a full two-dimensional polynomial."""
    return (order + 1) * (order + 2) // 2


def _columns(order, narrow):
    """Columns of the design that are used, and their degrees; `narrow` is the axis or None."""
    powers = np.array([(n - q, q) for n in range(order + 1) for q in range(n + 1)])
    use = np.ones(len(powers), bool) if narrow is None else powers[:, narrow] <= 1
    return np.flatnonzero(use), powers.sum(axis=1)[use]


def find_narrow_axis(image_shape):
    """Return 0 or 1 if the frame is very narrow in x or y, else None."""
    ny, nx = image_shape
    return 0 if nx < _NARROW * ny else 1 if ny < _NARROW * nx else None


def turn_and_scale(matrix, image_shape):
    """Return rotation and scale of the similarity closest to a matrix on a frame.

    The directions of the sides are weighted by their lengths: the short side of a narrow frame does
    not determine a rotation.

    Parameters
    ----------
    matrix : (2, 2) ndarray
        First derivatives of a mapping.
    image_shape : (int, int)
        Shape of the frame, ``(ny, nx)``.

    Returns
    -------
    rotation, scale : float
        Rotation in deg and scale.
    """
    ny, nx = image_shape
    of_x, of_y = np.array([nx**2, ny**2]) / (nx**2 + ny**2)
    cosine = of_x * matrix[0, 0] + of_y * matrix[1, 1]
    sine = of_x * matrix[1, 0] - of_y * matrix[0, 1]
    return float(np.rad2deg(np.arctan2(sine, cosine))), float(np.hypot(sine, cosine))


def _design(u, v, order):
    """Products of Chebyshev polynomials by total degree: lower orders are leading columns."""
    powers = []
    for w in (u, v):
        t = [np.ones_like(w), w]
        for _ in range(2, order + 1):
            t.append(2 * w * t[-1] - t[-2])
        powers.append(t)
    columns = [
        powers[0][degree - q] * powers[1][q]
        for degree in range(order + 1)
        for q in range(degree + 1)
    ]
    return np.stack(columns, axis=-1)


@dataclass(frozen=True, eq=False)
class SmoothMap:
    r"""A polynomial mapping of the plane: starting pixel to reference pixel.

    Parameters
    ----------
    order : int
        Total degree of the polynomial.
    coefficients : (2, n_terms) ndarray
        Displacement in x and y, in products of Chebyshev polynomials of the normalized coordinates
        sorted by total degree.
    center : (2,) ndarray
        Origin of the normalized coordinates, px.
    scale : float
        Pixels per normalized unit.

    Notes
    -----
    With u = (x - x_c) / s and v = (y - y_c) / s

    .. math::
        X = x + \sum_{p+q \le n} a_{pq} T_p(u) T_q(v), \quad
        Y = y + \sum_{p+q \le n} b_{pq} T_p(u) T_q(v)

    Examples
    --------
    >>> from wpdc_gwcs.matching import SmoothMap
    >>> shift = SmoothMap.identity((100, 200)).shifted(3.0, -1.0)
    >>> x, y = shift([10.0], [20.0])
    >>> float(x[0]), float(y[0])
    (13.0, 19.0)
    """

    order: int
    coefficients: np.ndarray
    center: np.ndarray
    scale: float

    @classmethod
    def identity(cls, image_shape):
        """Make the identity mapping, normalized to a frame of the shape ``(ny, nx)``."""
        ny, nx = image_shape
        return cls(
            1, np.zeros((2, 3)), np.array([0.5 * (nx - 1), 0.5 * (ny - 1)]), 0.5 * max(nx, ny)
        )

    def shifted(self, dx, dy):
        """Return the same mapping with a shift in pixels added."""
        coefficients = self.coefficients.copy()
        coefficients[:, 0] += dx, dy
        return SmoothMap(self.order, coefficients, self.center, self.scale)

    def turned_back(self, turn):
        """Return the same mapping to a plane that has been turned about the center by `turn`."""
        coefficients = turn.T @ self.coefficients
        # The columns of u and v follow that of the shift.
        coefficients[:, 1:3] += self.scale * (turn.T - np.eye(2))
        return SmoothMap(self.order, coefficients, self.center, self.scale)

    def __call__(self, x, y):
        """Map positions.

        Parameters
        ----------
        x, y : (N,) array_like
            Starting pixel coordinates, zero based.

        Returns
        -------
        x, y : (N,) ndarray
            Reference pixel coordinates.
        """
        x, y = np.asarray(x, float), np.asarray(y, float)
        out = np.empty((2, x.size))
        flat_x, flat_y = x.ravel(), y.ravel()
        for start in range(0, x.size, _BLOCK):
            part = slice(start, start + _BLOCK)
            design = _design(*self._normalise(flat_x[part], flat_y[part]), self.order)
            out[:, part] = self.coefficients @ design.T
        return x + out[0].reshape(x.shape), y + out[1].reshape(y.shape)

    def linear_part(self):
        """Return the shift and the matrix of first derivatives at the center of the frame.

        Returns
        -------
        shift : (2,) ndarray
            Displacement of the center, px.
        matrix : (2, 2) ndarray
            Derivatives of the mapped position with respect to the starting position.
        """
        step = 1e-3 * self.scale
        cx, cy = self.center
        x, y = self(cx + step * np.array([0, 1, -1, 0, 0]), cy + step * np.array([0, 0, 0, 1, -1]))
        matrix = np.array([[x[1] - x[2], x[3] - x[4]], [y[1] - y[2], y[3] - y[4]]]) / (2 * step)
        return np.array([x[0] - cx, y[0] - cy]), matrix

    def inverse(self, x, y, *, iterations=12):
        """Find the starting positions of mapped ones by fixed-point iteration.

        The displacement is evaluated up to 5 % outside the frame, where a polynomial is still
        meaningful.  The result is accurate to a fraction of a pixel, which is enough to count the
        stars on the frame.
        """
        x, y = np.asarray(x, float), np.asarray(y, float)
        cx, cy = self.center
        reach = 1.05 * self.scale
        px, py = x.copy(), y.copy()
        for _ in range(iterations):
            qx, qy = np.clip(px, cx - reach, cx + reach), np.clip(py, cy - reach, cy + reach)
            mx, my = self(qx, qy)
            px, py = x - (mx - qx), y - (my - qy)
        return px, py

    def _normalise(self, x, y):
        return (x - self.center[0]) / self.scale, (y - self.center[1]) / self.scale


@dataclass(frozen=True, eq=False)
class SmoothFit:
    """A fitted `SmoothMap` with the data for its uncertainty.

    Parameters
    ----------
    mapping : SmoothMap
        The mapping.
    scatter : float
        Robust scatter per axis of the leave-one-out residuals, px.
    used : (N,) ndarray of bool
        Pairs used after clipping.
    triangle : (n_terms, n_terms) ndarray
        Triangular factor of the design matrix.
    columns : (n_terms,) ndarray of int
        Terms of the mapping that were fitted; the others are zero.
    """

    mapping: SmoothMap
    scatter: float
    used: np.ndarray
    triangle: np.ndarray
    columns: np.ndarray

    @property
    def n_terms(self):
        """Terms per axis that were fitted."""
        return len(self.columns)

    def leverage(self, x, y):
        """Variance of the prediction at a position in units of the variance of one pair."""
        x, y = np.asarray(x, float), np.asarray(y, float)
        out = np.empty(len(x))
        for start in range(0, len(x), _BLOCK):
            part = slice(start, start + _BLOCK)
            design = _design(*self.mapping._normalise(x[part], y[part]), self.mapping.order)
            design = design[:, self.columns]
            out[part] = (
                solve_triangular(self.triangle, design.T, trans="T", check_finite=False) ** 2
            ).sum(axis=0)
        return out


def fit_smooth_map(
    x, y, x_ref, y_ref, *, center, scale, max_order=MAX_ORDER, clip=5.0, narrow=None
):
    """Fit a smooth mapping to pairs: order from leave-one-out errors, outliers clipped.

    All orders come from one QR decomposition, since the columns are sorted by degree.  The order is
    the lowest one whose mean squared leave-one-out error (each clipped, so that wrong pairs do not
    decide) is within 2 % of the best.

    Parameters
    ----------
    x, y : (N,) ndarray
        Starting positions, px.
    x_ref, y_ref : (N,) ndarray
        Reference positions, px.
    center, scale
        Normalization of the coordinates, see `SmoothMap`.
    max_order : int
        Highest order to try.
    clip : float
        Pairs with residuals of more than this many robust standard deviations are not used.
    narrow : int, optional
        Axis along which the frame is narrow, see `find_narrow_axis`.

    Returns
    -------
    SmoothFit or None
        `None` when there are too few pairs for an order of 1 or they lie on a line.
    """
    u, v = (x - center[0]) / scale, (y - center[1]) / scale
    target = np.column_stack([x_ref - x, y_ref - y])
    used = np.ones(len(x), bool)
    fit, whole = None, np.empty((0, 0))
    for _ in range(8):
        count = np.count_nonzero(used)
        few = count < PAIRS_PER_TERM * count_terms(_NARROW_ORDER + 1)
        columns, degrees = _columns(max_order, narrow if few else None)
        size = np.searchsorted(degrees, np.arange(max_order + 1), side="right")
        top = 0
        while top < max_order and count >= PAIRS_PER_TERM * size[top + 1]:
            top += 1
        if top == 0:
            return fit
        # Fewer pairs rarely allow a higher order, except on a narrow frame.
        if whole.shape[1] < count_terms(top):
            whole = _design(u, v, top)
        design = whole[:, columns[: size[top]]]
        q, r = np.linalg.qr(design[used])
        diagonal = np.abs(np.diag(r))
        if diagonal[:3].min() < 1e-4 * diagonal[0]:
            return fit
        while diagonal[: size[top]].min() < 1e-9 * diagonal[0]:
            top -= 1
        projected = q.T @ target[used]
        residual = target[used].copy()
        leverage = np.zeros(count)
        errors = []
        for order in range(1, top + 1):
            of_order = slice(size[order - 1] if order > 1 else 0, size[order])
            residual = residual - q[:, of_order] @ projected[of_order]
            leverage = leverage + np.einsum("ij,ij->i", q[:, of_order], q[:, of_order])
            left_out = residual.T / (1 - np.minimum(leverage, 0.99))
            errors.append(left_out[0] ** 2 + left_out[1] ** 2)
        errors = np.array(errors)
        variances = np.maximum(np.median(errors, axis=1) / (2 * np.log(2)), SMALLEST_SCATTER**2)
        score = np.minimum(errors, clip**2 * variances.min()).mean(axis=1)
        order = 1 + int(np.flatnonzero(score <= 1.02 * score.min() + SMALLEST_SCATTER**2)[0])
        terms = size[order]
        columns = columns[:terms]
        fitted = solve_triangular(r[:terms, :terms], projected[:terms])
        coefficients = np.zeros((2, count_terms(order)))
        coefficients[:, columns] = fitted.T
        scatter = float(np.sqrt(variances[order - 1]))
        squared = np.sum((target - design[:, :terms] @ fitted).T ** 2, axis=0)
        squared[used] = errors[order - 1]
        fit = SmoothFit(
            SmoothMap(order, coefficients, np.asarray(center, float), float(scale)),
            scatter,
            used,
            r[:terms, :terms],
            columns,
        )
        now = squared <= (clip * scatter) ** 2
        if (now == used).all():
            break
        used = now
    return fit
