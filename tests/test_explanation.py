"""What `wpdc explain` and `wpdc show` say, and how results show themselves in a notebook."""

import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from astropy.table import Table
from astropy.wcs import WCS

from wpdc_gwcs import Settings, calibrate, simulate, write
from wpdc_gwcs.calibration.start import linear_wcs
from wpdc_gwcs.cli.app import run
from wpdc_gwcs.description import as_html, describe
from wpdc_gwcs.explanation import explain_frame
from wpdc_gwcs.pictures import draw_explanation


@pytest.fixture(scope="module")
def sky():
    return simulate(1, image_shape=(512, 512), density=60.0, distortion=5.0, seed=3)


@pytest.fixture(scope="module")
def solved(sky):
    return calibrate(sky.exposures[0].frame(), sky.reference)


def changed(frame, degrees=0.0, scale=1.0):
    wcs = frame.wcs.deepcopy()
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    wcs.wcs.cd = wcs.wcs.cd @ [[c, -s], [s, c]] * scale
    return replace(frame, wcs=wcs)


def test_a_frame_that_is_solved(sky, solved):
    told = explain_frame(sky.exposures[0].frame(), sky.reference)
    assert told.status == "solved"
    assert [s.name for s in told.stages] == ["frame", "sources", "catalog", "match", "solution"]
    assert all(stage.went_well for stage in told.stages)
    assert not told.advice
    # It is the same solution as that of a run.
    same = solved.calibrations[0]
    np.testing.assert_allclose(told.calibration.wcs(9.0, 9.0), same.wcs(9.0, 9.0), rtol=1e-12)
    assert f"{same.statistics['n_used']} of" in told.stages[-1].lines[0]
    figure = draw_explanation(told)
    assert [axes.has_data() for axes in figure.axes] == [True] * 4


@pytest.mark.parametrize("angle", [8.0, 90.0, 157.0])
def test_a_turned_frame_is_found_out_by_a_blind_search(sky, angle):
    frame = changed(sky.exposures[0].frame(), angle)
    told = explain_frame(frame, sky.reference)
    assert told.status == "failed"
    assert [s.name for s in told.stages if not s.went_well] == ["match"]
    advice = " ".join(told.advice)
    assert "it matches with --blind" in advice
    assert f"-{angle:.1f} deg" in advice
    # The advice is right.
    assert explain_frame(frame, sky.reference, Settings(blind=True)).status == "solved"
    figure = draw_explanation(told)
    assert "no solution: ends with the match" in figure.axes[3].texts[0].get_text()


@pytest.mark.parametrize(
    ("scale", "angle", "options"),
    [(2.0, 0.0, ""), (0.5, 40.0, " --blind"), (1.08, 0.0, ""), (1.08, 30.0, " --blind")],
)
def test_a_wrong_scale_is_found_out(scale, angle, options):
    # Few stars, so that the searches that fail take little time.
    sky = simulate(1, image_shape=(512, 512), density=15.0, distortion=5.0, seed=3)
    frame = sky.exposures[0].frame()
    true = 3600 * np.sqrt(abs(np.linalg.det(frame.wcs.wcs.cd)))
    told = explain_frame(changed(frame, angle, scale), sky.reference)
    assert told.status == "failed"
    found = re.search(r"it matches with --pixel-scale (\S+)(.*?) \(", " ".join(told.advice))
    assert float(found[1]) == pytest.approx(true, rel=0.005)
    assert found[2] == options


def test_a_catalog_of_another_sky(sky):
    reference = Table(sky.reference)
    reference["dec"] = np.asarray(reference["dec"]) - 20
    told = explain_frame(sky.exposures[0].frame(), reference)
    assert told.status == "failed"
    assert told.stages[-1].name == "catalog"
    assert "no star within" in told.reasons[0]
    assert "its nearest star is 20 deg away" in told.reasons[0]
    assert "--wcs HEADER" in told.advice[0]
    assert "wpdc catalog prepare gaia --around" in told.advice[1]
    draw_explanation(told)


def test_a_frame_without_an_epoch_and_one_without_stars(sky):
    frame = sky.exposures[0].frame()
    told = explain_frame(replace(frame, epoch=None), sky.reference)
    assert told.status == "degraded"
    assert any("--epoch" in advice for advice in told.advice)
    few = frame.load_sources()[:5]
    told = explain_frame(replace(frame, load_sources=lambda: few), sky.reference)
    assert told.status == "failed"
    assert "5 of 5 sources used" in told.stages[1].lines[0]
    empty = replace(frame, load_sources=lambda: few[:0])
    told = explain_frame(empty, sky.reference)
    assert [s.name for s in told.stages] == ["frame", "sources"]
    assert told.sources is None
    draw_explanation(told)


