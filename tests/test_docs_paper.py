"""The page about the reproduction: its tables are those of the numbers beside them."""

import csv
import re
import runpy
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parent.parent / "docs"
FOLDER = DOCS / "explanation" / "paper"


@pytest.fixture(scope="module")
def maker():
    pytest.importorskip("PIL", reason="comes with matplotlib")
    return runpy.run_path(str(DOCS / "figures" / "paper.py"))


def test_tables_are_what_is_made_of_the_results(maker):
    results = maker["Results"](maker["Table"].read(FOLDER / "results.ecsv"))
    for name, (columns, rows) in maker["tables"](results).items():
        with (FOLDER / f"{name}.csv").open(encoding="utf-8", newline="") as file:
            assert list(csv.reader(file)) == [list(columns), *(list(row) for row in rows)], name


def test_figures_are_there_and_small(maker):
    page = (DOCS / "explanation" / "paper_reproduced.rst").read_text(encoding="utf-8")
    named = set(re.findall(r"paper_\w+\.png", page))
    assert named == {maker["target_of"](figure) for figure, _ in maker["FIGURES"]}
    assert sum((DOCS / "images" / name).stat().st_size for name in named) < 1.5e6


def test_numbers_in_tables(maker):
    text = maker["text"]
    assert [text(v, 3) for v in (-0.0001, -0.0006, 1.23456)] == ["0.000", "-0.001", "1.235"]
    assert text(float("nan"), 3) == "–"
