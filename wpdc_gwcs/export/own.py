"""FITS tables of this package: the look-up table, as in the paper, and the instrument."""

import numpy as np
from astropy.io import fits

from wpdc_gwcs.export.exact import description

__all__ = ["INSTRUMENT_NAME", "TABLE_COLUMNS", "TABLE_NAME", "own_tables"]

#: EXTNAMEs and columns.
TABLE_NAME = "WPDC_LUT"
INSTRUMENT_NAME = "WPDC_INSTRUMENT"
TABLE_COLUMNS = ("X_GRID", "Y_GRID", "DX_LUT", "DY_LUT")


def own_tables(obj, *, version=1):
    """Make the tables from which the instrument is read back exactly.

    Parameters
    ----------
    obj : Calibration or DistortionSolution
        What is exported.
    version : int, optional
        EXTVER of the tables.

    Returns
    -------
    tables : list of `~astropy.io.fits.BinTableHDU`
        The instrument, and the look-up table if there is one.

    Notes
    -----
    ``WPDC_LUT`` has one row for each node, x running fastest: ``X_GRID``, ``Y_GRID`` in FITS pixels
    (from one), and ``DX_LUT``, ``DY_LUT`` in px, to be subtracted from the undistorted position.
    The single row of ``WPDC_INSTRUMENT`` has CD0, PV0, the zero-based CRPIX and the nominal CRVAL,
    which are read back without rounding.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs import DistortionSolution, LookupTable, PVPolynomial
    >>> from wpdc_gwcs.export import own_tables
    >>> cd, crpix, crval = np.diag([-8e-5, 8e-5]), np.array([49.5, 49.5]), np.array([10.0, 45.0])
    >>> grid = np.linspace(-0.5, 99.5, 5)
    >>> table = LookupTable(grid, grid, np.full((5, 5), 0.25), np.zeros((5, 5)))
    >>> solution = DistortionSolution("d1", (100, 100), crpix, cd, crval, PVPolynomial(), table)
    >>> instrument, lut = own_tables(solution)
    >>> instrument.name, lut.name, lut.data["X_GRID"][:2].tolist(), float(lut.data["DX_LUT"][0])
    ('WPDC_INSTRUMENT', 'WPDC_LUT', [0.5, 25.5], 0.25)
    """
    solution = description(obj).solution
    pv, table = solution.pv, obj.lookup_table
    values = {
        "CRPIX": ("2D", "pixel", solution.crpix),
        "CD": ("4D", "deg/pixel", solution.cd),
        "CRVAL": ("2D", "deg", solution.crval),
        "DEGREE": ("1J", None, pv.degree),
        "RADIAL": ("1L", None, pv.radial),
        "PV": (f"{pv.coefficients.size}D", "deg", pv.coefficients),
    }
    columns = [
        fits.Column(name, form, unit=unit, array=np.asarray(value).reshape(1, -1))
        for name, (form, unit, value) in values.items()
    ]
    instrument = fits.BinTableHDU.from_columns(columns, name=INSTRUMENT_NAME, ver=version)
    instrument.header["WPDCLUT"] = (table is not None, "whether WPDC_LUT belongs to it")
    instrument.header.add_comment("CRPIX counts from zero; PV: axis 1, axis 2, by FITS index")
    if table is None:
        return [instrument]
    x, y = np.meshgrid(table.x_grid + 1.0, table.y_grid + 1.0)
    columns = [
        fits.Column(name, "D", unit="pixel", array=np.asarray(value).ravel())
        for name, value in zip(TABLE_COLUMNS, (x, y, table.dx, table.dy), strict=True)
    ]
    nodes = fits.BinTableHDU.from_columns(columns, name=TABLE_NAME, ver=version)
    nodes.header["METHOD"] = (table.method, "interpolation between the nodes")
    nodes.header["NXGRID"] = (len(table.x_grid), "nodes along x, which runs fastest")
    nodes.header["NYGRID"] = (len(table.y_grid), "nodes along y")
    return [instrument, nodes]
