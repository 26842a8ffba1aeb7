"""Work on whole images strip by strip, always in the same memory.

Memory that is had from the system anew for every strip costs more time than the work in it.
"""

import numpy as np

__all__ = ["high_pixels", "row_strips"]

# Pixels of a strip: few enough for the cache of a processor.
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
        Their rows; the first has as many as any.
    """
    step = max(1, _PIXELS // shape[1])
    return [slice(k, min(k + step, shape[0])) for k in range(0, shape[0], step)]


def high_pixels(image, rms, factor):
    """Mark the pixels of an image that are so many standard deviations high.

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
        True for the pixels that are; good until the next strip.
    """
    strips = row_strips(image.shape)
    limit = np.empty((strips[0].stop, image.shape[1]), np.float32)
    high = np.empty(limit.shape, bool)
    for rows in strips:
        n = rows.stop - rows.start
        np.multiply(rms[rows], np.float32(factor), out=limit[:n])
        yield rows.start, np.greater(image[rows], limit[:n], out=high[:n])