def test_a_frame_of_no_place(sky):
    class Nowhere:
        def pixel_to_world_values(self, x, y):
            return np.full(np.shape(x), np.nan), np.full(np.shape(x), np.nan)

    told = explain_frame(replace(sky.exposures[0].frame(), wcs=Nowhere()), sky.reference)
    assert told.status == "failed"
    assert "--wcs" in told.advice[0]


def test_results_in_a_notebook(solved):
    calibration, solution = solved.calibrations[0], solved.solutions["sim"]
    for result in (calibration, solution, solved):
        html = result._repr_html_()
        assert html == as_html(result)
        assert html.startswith("<table><caption>")
    for result in (calibration, solution, solved, *solved.cameras):
        assert repr(result).startswith(f"<{type(result).__name__}\n")
        assert len(repr(result)) < 1000
        assert all(text in repr(result) for _, text in describe(result))
    lines = dict(describe(calibration))
    assert lines["frame"] == "sim-01, solved"
    assert f"{calibration.statistics['n_used']} of" in lines["stars"]
    x, y = np.meshgrid(np.linspace(0, 511, 21), np.linspace(0, 511, 21))
    u, v = solution.undistort(x.ravel(), y.ravel())
    most = np.hypot(u - x.ravel(), v - y.ravel()).max()
    assert f"up to {most:.2f} px" in dict(describe(solution))["distortion"]
    assert "<b>" not in as_html(replace(calibration, frame="<b>"))
    with pytest.raises(TypeError, match="cannot describe a int"):
        describe(3)


@pytest.mark.parametrize("angle", [0.0, 30.0, 150.0])
def test_north_is_where_it_is(solved, angle):
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    # A sky seen from within, whose North is turned counterclockwise from the y axis.
    cd = np.diag([-1e-4, 1e-4]) @ [[c, s], [-s, c]]
    text = dict(describe(replace(solved.calibrations[0], cd=cd)))["scale"]
    assert f"North {angle:.3f} deg from the y axis" in text
    assert "0.36 arcsec" in text


