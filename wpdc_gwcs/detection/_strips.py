"""Processing of whole images strip by strip, always in the same memory.

To get new memory from the system for every strip takes more time than the work itself.
"""

import numpy as np

__all__ = ["high_pixels", "row_strips"]

# Number of pixels in a strip, which fits into the cache of a processor.
_PIXELS = 200_000


def row_strips(shape):
    """Divide an image into strips.

    Parameters
    ----------
    shape : (int, int)
        Shape of the image.

    Returns
    -------
    list of slice
        Rows of the strips; no strip has more rows than the first one.
    """
    step = max(1, _PIXELS // shape[1])
    return [slice(k, min(k + step, shape[0])) for k in range(0, shape[0], step)]


def high_pixels(image, rms, factor):
    """Mark the pixels of an image above a number of standard deviations.

    Parameters
    ----------
    image, rms : (ny, nx) ndarray of float32
        Image, and its noise.
    factor : float
        Number of standard deviations.

    Yields
    ------
    first : int
        First row of a strip.
    high : (n, nx) ndarray of bool
        True for these pixels; the array is reused for the next strip.
    """
    strips = row_strips(image.shape)
    limit = np.empty((strips[0].stop, image.shape[1]), np.float32)
    high = np.empty(limit.shape, bool)
    for rows in strips:
        n = rows.stop - rows.start
        np.multiply(rms[rows], np.float32(factor), out=limit[:n])
        yield rows.start, np.greater(image[rows], limit[:n], out=high[:n])
