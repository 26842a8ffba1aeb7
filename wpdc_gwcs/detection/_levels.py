"""The level of the sky and its scatter, in the cells of an image and as smooth maps."""

from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.ndimage import binary_opening, distance_transform_edt, median_filter

from wpdc_gwcs import kernels
from wpdc_gwcs.detection._cells import measure_cells
from wpdc_gwcs.threads import map_threads

__all__ = ["Levels", "measure_levels"]

# Minimum fraction of usable pixels, relative to that of the best cell, for a cell to have its own
# level.
_MIN_SHARE = 0.5

# Scatter of a cell, and difference from its level, in units of the typical scatter, below which its
# pixels are equal.
_EQUAL = 0.01

# Constants this many standard deviations above the sky may be those of a saturated star.
_HIGH = 5.0

# Maximum number of different constants of padding and dead regions.
_MAX_CONSTANTS = 4

# Number of rows of cells, and of pixels, that are processed at a time.
_CELL_ROWS = 8
_PIXEL_ROWS = 256


@dataclass(frozen=True, eq=False)
class Levels:
    """The level of the sky and its scatter in the cells of an image.

    Parameters
    ----------
    rows, columns : (M + 1,), (N + 1,) ndarray of int
        First rows and columns of the cells, followed by the row and column after the last cell.
    level : (M, N) ndarray
        Level of the sky.
    scatter : (M, N) ndarray
        Standard deviation of the sky.
    """

    rows: np.ndarray
    columns: np.ndarray
    level: np.ndarray
    scatter: np.ndarray

    def subtract(self, image):
        """Subtract the level of the sky, interpolated by bicubic splines, from an image.

        Parameters
        ----------
        image : (ny, nx) float32 ndarray
            The image, changed in place.
        """
        spline = partial(CubicSpline, bc_type="natural")
        _put(spline, self.rows, self.columns, self.level, image, beyond=True, subtract=True)

    def noise(self):
        """Map the standard deviation of the sky, interpolated by monotone cubics without overshoot.

        Returns
        -------
        (ny, nx) float32 ndarray
            Standard deviation in each pixel.
        """
        rms = np.empty((self.rows[-1], self.columns[-1]), np.float32)
        # The scatter is constant beyond the outermost centers, where cubics would overshoot.
        kind = PchipInterpolator
        _put(kind, self.rows, self.columns, self.scatter, rms, beyond=False, subtract=False)
        return rms


def measure_levels(image, mask, mesh, filter_size, scale):
    """Measure the level of the sky and its scatter in the cells of an image.

    Parameters
    ----------
    image : (ny, nx) float32 ndarray
        The image, C-contiguous.
    mask : (ny, nx) bool ndarray or None
        True for pixels that are not used.
    mesh : int
        Approximate size of the cells in px; cells of equal size fill the image.
    filter_size : int
        Size in cells of the median filter over the cells.
    scale : float
        Scatter of the image, which is used for cells in which most pixels are equal.

    Returns
    -------
    levels : Levels
        The levels.
    mask : (ny, nx) bool ndarray or None
        True for pixels that were not used: the given ones, and those of padding and dead regions,
        which are equal to most other pixels of their cells.

    Notes
    -----
    The pixels of each cell are clipped about their median until none is farther away than three
    standard deviations.  The level is the mode, estimated as 2.5 times the median minus 1.5 times
    the mean, or the median if the two differ by more than 0.3 standard deviations (Bertin & Arnouts
    1996, A&AS 117, 393).  The standard deviation is that after clipping.  For normal noise it is
    1.6 % too low, and for a sky with faint stars it includes their light.
    """
    rows, columns = (_edges(size, mesh) for size in image.shape)
    for _ in range(_MAX_CONSTANTS):
        level, scatter, constant = _measure(image, mask, rows, columns, scale)
        if not np.isfinite(constant).any():
            break
        # Cells with fewer pixels of this constant may also have sky.
        tolerance = _EQUAL * np.median(scatter)
        equal = _equal_pixels(image, rows, columns, constant, tolerance)
        mask = equal if mask is None else mask | equal
    level, scatter = (_filtered(values, filter_size) for values in (level, scatter))
    return Levels(rows, columns, level, scatter), mask


