"""Reading of table columns: names, masked and missing values, units, numbers as text.

Tables of stars have many sources: a missing value may be masked, NaN, empty, ``null`` or ``--``, a
unit may be misspelled, and a number may be in a column of text.  All parts of the package read
columns with these functions.
"""

import re

import numpy as np
from astropy import units as u

__all__ = [
    "MISSING",
    "convert",
    "find_name",
    "listed",
    "numbers_or_nan",
    "numbers_or_none",
    "read_numbers",
    "read_text",
    "spelled_names",
    "unit_of",
]

# Words for a missing value, in lower case.
MISSING = ("", "null", "none", "nan", "na", "n/a", "--", "---", "-", "...", "\\n", "masked", "?")


def spelled_names(names):
    """Return the spelling of every name by its lower case; an exact one has precedence.

    Parameters
    ----------
    names : sequence of str
        Names of columns.

    Returns
    -------
    dict
        Name as it is spelled, by itself and by its lower case.
    """
    return {n.lower(): n for n in reversed(names)} | {n: n for n in names}


def find_name(spelled, aliases):
    """Find the first of several names.

    Parameters
    ----------
    spelled : dict
        As returned by `spelled_names`.
    aliases : sequence of str
        Names in lower case, best first.

    Returns
    -------
    str or None
        The name as it is spelled; `None` if there is none.
    """
    return next((spelled[a] for a in aliases if a in spelled), None)


def listed(names, most=12, *, kind="columns"):
    """List the names of columns, or of other things, for a message.

    Parameters
    ----------
    names : sequence of str
        The names.
    most : int, optional
        Maximum number shown.
    kind : str, optional
        What they are, in the plural.

    Returns
    -------
    str
        Names separated by commas.
    """
    shown = ", ".join(names[:most])
    return f"{shown}, ... ({len(names)} {kind})" if len(names) > most else shown


def read_text(column):
    """Return a column as text without surrounding blanks.

    Parameters
    ----------
    column : array_like
        Strings, bytes, or objects of any kind.

    Returns
    -------
    (N,) ndarray of str
        Texts, empty for missing or masked values.
    """
    values, mask = _data_and_mask(column)
    if values.dtype.kind == "S":
        values = np.char.decode(values, "latin-1")
    elif values.dtype.kind != "U":
        values = np.array(["" if v is None else _text(v) for v in values.ravel()], dtype=str)
    text = np.char.strip(values.ravel())
    if mask is not None:
        text = np.where(np.broadcast_to(mask, values.shape).ravel(), "", text)
    return text


def read_numbers(column, *, several=False):
    """Return a column as plain floats.

    Parameters
    ----------
    column : array_like
        Column of a table, masked or not, a Quantity, a list; numbers or text.
    several : bool, optional
        Whether rows may have several values, of which the first is used.

    Returns
    -------
    values : (N,) ndarray
        Values, NaN if masked, missing, infinite or unreadable.
    unreadable : (N,) ndarray of bool
        Mask of cells that are not numbers.

    Raises
    ------
    ValueError
        If no row has a number but some have something else, or if rows have several values.
    """
    values, mask = _data_and_mask(column)
    if values.ndim != 1:
        if not several or values.ndim < 1:
            raise ValueError(f"must have one value a row, has {values.shape}")
        n = len(values)
        values = values.reshape(n, -1)[:, 0] if values.size else np.full(n, np.nan)
        mask = None if mask is None else np.reshape(mask, (n, -1))[:, 0]
    unreadable = np.zeros(len(values), bool)
    if values.dtype.kind in "biuf":
        numbers = np.array(values, dtype=float)
    elif values.dtype.kind in "SUO":
        numbers, unreadable = _numbers_of_text(values)
    else:
        raise ValueError(f"must be numeric, is of type {values.dtype}")
    if mask is not None:
        mask = np.broadcast_to(mask, values.shape)
        numbers[mask] = np.nan
        unreadable &= ~mask
    numbers[~np.isfinite(numbers)] = np.nan
    if unreadable.any() and not np.isfinite(numbers).any():
        first = _text(values[np.flatnonzero(unreadable)[0]])
        raise ValueError(f"must be numeric, got {first!r}")
    return numbers, unreadable


