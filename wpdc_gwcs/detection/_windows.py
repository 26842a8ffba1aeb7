"""Windows of an image outside which nothing exceeds a threshold."""

import numpy as np
from scipy import ndimage

from wpdc_gwcs import kernels
from wpdc_gwcs.threads import map_threads

__all__ = ["CELL", "find_windows", "high_cells"]

# Side of a cell in px, and number of rows of cells that are processed at a time.
CELL = 32
_CELL_ROWS = 8

# Rounding error of float32 in a filter: values so close to the threshold count as above it.
_ROUNDING = 1e-4

_TOUCHING = np.ones((3, 3), bool)


def high_cells(image, rms, mask, line, factor):
    """Mark the cells in which the smoothed image exceeds a threshold.

    Parameters
    ----------
    image, rms : (ny, nx) float32 ndarray
        Image, and its noise, C-contiguous.
    mask : (ny, nx) bool ndarray or None
        True for pixels that count as 0, like those outside the image.
    line : (2 n + 1,) ndarray
        Symmetric weights of the filter along each axis.
    factor : float
        The threshold, in standard deviations of the noise of single pixels.

    Returns
    -------
    (my, mx) ndarray of bool
        True for marked cells of 32 x 32 px.
    """
    line, factor = np.asarray(line, np.float32), (1 - _ROUNDING) * factor
    n, m = (-(-size // CELL) for size in image.shape)
    cells = np.zeros((n, m), bool)

    def mark(first):
        last = min(first + _CELL_ROWS, n)
        kernels.mark_cells(image, rms, mask, line, factor, CELL, first, last, cells)

    map_threads(mark, range(0, n, _CELL_ROWS))
    return cells


def find_windows(cells, shape, margin):
    """Find windows around marked cells; cells that touch each other share a window.

    Parameters
    ----------
    cells : (my, mx) ndarray of bool
        Marked cells, as from `high_cells`.
    shape : (int, int)
        Shape of the image.
    margin : int
        Margin of the windows around their cells, px.

    Returns
    -------
    list of (slice, slice)
        Rows and columns of each window.
    labels : (my, mx) ndarray of int
        Number of the window of each cell, from 1; 0 for unmarked cells.  Windows of interlocking
        groups of cells overlap.
    """
    labels, _ = ndimage.label(cells, _TOUCHING)

    def widened(cells, size):
        return slice(max(CELL * cells.start - margin, 0), min(CELL * cells.stop + margin, size))

    found = ndimage.find_objects(labels)
    return [tuple(map(widened, window, shape)) for window in found], labels
