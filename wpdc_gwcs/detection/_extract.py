"""Peaks of an image, and the size of its stars."""

import numpy as np
import sep

from wpdc_gwcs.cutouts import cut_squares
from wpdc_gwcs.detection._shapes import SIGMA_PER_FWHM, mode, sizes, window
from wpdc_gwcs.detection._strips import high_pixels
from wpdc_gwcs.detection._windows import CELL, find_windows, high_cells

__all__ = ["extract_peaks", "is_broad", "search", "star_size", "typical_fwhm"]

# Smoothing before the threshold: close to a matched filter for FWHM 1.5 to 3 px, and narrow enough
# not to merge neighbors.
_LINE = np.array([1.0, 2.0, 1.0]) / 4

# Stars with a larger FWHM (px) would be split with this kernel, because noise causes separate peaks
# on rings and trails.
_BROAD = 4.5

# Number of rows in a strip, and their overlap: every source comes whole from the strip with its
# peak.
_STRIP = 1024
_OVERLAP = 64

# Number of pixels for which sep has room in addition to those of sources, in a strip and in a
# window, and the fraction of pixels that noise alone may lift above the threshold.
_ROOM, _ROOM_IN_WINDOW = 300_000, 1000
_BY_CHANCE = 0.03
# One of this many rows is used to estimate the number of pixels in sources.
_SAMPLED = 4
# Maximum number of branches of a source in sep.
_BRANCHES = 8192

# Fraction of bright cells above which windows around them save no time.
_CROWDED = 0.15

# Number of sources from which the size of the stars is measured.
_N_BRIGHT = 500


def extract_peaks(background, threshold, deblend_contrast, fwhm=0.0):
    """Extract peaks with sep.

    Parameters
    ----------
    background : Background
        Image without background.
    threshold : float
        Smallest significance of a peak.
    deblend_contrast : float
        Smallest fraction of the flux for a separate peak within a larger source.
    fwhm : float, optional
        FWHM of the stars, px; for broad stars, the filter is equally broad.

    Returns
    -------
    structured array
        The result of `sep.extract`.
    """
    parts = []
    for start, _, found in search(background, threshold, deblend_contrast, fwhm):
        _shift(found, 0, start)
        parts.append(found)
    return np.concatenate(parts)


def search(background, threshold, deblend_contrast, fwhm=0.0, *, sparse=False):
    """Extract peaks strip by strip, because sep compares every source with every other one.

    Parameters
    ----------
    background : Background
        Image without background, or an object that provides its rows.
    threshold, deblend_contrast, fwhm
        As for `extract_peaks`.
    sparse : bool, optional
        Whether most of the image is expected to have no peaks, so that sep gets only windows around
        bright pixels.

    Yields
    ------
    start : int
        First row of the strip.
    strip : Background
        The strip, including its overlap with others.
    found : structured array
        Peaks as from `sep.extract`, in pixels of the strip.
    """
    line = _line(fwhm)
    options = {
        "thresh": threshold * (line**2).sum(),
        "filter_kernel": np.outer(line, line),
        "deblend_cont": deblend_contrast,
    }
    overlap = max(_OVERLAP, int(3 * fwhm))
    n_rows = background.shape[0]
    for first in range(0, n_rows, _STRIP):
        last = min(first + _STRIP, n_rows)
        start = max(first - overlap, 0)
        strip = background.rows(start, min(last + overlap, n_rows))
        cells = None
        if sparse:
            cells = high_cells(strip.image, strip.rms, strip.mask, line, options["thresh"])
            if not cells.any():
                continue
        if cells is None or cells.mean() > _CROWDED:
            found = _extract(strip, options)
        else:
            found = _extract_in_windows(strip, cells, options)
        row = found["ycpeak"] + start
        yield start, strip, found[(row >= first) & (row < last)]


def _extract(strip, options):
    """Extract the peaks of a strip."""
    # Room for all pixels of all sources, and no more, because sep writes to all of it every time.
    high = high_pixels(strip.image[::_SAMPLED], strip.rms[::_SAMPLED], options["thresh"])
    active = _SAMPLED * sum(np.count_nonzero(part) for _, part in high)
    active -= int(_BY_CHANCE * strip.image.size)
    room = min(_ROOM + 3 * max(active, 0), _ROOM + strip.image.size)
    return _call_sep(strip.image, strip.rms, strip.mask, room, options)


