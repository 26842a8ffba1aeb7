"""Images without their background, and their noise."""

from dataclasses import dataclass, replace

import numpy as np

from wpdc_gwcs.detection._levels import measure_levels
from wpdc_gwcs.detection._mosaic import has_pattern, plane_slices, star_responses
from wpdc_gwcs.detection._strips import row_strips
from wpdc_gwcs.exceptions import DetectionError
from wpdc_gwcs.robust import robust_scatter

__all__ = ["Background", "subtract_background"]

# Values farther from the level than this, in standard deviations, are blanks of some kind; sums of
# their squares would overflow float32.
_BLANK = 1e10

# Range of the noise in counts for which counts are the unit; the squares are within float32.
_PLAIN = (1e-3, 1e6)

# Pixels this many standard deviations below the background are dead, because no source is dark.
_COLD = 10.0

# Size in px of the cells in which a weight map gives the noise of the sky.  Many variance maps
# include the photons of stars, which the gain accounts for; the median over a cell excludes them.
_WEIGHT_CELL = 16

# Pixels that may be saturated, in units of the scatter above the median: no sky is so bright.
_BRIGHT = 5.0


@dataclass(frozen=True, eq=False)
class Background:
    """An image without its background, and its noise.

    Parameters
    ----------
    image : (ny, nx) float32 ndarray
        Image minus background in `unit`; masked pixels are 0.
    rms : (ny, nx) float32 ndarray
        Standard deviation of the background in every pixel, in `unit`.
    mask : (ny, nx) bool ndarray or None
        True where a pixel must not be used; None if all are good.
    level : float
        Median of the subtracted background, in counts.
    bright : BrightPixels
        The bright pixels of the original image.
    unit : float, optional
        Counts in one unit of `image` and `rms`.  It is 1 unless the noise in counts is so small or
        so large that its square does not fit into float32.
    photons : (ny, nx) float32 ndarray or None, optional
        Variance of the photons of a star relative to that from the gain, if a weight map or the
        filters of a mosaic show that pixels differ in response or exposure; None otherwise.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.detection import subtract_background
    >>> image = np.random.default_rng(1).normal(100, 5, (200, 200))
    >>> background = subtract_background(image)
    >>> round(background.level), round(float(background.noise))
    (100, 5)
    >>> bool(abs(background.image.mean()) < 0.1)
    True
    """

    image: np.ndarray
    rms: np.ndarray
    mask: np.ndarray | None
    level: float
    bright: "BrightPixels"
    unit: float = 1.0
    photons: np.ndarray | None = None

    @property
    def shape(self):
        """Shape of the image, (ny, nx)."""
        return self.image.shape

    @property
    def noise(self):
        """Typical standard deviation of the background in counts."""
        step = max(1, min(self.rms.shape) // 500)
        return float(np.median(self.rms[::step, ::step])) * self.unit

    def copy(self):
        """Return a copy whose image and mask may be changed.

        Returns
        -------
        Background
            The copy.
        """
        mask = None if self.mask is None else self.mask.copy()
        return replace(self, image=self.image.copy(), mask=mask)

    def rows(self, start, stop):
        """Return some of the rows.

        Parameters
        ----------
        start, stop : int
            The first row, and the row after the last one.

        Returns
        -------
        Background
            The rows, as views.
        """
        mask, photons = (
            None if values is None else values[start:stop] for values in (self.mask, self.photons)
        )
        size = self.image.shape[1]
        return replace(
            self,
            image=self.image[start:stop],
            rms=self.rms[start:stop],
            mask=mask,
            photons=photons,
            bright=self.bright.between(start * size, stop * size),
        )

    def saturated(self, level):
        """Mark the saturated pixels.

        Parameters
        ----------
        level : float
            Saturation level in counts, including the background.

        Returns
        -------
        (ny, nx) ndarray of bool
            True for saturated pixels.  Pixels hardly above the background never are.
        """
        full = np.zeros(self.image.shape, bool)
        high = self.bright.values >= level
        full.reshape(-1)[self.bright.indices[high]] = True
        return full


@dataclass(frozen=True, eq=False)
class BrightPixels:
    """The bright pixels of an image, which may be saturated.

    Parameters
    ----------
    indices : (N,) ndarray of int
        Indices of the pixels in the flat image, ascending.
    values : (N,) ndarray
        Counts, including the background.
    """

    indices: np.ndarray
    values: np.ndarray

    def between(self, start, stop):
        """Return the bright pixels in a part of the flat image.

        Parameters
        ----------
        start, stop : int
            The first index, and the index after the last one.

        Returns
        -------
        BrightPixels
            Bright pixels with indices in that part.
        """
        k = slice(*np.searchsorted(self.indices, [start, stop]))
        return BrightPixels(self.indices[k] - start, self.values[k])


def subtract_background(data, *, mask=None, weight=None, mesh=64, filter_size=3, overwrite=False):
    """Subtract a smooth background from an image and map its noise.

    Parameters
    ----------
    data : (ny, nx) array_like
        Image of any real type, byte order and unit.
    mask : (ny, nx) array_like of bool, optional
        True where a pixel must not be used.  NaN and infinite pixels, and pixels far below the
        background, are not used in any case.
    weight : (ny, nx) array_like, optional
        Inverse variance of the background on any scale.  Pixels whose weight is not positive are
        not used.
    mesh : int, optional
        Approximate size in px of the cells in which the background is estimated, at least 4.  Cells
        of equal size fill the image.
    filter_size : int, optional
        Size in cells of the median filter over the cells.
    overwrite : bool, optional
        Whether the memory of `data` may be used for the result.

    Returns
    -------
    Background
        Image, noise and mask.

    Raises
    ------
    TypeError
        If the image is not of a real number type.
    ValueError
        If the image is not two-dimensional or smaller than 8 x 8 px, if the mask or the weight has
        another shape, or if ``mesh`` or ``filter_size`` is too small.
    DetectionError
        If the image has no finite pixels, or no noise.

    Notes
    -----
    The background is the mode of each cell after clipping (Bertin & Arnouts 1996, A&AS 117, 393),
    smoothed by a median filter and interpolated by bicubic splines.  Pixels that are equal to most
    other pixels of their cell (padding, dead regions) are masked.  The raw mosaic of a color camera
    is recognized by its pattern of 2 x 2 px.  Each of its four planes has its own background, and
    they are scaled to the same response to stars.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.detection import subtract_background
    >>> background = subtract_background(np.random.default_rng(1).normal(1000, 5, (256, 256)))
    >>> round(background.level), round(background.noise)
    (1000, 5)
    """
    data = np.asanyarray(data)
    if data.dtype.kind not in "iuf":
        raise TypeError(f"the image must hold real numbers, got dtype {data.dtype}")
    if data.ndim != 2 or min(data.shape) < 8:
        raise ValueError(f"the image must be 2-D and at least 8 x 8 px, got shape {data.shape}")
    if mesh < 4 or filter_size < 1:
        raise ValueError(f"mesh must be >= 4 and filter_size >= 1, got {mesh}, {filter_size}")
    # Most images have no blank pixels: their extremes show this without a mask of the whole image.
    extremes = np.array([data.min(), data.max()], dtype=float)
    blank = None if np.isfinite(extremes).all() else ~np.isfinite(data)
    bad = blank
    for name, given in (("mask", mask), ("weight", weight)):
        if given is None:
            continue
        given = np.asarray(given)
        if given.shape != data.shape:
            raise ValueError(f"{name} has shape {given.shape}, the image {data.shape}")
        out = given.astype(bool) if name == "mask" else ~(given > 0)
        bad = out if bad is None else bad | out
    if bad is not None and not bad.any():
        bad = None
    pedestal, scale = _level_and_scatter(data, bad)
    if not np.abs(extremes - pedestal).max() < _BLANK * scale:
        # Two comparisons, because differences of integers could overflow.
        blank = ~((data > pedestal - _BLANK * scale) & (data < pedestal + _BLANK * scale))
        bad = blank if bad is None else bad | blank
    # A power of two, so that nothing is rounded.
    unit = 1.0 if _PLAIN[0] < scale < _PLAIN[1] else 2.0 ** np.round(np.log2(scale))
    period = 2 if has_pattern(data, bad, scale) else 1
    bright = _bright_pixels(data, pedestal + _BRIGHT * scale)
    image = _in_units(data, pedestal, unit, overwrite=overwrite)
    # If there is no other reference to it, its memory becomes free.
    del data
    if blank is not None:
        image[blank] = 0
    relative = None if weight is None else _relative_noise(np.asarray(weight), bad)
    planes = plane_slices(period)
    rms = np.empty(image.shape, dtype=np.float32) if period > 1 else None
    level = []
    for plane in planes:
        part = np.ascontiguousarray(image[plane])
        hidden = None if bad is None else np.ascontiguousarray(bad[plane])
        cells = max(4, mesh // period), filter_size, scale / unit
        levels, hidden = measure_levels(part, hidden, *cells)
        if hidden is not None:
            bad = np.zeros(image.shape, bool) if bad is None else bad
            bad[plane] = hidden
        levels.subtract(part)
        level.append(np.median(levels.level))
        if relative is not None:
            levels, _ = measure_levels(part / relative[plane], hidden, *cells)
        noise = levels.noise()
        if relative is not None:
            noise *= relative[plane]
        if period == 1:
            image, rms = part, noise
        else:
            image[plane], rms[plane] = part, noise
    if bad is not None:
        image[bad] = 0
    photons = None if relative is None else _relative_photons(relative)
    if period > 1:
        photons = np.ones(image.shape, np.float32) if photons is None else photons
        for plane, response in zip(planes, star_responses(image, rms, bad), strict=True):
            image[plane] /= response
            rms[plane] /= response
            photons[plane] /= response
    level = pedestal + float(np.mean(level)) * unit
    return _finished(Background(image, rms, bad, level, bright, unit, photons))


def _bright_pixels(data, limit):
    """Pixels above a limit, including masked ones."""
    indices, values = [], []
    strips = row_strips(data.shape)
    work = np.empty((strips[0].stop, data.shape[1]), bool)
    for rows in strips:
        part = data[rows]
        high = np.flatnonzero(np.greater(part, limit, out=work[: len(part)]))
        indices.append(high + rows.start * data.shape[1])
        values.append(part.reshape(-1)[high])
    return BrightPixels(np.concatenate(indices), np.concatenate(values))


def _finished(background):
    """Mask the pixels far below the sky."""
    image, rms, bad = background.image, background.rms, background.mask
    noise = np.sqrt(np.median(rms[:: max(1, len(rms) // 500)] ** 2))
    if not (np.isfinite(noise) and noise > 0):
        raise DetectionError(
            f"the image is flat: all pixels near {background.level:g}, no noise, no stars"
        )
    # Most images have no such pixels, as their extremes show.
    if not image.min() < -_COLD * rms.min():
        return background
    bad = np.zeros(image.shape, bool) if bad is None else bad.copy()
    for rows in row_strips(image.shape):
        bad[rows] |= image[rows] < -_COLD * rms[rows]
        image[rows][bad[rows]] = 0
    return replace(background, mask=bad)


def _level_and_scatter(data, bad):
    """Median of an image and the scatter about it, from which its unit is chosen."""
    stride = max(1, min(data.shape) // 500)
    sample = data[::stride, ::stride]
    if bad is not None:
        sample = sample[~bad[::stride, ::stride]]
        sample = data[~bad] if sample.size == 0 else sample
    if sample.size == 0:
        raise DetectionError("the image has no finite, unmasked pixel")
    sample = sample.astype(float).ravel()
    pedestal = float(np.median(sample))
    scatter = robust_scatter(sample)
    if not scatter > 0:
        # Padding, or counts of few photons: only the other pixels show the scale.
        other = np.abs(sample[sample != pedestal] - pedestal)
        scatter = float(np.median(other)) if other.size else 0.0
    if not scatter > 0:
        raise DetectionError(f"the image is flat: all pixels near {pedestal:g}, no noise, no stars")
    return pedestal, scatter


def _in_units(data, pedestal, unit, *, overwrite):
    """Difference from a first level, so that float32 keeps the noise on a high pedestal."""
    here = overwrite and data.dtype == np.float32 and data.flags.carray
    image = data if here else np.empty(data.shape, dtype=np.float32)
    strips = row_strips(data.shape)
    work = np.empty((strips[0].stop, data.shape[1]))
    with np.errstate(over="ignore", invalid="ignore"):
        for rows in strips:
            part = work[: rows.stop - rows.start]
            part[:] = data[rows]
            part -= pedestal
            part /= unit
            image[rows] = part
    return image


def _relative_photons(relative):
    """Relative variance of photons, if the relative noise of the sky shows different responses.

    With the response s, the variance of photons is proportional to 1/s.  That of the sky is
    proportional to 1/s if it comes from photons, and to 1/s^2 if it comes from the readout, so a
    value between the two is used.  The gain is that of the best pixels.
    """
    step = max(1, min(relative.shape) // 500)
    best = np.percentile(relative[::step, ::step], 5)
    return (relative / best) ** 1.5


def _relative_noise(weight, bad):
    """Noise of the sky from a weight map, relative to its median over the image."""
    variance = np.full(weight.shape, np.nan, dtype=np.float32)
    good = np.isfinite(weight) & (weight > 0)
    if bad is not None:
        good &= ~bad
    middle = np.median(weight[good].astype(float))
    variance[good] = middle / weight[good]
    ny, nx = (-n % _WEIGHT_CELL for n in weight.shape)
    cells = np.pad(variance, ((0, ny), (0, nx)), constant_values=np.nan)
    rows, columns = (n // _WEIGHT_CELL for n in cells.shape)
    cells = cells.reshape(rows, _WEIGHT_CELL, columns, _WEIGHT_CELL).swapaxes(1, 2)
    cells = cells.reshape(rows, columns, -1)
    empty = np.isnan(cells).all(axis=2)
    cells[empty] = 1
    noise = np.sqrt(np.nanmedian(cells, axis=2))
    noise = np.repeat(np.repeat(noise, _WEIGHT_CELL, axis=0), _WEIGHT_CELL, axis=1)
    return noise[: weight.shape[0], : weight.shape[1]]
