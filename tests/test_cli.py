"""The command line: what it writes, what it refuses, and how it says so."""

import re
import signal
import subprocess
import sys
import time

import asdf
import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.stats import mad_std
from astropy.table import QTable, Table
from astropy.wcs import WCS

from wpdc_gwcs import DistortionSolution, PVPolynomial, read, read_catalog, read_frames, write
from wpdc_gwcs.catalogs import propagate
from wpdc_gwcs.cli.app import run
from wpdc_gwcs.simulation import simulate, write_simulation


@pytest.fixture(scope="module")
def simulation():
    return simulate(2, image_shape=(1024, 1024), density=25, distortion=15, seed=3)


@pytest.fixture(scope="module")
def inputs(simulation, tmp_path_factory):
    """Files of a simulation: two FITS_LDAC lists and the reference."""
    folder = tmp_path_factory.mktemp("input")
    files = write_simulation(simulation, folder, images=(), sources="ldac")
    return [str(f) for f in files["frames"]], str(files["reference"])


@pytest.fixture(scope="module")
def results(inputs, tmp_path_factory):
    """Folder with the results of one calibration."""
    frames, reference = inputs
    folder = tmp_path_factory.mktemp("results")
    status = run(["calibrate", *frames, "--catalog", reference, "--output", str(folder), "-q"])
    assert status == 0
    return folder


def error_of(capsys):
    """The single line of an error; no traceback, nothing else."""
    captured = capsys.readouterr().err.strip().splitlines()
    assert len(captured) == 1, captured
    assert captured[0].startswith("wpdc: error: ")
    return captured[0].removeprefix("wpdc: error: ")


def test_calibrate_writes_what_it_promises(results, simulation):
    names = sorted(p.name for p in results.iterdir())
    assert names == [
        "manifest.json", "sim-01.matches.ecsv", "sim-01.wcs.asdf", "sim-02.matches.ecsv",
        "sim-02.wcs.asdf", "sim.solution.asdf", "summary.ecsv",
    ]  # fmt: skip
    summary = Table.read(results / "summary.ecsv")
    assert list(summary["status"]) == ["solved", "solved"]
    for exposure in simulation.exposures:
        with asdf.open(results / f"{exposure.name}.wcs.asdf", lazy_load=False) as file:
            stock = file["wcs"]
        for wcs in (stock, read(results / f"{exposure.name}.wcs.asdf").wcs):
            dx, dy = exposure.wcs_error(wcs)[2:]
            assert np.sqrt(np.mean(dx**2 + dy**2)) < 0.03
        matches = Table.read(results / f"{exposure.name}.matches.ecsv")
        assert {"source_index", "catalog_index", "x", "dx", "used", "holdout"} <= set(
            matches.colnames
        )


def test_calibrate_as_the_paper_does(inputs, simulation, tmp_path):
    frames, reference = inputs
    arguments = ["calibrate", *frames, "--catalog", reference, "--output", str(tmp_path)]
    assert run([*arguments, "--method", "paper", "--weight", "w1", "-q"]) == 0
    for exposure in simulation.exposures:
        found = read(tmp_path / f"{exposure.name}.wcs.asdf")
        assert found.settings["method"] == "paper"
        _, _, dx, dy = exposure.wcs_error(found.wcs)
        assert np.sqrt(np.mean(dx**2 + dy**2)) < 0.5


def test_existing_files_are_kept(inputs, results, capsys):
    frames, reference = inputs
    before = {p.name: p.read_bytes() for p in results.iterdir()}
    status = run(["calibrate", *frames, "--catalog", reference, "--output", str(results)])
    assert status == 2
    assert "sim-01.wcs.asdf: file exists, and is replaced only with --overwrite" in error_of(capsys)
    assert {p.name: p.read_bytes() for p in results.iterdir()} == before


def test_a_frame_that_fails_again_loses_its_old_wcs(inputs, results, tmp_path, capsys):
    frames, reference = inputs
    for path in results.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    elsewhere = Table.read(reference)
    elsewhere["ra"] += 20.0
    elsewhere.write(tmp_path / "elsewhere.fits")
    status = run(
        ["calibrate", frames[0], "--catalog", str(tmp_path / "elsewhere.fits"),
         "--output", str(tmp_path), "--overwrite", "-q"]
    )  # fmt: skip
    assert status == 1
    assert "sim-01: not solved: " in error_of(capsys)
    assert not (tmp_path / "sim-01.wcs.asdf").exists()
    assert (tmp_path / "sim-02.wcs.asdf").exists()
    summary = Table.read(tmp_path / "summary.ecsv")
    assert list(summary["status"]) == ["failed"]
    assert "no star within" in summary["reason"][0]


