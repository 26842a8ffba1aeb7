"""Table files of any format: those that astropy reads, and those that it stumbles over."""

import bz2
import csv
import gzip
import lzma
import os
import re
import stat
import struct
import zlib
from pathlib import Path
from xml.parsers.expat import ExpatError

from astropy.io import fits
from astropy.io.ascii import InconsistentTableError
from astropy.io.ascii.cparser import CParserError
from astropy.io.ascii.ipac import IpacFormatError, IpacFormatErrorDBMS
from astropy.io.registry import IORegistryError
from astropy.table import Table
from astropy.table.meta import YamlParseError
from astropy.table.mixins.registry import MixinRegistryError
from astropy.units import UnitsError
from yaml import YAMLError

from wpdc_gwcs.catalogs.parquet import read_parquet
from wpdc_gwcs.catalogs.positions import find_positions
from wpdc_gwcs.columns import spelled_names
from wpdc_gwcs.exceptions import CatalogError

__all__ = [
    "READ_ERRORS",
    "choose_table",
    "csv_form",
    "decode",
    "is_fits",
    "open_any",
    "parse_csv",
    "parse_ecsv",
    "plain_name",
    "read_lines",
    "read_table_file",
    "special_file",
    "split_extension",
]

# What astropy, asdf, the decompressors and the parsers raise on damaged or foreign files.
READ_ERRORS = (
    OSError,
    EOFError,
    ValueError,
    TypeError,
    LookupError,
    AttributeError,
    RuntimeError,
    ArithmeticError,
    AssertionError,
    ImportError,
    MemoryError,
    ReferenceError,
    CParserError,
    ExpatError,
    IORegistryError,
    IpacFormatError,
    IpacFormatErrorDBMS,
    MixinRegistryError,
    UnitsError,
    YAMLError,
    YamlParseError,
    csv.Error,
    fits.VerifyError,
    lzma.LZMAError,
    struct.error,
    zlib.error,
)
# Suffixes of tables that are not plain text: astropy identifies these itself.
_FOREIGN = re.compile(r"\.(vot|votable|xml|h5|hdf5|html?|asdf|mrt|feather)$")
_OPENERS = ((b"\x1f\x8b", gzip.open), (b"BZh", bz2.open), (b"\xfd7zXZ\x00", lzma.open))
# Characters that do not occur in text.
_BINARY = re.compile(rb"[\x00-\x08\x0e-\x1a\x1c-\x1f]")
_MARKS = (
    (b"\xef\xbb\xbf", "utf-8-sig"),
    (b"\xff\xfe\x00\x00", "utf-32"),
    (b"\xff\xfe", "utf-16"),
    (b"\xfe\xff", "utf-16"),
)
# Words that mean "no value" in any column; other words may be names.
_FILL = [(t, "0") for t in ("", "null", "NULL", "Null", "--", "---", "N/A", "n/a", "\\N")]


def split_extension(path):
    """Split ``path[EXT]``; a file whose name really ends in brackets is kept.

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

    Examples
    --------
    >>> from wpdc_gwcs.catalogs import split_extension
    >>> path, extension = split_extension("night1/a.fits[SCI]")
    >>> path.name, extension
    ('a.fits', 'SCI')
    >>> split_extension("a.fits[2]")[1], split_extension("a.fits")[1]
    (2, None)
    """
    text = str(path)
    found = re.fullmatch(r"(.+)\[([^\[\]]+)\]", text)
    if found is None or Path(text).exists():
        return Path(text), None
    extension = found[2].strip()
    return Path(found[1]), int(extension) if re.fullmatch("[0-9]{1,9}", extension) else extension


def special_file(path):
    """Tell what a path is if it is not a file: reading it might block for ever or never end.

    Parameters
    ----------
    path : path-like
        The path.

    Returns
    -------
    what : str or None
        For messages, such as ``a folder`` or ``a pipe``; `None` for a file or a missing path.

    Examples
    --------
    >>> import tempfile
    >>> from wpdc_gwcs.catalogs import special_file
    >>> special_file(tempfile.mkdtemp()), special_file("no-such-file.fits")
    ('a folder', None)
    """
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        return None
    kinds = {
        stat.S_ISDIR: "a folder",
        stat.S_ISFIFO: "a pipe",
        stat.S_ISSOCK: "a socket",
        stat.S_ISCHR: "a device",
        stat.S_ISBLK: "a device",
    }
    return next((what for is_kind, what in kinds.items() if is_kind(mode)), None)


