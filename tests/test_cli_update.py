"""`wpdc calibrate --solution S --update`: a stored solution grows with new frames."""

import numpy as np
import pytest
from astropy.table import Table

from wpdc_gwcs import read
from wpdc_gwcs.cli.app import run
from wpdc_gwcs.simulation import simulate, write_simulation

SHAPE = (1000, 1024)


@pytest.fixture(scope="module")
def simulation():
    return simulate(6, image_shape=SHAPE, density=40, distortion=20, seed=8)


@pytest.fixture(scope="module")
def inputs(simulation, tmp_path_factory):
    folder = tmp_path_factory.mktemp("input")
    files = write_simulation(simulation, folder, images=(), sources="ldac")
    return [str(f) for f in files["frames"]], str(files["reference"])


@pytest.fixture(scope="module")
def halves(inputs, tmp_path_factory):
    """Solutions of the first and of the last three frames, alone."""
    frames, reference = inputs
    found = []
    for part in (frames[:3], frames[3:]):
        folder = tmp_path_factory.mktemp("half")
        command = ["calibrate", *part, "--catalog", reference, "--output", str(folder), "-q"]
        assert run(command) == 0
        found.append(folder / "sim.solution.asdf")
    return found


@pytest.fixture(scope="module")
def updated(inputs, halves, tmp_path_factory):
    """The first half, and the frames of the second merged into it."""
    frames, reference = inputs
    folder = tmp_path_factory.mktemp("updated")
    before = halves[0].read_bytes()
    status = run(
        ["calibrate", *frames[3:], "--catalog", reference, "--output", str(folder), "-q",
         "--solution", str(halves[0]), "--update"]
    )  # fmt: skip
    assert status == 0
    assert halves[0].read_bytes() == before
    return folder


def distortion_error(solution, simulation, n=61):
    """Rms error of the distortion over the detector, px, but for what attitudes take."""
    y, x = np.mgrid[0 : SHAPE[0] - 1 : n * 1j, 0 : SHAPE[1] - 1 : n * 1j].reshape(2, -1)
    found = np.array(solution.wcs.get_transform("detector", "undistorted")(x, y))
    true = np.array(simulation.distortion.undistort(x, y))
    # The undistorted pixels of two solutions differ by a linear map.
    columns = np.stack([np.ones_like(x), *found], axis=1)
    rest = true.T - columns @ np.linalg.lstsq(columns, true.T, rcond=None)[0]
    return np.sqrt(np.mean(np.sum(rest**2, axis=1)))


def test_residuals_are_merged_in_constant_memory(halves, updated):
    one, two, both = (read(p) for p in (*halves, updated / "sim.solution.asdf"))
    assert both.residual_map.sums.shape == one.residual_map.sums.shape
    matches = [Table.read(p) for p in sorted(updated.glob("*.matches.ecsv"))]
    assert len(matches) == 3
    added = sum(int(m["used"].sum()) for m in matches)
    assert both.residual_map.n_stars == one.residual_map.n_stars + added
    assert abs(added - two.residual_map.n_stars) < 0.01 * added
    assert both.statistics["n_exposures"] == 6
    assert both.statistics["n_used"] == one.statistics["n_used"] + added
    np.testing.assert_array_equal(both.pv.parameters, one.pv.parameters)
    np.testing.assert_array_equal(both.crpix, one.crpix)


def test_updated_solution_is_better_than_either_half(simulation, halves, updated):
    one, two, both = (
        distortion_error(read(p), simulation) for p in (*halves, updated / "sim.solution.asdf")
    )
    assert both < 0.9 * min(one, two)
    assert both < 0.012
    sigma = [np.nanmean(read(p).table_sigma[0]) for p in (halves[0], updated / "sim.solution.asdf")]
    assert sigma[1] < 0.9 * sigma[0]


def test_frames_of_the_update_are_calibrated_with_it(simulation, updated):
    for exposure in simulation.exposures[3:]:
        calibration = read(updated / f"{exposure.name}.wcs.asdf")
        dx, dy = exposure.wcs_error(calibration.wcs)[2:]
        assert np.sqrt(np.mean(dx**2 + dy**2)) < 0.015


def test_updated_solution_can_be_updated_again(inputs, updated, tmp_path):
    frames, reference = inputs
    status = run(
        ["calibrate", frames[0], "--catalog", reference, "--output", str(tmp_path), "-q",
         "--solution", str(updated / "sim.solution.asdf"), "--update"]
    )  # fmt: skip
    assert status == 0
    before, after = (
        read(p / "sim.solution.asdf").residual_map.n_stars for p in (updated, tmp_path)
    )
    assert after > before


def test_solution_of_another_shape_is_refused(halves, tmp_path, capsys):
    other = simulate(1, image_shape=(900, 900), density=40, distortion=20, seed=8)
    files = write_simulation(other, tmp_path / "other", images=(), sources="ldac")
    status = run(
        ["calibrate", *map(str, files["frames"]), "--catalog", str(files["reference"]),
         "--output", str(tmp_path / "out"), "-q", "--solution", str(halves[0]), "--update"]
    )  # fmt: skip
    assert status == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    assert "shape (ny, nx) (900, 900), the stored solution has (1000, 1024)" in lines[0]
    assert not list((tmp_path / "out").glob("*.asdf"))


