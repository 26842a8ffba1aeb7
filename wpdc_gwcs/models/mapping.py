"""The numerical core: a smooth map of the plane, its Jacobian and its inverse, on plain 1-D arrays.

::

    (x, y) --polynomial (any degree, radial terms)--+--> (a, b)
           --piecewise bicubic on a grid of cells---+

A cubic polynomial is bicubic on each cell of a grid, so where there is a table the polynomial is
folded into the table's cells and costs nothing.  Everything here takes and returns contiguous
float64 blocks; models hand over blocks through `wpdc_gwcs.models.blocks`.
"""

import math
import threading

import numpy as np
from scipy.interpolate import CubicSpline

from wpdc_gwcs.models.terms import pv_terms

__all__ = ["CellGrid", "PlaneMap", "expand_pv", "fit_polynomial", "spline_cells"]

_MAX_NEWTON = 25

# The fit that starts the inversion: degree, and points along each axis.  It leaves a few px of a
# distortion of 200 px.
_FIT_DEGREE = 4
_FIT_NODES = 17

# The spline that starts it for many points: nodes along each axis, and how many are many.
_SPLINE_NODES = 65
_SPLINE_SIZE = 4096

# How far outside the grid (px) an iterate may go.
_RIM = 1e-6


def _linear_power(coefficients, power):
    """Coefficients of ``(c0 a + c1 b)**power`` by the power of ``a``, lowest first."""
    c0, c1 = coefficients
    return np.array([math.comb(power, i) * c0**i * c1 ** (power - i) for i in range(power + 1)])


def expand_pv(coefficients, degree, radial, matrix):
    """Expand a PV polynomial of ``matrix @ (u, v)`` into powers of u and v.

    Parameters
    ----------
    coefficients : (2, n_terms) ndarray
        In the order of `~wpdc_gwcs.models.pv_terms`.
    degree : int
        Degree of the polynomial.
    radial : bool
        Whether radial terms are among the coefficients.
    matrix : (2, 2) ndarray
        Linear map from (u, v) to (xi, eta).

    Returns
    -------
    polynomial : (2, degree + 1, degree + 1) ndarray
        ``polynomial[k, p, q]`` multiplies ``u**p v**q`` in output k.
    radial_polynomial : (2, degree + 1) ndarray or None
        ``radial_polynomial[k, s]`` multiplies ``r**s`` in output k; `None` without radial terms.
    """
    terms = pv_terms(degree, radial)
    n = degree + 1
    polynomial = np.zeros((2, n, n))
    in_radius = np.zeros((2, n))
    powers = [[_linear_power(row, p) for p in range(n)] for row in matrix]
    for axis in (0, 1):
        own_powers, other_powers = powers[axis], powers[1 - axis]
        for value, own, other, radius in zip(
            coefficients[axis], terms.own, terms.other, terms.radius, strict=True
        ):
            if value == 0.0:
                continue
            if radius:
                in_radius[axis, radius] += value
                continue
            total = own + other
            homogeneous = np.convolve(own_powers[own], other_powers[other])
            polynomial[axis, np.arange(total + 1), total - np.arange(total + 1)] += (
                value * homogeneous
            )
    return polynomial, (in_radius if in_radius.any() else None)


def fit_polynomial(points, values, degree):
    """Fit a map of the plane by polynomials.

    Parameters
    ----------
    points, values : (2, N) array_like
        Points and their images.
    degree : int
        Total degree.

    Returns
    -------
    polynomial : (2, degree + 1, degree + 1) ndarray
        ``polynomial[k, p, q]`` multiplies ``u**p v**q`` in output k, (u, v) being the point minus
        origin.
    origin : (float, float)
        Centre of the points.
    """
    origin = tuple(0.5 * (point.min() + point.max()) for point in points)
    # Scaled for the solution, not for its use: floating-point powers lose nothing.
    scale = 0.5 * max(np.ptp(point) for point in points)
    u, v = ((point - centre) / scale for point, centre in zip(points, origin, strict=True))
    powers = [(p, q) for p in range(degree + 1) for q in range(degree + 1 - p)]
    matrix = np.stack([u**p * v**q for p, q in powers], axis=1)
    fit = np.linalg.lstsq(matrix, np.stack(values, axis=1), rcond=None)[0]
    polynomial = np.zeros((2, degree + 1, degree + 1))
    for (p, q), pair in zip(powers, fit, strict=True):
        polynomial[:, p, q] = pair / scale ** (p + q)
    return polynomial, origin


