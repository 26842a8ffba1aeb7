"""Reference catalogs from any table: names, units and values checked."""

import logging
import re
import warnings

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import Table

from wpdc_gwcs.catalogs.epochs import EPOCH_NAMES, reference_epochs
from wpdc_gwcs.catalogs.files import (
    READ_ERRORS,
    choose_table,
    is_fits,
    read_table_file,
    special_file,
    split_extension,
)
from wpdc_gwcs.catalogs.pieces import part_of, pieces_of
from wpdc_gwcs.catalogs.positions import (
    POSITION_NAMES,
    find_positions,
    read_positions,
    turn_to_icrs,
)
from wpdc_gwcs.catalogs.sources import catalog_source
from wpdc_gwcs.catalogs.stars import one_of_each, read_identifiers
from wpdc_gwcs.catalogs.units import UNITS, unit_column
from wpdc_gwcs.columns import (
    convert,
    find_name,
    listed,
    read_numbers,
    spelled_names,
    unit_of,
)
from wpdc_gwcs.exceptions import CatalogError, WPDCWarning

__all__ = ["identity_of", "known_names", "read_catalog", "require_catalog_file"]

log = logging.getLogger(__name__)

# Output column -> aliases, best first; a column without a unit has that of the output.
_OPTIONAL = {
    "pmra": ("pmra", "pm_ra_cosdec", "pmra_cosdec", "pmracosdec", "pm_ra", "pmalpha_j2000"),
    "pmdec": ("pmdec", "pm_dec", "pmde", "pmdelta_j2000"),
    "parallax": ("parallax", "plx"),
    "ra_error": ("ra_error", "e_ra_icrs", "e_raj2000", "e_ra"),
    "dec_error": ("dec_error", "e_de_icrs", "e_dej2000", "e_dec", "e_de"),
    "pmra_error": ("pmra_error", "e_pmra"),
    "pmdec_error": ("pmdec_error", "e_pmdec", "e_pmde"),
    "parallax_error": ("parallax_error", "e_plx", "e_parallax"),
    "ra_dec_corr": ("ra_dec_corr", "radecor"),
    "ra_pmra_corr": ("ra_pmra_corr", "rapmracor"),
    "ra_pmdec_corr": ("ra_pmdec_corr", "rapmdecor"),
    "dec_pmra_corr": ("dec_pmra_corr", "depmracor"),
    "dec_pmdec_corr": ("dec_pmdec_corr", "depmdecor"),
    "pmra_pmdec_corr": ("pmra_pmdec_corr", "pmrapmdecor"),
    "radial_velocity": ("radial_velocity", "dr2_radial_velocity", "rv", "rvel"),
    "ruwe": ("ruwe",),
}
_MAGNITUDES = (
    "phot_g_mean_mag",
    "gmag",
    "mag",
    "mag_auto",
    "mag_psf",
    "rmag",
    "imag",
    "vmag",
    "jmag",
    "kmag",
)
_COLORS = ("bp_rp", "bp-rp", "bprp")
# If there is no color, it is the difference of these magnitudes.
_BLUE = ("phot_bp_mean_mag", "bpmag", "bp_mag")
_RED = ("phot_rp_mean_mag", "rpmag", "rp_mag")
# Numbers that mean "no value": no measurement is exactly one of them.
_SENTINELS = np.array([s * n for n in (999.0, 9999.0, 99999.0, 1e20, 1e30) for s in (1, -1)])
# Magnitudes beyond this mean "no value" (99, -99).
_MOST_MAG = 90.0
_MARK = "wpdc_catalog"
_IDENTITY = "wpdc_identity"