def test_three_stars_are_refused_and_the_others_solved(inputs, simulation, tmp_path, capsys):
    frames, reference = inputs
    header = tmp_path / "start.hdr"
    simulation.exposures[0].header.totextfile(header)
    Table({"x": [10.0, 500.0, 900.0], "y": [20.0, 400.0, 200.0]}).write(tmp_path / "three.ecsv")
    status = run(
        ["calibrate", str(tmp_path / "three.ecsv"), frames[0], "--wcs", str(header),
         "--catalog", reference, "--output", str(tmp_path / "out"), "-q"]
    )  # fmt: skip
    assert status == 1
    assert "three: not solved: too few sources" in error_of(capsys)
    assert not (tmp_path / "out" / "three.wcs.asdf").exists()
    assert (tmp_path / "out" / "sim-01.wcs.asdf").exists()


def make_bad_files(folder, reference):
    """Every kind of input that cannot be used."""
    table = Table.read(reference)
    table[:0].write(folder / "norows.fits")
    bad = table.copy()
    bad["ra"].unit = "mag"
    bad.write(folder / "unit.fits")
    bad = table.copy()
    bad.remove_column("dec")
    bad.write(folder / "nodec.fits")
    (folder / "empty.fits").write_bytes(b"")
    (folder / "text.fits").write_text("this is no FITS file\n")
    fits.writeto(folder / "nowcs.fits", np.zeros((64, 64), "f4"))
    (folder / "not-a-folder").write_text("")
    (folder / "bad.toml").write_text("r0 = \n")
    (folder / "unknown.toml").write_text("radius = 5\n")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{dir}/missing.fits"], r"missing.fits: must be a readable file"),
        (["{dir}/empty.fits"], "empty.fits: must not be empty"),
        (["{dir}/text.fits"], "text.fits: a FITS file must begin with"),
        (["{dir}/nowcs.fits"], "nowcs.fits: header must have a celestial WCS"),
        (["{frame}", "--catalog", "{dir}/missing.fits"], "missing.fits: catalog must be"),
        (
            ["{frame}", "--catalog", "{dir}/norows.fits"],
            "norows.fits: catalog must have at least one row",
        ),
        (["{frame}", "--catalog", "{dir}/nodec.fits"], "nodec.fits: .* 'ra' and 'dec'"),
        (["{frame}", "--catalog", "{dir}/unit.fits"], "unit of column 'ra' must be an angle"),
        (["{frame}", "--output", "{dir}/not-a-folder"], "not-a-folder: the output folder must be"),
        (["{frame}", "--preset", "nope"], "unknown preset 'nope': must be one of bass-90prime"),
        (["{frame}", "--weight", "w9"], "weight must be one of exp-sqrt, .* got 'w9'"),
        (["{frame}", "--r0", "-5"], "r0 must be a positive number of px, got -5"),
        (["{frame}", "--n-grid", "many"], "Invalid value for '--n-grid'"),
        (["{frame}", "--holdout", "1.5"], "holdout must be between 0 and 0.9, got 1.5"),
        (["{frame}", "--detector", "a\nb"], "--detector must be a printable name"),
        (["{frame}", "--detector", " "], "--detector must be a printable name"),
        (["{frame}", "--seed", "-1"], "seed must be an integer from 0 to .*, got -1"),
        (["{frame}", "--threshold", "inf"], "threshold and min_snr must be finite, got inf"),
        (["{frame}", "--scheduler-timeout", "nan"], "--scheduler-timeout must be positive"),
        (["{frame}", "--degree", "²"], "invalid literal"),
        (
            ["{frame}", "--output", "/dev/null"],
            "/dev/null: the output folder must be a folder",
        ),
        (["{frame}", "--jobs", "0"], "--jobs must be at least 1, got 0"),
        (["{frame}", "--update"], "--update needs the stored solution"),
        (["{frame}", "--method", "scamp"], "method must be one of wpdc, paper, got 'scamp'"),
        (
            ["{frame}", "--method", "paper", "--refine", "field"],
            "refine must be 'auto' or 'pv' with",
        ),
        (
            ["{frame}", "--method", "paper", "--update", "--solution", "a.asdf"],
            "--update needs --method wpdc",
        ),
        (["{frame}", "--no-such-option"], "No such option"),
        (["{frame}", "{frame}"], "would both write sim-01.wcs.asdf"),
        (["{frame}", "--config", "{dir}/missing.toml"], "missing.toml: no such configuration"),
        (["{frame}", "--config", "{dir}/bad.toml"], "bad.toml: not valid TOML"),
        (["{frame}", "--config", "{dir}/unknown.toml"], "unknown option 'radius'"),
        (["{frame}", "--solution", "{dir}/missing.asdf"], "missing.asdf"),
        ([], "Missing argument"),
    ],
)
def test_bad_input_is_one_line_and_status_two(inputs, tmp_path, capsys, arguments, message):
    frames, reference = inputs
    make_bad_files(tmp_path, reference)
    arguments = [a.format(dir=tmp_path, frame=frames[0]) for a in arguments]
    for name, value in (("--catalog", reference), ("--output", str(tmp_path / "out"))):
        if name not in arguments:
            arguments += [name, value]
    assert run(["calibrate", *arguments]) == 2
    line = error_of(capsys)
    assert re.search(message, line), line
    assert not list(tmp_path.glob("**/*.wcs.asdf"))
    assert not list(tmp_path.glob("out/*"))


