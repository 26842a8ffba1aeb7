"""The look-up table: residual displacements on a grid of nodes, interpolated by a spline."""

import numpy as np
from astropy.modeling import Model, Parameter

from wpdc_gwcs.models.blocks import evaluate_blocks
from wpdc_gwcs.models.cells import CellGrid, spline_cells
from wpdc_gwcs.models.mapping import PlaneMap

__all__ = ["LookupTable"]

_METHODS = {"linear": 2, "cubic": 4}


def _check_grid(name, grid, least):
    """Return a validated read-only copy of the node positions of one axis."""
    grid = np.array(grid, dtype=float)
    if grid.ndim != 1 or len(grid) < least:
        raise ValueError(
            f"{name} must be one-dimensional with at least {least} nodes, not of shape {grid.shape}"
        )
    if not np.all(np.isfinite(grid)):
        raise ValueError(f"{name} must be finite")
    steps = np.diff(grid)
    step = (grid[-1] - grid[0]) / (len(grid) - 1)
    if not step > 0 or np.any(np.abs(steps - step) > 1e-6 * step):
        raise ValueError(
            f"{name} must be increasing and equally spaced; its steps range from "
            f"{steps.min():.9g} to {steps.max():.9g}"
        )
    grid.flags.writeable = False
    return grid


