"""Parquet tables, read with pyarrow alone."""

from functools import partial

import numpy as np
from astropy.table import MaskedColumn, Table
from astropy.table.meta import get_header_from_yaml, get_yaml_from_table

from wpdc_gwcs.exceptions import CatalogError
from wpdc_gwcs.extras import require

__all__ = ["LazyColumns", "parquet_groups", "read_parquet", "write_parquet"]


class LazyColumns:
    """Columns that are read on first access.

    Parameters
    ----------
    names : list of str
        Their names.
    read : callable
        Returns the column with a given name.
    meta : dict
        Metadata of the table.
    """

    def __init__(self, names, read, meta):
        self.colnames = names
        self.meta = meta
        self._read = read

    def __getitem__(self, name):
        return self._read(name)


def read_parquet(path):
    """Read a Parquet file.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    `~astropy.table.Table`
        All columns, with units if astropy wrote the file.

    Raises
    ------
    CatalogError
        If pyarrow is not installed.
    """
    require(path, "hats", "pyarrow", error=CatalogError)
    from pyarrow import parquet

    with parquet.ParquetFile(path) as file:
        return _arrow_table(file.read(), _astropy_header(file.schema_arrow.metadata))


def write_parquet(table, path):
    """Write a table, with units as astropy writes them.

    Parameters
    ----------
    table : `~astropy.table.Table`
        Table of plain columns.
    path : path-like
        File to write.
    """
    import pyarrow
    from pyarrow import parquet

    columns = {}
    for name in table.colnames:
        values = np.asarray(table[name])
        columns[name] = values.astype(values.dtype.newbyteorder("="))
    text = "\n".join(get_yaml_from_table(table)).encode()
    arrow = pyarrow.table(columns).replace_schema_metadata({"table_meta_yaml": text})
    parquet.write_table(arrow, path)


def parquet_groups(paths, known):
    """Yield the row groups of Parquet files.

    Parameters
    ----------
    paths : iterable of `~pathlib.Path`
        The files, in this order.
    known : set of str
        Names of the columns that may be needed, in lower case.

    Yields
    ------
    positions : LazyColumns
        Numeric columns, read on first access.
    take : callable
        Returns the table of the rows that a mask selects.
    """
    from pyarrow import parquet

    for path in paths:
        with parquet.ParquetFile(path) as file:
            names = [n for n in file.schema_arrow.names if n.lower() in known]
            about = _astropy_header(file.schema_arrow.metadata)
            for group in range(file.num_row_groups):
                read = partial(_parquet_rows, file, group, about)
                empty = _arrow_table(file.schema_arrow.empty_table().select(names), about)
                columns = [n for n in names if empty[n].dtype.kind in "fiu"]
                lazy = LazyColumns(columns, lambda name, read=read: read([name])[name], empty.meta)
                yield lazy, partial(read, names)


def _parquet_rows(file, group, about, names, mask=None):
    """Columns of a row group, one by one: decoded all at once, they would be large."""
    import pyarrow

    keep = None if mask is None else pyarrow.array(mask)
    columns = {}
    for name in names:
        column = file.read_row_group(group, columns=[name])[name]
        columns[name] = column if keep is None else column.filter(keep)
    return _arrow_table(pyarrow.table(columns), about)


def _arrow_table(arrow, about):
    """Astropy table, with the units that astropy has stored in the file."""
    table = Table(meta=about.get("meta") or {})
    units = {column["name"]: column.get("unit") for column in about.get("datatype", ())}
    for name in arrow.column_names:
        column = arrow[name]
        mask = np.array(column.is_null())
        if mask.any() and column.type in _fillable():
            column = column.fill_null(0)
        values = column.to_numpy()
        if values.dtype == object:
            values = np.array(["" if v is None else str(v) for v in values], dtype=str)
        table[name] = MaskedColumn(values, mask=mask) if mask.any() else values
        table[name].unit = units.get(name)
    return table


def _fillable():
    import pyarrow

    return (
        *(pyarrow.int8(), pyarrow.int16(), pyarrow.int32(), pyarrow.int64()),
        *(pyarrow.uint8(), pyarrow.uint16(), pyarrow.uint32(), pyarrow.uint64()),
        *(pyarrow.float32(), pyarrow.float64()),
    )


def _astropy_header(metadata):
    text = (metadata or {}).get(b"table_meta_yaml")
    return {} if text is None else get_header_from_yaml(text.decode().split("\n"))