def _horner(coefficients, a, b):
    """Sum of ``coefficients[p, q] a**p b**q`` over ``p + q < n`` by Horner's rule."""
    n = len(coefficients)
    total = None
    for p in range(n - 1, -1, -1):
        row = coefficients[p]
        q = n - 1 - p
        if q == 0:
            total = np.full(a.shape, row[0])
            continue
        inner = row[q] * b
        inner += row[q - 1]
        for k in range(q - 2, -1, -1):
            inner *= b
            inner += row[k]
        total *= a
        total += inner
    return total


def _derivative(coefficients, axis):
    """Coefficients of the derivative by u (axis 0) or v (axis 1)."""
    n = len(coefficients)
    if n == 1:
        return np.zeros((1, 1))
    factors = np.arange(1.0, n)
    if axis == 0:
        return coefficients[1:, : n - 1] * factors[:, np.newaxis]
    return coefficients[: n - 1, 1:] * factors


def _horner_columns(columns, s, total, slope=None):
    """Write the sum of ``columns[:, p] s**p``, and its derivative by s when asked for."""
    n = columns.shape[1]
    np.multiply(columns[:, n - 1], s, out=total)
    total += columns[:, n - 2]
    if slope is not None:
        slope[:] = columns[:, n - 1]
    for p in range(n - 3, -1, -1):
        if slope is not None:
            slope *= s
            slope += total
        total *= s
        total += columns[:, p]


# Points whose four coefficients are worked on at a time, a compromise: fewer stay closer to the
# core, more keep threads from waiting for each other.
_PART_SIZE = 65536


def _parts(n):
    return (slice(start, min(start + _PART_SIZE, n)) for start in range(0, n, _PART_SIZE))


class _Scratch(threading.local):
    """Work space that each thread keeps from block to block.

    Arrays of this size would otherwise be mapped and unmapped by the system for every block, which
    takes longer than filling them.
    """

    space = np.empty(0)

    def get(self, shape):
        size = math.prod(shape)
        if len(self.space) < size:
            self.space = np.empty(size)
        return self.space[:size].reshape(shape)


_scratch = _Scratch()