@pytest.fixture(scope="module")
def folder(sky, tmp_path_factory):
    folder = tmp_path_factory.mktemp("results")
    frame = replace(sky.exposures[0].frame(), name="good")
    bad = replace(frame, name="bad", load_sources=lambda: frame.load_sources()[:4])
    calibrate([frame, bad], sky.reference, output=folder)
    Table(sky.reference).write(folder / "gaia.fits")
    return folder


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (".", ["frames      2", "solved      1", "bad         failed: ", "good.wcs.asdf"]),
        ("summary.ecsv", ["frames      2", "failed      1"]),
        ("good.wcs.asdf", ["frame       good, solved", "distortion  up to"]),
        ("sim.solution.asdf", ["detector    sim, 512 x 512 px"]),
        ("good.matches.ecsv", ["pairs       ", "residuals   0.0"]),
        ("gaia.fits", ["stars       ", "epoch       2016", "lacks       ruwe"]),
    ],
)
def test_show_tells_what_is_in_a_file(folder, tmp_path, capsys, name, words):
    picture = tmp_path / "a.png"
    assert run(["show", str(folder / name), "--output", str(picture)]) == 0
    text = capsys.readouterr().out
    for word in words:
        assert word in text
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_show_an_exported_file(folder, tmp_path, capsys):
    from wpdc_gwcs import read

    write(read(folder / "good.wcs.asdf"), tmp_path / "a.head", format="head")
    assert run(["show", str(tmp_path / "a.head")]) == 0
    assert "distortion  up to" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.fits"], "nowhere.fits"),
        (["{folder}/good.wcs.asdf", "--output", "a.gif"], "must end with .png"),
    ],
)
def test_what_cannot_be_shown(folder, capsys, arguments, message):
    assert run(["show", *(a.format(folder=folder) for a in arguments)]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("what", ["scale", "pointing", "references", "sources", "faint", "flat"])
def test_advice_is_that_of_the_case(sky, what):
    """What would have helped, or what is missing: not a search in other directions."""
    frame, stars = sky.exposures[0].frame(), sky.reference
    settings = Settings()
    header = sky.exposures[0].header.copy()
    if what == "scale":
        for name in ("CD1_1", "CD1_2", "CD2_1", "CD2_2"):
            header[name] *= 1.3
        frame = replace(frame, wcs=WCS(header))
        expected = r"it matches with --pixel-scale 0\.\d+ \(\d+ pairs"
    elif what == "pointing":
        header["CRPIX1"] += 490.0
        frame = replace(frame, wcs=WCS(header))
        expected = "a match was found with the header off by .*correct the header"
    elif what == "references":
        stars = Table(stars)[:5]
        expected = "8 reference stars are needed, and the catalog has 5 in reach"
    elif what == "sources":
        few = frame.load_sources()[:4]
        frame = replace(frame, load_sources=few.copy)
        expected = "8 sources are needed, 4 can be used: solve it with .*--solution"
    elif what == "faint":
        few = frame.load_sources()[:10]
        few["snr"] = np.where(np.arange(10) < 4, 50.0, 7.0)
        frame = replace(frame, load_sources=few.copy)
        # A list has no other threshold.
        expected = r"4 can be used: use fainter ones \(--min-snr 5\), or solve it with .*--solution"
    else:
        image = partial(np.full, frame.image_shape, 100.0)
        frame = replace(frame, load_sources=None, load_image=image)
        expected = "look at the image: wpdc show .* --output look.png"
    told = explain_frame(frame, stars, settings)
    assert told.status == "failed"
    assert any(re.search(expected, advice) for advice in told.advice), told.advice
    if what == "scale":
        # The scale that is named is the one that matches.
        scale = float(re.search(r"--pixel-scale (\S+)", told.advice[-1])[1])
        true = linear_wcs(sky.exposures[0].frame().wcs, np.zeros(2)).scale * 3600
        assert abs(scale / true - 1) < 0.01


def test_positions_that_are_worse_than_their_errors(sky, rng):
    """Noise of 0.5 px where the list states hundredths: the match holds, and the cause is named."""
    frame = sky.exposures[0].frame()
    sources = frame.load_sources()
    for axis in ("x", "y"):
        sources[axis] += rng.normal(0, 0.5, len(sources))
    told = explain_frame(replace(frame, load_sources=lambda: sources), sky.reference)
    assert told.match is not None
    residuals = told.calibration.statistics["residuals"]
    (advice,) = [a for a in told.advice if "expected errors" in a]
    ratio = int(re.search(r"the residuals are (\d+) times", advice)[1])
    stated = np.median(np.asarray(sources["x_err"], float))
    assert 0.5 < ratio / (min(residuals["sigma_dx"], residuals["sigma_dy"]) / stated) < 1.5


def test_a_header_that_points_beside_the_catalog(sky):
    """Many stars are in reach and none is on the frame: the catalog is not too shallow."""
    frame = sky.exposures[0].frame()
    x, y = frame.wcs.world_to_pixel_values(sky.reference["ra"], sky.reference["dec"])
    stars = sky.reference[(0 < x) & (x < 511) & (0 < y) & (y < 511)]
    wcs = frame.wcs.deepcopy()
    wcs.wcs.crpix = wcs.wcs.crpix + np.array([0.0, 530.0])
    told = explain_frame(replace(frame, wcs=wcs), stars)
    (line,) = [s.lines[0] for s in told.stages if s.name == "catalog"]
    assert line.endswith("in reach, 0 on the frame by its header")
    assert any("the header may point elsewhere" in advice for advice in told.advice)
    assert not any("deeper" in advice for advice in told.advice)


def test_the_command_tells_stages_status_and_advice(tmp_path, capsys):
    """A frame that is solved has status 0 and a picture; one of another sky 1 and what to try."""
    options = ["--size", "512", "--density", "60", "--distortion", "5", "--exposures", "1", "-q"]
    for name, center in (("a", "120,30"), ("b", "200,-10")):
        folder = str(tmp_path / name)
        assert run(["simulate", "--output", folder, "--center", center, *options]) == 0
    catalogs = [str(tmp_path / name / "sim-reference.fits") for name in "ab"]
    frame, picture = str(tmp_path / "a" / "sim-01.fits"), tmp_path / "why.png"
    capsys.readouterr()
    assert run(["explain", frame, "--catalog", catalogs[0], "--output", str(picture)]) == 0
    lines = capsys.readouterr().out.splitlines()
    stages = [line[:10].strip() for line in lines if line[10:12] == "ok"]
    assert stages == ["frame", "sources", "catalog", "match", "solution"]
    assert "sim-01: solved" in lines
    assert picture.stat().st_size > 10_000
    assert run(["explain", frame, "--catalog", catalogs[1]]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert "sim-01: failed" in lines
    assert any(
        line.startswith("try: if it is right, use a catalog of this part of the sky: ")
        for line in lines
    )
    assert run(["explain", frame, "--catalog", catalogs[0], "--output", str(picture)]) == 2
    assert run(["explain", frame, "--catalog", catalogs[0], "--output", "why.txt"]) == 2
    assert "must end with .png, .pdf or .svg" in capsys.readouterr().err
