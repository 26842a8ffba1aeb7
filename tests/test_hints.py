"""What to try next: for real errors, and no rule for what nobody says."""

import ast
import re
from pathlib import Path

import numpy as np
import pytest
import typer
from astropy.io import fits
from astropy.table import Table

import wpdc_gwcs
from wpdc_gwcs.cli import hints
from wpdc_gwcs.cli.app import app, run
from wpdc_gwcs.cli.hints import hint_of, hint_of_frame, similar_option
from wpdc_gwcs.exceptions import DetectionError, FitError, InternalError, MatchError


def text_of(node):
    """Message of an error as it stands in the source, with 1 for each value."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(str(v.value) if isinstance(v, ast.Constant) else "1" for v in node.values)
    if isinstance(node, ast.BinOp):
        return text_of(node.left) + text_of(node.right)
    return "1"


@pytest.fixture(scope="module")
def messages():
    """All texts of the source; those of errors are among them."""
    found = set()
    for path in Path(wpdc_gwcs.__file__).parent.rglob("*.py"):
        if path.name != "hints.py":
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Constant | ast.JoinedStr | ast.BinOp):
                    found.add(" ".join(text_of(node).split()))
    # What has words of the system, or of other places, where the source has values.
    return [*found, "No space left on device", "another solution", "too few reference stars"]


@pytest.mark.parametrize("pattern", [rule[0] for rule in hints._OF_COMMANDS + hints._OF_FRAMES])
def test_every_rule_is_of_a_message(messages, pattern):
    assert any(re.match(pattern, text) or re.match(pattern, f"x: {text}") for text in messages)


def error_of(capsys):
    (line,) = capsys.readouterr().err.splitlines()
    return line


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "night").mkdir()
    stars = Table({"ra": [10.0, 10.1], "dec": [20.0, 20.1]})
    stars.write(tmp_path / "gaia.fits")
    Table({"a": [1.0]}).write(tmp_path / "no-positions.ecsv")
    Table({"x": [1.0, 2.0], "y": [1.0, 2.0]}).write(tmp_path / "list.ecsv")
    fits.writeto(tmp_path / "plain.fits", np.zeros((20, 20), "f4"))
    (tmp_path / "cut.fits").write_bytes((tmp_path / "plain.fits").read_bytes()[:3000])
    return tmp_path


@pytest.mark.parametrize(
    ("frame", "catalog", "hint"),
    [
        ("plane.fits", "gaia.fits", "; try: {folder}/plain.fits, which is there"),
        ("nihgt/a.fits", "gaia.fits", "; try: another folder: there is no {folder}/nihgt"),
        ("zzz.fits", "gaia.fits", ""),
        ("plain.fits", "gaia.fits", "; try: --wcs HEADER, with the header of another exposure"),
        ("list.ecsv", "gaia.fits", "; try: --wcs HEADER, with the header of another exposure"),
        ("cut.fits", "gaia.fits", "; try: get the file again, or leave it out"),
        ("gaia.fits", "gaia.fits", "; try: wpdc show {folder}/gaia.fits, which says what it is"),
    ],
)
def test_of_real_errors(folder, capsys, frame, catalog, hint):
    arguments = [str(folder / frame), "--catalog", str(folder / catalog)]
    assert run(["calibrate", *arguments, "--output", str(folder / "out")]) == 2
    line = error_of(capsys)
    assert hint.format(folder=folder) in line
    assert ("; try" in line) == bool(hint)


def test_of_names_in_other_letters(tmp_path, capsys):
    for name in ("a_Z-1.wcs.asdf", "a_G-1.wcs.asdf", "CSSTMSC.camera.asdf"):
        (tmp_path / name).touch()
    for typed, meant in (
        ("a_g-1.wcs.asdf", "a_G-1.wcs.asdf"),
        ("csst-msc.camera.asdf", "CSSTMSC.camera.asdf"),
    ):
        assert run(["show", str(tmp_path / typed)]) == 2
        assert error_of(capsys).endswith(f"; try: {tmp_path / meant}, which is there")


def test_of_folders_that_are_no_results(folder, capsys):
    for command in ("evaluate", "report"):
        assert run([command, str(folder / "night")]) == 2
        assert error_of(capsys).endswith("; try: the output folder of wpdc calibrate")


def test_of_a_catalog_without_positions(folder, capsys):
    assert run(["catalog", "info", str(folder / "no-positions.ecsv")]) == 2
    assert error_of(capsys).endswith("; try: rename its columns to ra and dec, in degrees")
    assert run(["catalog", "info", str(folder / "giaa.fits")]) == 2
    assert error_of(capsys).endswith(f"; try: {folder / 'gaia.fits'}, which is there")


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (MatchError("no match with sufficient evidence (...)"), "wpdc explain 'a b' --catalog c"),
        (MatchError("a: the catalog has no star within 1 deg"), "--around 'a b' --output gaia"),
        (DetectionError("no source above 5 sigma on the image"), "wpdc detect 'a b' --threshold 3"),
        (DetectionError("the image is flat: all pixels near 1"), "wpdc show 'a b'"),
        (FitError("a: the frame has shape (ny, nx) 1, the stored solution"), "without --solution"),
        (FitError("a: only 5 stars could be fitted; at least 10 are needed"), "more exposures"),
        (FitError("a: centroids 'given' needs a source list"), None),
        (InternalError("internal error: its process died 2 times"), "fewer --jobs"),
        (InternalError("internal error: KeyError: 1"), "please report it"),
    ],
)
def test_of_frames(error, expected):
    hint = hint_of_frame(error, "a b", catalog="c")
    assert hint is None if expected is None else expected in hint


def test_the_header_of_the_command_goes_with_the_hint():
    hint = hint_of_frame(MatchError("no match"), "a.ecsv", catalog="c", wcs="h.head")
    assert hint == "wpdc explain a.ecsv --catalog c --wcs h.head --output why.png"
    assert hint_of("--jobs must be at least 1, got 0") is None


def test_no_picture_is_suggested_where_none_can_be_drawn(monkeypatch):
    monkeypatch.setattr("wpdc_gwcs.extras.find_spec", lambda name: None)
    hint = hint_of_frame(MatchError("no match"), "a.fits", catalog="c")
    assert hint == "wpdc explain a.fits --catalog c"


def test_of_a_cluster_without_workers():
    error = "--scheduler tcp://a:8786: must have a worker within 60 s, has none"
    assert hint_of(error) == "dask worker tcp://a:8786, on machines that see the files"


@pytest.mark.parametrize(
    ("command", "typed", "meant"),
    [
        ("calibrate", "--plots", "--report"),
        ("monitor", "--figures", "--plots"),
        ("show", "--plot", "--output"),
        ("calibrate", "-o", "--output"),
        ("calibrate", "--catlog", "--catalog"),
        ("calibrate", "--clobber", "--overwrite"),
        ("calibrate", "--scale", "--pixel-scale"),
        ("calibrate", "--dry-run", None),
    ],
)
def test_of_options_of_other_names(capsys, command, typed, meant):
    assert run([command, typed, "3"]) == 2
    line = error_of(capsys)
    assert f"No such option: {typed}" in line
    assert (f"Did you mean {meant}?" in line) if meant else ("Did you mean" not in line)


def test_every_option_that_is_suggested_is_there():
    group = typer.main.get_command(app)
    commands = [*group.commands.values(), *group.commands["catalog"].commands.values()]
    options = {o for command in commands for p in command.params for o in p.opts}
    for ours in hints._OTHER_NAMES:
        assert set(ours.split()) <= options
    assert similar_option("--", ["--output"]) is None