def is_fits(path):
    """Return whether a file is FITS, compressed as a whole or not.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    bool
        True if its first bytes are those of FITS.

    Examples
    --------
    >>> import gzip
    >>> import tempfile
    >>> from pathlib import Path
    >>> from wpdc_gwcs.catalogs import is_fits
    >>> path = Path(tempfile.mkdtemp()) / "stars.dat"
    >>> size = path.write_bytes(gzip.compress(b"SIMPLE  =                    T" + 50 * b" "))
    >>> is_fits(path)
    True
    """
    with open_any(path) as file:
        return file.read(9) == b"SIMPLE  ="


def choose_table(hdus, path, extension=None):
    """Choose the table of stars of a FITS file.

    Parameters
    ----------
    hdus : `~astropy.io.fits.HDUList`
        The file.
    path : path-like
        Name of the file in messages.
    extension : int or str, optional
        The extension to use; by default the first table that has positions.

    Returns
    -------
    HDU
        A table.

    Raises
    ------
    CatalogError
        If there is none.
    """
    kinds = fits.BinTableHDU | fits.TableHDU
    if extension is not None:
        if not isinstance(hdus[extension], kinds):
            raise CatalogError(f"{path}[{extension}]: must be a table extension")
        return hdus[extension]
    tables = [h for h in hdus if isinstance(h, kinds)]
    if not tables:
        raise CatalogError(f"{path}: must have a table extension, has none")
    # LDAC files begin with a header table; other files have tables in any order.
    tables.sort(key=lambda h: find_positions(spelled_names(h.columns.names)) is None)
    return tables[0]


def read_table_file(path, format=None):
    r"""Read a table that is not FITS.

    Parameters
    ----------
    path : path-like
        Text in any form that astropy knows (also compressed, with a byte-order mark, in latin-1),
        VOTable, HDF5, Parquet, HTML, ASDF.
    format : str, optional
        Format name for `astropy.table.Table.read`; by default found from name and content.

    Returns
    -------
    `~astropy.table.Table`
        The table; words that mean "no value" (``null``, ``--``) are masked.

    Raises
    ------
    one of READ_ERRORS
        If the file cannot be read.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from wpdc_gwcs.catalogs import read_table_file
    >>> path = Path(tempfile.mkdtemp()) / "stars.csv"
    >>> size = path.write_text("ra,dec,pmra\n10,20,1.5\n11,21,null\n")
    >>> read_table_file(path)["pmra"].tolist()
    [1.5, None]
    """
    # Absolute, because astropy expands a leading '~'.
    path = Path(path).absolute()
    text_format = format is not None and format.startswith("ascii")
    if format is not None and not text_format:
        return Table.read(path, format=format)
    if re.search(r"\.(parquet|pq)$", plain_name(path)):
        return read_parquet(path)
    if not text_format and _FOREIGN.search(plain_name(path)):
        return Table.read(path, format="votable" if ".vot" in path.name.lower() else None)
    lines = read_lines(path)
    if not any(line.strip() for line in lines):
        raise ValueError("it has no text")
    if format is None and re.match(r"\s*(<\?xml|<VOTABLE)", "\n".join(lines[:2]), re.IGNORECASE):
        return Table.read(path, format="votable")
    if text_format:
        return Table.read(lines, format=format, fill_values=_FILL)
    if lines[0].startswith("# %ECSV"):
        return parse_ecsv(lines)
    if plain_name(path).endswith((".csv", ".tsv")):
        return _read_csv(lines)
    try:
        return Table.read(lines, format="ascii", fill_values=_FILL)
    except InconsistentTableError as problem:
        # astropy lists all that it has tried, in fifty lines
        raise ValueError("it is not a table in any known format") from problem


