"""`wpdc monitor` with frames of any origin; truth are the distortions that were simulated."""

import dataclasses
import re
import shutil

import numpy as np
import pytest
from astropy.table import Table

from wpdc_gwcs import detect_drift, read, write
from wpdc_gwcs.cli.app import run
from wpdc_gwcs.evaluation import has_map_of, residuals_of_attitude
from wpdc_gwcs.io import read_matches, write_table
from wpdc_gwcs.simulation import simulate, write_simulation

SHAPE = (1000, 1024)
NOISE = 0.05  # px, of a typical star


@pytest.fixture(scope="module")
def skies():
    """Five exposures of a detector with 10 px of distortion, and two after it has got 16 px."""
    return {
        name: simulate(n, image_shape=SHAPE, density=40, distortion=amount, seed=8)
        for name, n, amount in (("old", 5, 10), ("new", 2, 16))
    }


@pytest.fixture(scope="module")
def results(skies, tmp_path_factory):
    """Folders of results: how the stored solution was made, and frames with and without it."""
    folder = tmp_path_factory.mktemp("runs")
    files = {
        name: write_simulation(sky, folder / f"{name}-sky", images=(), sources="ldac")
        for name, sky in skies.items()
    }

    def calibrate(name, sky, part, *options):
        frames = [str(f) for f in files[sky]["frames"][part]]
        command = ["calibrate", *frames, "--catalog", str(files[sky]["reference"]), "-q"]
        assert run([*command, "--output", str(folder / name), *options]) == 0

    calibrate("stored", "old", slice(3))
    with_stored = "--solution", str(folder / "stored" / "sim.solution.asdf")
    calibrate("same", "old", slice(3, 5), *with_stored)
    calibrate("same-alone", "old", slice(3, 5))
    calibrate("changed-alone", "new", slice(2))
    calibrate("changed-updated", "new", slice(2), *with_stored, "--update")
    return folder


def monitor(results, capsys, name, *options, solution="stored"):
    """Exit status and output of a test of a solution with some results."""
    file = results / solution / "sim.solution.asdf"
    status = run(["monitor", str(file), str(results / name), *options])
    return status, *capsys.readouterr()


def frames_of(folder):
    """Match tables and calibrations of a folder."""
    for path in sorted(folder.glob("*.wcs.asdf")):
        name = path.name.removesuffix(".wcs.asdf")
        yield read_matches(folder / f"{name}.matches.ecsv"), read(path)


@pytest.mark.parametrize("name", ["changed-alone", "changed-updated"])
def test_a_change_shows_in_frames_with_a_map_of_their_own(results, capsys, name):
    status, out, err = monitor(results, capsys, name)
    assert status == 1
    amount, area = re.search(r"drifted .*by (\S+) px rms in (\d+)%", out, re.DOTALL).groups()
    assert 0.5 < float(amount) < 2
    assert int(area) > 80
    assert f"sim: 2 of 2 frames ({results / name / 'sim-01.matches.ecsv'}, ...): calibrated" in err


def test_residuals_are_those_of_the_two_distortions(skies, results):
    """Of the stored map from the true one, but for a linear map and the noise."""
    stored = read(results / "stored" / "sim.solution.asdf")
    for matches, calibration in frames_of(results / "changed-alone"):
        found = residuals_of_attitude(calibration, matches, solution=stored)
        x, y = np.asarray(matches["x"]), np.asarray(matches["y"])
        true = np.array(skies["new"].distortion.undistort(x, y))
        rows = np.stack([np.ones_like(x), *true], axis=1)
        error = np.asarray(matches["x_err"])
        weight = np.where(matches["used"], 1 / error, 0)[:, None]
        for k, axis in enumerate("xy"):
            target = np.array(stored.undistort(x, y))[k]
            linear = np.linalg.lstsq(rows * weight, target * weight[:, 0])[0]
            expected = target - rows @ linear
            rest = (np.asarray(found[f"d{axis}"]) - expected)[np.asarray(matches["used"])]
            assert expected.std() > 0.5
            assert np.std(rest) < 1.3 * NOISE
        assert found["dx"].unit == "pix"
        # The arguments stay as they were.
        assert np.std(matches["dx"]) < 1.3 * NOISE


