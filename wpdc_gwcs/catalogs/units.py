"""Units of the columns of a checked catalog."""

from astropy import units as u
from astropy.table import Column

__all__ = ["UNITS", "unit_column"]

UNITS = {
    "ra": u.deg,
    "dec": u.deg,
    "ref_epoch": u.yr,
    "phot_g_mean_mag": u.mag,
    "bp_rp": u.mag,
    "pmra": u.mas / u.yr,
    "pmdec": u.mas / u.yr,
    "parallax": u.mas,
    "ra_error": u.mas,
    "dec_error": u.mas,
    "pmra_error": u.mas / u.yr,
    "pmdec_error": u.mas / u.yr,
    "parallax_error": u.mas,
    "radial_velocity": u.km / u.s,
}


def unit_column(name, values):
    """Build a column with the standard unit for its name.

    Parameters
    ----------
    name : str
        Name of the column.
    values : (N,) ndarray
        Its values.

    Returns
    -------
    `~astropy.table.Column`
        The column; dimensionless if its name has no unit.
    """
    return Column(values, unit=UNITS.get(name))