def test_what_is_wrong_is_found_before_thousands_of_frames_are_read(inputs, tmp_path, capsys):
    frames, reference = inputs
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "report.html").write_text("precious")
    (tmp_path / "empty.fits").touch()
    unread = tmp_path / "unread.fits"
    unread.write_text("a frame that would be refused if it were read")
    for options, message in (
        (["--catalog", str(tmp_path / "none.fits")], "catalog must be an existing file"),
        (["--catalog", str(tmp_path / "empty.fits[1]")], "catalog must not be empty"),
        (["--catalog", reference, "--solution", str(tmp_path)], "is a folder"),
        (["--catalog", reference, "--report", "--output", str(tmp_path / "taken")], "report.html"),
    ):
        out = ["--output", str(tmp_path / "out")] if "--output" not in options else []
        assert run(["calibrate", str(unread), *options, *out]) == 2
        assert message in error_of(capsys)
    assert (tmp_path / "taken" / "report.html").read_text() == "precious"


def test_options_come_from_preset_then_config_then_command_line(inputs, tmp_path, monkeypatch):
    frames, reference = inputs
    seen = []

    def stop(frames, catalog, *, settings, **options):
        seen.append(settings)
        raise KeyboardInterrupt

    monkeypatch.setattr("wpdc_gwcs.calibration.calibrate", stop)
    config = tmp_path / "my.toml"
    config.write_text('r0 = 77.0\nn-grid = 31\nweight = "inverse"\n')
    common = ["calibrate", frames[0], "--catalog", reference, "--output", str(tmp_path / "out")]
    for order in (
        ["--preset", "bass-90prime", "--config", str(config)],
        ["--config", str(config), "--preset", "bass-90prime"],
    ):
        assert run([*common, *order, "--n-grid", "21"]) == 130
        settings = seen.pop()
        assert settings.reference_point == "nearest-source"  # the preset
        assert settings.r0 == 77.0  # the file wins over the preset
        assert settings.weight == "inverse"
        assert settings.n_grid == 21  # what is typed wins over the file


def test_interrupted_run_leaves_no_half_written_file(inputs, tmp_path):
    frames, reference = inputs
    # A shell starts what runs in its background with interrupts ignored, and children inherit that.
    listen = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    program = f"{listen}; from wpdc_gwcs.cli import main; main()"
    command = [sys.executable, "-c", program, "calibrate"]
    log = tmp_path / "log"
    with log.open("w") as stderr:
        process = subprocess.Popen(
            [*command, *frames, "--catalog", reference, "--output", str(tmp_path / "out"), "-v"],
            stderr=stderr,
        )
        while not log.stat().st_size:  # the first message says that the work has begun
            assert process.poll() is None
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60) == 130
    errors = log.read_text()
    assert "Traceback" not in errors
    assert "wpdc: error: interrupted" in errors
    assert not [p for p in (tmp_path / "out").iterdir() if p.suffix not in (".ecsv", ".asdf")]


def test_transforms_agree_with_the_wcs_and_invert_each_other(results, capsys):
    path = str(results / "sim-01.wcs.asdf")
    wcs = read(path).wcs
    assert run(["pix2sky", path, "100.25", "200.5"]) == 0
    ra, dec = capsys.readouterr().out.split()
    np.testing.assert_allclose([float(ra), float(dec)], wcs(100.25, 200.5), rtol=0, atol=1e-10)
    assert run(["sky2pix", path, ra, dec]) == 0
    np.testing.assert_allclose(
        [float(v) for v in capsys.readouterr().out.split()], [100.25, 200.5], atol=2e-5
    )
    assert run(["sky2pix", path, ra, dec, "--origin", "1"]) == 0
    np.testing.assert_allclose(
        [float(v) for v in capsys.readouterr().out.split()], [101.25, 201.5], atol=2e-5
    )