def read_catalog(source, *, format=None, region=None):
    """Read a reference catalog into a table with standard columns and units.

    Parameters
    ----------
    source : path-like, Table, SkyCoord, GaiaArchive or HatsCatalog
        A file in any format that astropy reads as a table (FITS, ECSV, CSV, VOTable, ...), a
        FITS_LDAC catalog, ``path[EXT]`` for one table of a FITS file, or what is already in
        memory; ``"gaia"`` for the archive (`GaiaArchive`), ``"hats:PATH"`` for a `HatsCatalog`.
        Columns may have Gaia, VizieR or SExtractor names in any case.
    format : str, optional
        Format name for `astropy.table.Table.read`, if the file name does not tell.
    region : Region, optional
        The part of the sky that is needed.  For an archive, a partitioned catalog or a file of more
        than 32 MB (FITS, CSV, ECSV, Parquet), only this part is returned; others are returned
        whole.

    Returns
    -------
    catalog : `~astropy.table.Table`
        Plain float64 columns as listed in `wpdc_gwcs.catalogs`.  Rows without a usable position
        and repeated rows of a star are left out; ``catalog_index`` is the row in the input.

    Raises
    ------
    CatalogError
        If the file cannot be read, has no rows or no position columns, or has an impossible unit
        or mostly impossible positions; if an archive does not answer, or a region is needed and
        not given.

    Warns
    -----
    WPDCWarning
        If there are proper motions but no epoch of the positions, if unreadable rows or columns
        are left out, if rows repeat others, or if positions are in single precision.

    Notes
    -----
    A column without a unit is taken to be in the unit of the Gaia archive (deg, mas, mas / yr, yr);
    ``ERRA_WORLD`` and similar ones in deg.  The epoch is that of the column ``ref_epoch``, or
    else of the metadata of the table, or of the Gaia release that these name.

    Rows are the same star if they have the same ``source_id`` and are within 2 arcsec, or if
    `group_copies` finds so from positions, errors and magnitudes.  The row with the most complete
    and most precise values is kept.

    Examples
    --------
    >>> from astropy.table import Table
    >>> from wpdc_gwcs import read_catalog
    >>> catalog = read_catalog(Table({"RA": [10.0, float("nan"), 10.1], "DEC": [-5.0, -5.0, -5.1]}))
    >>> print(catalog["ra", "dec", "catalog_index"])
     ra  dec  catalog_index
    deg  deg
    ---- ---- -------------
    10.0 -5.0             0
    10.1 -5.1             2
    """
    source = catalog_source(source)
    if isinstance(source, SkyCoord):
        name, table = "catalog", _table_of_coordinates(source)
    elif isinstance(source, Table):
        name, table = source.meta.get(_MARK, "catalog"), source
    elif isinstance(source, str) or hasattr(source, "__fspath__"):
        name = str(source)
        part = _read_part(source, format, region)
        if part is not None:
            log.info("%s: %d of %d rows are in reach", name, len(part.rows), part.n_rows)
            if part.n_wrong:
                warnings.warn(
                    f"{name}: {part.n_wrong} of {part.n_rows} rows are left out: their positions "
                    "are not on the sky",
                    WPDCWarning,
                )
            return _standardize_part(part.table, name, part.rows, _file_identity(source))
        table = _read_table(source, format)
        table.meta.pop(_MARK, None)
    elif hasattr(source, "stars_of"):
        name = str(source)
        if region is None:
            raise CatalogError(
                f"{name}: needs a region of the sky, got none: it is too large to be read whole"
            )
        table = source.stars_of(region)
        return _standardize_part(table, name, np.arange(len(table)), source.identity)
    else:
        raise TypeError(
            f"catalog must be a path, a Table or a SkyCoord, got {type(source).__name__}"
        )
    return _standardize(table, name)


def known_names():
    """Return the names of the columns that `read_catalog` uses.

    Returns
    -------
    set of str
        In lower case.
    """
    aliases = [*_OPTIONAL.values(), _MAGNITUDES, _COLORS, _BLUE, _RED, EPOCH_NAMES]
    ellipse = {f"err{a}{tag}_world" for a in ("a", "b", "theta") for tag in ("psf", "win", "")}
    return {n for names in aliases for n in names} | POSITION_NAMES | ellipse | {"source_id"}


def identity_of(catalog):
    """Return the identity of the catalog that a part was read from.

    Parameters
    ----------
    catalog : `~astropy.table.Table`
        As returned by `read_catalog`.

    Returns
    -------
    str or None
        The same for all parts; `None` for a catalog that was read whole.

    Examples
    --------
    >>> from astropy.table import Table
    >>> from wpdc_gwcs.catalogs import identity_of, read_catalog
    >>> catalog = read_catalog(Table({"ra": [10.0], "dec": [20.0]}))
    >>> print(identity_of(catalog))
    None
    """
    return catalog.meta.get(_IDENTITY)


def _standardize_part(table, name, rows, identity):
    """Build the checked table of a part, which may be empty."""
    if len(table) == 0:
        part = Table({c: unit_column(c, np.zeros(0)) for c in ("ra", "dec")})
        part["catalog_index"] = np.zeros(0, int)
        part.meta[_MARK] = name
    else:
        part = _standardize(table, name, rows)
    part.meta[_IDENTITY] = identity
    return part


def _read_part(path, format, region):
    """Rows of a region from a file that is too large to be read whole; `None` for others."""
    path, extension = split_extension(path)
    if region is None or format is not None or not path.is_file():
        return None
    try:
        # As for whole files: warnings of the readers are ignored; the checks come later.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            pieces = pieces_of(path.absolute(), extension, known_names())
            return None if pieces is None else part_of(pieces, region)
    except READ_ERRORS as problem:
        # Reading it whole will report what is wrong.
        log.info("%s: cannot be read in pieces: %s", path, problem)
        return None