class CellGrid:
    """Equally spaced cells, each with its own polynomial in local coordinates from 0 to 1.

    Parameters
    ----------
    x_range, y_range : (float, float)
        First and last edge.
    coefficients : (2, n, n, ny, nx) ndarray
        ``coefficients[k, p, q, j, i]`` multiplies ``s**p t**q`` in output k in cell (j, i).
    smooth : bool, keyword-only
        Whether the first derivatives are continuous from cell to cell.
    """

    def __init__(self, x_range, y_range, coefficients, *, smooth):
        self.smooth = smooth
        self.x_low, self.x_high = (float(edge) for edge in x_range)
        self.y_low, self.y_high = (float(edge) for edge in y_range)
        self.ny, self.nx = coefficients.shape[-2:]
        self.x_step = (self.x_high - self.x_low) / self.nx
        self.y_step = (self.y_high - self.y_low) / self.ny
        n = coefficients.shape[1]
        # The four powers of s of a cell side by side: one take of 32 bytes fetches them all, and
        # fetching is what the look-up costs.
        self.rows = np.ascontiguousarray(coefficients.reshape(2, n, n, -1).transpose(0, 2, 3, 1))

    @property
    def x_range(self):
        """First and last edge along x."""
        return self.x_low, self.x_high

    @property
    def y_range(self):
        """First and last edge along y."""
        return self.y_low, self.y_high

    def clip(self, x, y, margin=0.0):
        """Move points outside the grid onto its rim, or onto a margin around it, in place.

        Parameters
        ----------
        x, y : (N,) ndarray
            Positions on the grid.
        margin : float, optional
            Distance by which points may lie outside.
        """
        np.maximum(x, self.x_low - margin, out=x)
        np.minimum(x, self.x_high + margin, out=x)
        np.maximum(y, self.y_low - margin, out=y)
        np.minimum(y, self.y_high + margin, out=y)

    @property
    def coefficients(self):
        """The coefficients the grid was made of, ``[k, p, q, j, i]``."""
        n = self.rows.shape[1]
        return self.rows.transpose(0, 3, 1, 2).reshape(2, n, n, self.ny, self.nx)

    def locate(self, x, y, margin=0.0):
        """Return cell numbers, local coordinates and what is outside by more than the margin.

        Parameters
        ----------
        x, y : (N,) ndarray
            Positions on the grid.
        margin : float, optional
            Distance by which points may lie outside.

        Notes
        -----
        ``outside`` is `None` when every point is inside.
        """
        x_low, x_high = self.x_low - margin, self.x_high + margin
        y_low, y_high = self.y_low - margin, self.y_high + margin
        outside = None
        at_edge = margin > 0
        if len(x):
            x_most, y_most = x.max(), y.max()
            # Written so that NaN counts as outside.
            if not (
                x.min() >= x_low and x_most <= x_high and y.min() >= y_low and y_most <= y_high
            ):
                good = (x >= x_low) & (x <= x_high)
                good &= (y >= y_low) & (y <= y_high)
                outside = ~good
                x = np.where(good, x, self.x_low)
                y = np.where(good, y, self.y_low)
                at_edge = True
            # Within rounding of the division into cells.
            near = 1.0 - 1e-12
            at_edge |= x_most >= self.x_low + near * (self.x_high - self.x_low)
            at_edge |= y_most >= self.y_low + near * (self.y_high - self.y_low)
        s = x - self.x_low
        s *= 1.0 / self.x_step
        t = y - self.y_low
        t *= 1.0 / self.y_step
        i, j = np.floor(s), np.floor(t)
        if at_edge:
            # The last edge belongs to the last cell, a margin to the outermost ones.
            np.minimum(i, self.nx - 1, out=i)
            np.minimum(j, self.ny - 1, out=j)
        if margin:
            np.maximum(i, 0, out=i)
            np.maximum(j, 0, out=j)
        s -= i
        t -= j
        j *= self.nx
        j += i
        return j.astype(np.intp), s, t, outside

    def evaluate(self, cell, s, t):
        """Return both outputs."""
        outputs = [np.empty_like(s), np.empty_like(s)]
        n = self.rows.shape[1]
        for part in _parts(len(s)):
            wide_t, total, term = _scratch.get((3, part.stop - part.start, n))
            for column in wide_t.T:
                column[:] = t[part]
            for rows, output in zip(self.rows, outputs, strict=True):
                rows[n - 1].take(cell[part], axis=0, out=total, mode="clip")
                for q in range(n - 2, -1, -1):
                    total *= wide_t
                    rows[q].take(cell[part], axis=0, out=term, mode="clip")
                    total += term
                _horner_columns(total, s[part], output[part])
        return outputs

    def collapse(self, cell, s):
        """Return the coefficients ``[k][q]`` of the powers of t that are left when s is given.

        Parameters
        ----------
        cell : (N,) ndarray of int
            Cell numbers, see `locate`.
        s : (N,) ndarray
            Local coordinates in the cells.
        """
        coefficients = np.empty((2, self.rows.shape[1], len(s)))
        for rows, outputs in zip(self.rows, coefficients, strict=True):
            for row, output in zip(rows, outputs, strict=True):
                _horner_columns(row.take(cell, axis=0), s, output)
        return coefficients

    def evaluate_jacobian(self, cell, s, t):
        """Return both outputs and their derivatives, ``(a, b), (a_x, a_y, b_x, b_y)``.

        Parameters
        ----------
        cell : (N,) ndarray of int
            Cell numbers, see `locate`.
        s, t : (N,) ndarray
            Local coordinates in the cells.
        """
        results = [[np.empty_like(s) for _ in range(3)] for _ in range(2)]
        n = self.rows.shape[1]
        for part in _parts(len(s)):
            wide_t, total, slope, term = _scratch.get((4, part.stop - part.start, n))
            for column in wide_t.T:
                column[:] = t[part]
            for rows, (value, by_s, by_t) in zip(self.rows, results, strict=True):
                rows[n - 1].take(cell[part], axis=0, out=total, mode="clip")
                for q in range(n - 2, -1, -1):
                    if q == n - 2:
                        slope[:] = total
                    else:
                        slope *= wide_t
                        slope += total
                    total *= wide_t
                    rows[q].take(cell[part], axis=0, out=term, mode="clip")
                    total += term
                _horner_columns(total, s[part], value[part], by_s[part])
                _horner_columns(slope, s[part], by_t[part])
        for _, by_s, by_t in results:
            by_s *= 1.0 / self.x_step
            by_t *= 1.0 / self.y_step
        return [result[0] for result in results], [d for result in results for d in result[1:]]

    def transformed(self, matrix, offset=(0.0, 0.0)):
        """Return the grid with its outputs (a, b) replaced by ``matrix @ (a, b) + offset``.

        Parameters
        ----------
        matrix : (2, 2) array_like
            Matrix.
        offset : (2,) array_like, optional
            Offset.
        """
        coefficients = np.einsum("ij,j...->i...", matrix, self.coefficients)
        coefficients[:, 0, 0] += np.reshape(offset, (2, 1, 1))
        return CellGrid(self.x_range, self.y_range, coefficients, smooth=self.smooth)

    def curvature(self):
        """Return a bound M of the second derivatives.

        A step (dx, dy) of Newton's method leaves a residual of at most ``M (dx**2 + dy**2) / 2`` in
        either output.  Infinite where the first derivatives jump from cell to cell.
        """
        if not self.smooth:
            return np.inf
        n = self.rows.shape[1]
        p, q = np.arange(n)[:, np.newaxis, np.newaxis, np.newaxis], np.arange(n)[:, None, None]
        size = np.abs(self.coefficients)
        along_x = (size * p * (p - 1)).sum(axis=(1, 2)).max() / self.x_step**2
        along_y = (size * q * (q - 1)).sum(axis=(1, 2)).max() / self.y_step**2
        mixed = (size * p * q).sum(axis=(1, 2)).max() / (self.x_step * self.y_step)
        return max(along_x, along_y) + mixed

    def fold(self, polynomial, origin):
        """Return a grid of bicubic cells with a polynomial of degree 3 or less added.

        Parameters
        ----------
        polynomial : (2, m, m) ndarray
            In powers of ``x - origin[0]`` and ``y - origin[1]``, m at most 4.
        origin : (float, float)
            Reference point.

        Returns
        -------
        grid : CellGrid
            The sum, in cells of 4 x 4 coefficients.
        """
        m = polynomial.shape[1]
        shifts = []
        for low, step, n, centre in (
            (self.x_low, self.x_step, self.nx, origin[0]),
            (self.y_low, self.y_step, self.ny, origin[1]),
        ):
            edge = low - centre + step * np.arange(n)
            shift = np.zeros((n, m, m))
            for p in range(m):
                for a in range(p + 1):
                    shift[:, a, p] = math.comb(p, a) * edge ** (p - a) * step**a
            shifts.append(shift)
        local = np.einsum("iap,jbq,kpq->kabji", *shifts, polynomial, optimize=True)
        n = self.rows.shape[1]
        total = np.zeros((2, 4, 4, self.ny, self.nx))
        total[:, :n, :n] += self.coefficients
        total[:, :m, :m] += local
        return CellGrid(self.x_range, self.y_range, total, smooth=self.smooth)


