"""-TAB: the sky at nodes (FITS WCS Paper III), which wcslib interpolates."""

import numpy as np
from astropy.io import fits

from wpdc_gwcs.export.cards import number_card
from wpdc_gwcs.export.exact import astropy_sky, description, deviation, require_shape

__all__ = ["TAB_NAME", "tab_form"]

#: EXTNAME of the table.
TAB_NAME = "WPDC_TAB"
_TOLERANCE_PX = 5e-4  # half of the promised 1e-3 px
_FIRST_NODES = 33
_MOST_NODES = 1 << 22


def tab_form(obj, *, version=1):
    """Return a table of sky positions at nodes, dense enough for bilinear interpolation.

    Parameters
    ----------
    obj : Calibration or DistortionSolution
        What is exported.
    version : int, optional
        EXTVER of the table.

    Returns
    -------
    header : `~astropy.io.fits.Header`
        The keywords.
    tables : list of `~astropy.io.fits.BinTableHDU`
        The table.
    deviation : float
        Largest deviation from the exact WCS, px.

    Notes
    -----
    The nodes run from edge to edge of the detector.  The error of bilinear interpolation falls with
    the square of their distance, so a first table shows how many nodes are needed.  Right ascension
    does not wrap at 360 degrees within the table.  A pole on the detector cannot be represented;
    the deviation shows this.
    """
    require_shape(obj)
    n = _FIRST_NODES
    while True:
        header, tables = _form(obj, n, version)
        worst = deviation(obj, astropy_sky(header, tables))
        if worst <= _TOLERANCE_PX:
            return header, tables, worst
        growth = min(np.sqrt(1.2 * worst / _TOLERANCE_PX), 16.0)
        n = int(np.ceil((n - 1) * max(growth, 1.2))) + 1
        if n**2 > _MOST_NODES:
            return header, tables, worst


def _form(obj, n_nodes, version):
    ny, nx = require_shape(obj)
    grids = [np.linspace(-0.5, size - 0.5, n_nodes) for size in (nx, ny)]
    x, y = np.meshgrid(*grids)
    ra, dec = obj.wcs(x, y)
    middle = description(obj).crval[0]
    ra = middle + (ra - middle + 180.0) % 360.0 - 180.0
    values = np.stack([ra, dec], axis=-1)
    # In the byte order of FITS, because astropy takes a second to change that of a large cell.
    cell = np.array([(values,)], dtype=[("COORDS", ">f8", values.shape)])
    table = fits.BinTableHDU(cell.view(fits.FITS_rec), name=TAB_NAME, ver=version)
    table.columns["COORDS"].unit = "deg"
    header = fits.Header()
    header["WCSAXES"] = (2, "number of axes")
    header["CTYPE1"] = ("RA---TAB", "right ascension, table")
    header["CTYPE2"] = ("DEC--TAB", "declination, table")
    for axis, grid in enumerate(grids, start=1):
        step = (grid[-1] - grid[0]) / (len(grid) - 1)
        header[f"CUNIT{axis}"] = ("deg", "unit")
        header[f"CRVAL{axis}"] = (1.0, "first node")
        header.append(number_card(f"CRPIX{axis}", grid[0] + 1.0, "[pixel] of it"), end=True)
        header.append(number_card(f"CDELT{axis}", 1.0 / step, "nodes per pixel"), end=True)
        header[f"PS{axis}_0"] = (TAB_NAME, "extension of the table")
        header[f"PS{axis}_1"] = ("COORDS", "column of the coordinates")
        header[f"PV{axis}_1"] = (version, "EXTVER of the table")
        header[f"PV{axis}_2"] = (1, "EXTLEVEL of the table")
        header[f"PV{axis}_3"] = (axis, "axis within the table")
    header["RADESYS"] = ("ICRS", "celestial frame")
    header["EQUINOX"] = (2000.0, "[yr] for readers that need it")
    return header, [table]
