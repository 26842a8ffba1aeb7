"""The area and the name of a detector."""

import numpy as np

__all__ = ["UNNAMED", "detector_label", "on_detector"]

#: Name of a detector that no header names.
UNNAMED = "detector"


def on_detector(x, y, image_shape, *, margin=0.0):
    """Mark positions on a detector, including its outer edges.

    Parameters
    ----------
    x, y : array_like
        Pixel coordinates, zero based.
    image_shape : (int, int)
        Shape ``(ny, nx)``.
    margin : float, optional
        Width in px of a border that does not count.

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


def detector_label(name):
    """Return how a detector is called in a text.

    Parameters
    ----------
    name : str
        Its name.

    Returns
    -------
    str
        For example "detector g-1"; an empty text for a detector without a name.

    Examples
    --------
    >>> from wpdc_gwcs.detector import detector_label
    >>> detector_label("g-1"), detector_label("detector")
    ('detector g-1', '')
    """
    return "" if name == UNNAMED else f"detector {name}"
