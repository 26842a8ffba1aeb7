"""The kernel that marks the cells of peaks in NumPy, for installations without a compiler.

It gives the same results as the compiled one.
"""

import numpy as np

__all__ = ["mark_cells"]


def mark_cells(image, rms, mask, line, factor, size, first, last, cells):
    """Mark the cells of an image in which the smoothed image exceeds a threshold.

    Parameters
    ----------
    image, rms : (ny, nx) float32 ndarray
        The image, and its noise.
    mask : (ny, nx) bool ndarray or None
        True for pixels that count as 0, like those outside the image.
    line : (2 n + 1,) float32 ndarray
        Symmetric weights of the filter along each axis.
    factor : float
        The threshold, in units of the noise.
    size : int
        Side of the cells in px.
    first, last : int
        The first row of cells to process, and the row after the last one.
    cells : (my, mx) bool ndarray
        Marked cells become True here.
    """
    n_rows, n_columns = image.shape
    half = len(line) // 2
    for k in range(first, last):
        top, bottom = k * size, min((k + 1) * size, n_rows)
        low, high = max(top - half, 0), min(bottom + half, n_rows)
        part = np.zeros((bottom - top + 2 * half, n_columns + 2 * half), np.float32)
        inside = part[half - (top - low) :][: high - low, half : half + n_columns]
        inside[:] = image[low:high]
        if mask is not None:
            inside[mask[low:high]] = 0
        smooth = _filtered(_filtered(part, line).T, line).T
        high = (smooth > np.float32(factor) * rms[top:bottom]).any(axis=0)
        cells[k] |= np.logical_or.reduceat(high, np.arange(0, n_columns, size))


def _filtered(values, line):
    """Values filtered along the first axis, without the ends."""
    half = len(line) // 2
    n = len(values) - 2 * half
    result = line[half] * values[half : half + n]
    for k in range(half):
        pair = values[k : k + n] + values[2 * half - k :][:n]
        pair *= line[k]
        result += pair
    return result
