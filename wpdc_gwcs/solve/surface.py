"""Smooth displacements sampled on a grid, for fast repeated evaluation."""

from dataclasses import dataclass

import numpy as np

from wpdc_gwcs.models.blocks import evaluate_blocks
from wpdc_gwcs.models.cells import spline_cells
from wpdc_gwcs.models.mapping import PlaneMap

__all__ = ["SampledField", "SummedField", "TableSurface", "of_field", "of_table"]

# Nodes per shortest wave of a field: the spline is accurate to a thousandth of its amplitude.
_NODES_PER_WAVE = 6

# Steps by which the grid of a field extends beyond its box on each side: distortion moves stars
# over the edge.
_BEYOND = 2


@dataclass(frozen=True, eq=False)
class TableSurface:
    """Displacements of a look-up table, the same spline.

    Parameters
    ----------
    plane_map : PlaneMap
        Map from (x, y) to both displacements.
    """

    plane_map: PlaneMap

    def __call__(self, x, y):
        """Return the displacement of pixels.

        Parameters
        ----------
        x, y : (N,) ndarray
            Pixels.

        Returns
        -------
        (2, N) ndarray
            Px.
        """
        return np.array(evaluate_blocks(self.plane_map.evaluate, x, y))


@dataclass(frozen=True, eq=False)
class SampledField:
    """A field with its values on a grid.

    Parameters
    ----------
    field : Field
        The field, for its covariance.
    surface : TableSurface
        Its sampled values.
    """

    field: object
    surface: TableSurface

    def __call__(self, focal):
        """Displacement at focal plane positions.

        Parameters
        ----------
        focal : (2, N) ndarray
            Focal plane, px.

        Returns
        -------
        (2, N) ndarray
            Px.
        """
        return self.surface(*focal)

    def covariance(self, focal):
        """Return the posterior covariance, see `Field`.

        Parameters
        ----------
        focal : (2, N) ndarray
            Focal plane, px.

        Returns
        -------
        (2, 2, N) ndarray
            Px^2.
        """
        return self.field.covariance(focal)


@dataclass(frozen=True, eq=False)
class SummedField:
    """The sum of independent fields.

    Parameters
    ----------
    parts : tuple of SampledField
        The fields.
    """

    parts: tuple

    def __call__(self, focal):
        """Displacement at focal plane positions.

        Parameters
        ----------
        focal : (2, N) ndarray
            Focal plane, px.

        Returns
        -------
        (2, N) ndarray
            Px.
        """
        return sum(part(focal) for part in self.parts)

    def covariance(self, focal):
        """Return the posterior covariance.

        Parameters
        ----------
        focal : (2, N) ndarray
            Focal plane, px.

        Returns
        -------
        (2, 2, N) ndarray
            Px^2.
        """
        return sum(part.covariance(focal) for part in self.parts)


def of_table(table):
    """Convert a look-up table to cells that are set up once.

    Parameters
    ----------
    table : LookupTable
        Table.

    Returns
    -------
    TableSurface
        The same displacements.
    """
    return TableSurface(PlaneMap(grid=table._cells()))


def of_field(field, low, high, *, least_steps=1):
    """Sample a field over a box of the focal plane.

    Parameters
    ----------
    field : Field
        Field.
    low, high : (2,) ndarray
        Corners, px.
    least_steps : int, optional
        Minimum number of grid steps over the box.

    Returns
    -------
    SampledField
        The field on a grid.
    """
    size = high - low
    shortest = 2 * np.pi / np.abs(field.wave).max(axis=1)
    steps = np.maximum(np.ceil(_NODES_PER_WAVE * size / shortest).astype(int), least_steps)
    grids = [a + s / n * np.arange(-_BEYOND, n + _BEYOND + 1) for a, s, n in zip(low, size, steps)]
    x, y = np.meshgrid(*grids)
    values = field(np.array([x.ravel(), y.ravel()])).reshape(2, *x.shape)
    return SampledField(field, TableSurface(PlaneMap(grid=spline_cells(*grids, values))))