def _extract_in_windows(strip, cells, options):
    """Extract the peaks of each window of a strip around its bright cells.

    A source does not reach beyond these cells, so it has the same pixels in a window.
    """
    margin = len(options["filter_kernel"]) // 2 + 1
    places, labels = find_windows(cells, strip.shape, margin)
    planes, parts = (strip.image, strip.rms, strip.mask), []
    for place in places:
        image, rms, mask = (
            None if plane is None else np.ascontiguousarray(plane[place]) for plane in planes
        )
        parts.append(_call_sep(image, rms, mask, _ROOM_IN_WINDOW + image.size, options))
    found = np.concatenate(parts)
    corners = np.array([[columns.start, rows.start] for rows, columns in places])
    number = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    _shift(found, *corners[number].T)
    # If windows overlap, each source is taken from its own window.
    return found[labels[found["ycpeak"] // CELL, found["xcpeak"] // CELL] == number + 1]


def _call_sep(image, rms, mask, room, options):
    """Extract the peaks of an image, with room for a given number of pixels in sources."""
    before = sep.get_extract_pixstack(), sep.get_sub_object_limit()
    sep.set_extract_pixstack(room)
    # The default of sep is for small images, and it fails with more active branches.
    sep.set_sub_object_limit(_BRANCHES)
    try:
        return sep.extract(image, err=rms, mask=mask, minarea=3, filter_type="conv", **options)
    finally:
        # Other code may use sep, too.
        sep.set_extract_pixstack(before[0])
        sep.set_sub_object_limit(before[1])


def _shift(found, dx, dy):
    """Move peaks, in place."""
    for axis, step in (("x", dx), ("y", dy)):
        for name in (axis, f"{axis}peak", f"{axis}cpeak", f"{axis}min", f"{axis}max"):
            found[name] += step


def is_broad(fwhm):
    """Return whether stars of this FWHM need a broader filter.

    Parameters
    ----------
    fwhm : float
        FWHM of the stars, px.

    Returns
    -------
    bool
        True for 4.5 px or more.
    """
    return fwhm > _BROAD


def _line(fwhm):
    """Filter along one axis, of unit sum, for stars of this FWHM."""
    if not is_broad(fwhm):
        return _LINE
    sigma = fwhm * SIGMA_PER_FWHM
    step = np.arange(-int(2 * sigma), int(2 * sigma) + 1)
    line = np.exp(-0.5 * (step / sigma) ** 2)
    return line / line.sum()


def typical_fwhm(background, found):
    """Find the FWHM of the stars from the brightest sources that are not saturated.

    Parameters
    ----------
    background : Background
        Image without background.
    found : structured array
        Peaks as from `extract_peaks`.

    Returns
    -------
    float
        FWHM, px.
    """
    good = (found["npix"] >= 5) & (found["peak"] < 0.7 * found["peak"].max())
    rows = np.flatnonzero(good if good.sum() >= 5 else np.ones(len(found), bool))
    rows = rows[np.argsort(found["cpeak"][rows])[::-1][:_N_BRIGHT]]
    size = star_size(background.image, found["x"][rows], found["y"][rows])
    if size is None:
        # Only noise, or sources broader than any window: use the isophotal size.
        size = [2.35 * float(np.median(np.sqrt(found["a"][rows] * found["b"][rows])))]
    return float(np.clip(size[0], 1.0, 0.1 * min(background.image.shape)))


def star_size(image, x, y):
    """Find the most frequent size of sources.

    Parameters
    ----------
    image : (ny, nx) ndarray
        Image without background.
    x, y : (N,) ndarray
        Positions of the sources, px.

    Returns
    -------
    (float, float) or None
        FWHM of a round star of the same size, and FWHM along the minor axis, px; None if no source
        has a size.
    """
    xc, yc = np.rint(x).astype(int), np.rint(y).astype(int)
    fwhm = sharpest = 2.0
    for _ in range(4):
        sigma = fwhm * SIGMA_PER_FWHM
        half = int(np.ceil(3 * sigma)) + 1
        pixels = cut_squares(image, xc, yc, half)
        major, minor = sizes(pixels, *window(x, y, xc, yc, half, sigma), sigma)
        size = np.hypot(major, minor) / np.sqrt(2)
        known = np.isfinite(size) & (size > 0)
        if not known.any():
            return None
        fwhm = float(np.clip(mode(size[known])[0] / SIGMA_PER_FWHM, 0.75 * fwhm, 2 * fwhm))
        sharpest = mode(minor[known])[0] / SIGMA_PER_FWHM
    return fwhm, sharpest
