"""The numerical core: a smooth map of the plane, its Jacobian and its inverse, on plain 1-D arrays.

::

    (x, y) --polynomial (any degree, radial terms)--+--> (a, b)
           --piecewise bicubic on a grid of cells---+

A cubic polynomial is bicubic on each cell of a grid, so where there is a table the polynomial is
folded into the table's cells and costs nothing.  Everything here takes and returns contiguous
float64 blocks; models hand over blocks through `wpdc_gwcs.models.blocks`.
"""

import numpy as np

from wpdc_gwcs.models.cells import spline_cells
from wpdc_gwcs.models.powers import derivative, fit_polynomial, horner

__all__ = ["PlaneMap"]

_MAX_NEWTON = 25

# The fit that starts the inversion: degree, and points along each axis.  It leaves a few px of a
# distortion of 200 px.
_FIT_DEGREE = 4
_FIT_NODES = 17

# The spline that starts it for many points: nodes along each axis, and how many are many.
_SPLINE_NODES = 65
_SPLINE_SIZE = 4096


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
        Added to the polynomial; it has values outside its cells, too.
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
            self.derivatives = [(derivative(c, 0), derivative(c, 1)) for c in polynomial]

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

    def __call__(self, x, y):
        """Map a block of points.

        Parameters
        ----------
        x, y : (N,) ndarray
            Points.

        Returns
        -------
        a, b : (N,) ndarray
            Their images.
        """
        images = None
        if self.polynomial is not None:
            u, v = x - self.origin[0], y - self.origin[1]
            images = [horner(c, u, v) for c in self.polynomial]
            if self.radial is not None:
                r = self._radius(u, v)[2]
                for image, coefficients in zip(images, self.radial, strict=True):
                    image += np.polynomial.polynomial.polyval(r, coefficients)
        if self.grid is not None:
            values = self.grid.evaluate(*self.grid.locate(x, y))
            if images is not None:
                values += images
            images = values
        return tuple(images)

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
        x_number, s = grid.locate_x(x)
        cache = {}

        def function(y):
            y_number, t = grid.locate_y(y)
            a, b = np.empty((2, len(y), len(x)))
            for first in np.unique(y_number):
                if first not in cache:
                    cache.clear()
                    cell = grid.number(np.full(len(x), first), x_number)
                    cache[first] = grid.collapse(cell, s)
                rows = y_number == first
                t_rows = t[rows, np.newaxis]
                for output, (*lower, highest) in zip((a, b), cache[first], strict=True):
                    value = highest * t_rows
                    for coefficient in lower[:0:-1]:
                        value += coefficient
                        value *= t_rows
                    value += lower[0]
                    output[rows] = value
            return a, b

        return function

    def jacobian(self, x, y):
        """Map a block of points and differentiate.

        Parameters
        ----------
        x, y : (N,) ndarray
            Points.

        Returns
        -------
        values : (a, b)
            Images of the points.
        derivatives : (a_x, a_y, b_x, b_y)
            Their derivatives by x and y.
        """
        values = derivatives = None
        if self.polynomial is not None:
            u, v = x - self.origin[0], y - self.origin[1]
            values = [horner(c, u, v) for c in self.polynomial]
            derivatives = [horner(d, u, v) for pair in self.derivatives for d in pair]
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
            grid_values, grid_derivatives = self.grid.evaluate_jacobian(*self.grid.locate(x, y))
            for own, other in ((grid_values, values), (grid_derivatives, derivatives)):
                if other is not None:
                    for k, value in enumerate(own):
                        value += other[k]
            values, derivatives = grid_values, grid_derivatives
        return values, derivatives

    def invert(self, a, b, *, tolerance, start=None):
        """Invert a block of points by Newton's method with the analytic Jacobian.

        Parameters
        ----------
        a, b : (N,) ndarray
            Images to invert.
        tolerance : float
            Greatest residual of the map at the answer, in units of a and b.
        start : (x, y), optional
            Where to start; chosen by default.

        Returns
        -------
        x, y : (N,) ndarray
            The points, each verified by its residual or a bound of it; NaN where there is none.

        Notes
        -----
        Iterates first stay on the grid and one cell around it: for a point that lies there the way
        is only shortened by that.  What is left with a residual lies farther out, where the map is
        the polynomial and straight lines: Newton's method goes on for it without bounds.  A point
        where the Jacobian determinant has another sign than in the middle (the image is folded over
        there) is no answer.
        """
        good = np.isfinite(a)
        good &= np.isfinite(b)
        with np.errstate(all="ignore"):
            if good.all():
                return self._solve_near_and_far(a, b, start, tolerance)
            x, y = np.full(a.shape, np.nan), np.full(a.shape, np.nan)
            start = None if start is None else [value[good] for value in start]
            x[good], y[good] = self._solve_near_and_far(a[good], b[good], start, tolerance)
        return x, y

    def _solve_near_and_far(self, a, b, start, tolerance):
        if not len(a):
            return np.empty(0), np.empty(0)
        x, y = self._start(a, b) if start is None else (value.copy() for value in start)
        if self.grid is None:
            return self._solve(a, b, x, y, tolerance, bounded=False)
        self._clip(x, y)
        x_out, y_out = self._solve(a, b, x, y, tolerance, bounded=True)
        far = np.isnan(x_out)
        if far.any():
            x_out[far], y_out[far] = self._solve(
                a[far], b[far], x[far], y[far], tolerance, bounded=False
            )
        return x_out, y_out

    def _solve(self, a, b, x, y, tolerance, *, bounded):
        x_new, y_new, determinant, residual = self._newton_step(a, b, x, y, tolerance, bounded)
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
            x_new, y_new, determinant, residual = self._newton_step(a, b, x, y, tolerance, bounded)
        return x_out, y_out

    def _residual(self, a, b, x, y):
        """Return the greater of both residuals; it needs no derivatives."""
        fa, fb = self(x, y)
        np.subtract(a, fa, out=fa)
        np.subtract(b, fb, out=fb)
        np.abs(fa, out=fa)
        np.abs(fb, out=fb)
        return np.maximum(fa, fb, out=fa)

    def _newton_step(self, a, b, x, y, tolerance, bounded):
        """Return the next iterate, its residual, and the determinant here, negative in a fold."""
        (fa, fb), (a_x, a_y, b_x, b_y) = self.jacobian(x, y)
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
        certain = residual.max() <= tolerance and self.grid.outside(x_new, y_new) is None
        if not certain:
            if bounded:
                self._clip(x_new, y_new)
            residual = self._residual(a, b, x_new, y_new)
        if self._orientation() < 0:
            np.negative(determinant, out=determinant)
        return x_new, y_new, determinant, residual

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
        return spline.evaluate(*spline.locate(a, b))

    def _make_start_spline(self):
        """Return a spline of the inverse over the rectangle that the grid is mapped into."""
        a_grid, b_grid = (np.linspace(low, high, _SPLINE_NODES) for low, high in self._start_range)
        a, b = (value.ravel() for value in np.meshgrid(a_grid, b_grid))
        start = self._start_fit(a, b)
        solved = self.invert(a, b, tolerance=1e-6, start=start)
        values = np.where(np.isfinite(solved), solved, start)
        return spline_cells(a_grid, b_grid, values.reshape(2, _SPLINE_NODES, _SPLINE_NODES))

    def _clip(self, x, y):
        """Move points onto the grid and one cell around it, in place."""
        self.grid.clip(x, y, max(self.grid.x_step, self.grid.y_step))
