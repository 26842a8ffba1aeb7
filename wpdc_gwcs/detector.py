"""The area of a detector."""

import numpy as np

__all__ = ["on_detector"]


def on_detector(x, y, image_shape, *, margin=0.0):
    """Tell which positions lie on a detector, its outer edges included.

    Parameters
    ----------
    x, y : array_like
        Pixel coordinates, zero based.
    image_shape : (int, int)
        Shape ``(ny, nx)``.
    margin : float, optional
        Width in px of a rim that does not count.

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
    low, right, top = margin - 0.5, nx - 0.5 - margin, ny - 0.5 - margin
    return (x >= low) & (x <= right) & (y >= low) & (y <= top)