def spline_cells(x_grid, y_grid, values):
    """Return the cells of the bicubic spline through values on a grid (not-a-knot ends).

    Parameters
    ----------
    x_grid, y_grid : (nx,), (ny,) ndarray
        Positions of the nodes, equally spaced, four or more.
    values : (2, ny, nx) ndarray
        Values at the nodes.

    Returns
    -------
    cells : CellGrid
        The spline.
    """
    # A tensor product of one-dimensional splines; the power basis of scipy runs from the highest
    # power down, in units of the grid, and puts (power, cell) first.
    along_y = CubicSpline(y_grid, values, axis=1).c  # q, j, k, x
    both = CubicSpline(x_grid, along_y, axis=3).c  # p, i, q, j, k
    coefficients = np.moveaxis(both[::-1, :, ::-1], (4, 0, 2, 3, 1), (0, 1, 2, 3, 4))
    # From units of the grid to the local coordinate of a cell, 0 to 1.
    x_scale = (x_grid[1] - x_grid[0]) ** np.arange(4)
    y_scale = (y_grid[1] - y_grid[0]) ** np.arange(4)
    scale = x_scale[:, np.newaxis] * y_scale
    coefficients = coefficients * scale[..., np.newaxis, np.newaxis]
    return CellGrid(x_grid[[0, -1]], y_grid[[0, -1]], coefficients, smooth=True)


