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
        True for pixels that are not used.
    rows, columns : (M + 1,), (N + 1,) ndarray
        First rows and columns of the cells, followed by the row and column after the last cell;
        whole numbers.
    low, rate : (M * N,) float32 ndarray
        Lowest value, and number of steps per unit, for each cell.
    counts : (M * N, 256) intc ndarray
        The number of pixels in each step is written here.
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
    """Write piecewise cubics into the rows of an image, or subtract them from it.

    Parameters
    ----------
    coefficients : (ny, N, 4) float32 ndarray
        Coefficients of each piece in each row, the highest power first.
    edges : (N + 1,) ndarray
        First columns of the pieces, followed by the column after the last one; whole numbers.
    offset : (nx,) float32 ndarray
        Argument of the cubics in each column.
    subtract : bool
        Whether the cubics are subtracted from the image instead of written into it.
    image : (ny, nx) float32 ndarray
        The image, changed in place.
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