def test_transform_of_a_table(results, tmp_path, capsys):
    path = str(results / "sim-01.wcs.asdf")
    table = Table({"name": ["a", "b"], "x": [10.0, 500.0], "y": [20.0, 600.0]})
    table.write(tmp_path / "points.ecsv")
    out = tmp_path / "sky.ecsv"
    assert run(["pix2sky", path, str(tmp_path / "points.ecsv"), "--output", str(out)]) == 0
    found = Table.read(out)
    assert found.colnames == ["name", "x", "y", "ra", "dec"]
    expected = read(path).wcs(table["x"].data, table["y"].data)
    np.testing.assert_allclose([found["ra"], found["dec"]], expected, rtol=0, atol=1e-12)
    assert run(["pix2sky", path, str(tmp_path / "points.ecsv"), "--output", str(out)]) == 2
    assert "file exists" in error_of(capsys) or "exists" in error_of(capsys)


def forms_of(position):
    """Ways to write a position on the command line."""
    colons = position.to_string("hmsdms", sep=":", precision=9)
    units = position.to_string("hmsdms", precision=9)
    decimals = f"{position.ra.deg:.12f} {position.dec.deg:.12f}"
    degrees = position.ra.to_string("deg", precision=9), position.dec.to_string("deg", precision=9)
    for text in (colons, units, decimals):
        yield text.split()
        yield [text]
        yield text.replace(" ", ", ").split(" ")
    yield colons.replace(":", " ").split()
    yield [part.replace(":", " ") for part in colons.split()]
    yield list(degrees)
    yield f"{position.ra.hour:.12f}h {position.dec.deg:.12f}d".split()


def test_sky2pix_reads_positions_in_any_form(results, capsys):
    path = str(results / "sim-01.wcs.asdf")
    sky = SkyCoord(*read(path).wcs(100.25, 200.5), unit="deg")
    for form in forms_of(sky):
        assert run(["sky2pix", path, *form]) == 0, form
        found = [float(v) for v in capsys.readouterr().out.split()]
        np.testing.assert_allclose(found, [100.25, 200.5], atol=2e-5)


def test_sky2pix_reads_minus_zero(tmp_path, capsys):
    cd = np.diag([-1e-3, 1e-3])
    solution = DistortionSolution(
        "d", (100, 100), np.array([49.5, 49.5]), cd, np.array([0.0, 0.0]), PVPolynomial()
    )
    write(solution, tmp_path / "d.solution.asdf")
    assert run(["sky2pix", str(tmp_path / "d.solution.asdf"), "00:00:00", "-00:00:36"]) == 0
    assert capsys.readouterr().out.split() == ["49.50000", "39.50000"]


@pytest.mark.parametrize("names", [("ra", "dec"), ("RAJ2000", "DEJ2000"), ("Alpha", "Delta")])
def test_sky2pix_reads_tables_of_any_angles(results, tmp_path, capsys, names):
    path = str(results / "sim-01.wcs.asdf")
    sky = SkyCoord(*read(path).wcs([10.0, 500.0, 900.0], [20.0, 600.0, 40.0]), unit="deg")
    hours = sky.ra.to_string("hour", sep=":", precision=9)
    degrees = sky.dec.to_string("deg", sep=":", precision=9)
    for ra, dec in (
        (hours, degrees),
        ([h.replace(":", " ") for h in hours], [d.replace(":", " ") for d in degrees]),
        (sky.ra.to_string("hour", precision=9), sky.dec.to_string("deg", precision=9)),
        (sky.ra.to_string("deg", precision=9), sky.dec.deg),
        (sky.ra.hour * u.hourangle, sky.dec.rad * u.rad),
    ):
        table = QTable([ra, dec], names=names)
        table.write(tmp_path / "points.ecsv", overwrite=True)
        assert run(["sky2pix", path, str(tmp_path / "points.ecsv")]) == 0
        found = Table.read(capsys.readouterr().out, format="ascii.ecsv")
        np.testing.assert_allclose(found["x"], [10.0, 500.0, 900.0], atol=1e-5)
        np.testing.assert_allclose(found["y"], [20.0, 600.0, 40.0], atol=1e-5)


