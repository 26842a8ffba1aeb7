"""Scores against the truth: of a WCS whose error is known, and of pairs that are wrong."""

from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table

from wpdc_gwcs import Calibration, DistortionSolution, calibrate, simulate
from wpdc_gwcs.cli.app import run
from wpdc_gwcs.evaluation import Cuts, pool_scores, score_frame, tabulate_scores
from wpdc_gwcs.io import read_truth, write_simulation
from wpdc_gwcs.models import PVPolynomial

SHAPE = (600, 600)


@pytest.fixture(scope="module")
def sky():
    return simulate(3, image_shape=SHAPE, density=80, distortion=5, seed=12)


@pytest.fixture(scope="module")
def results(sky, tmp_path_factory):
    """Files of the simulation and of its calibration."""
    folder = tmp_path_factory.mktemp("scored")
    files = write_simulation(sky, folder / "sky", images=(0,), sources="ldac")
    frames = [str(p) for p in files["frames"]]
    command = ["calibrate", *frames, "--catalog", str(files["reference"])]
    assert run([*command, "--output", str(folder / "out"), "-q"]) == 0
    return folder


def known(exposure, offset=(0.0, 0.0), sigma=None):
    """A calibration whose error is an offset: the truth without distortion, moved."""
    linear = exposure.linear_wcs.wcs
    crpix = linear.crpix - 1
    solution = DistortionSolution(
        "sim", SHAPE, crpix - offset, linear.cd, linear.crval, PVPolynomial()
    )
    sources, stars = exposure.observe()
    seen = np.flatnonzero(stars["source_index"] >= 0)
    index = stars["source_index"][seen]
    matches = Table(
        {
            "source_index": index,
            "catalog_index": stars["reference_index"][seen],
            **{k: sources[k][index] for k in ("x", "y", "x_err", "y_err", "snr")},
            "dx": np.zeros(len(seen)),
            "dy": np.zeros(len(seen)),
            "used": np.arange(len(seen)) % 2 == 0,
            "holdout": np.zeros(len(seen), bool),
        }
    )
    stars.rename_column("reference_index", "catalog_index")
    if sigma is not None:
        sigma = np.array([np.full((5, 5), v) for v in (sigma**2, 0.0, sigma**2)])
    calibration = Calibration("sim-01", solution, linear.crval, linear.cd, matches=matches)
    return calibration, stars


@pytest.fixture(scope="module")
def straight():
    """An exposure without distortion."""
    exposure = simulate(1, image_shape=SHAPE, density=80, distortion=1, seed=12).exposures[0]
    distortion = exposure.distortion.scaled(0.0)
    return replace(exposure, distortion=distortion)


def test_error_that_is_known(straight):
    calibration, stars = known(straight, (0.03, -0.04))
    score = score_frame(calibration, straight, stars, limit=0.06)
    assert score.wcs_rms == pytest.approx(0.05, abs=1e-7)
    assert score.wcs_max == pytest.approx(0.05, abs=1e-7)
    assert score.wcs_rms_stars == pytest.approx(0.05, abs=1e-7)
    assert (score.wcs_mean_dx, score.wcs_mean_dy) == pytest.approx((0.03, -0.04), abs=1e-7)
    assert score.share_below == 1.0
    assert score_frame(calibration, straight, stars, limit=0.04).share_below == 0.0
    assert (score.n_wrong, score.n_wrong_used) == (0, 0)
    assert score.n_used == pytest.approx(score.n_matched / 2, abs=1)
    # Measured with errors of the size that is stated.
    assert score.pull_stars == pytest.approx(1.0, abs=4 / np.sqrt(2 * score.n_used))


def test_wrong_pairs_are_found(straight):
    calibration, stars = known(straight)
    m = calibration.matches
    swapped = m["catalog_index"][[1, 0, 2]]
    m["catalog_index"][:3] = swapped
    spurious = np.setdiff1d(np.arange(len(stars) + 50), m["source_index"])[0]
    m["source_index"][4] = spurious
    score = score_frame(calibration, straight, stars)
    assert (score.n_wrong, score.n_wrong_used) == (3, 2)
    # Without the list, by place: the two that are swapped; the spurious source is where it was.
    stars.remove_column("source_index")
    score = score_frame(calibration, straight, stars)
    assert (score.n_wrong, score.n_wrong_used) == (2, 1)
    m["catalog_index"][6] = 10**6
    assert score_frame(calibration, straight, stars).n_wrong == 3


