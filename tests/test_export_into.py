"""WCSs of a mosaic in the extensions of its image; truth are the calibrations themselves."""

import dataclasses
import re
import warnings

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.time import Time
from astropy.wcs import WCS
from test_io_formats import distance, grid, make_calibration

from wpdc_gwcs import write
from wpdc_gwcs.cli.app import run
from wpdc_gwcs.exceptions import InputError
from wpdc_gwcs.io.assignment import assign_extensions, frames_of_image
from wpdc_gwcs.io.embed import write_into

DETECTORS = ("N1", "N2", "S1", "S2")
DATE = "2016-05-01T03:00:00"


def calibrations_of(frame, detectors=DETECTORS, *, n=96):
    """Calibrations of the detectors of an exposure, 0.1 deg apart, by detector."""
    result = {}
    for k, name in enumerate(detectors):
        one = make_calibration(n=n, amplitude=2.0, seed=k, crval=(294.6 + 0.1 * k, 35.1))
        solution = dataclasses.replace(one.solution, detector=name)
        result[name] = dataclasses.replace(one, frame=f"{frame}_{name}", solution=solution)
    return result


def header_of(calibration, *, off=0.003):
    """Header with a rough WCS of a calibration."""
    ny, nx = calibration.solution.image_shape
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crpix = [(nx + 1) / 2, (ny + 1) / 2]
    wcs.wcs.crval = np.array(calibration.wcs((nx - 1) / 2, (ny - 1) / 2)) + off
    wcs.wcs.cd = calibration.cd
    return wcs.to_header()


def write_image(path, calibrations, *, checksum=False):
    """Write an image with an extension for each calibration, a table among them."""
    primary = fits.PrimaryHDU()
    primary.header["INSTRUME"], primary.header["DATE-OBS"] = "camera", DATE
    primary.header["EXPTIME"] = 30.0
    hdus = [primary]
    rng = np.random.default_rng(1)
    for name, one in calibrations.items():
        data = rng.integers(0, 1000, one.solution.image_shape).astype(np.int16)
        hdus.append(fits.ImageHDU(data, header_of(one), name=name))
    hdus.insert(2, fits.BinTableHDU.from_columns([fits.Column("A", "D", array=[1.0])], name="LOG"))
    fits.HDUList(hdus).writeto(path, checksum=checksum)


@pytest.fixture(scope="module")
def exposures():
    return {"a": calibrations_of("a"), "b": calibrations_of("b")}


@pytest.fixture
def folder(tmp_path, exposures):
    """A folder with two images and the results of both."""
    (tmp_path / "results").mkdir()
    for name, calibrations in exposures.items():
        write_image(tmp_path / f"{name}.fits", calibrations)
        for one in calibrations.values():
            write(one, tmp_path / "results" / f"{one.frame}.wcs.asdf")
    return tmp_path


def assert_has(path, calibrations, worst):
    """Every extension has its WCS to `worst` px."""
    with fits.open(path, checksum=True) as hdus:  # warnings are errors
        for (name, one), limit in zip(calibrations.items(), worst, strict=True):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                wcs = WCS(hdus[name].header, hdus)
            assert distance(one, wcs.all_pix2world(*grid(one), 0)) < limit


def run_well(capsys, *arguments):
    assert run([*map(str, arguments)]) == 0
    return capsys.readouterr()