def _file_identity(source):
    stat = split_extension(source)[0].stat()
    return f"{source} {stat.st_size} {stat.st_mtime_ns}"


def require_catalog_file(path):
    """Check that there is a file to read, before any work that needs it.

    Parameters
    ----------
    path : path-like
        The file; it may name an extension, ``path[EXT]``.

    Raises
    ------
    CatalogError
        If there is nothing, something else than a file, or an empty file.

    Examples
    --------
    >>> from wpdc_gwcs.catalogs import require_catalog_file
    >>> require_catalog_file("no-such-file.fits")
    Traceback (most recent call last):
        ...
    wpdc_gwcs.exceptions.CatalogError: no-such-file.fits: catalog must be an existing file, ...
    """
    path = split_extension(path)[0]
    if not path.exists():
        raise CatalogError(f"{path}: catalog must be an existing file, found nothing there")
    if (what := special_file(path)) is not None:
        raise CatalogError(f"{path}: catalog must be a file, is {what}")
    if path.is_file() and path.stat().st_size == 0:
        raise CatalogError(f"{path}: catalog must not be empty, the file has 0 bytes")


def _read_table(path, format):
    """Read a table from a file; raise a `CatalogError` whatever goes wrong."""
    require_catalog_file(path)
    path, extension = split_extension(path)
    try:
        # The readers warn of odd units and headers; what matters is checked later.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if format in (None, "fits") and is_fits(path):
                with fits.open(path, memmap=False) as hdus:
                    hdu = choose_table(hdus, path, extension)
                    return Table.read(hdu, format="fits", mask_invalid=False)
            if extension is not None:
                raise CatalogError(f"{path}[{extension}]: only FITS files have extensions")
            if format is None and re.search(r"\.(fits?|fts|fz)(\.gz)?$", path.name.lower()):
                raise CatalogError(
                    f"{path}: a FITS file must begin with 'SIMPLE  =', this one does not"
                )
            return read_table_file(path, format)
    except READ_ERRORS as error:
        first_line = (str(error).strip() or type(error).__name__).split("\n")[0]
        raise CatalogError(
            f"{path}: cannot be read as a table: {type(error).__name__}: {first_line}"
        ) from error


def _table_of_coordinates(coordinates):
    icrs = coordinates.icrs.reshape(-1) if coordinates.isscalar else coordinates.icrs.ravel()
    table = Table({"ra": icrs.ra.deg, "dec": icrs.dec.deg})
    if "s" in coordinates.data.differentials:
        table["pmra"] = icrs.pm_ra_cosdec.to_value(u.mas / u.yr)
        table["pmdec"] = icrs.pm_dec.to_value(u.mas / u.yr)
        if coordinates.obstime is not None:
            table["ref_epoch"] = np.broadcast_to(coordinates.obstime.jyear, len(table))
    return table


def _standardize(table, name, rows=None):
    """Build the checked table; `name` is for messages, `rows` are row numbers in the input."""
    if len(table) == 0:
        raise CatalogError(f"{name}: catalog must have at least one row, has 0")
    spelled = spelled_names(table.colnames)
    pair = find_positions(spelled)
    if pair is None:
        table, pair = _positions_of_coordinates(table, name)
        spelled = spelled_names(table.colnames)
    columns, keep, rounding = read_positions(table, pair, name)
    for column, aliases in _OPTIONAL.items():
        found = find_name(spelled, aliases)
        if found is not None:
            values = _optional(table, found, UNITS.get(column), name)
            if values is not None:
                columns[column] = values
    _add_ellipse_errors(columns, table, spelled, name)
    for column in ("ra_error", "dec_error"):
        if column in columns and rounding:
            columns[column] = np.hypot(columns[column], rounding)
    magnitude = _magnitudes(table, spelled, _MAGNITUDES, name)
    if magnitude is not None:
        columns["phot_g_mean_mag"] = magnitude
    color = _colors(table, spelled, name)
    if color is not None:
        columns["bp_rp"] = color
    epoch = reference_epochs(
        table, spelled, pair[0], name, has_motion={"pmra", "pmdec"} <= set(columns)
    )
    if epoch is not None:
        columns["ref_epoch"] = epoch
    turn_to_icrs(columns, keep, table.meta, name)
    identifiers = read_identifiers(table, spelled)
    keep[keep] = one_of_each(columns, keep, identifiers, name)
    result = Table({c: unit_column(c, np.ascontiguousarray(v[keep])) for c, v in columns.items()})
    if identifiers is not None:
        result["source_id"] = identifiers[keep]
    index = np.arange(len(table)) if rows is None else rows
    if isinstance(table.meta.get(_MARK), str) and "catalog_index" in table.colnames:
        # A table from read_catalog, possibly cut: its rows keep pointing to the original input.
        index = np.asarray(table["catalog_index"])
    result["catalog_index"] = index[keep]
    if "pm_from_neighbors" in spelled and table[spelled["pm_from_neighbors"]].dtype.kind == "b":
        # Otherwise, a second reading would take filled-in values for measured ones.
        result["pm_from_neighbors"] = np.asarray(table[spelled["pm_from_neighbors"]])[keep]
    result.meta[_MARK] = name
    if _IDENTITY in table.meta and _MARK in table.meta:
        result.meta[_IDENTITY] = table.meta[_IDENTITY]
    return result


