"""Cosmic-ray hits and hot pixels, which are sharper than any star of the image."""

import logging
from dataclasses import replace

import numpy as np
from scipy.special import erf

from wpdc_gwcs.detection._extract import star_size
from wpdc_gwcs.detection._strips import high_pixels

__all__ = ["mask_hits"]

log = logging.getLogger(__name__)

# Pixels tested, in standard deviations of the background.
_MIN_PEAK = 6.0

# Minimum height of the peaks that show the size of the stars, in standard deviations, and their
# maximum number.
_BRIGHT = 20.0
_N_BRIGHT = 500

# FWHM in px of the sharpest profile that optics and pixels can produce: anything sharper is not a
# star.  Above the broadest FWHM, the contrast for hits does not change.
_SHARPEST, _BROADEST = 1.0, 2.5

# Fraction of the expected light next to a peak below which it is a hit; profiles vary over the
# image.
_MARGIN = 0.6

# Standard deviations of noise that may decrease the neighboring pixels or increase the peak.
_NOISE = 2.5

# Opposite neighbors in four directions.
_DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))


def mask_hits(background, *, overwrite=False):
    r"""Mask the pixels that are bright because of cosmic rays or defects.

    Parameters
    ----------
    background : Background
        Image without background.
    overwrite : bool, optional
        Whether the image and its mask may be changed in place instead of copied.

    Returns
    -------
    Background
        The background with these pixels masked and set to 0.

    Notes
    -----
    A pixel is a hit if the mean of two opposite neighbors, in any of four directions, is lower than
    a star centered on it would make it (as in the photometric pipeline of the SDSS, Lupton et al.
    2001, ASP Conf. 238, 269).  The profile of stars is assumed to be a Gaussian.  Its FWHM is that
    of bright sources of the image along their minor axis, without sources sharper than 1 px, and at
    most 2.5 px.  The expected light is decreased by 40 % and by 2.5 standard deviations.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.detection import mask_hits, subtract_background
    >>> y, x = np.mgrid[:200, :200]
    >>> image = np.random.default_rng(1).normal(100, 5, x.shape)
    >>> for x0, y0 in 20 * np.mgrid[1:10, 1:10].reshape(2, -1).T:
    ...     image += 3000 * np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / 2)
    >>> image[50, 70] += 1000
    >>> background = mask_hits(subtract_background(image))
    >>> np.argwhere(background.mask).tolist()
    [[50, 70]]
    """
    image, rms = background.image, background.rms
    y, x = _peaks(image, rms)
    if len(x) == 0:
        return background
    peak, noise = image[y, x], rms[y, x]
    beside, against = (
        np.array([image[y + s * j, x + s * i] for j, i in _DIRECTIONS]) for s in (1, -1)
    )
    pairs = 0.5 * (beside + against)
    if background.mask is not None:
        # If one pixel of a pair is bad, the pair is not used: the star may be on the bad side.
        for sign in (1, -1):
            for pair, (j, i) in zip(pairs, _DIRECTIONS, strict=True):
                pair[background.mask[y + sign * j, x + sign * i]] = np.inf
    impossible = _sharper(peak, pairs, noise, _SHARPEST)
    top = (peak > _BRIGHT * noise) & ~impossible
    top &= (peak >= beside.max(axis=0)) & (peak >= against.max(axis=0))
    rows = np.flatnonzero(top)
    # The very brightest are saturated.
    rows = rows[peak[rows] < 0.7 * peak.max()] if len(rows) > 10 else rows
    rows = rows[np.argsort(peak[rows])[::-1][:_N_BRIGHT]]
    size = star_size(image, x[rows].astype(float), y[rows].astype(float)) if len(rows) else None
    hit = impossible
    if size is not None:
        hit |= _sharper(peak, pairs, noise, np.clip(size[1], _SHARPEST, _BROADEST))
    if not hit.any():
        return background
    log.debug("%d pixels masked as hits", np.count_nonzero(hit))
    result = background if overwrite else background.copy()
    mask = np.zeros(image.shape, bool) if result.mask is None else result.mask
    mask[y[hit], x[hit]] = True
    result.image[y[hit], x[hit]] = 0
    return replace(result, mask=mask)


def _peaks(image, rms):
    """Rows and columns of the pixels tested; at the rim, neighbors are missing."""
    rows, columns = [], []
    for first, high in high_pixels(image[1:-1], rms[1:-1], _MIN_PEAK):
        # There are few of them, which are found several times as fast in a flat array.
        high[:, 0] = high[:, -1] = False
        y, x = np.divmod(np.flatnonzero(high), high.shape[1])
        rows.append(y + first + 1)
        columns.append(x)
    return np.concatenate(rows), np.concatenate(columns)


def _sharper(peak, pairs, noise, fwhm):
    """Mark the peaks that are sharper than a star of this FWHM."""
    root = np.sqrt(8 * np.log(2)) / fwhm / np.sqrt(2)
    inner, outer = erf(0.5 * root), 0.5 * (erf(1.5 * root) - erf(0.5 * root))
    ratio = outer / inner
    # A diagonal step is one along each axis.
    expected = np.array([_MARGIN * ratio] * 2 + [(_MARGIN * ratio) ** 2] * 2)[:, None]
    light = pairs + _NOISE / np.sqrt(2) * noise
    return (light < expected * (peak - _NOISE * noise)).any(axis=0)
