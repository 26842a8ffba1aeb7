"""Inputs that are no files, or of which libraries raise what they have no names for: one line."""

import os
import re
import socket

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from wpdc_gwcs import Calibration, DistortionSolution, LookupTable, PVPolynomial, write
from wpdc_gwcs.cli.app import run

POSIX = pytest.mark.skipif(os.name != "posix", reason="no such files")


@pytest.fixture
def inputs(tmp_path):
    """An image, a list, a header, a catalog and a calibration, small and whole."""
    header = fits.Header()
    header["CTYPE1"], header["CTYPE2"] = "RA---TAN", "DEC--TAN"
    header["CRPIX1"], header["CRPIX2"] = 30.5, 20.5
    header["CRVAL1"], header["CRVAL2"] = 150.0, 2.0
    header["CD1_1"], header["CD1_2"], header["CD2_1"], header["CD2_2"] = -1e-4, 0.0, 0.0, 1e-4
    fits.writeto(tmp_path / "image.fits", np.zeros((40, 60), np.float32), header)
    header.totextfile(tmp_path / "wcs.hdr")
    Table({"x": np.arange(9.0), "y": np.arange(9.0)}).write(tmp_path / "list.ecsv")
    Table({"ra": [150.0], "dec": [2.0]}).write(tmp_path / "catalog.fits")
    nodes = np.linspace(-0.5, 59.5, 8)
    table = LookupTable(nodes, nodes, *np.full((2, 8, 8), 0.1))
    cd = np.diag([-1e-4, 1e-4])
    solution = DistortionSolution("d", (60, 60), [30, 30], cd, [150, 2], PVPolynomial(), table)
    write(Calibration("a", solution, [150, 2], cd), tmp_path / "a.wcs.asdf")
    return tmp_path


def make_odd(path, kind):
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as server:
            server.bind(os.path.relpath(path))
    elif kind == "loop":
        path.symlink_to(path)
    else:
        path.symlink_to("/dev/zero")
    return path


@POSIX
@pytest.mark.parametrize("kind", ["folder", "pipe", "socket", "device", "loop"])
@pytest.mark.parametrize(
    "role", ["frame", "--catalog", "--solution", "--wcs", "--mask", "--weight-map", "--config", ""]
)
def test_what_is_no_file_is_refused_at_once(inputs, monkeypatch, capsys, role, kind):
    monkeypatch.chdir(inputs)
    odd = make_odd(inputs / "odd.fits", kind)
    options = {"--catalog": "catalog.fits", "--output": "out"}
    frame = odd if role == "frame" else "image.fits"
    if role == "--wcs":
        frame = "list.ecsv"
    if role.startswith("--"):
        options[role] = odd
    command = ["calibrate", frame, *(part for pair in options.items() for part in pair)]
    if role == "":
        command = ["pix2sky", odd, "1", "1"]
    assert run([str(part) for part in command]) == 2
    said = capsys.readouterr().err
    (line,) = [one for one in said.splitlines() if one.startswith("wpdc: error: ")]
    assert "odd.fits" in line
    what = {"folder": "a folder", "pipe": "a pipe", "socket": "a socket", "device": "a device"}
    if (kind, role) == ("folder", "frame"):
        assert "the folder has no FITS file and no FITS_LDAC list" in line
    elif kind in what and role not in ("--solution", ""):
        assert f"must be a file, is {what[kind]}" in line


@pytest.mark.parametrize("text", ["a = " + "[" * 3000, "seed = " + "9" * 5000, "seed = [", "= 1"])
def test_configurations_that_are_no_toml(inputs, capsys, text):
    (inputs / "c.toml").write_text(text)
    command = ["calibrate", "image.fits", "--catalog", "catalog.fits", "--output", "out"]
    assert run([*command, "--config", str(inputs / "c.toml")]) == 2
    assert re.fullmatch(r"wpdc: error: \S*c.toml: not valid TOML: .*\n", capsys.readouterr().err)


def test_a_word_of_ten_megabytes(inputs, monkeypatch, capsys):
    monkeypatch.chdir(inputs)
    with open("list.ecsv", "a") as file:
        file.write("1" * 10_000_000)
    assert run(["pix2sky", "a.wcs.asdf", "list.ecsv"]) == 2
    assert "list.ecsv: " in capsys.readouterr().err
    command = ["calibrate", "image.fits", "--catalog", "list.ecsv", "--output", "out"]
    assert run(command) == 2
    assert "list.ecsv: cannot be read as a table" in capsys.readouterr().err


@pytest.mark.parametrize("dtype", [b"complex128", b"[ascii, 9]", b"float32", b"int64"])
def test_arrays_of_other_types(inputs, capsys, dtype):
    path = inputs / "a.wcs.asdf"
    content = path.read_bytes()
    at = content.index(b"\nwpdc:")
    found = re.search(rb"byteorder: little\n +datatype: float64", content[at:]).start() + at
    path.write_bytes(content[:found] + content[found:].replace(b"float64", dtype, 1))
    assert run(["pix2sky", str(path), "1", "1"]) == 2
    assert "damaged ASDF file" in capsys.readouterr().err


def test_tiles_that_do_not_unpack(inputs, monkeypatch, capsys):
    monkeypatch.chdir(inputs)
    with fits.open("image.fits") as hdus:
        image = fits.CompImageHDU(hdus[0].data + np.arange(60, dtype=np.float32), hdus[0].header)
    fits.HDUList([fits.PrimaryHDU(), image]).writeto("c.fits")
    content = bytearray((inputs / "c.fits").read_bytes())
    at = content.index(b"TFORM1  = '1PB")
    content[at : at + 14] = b"TFORM1  = '1QB"
    (inputs / "c.fits").write_bytes(content)
    command = ["calibrate", "c.fits", "--catalog", "catalog.fits", "--output", "out"]
    assert run(command) in (1, 2)
    said = capsys.readouterr().err
    assert "internal error" not in said
    assert "damaged image" in said
