"""Raw mosaics of color cameras: pixels behind red, green and blue filters in turn.

The pattern repeats every 2 x 2 px.  Its four planes differ in the level and noise of the sky and in
their response to stars.  Scaled to the same response, with the noise scaled accordingly, they are
one image of the light of all colors.
"""

import numpy as np
from scipy.ndimage import maximum_filter, uniform_filter

from wpdc_gwcs.robust import robust_scatter

__all__ = ["has_pattern", "plane_slices", "star_responses"]

# Minimum difference between the levels of the planes, in standard deviations of a pixel and of the
# levels themselves, for separate backgrounds.
_MIN_DIFFERENCE = 0.1
_MIN_SIGNIFICANCE = 8.0

# Peaks in the sum of the planes that show the response: significant, and below saturation.
_MIN_PEAK = 30.0
_MAX_PEAK = 0.5
_MIN_PEAKS = 8
_MAX_PEAKS = 500
_HALF = 2  # cells of 2 x 2 px about a peak

# Smaller differences of the response are due to the sample of stars.
_MIN_RESPONSE = 0.02


def plane_slices(period):
    """Return the slices of the planes of a mosaic.

    Parameters
    ----------
    period : int
        Number of pixels after which the pattern repeats; 1 for an image without a pattern.

    Returns
    -------
    list of (slice, slice)
        Rows and columns of each plane.
    """
    return [
        (slice(j, None, period), slice(i, None, period))
        for j in range(period)
        for i in range(period)
    ]


def has_pattern(data, bad, scatter):
    """Return whether the levels of an image repeat every 2 x 2 px.

    Parameters
    ----------
    data : (ny, nx) ndarray
        Image.
    bad : (ny, nx) ndarray of bool or None
        True for pixels that are not used.
    scatter : float
        Scatter of the pixels about their level.

    Returns
    -------
    bool
        True for a mosaic.
    """
    step = 2 * max(1, min(data.shape) // 1000)
    levels, errors = [], []
    for j in (0, 1):
        for i in (0, 1):
            sample = data[j::step, i::step]
            sample = sample[~bad[j::step, i::step]] if bad is not None else sample.ravel()
            if sample.size < 100:
                return False
            sample = sample.astype(float)
            levels.append(np.median(sample))
            spread = robust_scatter(sample)
            errors.append(1.25 * max(spread, 1e-3 * scatter) / np.sqrt(sample.size))
    # The noise of a plane, because the scatter of the image includes the pattern.
    noise = np.median(errors) * np.sqrt(sample.size)
    difference = np.max(levels) - np.min(levels)
    return bool(
        difference > _MIN_DIFFERENCE * noise and difference > _MIN_SIGNIFICANCE * np.max(errors)
    )


def star_responses(image, rms, bad):
    """Measure the response of the four planes of a mosaic to the light of stars.

    Parameters
    ----------
    image, rms : (ny, nx) ndarray
        Image without background, and its noise.
    bad : (ny, nx) ndarray of bool or None
        True for pixels that are not used.

    Returns
    -------
    (4,) ndarray
        Responses relative to their mean; all one if the stars show no differences.
    """
    ny, nx = (n // 2 for n in image.shape)
    planes = np.stack([image[s][:ny, :nx] for s in plane_slices(2)])
    noise = np.sqrt(sum(rms[s][:ny, :nx] ** 2 for s in plane_slices(2)))
    hidden = np.zeros((ny, nx), bool)
    if bad is not None:
        hidden = np.any([bad[s][:ny, :nx] for s in plane_slices(2)], axis=0)
    light = uniform_filter(planes.sum(axis=0), 3)
    size = 2 * _HALF + 1
    peak = (light == maximum_filter(light, size)) & (light > _MIN_PEAK * noise / 3)
    peak &= light < _MAX_PEAK * light.max()
    peak &= ~maximum_filter(hidden, size)
    peak[:_HALF] = peak[-_HALF:] = peak[:, :_HALF] = peak[:, -_HALF:] = False
    y, x = np.nonzero(peak)
    if len(y) < _MIN_PEAKS:
        return np.ones(4)
    brightest = np.argsort(light[y, x])[::-1][:_MAX_PEAKS]
    step = np.arange(-_HALF, _HALF + 1)
    iy, ix = y[brightest, None] + step, x[brightest, None] + step
    flux = planes[:, iy[:, :, None], ix[:, None, :]].sum(axis=(2, 3))
    ratio = flux / flux.mean(axis=0)
    response = np.median(ratio, axis=1)
    error = 1.25 * np.std(ratio, axis=1) / np.sqrt(len(brightest))
    known = np.abs(response - 1) > np.maximum(_MIN_RESPONSE, 4 * error)
    if not known.any() or not (response > 0.02).all():
        return np.ones(4)
    return response / response.mean()
