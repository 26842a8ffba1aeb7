"""The report is one page that says what the tables say."""

import io
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from astropy.table import QTable, Table
from PIL import Image

from wpdc_gwcs.models import LookupTable, PVPolynomial
from wpdc_gwcs.report import write_report
from wpdc_gwcs.solution import DistortionSolution


class Page(HTMLParser):
    """Counts tags, and collects images, rows of tables, links, and what they lead to."""

    def __init__(self, text):
        super().__init__()
        self.in_cell = False
        self.count, self.images, self.tables, self.links, self.ids = {}, [], [], [], set()
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.count[tag] = self.count.get(tag, 0) + 1
        self.ids |= {attrs["id"]} if "id" in attrs else set()
        if tag == "img":
            self.images.append(attrs)
        elif tag == "a":
            self.links.append(attrs["href"].removeprefix("#"))
        elif tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("th", "td"):
            self.tables[-1][-1].append("")
            self.in_cell = True

    def handle_endtag(self, tag):
        self.in_cell = self.in_cell and tag not in ("th", "td")

    def handle_data(self, data):
        if self.in_cell:
            self.tables[-1][-1][-1] += data


def stars(rng, n, sigma=0.05):
    columns = {name: rng.uniform(0, 99, n) for name in "xy"}
    columns |= {name: rng.normal(0, sigma, n) for name in ("dx", "dy")}
    columns["phot_g_mean_mag"] = rng.uniform(15, 20, n)
    columns["holdout"] = np.arange(n) < n // 4
    columns["used"] = ~columns["holdout"]
    return Table(columns)


def solution_of(name):
    grid = np.linspace(-0.5, 99.5, 5)
    table = LookupTable(grid, grid, np.ones((5, 5)), np.ones((5, 5)))
    return DistortionSolution(
        name, (100, 100), np.array([49.5] * 2), np.eye(2) * 1e-5, np.zeros(2), PVPolynomial(),
        lookup_table=table,
    )  # fmt: skip


def written(*args, **options):
    file = io.StringIO()
    write_report(*args, file, **options)
    return file.getvalue()


@pytest.fixture(scope="module")
def text():
    rng = np.random.default_rng(5)
    names = ["a1", "a2", "<b>", "b2"]
    summary = QTable(
        {
            "frame": names,
            "detector": ["chip-1", "chip-1", "chip-2", "chip-2"],
            "status": ["solved", "degraded", "failed", "solved"],
            "reason": ["", "few stars", "no match & no hope", ""],
            "n_matched": [200, 200, 0, 200],
            "sigma_dx": [0.0512345, 0.04, np.nan, 0.03],
            "rms_mas": [1.0, 2.0, np.nan, 7.125],
            "purity": [0.98, 0.97, 0.1, 0.99],
        }
    )
    matches = {name: stars(rng, 200) for name in ("a1", "a2", "b2")}
    matches["a2"]["dx"] += 0.25
    return written(
        summary,
        {"chip-1": solution_of("chip-1")},
        matches,
        title="Night 1",
        about={"settings": {"degree": "auto", "r0": None}, "software": {"numpy": "2.0"}},
    )


@pytest.fixture
def page(text):
    return Page(text)


def test_detectors_come_first_and_pooled(text, page):
    first = page.tables[0]
    assert first[0][0] == "detector"
    names = [c.split("px")[0].split("mas")[0] for c in first[0]]
    chip = dict(zip(names, first[1], strict=True))
    assert chip["detector"] == "chip-1"
    assert (chip["frames"], chip["solved"], chip["degraded"]) == ("2", "1", "1")
    assert chip["stars"] == "300"  # of 400, 100 are held out
    # half of the stars are 0.25 px off
    assert abs(float(chip["mean dx"]) - 0.125) < 0.02
    assert abs(float(chip["sigma dx"]) - np.hypot(0.05, 0.125)) < 0.01
    assert chip["rms"] == "1.50"
    assert text.index('<h2 id="detectors">') < text.index("Detector chip-1</h2>")
    assert text.index("Detector chip-1</h2>") < text.index('<h2 id="frames">')


def test_counts_and_contents(text, page):
    assert "4 frames: 2 solved, 1 degraded, 1 failed." in text
    assert set(page.links) <= page.ids
    assert {"detectors", "frames", "each", "settings", "detector-0", "detector-1"} <= page.ids


def test_the_heading_is_that_of_the_page(text):
    assert re.findall(r"<h1>(.*?)</h1>", text) == ["Night 1"]
    assert re.findall(r"<title>(.*?)</title>", text) == ["Night 1"]


def test_what_is_wrong_comes_first(text):
    """The failed frame, then the degraded one, each with its reason, and no solved one."""
    (found,) = re.findall(r'<ul class="problems">(.*?)</ul>', text, re.DOTALL)
    items = [re.sub(r"<.*?>", "", item) for item in re.findall(r"<li>(.*?)</li>", found, re.DOTALL)]
    expected = ["&lt;b&gt;: failed: no match &amp; no hope", "a2: degraded: few stars"]
    assert [" ".join(item.split()) for item in items] == expected
    assert text.index('id="problems"') < text.index('id="detectors"')