def refusal(capsys, *arguments):
    assert run([*map(str, arguments)]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    return line


@pytest.mark.parametrize("form", ["tpv", "sip", "cpdis", "tab"])
def test_a_folder_writes_all_extensions(folder, exposures, capsys, form):
    image = folder / "a.fits"
    image.unlink()
    write_image(image, exposures["a"], checksum=True)
    other = (folder / "b.fits").read_bytes()
    out = run_well(capsys, "export", folder / "results", "--into", image, "--format", form).out
    names = [line.split()[1] for line in out.splitlines()]
    assert names == [f"a_{name}.wcs.asdf" for name in DETECTORS]
    stated = [float(found) for found in re.findall(r"deviation (\S+) px", out)]
    assert max(stated) < (0.3 if form in ("tpv", "sip") else 0.002)
    assert_has(image, exposures["a"], worst=[1.06 * d for d in stated])  # two digits are printed
    assert (folder / "b.fits").read_bytes() == other


def test_the_same_as_one_by_one(folder, exposures, capsys):
    one_by_one, together = folder / "one.fits", folder / "new" / "a.fits"
    together.parent.mkdir()
    one_by_one.write_bytes((folder / "a.fits").read_bytes())
    for name, one in exposures["a"].items():
        write_into(one, f"{one_by_one}[{name}]", form="cpdis")
    run_well(
        capsys, "export", folder / "results", "--into", folder / "a.fits", "--format", "cpdis",
        "--output", together,
    )  # fmt: skip
    assert together.read_bytes() == one_by_one.read_bytes()
    with fits.open(folder / "a.fits") as hdus:
        assert "WCSDVARR" not in [hdu.name for hdu in hdus]
    # From the WCS that is there now: the same file.
    run_well(capsys, "export", folder / "results", "--into", together, "--format", "cpdis")
    assert together.read_bytes() == one_by_one.read_bytes()


def test_a_failed_frame_keeps_its_wcs(folder, exposures, capsys):
    image = folder / "a.fits"
    before = fits.getheader(image, "N2")
    (folder / "results" / "a_N2.wcs.asdf").unlink()
    err = run_well(capsys, "export", folder / "results", "--into", image).err
    assert err == f"wpdc: warning: {image}: no WCS for a_N2: left as it was\n"
    assert fits.getheader(image, "N2").tostring() == before.tostring()
    assert fits.getheader(image, "S2")["CTYPE1"] == "RA---TPV"


def test_either_all_or_nothing(folder, exposures, capsys):
    """A detector of another shape, after others that fit."""
    image = folder / "a.fits"
    wrong = calibrations_of("a", ("S2",), n=64)["S2"]
    wrong = dataclasses.replace(wrong, crval=exposures["a"]["S2"].crval)
    write(wrong, folder / "results" / "a_S2.wcs.asdf", overwrite=True)
    before = image.read_bytes()
    line = refusal(capsys, "export", folder / "results", "--into", image)
    assert "a.fits[5]: must have the shape of the detector, 64 x 80 px, has 96 x 112" in line
    assert image.read_bytes() == before
    assert sorted(p.name for p in folder.iterdir()) == ["a.fits", "b.fits", "results"]


def test_one_file_finds_its_extension(folder, capsys):
    out = run_well(
        capsys, "export", folder / "results" / "a_S1.wcs.asdf", "--into", folder / "a.fits"
    ).out
    assert out.startswith(f"{folder / 'a.fits'}[4]: a_S1.wcs.asdf written as tpv")
    kinds = [fits.getheader(folder / "a.fits", name)["CTYPE1"] for name in DETECTORS]
    assert kinds == ["RA---TAN", "RA---TAN", "RA---TPV", "RA---TAN"]


def test_a_renamed_image_has_the_same_detectors(folder, exposures, capsys):
    copy = folder / "reduced.fits"
    (folder / "a.fits").rename(copy)
    line = refusal(capsys, "export", folder / "results", "--into", copy)
    assert "has no WCS file of" in line
    assert "such as reduced_N1.wcs.asdf" in line
    files = sorted((folder / "results").glob("a_*.wcs.asdf"))
    run_well(capsys, "export", *files, "--into", copy, "--format", "cpdis")
    assert_has(copy, exposures["a"], worst=[0.002] * 4)


def test_refusals(folder, capsys):
    results, image = folder / "results", folder / "a.fits"
    both = [results / f"{frame}_N1.wcs.asdf" for frame in "ab"]
    before = image.read_bytes()
    for given, into, message in (
        ([results], f"{image}[N1]", "takes one FILE; without [N1], all extensions are written"),
        (both, f"{image}[N1]", "takes one FILE"),
        (both, image, f"{both[0]} and {both[1]} both belong to {image}[1]; give one"),
        ([folder], image, f"{folder}: has no WCS file of {image}, such as a_N1.wcs.asdf"),
        ([results], folder / "c.fits", "c.fits: must be a readable file"),
        ([folder / "none"], image, "none: must be a readable file"),
    ):
        assert message in refusal(capsys, "export", *given, "--into", into)
    copy = folder / "copy.fits"
    copy.write_text("mine")
    line = refusal(capsys, "export", results, "--into", image, "--output", copy)
    assert "replaced only with --overwrite" in line
    assert copy.read_text() == "mine"
    assert image.read_bytes() == before


def test_an_image_with_its_errors(tmp_path, exposures, capsys):
    """They are images too, and have the same shape."""
    one, image = exposures["a"]["N1"], tmp_path / "a.fits"
    data = np.zeros(one.solution.image_shape, np.float32)
    hdus = [fits.ImageHDU(data, header_of(one), name=name) for name in ("SCI", "ERR", "DQ")]
    fits.HDUList([fits.PrimaryHDU(), *hdus]).writeto(image)
    write(one, tmp_path / "a.wcs.asdf")
    for given in (tmp_path / "a.wcs.asdf", tmp_path):
        line = refusal(capsys, "export", given, "--into", image)
        assert "has 3 images of two axes, of which one is a frame; choose it with path[EXT]" in line
    run_well(capsys, "export", tmp_path / "a.wcs.asdf", "--into", f"{image}[SCI]")
    kinds = [fits.getheader(image, name)["CTYPE1"] for name in ("SCI", "ERR", "DQ")]
    assert kinds == ["RA---TPV", "RA---TAN", "RA---TAN"]


def test_calibrations_of_others_are_refused(tmp_path, exposures):
    image = tmp_path / "a.fits"
    write_image(image, exposures["a"])
    frames = frames_of_image(image)
    one = exposures["b"]["N1"]
    epoch = frames[1].epoch
    late = dataclasses.replace(one, provenance={"epochs": (epoch + 1e-3, epoch + 1e-3)})
    right = dataclasses.replace(one, provenance={"epochs": (epoch, epoch)})
    far = dataclasses.replace(right, crval=right.crval + [1.0, 0.0])
    alien = dataclasses.replace(one, solution=dataclasses.replace(one.solution, detector="X"))
    assert assign_extensions(image, frames, {"f": right}) == {1: "f"}
    for wrong, message in (
        (late, r"a.fits\[1\]: is of epoch 2016.33\d+, f of 2016.33\d+: not the same exposure"),
        (far, r"its header points 0.8\d+ deg away from f: not the same exposure"),
        (alien, "f: is of frame b_N1 and detector X; .* has frames a_N1, a_N2, a_S1, a_S2 and"),
    ):
        with pytest.raises(InputError, match=message):
            assign_extensions(image, frames, {"f": wrong})


def test_of_many_frames_some_are_named(tmp_path, exposures):
    names = [f"D{k}" for k in range(20)]
    image, one = tmp_path / "a.fits", exposures["a"]["N1"]
    write_image(image, dict.fromkeys(names, one))
    alien = dataclasses.replace(one, solution=dataclasses.replace(one.solution, detector="X"))
    with pytest.raises(InputError, match=r"a_D11, \.\.\. \(20 frames\) and detectors D0, "):
        assign_extensions(image, frames_of_image(image), {"f": alien})


def test_a_solution_goes_by_its_detector(tmp_path, exposures):
    image = tmp_path / "a.fits"
    write_image(image, exposures["a"])
    solutions = {name: one.solution for name, one in exposures["a"].items()}
    found = assign_extensions(image, frames_of_image(image), solutions)
    assert found == {1: "N1", 3: "N2", 4: "S1", 5: "S2"}


def write_one(path, one, **cards):
    """Write an image of one detector that has the shape of a calibration."""
    header = header_of(one)
    header.update({key.replace("_", "-"): value for key, value in cards.items()})
    fits.writeto(path, np.zeros(one.solution.image_shape, np.int16), header)


@pytest.fixture
def dated(tmp_path, exposures):
    """Calibration of a 600 s exposure from `DATE` on, and its file."""
    middle = Time(DATE, scale="utc") + 300 * u.s
    epoch = middle.tt.jyear
    one = dataclasses.replace(exposures["a"]["N1"], provenance={"epochs": (epoch, epoch)})
    file = tmp_path / "results.wcs.asdf"
    write(one, file)
    return one, file


@pytest.mark.parametrize(
    "cards",
    [
        {"DATE_OBS": DATE, "EXPTIME": 600.0},
        {"MJD_OBS": Time(DATE, scale="utc").mjd, "EXPTIME": 600.0, "DETECTOR": "N1"},
        # The start of the exposure in place of its middle, as some programs write it.
        {"DATE_AVG": DATE, "EXPTIME": 600.0},
        {"DATE_BEG": DATE, "DATE_END": "2016-05-01T03:10:00", "DATE": "2026-01-01"},
        {"DATE": "2026-01-01"},
        {"OBJECT": "no date"},
        {"DATE_OBS": DATE, "EXPTIME": 600.0, "EXTNAME": "SCI"},
    ],
)
def test_a_processed_copy_is_accepted(tmp_path, dated, capsys, cards):
    one, file = dated
    write_one(tmp_path / "copy.fits", one, **cards)
    out = run_well(capsys, "export", file, "--into", tmp_path / "copy.fits").out
    assert "copy.fits: written as tpv" in out


@pytest.mark.parametrize(
    ("cards", "message"),
    [
        # The next exposure begins ten seconds after the end of this one.
        ({"DATE_OBS": "2016-05-01T03:10:10", "EXPTIME": 600.0}, "not the same exposure"),
        ({"DATE_OBS": "2016-05-02T03:00:00", "EXPTIME": 600.0}, "not the same exposure"),
        ({"DATE_OBS": DATE, "EXPTIME": 600.0, "DETECTOR": "N2"}, "is of detector N2, "),
        ({"DETECTOR": "N2"}, "of N1: not the same detector"),
    ],
)
@pytest.mark.parametrize("extension", ["", "[0]"])
def test_one_file_of_another_exposure_is_refused(
    tmp_path, dated, capsys, cards, message, extension
):
    one, file = dated
    image = tmp_path / "other.fits"
    write_one(image, one, **cards)
    before = image.read_bytes()
    line = refusal(capsys, "export", file, "--into", f"{image}{extension}")
    assert message in line
    assert f"{image}{extension}: is of " in line
    assert str(file) in line
    assert "; try: --any-exposure" in line
    assert image.read_bytes() == before
    run_well(capsys, "export", file, "--into", f"{image}{extension}", "--any-exposure")
    assert fits.getheader(image)["CTYPE1"] == "RA---TPV"


def test_an_image_of_the_same_name_may_be_of_another_night(tmp_path, dated, capsys):
    one, file = dated
    image = tmp_path / f"{one.frame}.fits"
    write_one(image, one, DATE_OBS="2016-05-02T03:00:00", EXPTIME=600.0)
    assert "not the same exposure" in refusal(capsys, "export", file, "--into", image)
    image.unlink()
    # But a detector may have been named by hand.
    write_one(image, one, DATE_OBS=DATE, EXPTIME=600.0, DETECTOR="E2V")
    run_well(capsys, "export", file, "--into", image)


def test_one_file_is_not_written_into_another_detector(folder, capsys):
    """Of a mosaic whose extensions have the names of their detectors."""
    file, image = folder / "results" / "a_S1.wcs.asdf", folder / "a.fits"
    before = image.read_bytes()
    line = refusal(capsys, "export", file, "--into", f"{image}[N1]")
    assert f"{image}[N1]: is of detector N1, {file} of S1: not the same detector" in line
    assert image.read_bytes() == before
    run_well(capsys, "export", file, "--into", f"{image}[S1]")


def test_another_shape_is_refused_for_any_exposure(tmp_path, dated, capsys):
    one, file = dated
    fits.writeto(tmp_path / "small.fits", np.zeros((10, 20)), header_of(one))
    line = refusal(capsys, "export", file, "--into", tmp_path / "small.fits", "--any-exposure")
    assert "must have the shape of the detector" in line


def test_a_mosaic_of_the_same_names_may_be_of_another_night(folder, exposures, capsys):
    for one in exposures["a"].values():
        late = dataclasses.replace(one, provenance={"epochs": (2017.0, 2017.0)})
        write(late, folder / "results" / f"{one.frame}.wcs.asdf", overwrite=True)
    line = refusal(capsys, "export", folder / "results", "--into", folder / "a.fits")
    assert "not the same exposure; try: --any-exposure" in line
    run_well(capsys, "export", folder / "results", "--into", folder / "a.fits", "--any-exposure")
