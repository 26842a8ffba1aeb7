"""Reliability of the astrometry of stars: RUWE and errors."""

import numpy as np

from wpdc_gwcs.catalogs.units import unit_column
from wpdc_gwcs.columns import numbers_or_nan

__all__ = ["TRUSTED_RUWE", "scale_errors"]

# Up to this RUWE, Gaia considers a star well described as single (GAIA-C3-TN-LU-LL-124-01).
TRUSTED_RUWE = 1.4
_ERRORS = ("ra_error", "dec_error", "pmra_error", "pmdec_error", "parallax_error")


def scale_errors(catalog):
    """Scale the errors of stars with a bad astrometric fit by their RUWE.

    Parameters
    ----------
    catalog : `~astropy.table.Table`
        As returned by `read_catalog`.

    Returns
    -------
    catalog : `~astropy.table.Table`
        A copy in which all errors of stars with a ``ruwe`` above 1.4 are multiplied by it (the
        square root of the reduced chi-square); the catalog itself if there are no such stars.

    Examples
    --------
    >>> from astropy.table import Table
    >>> from wpdc_gwcs.catalogs import read_catalog
    >>> from wpdc_gwcs.catalogs.quality import scale_errors
    >>> table = Table({"ra": [1.0, 1.1], "dec": [0.0, 0.0], "ra_error": [0.1, 0.1]})
    >>> table["ruwe"] = [1.0, 3.0]
    >>> [round(float(error), 3) for error in scale_errors(read_catalog(table))["ra_error"]]
    [0.1, 0.3]
    """
    ruwe = np.nan_to_num(numbers_or_nan(catalog, "ruwe"))
    bad = ruwe > TRUSTED_RUWE
    if not bad.any():
        return catalog
    scaled = catalog.copy()
    for name in set(_ERRORS) & set(catalog.colnames):
        errors = np.array(catalog[name], float)
        errors[bad] *= ruwe[bad]
        scaled[name] = unit_column(name, errors)
    return scaled
