"""``-v``: a line for each stage, with counts and times; and what shells complete."""

import os
import re
import subprocess
import sys

import numpy as np
import pytest
from astropy.table import Table

from wpdc_gwcs.calibration import Settings
from wpdc_gwcs.calibration.story import tell_sources
from wpdc_gwcs.cli.app import run
from wpdc_gwcs.report import write_report
from wpdc_gwcs.simulation import simulate, write_simulation


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """An image, a list, and one that cannot be solved."""
    sky = simulate(2, image_shape=(400, 400), density=90, distortion=3, seed=4)
    folder = tmp_path_factory.mktemp("input")
    files = write_simulation(sky, folder, images=(0,), sources="ldac")
    return [str(path) for path in files["frames"]], str(files["reference"])


def test_the_story_of_a_run(inputs, tmp_path, capsys):
    frames, reference = inputs
    arguments = ["--catalog", reference, "--output", str(tmp_path), "-v", "--jobs", "2"]
    assert run(["calibrate", *frames, *arguments]) == 0
    lines = capsys.readouterr().err.splitlines()
    number, seconds = r"\d+(?:\.\d+)?", r"\(\d+\.\d s\)"
    expected = [
        "frames: 1 image and 1 source list of 1 detector, 2 exposures; solved in 1 group",
        rf"catalog: \d+ stars with positions, proper motions, .*, of 2016\.0 {seconds}",
        r"sim-01: sources: \d+ of \d+ sources used \(.*\); stars have a FWHM of "
        rf"{number} px; gain of {number} electrons per count, from the header.*",
        rf"sim-01: match: \d+ pairs, .* expected by chance .*; the header is off by .* {seconds}",
        r"sim-02: sources: \d+ of \d+ sources used \(.*\)",
        rf"sim-02: match: \d+ pairs, .* {seconds}",
        r"solution: sim: polynomial of degree 3.*, from \d+ pairs in 2 exposures; errors .*",
        rf"solution: 2 frames: 2 solved; \d with a field of their own {seconds}",
        rf"files: results of 2 frames written to {re.escape(str(tmp_path))} {seconds}",
    ]
    assert len(lines) == len(expected)
    for line, pattern in zip(lines, expected, strict=True):
        assert re.fullmatch("wpdc: " + pattern, line), line


def test_a_frame_that_fails_has_its_line(inputs, tmp_path, capsys):
    frames, reference = inputs
    stars = Table.read(reference)
    stars["dec"] += 20
    stars.write(tmp_path / "far.fits")
    out = str(tmp_path / "out")
    arguments = ["--catalog", str(tmp_path / "far.fits"), "--output", out, "-v"]
    assert run(["calibrate", frames[1], *arguments]) == 1
    captured = capsys.readouterr()
    assert re.search(r"wpdc: sim-02: failed: .*has no star within .* s\)\n", captured.err)
    assert "try: --wcs HEADER if the header is wrong, or a catalog of this field" in captured.out


@pytest.mark.parametrize(
    ("meta", "words"),
    [
        ({"gain": 1.5, "gain_from": "given"}, "gain of 1.5 electrons per count, as given"),
        ({"gain": 1.5, "gain_from": "noise"}, "from the noise in its stars"),
        ({"fwhm": 2.0}, "stars have a FWHM of 2.00 px"),
    ],
)
def test_what_is_known_of_sources(inputs, meta, words):
    class Frame:
        image_shape = (100, 100)

    sources = Table({"x": [10.0, 50.0], "y": [20.0, 60.0]}, meta=meta)
    lines = tell_sources(sources, Frame, Settings())
    assert lines[0].startswith("2 of 2 sources used")
    assert words in lines[1]


@pytest.mark.parametrize(
    ("shell", "environment"),
    [
        ("bash", {"COMP_WORDS": "wpdc ca", "COMP_CWORD": "1"}),
        ("zsh", {"_TYPER_COMPLETE_ARGS": "wpdc ca"}),
        ("fish", {"_TYPER_COMPLETE_ARGS": "wpdc ca", "_TYPER_COMPLETE_FISH_ACTION": "get-args"}),
    ],
)
def test_shells_complete_commands(shell, environment):
    done = subprocess.run(
        [sys.executable, "-m", "wpdc_gwcs"],
        env={**os.environ, **environment, "_WPDC_COMPLETE": f"complete_{shell}"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert {"calibrate", "catalog"} <= set(re.findall(r"\w+", done.stdout)), done.stderr
    assert "monitor" not in done.stdout


def test_the_page_of_a_survey_has_what_is_worth_a_look(tmp_path, monkeypatch):
    """Of 140 frames 100 rows, 20 figures, and of each detector 20 frames pooled."""
    pytest.importorskip("jinja2")
    for name, most in (("_MOST_ROWS", 100), ("_MOST_FIGURES", 20), ("_MOST_POOLED", 20)):
        monkeypatch.setattr(f"wpdc_gwcs.report.page.{name}", most)
    rng, n = np.random.default_rng(8), 140
    names = [f"f{k:03d}" for k in range(n)]
    summary = Table(
        {
            "frame": names,
            "detector": np.where(np.arange(n) % 2, "a", "b"),
            "status": np.where(np.arange(n) % 20 == 7, "failed", "solved"),
            "rms_mas": rng.permutation(np.arange(n, dtype=float)),
        }
    )
    read = []

    class Matches(dict):
        def __getitem__(self, name):
            read.append(name)
            x, y, dx, dy = rng.normal(500, 100, (4, 30))
            used = np.ones(30, bool)
            return Table(
                {"x": x, "y": y, "dx": dx - 500, "dy": dy - 500, "used": used, "holdout": ~used}
            )

    solved = [name for name, status in zip(names, summary["status"]) if status == "solved"]
    with (tmp_path / "page.html").open("w") as file:
        write_report(summary, {}, Matches.fromkeys(solved), file)
    text = (tmp_path / "page.html").read_text()
    assert "40 more are in <code>summary.ecsv</code>" in text
    assert text.count("Pooled over 20 of its") == 2
    assert text.count('<details id="frame-') == 20
    shown = set(re.findall(r"f\d{3}", text))
    assert {name for name in names if name not in solved} <= shown
    worst = np.array(names)[np.argsort(np.asarray(summary["rms_mas"]))[::-1]]
    assert set(worst[:80]) <= shown
    assert len(read) < 2 * 20 + 2 * 20 + 1
    assert len(text) < 10e6
