"""The file of a camera: detectors that were solved together, and what they are used for."""

from dataclasses import replace

import asdf
import numpy as np
import pytest
from numpy.testing import assert_allclose
from test_mosaic import CENTERS, PLACES, SCALE, SIDE, catalog, make_frames, stars, turn

from wpdc_gwcs import Camera, read, write
from wpdc_gwcs.calibration import calibrate
from wpdc_gwcs.cli.app import run as run_cli
from wpdc_gwcs.cli.calibrate import stored_solutions
from wpdc_gwcs.exceptions import InputError
from wpdc_gwcs.models import deproject

__all__ = ["catalog", "stars"]  # fixtures

EXPOSURES = [((150.0, 0.0), 0.0), ((150.01, 0.01), 0.2)]


@pytest.fixture(scope="module")
def solved(stars, catalog, tmp_path_factory):
    """A run of six detectors and its files."""
    frames = make_frames(stars, EXPOSURES)
    folder = tmp_path_factory.mktemp("camera")
    return calibrate(frames, catalog, output=folder), folder


@pytest.fixture(scope="module")
def path(solved):
    return solved[1] / "CAM.camera.asdf"


def test_places_are_those_of_the_detectors(solved, path):
    run, _ = solved
    (camera,) = run.cameras
    found = read(path)
    assert isinstance(found, Camera)
    assert found.name == "CAM"
    assert set(found.detectors) == set(CENTERS)
    assert_allclose(found.places, camera.places)
    assert_allclose(found.matrices, camera.matrices)
    assert found.learned.keys() == camera.learned.keys()
    # Reference points are those of the headers, where the optics move them by some px.
    for k, name in enumerate(found.detectors):
        at = found.solutions[name].crpix - SIDE / 2 + CENTERS[name] + PLACES[name]
        base = found.solutions[found.reference].crpix - SIDE / 2
        base = base + CENTERS[found.reference] + PLACES[found.reference]
        assert np.hypot(*(found.places[k] - (at - base))) < 60
    # One sky: two detectors agree where the focal plane puts them.
    c = {c.solution.detector: c for c in run.calibrations if c.frame.startswith("e1")}
    base = c[found.reference]
    for name in found.detectors:
        x, y = found.focal_plane(name, 300.0, 500.0)
        ra, dec = deproject(*(base.cd @ [x, y]), base.crval)
        sky = c[name].wcs(300.0, 500.0)
        assert np.hypot(ra - sky[0], dec - sky[1]) < 0.5 * SCALE
    with pytest.raises(KeyError, match="no detector 'D9'"):
        found.focal_plane("D9", 0.0, 0.0)


def test_opens_where_the_package_is_not_installed(path):
    with asdf.open(path) as file:
        assert file["wpdc"]["kind"] == "camera"
        assert set(file["wpdc"]["files"].values()) == {f"{n}.solution.asdf" for n in CENTERS}


def test_a_stored_camera_solves_detectors_of_six_stars(stars, catalog, path):
    few = dict.fromkeys(["C1", "C3", "C5"], 6)
    frames = make_frames(stars, [((149.98, -0.01), 90.0)], few=few, seed=5)
    run = calibrate(frames, catalog, solution=stored_solutions([path]))
    assert run.failures == {}
    for calibration in run.calibrations:
        dx, dy = (calibration.matches[k][calibration.matches["used"]] for k in ("dx", "dy"))
        assert np.hypot(dx, dy).max() < 0.2
    good = {c.solution.detector: c for c in run.calibrations}
    rich = make_frames(stars, [((149.98, -0.01), 90.0)], seed=6)
    for frame in rich:
        if frame.detector not in few:
            continue
        sources = frame.load_sources()
        ra, dec = good[frame.detector].wcs(sources["x"], sources["y"])
        row = np.asarray(sources["true_row"])
        error = np.array([ra - stars["ra"][row], dec - stars["dec"][row]]) / SCALE
        assert np.sqrt(np.nanmean(np.sum(error**2, axis=0))) < 0.15