def test_missing_positions_of_a_table_give_nan(results, tmp_path, capsys):
    (tmp_path / "a.csv").write_text("name,ra,dec\na,08:00:00,+30:00:00\nb,,\n")
    assert run(["sky2pix", str(results / "sim-01.wcs.asdf"), str(tmp_path / "a.csv")]) == 0
    found = Table.read(capsys.readouterr().out, format="ascii.ecsv")
    assert np.isfinite(found["x"]).tolist() == [True, False]


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("ra,dec\n08:00:00,+30:00:00\nx,y\n", "column 'ra' must hold angles, got 'x' in row 1"),
        ("ra,dec\n08:00:00,95:00:00\n", "column 'dec' must lie in [-90, 90] deg, got 95 in row 0"),
        ("ra,dec\nnorth,south\n", "column 'ra' must be numeric, got 'north'"),
        ("x,y\n1,2\n", "table must have columns 'ra' and 'dec', has x, y"),
    ],
)
def test_sky2pix_refuses_tables_in_one_line(results, tmp_path, capsys, rows, message):
    (tmp_path / "a.csv").write_text(rows)
    assert run(["sky2pix", str(results / "sim-01.wcs.asdf"), str(tmp_path / "a.csv")]) == 2
    assert message in error_of(capsys)


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        (["sky2pix", "{file}", "12:34:56", "south"], 2, "an angle such as -01:02:03, got 'south'"),
        (["sky2pix", "{file}", "12:60:00", "1:2:3"], 2, "such as 12:34:56.7, got '12:60:00'"),
        (["sky2pix", "{file}", "25:00:00", "1:2:3"], 2, "ra must lie in [-360, 360] deg, got 375"),
        (["sky2pix", "{file}", "10", "-91"], 2, "dec must lie in [-90, 90] deg, got -91"),
        (["sky2pix", "{file}", "12:34:56"], 2, "12:34:56: no such file; give ra and dec, or one"),
        (["sky2pix", "{file}", "12:34:56", "1:2:3"], 1, "outside the sky of the detector"),
        (["pix2sky", "{file}", "-100", "5"], 1, "outside the detector"),
        (
            ["export", "{file}", "--format", "tpv", "--output", "o.asdf"],
            2,
            "o.asdf: the name of a file in the format tpv must end with .fits, ends with .asdf",
        ),
        (["export", "{file}", "--format", "stock", "--output", "o.fits"], 2, "end with .asdf, "),
        (["export", "{file}", "--format", "head", "--output", "o.ecsv"], 2, "end with .head, "),
        (["convert", "{file}", "--to", "tpv", "--output", "im.head"], 2, "end with .fits, "),
        (["convert", "{file}", "--to", "asdf", "--output", "im.fits"], 2, "end with .asdf, "),
        (["export", "{file}", "--into", "a.fits", "--output", "b.head"], 2, "end with .fits, "),
        (["detect", "missing.fits", "--output", "o.fits"], 2, "end with .ecsv, ends with .fits"),
        (["sky2pix", "{file}", "300.0", "-60.0"], 1, "outside the sky of the detector"),
        (["pix2sky", "{file}", "1", "2", "3"], 2, "got 3 values"),
        (["pix2sky", "{file}", "1024"], 2, "give x and y, or one table; got 1 value: 1024"),
        (["export", "{file}", "--output", "o"], 2, "export needs --format, one of fits, cpdis, "),
        (["pix2sky", "{file}", "1", "two"], 2, "must be numbers, got 1 two"),
        (["pix2sky", "{file}", "1", "2", "--origin", "2"], 2, "--origin must be 0 or 1, got 2"),
        (["pix2sky", "missing.asdf", "1", "2"], 2, "missing.asdf"),
        (["export", "{file}", "--format", "tnx", "--output", "o"], 2, "--format must be one of"),
        (["export", "missing.asdf", "--format", "sip", "--output", "o"], 2, "missing.asdf"),
        (["evaluate", "missing.matches.ecsv"], 2, "missing.matches.ecsv: no such file"),
        (["detect", "missing.fits", "--output", "o.ecsv"], 2, "missing.fits"),
    ],
)
def test_other_commands_refuse_in_one_line(results, capsys, arguments, status, message):
    arguments = [a.format(file=results / "sim-01.wcs.asdf") for a in arguments]
    assert run(arguments) == status
    assert message in error_of(capsys)


@pytest.mark.parametrize("form", ["fits", "cpdis", "tpv", "head", "sip", "tab", "stock"])
def test_export(results, tmp_path, capsys, form):
    suffix = {"stock": "asdf", "head": "head"}.get(form, "fits")
    out = tmp_path / f"out.{suffix}"
    command = ["export", str(results / "sim-01.wcs.asdf"), "--format", form, "--output", str(out)]
    assert run(command) == 0
    assert out.exists()
    assert f"written as {form}" in capsys.readouterr().out
    assert run(command) == 2
    assert "replaced only with --overwrite" in error_of(capsys)
    assert run([*command, "--overwrite", "-q"]) == 0
    assert capsys.readouterr().out == ""


