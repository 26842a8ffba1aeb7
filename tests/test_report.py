"""The report is one page that says what the tables say."""

import io
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from astropy.table import QTable, Table

from wpdc_gwcs.models import LookupTable, PVPolynomial
from wpdc_gwcs.report import write_report
from wpdc_gwcs.solution import DistortionSolution


class Tags(HTMLParser):
    """Counts tags and collects the sources of images."""

    def __init__(self):
        super().__init__()
        self.count, self.sources = {}, []

    def handle_starttag(self, tag, attrs):
        self.count[tag] = self.count.get(tag, 0) + 1
        self.sources += [value for name, value in attrs if name == "src"]


@pytest.fixture(scope="module")
def page():
    rng = np.random.default_rng(5)
    summary = QTable(
        {
            "frame": ["good", "<bad>"],
            "detector": ["chip-1", "chip-2"],
            "status": ["solved", "failed"],
            "reason": ["", "no match & no hope"],
            "sigma_dx": [0.0512345, np.nan],
        }
    )
    grid = np.linspace(-0.5, 99.5, 5)
    table = LookupTable(grid, grid, np.ones((5, 5)), np.ones((5, 5)))
    solution = DistortionSolution(
        "chip-1", (100, 100), np.array([49.5] * 2), np.eye(2) * 1e-5, np.zeros(2), PVPolynomial(),
        lookup_table=table,
    )  # fmt: skip
    columns = {"x": rng.uniform(0, 99, 200), "y": rng.uniform(0, 99, 200)}
    columns |= {"dx": rng.normal(size=200), "dy": rng.normal(size=200)}
    columns["dx"][:50] = 0.25
    columns["holdout"] = np.arange(200) < 50
    columns["used"] = ~columns["holdout"]
    file = io.StringIO()
    write_report(summary, {"chip-1": solution}, {"good": Table(columns)}, file, title="Night 1")
    return file.getvalue()


def test_page_holds_every_frame_and_figure(page):
    tags = Tags()
    tags.feed(page)
    # summary: heading and two frames; statistics: heading, stars of the fit, held-out stars
    assert tags.count["tr"] == 3 + 3
    # look-up table; maps, residuals against position, distribution
    assert tags.count["img"] == 1 + 3
    assert all(source.startswith("data:image/png;base64,iVBOR") for source in tags.sources)
    assert "1 of 2 frames solved" in page
    assert "0.0512" in page
    assert "Detector chip-1" in page


def test_statistics_of_the_stars(page):
    fit, held_out = re.findall(r"<td>(?:in the fit|held out)</td>.*?</tr>", page)
    assert "<td>150</td>" in fit
    # 50 held-out stars, none clipped by their dx, all with a dx of 0.25 px
    assert re.search(r"<td>50</td><td>(50|4\d)</td><td>0.2500</td>", held_out)


def test_detector_without_table_or_solution(rng):
    summary = Table({"frame": ["a"], "detector": ["chip-1"], "status": ["solved"]})
    columns = {name: rng.normal(size=20) for name in ("x", "y", "dx", "dy")}
    matches = {"a": Table(columns | {"used": np.ones(20, bool), "holdout": np.zeros(20, bool)})}
    bare = DistortionSolution(
        "chip-1", (80, 100), np.zeros(2), np.eye(2) * 1e-5, np.zeros(2), PVPolynomial()
    )
    summary["reason"] = np.ma.masked_all(1, dtype="U5")
    file = io.StringIO()
    write_report(summary, {"chip-1": bare}, matches, file)
    assert "<td>solved</td><td></td>" in file.getvalue()
    assert "100 x 80 px; no look-up table." in file.getvalue()
    file = io.StringIO()
    write_report(summary, {}, matches, file)
    tags = Tags()
    tags.feed(file.getvalue())
    assert tags.count["img"] == 2


def test_page_is_self_contained_and_escaped(page):
    assert not re.search(r"https?://", page)
    assert "&lt;bad&gt;" in page
    assert "<bad>" not in page
    assert "no match &amp; no hope" in page
