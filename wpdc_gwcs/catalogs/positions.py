"""Positions of a catalog: columns, units, impossible values, old reference systems."""

import logging
import warnings

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord

from wpdc_gwcs.columns import (
    MISSING,
    convert,
    read_numbers,
    read_text,
    spelled_names,
    unit_of,
)
from wpdc_gwcs.counts import counted
from wpdc_gwcs.exceptions import CatalogError, WPDCWarning
from wpdc_gwcs.sexagesimal import read_angles

__all__ = [
    "POSITION_NAMES",
    "column_angles",
    "find_positions",
    "plain_degrees",
    "read_positions",
    "turn_to_icrs",
]

log = logging.getLogger(__name__)

# Pairs of position columns, best first; case is ignored.
_POSITIONS = (
    ("ra", "dec"),
    ("ra_icrs", "de_icrs"),
    ("ra_icrs", "dec_icrs"),
    ("alphapsf_j2000", "deltapsf_j2000"),
    ("alphawin_j2000", "deltawin_j2000"),
    ("alpha_j2000", "delta_j2000"),
    ("xpsf_world", "ypsf_world"),
    ("xwin_world", "ywin_world"),
    ("x_world", "y_world"),
    ("raj2000", "dej2000"),
    ("raj2000", "decj2000"),
    ("_raj2000", "_dej2000"),
    ("ra_j2000", "dec_j2000"),
    ("ra_deg", "dec_deg"),
    ("radeg", "dedeg"),
    ("radeg", "decdeg"),
    ("ramean", "decmean"),
    ("coord_ra", "coord_dec"),
    ("right_ascension", "declination"),
    ("alpha", "delta"),
)
POSITION_NAMES = {name for pair in _POSITIONS for name in pair}
# Columns that are in radians if they have no unit: tables of the Rubin pipelines.
_RADIANS = ("coord_ra",)
# Densities in stars per square degree that no catalog reaches: such positions are not in degrees.
# The lower limit is for columns whose name suggests radians.
_TOO_DENSE, _DENSE = 1e7, 1e5
# Minimum number of rows for a meaningful density.
_CROWD = 50
# Above this fraction of impossible positions, the column as a whole is wrong.
_MOST_WRONG = 0.5
# Relative resolution of single precision: 0.05 arcsec at 360 deg.
_SINGLE = np.finfo(np.float32).eps
# Reference systems that differ from ICRS by more than 0.02 arcsec, by their names in metadata.
_OLD_SYSTEMS = {"FK4": "fk4", "B1950": "fk4", "FK4-NO-E": "fk4noeterms"}


def find_positions(spelled):
    """Find the position columns.

    Parameters
    ----------
    spelled : dict
        Names of the columns, see `wpdc_gwcs.columns.spelled_names`.

    Returns
    -------
    (str, str) or None
        Names of right ascension and declination; `None` if there are none.
    """
    for ra, dec in _POSITIONS:
        if ra in spelled and dec in spelled:
            return spelled[ra], spelled[dec]
    return None


def read_positions(table, pair, name):
    """Read positions and find the rows that have one.

    Parameters
    ----------
    table : `~astropy.table.Table`
        The input.
    pair : (str, str)
        Columns of right ascension and declination.
    name : str
        Name of the input in messages.

    Returns
    -------
    columns : dict
        ``ra`` and ``dec``, deg.
    keep : (N,) ndarray of bool
        Rows with a position.
    rounding : float
        Rounding error of single precision, mas; 0 for double precision.

    Raises
    ------
    CatalogError
        If there is no position, or most are impossible.

    Warns
    -----
    WPDCWarning
        If rows with impossible positions are left out, or positions are taken to be radians or are
        in single precision.
    """
    found = [column_angles(table[column], column, name) for column in pair]
    values, unreadable = zip(*found, strict=True)
    factor = _radians_to_degrees(table, pair, values, name)
    ra, dec = (v * factor for v in values)
    finite = np.isfinite(ra) & np.isfinite(dec)
    if not finite.any():
        raise CatalogError(
            f"{name}: catalog must have rows with finite {pair[0]!r} and {pair[1]!r}, "
            f"none of {counted(len(table), 'row')} has"
        )
    keep = finite.copy()
    dropped = []
    for column, angle, low, high in ((pair[0], ra, -360.0, 360.0), (pair[1], dec, -90.0, 90.0)):
        wrong = keep & ((angle < low) | (angle > high))
        if not wrong.any():
            continue
        row = int(np.flatnonzero(wrong)[0])
        rule = f"column {column!r} must lie in [{low:g}, {high:g}] deg, got {angle[row]:g}"
        if wrong.sum() > _MOST_WRONG * finite.sum():
            raise CatalogError(f"{name}: {rule} in row {row}")
        dropped.append(f"{wrong.sum()} out of range ({rule} in row {row})")
        keep &= ~wrong
    broken = unreadable[0] | unreadable[1]
    if broken.any():
        row = int(np.flatnonzero(broken)[0])
        cells = ", ".join(repr(str(table[column][row])) for column in pair)
        dropped.append(f"{broken.sum()} that cannot be read ({cells} in row {row})")
    missing = int(np.sum(~finite & ~broken))
    if missing:
        log.info("%s: %d of %d rows have no position", name, missing, len(table))
    if dropped:
        warnings.warn(
            f"{name}: {np.sum(~keep) - missing} of {counted(len(table), 'row')} left out: "
            + "; ".join(dropped),
            WPDCWarning,
        )
    if not keep.any():
        raise CatalogError(f"{name}: none of {counted(len(table), 'row')} has a usable position")
    rounding = 0.0
    if any(getattr(table[column], "dtype", None) == np.float32 for column in pair):
        # half a step of the last bit at most, a uniform distribution
        step = _SINGLE * 2.0 ** np.floor(np.log2(max(np.nanmax(np.abs(ra[keep])), 1e-3)))
        rounding = float(step * 3.6e6 / np.sqrt(12))
        warnings.warn(
            f"{name}: positions are in single precision, which rounds them by up to "
            f"{step * 1.8e6:.2g} mas: a catalog in double precision gives a better solution",
            WPDCWarning,
        )
    return {"ra": ra % 360.0, "dec": dec}, keep, rounding