def test_what_is_no_solution_is_refused(inputs, updated, tmp_path, capsys):
    frames, reference = inputs
    command = ["calibrate", frames[0], "--catalog", reference, "--output", str(tmp_path), "-q"]
    wrong = next(updated.glob("*.wcs.asdf"))
    assert run([*command, "--solution", str(wrong), "--update"]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert "--solution needs a *.solution.asdf or *.camera.asdf file" in lines[0]
    assert run([*command, "--solution", str(updated)]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    hint = f"is a folder; try: --solution {updated / 'sim.solution.asdf'}"
    assert line.endswith(hint)
    assert run([*command, "--solution", str(tmp_path)]) == 2
    assert "file, is a folder; try: the file of this name" in capsys.readouterr().err
    # Nor is a table, whose folder has a solution.
    assert run([*command, "--solution", str(updated / "summary.ecsv")]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "--solution needs a *.solution.asdf or *.camera.asdf file; try: --solution " in line
    assert line.endswith(f"{updated / 'sim.solution.asdf'}")
    assert "--wcs" not in line


@pytest.fixture(scope="module")
def later(tmp_path_factory):
    """Frames of two years later, when the distortion has grown by 3 %."""
    folder = tmp_path_factory.mktemp("later")
    grown = simulate(
        3, image_shape=SHAPE, density=40, distortion=20.6, seed=8, epoch=[2018.5, 2018.6, 2018.7]
    )
    files = write_simulation(grown, folder, images=(), sources="ldac")
    return [str(f) for f in files["frames"]], str(files["reference"])


@pytest.fixture(scope="module")
def followed(halves, later, tmp_path_factory):
    frames, reference = later
    folder = tmp_path_factory.mktemp("followed")
    status = run(
        ["calibrate", *frames, "--catalog", reference, "--output", str(folder),
         "--solution", str(halves[0]), "--update"]
    )  # fmt: skip
    assert status == 0
    return folder


def test_a_change_is_told_and_dated(halves, followed):
    old, new = read(halves[0]), read(followed / "sim.solution.asdf")
    (entry,) = new.statistics["updates"]
    assert entry["process_noise"] > 0
    assert entry["evidence"] > 3
    assert 0.01 < entry["rms_change_px"] < entry["max_change_px"] < 1
    assert abs(entry["first_epoch"] - 2018.5) < 0.01
    assert abs(entry["last_epoch"] - 2018.7) < 0.01
    assert new.valid_from == entry["first_epoch"]
    assert new.valid_to is None
    (kept,) = followed.glob("*.until-*.solution.asdf")
    assert kept.name == f"sim.until-{new.valid_from:.4f}.solution.asdf"
    kept = read(kept)
    assert (kept.valid_from, kept.valid_to) == (None, new.valid_from)
    assert kept.residual_map == old.residual_map
    assert new.provenance["epochs"] == (2016.0, entry["last_epoch"]) or (
        abs(new.provenance["epochs"][0] - 2016.0) < 0.01
    )
    assert len(new.provenance["inputs"]) == 6


def test_the_command_line_says_what_has_changed(halves, inputs, later, tmp_path, capsys):
    for (frames, reference), words in (
        (later, ("sim: changed before 2018.", "px rms", "the old solution is in sim.until-2018.")),
        ((inputs[0][3:], inputs[1]), ("sim: no change found, 3 exposures added",)),
    ):
        status = run(
            ["calibrate", *frames, "--catalog", reference, "--output", str(tmp_path),
             "--solution", str(halves[0]), "--update", "--overwrite"]
        )  # fmt: skip
        assert status == 0
        output = capsys.readouterr().out
        assert all(word in output for word in words), output


def test_monitor_sees_what_the_update_has_seen(halves, inputs, later, tmp_path):
    for name, (frames, reference), status in (
        ("same", (inputs[0][3:], inputs[1]), 0),
        ("other", later, 1),
    ):
        folder = tmp_path / name
        command = ["calibrate", *frames, "--catalog", reference, "--output", str(folder), "-q"]
        assert run([*command, "--solution", str(halves[0]), "--refine", "attitude"]) == 0
        assert run(["monitor", str(halves[0]), str(folder), "-q"]) == status


def test_a_solution_of_another_time_is_a_shortcoming(inputs, followed, tmp_path, capsys):
    frames, reference = inputs
    command = ["calibrate", frames[0], "--catalog", reference, "--output", str(tmp_path), "-q",
               "--solution", str(followed / "sim.solution.asdf")]  # fmt: skip
    assert run(command) == 0
    summary = Table.read(tmp_path / "summary.ecsv")
    assert list(summary["status"]) == ["degraded"]
    assert "the stored solution is valid from 2018." in summary["reason"][0]
    # Nor can they update it.
    capsys.readouterr()
    assert run([*command, "--update", "--overwrite"]) == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "it cannot be updated with it" in line


def test_report_shows_the_solution_that_holds(followed):
    pytest.importorskip("jinja2")
    assert run(["report", str(followed), "--output", str(followed / "page.html"), "-q"]) == 0
    assert (followed / "page.html").stat().st_size > 1000