def read_lines(path):
    r"""Read the lines of a text file.

    Parameters
    ----------
    path : path-like
        Compressed or not, in UTF-8, with a byte-order mark, or in latin-1.

    Returns
    -------
    list of str
        Lines without their ends.

    Raises
    ------
    one of READ_ERRORS
        If the file cannot be read or is not text.

    Examples
    --------
    >>> import gzip
    >>> import tempfile
    >>> from pathlib import Path
    >>> from wpdc_gwcs.catalogs import read_lines
    >>> path = Path(tempfile.mkdtemp()) / "stars.txt.gz"
    >>> size = path.write_bytes(gzip.compress("# M\xfcnchen\nra dec\n".encode("latin-1")))
    >>> read_lines(path)
    ['# München', 'ra dec']
    """
    with open_any(path) as file:
        return decode(file.read()).splitlines()


def open_any(path):
    """Open a file to read bytes, whether it is compressed or not.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    file object
        Yields the decompressed bytes.
    """
    with open(path, "rb") as file:
        start = file.read(6)
    return next((opener for mark, opener in _OPENERS if start.startswith(mark)), open)(path, "rb")


def plain_name(path):
    """Return the name of a file in lower case, without the suffix of its compression.

    Parameters
    ----------
    path : `~pathlib.Path`
        The file.

    Returns
    -------
    str
        For example ``gaia.csv`` for ``Gaia.csv.gz``.
    """
    return re.sub(r"\.(gz|bz2|xz)$", "", path.name.lower())


def decode(content):
    """Decode bytes to text.

    Parameters
    ----------
    content : bytes
        In UTF-8, with a byte-order mark, or in latin-1.

    Returns
    -------
    str
        The text.

    Raises
    ------
    ValueError
        If the bytes are not text.
    """
    encoding = next((e for mark, e in _MARKS if content.startswith(mark)), "utf-8")
    if encoding.startswith("utf-8") and _BINARY.search(content):
        raise ValueError("it is neither text nor a table of a known format")
    try:
        return content.decode(encoding)
    except UnicodeDecodeError:
        return content.decode("latin-1")


def csv_form(head, first):
    """Find the delimiter of CSV and its line of column names, which may be a comment.

    Parameters
    ----------
    head : list of str
        Comment lines before it.
    first : str
        First line that is not a comment.

    Returns
    -------
    delimiter : str
        One of ``,;|`` and the tab.
    names : str
        Line with the column names: the first line, unless a comment has them.
    """
    delimiter = max(",;\t|", key=first.count)
    if head and head[-1].count(delimiter) == first.count(delimiter) > 0:
        names = head[-1].lstrip("# ").split(delimiter)
        # a comment has the names if the first row has numbers
        if any(re.match(r"[-+]?\d", cell.strip()) for cell in first.split(delimiter)) and all(
            re.match(r"[A-Za-z_]", cell.strip(' "')) for cell in names
        ):
            return delimiter, head[-1].lstrip("# ")
    return delimiter, first


def parse_csv(lines, delimiter):
    """Parse CSV.

    Parameters
    ----------
    lines : list of str
        Names and rows.
    delimiter : str
        Separator of the cells.

    Returns
    -------
    `~astropy.table.Table`
        The table.
    """
    return Table.read(lines, format="ascii.csv", delimiter=delimiter, fill_values=_FILL)


def _read_csv(lines):
    """Read CSV with any delimiter and leading comments, one of which may have the names."""
    comments = next((k for k, line in enumerate(lines) if not line.startswith("#")), 0)
    head, rows = lines[:comments], [line for line in lines[comments:] if line.strip()]
    delimiter, names = csv_form(head, rows[0])
    return parse_csv(rows if names is rows[0] else [names, *rows], delimiter)


def parse_ecsv(lines):
    """Parse ECSV; if a cell contradicts the header, read the cells as text, with its units.

    Parameters
    ----------
    lines : list of str
        Header, names and rows.

    Returns
    -------
    `~astropy.table.Table`
        The table.
    """
    try:
        return Table.read(lines, format="ascii.ecsv", fill_values=_FILL)
    except ValueError:
        head = [line for line in lines if line.startswith("#")]
        rows = [line for line in lines if not line.startswith("#")]
        found = re.search(r"delimiter: *['\"]?([^'\"\s])", "\n".join(head))
        delimiter = found[1] if found else " "
        declared = Table.read([*head, rows[0]], format="ascii.ecsv")
        table = Table.read(rows, format="ascii.basic", delimiter=delimiter, fill_values=_FILL)
        for name in set(declared.colnames) & set(table.colnames):
            table[name].unit = getattr(declared[name], "unit", None)
        table.meta.update(declared.meta)
        return table