def test_our_own_source_lists_tell_where_pixels_begin(simulation, inputs, tmp_path, capsys):
    files = write_simulation(simulation, tmp_path / "sky", images=(0,), sources="ecsv")
    image, table = map(str, files["frames"][:2])
    found = str(tmp_path / "found.ecsv")
    assert run(["detect", image, "--output", found, "-q"]) == 0
    for k, (sources, header) in enumerate(((found, image), (table, files["headers"][1]))):
        out = str(tmp_path / f"out{k}")
        arguments = ["--wcs", str(header), "--catalog", inputs[1], "--output", out]
        assert run(["calibrate", sources, *arguments]) == 0
        assert "count from 0" not in capsys.readouterr().err


def test_export_of_several_files_into_a_folder(results, tmp_path, capsys):
    folder = tmp_path / "made" / "heads"
    assert run(["export", str(results), "--format", "head", "--output", str(folder)]) == 0
    names = sorted(p.name.replace(".wcs.asdf", ".head") for p in results.glob("*.wcs.asdf"))
    assert sorted(p.name for p in folder.iterdir()) == names
    assert len(capsys.readouterr().out.splitlines()) == len(names) > 1
    one = results / "sim-01.wcs.asdf"
    alone = tmp_path / "alone.head"
    assert run(["export", str(one), "--format", "head", "--output", str(alone), "-q"]) == 0
    assert alone.read_bytes() == (folder / "sim-01.head").read_bytes()
    assert run(["export", str(one), "--format", "sip", "--output", str(folder), "-q"]) == 0
    assert (folder / "sim-01.sip.fits").exists()
    (tmp_path / "empty").mkdir()
    again = tmp_path / "sim-01.wcs.asdf"
    again.write_bytes(one.read_bytes())
    capsys.readouterr()
    for given, output, message in (
        ([results], folder, "sim-01.head: file exists, and is replaced only with --overwrite"),
        ([results], alone, f"{alone}: the output folder must be a folder, is a file"),
        ([one, again], folder, f"{one} and {again} would both write"),
        ([tmp_path / "empty"], folder, "the folder has no *.wcs.asdf file; try: the output folder"),
    ):
        assert run(["export", *map(str, given), "--format", "head", "--output", str(output)]) == 2
        assert message in error_of(capsys)
    assert run(["export", str(results), "--into", "a.fits"]) == 2
    assert "a.fits: must be a readable file" in error_of(capsys)


def test_matches_have_the_sky_with_errors(results):
    """Positions of the sources scatter about the reference stars as their errors say."""
    for name in ("sim-01", "sim-02"):
        matches = Table.read(results / f"{name}.matches.ecsv")
        used = np.asarray(matches["used"])
        east = (matches["source_ra"] - matches["ra"]) * np.cos(np.radians(matches["dec"]))
        north = matches["source_dec"] - matches["dec"]
        for offset, error in ((east, "ra_error"), (north, "dec_error")):
            pull = np.asarray(offset)[used] * 3.6e6 / np.asarray(matches[error])[used]
            assert 0.8 < mad_std(pull) < 1.2


def test_export_into_an_image(results, tmp_path, capsys):
    file, image, copy = results / "sim-01.wcs.asdf", tmp_path / "a.fits", tmp_path / "b.fits"
    fits.writeto(image, np.zeros((1024, 1024), np.float32))
    before = image.read_bytes()
    command = ["export", str(file), "--into", str(image)]
    assert run([*command, "--output", str(copy), "--format", "sip", "--degree", "4"]) == 0
    assert f"{copy}: written as sip (greatest deviation " in capsys.readouterr().out
    assert image.read_bytes() == before
    assert fits.getheader(copy)["A_ORDER"] == 4
    assert run(command) == 0
    out = capsys.readouterr().out
    assert f"{image}: written as tpv (greatest deviation " in out
    header = fits.getheader(image)
    assert header["CTYPE1"] == "RA---TPV"
    exact = read(file).wcs.pixel_to_world(1000.0, 1000.0)
    worst = float(re.search(r"deviation (\S+) px", out)[1])
    scale = np.sqrt(abs(np.linalg.det(read(file).cd)))
    assert WCS(header).pixel_to_world(1000.0, 1000.0).separation(exact).deg < 1.1 * worst * scale
    for wrong, message in (
        (["--format", "head"], "--format must be one of tpv, sip, cpdis, fits, tab with --into"),
        (["--alternates", "drop"], "--alternates must be keep or remove, got 'drop'"),
        (["--degree", "8"], "degree must be from 1 to 7 for TPV, got 8"),
        (["--output", str(copy)], "replaced only with --overwrite"),
    ):
        assert run([*command, *wrong]) == 2
        assert message in error_of(capsys)
    assert run(["export", str(file), "--format", "sip"]) == 2
    assert "needs --output FILE or DIR, or --into IMAGE" in error_of(capsys)


