"""Input of the kernels as plain arrays: a map of the plane, and a tangent point."""

from typing import NamedTuple

import numpy as np

__all__ = ["Plane", "arrange", "arranged", "box_numbers", "tangent_numbers"]

# Alignment of a table in memory, so that a cell does not use more cache lines than necessary.
_ALIGNMENT = 64


class Plane(NamedTuple):
    """A map of the plane: polynomial, radial terms and bicubic cells, summed.

    A missing part is empty.

    Parameters
    ----------
    head : (14,) ndarray
        First edge, last edge and step of the cells along x, the same along y, numbers of cells
        along x and y; reference point of the polynomial, x and y; matrix of the radius, row by row.
    polynomial : (6, n, n) ndarray
        ``polynomial[k, p, q]`` multiplies ``u**p v**q``, where (u, v) is the point minus the
        reference point, in a, b and their derivatives a_x, a_y, b_x, b_y; p + q < n.
    radial : (4, m) ndarray
        ``radial[k, s]`` multiplies ``r**s`` in a, b and their derivatives by r, where r is the
        length of the matrix times (u, v).
    table : (...) ndarray
        Coefficients of the cells, see `arrange`.
    """

    head: np.ndarray
    polynomial: np.ndarray
    radial: np.ndarray
    table: np.ndarray


def arrange(coefficients, order):
    """Lay out the coefficients of cells in memory as kernels read them.

    Parameters
    ----------
    coefficients : (2, 4, 4, ny + 2, nx + 2) ndarray
        ``coefficients[k, p, q, j, i]`` multiplies ``s**p t**q`` in output k in cell (j, i).
    order : str
        The same five letters in the order of the kernels, ``CELL_ORDER``.

    Returns
    -------
    table : (...) ndarray
        Array, contiguous in this order.
    """
    ordered = coefficients.transpose(["kpqji".index(letter) for letter in order])
    space = np.empty(ordered.size * 8 + _ALIGNMENT, dtype=np.uint8)
    offset = -space.ctypes.data % _ALIGNMENT
    table = space[offset : offset + ordered.size * 8].view(np.float64).reshape(ordered.shape)
    table[...] = ordered
    return table


def arranged(table, order):
    """Return the coefficients from the table of `arrange`, as a view.

    Parameters
    ----------
    table : (...) ndarray
        As returned by `arrange`.
    order : str
        Its order.

    Returns
    -------
    coefficients : (2, 4, 4, ny + 2, nx + 2) ndarray
        ``coefficients[k, p, q, j, i]``.
    """
    return table.transpose([order.index(letter) for letter in "kpqji"])


def tangent_numbers(crval, matrix=((1.0, 0.0), (0.0, 1.0)), offset=(0.0, 0.0)):
    """Return a tangent point and the map from the plane to pixels, for kernels.

    Parameters
    ----------
    crval : (float, float)
        Tangent point, RA and Dec in degrees.
    matrix : (2, 2) array_like, optional
        Matrix from standard coordinates in degrees to pixels.
    offset : (float, float), optional
        Pixel of the tangent point.

    Returns
    -------
    numbers : (9,) ndarray
        RA (0 to 360), sine and cosine of Dec, the matrix row by row, the offset.
    """
    ra0, dec0 = (float(value) for value in crval)
    sine, cosine = np.sin(np.radians(dec0)), np.cos(np.radians(dec0))
    return np.array([ra0 % 360.0, sine, cosine, *np.ravel(matrix), *offset], dtype=float)


def box_numbers(box, fill_value):
    """Return a bounding box for kernels, `None` for none.

    Parameters
    ----------
    box : ((float, float), (float, float)) or None
        Smallest and largest x, smallest and largest y.
    fill_value : float
        Value of points outside.

    Returns
    -------
    numbers : (5,) ndarray or None
        The limits and the value.
    """
    if box is None:
        return None
    return np.array([*box[0], *box[1], fill_value], dtype=float)
