"""A smooth map of the plane, its Jacobian and its inverse, on plain 1-D arrays.

::

    (x, y) --polynomial (any degree, radial terms)--+--> (a, b)
           --piecewise bicubic on a grid of cells---+

A cubic polynomial is bicubic on each cell of a grid, so where there is a table the polynomial is
folded into the cells of the table and takes no additional time.  All functions take contiguous
float64 blocks from `wpdc_gwcs.models.blocks` and write into others; the loops over points are those
of `wpdc_gwcs.kernels`.
"""

from functools import cached_property

import numpy as np

from wpdc_gwcs import kernels
from wpdc_gwcs.models.cells import spline_cells
from wpdc_gwcs.models.powers import derivative, fit_polynomial

__all__ = ["RIM_PX", "TOLERANCE_PX", "PlaneMap"]

#: Answers this far (px) outside a bounding box lie on its rim but for rounding.
RIM_PX = 1e-6

#: Residual of the inverse in undistorted pixels; Newton's last step leaves far less.
TOLERANCE_PX = 1e-9

# Degree and points along each axis of the fit with which the start of the inversion is computed.
# It leaves a few px of a distortion of 200 px.
_FIT_DEGREE = 4
_FIT_NODES = 17

# Nodes along each axis of the spline that starts the inversion, and its residual.
_SPLINE_NODES = 65
_SPLINE_TOLERANCE = 1e-6

_NOTHING = np.empty(0)


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
        Cells that are added to the polynomial; they have values outside their edges, too.
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

    @cached_property
    def plane(self):
        """The map as kernels take it, a `~wpdc_gwcs.kernels.Plane`."""
        grid = self.grid
        head = [0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0]
        if grid is not None:
            head = [grid.x_low, grid.x_high, grid.x_step, grid.y_low, grid.y_high, grid.y_step]
            head += [grid.nx, grid.ny]
        polynomial = radial = _NOTHING
        if self.polynomial is not None:
            n = self.polynomial.shape[1]
            polynomial = np.zeros((6, n, n))
            polynomial[:2] = self.polynomial
            slopes = [derivative(c, axis) for c in self.polynomial for axis in (0, 1)]
            polynomial[2:, : len(slopes[0]), : len(slopes[0])] = slopes
            if self.radial is not None:
                radial = np.zeros((4, self.radial.shape[1]))
                radial[:2] = self.radial
                radial[2:, :-1] = self.radial[:, 1:] * np.arange(1, radial.shape[1])
        return kernels.Plane(
            np.array([*head, *self.origin, *np.ravel(self.radial_matrix)], dtype=float),
            polynomial,
            radial,
            _NOTHING if grid is None else grid.table,
        )

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
        images = np.empty((2, len(x)))
        self.evaluate(x, y, *images)
        return tuple(images)

    def evaluate(self, x, y, a, b):
        """Map a block of points.

        Parameters
        ----------
        x, y : (N,) ndarray
            Points.
        a, b : (N,) ndarray
            Their images are written here.
        """
        kernels.evaluate(self.plane, x, y, a, b)

    def jacobian(self, x, y, a, b, a_x, a_y, b_x, b_y):
        """Map a block of points and differentiate.

        Parameters
        ----------
        x, y : (N,) ndarray
            Points.
        a, b, a_x, a_y, b_x, b_y : (N,) ndarray
            Their images and the derivatives of these by x and y are written here.
        """
        kernels.jacobian(self.plane, x, y, a, b, a_x, a_y, b_x, b_y)

    def inverse(self, *, tolerance, tangent=None, box=None, fill_value=np.nan):
        """Return the inverse as a function of blocks: Newton's method, with the analytic Jacobian.

        Parameters
        ----------
        tolerance : float
            Largest residual of the map at the solution, in units of a and b.
        tangent : (9,) ndarray, optional
            If given, positions on the sky are inverted, see `~wpdc_gwcs.kernels.tangent_numbers`.
        box : ((float, float), (float, float)), optional
            Smallest and largest x, smallest and largest y.  Solutions up to 1e-6 px outside are
            moved to its edge; those farther out are not accepted.
        fill_value : float, optional
            Value of both coordinates of a solution outside the box, and without a solution.

        Returns
        -------
        function : callable
            ``function(a, b, x, y)`` writes the points x, y with the images a, b.  Each is verified
            by its residual or an upper limit of it; NaN if there is no solution.

        Notes
        -----
        At first, the iteration is confined to the grid and one cell around it, which only helps
        points that lie there.  Points that still have a residual lie farther out, where the map is
        the polynomial plus linear functions, and Newton's method continues without bounds.  A point
        where the Jacobian determinant has a different sign than at the center, because the image is
        folded there, is not a solution.
        """
        limits = np.array([tolerance, self._curvature, self._orientation, RIM_PX])
        return self._inverse(self._start, limits, tangent, kernels.box_numbers(box, fill_value))

    def _inverse(self, start, limits, tangent, box):
        plane = self.plane

        def function(a, b, x, y):
            kernels.invert(plane, start, limits, tangent, box, a, b, x, y)

        return function

    def invert(self, a, b, *, tolerance):
        """Invert a block of points.

        Parameters
        ----------
        a, b : (N,) ndarray
            Images to invert.
        tolerance : float
            Largest residual of the map at the solution, in units of a and b.

        Returns
        -------
        x, y : (N,) ndarray
            The points, see `inverse`.
        """
        points = np.empty((2, len(a)))
        self.inverse(tolerance=tolerance)(a, b, *points)
        return tuple(points)

    @cached_property
    def _curvature(self):
        """Bound of the second derivatives; only cells alone have one at hand."""
        return np.inf if self.grid is None or self.polynomial is not None else self.grid.curvature()

    @cached_property
    def _orientation(self):
        """The sign of the Jacobian determinant in the middle, -1 for a mirror."""
        point = self.origin
        if self.grid is not None:
            grid = self.grid
            point = (0.5 * (grid.x_low + grid.x_high), 0.5 * (grid.y_low + grid.y_high))
        found = np.empty((6, 1))
        self.jacobian(*(np.array([value]) for value in point), *found)
        _, _, a_x, a_y, b_x, b_y = found[:, 0]
        return -1.0 if a_x * b_y - a_y * b_x < 0 else 1.0

    @cached_property
    def _start(self):
        """Cells of an approximate inverse, as the start of the inversion.

        They are a spline over the rectangle that the grid is mapped to, computed with a polynomial
        fit; only one step remains.  Without a grid, the range of a fit is unknown, so this is
        `None`, and the inversion starts from the images themselves.
        """
        grid = self.grid
        if grid is None:
            return None
        x, y = np.meshgrid(
            np.linspace(grid.x_low, grid.x_high, _FIT_NODES),
            np.linspace(grid.y_low, grid.y_high, _FIT_NODES),
        )
        x, y = x.ravel(), y.ravel()
        images = self(x, y)
        fit = PlaneMap(*fit_polynomial(images, (x, y), _FIT_DEGREE))
        a_grid, b_grid = (np.linspace(v.min(), v.max(), _SPLINE_NODES) for v in images)
        a, b = (value.ravel() for value in np.meshgrid(a_grid, b_grid))
        limits = np.array([_SPLINE_TOLERANCE, self._curvature, self._orientation, RIM_PX])
        solved = np.empty((2, len(a)))
        self._inverse(fit.plane, limits, None, None)(a, b, *solved)
        nodes = np.where(np.isfinite(solved), solved, fit(a, b))
        return PlaneMap(
            grid=spline_cells(a_grid, b_grid, nodes.reshape(2, _SPLINE_NODES, _SPLINE_NODES))
        ).plane
