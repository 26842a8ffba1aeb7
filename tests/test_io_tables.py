"""ECSV tables: the same as astropy's, but fast."""

import os
import time

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable, Table

from wpdc_gwcs.exceptions import FileFormatError
from wpdc_gwcs.io import OutputExistsError, read_matches, read_table, write_table


def make_table(n=200):
    rng = np.random.default_rng(1)
    table = Table(
        {
            "source_index": np.arange(n),
            "x": rng.normal(size=n) * 1e3,
            "tiny": rng.normal(size=n) * 1e-300,
            "single": rng.normal(size=n).astype(np.float32),
            "used": rng.uniform(size=n) > 0.5,
            "name": ["a b", 'with "quotes"', "", "ünï"] * (n // 4),
            "flags": rng.integers(0, 9, n).astype(np.uint8),
        }
    )
    table["x"][:3] = [np.nan, np.inf, -np.inf]
    table["x"].unit = u.pix
    table["x"].description = "position: along x"
    table.meta["frame"] = "e00"
    table.meta["nested"] = {"a": [1, 2.5, None]}
    return table


def test_round_trip(tmp_path):
    table = make_table()
    write_table(table, tmp_path / "a.ecsv")
    for back in (read_table(tmp_path / "a.ecsv"), Table.read(tmp_path / "a.ecsv")):
        assert back.colnames == table.colnames
        assert back.meta == table.meta
        for name in table.colnames:
            np.testing.assert_array_equal(back[name], table[name])
            assert back[name].dtype.kind == table[name].dtype.kind
            assert back[name].unit == table[name].unit
        assert back["x"].description == "position: along x"


def test_file_is_astropys_own(tmp_path):
    table = make_table()
    write_table(table, tmp_path / "a.ecsv")
    table.write(tmp_path / "b.ecsv")
    ours, theirs = (Table.read(tmp_path / n) for n in ("a.ecsv", "b.ecsv"))
    for name in table.colnames:
        np.testing.assert_array_equal(ours[name], theirs[name])
    header = [
        [line for line in (tmp_path / n).read_text().splitlines() if line.startswith("#")]
        for n in ("a.ecsv", "b.ecsv")
    ]
    assert header[0] == header[1]


@pytest.mark.parametrize("n", [0, 4])
def test_empty_masked_and_quantities(tmp_path, n):
    table = QTable({"x": np.arange(n) * u.pix, "n": np.arange(n)})
    masked = Table(table, masked=True)
    if n:
        masked["n"].mask[1] = True
    for i, t in enumerate((table, masked)):
        write_table(t, tmp_path / f"{i}.ecsv")
        back = read_table(tmp_path / f"{i}.ecsv")
        assert len(back) == n
        np.testing.assert_array_equal(np.asarray(back["x"]), np.arange(n))
    if n:
        assert back["n"].mask.tolist() == [False, True, False, False]


def test_array_columns(tmp_path):
    table = Table({"a": np.arange(6.0).reshape(3, 2)})
    write_table(table, tmp_path / "a.ecsv")
    np.testing.assert_array_equal(read_table(tmp_path / "a.ecsv")["a"], table["a"])


def test_speed(tmp_path):
    rng = np.random.default_rng(1)
    table = Table({f"c{i}": rng.normal(size=10000) for i in range(14)})
    start = time.perf_counter()
    write_table(table, tmp_path / "a.ecsv")
    # 0.15 s on a machine at leisure.
    assert time.perf_counter() - start < 3.0


def test_existing_table_is_kept(tmp_path):
    write_table(make_table(), tmp_path / "a.ecsv")
    with pytest.raises(OutputExistsError):
        write_table(make_table(), tmp_path / "a.ecsv")
    write_table(make_table(4), tmp_path / "a.ecsv", overwrite=True)
    assert len(read_table(tmp_path / "a.ecsv")) == 4
    assert os.listdir(tmp_path) == ["a.ecsv"]


@pytest.mark.parametrize("suffix", ["fits", "csv", "ecsv", "dat"])
def test_other_formats(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    Table({"x": [1.0], "y": [2.0]}).write(path, **({"format": "ascii"} if suffix == "dat" else {}))
    assert read_table(path, columns=("x", "y"))["y"][0] == 2.0


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "must be a readable file: No such file"),
        (b"", "must not be empty"),
        (b"# %ECSV 1.0\n# ---\n# datatype:\n# - {name: a", "not a readable table"),
        (b"x y\n1 2\n3\n", "not a readable table"),
        (bytes(range(256)), "must be FITS, ASDF or a table, is another binary file"),
    ],
)
def test_bad_tables(tmp_path, content, message):
    path = tmp_path / "a.ecsv"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(FileFormatError, match=f"a.ecsv: {message}"):
        read_table(path)


def test_truncated_table(tmp_path):
    write_table(make_table(), tmp_path / "a.ecsv")
    data = (tmp_path / "a.ecsv").read_bytes()
    cut = data.rindex(b"\n", 0, len(data) - 1) + 12
    (tmp_path / "b.ecsv").write_bytes(data[:cut])
    with pytest.raises(FileFormatError, match="b.ecsv: not a readable table"):
        read_table(tmp_path / "b.ecsv")


def test_columns_are_checked(tmp_path):
    write_table(Table({"x": [1.0], "y": ["a"]}), tmp_path / "a.ecsv")
    with pytest.raises(FileFormatError, match="must have a column 'ra', has x, y"):
        read_table(tmp_path / "a.ecsv", columns=("ra",))
    with pytest.raises(FileFormatError, match="column 'y' must be numeric, is <U1|is str"):
        read_table(tmp_path / "a.ecsv", columns=("x", "y"))
    with pytest.raises(FileFormatError, match="a.ecsv: table must have a column 'y'|numeric"):
        read_matches(tmp_path / "a.ecsv")