def test_cuts_are_on_the_area_and_on_the_stars(straight):
    calibration, stars = known(straight)
    cuts = Cuts(region=(0, 299, -1, 601), min_snr=30)
    score = score_frame(calibration, straight, stars, cuts=cuts, n_grid=61)
    m = calibration.matches
    assert score.n_matched == np.sum((m["x"] <= 299) & (m["x"] >= 0) & (m["snr"] > 30))
    assert np.isfinite(score.error_x[:, :30]).all()
    assert np.isnan(score.error_x[:, 31:]).all()


def test_pooled_scores_tell_what_frames_share(straight):
    scores = []
    for offset in ((0.03, 0.01), (0.03, -0.01)):
        calibration, stars = known(straight, offset)
        scores.append(score_frame(calibration, straight, stars))
    (found,) = pool_scores(scores)
    assert (found.frame, found.detector, found.n_frames) == ("all", "sim", 2)
    assert found.wcs_rms == pytest.approx(np.hypot(0.03, 0.01), abs=1e-7)
    assert found.wcs_rms_static == pytest.approx(0.03, abs=1e-7)
    assert found.n_used == 2 * scores[0].n_used
    other = replace(scores[0], detector="other")
    assert [s.detector for s in pool_scores([*scores, other])] == ["other", "sim", "all"]
    table = tabulate_scores(scores)
    assert "error_x" not in table.colnames
    assert len(table) == 2
    with pytest.raises(ValueError, match="pool_scores needs the scores of at least one frame"):
        pool_scores([])


def test_score_of_another_detector(straight):
    calibration, stars = known(straight)
    other = simulate(1, image_shape=(300, 600), density=5, distortion=2).exposures[0]
    with pytest.raises(
        ValueError, match=r"frame sim-01 must have the shape of its truth, \(300, 600\)"
    ):
        score_frame(calibration, other, stars)
    with pytest.raises(ValueError, match="score_frame needs a calibrated frame with its matches"):
        score_frame(replace(calibration, matches=None), straight, stars)


def test_calibrations_and_what_they_say_of_themselves(sky):
    result = calibrate([e.frame() for e in sky.exposures], sky.reference)
    scores = []
    for exposure, calibration in zip(sky.exposures, result.calibrations, strict=True):
        stars = exposure.observe()[1]
        stars.rename_column("reference_index", "catalog_index")
        score = score_frame(calibration, exposure, stars)
        *_, dx, dy = exposure.wcs_error(calibration.wcs)
        assert score.wcs_rms == pytest.approx(np.sqrt(np.mean(dx**2 + dy**2)))
        assert 0.4 < score.pull_wcs < 2.5
        scores.append(score)
    assert pool_scores(scores)[0].n_wrong_used == 0


# ---- command line


def test_evaluate_with_the_truth(results, tmp_path, capsys):
    command = ["evaluate", str(results / "out"), "--truth", str(results / "sky"), "--no-weights"]
    assert run(command) == 0
    assert "wcs_rms" in capsys.readouterr().out
    output = tmp_path / "scores.ecsv"
    assert run([*command, "--output", str(output), "--table", str(tmp_path / "t.txt")]) == 0
    assert capsys.readouterr().out == ""
    frames = Table.read(tmp_path / "scores.truth.ecsv")
    assert list(frames["frame"]) == ["sim-01", "sim-02", "sim-03"]
    truth = read_truth(results / "sky")
    assert set(truth.frames) == set(frames["frame"])
    assert frames["wcs_rms"].max() < 0.02
    assert frames["n_wrong_used"].sum() == 0
    pooled = Table.read(tmp_path / "scores.truth-detectors.ecsv")
    assert pooled["n_frames"].tolist() == [3]
    detectors = Table.read(tmp_path / "scores.detectors.ecsv")
    assert detectors["sigma_alpha"][0] == pytest.approx(300 * detectors["sigma_dx"][0], rel=0.02)
    assert (tmp_path / "t.txt").read_text().splitlines()[2].startswith("sim")
    assert run([*command, "--output", str(output)]) == 2
    assert "file exists" in capsys.readouterr().err


