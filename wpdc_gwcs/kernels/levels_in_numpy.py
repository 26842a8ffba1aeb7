"""The kernels of the levels of the sky in NumPy, for installations without a compiler.

They give the same numbers as the compiled ones, to the last bit.
"""

import numpy as np

__all__ = ["N_STEPS", "count_levels", "put_cubics"]

#: Number of steps that the values of a cell are counted in.
N_STEPS = 256


def count_levels(image, mask, rows, columns, low, rate, counts):
    """Count the pixels within the cells of an image by their values.

    Parameters
    ----------
    image : (ny, nx) float32 ndarray
        The image.
    mask : (ny, nx) bool ndarray or None
        True for pixels that do not count.
    rows, columns : (M + 1,), (N + 1,) ndarray
        First rows and columns of the cells, whole numbers, and those behind the last cell.
    low, rate : (M * N,) float32 ndarray
        The lowest value that counts, and the number of steps per unit, of every cell.
    counts : (M * N, 256) intc ndarray
        The numbers of pixels in each step are written here.
    """
    rows, columns = rows.astype(int), columns.astype(int)
    widths = np.diff(columns)
    n = len(widths)
    cell = np.repeat(np.arange(n), widths)
    for j in range(len(rows) - 1):
        strip = np.s_[rows[j] : rows[j + 1], columns[0] : columns[-1]]
        mine = slice(j * n, (j + 1) * n)
        with np.errstate(over="ignore", invalid="ignore"):
            place = (image[strip] - np.repeat(low[mine], widths)) * np.repeat(rate[mine], widths)
        inside = (place >= 0) & (place < N_STEPS)
        if mask is not None:
            inside &= ~mask[strip]
        index = (np.broadcast_to(cell, place.shape)[inside], place[inside].astype(int))
        flat = np.ravel_multi_index(index, (n, N_STEPS))
        counts[mine] = np.bincount(flat, minlength=n * N_STEPS).reshape(n, N_STEPS)


def put_cubics(coefficients, edges, offset, subtract, image):
    """Write piecewise cubics into the rows of an image, or take them off it.

    Parameters
    ----------
    coefficients : (ny, N, 4) float32 ndarray
        Those of every piece in every row, the highest power first.
    edges : (N + 1,) ndarray
        First columns of the pieces, whole numbers, and the one behind the last.
    offset : (nx,) float32 ndarray
        Argument of the cubics in every column.
    subtract : bool
        Whether the cubics are taken off the image.
    image : (ny, nx) float32 ndarray
        The image.
    """
    widths = np.diff(edges.astype(int))
    c = (np.repeat(coefficients[:, :, k], widths, axis=1) for k in range(4))
    value = next(c) * offset
    value += next(c)
    value *= offset
    value += next(c)
    value *= offset
    value += next(c)
    if subtract:
        image -= value
    else:
        image[:] = value