def test_evaluate_prints_and_writes(results, tmp_path, capsys):
    assert run(["evaluate", str(results)]) == 0
    out = capsys.readouterr().out
    assert "sim-01" in out
    assert "sigma_dx" in out
    table = tmp_path / "table.ecsv"
    assert run(["evaluate", str(results / "sim-02.wcs.asdf"), "--output", str(table)]) == 0
    found = Table.read(table)
    assert list(found["frame"]) == ["sim-02"]
    assert 0.01 < found["sigma_dx"][0] < 0.1


def test_evaluate_compares_the_weights(results, tmp_path, capsys):
    assert run(["evaluate", str(results)]) == 0
    out = capsys.readouterr().out
    for name in ("exp-sqrt", "gaussian", "inverse", "inverse-square", "uniform"):
        assert len(re.findall(rf"^sim +{name} .*(?:no|yes) ", out, re.MULTILINE)) == 2
    table = tmp_path / "table.ecsv"
    command = ["evaluate", str(results), "--output", str(table)]
    assert run([*command, "--plots", str(tmp_path / "plots")]) == 0
    weights = Table.read(tmp_path / "table.weights.ecsv")
    assert len(weights) == 10
    assert np.all(weights["n"] > 800)
    # 0.05 px of centroid noise are left with a table, whatever the weight
    assert np.ptp(weights["sigma_dx"][weights["table"] == "yes"]) < 0.003
    names = sorted(p.name for p in (tmp_path / "plots").iterdir())
    assert names == sorted(
        ["sim.weights.png"]
        + [f"sim-0{k}.{kind}.png" for k in (1, 2)
           for kind in ("cdf", "magnitude", "maps", "residuals")]
    )  # fmt: skip
    assert run(command) == 2
    assert "table.ecsv: file exists" in error_of(capsys)
    assert run(["evaluate", str(results), "--no-weights"]) == 0
    assert "uniform" not in capsys.readouterr().out


def test_matches_have_the_magnitudes_of_the_catalog(inputs, results):
    catalog = Table.read(inputs[1])
    for path in sorted(results.glob("*.matches.ecsv")):
        matches = Table.read(path)
        expected = np.asarray(catalog["phot_g_mean_mag"])[matches["catalog_index"]]
        np.testing.assert_allclose(matches["phot_g_mean_mag"], expected, atol=1e-6)
        assert np.all(matches["snr"] > 0)


def test_report_is_written_once(results, tmp_path, capsys):
    page = tmp_path / "page.html"
    assert run(["report", str(results), "--output", str(page)]) == 0
    assert "report of 2 frames" in capsys.readouterr().out
    assert "sim-02" in page.read_text()
    assert run(["report", str(results), "--output", str(page)]) == 2
    assert "replaced only with --overwrite" in error_of(capsys)