def plain_degrees(table):
    """Positions of some rows of a larger table, if these rows suffice to interpret them.

    Parameters
    ----------
    table : `~astropy.table.Table`
        Numeric columns of these rows.

    Returns
    -------
    (ra, dec, sure) or None
        Positions in deg, and whether they cannot be radians; `None` if the columns are missing,
        are text, or have another unit or an old reference system.
    """
    pair = find_positions(spelled_names(table.colnames))
    if pair is None or pair[0].lower() in _RADIANS or _old_system(table.meta) is not None:
        return None
    found, sure = [], False
    for name, half in zip(pair, (2 * np.pi, np.pi / 2)):
        column = table[name]
        unit = unit_of(column)
        if column.dtype.kind not in "fiu":
            return None
        values = read_numbers(column)[0]
        if unit is not None:
            try:
                values = convert(values, unit, u.deg)
            except ValueError:
                return None
        sure |= unit is not None or bool(np.nanmax(np.abs(values), initial=0) > half)
        found.append(values)
    return *found, sure


def column_angles(column, label, name):
    """Read a column of right ascension or declination, as numbers or as sexagesimal text.

    Parameters
    ----------
    column : array_like
        Column of a table.  Sexagesimal right ascension is in hours, unless the unit is deg.
    label : str
        Name of the column, which tells right ascension from declination.
    name : str
        Name of the input in messages.

    Returns
    -------
    values : (N,) ndarray
        Values in deg, or as they are if the column has no unit; NaN if missing or unreadable.
    unreadable : (N,) ndarray of bool
        Mask of cells that are neither missing nor an angle.

    Raises
    ------
    CatalogError
        If no cell can be read, or the unit is not one of an angle.
    """
    unit = unit_of(column)
    try:
        values, unreadable = read_numbers(column)
    except ValueError as problem:
        text = read_text(column)
        declination = label.lower().lstrip("_").startswith(("d", "b"))
        values = read_angles(text, hours=not declination and unit != u.deg)
        if np.isnan(values).all():
            raise CatalogError(f"{name}: column {label!r} {problem}") from None
        return values, np.isnan(values) & ~np.isin(np.char.lower(text), MISSING)
    if unit is None:
        return values, unreadable
    try:
        return convert(values, unit, u.deg), unreadable
    except ValueError:
        given = str(getattr(column, "unit", unit))
        raise CatalogError(
            f"{name}: unit of column {label!r} must be an angle, got {given!r}"
        ) from None


def _radians_to_degrees(table, pair, values, name):
    """Factor to degrees for positions without a unit, which may be radians."""
    if any(unit_of(table[column]) is not None for column in pair):
        return 1.0
    ra, dec = values
    known = np.isfinite(ra) & np.isfinite(dec)
    ra, dec = ra[known], dec[known]
    named = pair[0].lower() in _RADIANS
    in_range = np.all(np.abs(ra) <= 2 * np.pi) and np.all(np.abs(dec) <= np.pi / 2)
    if not in_range or len(ra) < (1 if named else _CROWD):
        return 1.0
    side = max(np.ptp(ra) * np.cos(np.radians(np.median(dec))), np.ptp(dec), 1e-9)
    density = len(ra) / side**2
    if density > (_DENSE if named else _TOO_DENSE):
        warnings.warn(
            f"{name}: columns {pair[0]!r} and {pair[1]!r} have no unit and are taken to be "
            f"radians: in degrees, they would have {density:.2g} stars per square degree",
            WPDCWarning,
        )
        return 180.0 / np.pi
    if named:
        raise CatalogError(
            f"{name}: columns {pair[0]!r} and {pair[1]!r} must have a unit: without one, they may "
            f"be degrees or radians ({ra[0]:g}, {dec[0]:g} in the first row)"
        )
    return 1.0


def turn_to_icrs(columns, keep, meta, name):
    """Transform positions to ICRS in place, if the metadata name an old reference system.

    Parameters
    ----------
    columns : dict
        ``ra`` and ``dec``, deg; replaced.
    keep : (N,) ndarray of bool
        Rows with a position.
    meta : dict
        Metadata of the table.
    name : str
        Name of the input in messages.

    Raises
    ------
    CatalogError
        If there are proper motions, which would be in the old system too.
    """
    system = _old_system(meta)
    if system is None:
        return
    if {"pmra", "pmdec"} & set(columns):
        raise CatalogError(
            f"{name}: catalog must be in ICRS or FK5 to have proper motions, is in {system.upper()}"
        )
    sky = SkyCoord(columns["ra"][keep], columns["dec"][keep], unit="deg", frame=system).icrs
    columns["ra"][keep], columns["dec"][keep] = sky.ra.deg, sky.dec.deg
    log.info("%s: positions are turned from %s to ICRS", name, system.upper())


def _old_system(meta):
    """Astropy frame of the old system that the metadata name, or `None`."""
    words = [str(meta.get(k, "")) for k in ("RADESYS", "RADECSYS", "radesys", "COOSYS", "system")]
    return next((s for w in words if (s := _OLD_SYSTEMS.get(w.strip().upper()))), None)
