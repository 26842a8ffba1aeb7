"""`wpdc simulate`: what it writes, and what it refuses."""

import numpy as np
import pytest
from astropy.table import Table

from wpdc_gwcs.cli.app import run
from wpdc_gwcs.io import read_frames
from wpdc_gwcs.simulation import read_truth


def simulate(folder, *options):
    return run(["simulate", "--output", str(folder), *options])


def test_generic_as_it_always_was(tmp_path, capsys):
    assert simulate(tmp_path, "--size", "128", "--distortion", "2", "--exposures", "2") == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "sim-01.fits",
        "sim-01.truth.ecsv",
        "sim-02.ldac",
        "sim-02.truth.ecsv",
        "sim-reference.fits",
        "truth.asdf",
    ]
    line = capsys.readouterr().out
    assert line == (
        f"wpdc calibrate {tmp_path}/sim-01.fits {tmp_path}/sim-02.ldac --catalog "
        f"{tmp_path}/sim-reference.fits --output results\n"
    )
    assert simulate(tmp_path, "--size", "128", "--exposures", "2") == 2
    assert "sim-reference.fits: file exists" in capsys.readouterr().err


def test_a_mosaic_with_everything(tmp_path, capsys):
    assert (
        simulate(
            tmp_path, "--preset", "csst-msc", "--detectors", "NUV-1, y-4", "--size", "120x100",
            "--distortion", "2", "--pixel-scale", "2", "--exposures", "2", "--fields", "3",
            "--center", "6h48m59s,-36d00m18s", "--center", "-0.001,90", "--density", "5:50",
            "--epoch", "2016:2020", "--proper-motion", "10", "--colors", "1,0.3", "--cluster",
            "20", "--core-radius", "30", "--tidal-radius", "200", "--galaxies", "2", "--dither",
            "5", "--roll", "33", "--magnitudes", "16,22", "--reference-limit", "21.5", "--fwhm",
            "3", "--catalog-errors", "--sources", "ldac", "--seed", "4", "-q",
        )
        == 0
    )  # fmt: skip
    assert capsys.readouterr().out == ""
    truth = read_truth(tmp_path)
    assert len(truth.frames) == 2 * 2 * 3
    assert {f.image_shape for f in truth.frames.values()} == {(100, 120)}
    assert {f.epoch for f in truth.frames.values()} == {2016.0, 2020.0}
    catalog = Table.read(truth.catalog)
    assert {"bp_rp", "pmra", "ra_error"} < set(catalog.colnames)
    assert catalog["phot_g_mean_mag"].max() <= 21.5
    first = truth.frames["csst-msc-f01-01-y-4"].sky(60, 50)
    assert first[1] == pytest.approx(-36.0, abs=0.5)
    assert first[0] == pytest.approx(102.25, abs=0.5)
    assert truth.frames["csst-msc-f02-02-y-4"].sky(60, 50)[1] > 89.5
    density = [len(truth.stars(f"csst-msc-f0{k}-01-y-4")) for k in (1, 3)]
    assert density[1] > 2 * density[0]


def test_tables_have_a_command_each(tmp_path, capsys):
    options = ("--sources", "ecsv", "--images", "0", "--size", "64", "--distortion", "1")
    assert simulate(tmp_path, *options, "--exposures", "2") == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2
    assert f"{tmp_path}/sim-02.cat.ecsv --wcs {tmp_path}/sim-02.hdr" in lines[1]
    table, header = tmp_path / "sim-02.cat.ecsv", tmp_path / "sim-02.hdr"
    (frame,) = read_frames(table, wcs=header)
    assert frame.image_shape == (64, 64)


def test_many_frames_are_named_by_a_pattern(tmp_path, capsys):
    options = ("--preset", "csst-msc", "--size", "32", "--distortion", "0.5", "--density", "5")
    assert simulate(tmp_path, *options, "--exposures", "1") == 0
    assert capsys.readouterr().out == (
        f"wpdc calibrate {tmp_path}/*.ldac --catalog {tmp_path}/csst-msc-reference.fits "
        "--output results\n"
    )


def test_same_seed_same_files(tmp_path):
    options = ("--preset", "bass-90prime", "--size", "100", "--distortion", "1", "--fields", "2")
    for name in "ab":
        assert simulate(tmp_path / name, *options, "--exposures", "1", "--seed", "3", "-q") == 0
    for path in (tmp_path / "a").glob("*.ecsv"):
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()
    a, b = (Table.read(tmp_path / n / "bass-90prime-reference.fits") for n in "ab")
    assert np.array_equal(a["ra"], b["ra"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--preset", "hst"], "camera must be one of generic, csst-msc, bass-90prime, not hst"),
        (["--preset", "csst-msc", "--detectors", "g-3"], "detectors must be among y-1"),
        (["--detectors", "g-1"], "detectors must be among sim, not g-1"),
        (["--exposures", "0"], "n_exposures must be at least 1, not 0"),
        (["--images", "6"], "--images must be between 0 and 5, got 6"),
        (["--sources", "csv"], "--sources must be ldac or ecsv, got csv"),
        (["--center", "120"], "--center must be RA,DEC, got '120'"),
        (["--center", "10,91"], "--center: dec must lie in [-90, 90] deg, got 91"),
        (
            ["--center", "nan,1"],
            "--center: ra must be a number of deg, or an angle such as 12:34:56.7, got 'nan'",
        ),
        (["--center", "1,1", "--fields", "0"], "--fields must be at least 1, got 0"),
        (["--density", "a"], "--density must be numbers with ',' between them, got 'a'"),
        (["--density", "9:1"], "--density LOW:HIGH must be positive and increasing, got '9:1'"),
        (["--density", "1,2,3"], "density must be one number, or one for each field (1)"),
        (["--density", "-1"], "density must be not negative"),
        (["--size", "big"], "--size must be like 2048 or 4096x2048, got 'big'"),
        (["--size", "8"], "image_shape must be at least 16 px"),
        (["--magnitudes", "20"], "--magnitudes must be 2 numbers with ',' between them, got '20'"),
        (["--magnitudes", "20,15"], "magnitudes must be a brighter and a fainter one"),
        (["--epoch", "now"], "--epoch must be a number, got 'now'"),
        (["--cluster", "10", "--tidal-radius", "1"], "tidal_radius must be above core_radius"),
        (["--cluster", "-10"], "density must be not negative"),
        (["--fwhm", "0"], "fwhm must be positive, not 0"),
        (["--lost", "2"], "lost must be between 0 and 1, not 2"),
        (["--spurious", "-1"], "spurious must be not negative, not -1"),
        (["--distortion", "9000"], "is not invertible"),
        (["--seed", "-1"], "seed must be 0 or more, not -1"),
        (["--pixel-scale", "0"], "pixel_scale must be positive"),
        (["--dither", "nan"], "dither must be finite"),
    ],
)
def test_refused_in_one_line(tmp_path, capsys, options, message):
    assert simulate(tmp_path / "new", *options) == 2
    error = capsys.readouterr().err
    assert error.startswith("wpdc: error: ")
    assert error.count("\n") == 1
    assert message in error
    assert not (tmp_path / "new").exists()
