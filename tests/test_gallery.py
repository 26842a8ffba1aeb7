"""The pages of the gallery run, and print what they say."""

import re
import runpy
from pathlib import Path

import pytest

from wpdc_gwcs.cli import app  # noqa: F401  What the pages import takes its time once.

DOCS = Path(__file__).resolve().parent.parent / "docs"
GALLERY = runpy.run_path(str(DOCS / "figures" / "gallery.py"))
NEEDS = {"reproject": "reproject"}


@pytest.mark.parametrize("name", GALLERY["page_names"]())
def test_page_prints_what_it_says(name, tmp_path):
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    made, report = GALLERY["run_page"](name, tmp_path)
    assert not report, report
    assert "figure" in made or (tmp_path / "picture.png").is_file()


def test_a_page_that_is_wrong_is_reported(tmp_path):
    (examples, report) = GALLERY["run_text"](
        "wrong", ".. code-block:: console\n\n   $ wpdc --version\n   another program\n", tmp_path
    )
    assert "Expected:\n    another program" in report


def test_every_page_is_in_the_index_and_has_its_picture():
    index = (DOCS / "gallery" / "index.rst").read_text(encoding="utf-8")
    assert sorted(re.findall(r":doc:`(\w+)`", index)) == GALLERY["page_names"]()
    for name in GALLERY["page_names"]():
        page = (DOCS / "gallery" / f"{name}.rst").read_text(encoding="utf-8")
        assert f"/images/gallery_{name}.png" in page
        assert (DOCS / "images" / f"gallery_{name}.png").is_file()