def test_a_stored_camera_is_updated(stars, catalog, solved, path, tmp_path):
    frames = make_frames(stars, [((150.02, 0.02), 1.0)], seed=9)
    run = calibrate(frames, catalog, solution=read(path), update=True, output=tmp_path)
    assert run.failures == {}
    assert not run.superseded
    for name, one in run.solutions.items():
        before = solved[0].solutions[name].residual_map.n_stars
        assert one.residual_map.n_stars > before
        assert one.statistics["updates"][-1]["process_noise"] == 0
        # The table that the whole camera has made is not made anew of one detector's stars.
        table = solved[0].solutions[name].lookup_table
        assert np.abs(one.lookup_table.dx - table.dx).max() < 0.05
        assert (
            one.statistics["learned"].keys()
            == solved[0].solutions[name].statistics["learned"].keys()
        )
    assert set(read(tmp_path / "CAM.camera.asdf").detectors) == set(CENTERS)


def test_detectors_of_another_camera_fail_each_with_its_reason(stars, catalog, path):
    frames = [replace(f, detector="X" + f.detector) for f in make_frames(stars, EXPOSURES[:1])]
    run = calibrate(frames, catalog, solution=read(path))
    assert len(run.failures) == 6
    assert "is from detector 'XC0', the stored solutions are for 'C0', " in str(
        run.failures["e0_C0"]
    )
    assert list(run.summary["status"]) == ["failed"] * 6
    frames = [replace(f, image_shape=(700, 800)) for f in make_frames(stars, EXPOSURES[:1])]
    run = calibrate(frames, catalog, solution=read(path))
    assert all("shape (ny, nx) (700, 800)" in str(e) for e in run.failures.values())
    assert len(run.failures) == 6


def test_several_files_are_one_camera(solved, path):
    run, folder = solved
    names = [folder / f"{n}.solution.asdf" for n in ("C0", "C1")]
    found = stored_solutions(names)
    assert set(found) == {"C0", "C1"}
    assert stored_solutions(names[:1]).detector == "C0"
    assert stored_solutions([]) is None
    with pytest.raises(InputError, match="detector 'C0' already has a solution, in "):
        stored_solutions([path, names[0]])
    write(run.calibrations[0], folder / "frame.asdf", overwrite=True)
    with pytest.raises(InputError, match=r"needs a \*.solution.asdf or \*.camera.asdf file"):
        stored_solutions([folder / "frame.asdf"])


@pytest.mark.parametrize("what", ["missing", "other", "shape"])
def test_what_does_not_fit_is_refused_in_one_line(solved, path, tmp_path, what, capsys):
    run, _ = solved
    camera = read(path)
    for name, one in camera.solutions.items():
        if what == "missing" and name == "C2":
            continue
        if what == "other" and name == "C2":
            one = replace(one, detector="Z")
        if what == "shape" and name == "C2":
            one = replace(one, image_shape=(900, 900))
        write(one, tmp_path / f"{name}.solution.asdf")
    write(camera, tmp_path / "CAM.camera.asdf")
    command = ["pix2sky", str(tmp_path / "CAM.camera.asdf"), "1", "1"]
    assert run_cli(command) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    reason = {
        "missing": "the file of detector 'C2' is missing",
        "other": "is not the solution of detector 'C2'",
        "shape": "is of shape (ny, nx) (900, 900), the camera's detector 'C2' of (800, 800)",
    }[what]
    assert reason in lines[0]


@pytest.mark.parametrize(
    "command",
    [
        ["pix2sky", "{path}", "1", "1"],
        ["export", "{path}", "--format", "sip", "--output", "{folder}/x.fits"],
    ],
)
def test_commands_for_one_detector_name_what_they_need(path, tmp_path, command, capsys):
    assert run_cli([c.format(path=path, folder=tmp_path) for c in command]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert "is a camera of 6 detectors" in lines[0]


def test_a_camera_is_written_as_asdf_with_all_its_files(solved, path, tmp_path):
    camera = read(path)
    with pytest.raises(ValueError, match="a camera is written as 'asdf'"):
        write(camera, tmp_path / "c.fits")
    with pytest.raises(InputError, match="must name the solution file of each detector"):
        write(replace(camera, files={}), tmp_path / "c.camera.asdf")


def test_turned_exposures_have_one_camera(solved):
    # A roll of the camera turns all of its detectors: their places stay.
    (camera,) = solved[0].cameras
    assert_allclose(camera.matrices, np.broadcast_to(turn(0.0), (6, 2, 2)), atol=0.05)
