"""Images without their background, and their noise."""

from dataclasses import dataclass, replace

import numpy as np

from wpdc_gwcs.detection._levels import measure_levels
from wpdc_gwcs.detection._mosaic import has_pattern, plane_slices, star_responses
from wpdc_gwcs.detection._strips import row_strips
from wpdc_gwcs.exceptions import DetectionError
from wpdc_gwcs.robust import robust_scatter

__all__ = ["Background", "subtract_background"]

# Values further from the level than this, in standard deviations, are blanks of some kind; sums of
# their squares would overflow float32.
_BLANK = 1e10

# Noise in counts for which counts are the unit: far from what the squares of float32 can hold.
_PLAIN = (1e-3, 1e6)

# Pixels this many standard deviations below the background are dead: nothing on the sky is dark.
_COLD = 10.0

# Cells in px within which a weight map tells the noise of the sky: the median over them does not
# see the photons of stars, which many maps of variances hold and which the gain brings.
_WEIGHT_CELL = 16

# Pixels that may be saturated, in scatters of all pixels above their median: no sky reaches there.
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
        Median of the background that was taken off, in counts.
    bright : BrightPixels
        The bright pixels as they came in.
    unit : float, optional
        Counts in one unit of `image` and `rms`: 1 but for images whose noise is so small or great
        in counts that squares of float32 would not hold it.
    photons : (ny, nx) float32 ndarray or None, optional
        Variance of the photons of a star relative to that by the gain, if pixels differ in response
        or exposure, which is known from a weight map or the filters of a mosaic; None otherwise.

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
        """Copy the pixels of the image and the mask, which may then be changed.

        Returns
        -------
        Background
            Copy.
        """
        mask = None if self.mask is None else self.mask.copy()
        return replace(self, image=self.image.copy(), mask=mask)

    def rows(self, start, stop):
        """Take some rows: views of these, no copies.

        Parameters
        ----------
        start, stop : int
            The first row, and the one behind the last.

        Returns
        -------
        Background
            The rows.
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
        """Find the pixels that are saturated.

        Parameters
        ----------
        level : float
            Counts, background included, from which a pixel is.

        Returns
        -------
        (ny, nx) ndarray of bool
            True for those that are; pixels hardly above the background never are.
        """
        full = np.zeros(self.image.shape, bool)
        high = self.bright.values >= level
        full.reshape(-1)[self.bright.indices[high]] = True
        return full


@dataclass(frozen=True, eq=False)
class BrightPixels:
    """The bright pixels of an image, background included, which may be saturated.

    Parameters
    ----------
    indices : (N,) ndarray of int
        Their indices in the flat image, ascending.
    values : (N,) ndarray
        Their counts.
    """

    indices: np.ndarray
    values: np.ndarray

    def between(self, start, stop):
        """Take those of a part of the flat image.

        Parameters
        ----------
        start, stop : int
            The first place, and the one behind the last.

        Returns
        -------
        BrightPixels
            With places in that part.
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
        True where a pixel must not be used.  NaN and infinite pixels never are, nor those far
        below the background.
    weight : (ny, nx) array_like, optional
        Inverse variance of the background, of any scale; pixels whose weight is not positive are
        not used.
    mesh : int, optional
        Size in px, about, of the cells within which the background is estimated: cells of equal
        sizes fill the image.
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
        If the image is not two-dimensional, or the mask or the weight has another shape.
    DetectionError
        If the image has no finite pixels, or no noise.

    Notes
    -----
    The background is the mode of every cell after clipping (Bertin & Arnouts 1996, A&AS 117, 393),
    median filtered and interpolated by bicubic splines.  Pixels that are equal to most others of
    their cell (padding, dead regions) are masked.  The raw mosaic of a color camera is recognized
    by a pattern of 2 x 2 px.  It has a background for each of the four planes, which are scaled to
    the same response to stars.

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
    # Most images are whole, which their extremes tell without an array of their own.
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
        # Compared apart: differences of integers could overflow.
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
    """Pixels above a limit, masked ones too."""
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
    """Mask what lies far below the sky."""
    image, rms, bad = background.image, background.rms, background.mask
    noise = np.sqrt(np.median(rms[:: max(1, len(rms) // 500)] ** 2))
    if not (np.isfinite(noise) and noise > 0):
        raise DetectionError(
            f"the image is flat: all pixels near {background.level:g}, no noise, no stars"
        )
    # Most images have no such pixels, which their extremes tell.
    if not image.min() < -_COLD * rms.min():
        return background
    bad = np.zeros(image.shape, bool) if bad is None else bad.copy()
    for rows in row_strips(image.shape):
        bad[rows] |= image[rows] < -_COLD * rms[rows]
        image[rows][bad[rows]] = 0
    return replace(background, mask=bad)


def _level_and_scatter(data, bad):
    """Median of an image, and the scatter about it: what its unit is chosen by."""
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
        # Padding, or counts of few photons: what differs tells the scale.
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
    """Variance of photons where pixels differ in response or exposure by this noise of the sky.

    With response s it goes as 1/s, that of the sky as 1/s if its own photons make it, as 1/s^2 if
    the readout does: between the two.  The gain is that of the best pixels.
    """
    step = max(1, min(relative.shape) // 500)
    best = np.percentile(relative[::step, ::step], 5)
    return (relative / best) ** 1.5


def _relative_noise(weight, bad):
    """Noise of the sky by a weight map, relative to its median over the image."""
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
