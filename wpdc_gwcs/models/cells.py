"""Piecewise bicubic maps on a grid of equal cells."""

import math

import numpy as np
from scipy.interpolate import CubicSpline

from wpdc_gwcs import kernels

__all__ = ["CellGrid", "spline_cells"]


def _with_outer_cells(coefficients, power_axis, cell_axis):
    """Add a cell at both ends of an axis that goes on with the value and the slope of the edge."""
    inner = np.moveaxis(coefficients, (power_axis, cell_axis), (0, 1))
    outer = np.zeros((len(inner), 2, *inner.shape[2:]))
    powers = np.arange(len(inner)).reshape((-1,) + (1,) * (inner.ndim - 2))
    first, last = inner[:, 0], inner[:, -1]
    # The first outer cell ends at its s = 1, the last one begins at its s = 0.
    outer[0, 0], outer[1, 0] = first[0] - first[1], first[1]
    outer[0, 1], outer[1, 1] = last.sum(axis=0), (powers * last).sum(axis=0)
    whole = np.concatenate([outer[:, :1], inner, outer[:, 1:]], axis=1)
    return np.moveaxis(whole, (0, 1), (power_axis, cell_axis))


class CellGrid:
    """Equally spaced cells, each with its own polynomial in local coordinates from 0 to 1.

    ::

        outer | cells of the grid, numbered from 1 | outer
        s < 1 |          0 <= s < 1                | 0 <= s

    Around them is a ring of infinite outer cells, so that there are values everywhere.  Cells are
    evaluated by `wpdc_gwcs.kernels`.

    Parameters
    ----------
    x_range, y_range : (float, float)
        First and last edge, of the cells without the ring.
    coefficients : (2, n, n, ny + 2, nx + 2) ndarray
        ``coefficients[k, p, q, j, i]`` multiplies ``s**p t**q`` in output k in cell (j, i), the
        ring of outer cells included; n is 2 or 4.
    smooth : bool, keyword-only
        Whether the first derivatives are continuous from cell to cell.
    """

    def __init__(self, x_range, y_range, coefficients, *, smooth):
        self.smooth = smooth
        self.x_low, self.x_high = (float(edge) for edge in x_range)
        self.y_low, self.y_high = (float(edge) for edge in y_range)
        self.ny, self.nx = (n - 2 for n in coefficients.shape[-2:])
        self.x_step = (self.x_high - self.x_low) / self.nx
        self.y_step = (self.y_high - self.y_low) / self.ny
        n = coefficients.shape[1]
        if n < 4:
            wide = np.zeros((2, 4, 4, *coefficients.shape[3:]))
            wide[:, :n, :n] = coefficients
            coefficients = wide
        #: The coefficients in the order that the kernels have them in.
        self.table = kernels.arrange(coefficients, kernels.CELL_ORDER)

    @classmethod
    def continued(cls, x_range, y_range, coefficients, *, smooth):
        """Return a grid that continues linearly outside its cells.

        Parameters
        ----------
        x_range, y_range : (float, float)
            First and last edge.
        coefficients : (2, n, n, ny, nx) ndarray
            Coefficients of the cells, without the outer ring.
        smooth : bool
            Whether the first derivatives are continuous from cell to cell.  Into the ring, they
            always are.

        Returns
        -------
        grid : CellGrid
            Grid with values everywhere.
        """
        along_x = _with_outer_cells(coefficients, power_axis=1, cell_axis=4)
        return cls(x_range, y_range, _with_outer_cells(along_x, 2, 3), smooth=smooth)

    @property
    def x_range(self):
        """First and last edge along x."""
        return self.x_low, self.x_high

    @property
    def y_range(self):
        """First and last edge along y."""
        return self.y_low, self.y_high

    @property
    def coefficients(self):
        """The coefficients, ``[k, p, q, j, i]`` with four powers each, with the outer cells."""
        return kernels.arranged(self.table, kernels.CELL_ORDER)

    def covers(self, x, y):
        """Return whether all points lie inside the cells.

        Parameters
        ----------
        x, y : (N,), (M,) ndarray
            Positions along both axes.
        """
        return all(
            values.size == 0 or (values.min() >= low and values.max() <= high)
            for values, (low, high) in ((x, self.x_range), (y, self.y_range))
        )

    def transformed(self, matrix, offset=(0.0, 0.0)):
        """Return the grid with its outputs (a, b) replaced by ``matrix @ (a, b) + offset``.

        Parameters
        ----------
        matrix : (2, 2) array_like
            Matrix.
        offset : (2,) array_like, optional
            Offset.
        """
        a, b = self.coefficients
        coefficients = np.stack([row[0] * a + row[1] * b for row in np.asarray(matrix)])
        coefficients[:, 0, 0] += np.reshape(offset, (2, 1, 1))
        return CellGrid(self.x_range, self.y_range, coefficients, smooth=self.smooth)

    def points(self, local):
        """Return points at the same local coordinates in every cell.

        Parameters
        ----------
        local : (n,) array_like
            Local coordinates, 0 to 1, along both axes.

        Returns
        -------
        x, y : (ny * n * nx * n,) ndarray
            The points, x running fastest.
        """
        local = np.asarray(local)
        x, y = (
            np.minimum(low + step * np.add.outer(np.arange(n), local).ravel(), high)
            for low, step, n, high in (
                (self.x_low, self.x_step, self.nx, self.x_high),
                (self.y_low, self.y_step, self.ny, self.y_high),
            )
        )
        return np.tile(x, len(y)), np.repeat(y, len(x))

    def interpolate(self, function):
        """Return the same cells for another function, each with its bicubic interpolant.

        Parameters
        ----------
        function : callable
            ``function(x, y) -> a, b`` of 1-D arrays; smooth in each cell.
        """
        # At Chebyshev points, the interpolant is nearly the best approximation.
        local = 0.5 - 0.5 * np.cos(np.pi * (2 * np.arange(4) + 1) / 8)
        values = np.reshape(function(*self.points(local)), (2, self.ny, 4, self.nx, 4))
        # Powers amplify rounding errors, so they are used for differences within the cell only.
        first = values[:, :, :1, :, :1].copy()
        powers = np.linalg.inv(np.vander(local, increasing=True))
        coefficients = np.einsum(
            "pa,qb,kjbia->kpqji", powers, powers, values - first, optimize=True
        )
        coefficients[:, 0, 0] += first[:, :, 0, :, 0]
        return CellGrid.continued(self.x_range, self.y_range, coefficients, smooth=False)

    def curvature(self):
        """Return a bound M of the second derivatives inside the cells.

        A step (dx, dy) of Newton's method leaves a residual of at most ``M (dx**2 + dy**2) / 2`` in
        either output.  Infinite where the first derivatives jump from cell to cell.
        """
        if not self.smooth:
            return np.inf
        p, q = np.arange(4)[:, np.newaxis], np.arange(4)
        factors = np.broadcast_arrays(
            p * (p - 1) / self.x_step**2,
            q * (q - 1) / self.y_step**2,
            p * q / (self.x_step * self.y_step),
        )
        size = np.abs(self.coefficients[..., 1:-1, 1:-1]).reshape(2, 16, -1)
        along_x, along_y, mixed = (np.reshape(factors, (3, 16)) @ size).max(axis=(0, 2))
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
        for low, step, n, center in (
            (self.x_low, self.x_step, self.nx, origin[0]),
            (self.y_low, self.y_step, self.ny, origin[1]),
        ):
            edge = low - center + step * np.arange(-1, n + 1)
            shift = np.zeros((n + 2, m, m))
            for p in range(m):
                for a in range(p + 1):
                    shift[:, a, p] = math.comb(p, a) * edge ** (p - a) * step**a
            shifts.append(shift)
        local = np.einsum("iap,jbq,kpq->kabji", *shifts, polynomial, optimize=True)
        total = np.array(self.coefficients)
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
    return CellGrid.continued(x_grid[[0, -1]], y_grid[[0, -1]], coefficients, smooth=True)
