"""Large catalog files: the rows of a region, read piece by piece.

::

    file --> pieces: positions first, then the other columns of the selected rows --> one table

Only one piece and the selected rows are in memory, never the whole file.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice

import numpy as np
from astropy.io import fits
from astropy.table import Table, vstack

from wpdc_gwcs.catalogs.files import (
    choose_table,
    csv_form,
    decode,
    open_any,
    parse_csv,
    parse_ecsv,
    plain_name,
)
from wpdc_gwcs.catalogs.parquet import parquet_groups
from wpdc_gwcs.catalogs.positions import plain_degrees

__all__ = ["Part", "parquet_pieces", "part_of", "pieces_of"]

# Smaller files (bytes) are read whole: they need little memory.
_LARGE = 2**25
# Rows per piece.
_PIECE = 50_000
# Above this fraction of impossible positions, the column is wrong, not the rows.
_MOST_WRONG = 0.5


@dataclass(frozen=True, eq=False)
class Piece:
    """Some rows of a file.

    Parameters
    ----------
    positions : `~astropy.table.Table`
        The rows, with at least the columns of their positions.
    take : callable
        Returns the table of the rows that a mask selects.
    """

    positions: Table
    take: Callable


@dataclass(frozen=True, eq=False)
class Part:
    """The rows of a region.

    Parameters
    ----------
    table : `~astropy.table.Table`
        The rows, with all columns.
    rows : (N,) ndarray of int
        Their row numbers in the file.
    n_rows, n_wrong : int
        Number of rows in the file, and of those with impossible positions.
    """

    table: Table
    rows: np.ndarray
    n_rows: int
    n_wrong: int


def pieces_of(path, extension, known):
    """Return the pieces of a file.

    Parameters
    ----------
    path : `~pathlib.Path`
        The file.
    extension : int, str or None
        Extension of a FITS file.
    known : set of str
        Names of columns, in lower case, that may be wanted.

    Returns
    -------
    iterator of Piece or None
        `None` if the file is small, or its format has to be read whole.
    """
    if path.stat().st_size < _LARGE:
        return None
    with open(path, "rb") as file:
        start = file.read(6)
    if start == b"SIMPLE":
        return _fits_pieces(path, extension)
    if extension is not None:
        return None
    if start.startswith(b"PAR1"):
        return parquet_pieces([path], known)
    if re.search(r"\.(csv|tsv|ecsv)$", plain_name(path)):
        return _text_pieces(path)
    return None


def part_of(pieces, region, *, sure=False):
    """Gather the rows of a region.

    Parameters
    ----------
    pieces : iterable of Piece
        As returned by `pieces_of`.
    region : Region
        Part of the sky to select.
    sure : bool, optional
        Whether positions without a unit are known to be degrees.

    Returns
    -------
    Part or None
        `None` if one piece does not tell what the positions are: text, possible radians, another
        equinox, or no positions at all.
    """
    taken, rows, total, wrong = [], [], 0, 0
    told = sure
    for piece in pieces:
        found = plain_degrees(piece.positions)
        if found is None:
            return None
        ra, dec, clear = found
        told |= clear
        known = np.isfinite(ra) & np.isfinite(dec)
        off = known & ((np.abs(ra) > 360) | (np.abs(dec) > 90))
        wrong += int(off.sum())
        inside = np.zeros(len(ra), bool)
        good = np.flatnonzero(known & ~off)
        inside[good] = region.contains(ra[good], dec[good])
        if inside.any():
            taken.append(piece.take(inside))
            rows.append(total + np.flatnonzero(inside))
        total += len(ra)
    if not told or wrong > _MOST_WRONG * total:
        return None
    if not taken:
        return Part(Table(), np.zeros(0, int), total, wrong)
    return Part(_stacked(taken), np.concatenate(rows), total, wrong)


def _stacked(tables):
    """Stack tables; a column that is text in one of them becomes text."""
    for name in tables[0].colnames:
        kinds = {t[name].dtype.kind for t in tables if name in t.colnames}
        if kinds & set("USO") and kinds - set("USO"):
            for table in tables:
                column = table[name]
                text = column.astype(str)
                table[name] = text.filled("") if hasattr(text, "filled") else text
    return vstack(tables, metadata_conflicts="silent")


def parquet_pieces(paths, known):
    """Return the pieces of Parquet files.

    Parameters
    ----------
    paths : iterable of `~pathlib.Path`
        The files, one after the other.
    known : set of str
        Names of columns, in lower case, that may be wanted.

    Returns
    -------
    iterator of Piece
        One for each row group.
    """
    return (Piece(*group) for group in parquet_groups(paths, known))


def _fits_pieces(path, extension):
    with fits.open(path) as hdus:
        hdu = choose_table(hdus, path, extension)
        heap = any(re.match(r"\d*[PQ]", form) for form in getattr(hdu.columns, "formats", ()))
        if heap or not isinstance(hdu, fits.BinTableHDU):
            return None
        header, start = hdu.header.copy(), hdu.fileinfo()["datLoc"]
    return _rows_of_fits(path, header, start)


def _rows_of_fits(path, header, start):
    width, n_rows = header["NAXIS1"], header["NAXIS2"]
    with open(path, "rb") as file:
        file.seek(start)
        for first in range(0, n_rows, _PIECE):
            # Read, not memory-mapped: mapped pages would count as memory of this process.
            header["NAXIS2"] = min(_PIECE, n_rows - first)
            block = file.read(width * header["NAXIS2"])
            if len(block) < width * header["NAXIS2"]:
                raise OSError("the file is truncated")
            hdu = fits.BinTableHDU.fromstring(header.tostring().encode("latin-1") + block)
            table = Table.read(hdu, format="fits", mask_invalid=False)
            yield Piece(table, table.__getitem__)


def _text_pieces(path):
    with open_any(path) as file:
        start = file.peek(4)[:4]
        if start.startswith((b"\xff\xfe", b"\xfe\xff")):
            return None
    return _rows_of_text(path)


def _rows_of_text(path):
    with open_any(path) as file:
        head, first = [], b""
        for first in file:
            if first.strip() and not first.lstrip(b"\xef\xbb\xbf").startswith(b"#"):
                break
            head.append(first)
        lines = decode(b"".join([*head, first])).splitlines()
        head, first = lines[:-1], lines[-1]
        if head and head[0].startswith("# %ECSV"):
            parse, pending = (lambda rows: parse_ecsv([*head, first, *rows])), []
        else:
            delimiter, names = csv_form(head, first)
            pending = [] if names is first else [first]
            parse = lambda rows: parse_csv([names, *rows], delimiter)  # noqa: E731
        while block := list(islice(file, _PIECE)):
            text = b"".join(block)
            if text.count(b'"') % 2:
                # A quoted field continues on the next line, perhaps in the next piece.
                yield Piece(Table(), None)
                return
            rows = pending + [line for line in decode(text).splitlines() if line.strip()]
            pending = []
            if rows:
                table = parse(rows)
                yield Piece(table, table.__getitem__)
