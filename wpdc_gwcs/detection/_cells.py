"""The level of the sky and its scatter in cells of an image, from clipped histograms."""

import numpy as np

from wpdc_gwcs import kernels

__all__ = ["measure_cells"]

# Sample of the pixels of a cell that sets the range of its histogram: this many by this many.
_SAMPLED = 10

# Steps of the histogram per median deviation of the sample: 16 per standard deviation of the sky,
# so that the 256 steps reach 8 standard deviations on each side.
_RATE = 10.8

# Pixels farther from the median than this, in standard deviations, are not sky.
_CLIP = 3.0
_MAX_CLIPS = 50

# Minimum fraction of different values for a sky of few photons, where most pixels have none.  With
# fewer, the cell is constant with outliers.
_MIN_OTHER = 0.01

# Largest difference between mean and median, in standard deviations, for which the relation between
# mean, median and mode is valid, as for a sky with few stars.
_MAX_SKEW = 0.3


def measure_cells(image, mask, rows, columns, scale):
    """Measure the level of the sky and its scatter in cells.

    Parameters
    ----------
    image : (ny, nx) float32 ndarray
        The image, C-contiguous.
    mask : (ny, nx) bool ndarray or None
        True for pixels that are not used.
    rows, columns : (M + 1,), (N + 1,) ndarray of int
        First rows and columns of the cells, followed by the row and column after the last cell.
    scale : float
        Scatter of the image, which is used for cells in which most pixels are equal.

    Returns
    -------
    level, scatter : (M * N,) ndarray
        Mode and standard deviation of the pixels after clipping.
    number : (M * N,) ndarray
        Number of pixels within the range of the histogram.
    mean, deviation : (M * N,) ndarray
        Mean and standard deviation of these pixels before clipping; the deviation is 0 if the
        clipping removes only outliers.
    """
    middle, spread = _sampled(image, mask, rows, columns)
    spread[~(spread > 0)] = scale
    rate = (_RATE / spread).astype(np.float32)
    # The median is at the center of a step, so that integer values are even about the centers.
    low = (middle - (kernels.N_STEPS / 2 + 0.5) / _RATE * spread).astype(np.float32)
    counts = np.empty((len(low), kernels.N_STEPS), np.intc)
    kernels.count_levels(image, mask, rows.astype(float), columns.astype(float), low, rate, counts)
    level, scatter, number, mean, deviation = _clip(counts)
    # The values of a step are about its center.
    level, mean = (low + (step + 0.5) / rate for step in (level, mean))
    return level, scatter / rate, number, mean, deviation / rate


def _sampled(image, mask, rows, columns):
    """Median of some pixels of every cell, and of their deviations."""
    y, x = (
        edges[:-1, None] + (np.arange(_SAMPLED) * 2 + 1) * np.diff(edges)[:, None] // (2 * _SAMPLED)
        for edges in (rows, columns)
    )
    pixels = np.s_[y[:, None, :, None], x[None, :, None, :]]
    sample = image[pixels].reshape(-1, _SAMPLED**2)
    if mask is not None:
        sample[mask[pixels].reshape(sample.shape)] = np.nan
    middle = _sorted_median(sample)
    return middle, _sorted_median(np.abs(sample - middle[:, None]))


def _sorted_median(sample):
    """Median of every row without NaN; 0 for a row of NaN only."""
    ordered = np.sort(sample, axis=1)
    number = np.isfinite(ordered).sum(axis=1)
    row = np.arange(len(ordered))
    middle = (ordered[row, np.maximum(number - 1, 0) // 2] + ordered[row, number // 2]) / 2
    return np.where(number > 0, middle, 0)


def _clip(counts):
    """Return the results of `measure_cells` from histograms, in steps."""
    n_cells, n_steps = counts.shape
    step, row = np.arange(n_steps), np.arange(n_cells)
    below = np.zeros((3, n_cells, n_steps + 1), np.int64)
    for power in range(3):
        np.cumsum(counts * step**power, axis=1, out=below[power, :, 1:])
    median_between = _medians(below[0])
    first, last = np.zeros(n_cells, int), np.full(n_cells, n_steps)
    of_all = None
    for _ in range(_MAX_CLIPS):
        n, by_one, by_two = below[:, row, last] - below[:, row, first]
        n = np.maximum(n, 1)
        mean = by_one / n
        sigma = np.sqrt(np.maximum(by_two / n - mean**2, 0))
        median = median_between(first, last)
        of_all = of_all or (n, mean, sigma)
        before = first, last
        first = np.clip(np.ceil(median - _CLIP * sigma), 0, n_steps - 1).astype(int)
        last = np.clip(np.floor(median + _CLIP * sigma) + 1, first + 1, n_steps).astype(int)
        if np.array_equal(before, (first, last)):
            break
    skewed = np.abs(mean - median) > _MAX_SKEW * sigma
    level = np.where(skewed, median, 2.5 * median - 1.5 * mean)
    n_all, mean_of_all, sigma_of_all = of_all
    sigma_of_all[n_all - n < _MIN_OTHER * n_all] = 0
    return level, sigma, below[0, :, -1], mean_of_all, sigma_of_all


def _medians(number):
    """Return a function for medians between two steps, from the numbers of pixels below each step.

    Integer values, as in raw frames, fill only one of several steps.  The pixels in a step are
    assumed to be spread over the space between the filled steps; otherwise, the median would be off
    by up to half a unit.
    """
    n_cells, n_edges = number.shape
    row = np.arange(n_cells)
    # Joined with shifts, the numbers of all cells ascend, so one search serves all of them.
    shift = (number[:, -1].max() + 1) * row
    ascending = (number + shift[:, None]).ravel()

    def find(value, side):
        return np.searchsorted(ascending, value + shift, side) - n_edges * row

    def median_between(first, last):
        half = (number[row, first] + number[row, last]) / 2
        step = np.clip(find(half, "left") - 1, 0, n_edges - 2)
        low, high = number[row, step], number[row, step + 1]
        # The nearer filled step; it is the next one if the values are not integers.
        before, after = find(low, "left") - 1, find(high, "right") - 1
        below = np.where(before < 0, n_edges, step - before)
        above = np.where(after >= n_edges - 1, n_edges, after - step)
        room = np.minimum(below, above)
        room[room == n_edges] = 1
        return step + room * ((half - low) / np.maximum(high - low, 1) - 0.5)

    return median_between