def _positions_of_coordinates(table, name):
    """Take the positions from a column of coordinates, if there is one."""
    found = next((c for c in table.colnames if isinstance(table[c], SkyCoord)), None)
    if found is None:
        raise CatalogError(
            f"{name}: catalog must have columns 'ra' and 'dec' (or RA_ICRS/DE_ICRS, "
            "X_WORLD/Y_WORLD, ALPHA_J2000/DELTA_J2000, RAJ2000/DEJ2000, ra_deg/dec_deg), "
            f"has {listed(table.colnames)}"
        )
    read = _table_of_coordinates(table[found])
    for column in table.colnames:
        if column != found and column not in read.colnames:
            read[column] = table[column]
    read.meta.update(table.meta)
    return read, ("ra", "dec")


def _optional(table, column, unit, name):
    """Values of an optional column; `None`, with a warning, if it cannot be read."""
    unit = u.dimensionless_unscaled if unit is None else unit
    given = unit_of(table[column], unit)
    try:
        values, unreadable = read_numbers(table[column])
        values[np.isin(values, _SENTINELS)] = np.nan
        values = convert(values, given, unit)
    except ValueError as problem:
        rule = str(problem)
        if "convertible" in rule:
            wanted = "none" if unit == u.dimensionless_unscaled else f"convertible to {unit}"
            rule = f"must have the unit {wanted}, has {str(table[column].unit)!r}"
        warnings.warn(f"{name}: column {column!r} {rule}: it is left out", WPDCWarning)
        return None
    if unreadable.any():
        row = int(np.flatnonzero(unreadable)[0])
        log.info(
            "%s: unreadable values in column %r: %d, such as %r",
            name,
            column,
            unreadable.sum(),
            str(table[column][row]),
        )
    return values


def _magnitudes(table, spelled, aliases, name):
    """Magnitudes from the first readable one of some columns, or `None`."""
    for alias in aliases:
        if alias in spelled:
            # only the order matters, so any unit will do
            column = table[spelled[alias]]
            plain = Table({spelled[alias]: getattr(column, "value", column)}, copy=False)
            plain[spelled[alias]].unit = None
            values = _optional(plain, spelled[alias], None, name)
            if values is not None:
                values[np.abs(values) >= _MOST_MAG] = np.nan
                return values
    return None


def _add_ellipse_errors(columns, table, spelled, name):
    """Errors from SExtractor and SCAMP: an ellipse, its angle measured from the RA axis."""
    if "ra_error" in columns:
        return
    for tag in ("psf", "win", ""):
        a, b, theta = f"erra{tag}_world", f"errb{tag}_world", f"errtheta{tag}_world"
        if a not in spelled or b not in spelled:
            continue
        # SExtractor's world coordinates are in degrees, even if the file does not say so.
        major, minor = (_angle_or_none(table, spelled[c], u.mas, name) for c in (a, b))
        angle = np.zeros(len(table))
        if theta in spelled:
            angle = _angle_or_none(table, spelled[theta], u.rad, name)
        if major is None or minor is None or angle is None:
            continue
        c2, s2 = np.cos(angle) ** 2, np.sin(angle) ** 2
        columns["ra_error"] = np.sqrt(major**2 * c2 + minor**2 * s2)
        columns["dec_error"] = np.sqrt(major**2 * s2 + minor**2 * c2)
        return


def _angle_or_none(table, column, unit, name):
    degrees = _optional(table, column, u.deg, name) if unit_of(table[column]) is not None else None
    if degrees is None:
        plain = _optional(table, column, None, name)
        degrees = plain
    return None if degrees is None else degrees * u.deg.to(unit)


def _colors(table, spelled, name):
    """Color of every star, or `None` if the table has neither a color nor both magnitudes."""
    found = find_name(spelled, _COLORS)
    color = None if found is None else _magnitudes(table, spelled, (found.lower(),), name)
    bands = [_magnitudes(table, spelled, aliases, name) for aliases in (_BLUE, _RED)]
    if any(band is None for band in bands):
        return color
    blue, red = bands
    return blue - red if color is None else np.where(np.isnan(color), blue - red, color)
