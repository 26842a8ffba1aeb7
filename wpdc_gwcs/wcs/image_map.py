"""Sky coordinates of all pixels of an image, band by band."""

import math
import os

import numpy as np

from wpdc_gwcs.models import DetectorToSky
from wpdc_gwcs.models.blocks import run_blocks

__all__ = ["sky_map"]


def sky_map(wcs, *, image_shape=None, out=None):
    """Compute the sky coordinates of every pixel of an image, block by block.

    Parameters
    ----------
    wcs : `gwcs.WCS`
        The WCS, from pixels to two world coordinates.
    image_shape : (int, int), optional
        Shape of the image, (ny, nx); that of the WCS by default.
    out : array_like or path, optional
        Where to write: an array (or memory map) of the shape (2, ny, nx), a pair of (ny, nx)
        arrays, or the path of a new ``.npy`` file of the shape (2, ny, nx), which is memory-mapped.

    Returns
    -------
    ra, dec : (ny, nx) ndarray
        Coordinates of the pixel centers in degrees; views of ``out`` if it is given.

    Raises
    ------
    ValueError
        If the shape of the image is not known, or that of ``out`` does not fit.
    FileExistsError
        If ``out`` is the path of an existing file.

    Notes
    -----
    In addition to the outputs, it needs a few megabytes, for images of any size.

    Examples
    --------
    >>> from wpdc_gwcs.wcs import build_wcs, sky_map
    >>> cd = [[-1e-4, 0], [0, 1e-4]]
    >>> wcs = build_wcs(crpix=(2, 1), cd=cd, crval=(10, 20), image_shape=(3, 5))
    >>> ra, dec = sky_map(wcs)
    >>> ra.shape, float(ra[1, 2]), float(dec[1, 2])
    ((3, 5), 10.0, 20.0)
    """
    if image_shape is None:
        image_shape = wcs.array_shape
        if image_shape is None:
            raise ValueError("image_shape must be given: the WCS does not know its shape")
    ny, nx = (int(n) for n in image_shape)
    if isinstance(out, (str, os.PathLike)):
        if os.path.exists(out):
            raise FileExistsError(f"out must be a new file; {os.fspath(out)!r} is there already")
        out = np.lib.format.open_memmap(out, mode="w+", dtype=np.float64, shape=(2, ny, nx))
    ra, dec = (np.empty((ny, nx)), np.empty((ny, nx))) if out is None else out
    for array in (ra, dec):
        if array.shape != (ny, nx):
            raise ValueError(f"out must hold two arrays of the shape {(ny, nx)}, not {array.shape}")
    transform = wcs.forward_transform
    columns, rows = np.arange(nx, dtype=float), np.arange(ny, dtype=float)
    if isinstance(transform, DetectorToSky):
        function = transform.row_function(columns, rows)
    else:
        function = _any_rows(transform, columns, rows)
    # Threads process bands of rows.
    band = max(1, _BAND_SIZE // nx)

    def fill(first, last):
        for start in range(first * band, min(last * band, ny), band):
            stop = min(start + band, ny)
            targets = ra[start:stop], dec[start:stop]
            if all(t.flags.c_contiguous and t.dtype == np.float64 for t in targets):
                function(start, stop, *targets)
            else:
                values = np.empty((2, stop - start, nx))
                function(start, stop, *values)
                ra[start:stop], dec[start:stop] = values

    run_blocks(fill, math.ceil(ny / band), weight=band * nx)
    return ra, dec


# Number of pixels in a band of rows.
_BAND_SIZE = 524_288


def _any_rows(transform, x, y):
    """Return a function for rows of any transform."""

    def function(start, stop, ra, dec):
        with np.errstate(all="ignore"):
            ra[...], dec[...] = transform(*np.broadcast_arrays(x, y[start:stop, np.newaxis]))

    return function