def test_missing_plotting_packages_are_named(results, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("wpdc_gwcs.extras.find_spec", lambda name: None)
    assert run(["report", str(results), "--output", str(tmp_path / "page.html")]) == 2
    assert "needs matplotlib and jinja2, not installed here" in error_of(capsys)


def test_monitor_tells_a_changed_table(results, tmp_path, capsys):
    solution = str(results / "sim.solution.asdf")
    assert run(["monitor", solution, str(results)]) == 0
    assert "sim: no drift found" in capsys.readouterr().out
    matches = Table.read(results / "sim-01.matches.ecsv")
    matches["dx"][(matches["x"] < 512) & (matches["y"] < 512)] += 0.1
    matches.write(tmp_path / "sim-01.matches.ecsv")
    cells = tmp_path / "cells.ecsv"
    assert run(["monitor", solution, str(tmp_path), "--output", str(cells)]) == 1
    out = capsys.readouterr().out
    assert "sim: has drifted" in out
    by, area = re.search(r"by (0\.\d+) px rms in (\d+)% of the detector", out).groups()
    assert abs(float(by) - 0.1) < 0.02
    assert abs(int(area) - 25) < 8
    assert Table.read(cells)["changed"][0]
    assert run(["monitor", str(results / "sim-01.wcs.asdf"), str(tmp_path)]) == 2
    assert "needs a *.solution.asdf or *.camera.asdf file" in error_of(capsys)


def test_a_suffix_that_belongs_to_no_format_is_accepted(results, tmp_path, capsys):
    for format, name in (("tpv", "a.hdr"), ("head", "a.txt"), ("stock", "a"), ("sip", "a.FIT")):
        command = ["export", str(results / "sim-01.wcs.asdf"), "--format", format]
        assert run([*command, "--output", str(tmp_path / name)]) == 0
        assert (tmp_path / name).exists()


def test_sky_outside_names_the_center_and_hours(results, simulation, capsys):
    file = str(results / "sim-01.wcs.asdf")
    ny, nx = simulation.exposures[0].frame().image_shape
    center = read(file).wcs((nx - 1) / 2, (ny - 1) / 2)
    assert run(["sky2pix", file, f"{center[0] / 15:.7f}", f"{center[1]:.7f}"]) == 1
    captured = capsys.readouterr()
    assert captured.out == "nan nan\n"
    found = re.search(r"center is RA (\S+) Dec (\S+) deg; if (\S+) is in hours, RA is (\S+) deg",
                      captured.err)  # fmt: skip
    np.testing.assert_allclose([float(found[1]), float(found[2])], center, atol=1e-5)
    assert float(found[4]) == pytest.approx(center[0], abs=1e-4)
    # Sexagesimal positions are in hours anyway, and other numbers are elsewhere in hours too.
    for wrong in (("1:2:3", "1:2:3"), ("300.0", "-60.0"), (str(center[0] + 5), str(center[1]))):
        assert run(["sky2pix", file, *wrong]) == 1
        line = error_of(capsys)
        assert "whose center is RA" in line
        assert "hours" not in line


def test_match_alone(inputs, tmp_path, capsys):
    frames, reference = inputs
    out = tmp_path / "pairs.ecsv"
    assert run(["match", frames[0], "--catalog", reference, "--output", str(out)]) == 0
    assert "pairs" in capsys.readouterr().out
    assert len(Table.read(out)) > 400


def test_help_and_version(capsys):
    assert run(["--version"]) == 0
    assert capsys.readouterr().out.startswith("wpdc_gwcs ")
    for command in ("calibrate", "detect", "match", "evaluate", "export", "pix2sky", "sky2pix",
                    "simulate", "demo"):  # fmt: skip
        assert run([command, "--help"]) == 0
        assert f"wpdc {command}" in capsys.readouterr().out


def test_parallel_frames_give_the_same_answer(inputs, results, tmp_path):
    frames, reference = inputs
    command = [sys.executable, "-c", "from wpdc_gwcs.cli import main; main()", "calibrate"]
    subprocess.run(
        [*command, *frames, "--catalog", reference, "--output", str(tmp_path), "--jobs", "2"],
        check=True,
        timeout=240,
    )
    for name in ("sim-01", "sim-02"):
        one, two = (read(folder / f"{name}.wcs.asdf") for folder in (results, tmp_path))
        np.testing.assert_allclose(one.wcs(7.0, 9.0), two.wcs(7.0, 9.0), rtol=0, atol=1e-10)


def test_real_frame_is_right_at_stars_it_has_not_seen(shared_data, tmp_path):
    catalog = Table.read(shared_data / "wircam" / "gaia_dr2.fits")
    held_out = np.random.default_rng(4).uniform(size=len(catalog)) < 0.2
    catalog[~held_out].write(tmp_path / "catalog.fits")
    frame = shared_data / "wircam" / "wircam_J_1325839p.fits.fz"
    out = tmp_path / "out"
    status = run(
        ["calibrate", str(frame), "--catalog", str(tmp_path / "catalog.fits"), "--output", str(out),
         "-q"]
    )  # fmt: skip
    assert status == 0
    stem = out / "wircam_J_1325839p"
    sources = Table.read(f"{stem}.sources.ecsv")
    epoch = read_frames(frame)[0].epoch
    stars = propagate(read_catalog(catalog[held_out]), epoch)
    with asdf.open(f"{stem}.wcs.asdf", lazy_load=False) as file:
        found = SkyCoord(*file["wcs"](sources["x"].data, sources["y"].data), unit="deg")
    true = SkyCoord(stars["ra"], stars["dec"], unit="deg")
    nearest, separation, _ = true.match_to_catalog_sky(found)
    near = separation < 0.6 * u.arcsec
    east, north = (a.to_value(u.mas) for a in true[near].spherical_offsets_to(found[nearest[near]]))
    assert near.sum() > 500
    # SExtractor and SCAMP leave 27 and 33 mas with a cubic, 19 and 27 mas with degree 5
    assert mad_std(east) < 17
    assert mad_std(north) < 20
    assert abs(np.median(east)) < 5
    assert abs(np.median(north)) < 5
