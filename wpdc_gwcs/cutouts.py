"""Square cutouts about many sources at once."""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

__all__ = ["cut_squares", "on_image"]


def cut_squares(image, xc, yc, half):
    """Cut squares about integer centers; at the edge, the outermost pixels are repeated.

    Parameters
    ----------
    image : (ny, nx) ndarray
        Image.
    xc, yc : (N,) ndarray of int
        Central pixels.
    half : int
        The squares are n = 2 half + 1 px wide.

    Returns
    -------
    (N, n, n) ndarray
        Pixels.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.cutouts import cut_squares
    >>> cut_squares(np.arange(12).reshape(3, 4), np.array([0, 2]), np.array([0, 1]), 1).tolist()
    [[[0, 0, 1], [0, 0, 1], [4, 4, 5]], [[1, 2, 3], [5, 6, 7], [9, 10, 11]]]
    """
    ny, nx = image.shape
    size = 2 * half + 1
    whole = (xc >= half) & (xc < nx - half) & (yc >= half) & (yc < ny - half)
    # Whole rows are copied; indices of single pixels would take several times as long.
    if whole.all() and len(xc):
        return sliding_window_view(image, (size, size))[yc - half, xc - half]
    result = np.empty((len(xc), size, size), image.dtype)
    if whole.any():
        windows = sliding_window_view(image, (size, size))
        result[whole] = windows[yc[whole] - half, xc[whole] - half]
    step = np.arange(-half, half + 1)
    iy = np.clip(yc[~whole, None] + step, 0, ny - 1)
    ix = np.clip(xc[~whole, None] + step, 0, nx - 1)
    result[~whole] = image[iy[:, :, None], ix[:, None, :]]
    return result


def on_image(shape, xc, yc, half):
    """Mark the pixels of squares that are on the image.

    Parameters
    ----------
    shape : (int, int)
        Shape of the image.
    xc, yc : (N,) ndarray of int
        Central pixels.
    half : int
        The squares are n = 2 half + 1 px wide.

    Returns
    -------
    (N, n, n) ndarray of bool
        True for pixels on the image.
    """
    step = np.arange(-half, half + 1)
    iy, ix = yc[:, None] + step, xc[:, None] + step
    rows, columns = ((i >= 0) & (i < size) for i, size in zip((iy, ix), shape, strict=True))
    return rows[:, :, None] & columns[:, None, :]
