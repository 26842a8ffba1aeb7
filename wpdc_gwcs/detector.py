"""The area of a detector."""

import numpy as np

__all__ = ["on_detector"]


def on_detector(x, y, image_shape):
    """Mark positions on a detector, including its outer edges.

    Parameters
    ----------
    x, y : array_like
        Pixel coordinates, zero based.
    image_shape : (int, int)
        Shape ``(ny, nx)``.

    Returns
    -------
    ndarray of bool
        False for NaN as well.

    Examples
    --------
    >>> from wpdc_gwcs.detector import on_detector
    >>> on_detector([-0.5, 9.6, float("nan")], [0.0, 0.0, 0.0], (5, 10)).tolist()
    [True, False, False]
    """
    ny, nx = image_shape
    x, y = np.asarray(x, float), np.asarray(y, float)
    return (x >= -0.5) & (x <= nx - 0.5) & (y >= -0.5) & (y <= ny - 0.5)