def test_frames_have_the_important_columns_and_are_folded(text, page):
    frames = page.tables[1]
    assert frames[0][0] == "frame"
    assert "purity" not in frames[0]
    assert [row[0].strip() for row in frames[1:]] == ["a1", "a2", "<b>", "b2"]
    assert frames[3][-1] == "no match & no hope"
    assert "0.0512" in frames[1]
    assert "7.12" in frames[4]
    # all columns, and each frame that has matches
    assert page.count["details"] == 1 + 3
    assert any("purity" in table[0] for table in page.tables)
    assert "<details open" not in text
    assert text.count('class="failed"') == 2


def test_statistics_of_a_frame(page):
    tables = [t for t in page.tables if t[1][0] == "in the fit"]
    assert len(tables) == 3
    (_, fit, held) = tables[1]
    assert (fit[1], held[:2]) == ("150", ["held out", "50"])
    assert abs(float(fit[2]) - 0.25) < 0.02


def test_images(page):
    # chip-1: both maps, magnitudes, distribution, table; chip-2: magnitudes, distribution; a1, a2,
    # and b2, whose detector has no map
    assert len(page.images) == 4 + 2 + 3
    for image in page.images:
        assert image["src"].startswith("data:image/webp;base64,")
        assert image["alt"]
        assert int(image["width"]) > 300


def test_settings(page):
    rows = [row for table in page.tables for row in table]
    assert ["degree", "auto"] in rows
    assert ["r0", "none"] in rows
    assert ["numpy", "2.0"] in rows


def test_dark_and_light_are_both_provided(text):
    assert "color-scheme: light dark" in text
    assert "prefers-color-scheme: dark" in text


def test_page_is_self_contained_and_escaped(text):
    assert not re.search(r"https?://", text)
    assert "&lt;b&gt;" in text
    assert "<b>" not in text
    assert "no match &amp; no hope" in text


def test_detector_without_table_or_solution(rng):
    summary = Table({"frame": ["a"], "detector": ["chip-1"], "status": ["solved"]})
    columns = {name: rng.normal(size=20) for name in ("x", "y", "dx", "dy")}
    matches = {"a": Table(columns | {"used": np.ones(20, bool), "holdout": np.zeros(20, bool)})}
    bare = DistortionSolution(
        "chip-1", (80, 100), np.zeros(2), np.eye(2) * 1e-5, np.zeros(2), PVPolynomial(),
        settings={"method": "paper"},
    )  # fmt: skip
    summary["reason"] = np.ma.masked_all(1, dtype="U5")
    text = written(summary, {"chip-1": bare}, matches)
    assert "100 x 80 px, by the paper&#39;s literal method; no look-up table." in text
    assert "1 frame: 1 solved." in text
    page = Page(text)
    # The only frame of a detector is what is shown of the detector.
    assert len(page.images) == 2
    assert ["method", "paper"] in [row for table in page.tables for row in table]
    text = written(summary, {}, matches)
    assert "No solution is stored for it." in text
    assert len(Page(text).images) == 2


def test_nothing_solved():
    summary = Table({"frame": ["a"], "detector": ["c"], "status": ["failed"], "reason": ["no"]})
    text = written(summary, {}, {})
    assert "1 frame: 1 failed." in text
    assert Page(text).images == []
    assert "settings" not in Page(text).ids


@pytest.mark.parametrize(("n_detectors", "drawn"), [(1, 2), (18, 6)])
def test_many_frames_are_a_small_page(n_detectors, drawn):
    # As large as they get: figures of some frames and of some detectors stand for all.
    rng = np.random.default_rng(1)
    names = [f"night_20170430_exposure_{k:03d}" for k in range(drawn)]
    detectors = [f"d{k % n_detectors}" for k in range(drawn)]
    summary = Table({"frame": names, "detector": detectors, "status": ["solved"] * drawn})
    text = written(
        summary,
        {d: solution_of(d) for d in detectors},
        {name: stars(rng, 5000) for name in names},
    )
    of_frames, others = [0], 0
    for image in Page(text).images:
        if re.match(r"residuals of night_\w+$", image["alt"]):
            of_frames.append(len(image["src"]))
        else:
            others += len(image["src"])
    assert 72 * max(of_frames) + others * n_detectors / len(set(detectors)) < 2_800_000


def test_images_can_be_read(page):
    import base64

    data = base64.b64decode(page.images[0]["src"].partition(",")[2])
    image = Image.open(io.BytesIO(data))
    assert (image.width, image.height) == tuple(
        int(page.images[0][name]) for name in ("width", "height")
    )
    assert image.convert("L").getextrema() != (255, 255)


def test_settings_of_a_folder_are_found(tmp_path):
    from wpdc_gwcs.cli.report import about_run

    assert about_run(tmp_path) is None
    manifest = {
        "run": "abc", "created": "2026", "software": {"numpy": "2"}, "settings": {"r0": 3},
        "catalog": {}, "solution": None, "update": False, "inputs": [], "frames": {},
    }  # fmt: skip
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    about = about_run(tmp_path)
    assert about["settings"] == {"r0": 3}
    assert about["run"] == {"run": "abc", "began": "2026", "input files": 0}