def numbers_or_none(table, name, rows=slice(None)):
    """Return rows of a column as floats, or None if the table does not have it.

    Parameters
    ----------
    table : `~astropy.table.Table`
        Any table.
    name : str
        Name of the column.
    rows : slice or array_like, optional
        Rows; all by default.

    Returns
    -------
    ndarray or None
        Values, NaN for missing ones.
    """
    return read_numbers(table[name])[0][rows] if name in table.colnames else None


def numbers_or_nan(table, name):
    """Return a column as floats, NaN if the table does not have it.

    Parameters
    ----------
    table : `~astropy.table.Table`
        Any table.
    name : str
        Name of the column.

    Returns
    -------
    (N,) ndarray
        Values.
    """
    values = numbers_or_none(table, name)
    return np.full(len(table), np.nan) if values is None else values


def unit_of(column, default=None):
    """Return the unit of a column, even if its spelling is nonstandard.

    Parameters
    ----------
    column : array_like
        Column of a table.
    default : unit, optional
        Unit for a column without one.

    Returns
    -------
    unit
        The unit, possibly unrecognized.
    """
    given = getattr(column, "unit", None)
    if given is None or given == u.dimensionless_unscaled or not str(given).strip():
        return default
    if isinstance(given, u.UnrecognizedUnit | str):
        return _forgiven_unit(str(given))
    return given


def convert(values, given, unit):
    """Convert values to another unit.

    Parameters
    ----------
    values : (N,) ndarray
        Numbers.
    given, unit : unit
        Unit of the numbers, and target unit.

    Returns
    -------
    (N,) ndarray
        Converted values; the same array if the units are the same.

    Raises
    ------
    ValueError
        If there is no conversion.
    """
    if given == unit:
        return values
    try:
        return values * given.to(unit)
    except (u.UnitConversionError, u.UnitTypeError, AttributeError, TypeError, ValueError):
        raise ValueError(f"must be convertible to {unit}, got {str(given)!r}") from None


def _data_and_mask(column):
    mask = getattr(column, "mask", None)
    column = getattr(column, "unmasked", column)
    return np.asarray(np.ma.getdata(getattr(column, "value", column))), mask


def _text(value):
    return value.decode("latin-1") if isinstance(value, bytes) else str(value)


def _numbers_of_text(values):
    """Numbers in text or objects, and a mask of other cells."""
    text = read_text(values)
    missing = np.isin(np.char.lower(text), MISSING)
    text = np.where(missing, "nan", text)
    try:
        return text.astype(float), np.zeros(len(text), bool)
    except ValueError:
        # Text among numbers is rare enough to be checked cell by cell.
        numbers = np.array([_number(t) for t in text.tolist()], dtype=float)
        return numbers, np.isnan(numbers) & (text != "nan")


def _number(text):
    try:
        return float(text)
    except ValueError:
        return np.nan


def _forgiven_unit(text):
    """Read ``degrees``, ``DEG``, ``Radians``, ``milliarcsec``, ``mas/year``, ``[yr]``."""
    plain = re.sub(r"milli-?arc-?sec(ond)?s?", "mas", text.strip(" '\"[]()").lower())
    plain = re.sub(r"\barc-?sec(ond)?s?\b", "arcsec", plain)
    plain = re.sub(r"\barc-?min(ute)?s?\b", "arcmin", plain)
    plain = re.sub(r"\bdegrees?\b", "deg", re.sub(r"\b(years?|a)\b", "yr", plain))
    plain = re.sub(r"\bradians?\b", "rad", re.sub(r"\bhours?\b", "hourangle", plain))
    try:
        return u.Unit(plain)
    except (ValueError, TypeError):
        return u.Unit(text, parse_strict="silent")