def test_frames_of_the_solution_are_tested_as_they_are(results, capsys):
    stored = read(results / "stored" / "sim.solution.asdf")
    frames = list(frames_of(results / "same"))
    for matches, calibration in frames:
        assert has_map_of(calibration, stored)
        found, own = (
            residuals_of_attitude(calibration, matches, solution=s) for s in (stored, None)
        )
        np.testing.assert_array_equal(found["dx"], own["dx"])
    p_value = detect_drift(stored, [residuals_of_attitude(c, m) for m, c in frames]).p_value
    status, out, err = monitor(results, capsys, "same")
    assert status == 0
    assert f"no drift found (p = {p_value:.2g}, " in out
    assert err == ""


def test_stable_frames_with_a_map_of_their_own_do_not_alarm(results, capsys):
    status, out, err = monitor(results, capsys, "same-alone")
    assert status == 0
    assert "sim: no drift found" in out
    assert "2 of 2 frames" in err


def test_an_updated_solution_is_the_map_of_its_frames(results, capsys):
    status, out, err = monitor(results, capsys, "changed-updated", solution="changed-updated")
    assert (status, err) == (0, "")
    assert "no drift found" in out


def test_each_period_is_about_the_stored_solution(results, tmp_path, capsys):
    out = tmp_path / "drift.ecsv"
    options = "--every", "1", "--output", str(out), "--plots", str(tmp_path / "plots")
    status, _, err = monitor(results, capsys, "changed-alone", *options)
    assert status == 1
    assert err.count("2 of 2 frames") == 1
    assert Table.read(out)["drifted"].all()


def test_tables_alone_cannot_be_checked(results, tmp_path, capsys):
    for path in (results / "same").glob("*.matches.ecsv"):
        shutil.copy(path, tmp_path)
    status = run(["monitor", str(results / "stored" / "sim.solution.asdf"), str(tmp_path)])
    (line,) = capsys.readouterr().err.splitlines()
    assert status == 0
    assert "2 of 2 frames" in line
    assert "no *.wcs.asdf file beside the match table" in line
    assert "cannot be checked" in line


def test_frames_of_another_time_are_told(results, tmp_path, capsys):
    old = dataclasses.replace(read(results / "stored" / "sim.solution.asdf"), valid_to=2010.0)
    write(old, tmp_path / "sim.solution.asdf")
    assert run(["monitor", str(tmp_path / "sim.solution.asdf"), str(results / "same")]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert "2 of 2 frames" in line
    assert line.endswith("another time than the stored solution, which is valid until 2010.0000")


def test_frames_of_another_shape_are_refused(results, tmp_path, capsys):
    stored = read(results / "stored" / "sim.solution.asdf")
    write(dataclasses.replace(stored, image_shape=(500, 512)), tmp_path / "s.solution.asdf")
    assert run(["monitor", str(tmp_path / "s.solution.asdf"), str(results / "same")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "sim-04.matches.ecsv: must have the shape (ny, nx) of the stored solution, " in line
    assert "(500, 512), has (1000, 1024)" in line


def test_a_frame_with_too_few_stars_for_an_attitude_is_left_out(results, tmp_path, capsys):
    for path in (results / "changed-alone").glob("sim-0*"):
        shutil.copy(path, tmp_path)
    poor = tmp_path / "sim-01.matches.ecsv"
    write_table(read_matches(poor)[:5], poor, overwrite=True)
    status = run(["monitor", str(results / "stored" / "sim.solution.asdf"), str(tmp_path)])
    captured = capsys.readouterr()
    assert status == 1
    assert f"1 of 2 frames ({poor}): left out" in captured.err
    assert "has drifted" in captured.out
