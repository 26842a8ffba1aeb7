"""The level at which pixels are saturated."""

import numpy as np

__all__ = ["plateau", "saturation_problem"]

# A stated saturation level is wrong if the brightest pixels exceed it by this factor; flat fields
# and stacks cause smaller factors.
_MAX_EXCESS = 3.0
# If pixels are cut off below this fraction of it, they are saturated there.
_BELOW = 0.95
# Levels within this many standard deviations of the background are those of the sky.
_ABOVE_SKY = 10.0


def saturation_problem(background, saturation):
    """Explain why a stated saturation level contradicts the pixels of an image.

    Parameters
    ----------
    background : Background
        Image without background.
    saturation : float
        Saturation level in counts, including the background.

    Returns
    -------
    str or None
        The contradiction; None if there is none.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.detection import saturation_problem, subtract_background
    >>> image = np.random.default_rng(1).normal(100, 5, (200, 200))
    >>> image[50:55, 50:55] = 60000
    >>> background = subtract_background(image)
    >>> print(saturation_problem(background, 60000.0))
    None
    >>> print(saturation_problem(background, 1000.0))
    pixels of the image reach 6e+04
    """
    height = saturation - background.level
    if not height > _ABOVE_SKY * background.noise:
        return f"the sky of the image is at {background.level:.4g} +- {background.noise:.2g}"
    highest = float(background.image.max()) * background.unit
    if highest > _MAX_EXCESS * height:
        return f"pixels of the image reach {highest + background.level:.4g}"
    top = plateau(background)
    if top is not None and top - background.level < _BELOW * height:
        return f"pixels of the image are cut off at {top:.4g}"
    return None


def plateau(background):
    """Find the level at which the brightest pixels are cut off.

    Parameters
    ----------
    background : Background
        Image without background.

    Returns
    -------
    float or None
        Level in counts, including the background; None if there is no such level.

    Notes
    -----
    The brighter peaks of stars are, the rarer they are.  So if many pixels have nearly the largest
    value, they have been cut off there.
    """
    indices, values = background.bright.indices, background.bright.values
    height = background.image.reshape(-1)[indices]
    top = float(height.max(initial=0.0))
    # The largest values of the image without background: the background varies less than the peaks.
    high = height > 0.9 * top
    if background.mask is not None:
        high &= ~background.mask.reshape(-1)[indices]
    values = (values[high].astype(float) - background.level) / background.unit
    limit = 0.999 * values.max(initial=0.0)
    at_top = np.count_nonzero(values >= limit)
    if at_top < max(5, 2 * (values.size - at_top)) or top < 50 * np.median(background.rms[::99]):
        return None
    return background.level + float(limit) * background.unit