def _measure(image, mask, rows, columns, scale):
    """Level and scatter of cells, and constants.

    Cells without their own level and scatter get those of the nearest cell.  Constants are the
    values of cells in which most pixels are equal; NaN for other cells.
    """
    shape = (len(rows) - 1, len(columns) - 1)

    def measure(first):
        return measure_cells(image, mask, rows[first : first + _CELL_ROWS + 1], columns, scale)

    parts = map_threads(measure, range(0, shape[0], _CELL_ROWS))
    level, scatter, number, mean, deviation = (
        np.concatenate(p).reshape(shape) for p in zip(*parts, strict=True)
    )
    # If most pixels are equal in most cells, there are few photons; in single cells, it is padding.
    few = (scatter == 0) & (deviation > 0)
    if few.mean() > 0.5:
        level, scatter = np.where(few, mean, level), np.where(few, deviation, scatter)
    share = number / np.outer(np.diff(rows), np.diff(columns))
    unknown = share < _MIN_SHARE * share.max()
    noisy = scatter[~unknown & (scatter > 0)]
    equal = ~unknown & (scatter < _EQUAL * (np.median(noisy) if noisy.size else 0.0))
    constant = np.where(equal, level, np.nan)
    unknown |= equal
    if unknown.any():
        nearest = distance_transform_edt(unknown, return_distances=False, return_indices=True)
        level, scatter = level[tuple(nearest)], scatter[tuple(nearest)]
    # Padding is larger than the center of a saturated star.
    high = constant > level + _HIGH * scatter
    constant[high & ~binary_opening(high, np.ones((2, 2)))] = np.nan
    return level, scatter, constant


def _equal_pixels(image, rows, columns, constant, tolerance):
    """Mark the pixels with the constant of their cell, or of the nearest adjacent cell."""
    distance, nearest = distance_transform_edt(np.isnan(constant), return_indices=True)
    constant = np.where(distance < 2, constant[tuple(nearest)], np.nan).astype(np.float32)
    equal = np.zeros(image.shape, bool)
    for j in np.flatnonzero(np.isfinite(constant).any(axis=1)):
        part = slice(rows[j], rows[j + 1])
        equal[part] = np.abs(image[part] - np.repeat(constant[j], np.diff(columns))) < tolerance
    return equal


def _filtered(values, size):
    """Values in cells after a median filter, which preserves slopes, even at the edges."""
    margin = [(min(size // 2, n - 1),) * 2 for n in values.shape]
    padded = np.pad(values, margin, mode="reflect", reflect_type="odd")
    inner = tuple(
        slice(width, width + n) for (width, _), n in zip(margin, values.shape, strict=True)
    )
    return median_filter(padded, size, mode="nearest")[inner]


def _edges(size, mesh):
    """First pixels of cells of nearly equal sizes, and the pixel after the last cell."""
    n_cells = max(1, round(size / mesh))
    return np.arange(n_cells + 1) * size // n_cells


def _put(kind, rows, columns, values, image, *, beyond, subtract):
    """Interpolate values in cells along both axes; write them into an image or subtract them."""
    y, x = _middles(rows), _middles(columns)
    place_y, place_x = (
        np.arange(n) if beyond else np.clip(np.arange(n), *np.clip(v[[0, -1]], 0, n - 1))
        for n, v in zip(image.shape, (y, x), strict=True)
    )
    along_y = kind(y, _repeated(values, len(y)))
    # Each piece reaches from the center of a cell to the next center; the outer ones to the edges.
    starts = np.ceil(x[:-1])
    starts[0] = 0
    edges = np.append(starts, columns[-1]).astype(float)
    piece = np.repeat(np.arange(len(starts)), np.diff(edges).astype(int))
    offset = (place_x - x[piece]).astype(np.float32)

    def put(first):
        part = slice(first, first + _PIXEL_ROWS)
        along_x = kind(x, _repeated(along_y(place_y[part]).T, len(x)))
        coefficients = np.ascontiguousarray(along_x.c.transpose(2, 1, 0), dtype=np.float32)
        kernels.put_cubics(coefficients, edges, offset, subtract, image[part])

    map_threads(put, range(0, len(image), _PIXEL_ROWS))


def _middles(edges):
    """Centers of cells, at least two: for a single cell, another one after it."""
    middles = (edges[1:] + edges[:-1] - 1) / 2
    return middles if len(middles) > 1 else np.append(middles, edges[-1] + 1.0)


def _repeated(values, number):
    """Values for a given number of places: unchanged, or one value repeated."""
    return np.broadcast_to(values, (number, *values.shape[1:]))