def test_evaluate_with_limits(results, tmp_path):
    table = tmp_path / "all.ecsv"
    limits = ["--min-radius", "50", "--max-radius", "250", "--min-snr", "20", "--max-mag", "20"]
    command = ["evaluate", str(results / "out"), "--no-weights", "--output", str(table)]
    assert run([*command, *limits, "--region", "0,600,0,300", "--table", f"{tmp_path}/t.ecsv"]) == 0
    matches = [Table.read(p) for p in sorted((results / "out").glob("*.matches.ecsv"))]
    n = 0
    for m in matches:
        r = np.hypot(m["x"] - 299.5, m["y"] - 299.5)
        chosen = (r > 50) & (r < 250) & (m["snr"] > 20) & (m["phot_g_mean_mag"] <= 20)
        n += np.sum(chosen & (m["y"] <= 300) & (m["y"] >= 0) & m["used"])
    assert Table.read(tmp_path / "all.detectors.ecsv")["n"].tolist() == [n]
    assert Table.read(table)["n"].sum() == n
    paper = Table.read(tmp_path / "t.ecsv")
    assert paper.colnames == ["detector", "mean_dx", "sigma_dx", "mean_dy", "sigma_dy"]
    assert paper["sigma_dx"].unit == "pix"


def test_evaluate_some_weights(results, tmp_path, capsys):
    table = tmp_path / "all.ecsv"
    command = ["evaluate", str(results / "out"), "--output", str(table)]
    assert run([*command, "--weights", "w1, inverse", "--degree", "4"]) == 0
    found = Table.read(tmp_path / "all.weights.ecsv")
    assert sorted(set(found["weight"])) == ["exp-sqrt", "inverse"]
    inner = tmp_path / "inner.ecsv"
    command = ["evaluate", str(results / "out"), "--output", str(inner), "--max-radius", "200"]
    assert run([*command, "--weights", "w1"]) == 0
    near = Table.read(tmp_path / "inner.weights.ecsv")
    # A circle of 200 px on 600 x 600 px.
    assert near["n"][0] / found["n"][0] == pytest.approx(np.pi * 200**2 / 600**2, rel=0.15)
    capsys.readouterr()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--weights", "w5"], "--weights: weight must be one of exp-sqrt"),
        (["--degree", "8"], "--degree must be 1 to 7, got 8"),
        (["--limit", "0"], "--limit must be positive, in px, got 0"),
        (["--about", "1"], "--about must be 2 numbers with ',' between them, got '1'"),
        (["--region", "1,2,3"], "--region must be 4 numbers"),
        (["--min-radius", "9", "--max-radius", "2"], "radius must have its lower limit first"),
        (["--min-mag", "30", "--no-weights"], "no star of 3 frames is within the given limits"),
        (["--truth", "nowhere"], "nowhere/truth.asdf: no such file"),
    ],
)
def test_evaluate_refuses_in_one_line(results, capsys, options, message):
    assert run(["evaluate", str(results / "out"), *options]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert message in error


def test_truth_of_another_simulation(results, tmp_path, capsys):
    other = simulate(1, image_shape=(64, 64), density=50, distortion=1, detector="other")
    write_simulation(other, tmp_path, images=())
    assert run(["evaluate", str(results / "out"), "--truth", str(tmp_path)]) == 2
    assert "the simulation has no frame sim-01" in capsys.readouterr().err


def test_matches_alone(results, tmp_path, capsys):
    path = results / "out" / "sim-02.matches.ecsv"
    alone = tmp_path / path.name
    alone.write_bytes(path.read_bytes())
    assert run(["evaluate", str(alone)]) == 0
    capsys.readouterr()
    assert run(["evaluate", str(alone), "--max-radius", "9"]) == 2
    assert "radii need --about X,Y, or sim-02.wcs.asdf beside it" in capsys.readouterr().err
    assert run(["evaluate", str(alone), "--max-radius", "90", "--about", "300,300"]) == 0
    assert run(["evaluate", str(alone), "--truth", str(results / "sky")]) == 2
    assert "--truth needs the *.wcs.asdf files" in capsys.readouterr().err
