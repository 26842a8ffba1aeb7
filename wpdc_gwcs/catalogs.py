"""Reference catalogues: read, check, move to the epoch of a frame, cut to the sky it covers.

::

    file or table --read_catalog--> checked table --fill_motions--> all stars with a motion
                                                  --select_cone--> near the frame
                                                  --propagate--> at the epoch of the frame

Motions are filled from the whole catalogue, before the cut, so that a star moves alike in all
frames.

The checked table has plain float64 columns with fixed names and units, whatever the input called
them:

===================== ======== =================================================================
column                unit     meaning
===================== ======== =================================================================
``ra``, ``dec``       deg      ICRS position at ``ref_epoch``
``pmra``, ``pmdec``   mas / yr proper motion (``pmra`` includes cos Dec), NaN where unknown
``parallax``          mas      NaN where unknown
``ref_epoch``         yr       Julian year of the position
``phot_g_mean_mag``   mag      a brightness, for ordering only
``bp_rp``             mag      a color, NaN where unknown
``ra_error``, ...     mas      errors of ``ra`` (times cos Dec), ``dec``, ``pmra``, ``pmdec``,
                               ``parallax``; NaN where unknown
``ra_pmra_corr``      --       correlation of the errors of ``ra`` and ``pmra``; likewise
                               ``dec_pmdec_corr``
``ra_dec_corr``       --       correlation of the errors of ``ra`` and ``dec``
``catalog_index``     --       row of the input, zero based
``pm_from_neighbors`` --       true where `fill_motions` filled the motion
===================== ======== =================================================================
"""

import re
import warnings
from pathlib import Path
from xml.parsers.expat import ExpatError

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.io.registry import IORegistryError
from astropy.stats import mad_std
from astropy.table import Column, Table
from scipy.spatial import cKDTree

from wpdc_gwcs.exceptions import CatalogError, WPDCWarning

__all__ = ["fill_motions", "propagate", "read_catalog", "select_cone"]

# Pairs of position columns, best first; compared without regard to case.
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

_NUMBER = u.dimensionless_unscaled
# Output column -> (unit, aliases best first, unit where the file gives none).
_OPTIONAL = {
    "pmra": (
        u.mas / u.yr,
        ("pmra", "pm_ra_cosdec", "pmra_cosdec", "pmracosdec", "pm_ra", "pmalpha_j2000"),
        u.mas / u.yr,
    ),
    "pmdec": (
        u.mas / u.yr,
        ("pmdec", "pm_dec", "pmde", "pmdelta_j2000"),
        u.mas / u.yr,
    ),
    "parallax": (u.mas, ("parallax", "plx"), u.mas),
    "ra_error": (u.mas, ("ra_error", "e_ra_icrs", "e_raj2000", "e_ra"), u.mas),
    "dec_error": (u.mas, ("dec_error", "e_de_icrs", "e_dej2000", "e_dec", "e_de"), u.mas),
    "pmra_error": (u.mas / u.yr, ("pmra_error", "e_pmra"), u.mas / u.yr),
    "pmdec_error": (u.mas / u.yr, ("pmdec_error", "e_pmdec", "e_pmde"), u.mas / u.yr),
    "parallax_error": (u.mas, ("parallax_error", "e_plx", "e_parallax"), u.mas),
    "ra_dec_corr": (_NUMBER, ("ra_dec_corr", "radecor"), _NUMBER),
    "ra_pmra_corr": (_NUMBER, ("ra_pmra_corr", "rapmracor"), _NUMBER),
    "dec_pmdec_corr": (_NUMBER, ("dec_pmdec_corr", "depmdecor"), _NUMBER),
}
_EPOCHS = ("ref_epoch", "refepoch", "epoch", "obsdate")
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
# Where there is no color, it is the difference of these.
_BLUE = ("phot_bp_mean_mag", "bpmag", "bp_mag")
_RED = ("phot_rp_mean_mag", "rpmag", "rp_mag")
_UNITS = {
    "ra": u.deg,
    "dec": u.deg,
    "ref_epoch": u.yr,
    "phot_g_mean_mag": u.mag,
    "bp_rp": u.mag,
    **{name: unit for name, (unit, _, _) in _OPTIONAL.items() if unit != _NUMBER},
}
# Releases that a header, a table name or a description may mention.
_GAIA_EPOCHS = (
    (re.compile(r"gaia\s*[-_/]?\s*e?dr3|I[/_]35[05]"), 2016.0),
    (re.compile(r"gaia\s*[-_/]?\s*dr2|I[/_]345"), 2015.5),
    (re.compile(r"gaia\s*[-_/]?\s*dr1|I[/_]337"), 2015.0),
)
_ASSUMED_EPOCH = 2016.0
_FITS_NAME = re.compile(r"\.(fits?|fts|fz)(\.gz)?$", re.IGNORECASE)
# Endings that tell the format; None where astropy finds out by itself.
_FORMATS = (
    (".ecsv", "ascii.ecsv"),
    (".csv", "ascii.csv"),
    (".vot", "votable"),
    (".parquet", "parquet"),
    (".xml", None),
    (".h5", None),
    (".hdf5", None),
    (".html", None),
    (".asdf", None),
)
_MARK = "wpdc_catalog"
# Stars whose median stands in for a motion that is not known.  Fewer than the least say nothing
# about their scatter, hence nothing about the error of a star that is moved by them.
_NEIGHBORS = 30
_LEAST_NEIGHBORS = 5
# Stars whose neighbours are looked up at once: some 30 MB.
_BLOCK = 20000
# What the readers of astropy raise on damaged or foreign files.
_READ_ERRORS = (
    OSError,
    EOFError,
    ValueError,
    TypeError,
    LookupError,
    AttributeError,
    ImportError,
    RuntimeError,
    ArithmeticError,
    AssertionError,
    ExpatError,
    IORegistryError,
    fits.VerifyError,
)