class LookupTable(Model):
    """Residual displacement ``(dX, dY)`` as a function of detector position, to be subtracted.

    Parameters
    ----------
    x_grid, y_grid : (nx,), (ny,) array_like
        Positions of the nodes in pixels, zero based; increasing and equally spaced.
    dx, dy : (ny, nx) array_like
        Displacements at the nodes in pixels, indexed ``[iy, ix]``.
    method : {"cubic", "linear"}, keyword-only
        ``"cubic"``: interpolating bicubic spline through the nodes (not-a-knot ends), continuous to
        the second derivative; needs four nodes along each axis.  ``"linear"``: bilinear; needs two.
    **kwargs
        ``name`` and ``meta`` of the model.

    Raises
    ------
    ValueError
        If the nodes are too few or not equally spaced, a value is not finite, the shapes do not
        agree, or the method is unknown.

    Notes
    -----
    Phase 2 of WPDC-2P: ``X'' = X' - dX(x, y)``, ``Y'' = Y' - dY(x, y)``.  The nodes run from the
    outer edge of the detector to the other, -0.5 ... n - 0.5.  Outside the nodes the table is
    continued linearly with the value and the slope at its edge.  It is smooth there but has little
    meaning; the bounding box of a WCS masks positions off the detector.

    References
    ----------
    WPDC-2P, arXiv:2603.09193, section 3.3.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.models import LookupTable
    >>> grid = np.linspace(-0.5, 99.5, 5)
    >>> table = LookupTable(grid, grid, np.full((5, 5), 0.25), np.zeros((5, 5)))
    >>> dx, dy = table(10.0, 20.0)
    >>> float(dx), float(dy)
    (0.25, 0.0)
    """

    n_inputs = 2
    n_outputs = 2
    _separable = False
    standard_broadcasting = False

    displacement = Parameter(
        default=np.zeros((2, 4, 4)), description="dx and dy at the nodes, (2, ny, nx), in pixels"
    )

    def __init__(self, x_grid, y_grid, dx, dy, *, method="cubic", **kwargs):
        if method not in _METHODS:
            raise ValueError(f"method must be one of {sorted(_METHODS)}, not {method!r}")
        least = _METHODS[method]
        self._x_grid = _check_grid("x_grid", x_grid, least)
        self._y_grid = _check_grid("y_grid", y_grid, least)
        self._method = method
        shape = (len(self._y_grid), len(self._x_grid))
        dx, dy = np.asarray(dx, dtype=float), np.asarray(dy, dtype=float)
        for label, values in (("dx", dx), ("dy", dy)):
            if values.shape != shape:
                raise ValueError(
                    f"{label} must have the shape (ny, nx) = {shape} of the grids, not "
                    f"{values.shape}"
                )
            if not np.all(np.isfinite(values)):
                n_bad = np.count_nonzero(~np.isfinite(values))
                raise ValueError(f"{label} must be finite at every node; {n_bad} nodes are not")
        self._cache = None
        super().__init__(displacement=np.array([dx, dy]), **kwargs)
        self.inputs = ("x", "y")
        self.outputs = ("dx", "dy")

    def __getstate__(self):
        # The spline is computed again when it is needed.
        return {**self.__dict__, "_cache": None}

    def __repr__(self):
        (x0, x1), (y0, y1) = (grid[[0, -1]].tolist() for grid in (self._x_grid, self._y_grid))
        return (
            f"<{type(self).__name__}({len(self._x_grid)} x {len(self._y_grid)} nodes, "
            f"x {x0:g} to {x1:g}, y {y0:g} to {y1:g}, {self._method}, "
            f"up to {np.abs(self.displacement.value).max():.3g} px)>"
        )

    @property
    def x_grid(self):
        """Positions of the nodes along x in pixels (read-only)."""
        return self._x_grid

    @property
    def y_grid(self):
        """Positions of the nodes along y in pixels (read-only)."""
        return self._y_grid

    @property
    def dx(self):
        """Displacement along x at the nodes, ``[iy, ix]``, in pixels (read-only)."""
        return self._nodes(0)

    @property
    def dy(self):
        """Displacement along y at the nodes, ``[iy, ix]``, in pixels (read-only)."""
        return self._nodes(1)

    def _nodes(self, axis):
        view = self.displacement.value[axis]
        view.flags.writeable = False
        return view

    @property
    def method(self):
        """Interpolation between the nodes: ``"cubic"`` or ``"linear"``."""
        return self._method

    def _cells(self, displacement=None):
        """Polynomial coefficients of every cell as a `CellGrid`, kept until the nodes change."""
        if displacement is None:
            displacement = self.displacement.value
        displacement = np.reshape(displacement, (2, len(self._y_grid), len(self._x_grid)))
        cache = self._cache
        if cache is not None and np.array_equal(cache[0], displacement):
            return cache[1]
        x_grid, y_grid = (
            np.linspace(grid[0], grid[-1], len(grid)) for grid in (self._x_grid, self._y_grid)
        )
        if self._method == "cubic":
            cells = spline_cells(x_grid, y_grid, displacement)
        else:
            low, high = displacement[:, :-1], displacement[:, 1:]
            along_y = np.stack([low, high - low])  # q, k, j, x
            low, high = along_y[..., :-1], along_y[..., 1:]
            both = np.stack([low, high - low])  # p, q, k, j, i
            coefficients = np.moveaxis(both, 2, 0)
            cells = CellGrid.continued(x_grid[[0, -1]], y_grid[[0, -1]], coefficients, smooth=False)
        self._cache = (displacement.copy(), cells)
        return cells

    def evaluate(self, x, y, displacement):
        """Interpolate the table.

        Parameters
        ----------
        x, y : array_like
            Pixel coordinates, zero based.
        displacement : (2, ny, nx) array_like
            The nodes.

        Returns
        -------
        dx, dy : ndarray
            Displacements to subtract, in pixels.
        """
        return evaluate_blocks(PlaneMap(grid=self._cells(displacement)).evaluate, x, y)

    def jacobian(self, x, y):
        """Return the derivatives of both outputs by both inputs.

        Parameters
        ----------
        x, y : array_like
            Pixel coordinates, zero based.

        Returns
        -------
        jacobian : (2, 2, ...) ndarray
            ``jacobian[i, j]`` is the derivative of output i by input j.
        """
        plane_map = PlaneMap(grid=self._cells())
        rows = evaluate_blocks(plane_map.jacobian, x, y, n_outputs=6)[2:]
        return np.array(rows).reshape(2, 2, *rows[0].shape)
