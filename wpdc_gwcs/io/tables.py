"""Tables of matches, sources and frames as ECSV, written in one step and fast."""

import io
import re
import warnings
from pathlib import Path

import numpy as np
from astropy.table import Table

from wpdc_gwcs.catalogs import read_table_file
from wpdc_gwcs.columns import listed
from wpdc_gwcs.exceptions import FileFormatError
from wpdc_gwcs.io.files import (
    READ_ERRORS,
    as_utf8,
    atomic_path,
    check_suffix,
    file_kind,
    first_line,
)

__all__ = ["read_matches", "read_table", "write_table"]


# Characters that require quotes around a field.
_SPECIAL = re.compile(r'[\s"#]')


def write_table(table, path, *, overwrite=False):
    """Write a table of matches, sources or frames as ECSV.

    Parameters
    ----------
    table : `~astropy.table.Table`
        Table with columns of numbers and strings.
    path : path-like
        File to write.
    overwrite : bool, optional
        Whether an existing file may be replaced.

    Raises
    ------
    OutputExistsError
        If the file exists and may not be replaced.
    InputError
        If the file cannot be written, or its suffix belongs to another format.

    Notes
    -----
    The header is written by astropy.  The rows are written here, in less than half the time, and
    with enough digits to read every float back exactly.

    Examples
    --------
    >>> import tempfile
    >>> from astropy.table import Table
    >>> from wpdc_gwcs.io import read_table, write_table
    >>> path = f"{tempfile.mkdtemp()}/stars.ecsv"
    >>> write_table(Table({"x": [0.1 + 0.2], "used": [True]}), path)
    >>> bool(read_table(path)["x"][0] == 0.1 + 0.2)  # to the last digit
    True
    """
    check_suffix(path, "ecsv")
    plain = Table(table, copy=False)
    if (
        any(getattr(column, "ndim", 0) != 1 for column in plain.itercols())
        or plain.has_masked_values
    ):
        text = _text_of(plain)
    else:
        # The only header line that is not a comment has the names of the columns.
        text = _text_of(plain[:0]) + _rows_of(plain)
    with atomic_path(path, overwrite=overwrite) as temporary:
        temporary.write_text(as_utf8(text), encoding="utf-8")


def read_table(path, *, columns=()):
    r"""Read a table that was written by `write_table`, or any other table that astropy can read.

    Parameters
    ----------
    path : path-like
        File in ECSV, CSV, FITS, ...; name and content show the format.
    columns : sequence of str, optional
        Columns that must exist and be numeric or boolean.

    Returns
    -------
    table : `~astropy.table.Table`
        The table.

    Raises
    ------
    FileFormatError
        If the file is missing, empty or damaged, or lacks a column.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from wpdc_gwcs.io import read_table
    >>> path = Path(tempfile.mkdtemp()) / "stars.csv"
    >>> size = path.write_text("x,y\n10.5,20.25\n30,40\n")
    >>> read_table(path, columns=["x", "y"])["y"].tolist()
    [20.25, 40.0]
    >>> read_table(path, columns=["x", "flux"])
    Traceback (most recent call last):
        ...
    wpdc_gwcs.exceptions.FileFormatError: ...stars.csv: table must have a column 'flux', ...
    """
    path = Path(path)
    kind = file_kind(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if kind == "fits":
                table = Table.read(path.absolute(), format="fits")
            else:
                table = read_table_file(path)
    except READ_ERRORS as problem:
        raise FileFormatError(f"{path}: not a readable table: {first_line(problem)}") from problem
    for column in columns:
        if column not in table.colnames:
            raise FileFormatError(
                f"{path}: table must have a column {column!r}, has {listed(table.colnames)}"
            )
        if table[column].dtype.kind not in "biuf":
            raise FileFormatError(
                f"{path}: column {column!r} must be numeric, is {table[column].dtype}"
            )
    return table


def read_matches(path):
    """Read the match table of a frame.

    Parameters
    ----------
    path : path-like
        File ``<stem>.matches.ecsv``.

    Returns
    -------
    matches : `~astropy.table.Table`
        The table, with at least the columns ``x``, ``y``, ``dx``, ``dy``, ``used`` and ``holdout``.

    Raises
    ------
    FileFormatError
        If the file is missing, empty or damaged, or lacks a column.

    Examples
    --------
    >>> import tempfile
    >>> from wpdc_gwcs import Settings, calibrate, simulate
    >>> from wpdc_gwcs.io import read_matches
    >>> sky = simulate(1, image_shape=(256, 256), density=120, distortion=2, seed=1)
    >>> frames, folder = [sky.exposures[0].frame()], tempfile.mkdtemp()
    >>> run = calibrate(frames, sky.reference, settings=Settings(lut="none"), output=folder)
    >>> matches = read_matches(f"{folder}/sim-01.matches.ecsv")
    >>> len(matches) == int(run.summary["n_matched"][0]), str(matches["dx"].unit)
    (True, 'pix')
    """
    return read_table(path, columns=("x", "y", "dx", "dy", "used", "holdout"))


def _text_of(table):
    buffer = io.StringIO()
    table.write(buffer, format="ascii.ecsv")
    return buffer.getvalue()


def _rows_of(table):
    columns = [_cells(column) for column in table.itercols()]
    return "".join(" ".join(row) + "\n" for row in zip(*columns, strict=True))


def _cells(column):
    values = np.asarray(column)
    if values.dtype.kind == "f" and values.dtype.itemsize == 8:
        # The shortest text that reads back to the same number.
        return map(repr, values.tolist())
    if values.dtype.kind in "biuf":
        return values.astype(str).tolist()
    return [_quoted(str(value)) for value in values.tolist()]


def _quoted(text):
    if text and not _SPECIAL.search(text):
        return text
    return '"' + text.replace('"', '""') + '"'