def read_catalog(source, *, format=None):
    """Read a reference catalogue and bring it to one form.

    Parameters
    ----------
    source : path-like, `~astropy.table.Table` or `~astropy.coordinates.SkyCoord`
        A file in any format that astropy reads as a table (FITS, ECSV, CSV, VOTable, ...), a
        FITS_LDAC catalogue, ``path[EXT]`` for one table of a FITS file, or what is already in
        memory.  Columns may have Gaia, VizieR or SExtractor names in any case.
    format : str, optional
        Format name for `astropy.table.Table.read` where the file name does not tell.

    Returns
    -------
    catalog : `~astropy.table.Table`
        Plain float64 columns as listed in the documentation of this module.  Rows without a finite
        position are left out; ``catalog_index`` tells the row of the input.

    Raises
    ------
    CatalogError
        If the file cannot be read, has no rows or no position columns, if a unit or a value is
        impossible.

    Warns
    -----
    WPDCWarning
        If there are proper motions and nothing says at which epoch the positions are.

    Notes
    -----
    A column without a unit is taken to be in the unit of the Gaia archive (deg, mas, mas / yr, yr);
    ``ERRA_WORLD`` and its kin in deg.  The epoch is that of the column ``ref_epoch``, else of the
    table's metadata, else of the Gaia release that the metadata names.

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
    if isinstance(source, SkyCoord):
        name, table = "catalog", _table_of_coordinates(source)
    elif isinstance(source, Table):
        name, table = source.meta.get(_MARK, "catalog"), source
    elif isinstance(source, str) or hasattr(source, "__fspath__"):
        name, table = str(source), _read_table(source, format)
        table.meta.pop(_MARK, None)
    else:
        raise TypeError(
            f"catalog must be a path, a Table or a SkyCoord, got {type(source).__name__}"
        )
    return _standardize(table, name)


def fill_motions(catalog):
    r"""Give stars without a known proper motion that of their neighbours.

    Parameters
    ----------
    catalog : `~astropy.table.Table`
        As returned by `read_catalog`; all of it, because a part has other neighbours.

    Returns
    -------
    catalog : `~astropy.table.Table`
        A copy with ``pmra``, ``pmdec``, ``pmra_error`` and ``pmdec_error`` filled in where the
        motion was not known, and the boolean column ``pm_from_neighbors``.  The catalogue itself
        where there is nothing to fill, where it has been filled, or where fewer than five stars
        have a motion.

    Notes
    -----
    The motion is the median of that of the n = 30 nearest stars on the sky that have one (all of
    them, where they are fewer), its error on each axis

    .. math::
        \sigma_\mu = 1.4826\,\mathrm{MAD}\,\frac{n}{n - 0.8}\sqrt{1 + \frac{\pi}{2 n}}

    from the scatter of these stars about their median, with the correction of the MAD for few of
    them [1]_ and the variance of the median itself.  Directions are those at the star, also at the
    poles.

    References
    ----------
    .. [1] Croux, C. & Rousseeuw, P. J., 1992, Time-efficient algorithms for two highly robust
       estimators of scale, Computational Statistics 1, 411.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import Table
    >>> from wpdc_gwcs.catalogs import fill_motions, read_catalog
    >>> table = Table({"ra": np.linspace(10.0, 10.1, 6), "dec": np.full(6, -5.0)})
    >>> table["pmra"] = [1.0, 2.0, 3.0, 4.0, 100.0, np.nan]
    >>> table["pmdec"], table["ref_epoch"] = -1.0, 2016.0
    >>> catalog = fill_motions(read_catalog(table))
    >>> round(float(catalog["pmra"][5]), 2), bool(catalog["pm_from_neighbors"][5])
    (3.0, True)
    """
    names = set(catalog.colnames)
    if not {"pmra", "pmdec"} <= names or "pm_from_neighbors" in names:
        return catalog
    motion = np.array([catalog["pmra"], catalog["pmdec"]], float)
    unknown = ~np.isfinite(motion)
    lacking = unknown.any(axis=0)
    if not lacking.any() or np.sum(~lacking) < _LEAST_NEIGHBORS:
        return catalog
    median, error = _motion_of_neighbors(catalog, motion, ~lacking, np.flatnonzero(lacking))
    filled = catalog.copy()
    for k, name in enumerate(("pmra", "pmdec")):
        for column, new in ((name, median[k]), (f"{name}_error", error[k])):
            values = _floats_or_nan(catalog, column)
            # One of the two may be known, and stays.
            values[unknown[k]] = new[unknown[k, lacking]]
            filled[column] = _column(column, values)
    filled["pm_from_neighbors"] = lacking
    return filled


def propagate(catalog, epoch, *, parallax=False):
    r"""Move a catalogue to another epoch.

    Parameters
    ----------
    catalog : `~astropy.table.Table`
        As returned by `read_catalog`; a part of it better after `fill_motions`.
    epoch : float or `~astropy.time.Time`
        Julian year (TCB and TDB need not be told apart here).
    parallax : bool, optional
        Add the annual parallax as seen from the Earth's centre, so that the positions are
        *apparent* directions rather than barycentric ones.  Off by default; a calibration uses it.

    Returns
    -------
    catalog : `~astropy.table.Table`
        A copy with ``ra``, ``dec``, ``pmra``, ``pmdec`` and ``ref_epoch`` at the new epoch,
        position errors grown by the errors of the proper motion, and ``ra_pmra_corr`` and
        ``dec_pmdec_corr`` with them.  Stars without proper motion move with their neighbours (see
        `fill_motions`); where too few stars have one, and without an epoch, they stay put.

    Notes
    -----
    Linear motion in space on unit vectors (The Hipparcos and Tycho Catalogues, ESA SP-1200, vol. 1,
    sect. 1.5.5), with the radial velocity taken as zero:

    .. math::
        u(t) = \langle r + \mu\,t \rangle, \qquad \mu = \mu_{\alpha*} p + \mu_\delta q

    where r is the direction at the reference epoch, p and q the unit vectors towards East and
    North. It is exact at the poles and across RA 0.  The variance of a position grows on each axis
    by

    .. math::
        \sigma^2(t) = \sigma^2 + 2 \rho\,\sigma\,\sigma_\mu t + \sigma_\mu^2 t^2

    with the correlation :math:`\rho` of position and motion, zero where the catalogue gives none.
    An error that is not known counts as zero; columns of position errors are made where the
    catalogue has only those of the motions.  ``ra_dec_corr`` is left as it is.

    Of a parallax :math:`\varpi` with the error :math:`\sigma_\varpi` is used

    .. math::
        \varpi \left(1 - \sigma_\varpi^2 / \varpi^2\right) \quad
        \text{where } \varpi > \sigma_\varpi, \quad 0 \text{ elsewhere,}

    because most faint stars are farther than their parallaxes can tell, and a negative one is all
    noise.  Without an error, the parallax is used as it is.  The column keeps what was given.

    Examples
    --------
    >>> from astropy.table import Table
    >>> from wpdc_gwcs.catalogs import propagate, read_catalog
    >>> star = Table({"ra": [10.0], "dec": [60.0], "pmra": [1000.0], "pmdec": [0.0]})
    >>> star["ref_epoch"] = 2016.0
    >>> moved = propagate(read_catalog(star), 2026.0)
    >>> round(float(moved["ra"][0] - 10.0) * 3600, 4)  # 10 arcsec / cos(60 deg)
    20.0
    """
    epoch = float(getattr(epoch, "jyear", epoch))
    if not np.isfinite(epoch):
        raise ValueError(f"epoch must be a finite Julian year, got {epoch}")
    catalog = fill_motions(catalog)
    moved = catalog.copy()
    ra, dec = np.array(catalog["ra"], float), np.array(catalog["dec"], float)
    if {"pmra", "pmdec", "ref_epoch"} <= set(catalog.colnames):
        pmra, pmdec = np.array(catalog["pmra"], float), np.array(catalog["pmdec"], float)
        years = epoch - np.asarray(catalog["ref_epoch"], float)
        k = np.isfinite(pmra) & np.isfinite(pmdec) & np.isfinite(years)
        ra[k], dec[k], pmra[k], pmdec[k] = _space_motion(ra[k], dec[k], pmra[k], pmdec[k], years[k])
        moved["pmra"], moved["pmdec"] = _column("pmra", pmra), _column("pmdec", pmdec)
        for axis in ("ra", "dec"):
            for name, values in _grown_errors(catalog, axis, np.where(k, years, 0.0)).items():
                moved[name] = _column(name, values)
    if parallax and "parallax" in catalog.colnames:
        plx = _measured_parallax(catalog)
        k = np.isfinite(plx)
        ra[k], dec[k] = _annual_parallax(ra[k], dec[k], plx[k], epoch)
    moved["ra"], moved["dec"] = _column("ra", ra), _column("dec", dec)
    if "ref_epoch" in catalog.colnames:
        moved["ref_epoch"] = _column("ref_epoch", np.full(len(catalog), epoch))
    return moved


def select_cone(catalog, ra, dec, radius):
    """Select the part of a catalogue within a radius of a position.

    Parameters
    ----------
    catalog : `~astropy.table.Table`
        As returned by `read_catalog`.
    ra, dec : float
        Centre, deg.
    radius : float
        Radius, deg; the rim belongs to the cone.

    Returns
    -------
    catalog : `~astropy.table.Table`
        The rows inside, in their order.

    Examples
    --------
    >>> from astropy.table import Table
    >>> from wpdc_gwcs.catalogs import read_catalog, select_cone
    >>> catalog = read_catalog(Table({"ra": [359.9, 0.1, 180.0], "dec": [0.0, 0.0, 0.0]}))
    >>> len(select_cone(catalog, 0.0, 0.0, 0.2))
    2
    """
    if not (np.isfinite([ra, dec, radius]).all() and radius >= 0):
        raise ValueError(
            "the cone needs a finite centre and a radius >= 0, "
            f"got ra={ra}, dec={dec}, radius={radius}"
        )
    all_dec = np.asarray(catalog["dec"], float)
    # The band in declination leaves little for the trigonometry.
    near = np.flatnonzero(np.abs(all_dec - dec) <= radius)
    near_ra, near_dec = (
        np.radians(np.asarray(catalog["ra"], float)[near]),
        np.radians(all_dec[near]),
    )
    # Haversine, which keeps its accuracy at small separations.
    h = (
        np.sin(0.5 * (near_dec - np.radians(dec))) ** 2
        + np.cos(near_dec) * np.cos(np.radians(dec)) * np.sin(0.5 * (near_ra - np.radians(ra))) ** 2
    )
    inside = h <= np.sin(np.radians(min(radius, 180.0)) / 2) ** 2 * (1 + 1e-12)
    return catalog[near[inside]]


def _read_table(path, format):
    """Read a table from a file; a `CatalogError` whatever goes wrong."""
    path, extension = split_extension(path)
    try:
        if not path.exists():
            raise CatalogError(f"{path}: catalogue must be an existing file, found nothing there")
        if path.is_file() and path.stat().st_size == 0:
            raise CatalogError(f"{path}: catalogue must not be empty, the file has 0 bytes")
        # The readers warn of odd units and headers; what matters of that is checked afterwards.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if format in (None, "fits") and _is_fits(path):
                return _read_fits_table(path, extension)
            if extension is not None:
                raise CatalogError(f"{path}[{extension}]: only FITS files have extensions")
            if format is None and _FITS_NAME.search(path.name):
                raise CatalogError(
                    f"{path}: a FITS file must begin with 'SIMPLE  =', this one does not"
                )
            return Table.read(path, format=format or table_format(path))
    except CatalogError:
        raise
    except _READ_ERRORS as error:
        first_line = str(error).strip().split("\n")[0]
        raise CatalogError(
            f"{path}: cannot be read as a table: {type(error).__name__}: {first_line}"
        ) from error


def split_extension(path):
    """Split ``path[EXT]``; a file whose name really ends in brackets is left alone.

    Parameters
    ----------
    path : path-like
        What the user gave.

    Returns
    -------
    path : `~pathlib.Path`
        The file.
    extension : int, str or None
        Number or name of the extension.
    """
    text = str(path)
    found = re.fullmatch(r"(.+)\[([^\[\]]+)\]", text)
    if found is None or Path(text).exists():
        return Path(text), None
    extension = found[2].strip()
    return Path(found[1]), int(extension) if re.fullmatch("[0-9]{1,9}", extension) else extension


def _is_fits(path):
    with open(path, "rb") as file:
        start = file.read(9)
    name = path.name.lower()
    compressed = start[:2] == b"\x1f\x8b" and re.search(r"\.(fits?|fts|cat|ldac)\.gz$", name)
    return start == b"SIMPLE  =" or bool(compressed)


def table_format(path):
    """Name the format of a table for `astropy.table.Table.read`.

    Parameters
    ----------
    path : `~pathlib.Path`
        Its name decides.

    Returns
    -------
    format : str or None
        ``"ascii"``, astropy's guess, where the ending says nothing; `None` where astropy knows it.
    """
    suffixes = "".join(path.suffixes[-2:]).lower()
    for ending, name in _FORMATS:
        if ending in suffixes:
            return name
    return "ascii"


def _read_fits_table(path, extension):
    with fits.open(path, memmap=False) as hdus:
        if extension is not None:
            tables = [hdus[extension]]
            if not isinstance(tables[0], fits.BinTableHDU | fits.TableHDU):
                raise CatalogError(f"{path}[{extension}]: must be a table extension")
        else:
            tables = [h for h in hdus if isinstance(h, fits.BinTableHDU | fits.TableHDU)]
            if not tables:
                raise CatalogError(f"{path}: must have a table extension, has none")
            # LDAC files have a header table first, others whatever their writer liked.
            tables.sort(key=lambda h: _find_positions(h.columns.names) is None)
        return Table.read(tables[0], format="fits", mask_invalid=False)


def _table_of_coordinates(coordinates):
    icrs = coordinates.icrs.reshape(-1) if coordinates.isscalar else coordinates.icrs.ravel()
    table = Table({"ra": icrs.ra.deg, "dec": icrs.dec.deg})
    if "s" in coordinates.data.differentials:
        table["pmra"] = icrs.pm_ra_cosdec.to_value(u.mas / u.yr)
        table["pmdec"] = icrs.pm_dec.to_value(u.mas / u.yr)
        if coordinates.obstime is not None:
            table["ref_epoch"] = np.broadcast_to(coordinates.obstime.jyear, len(table))
    return table


def _standardize(table, name):
    """Build the checked table; `name` is what messages call the input."""
    if len(table) == 0:
        raise CatalogError(f"{name}: catalogue must have rows, has 0")
    names = _by_name(table.colnames)
    pair = _find_positions(table.colnames)
    if pair is None:
        raise CatalogError(
            f"{name}: catalogue must have columns 'ra' and 'dec' (or RA_ICRS/DE_ICRS, "
            "X_WORLD/Y_WORLD, ALPHA_J2000/DELTA_J2000, RAJ2000/DEJ2000, ra_deg/dec_deg), "
            f"has {_listed(table.colnames)}"
        )
    columns = {
        "ra": _values(table, pair[0], u.deg, u.deg, name, "an angle"),
        "dec": _values(table, pair[1], u.deg, u.deg, name, "an angle"),
    }
    keep = np.isfinite(columns["ra"]) & np.isfinite(columns["dec"])
    if not keep.any():
        raise CatalogError(
            f"{name}: catalogue must have rows with finite {pair[0]!r} and {pair[1]!r}, "
            f"none of {len(table)} has"
        )
    for column, low, high in ((pair[0], -360.0, 360.0), (pair[1], -90.0, 90.0)):
        values = columns["ra" if column == pair[0] else "dec"]
        wrong = keep & ((values < low) | (values > high))
        if wrong.any():
            row = int(np.flatnonzero(wrong)[0])
            raise CatalogError(
                f"{name}: column {column!r} must lie in [{low:g}, {high:g}] deg, "
                f"got {values[row]:g} in row {row}"
            )
    columns["ra"] = columns["ra"] % 360.0
    for column, (unit, aliases, default) in _OPTIONAL.items():
        found = _first(names, aliases)
        if found is not None:
            rule = "none" if unit == _NUMBER else f"convertible to {unit}"
            columns[column] = _values(table, found, unit, default, name, rule)
    _add_ellipse_errors(columns, table, names, name)
    found = _first(names, _MAGNITUDES)
    if found is not None:
        columns["phot_g_mean_mag"] = _floats(table[found], name, found)
    color = _colors(table, names, name)
    if color is not None:
        columns["bp_rp"] = color
    epoch = _epochs(table, names, pair, name, has_motion={"pmra", "pmdec"} <= set(columns))
    if epoch is not None:
        columns["ref_epoch"] = epoch
    result = Table({c: _column(c, np.ascontiguousarray(v[keep])) for c, v in columns.items()})
    if "source_id" in names and np.asarray(table[names["source_id"]]).dtype.kind in "iu":
        result["source_id"] = np.asarray(table[names["source_id"]])[keep]
    index = np.arange(len(table))
    if isinstance(table.meta.get(_MARK), str) and "catalog_index" in table.colnames:
        # What read_catalog returned, possibly cut since: its rows keep pointing to the first input.
        index = np.asarray(table["catalog_index"])
    result["catalog_index"] = index[keep]
    if "pm_from_neighbors" in names and table[names["pm_from_neighbors"]].dtype.kind == "b":
        # Else a second reading would take what has been filled for measured.
        result["pm_from_neighbors"] = np.asarray(table[names["pm_from_neighbors"]])[keep]
    result.meta[_MARK] = name
    return result


def _by_name(colnames):
    """Column of every lower-case name; an exact one before one in capitals."""
    return {c.lower(): c for c in reversed(colnames)} | {c: c for c in colnames}


def _find_positions(colnames):
    names = _by_name(colnames)
    for ra, dec in _POSITIONS:
        if ra in names and dec in names:
            return names[ra], names[dec]
    return None


def _first(names, aliases):
    return next((names[a] for a in aliases if a in names), None)


def _listed(colnames, most=12):
    shown = ", ".join(colnames[:most])
    return f"{shown}, ... ({len(colnames)} columns)" if len(colnames) > most else shown


def _floats(column, name, label):
    """Give a plain float64 array: masked and infinite values are NaN."""
    mask = getattr(column, "mask", None)
    column = getattr(column, "unmasked", column)
    column = getattr(column, "value", column)
    try:
        values = np.array(np.ma.getdata(column), dtype=float)
    except (TypeError, ValueError):
        raise CatalogError(
            f"{name}: column {label!r} must be numeric, got {str(np.ma.getdata(column)[0])!r}"
        ) from None
    if values.ndim != 1:
        raise CatalogError(
            f"{name}: column {label!r} must have one value a row, has {values.shape}"
        )
    if mask is not None:
        values[np.broadcast_to(mask, values.shape)] = np.nan
    values[~np.isfinite(values)] = np.nan
    return values


def _values(table, column, unit, default, name, rule):
    values = _floats(table[column], name, column)
    given = getattr(table[column], "unit", None)
    if given is None or given == u.dimensionless_unscaled:
        given = default
    if isinstance(given, u.UnrecognizedUnit):
        given = _forgiven_unit(given)
    if given == unit:
        return values
    try:
        factor = given.to(unit)
    except (u.UnitConversionError, u.UnitTypeError, AttributeError, ValueError):
        raise CatalogError(
            f"{name}: unit of column {column!r} must be {rule}, got {str(given)!r}"
        ) from None
    return values * factor


def _forgiven_unit(unit):
    """Read a unit that is not quite in the standard: ``degrees``, ``DEG``, ``mas/year``."""
    text = re.sub(r"milli-?arc-?sec(ond)?s?", "mas", unit.name.strip().lower())
    text = re.sub(r"\bdegrees?\b", "deg", re.sub(r"\byears?\b", "yr", text))
    try:
        return u.Unit(text)
    except ValueError:
        return unit


def _add_ellipse_errors(columns, table, names, name):
    """Errors of SExtractor and SCAMP: an ellipse, its angle counted from the RA axis."""
    if "ra_error" in columns:
        return
    for tag in ("psf", "win", ""):
        a, b, theta = f"erra{tag}_world", f"errb{tag}_world", f"errtheta{tag}_world"
        if a in names and b in names:
            major, minor = (
                _values(table, names[c], u.mas, u.deg, name, "an angle") for c in (a, b)
            )
            angle = np.zeros(len(table))
            if theta in names:
                angle = _values(table, names[theta], u.rad, u.deg, name, "an angle")
            c2, s2 = np.cos(angle) ** 2, np.sin(angle) ** 2
            columns["ra_error"] = np.sqrt(major**2 * c2 + minor**2 * s2)
            columns["dec_error"] = np.sqrt(major**2 * s2 + minor**2 * c2)
            return


def _colors(table, names, name):
    """Find the color of every star, or `None` where the table has neither it nor both bands."""
    found = _first(names, _COLORS)
    color = None if found is None else _floats(table[found], name, found)
    bands = [_first(names, aliases) for aliases in (_BLUE, _RED)]
    if None in bands:
        return color
    blue, red = (_floats(table[band], name, band) for band in bands)
    return blue - red if color is None else np.where(np.isnan(color), blue - red, color)


def _epochs(table, names, pair, name, has_motion):
    """Find the reference epoch of every row, or `None` where none is known and none is needed."""
    found = _first(names, _EPOCHS)
    epochs = None
    if found is not None:
        epochs = _julian_years(table, found, name)
    fallback = _epoch_of_metadata(table, pair)
    if epochs is None and fallback is not None:
        epochs = np.full(len(table), fallback)
    if epochs is None and has_motion:
        warnings.warn(
            f"{name}: proper motions without a reference epoch: {_ASSUMED_EPOCH} (Gaia DR3) is "
            "assumed; a column 'ref_epoch' would say",
            WPDCWarning,
        )
        epochs = np.full(len(table), _ASSUMED_EPOCH)
    if epochs is not None and fallback is not None:
        epochs = np.where(np.isfinite(epochs), epochs, fallback)
    return epochs


def _julian_years(table, column, name):
    values = _floats(table[column], name, column)
    known = values[np.isfinite(values)]
    if known.size == 0:
        return None
    # Julian dates and modified ones occur (Pan-STARRS); no catalogue is from before the year 1000.
    if known.min() > 2.3e6:
        values = 2000.0 + (values - 2451545.0) / 365.25
    elif known.min() > 10000.0:
        values = 2000.0 + (values - 51544.5) / 365.25
    known = values[np.isfinite(values)]
    for extreme in (known.min(), known.max()):
        if not 1800.0 <= extreme <= 2200.0:
            raise CatalogError(
                f"{name}: column {column!r} must be a Julian year between 1800 and 2200, "
                f"got {extreme:g}"
            )
    return values


def _epoch_of_metadata(table, pair):
    meta = {str(k).lower().replace("-", "_"): v for k, v in table.meta.items()}
    for key in ("ref_epoch", "refepoch", "epoch"):
        found = re.fullmatch(r"\s*J?(\d{4}(?:\.\d*)?)\s*", str(meta.get(key, "")))
        if found and 1800.0 <= float(found[1]) <= 2200.0:
            return float(found[1])
    description = str(getattr(table[pair[0]], "description", "") or "")
    found = re.search(r"\b[Ee]p(?:och)?\s*=?\s*J?(\d{4}(?:\.\d+)?)", description)
    if found:
        return float(found[1])
    text = " ".join(f"{k} {v}" for k, v in meta.items() if isinstance(v, str | list))
    for pattern, epoch in _GAIA_EPOCHS:
        if re.search(pattern.pattern, text, re.IGNORECASE):
            return epoch
    return None


def _column(name, values):
    return Column(values, unit=_UNITS.get(name))


def _directions(ra, dec):
    """Give unit vectors towards the star, East and North, each (3, N)."""
    a, d = np.radians(ra), np.radians(dec)
    ca, sa, cd, sd = np.cos(a), np.sin(a), np.cos(d), np.sin(d)
    zero = np.zeros_like(ca)
    return (
        np.stack([cd * ca, cd * sa, sd]),
        np.stack([-sa, ca, zero]),
        np.stack([-sd * ca, -sd * sa, cd]),
    )


def _angles(vector):
    x, y, z = vector
    return np.degrees(np.arctan2(y, x)) % 360.0, np.degrees(np.arctan2(z, np.hypot(x, y)))


def _space_motion(ra, dec, pmra, pmdec, years):
    r, east, north = _directions(ra, dec)
    mas = np.pi / 180.0 / 3.6e6
    motion = (pmra * east + pmdec * north) * mas
    later = r + motion * years
    length = np.sqrt((later**2).sum(axis=0))
    new = later / length
    new_ra, new_dec = _angles(new)
    # The motion at the new epoch, so that moving on or back starts from there.
    motion = (motion - new * (new * motion).sum(axis=0)) / length
    _, east, north = _directions(new_ra, new_dec)
    return (
        new_ra,
        new_dec,
        (motion * east).sum(axis=0) / mas,
        (motion * north).sum(axis=0) / mas,
    )


def _motion_of_neighbors(catalog, motion, known, rows):
    """Median motion of the known stars nearest to each of some stars, and its error, (2, rows)."""
    r, east, north = _directions(
        np.asarray(catalog["ra"], float), np.asarray(catalog["dec"], float)
    )
    # In space, because East is not the same direction everywhere.
    vectors = (motion[0, known] * east[:, known] + motion[1, known] * north[:, known]).T
    tree = cKDTree(r[:, known].T)
    n = min(_NEIGHBORS, len(vectors))
    median, scatter = np.empty((2, len(rows))), np.empty((2, len(rows)))
    for start in range(0, len(rows), _BLOCK):
        block = slice(start, start + _BLOCK)
        near = vectors[tree.query(r[:, rows[block]].T, k=n)[1]]
        for k, axis in enumerate((east, north)):
            values = np.einsum("snc,cs->sn", near, axis[:, rows[block]])
            median[k, block] = np.median(values, axis=1)
            scatter[k, block] = mad_std(values, axis=1)
    return median, scatter * n / (n - 0.8) * np.sqrt(1 + np.pi / 2 / n)


def _grown_errors(catalog, axis, years):
    """Error of the position on one axis and its correlation with the motion, `years` later.

    What is unknown counts as zero, so that an unknown error of the position does not hide what the
    motion adds to it; the sum is NaN where nothing is known.
    """
    error, motion_error, correlation = f"{axis}_error", f"pm{axis}_error", f"{axis}_pm{axis}_corr"
    if motion_error not in catalog.colnames:
        return {}
    given = _floats_or_nan(catalog, error)
    position, motion = np.nan_to_num(given), np.nan_to_num(_floats_or_nan(catalog, motion_error))
    rho = np.clip(np.nan_to_num(_floats_or_nan(catalog, correlation)), -1.0, 1.0)
    growth = motion * years
    # Rounding must not make it negative where rho is -1.
    variance = np.maximum(position**2 + 2 * rho * position * growth + growth**2, 0.0)
    later = np.where(np.isnan(given) & (growth == 0), np.nan, np.sqrt(variance))
    # The position has taken up the error of the motion: moving back gives the first error again.
    product = np.nan_to_num(later) * motion
    with np.errstate(invalid="ignore", divide="ignore"):
        rho = np.where(product > 0, (rho * position * motion + motion * growth) / product, rho)
    return {error: later, correlation: rho}


def _floats_or_nan(catalog, name):
    """Give a column as floats, NaN where the table does not have it."""
    if name not in catalog.colnames:
        return np.full(len(catalog), np.nan)
    return np.array(catalog[name], float)


def _measured_parallax(catalog):
    """Parallax less what may be its noise.

    Stars at exp(-p / 0.4 mas) with errors of 0.05 to 1 mas, log-uniform: it leaves 0.29 mas rms,
    the parallaxes as they are 0.41, those above three errors alone 0.36, none at all 0.56.  With
    errors of 0.5 to 1 mas: 0.51, 0.76, 0.55 and 0.56.
    """
    parallax = np.array(catalog["parallax"], float)
    error = np.nan_to_num(_floats_or_nan(catalog, "parallax_error"))
    noisy = error > 0
    above = noisy & (parallax > error)
    parallax[noisy & (parallax <= error)] = 0.0
    parallax[above] -= error[above] ** 2 / parallax[above]
    return parallax


def _annual_parallax(ra, dec, parallax, epoch):
    # erfa's Earth needs no ephemeris file, hence no network.
    import erfa

    barycentric = erfa.epv00(2451545.0, (epoch - 2000.0) * 365.25)[1]["p"]
    r, _, _ = _directions(ra, dec)
    mas = np.pi / 180.0 / 3.6e6
    return _angles(r - parallax * mas * np.asarray(barycentric)[:, None])
