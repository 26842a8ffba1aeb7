"""CPDIS: look-up tables before CD and PV (FITS WCS Paper IV), as astropy.wcs applies them."""

import numpy as np
from astropy.io import fits

from wpdc_gwcs.exceptions import FileFormatError
from wpdc_gwcs.export.cards import number_card
from wpdc_gwcs.export.exact import astropy_sky, description, deviation, require_shape
from wpdc_gwcs.export.tpv import fold_polynomial, tpv_keywords

__all__ = ["cpdis_form"]

_TOLERANCE_PX = 5e-4  # half of the promised 1e-3 px
_MOST_NODES = 1 << 22


def cpdis_form(obj, *, first_version=1):
    """Return TPV keywords and look-up tables that plain astropy.wcs can use.

    Parameters
    ----------
    obj : Calibration or DistortionSolution
        What is exported.
    first_version : int, optional
        EXTVER of the table of the first axis; that of the second axis is one more.

    Returns
    -------
    header : `~astropy.io.fits.Header`
        The keywords.
    tables : list of `~astropy.io.fits.ImageHDU`
        Extensions ``WCSDVARR``; none if there is no look-up table.
    deviation : float
        Largest deviation from the exact WCS, px.

    Notes
    -----
    ``CPDIS`` acts on the pixel position, before CD and PV, and is bilinear.  Newton's method finds
    the shift d at every node that has the same effect there as the table has after PV:
    ``PV(CD (x + d - CRPIX)) = PV(CD (x - CRPIX)) - CD table(x)``.  The density of nodes is doubled
    until astropy.wcs agrees everywhere.
    """
    require_shape(obj)
    header, tables = tpv_keywords(obj, fold_polynomial(obj)), []
    table = obj.lookup_table
    if table is None:
        return header, tables, deviation(obj, astropy_sky(header))
    plain, worst, factor = header, np.inf, 1
    while worst > _TOLERANCE_PX:
        grids = [
            np.linspace(g[0], g[-1], (len(g) - 1) * factor + 1)
            for g in (table.x_grid, table.y_grid)
        ]
        if factor > 1 and len(grids[0]) * len(grids[1]) > _MOST_NODES:
            break
        shift = _prior_shift(obj, *np.meshgrid(*grids))
        header, tables = _with_tables(plain, grids, shift, first_version)
        worst = deviation(obj, astropy_sky(header, tables))
        factor *= 2
    return header, tables, worst


def _prior_shift(obj, x, y):
    """Shift of the pixel position before PV that is equivalent to the table after PV."""
    exact = description(obj)
    solution, cd = exact.solution, exact.cd
    pv = fold_polynomial(obj)
    shape = x.shape
    offset = np.array([x.ravel(), y.ravel()]) - np.asarray(solution.crpix)[:, None]
    shift_behind = np.array(obj.lookup_table(x.ravel(), y.ravel()))
    u = cd @ offset
    target = np.array(pv(*u)) - cd @ shift_behind
    v = u.copy()
    for _ in range(20):
        wrong = np.array(pv(*v)) - target
        (a, b), (c, d) = pv.jacobian(*v)
        step = np.array([d * wrong[0] - b * wrong[1], a * wrong[1] - c * wrong[0]]) / (
            a * d - b * c
        )
        v -= step
        if np.abs(np.linalg.solve(cd, step)).max() < 1e-10:
            break
    shift = np.linalg.solve(cd, v - u)
    if not np.isfinite(shift).all():
        raise FileFormatError("the look-up table cannot be carried through the polynomial")
    return shift.reshape(2, *shape)


def _with_tables(header, grids, shift, first_version):
    header = header.copy()
    tables = []
    for axis in (1, 2):
        version = first_version + axis - 1
        header[f"CPDIS{axis}"] = ("LOOKUP", "prior distortion: look-up table")
        header[f"DP{axis}.EXTVER"] = (float(version), "version of WCSDVARR")
        header[f"DP{axis}.NAXES"] = (2.0, "number of axes of the table")
        for i in (1, 2):
            header[f"DP{axis}.AXIS.{i}"] = (float(i), "axis of the image")
        image = fits.ImageHDU(shift[axis - 1].astype(np.float32), name="WCSDVARR", ver=version)
        for i, grid in enumerate(grids, start=1):
            image.header[f"CRPIX{i}"] = (1.0, "first node")
            image.header.append(number_card(f"CRVAL{i}", grid[0] + 1.0, "its pixel"), end=True)
            step = (grid[-1] - grid[0]) / (len(grid) - 1)
            image.header.append(number_card(f"CDELT{i}", step, "pixels between nodes"), end=True)
        tables.append(image)
    return header, tables