class PlaneMap:
    """A smooth map of the plane: polynomial, radial terms and cells, summed.

    Parameters
    ----------
    polynomial : (2, n, n) ndarray, optional
        ``polynomial[k, p, q]`` multiplies ``u**p v**q``, where (u, v) is (x, y) minus the origin.
    origin : (float, float), optional
        Reference point of the polynomial.
    radial : (2, m) ndarray, optional
        ``radial[k, s]`` multiplies ``r**s`` in output k.
    radial_matrix : (2, 2) ndarray, optional
        r is the length of ``radial_matrix @ (u, v)``.
    grid : CellGrid, optional
        Added to the polynomial.  The map is NaN outside it.
    """

    def __init__(
        self, polynomial=None, origin=(0.0, 0.0), *, radial=None, radial_matrix=None, grid=None
    ):
        foldable = polynomial is not None and polynomial.shape[1] <= 4 and radial is None
        if grid is not None and foldable:
            grid = grid.fold(polynomial, origin)
            polynomial = None
        self.polynomial = polynomial
        self.origin = (float(origin[0]), float(origin[1]))
        self.radial = radial
        self.radial_matrix = np.eye(2) if radial_matrix is None else radial_matrix
        self.grid = grid
        # Only cells alone have a bound of their second derivatives at hand.
        self._curvature = np.inf if grid is None or polynomial is not None else grid.curvature()
        self._start_fit = self._start_range = self._start_spline = self._middle_sign = None
        if polynomial is not None:
            self.derivatives = [(_derivative(c, 0), _derivative(c, 1)) for c in polynomial]

    def transformed(self, matrix, offset=(0.0, 0.0)):
        """Return the map followed by a linear one, ``matrix @ (a, b) + offset``.

        Parameters
        ----------
        matrix : (2, 2) ndarray
            Applied to the images.
        offset : (float, float), optional
            Added to them.

        Returns
        -------
        plane_map : PlaneMap
            The map from (x, y) to the transformed images.
        """
        polynomial, radial, grid = self.polynomial, self.radial, self.grid
        if polynomial is not None:
            polynomial = np.einsum("ij,jpq->ipq", matrix, polynomial)
            polynomial[:, 0, 0] += offset
            offset = (0.0, 0.0)
        if radial is not None:
            radial = matrix @ radial
        if grid is not None:
            grid = grid.transformed(matrix, offset)
        return PlaneMap(
            polynomial, self.origin, radial=radial, radial_matrix=self.radial_matrix, grid=grid
        )

    def _radius(self, u, v):
        m = self.radial_matrix
        a = m[0, 0] * u + m[0, 1] * v
        b = m[1, 0] * u + m[1, 1] * v
        return a, b, np.sqrt(a * a + b * b)

    def __call__(self, x, y, margin=0.0):
        """Map a block of points.

        Parameters
        ----------
        x, y : (N,) ndarray
            Points.
        margin : float, optional
            How far outside the grid its outermost cells are still used.

        Returns
        -------
        a, b : (N,) ndarray
            Their images; NaN outside the grid.
        """
        a = b = 0.0
        if self.polynomial is not None:
            u, v = x - self.origin[0], y - self.origin[1]
            a, b = (_horner(c, u, v) for c in self.polynomial)
            if self.radial is not None:
                r = self._radius(u, v)[2]
                a += np.polynomial.polynomial.polyval(r, self.radial[0])
                b += np.polynomial.polynomial.polyval(r, self.radial[1])
        if self.grid is not None:
            cell, s, t, outside = self.grid.locate(x, y, margin)
            ga, gb = self.grid.evaluate(cell, s, t)
            ga += a
            gb += b
            a, b = ga, gb
            if outside is not None:
                a[outside] = np.nan
                b[outside] = np.nan
        return a, b

    def along_rows(self, x):
        """Return a function for the rows of an image, which have much in common.

        Parameters
        ----------
        x : (N,) ndarray
            Positions along a row.

        Returns
        -------
        function : callable
            ``function(y)`` returns the images ``a, b`` of the points of M rows, each (M, N).  It is
            quickest when the rows come in order.
        """
        if self.grid is None or self.polynomial is not None:

            def function(y):
                points = np.tile(x, len(y)), np.repeat(y, len(x))
                return tuple(value.reshape(len(y), len(x)) for value in self(*points))

            return function
        grid = self.grid
        low = np.full(1, grid.y_low)
        x_cell, s, _, x_outside = grid.locate(x, np.broadcast_to(low, x.shape))
        cache = {}

        def function(y):
            cell, _, t, y_outside = grid.locate(np.full(len(y), grid.x_low), y)
            a, b = np.empty((2, len(y), len(x)))
            for first in np.unique(cell):
                if first not in cache:
                    cache.clear()
                    cache[first] = grid.collapse(first + x_cell, s)
                rows = cell == first
                t_rows = t[rows, np.newaxis]
                for output, (*lower, highest) in zip((a, b), cache[first], strict=True):
                    value = highest * t_rows
                    for coefficient in lower[:0:-1]:
                        value += coefficient
                        value *= t_rows
                    value += lower[0]
                    output[rows] = value
            for output in (a, b):
                if x_outside is not None:
                    output[:, x_outside] = np.nan
                if y_outside is not None:
                    output[y_outside] = np.nan
            return a, b

        return function

    def jacobian(self, x, y, margin=0.0):
        """Map a block of points and differentiate.

        Parameters
        ----------
        x, y : (N,) ndarray
            Points.
        margin : float, optional
            How far outside the grid its outermost cells are still used.

        Returns
        -------
        values : (a, b)
            Images of the points.
        derivatives : (a_x, a_y, b_x, b_y)
            Their derivatives by x and y.
        """
        values = [np.zeros_like(x), np.zeros_like(x)]
        derivatives = [np.zeros_like(x) for _ in range(4)]
        if self.polynomial is not None:
            u, v = x - self.origin[0], y - self.origin[1]
            values = [_horner(c, u, v) for c in self.polynomial]
            derivatives = [_horner(d, u, v) for pair in self.derivatives for d in pair]
            if self.radial is not None:
                m = self.radial_matrix
                a, b, r = self._radius(u, v)
                # r is not differentiable at 0; its one-sided slopes average to nothing there.
                inverse = np.divide(1.0, r, out=np.zeros_like(r), where=r > 0)
                r_x = (a * m[0, 0] + b * m[1, 0]) * inverse
                r_y = (a * m[0, 1] + b * m[1, 1]) * inverse
                for k in (0, 1):
                    values[k] += np.polynomial.polynomial.polyval(r, self.radial[k])
                    slope = np.polynomial.polynomial.polyval(
                        r, np.polynomial.polynomial.polyder(self.radial[k])
                    )
                    derivatives[2 * k] += slope * r_x
                    derivatives[2 * k + 1] += slope * r_y
        if self.grid is not None:
            cell, s, t, outside = self.grid.locate(x, y, margin)
            grid_values, grid_derivatives = self.grid.evaluate_jacobian(cell, s, t)
            values = [g + v for g, v in zip(grid_values, values, strict=True)]
            derivatives = [g + d for g, d in zip(grid_derivatives, derivatives, strict=True)]
            if outside is not None:
                for value in (*values, *derivatives):
                    value[outside] = np.nan
        return values, derivatives

    def invert(self, a, b, *, tolerance, margin=_RIM, start=None):
        """Invert a block of points by Newton's method with the analytic Jacobian.

        Parameters
        ----------
        a, b : (N,) ndarray
            Images to invert.
        tolerance : float
            Greatest residual of the map at the answer, in units of a and b.
        margin : float, optional
            How far outside the grid an answer may lie.  Answers within the default margin, which is
            there for rounding only, are put on the rim.
        start : (x, y), optional
            Where to start; chosen by default.

        Returns
        -------
        x, y : (N,) ndarray
            The points, each verified by its residual or a bound of it; NaN where there is none.

        Notes
        -----
        Iterates stay on the grid: for a point that lies on it the way is only shortened by that,
        and a point that lies outside is left with a residual and becomes NaN.  (They may leave it
        by 1e-6 px, since rounding moves points of the rim; such an answer is put on the rim.)  A
        point where the Jacobian determinant has another sign than in the middle (the image is
        folded over there) is no answer either.
        """
        good = np.isfinite(a)
        good &= np.isfinite(b)
        with np.errstate(all="ignore"):
            if good.all():
                x, y = self._solve(a, b, start, tolerance, margin)
            else:
                x, y = np.full(a.shape, np.nan), np.full(a.shape, np.nan)
                start = None if start is None else [value[good] for value in start]
                x[good], y[good] = self._solve(a[good], b[good], start, tolerance, margin)
            if margin <= _RIM:
                self._clip(x, y, 0.0)
        return x, y

    def _solve(self, a, b, start, tolerance, margin):
        if not len(a):
            return np.empty(0), np.empty(0)
        x, y = self._start(a, b) if start is None else (value.copy() for value in start)
        self._clip(x, y, margin)
        x_new, y_new, determinant, residual = self._newton_step(a, b, x, y, tolerance, margin)
        if residual.max() <= tolerance and determinant.min() > 0:
            return x_new, y_new
        # The points that are not done go on by themselves.  Rounding of the map sets the floor.
        limit = tolerance + 16 * np.finfo(float).eps * np.maximum(np.abs(a), np.abs(b))
        x_out, y_out = np.full(a.shape, np.nan), np.full(a.shape, np.nan)
        index = np.arange(len(a))
        for _ in range(_MAX_NEWTON):
            done = residual <= limit
            answer = done & (determinant > 0)
            x_out[index[answer]] = x_new[answer]
            y_out[index[answer]] = y_new[answer]
            # A point that no longer moves, or left for infinity, has no answer.
            going = (x_new != x) | (y_new != y)
            going &= np.isfinite(x_new) & np.isfinite(y_new)
            going &= ~done
            if not going.any():
                break
            a, b, limit, index = a[going], b[going], limit[going], index[going]
            x, y = x_new[going], y_new[going]
            x_new, y_new, determinant, residual = self._newton_step(a, b, x, y, tolerance, margin)
        return x_out, y_out

    def _residual(self, a, b, x, y, margin):
        """Return the greater of both residuals; it needs no derivatives."""
        fa, fb = self(x, y, margin)
        np.subtract(a, fa, out=fa)
        np.subtract(b, fb, out=fb)
        np.abs(fa, out=fa)
        np.abs(fb, out=fb)
        return np.maximum(fa, fb, out=fa)

    def _newton_step(self, a, b, x, y, tolerance, margin):
        """Return the next iterate, its residual, and the determinant here, negative in a fold."""
        (fa, fb), (a_x, a_y, b_x, b_y) = self.jacobian(x, y, margin)
        np.subtract(a, fa, out=fa)
        np.subtract(b, fb, out=fb)
        determinant = a_x * b_y
        determinant -= a_y * b_x
        b_y *= fa
        a_y *= fb
        b_y -= a_y
        b_y /= determinant
        a_x *= fb
        b_x *= fa
        a_x -= b_x
        a_x /= determinant
        x_new, y_new = x + b_y, y + a_x
        # What a step leaves is bounded by its length; where the bound is good enough for every
        # point, the map need not be evaluated again.
        residual = b_y
        residual *= b_y
        a_x *= a_x
        residual += a_x
        residual *= 0.5 * self._curvature
        certain = residual.max() <= tolerance and self._inside(x_new, y_new, margin)
        if not certain:
            self._clip(x_new, y_new, margin)
            residual = self._residual(a, b, x_new, y_new, margin)
        if self._orientation() < 0:
            np.negative(determinant, out=determinant)
        return x_new, y_new, determinant, residual

    def _inside(self, x, y, margin):
        x_low, x_high = self.grid.x_range
        y_low, y_high = self.grid.y_range
        return (
            x.min() >= x_low - margin
            and x.max() <= x_high + margin
            and y.min() >= y_low - margin
            and y.max() <= y_high + margin
        )

    def _orientation(self):
        """Return the sign of the Jacobian determinant in the middle, -1 for a mirror."""
        if self._middle_sign is None:
            point = self.origin
            if self.grid is not None:
                grid = self.grid
                point = (0.5 * (grid.x_low + grid.x_high), 0.5 * (grid.y_low + grid.y_high))
            _, (a_x, a_y, b_x, b_y) = self.jacobian(*(np.array([value]) for value in point))
            self._middle_sign = -1 if (a_x * b_y - a_y * b_x)[0] < 0 else 1
        return self._middle_sign

    def _start(self, a, b):
        """Return where to start the inversion.

        The images themselves where there is no telling where a fit should hold; else a polynomial
        fit of the inverse, or for many points a spline of the inverse, which leaves one step to do.
        """
        if self.grid is None:
            return a.copy(), b.copy()
        if self._start_fit is None:
            grid = self.grid
            x, y = np.meshgrid(
                np.linspace(grid.x_low, grid.x_high, _FIT_NODES),
                np.linspace(grid.y_low, grid.y_high, _FIT_NODES),
            )
            x, y = x.ravel(), y.ravel()
            images = self(x, y)
            self._start_range = [(image.min(), image.max()) for image in images]
            # Last: other threads take it for the sign that all is there.
            self._start_fit = PlaneMap(*fit_polynomial(images, (x, y), _FIT_DEGREE))
        if len(a) < _SPLINE_SIZE:
            return self._start_fit(a, b)
        if self._start_spline is None:
            self._start_spline = self._make_start_spline()
        spline = self._start_spline
        # Held at the edge: what lies farther out has no answer anyway.
        a, b = a.copy(), b.copy()
        spline.clip(a, b)
        cell, s, t, _ = spline.locate(a, b)
        return spline.evaluate(cell, s, t)

    def _make_start_spline(self):
        """Return a spline of the inverse over the rectangle that the grid is mapped into."""
        a_grid, b_grid = (np.linspace(low, high, _SPLINE_NODES) for low, high in self._start_range)
        a, b = (value.ravel() for value in np.meshgrid(a_grid, b_grid))
        start = self._start_fit(a, b)
        # The rectangle reaches beyond the grid; its outermost cells are good enough for a start.
        margin = 2 * max(self.grid.x_step, self.grid.y_step)
        solved = self.invert(a, b, tolerance=1e-6, margin=margin, start=start)
        values = np.where(np.isfinite(solved), solved, start)
        return spline_cells(a_grid, b_grid, values.reshape(2, _SPLINE_NODES, _SPLINE_NODES))

    def _clip(self, x, y, margin):
        if self.grid is not None:
            self.grid.clip(x, y, margin)
