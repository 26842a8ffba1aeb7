"""The whole chain against simulated exposures whose distortion is known."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import Table
from astropy.wcs import WCS

from wpdc_gwcs.calibration import Settings, calibrate, match_frame, measure_sources
from wpdc_gwcs.calibration.matched import catalog_of_frame
from wpdc_gwcs.calibration.start import header_reference_point, linear_wcs
from wpdc_gwcs.catalogs import read_catalog
from wpdc_gwcs.detection import detect_sources
from wpdc_gwcs.exceptions import DetectionError, MatchError, WPDCWarning
from wpdc_gwcs.simulation import simulate

SHAPE = (1024, 1024)


@pytest.fixture(scope="module")
def simulation():
    return simulate(3, image_shape=SHAPE, density=25, distortion=15, seed=5)


@pytest.fixture(scope="module")
def catalog(simulation):
    return read_catalog(simulation.reference)


@pytest.fixture(scope="module")
def run(simulation, catalog):
    frames = [e.frame() for e in simulation.exposures]
    return calibrate(frames, catalog, settings=Settings(holdout=0.2))


def rms_error(exposure, wcs):
    dx, dy = exposure.wcs_error(wcs)[2:]
    return np.sqrt(np.mean(dx**2 + dy**2))


def test_every_frame_is_right_against_the_truth(simulation, run):
    assert not run.failures
    assert [c.frame for c in run.calibrations] == [e.name for e in simulation.exposures]
    for exposure, calibration in zip(simulation.exposures, run.calibrations, strict=True):
        # 450 stars of 0.05 px: six numbers alone leave 0.05 * sqrt(6 / 450) = 0.006 px
        assert rms_error(exposure, calibration.wcs) < 0.02
        assert rms_error(exposure, exposure.wcs) > 1


def test_pairs_are_right(simulation, run):
    for exposure, calibration in zip(simulation.exposures, run.calibrations, strict=True):
        matches = calibration.matches
        true = np.asarray(exposure.sources["reference_index"])[matches["source_index"]]
        assert np.mean(true == np.asarray(matches["catalog_index"])) > 0.998
        assert len(matches) > 0.95 * np.sum(exposure.sources["reference_index"] >= 0)


def test_matches_hold_the_residuals_of_the_delivered_wcs(run):
    for calibration in run.calibrations:
        matches = calibration.matches
        x, y = calibration.wcs.invert(np.asarray(matches["ra"]), np.asarray(matches["dec"]))
        # the residuals are in undistorted pixels, these in detector pixels: alike within the
        # local stretch and turn (3 %) of the distortion
        np.testing.assert_allclose(np.asarray(matches["x"]) - x, matches["dx"], rtol=0.1, atol=5e-3)
        np.testing.assert_allclose(np.asarray(matches["y"]) - y, matches["dy"], rtol=0.1, atol=5e-3)


def test_held_out_stars_are_in_no_fit_and_as_good_as_the_others(run):
    held = [np.asarray(c.matches["holdout"]) for c in run.calibrations]
    assert 0.15 < np.concatenate(held).mean() < 0.25
    for calibration, mask in zip(run.calibrations, held, strict=True):
        assert not np.any(np.asarray(calibration.matches["used"])[mask])
        statistics = calibration.statistics
        assert statistics["holdout"]["n"] == mask.sum()
        ratio = statistics["holdout"]["sigma_dx"] / statistics["residuals"]["sigma_dx"]
        assert 0.7 < ratio < 1.4
    rows = [set(np.asarray(c.matches["catalog_index"])[m]) for c, m in zip(run.calibrations, held)]
    used = [set(np.asarray(c.matches["catalog_index"])[~m]) for c, m in zip(run.calibrations, held)]
    assert not set.union(*rows) & set.union(*used)


def test_summary_has_a_row_per_frame(run):
    assert run.summary.colnames == [
        "frame", "detector", "camera", "exposure", "status", "reason", "n_sources", "n_matched",
        "n_pairs", "n_ambiguous", "expected_by_chance", "purity", "completeness", "significance",
        "mean_dx", "sigma_dx", "mean_dy", "sigma_dy", "holdout_sigma_dx", "holdout_sigma_dy",
        "rms_mas", "seconds", "fwhm", "ellipticity", "mismatch", "gain", "noise", "left_out",
        "epoch", "header_offset", "header_rotation",
    ]  # fmt: skip
    assert list(run.summary["status"]) == ["solved"] * 3
    assert np.all(run.summary["sigma_dx"].to_value("pix") < 0.08)
    assert np.all(np.isfinite(run.summary["holdout_sigma_dy"]))
    for row, calibration in zip(run.summary, run.calibrations, strict=True):
        evidence = calibration.statistics["match"]
        for name in run.summary.colnames[8:14]:
            assert row[name] == evidence[name]
        assert row["n_pairs"] > 100 * row["expected_by_chance"]
        assert 0.9 < row["completeness"] <= 1


def test_a_stored_solution_leaves_six_numbers(simulation, catalog, run):
    stored = run.solutions["sim"]
    frame = simulation.exposures[2].frame()
    sources = frame.load_sources()[:120]
    few = replace(frame, load_sources=sources.copy)
    found = calibrate(few, catalog, solution=stored)
    assert not found.failures
    calibration = found.calibrations[0]
    assert np.array_equal(calibration.solution.pv.parameters, stored.pv.parameters)
    assert rms_error(simulation.exposures[2], calibration.wcs) < 0.03


def test_stored_solution_of_another_shape_is_refused(simulation, catalog, run):
    frame = replace(simulation.exposures[0].frame(), image_shape=(1024, 1000))
    found = calibrate(frame, catalog, solution=run.solutions["sim"])
    assert not found.calibrations
    assert "the stored solution has (1024, 1024)" in str(found.failures[frame.name])


def test_stored_solution_of_another_detector_is_refused(simulation, catalog, run):
    frame = replace(simulation.exposures[0].frame(), detector="other")
    found = calibrate(frame, catalog, solution=run.solutions["sim"])
    assert "detector 'other', the stored solution for 'sim'" in str(found.failures[frame.name])


def test_stored_solution_that_does_not_fit(simulation, catalog, run):
    """It is refused where it must be taken as it is; a field of the frame takes what it lacks."""
    stored = run.solutions["sim"]
    pv = stored.pv.copy()
    pv.pv1_4 = pv.pv1_4.value + 0.15  # 3 px at the edges
    stored, exposure = replace(stored, pv=pv), simulation.exposures[0]
    alone = Settings(refine="attitude")
    found = calibrate(exposure.frame(), catalog, solution=stored, settings=alone)
    assert not found.calibrations
    assert "solution by 0.0" in str(found.failures["sim-01"])
    (calibration,) = calibrate(exposure.frame(), catalog, solution=stored).calibrations
    assert calibration.field is not None
    field = calibration.statistics["field"]
    assert np.hypot(field["amplitude"], field["bend"]) > 0.3
    assert rms_error(exposure, calibration.wcs) < 0.2


def test_a_frame_that_fails_leaves_the_others_alone(simulation, catalog):
    good = simulation.exposures[0].frame()
    rng = np.random.default_rng(8)
    noise = Table({"x": rng.uniform(0, 1023, 60), "y": rng.uniform(0, 1023, 60)})
    bad = replace(good, name="noise", load_sources=noise.copy)
    empty = replace(good, name="empty", load_sources=noise[:0].copy)
    found = calibrate([bad, good, empty], catalog)
    assert [c.frame for c in found.calibrations] == [good.name]
    assert isinstance(found.failures["noise"], MatchError)
    assert isinstance(found.failures["empty"], DetectionError)
    assert list(found.summary["status"]) == ["failed", "solved", "failed"]
    assert list(found.summary["n_pairs"] > 0) == [False, True, False]
    assert list(np.isnan(found.summary["purity"])) == [True, False, True]
    assert list(found.summary["n_sources"]) == [60, len(good.load_sources()), 0]
    assert "no rows" in found.summary["reason"][2]


def test_catalogue_of_another_part_of_the_sky(simulation, catalog):
    elsewhere = catalog.copy()
    elsewhere["ra"] = np.asarray(elsewhere["ra"]) + 10
    frame = simulation.exposures[0].frame()
    with pytest.raises(
        MatchError, match=r"no star within 0\.\d+ deg of the frame's center"
    ) as info:
        match_frame(frame, elsewhere)
    ra, dec = (float(c) for c in frame.wcs.pixel_to_world_values(511.5, 511.5))
    stars = SkyCoord(np.asarray(elsewhere["ra"]), np.asarray(elsewhere["dec"]), unit="deg")
    distance = SkyCoord(ra, dec, unit="deg").separation(stars).deg.min()
    assert f"its nearest star is {distance:.3g} deg away" in str(info.value)
    # The same from the part that another process is handed.
    part = catalog_of_frame(frame, elsewhere, Settings())
    assert len(part) == 1
    with pytest.raises(MatchError) as again:
        match_frame(frame, part)
    assert str(again.value) == str(info.value)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_summary_says_how_far_the_header_is_off(simulation, catalog, sign):
    """Of 40 and 30 px, and half a degree, about the center of the detector."""
    frame = simulation.exposures[0].frame()
    truth = simulation.exposures[0].sky
    header, angle = WCS(naxis=2), np.radians(0.5 * sign)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    header.wcs.ctype = "RA---TAN", "DEC--TAN"
    header.wcs.crpix = 512.0 - 40.0, 512.0 + 30.0
    header.wcs.crval = truth(511.5, 511.5)
    x, y = 511.5 + 100.0 * np.array([[0, 1, -1, 0, 0], [0, 0, 0, 1, -1]])
    offset = SkyCoord(*header.wcs.crval, unit="deg").spherical_offsets_to(
        SkyCoord(*truth(x, y), unit="deg")
    )
    xi, eta = (o.deg for o in offset)
    cd = np.array([[xi[1] - xi[2], xi[3] - xi[4]], [eta[1] - eta[2], eta[3] - eta[4]]]) / 200.0
    header.wcs.cd = cd @ turn
    row = calibrate(replace(frame, wcs=header), catalog).summary[0]
    assert row["header_offset"].to_value("pix") == pytest.approx(50.0, abs=0.1)
    assert row["header_rotation"].to_value("deg") == pytest.approx(0.5 * sign, abs=0.02)


def test_right_ascension_in_hours(simulation, catalog):
    frame = simulation.exposures[0].frame()
    header = frame.wcs.to_header()
    header["CRVAL1"] /= 15
    frame = replace(frame, wcs=WCS(header))
    for reference in (catalog, catalog_of_frame(frame, catalog, Settings())):
        with pytest.raises(MatchError, match="is the right ascension in hours"):
            match_frame(frame, reference)


def test_an_epoch_far_from_that_of_the_catalog_is_doubted(simulation, catalog):
    frame = replace(simulation.exposures[0].frame(), epoch=1916.0)
    with pytest.warns(
        WPDCWarning, match=r"the epoch 1916\.00 is 100 years from that of the catalog"
    ):
        calibrate(frame, catalog)


def test_stars_without_motion_do_not_spoil_the_solution():
    """12 years after the catalog, all stars have moved by 120 mas on the mean."""
    sky = simulate(2, image_shape=SHAPE, density=25, distortion=15, seed=5, epoch=2028.0)
    reference = read_catalog(sky.reference)
    for name, bulk in (("ra", 8.0), ("dec", -6.0)):
        stretch = np.cos(np.radians(reference["dec"])) if name == "ra" else 1.0
        reference[name] -= bulk * 12.0 / 3.6e6 / stretch
        reference[f"pm{name}"] += bulk
    unknown = np.random.default_rng(2).uniform(size=len(reference)) < 0.4
    for name in ("pmra", "pmdec"):
        reference[name][unknown] = np.nan
    catalog = read_catalog(reference)
    frames = [e.frame() for e in sky.exposures]
    matched = [match_frame(frame, catalog).reference for frame in frames]
    rows = [np.asarray(m["catalog_index"]) for m in matched]
    common, i, j = np.intersect1d(*rows, return_indices=True)
    assert unknown[common].sum() > 100
    for name in ("ra", "dec", "ra_error", "dec_error"):
        np.testing.assert_array_equal(matched[0][name][i], matched[1][name][j])
    # Also in processes of their own.
    run = calibrate(frames, catalog, jobs=2)
    for exposure, calibration in zip(sky.exposures, run.calibrations, strict=True):
        # 0.16 px if they stay where they were, 0.005 px now.
        assert rms_error(exposure, calibration.wcs) < 0.01


def test_names_must_be_unique(simulation, catalog):
    frame = simulation.exposures[0].frame()
    with pytest.raises(ValueError, match="must be unique: .* would both write sim-01.wcs.asdf"):
        calibrate([frame, frame], catalog)
    with pytest.raises(ValueError, match="at least one frame"):
        calibrate([], catalog)
    with pytest.raises(ValueError, match="jobs must be at least 1, got 0"):
        calibrate(frame, catalog, jobs=0)


def test_given_centroids_need_a_source_list(simulation):
    frame = simulation.exposures[0].frame(image=True)
    with pytest.raises(DetectionError, match="needs a source list"):
        measure_sources(frame, Settings(centroids="given"))


def test_sources_of_an_image_reach_the_least_signal_to_noise_ratio(simulation):
    exposure = simulation.exposures[0]
    frame = exposure.frame(image=True)
    every, good, better = (measure_sources(frame, Settings(min_snr=limit)) for limit in (0, 10, 30))
    detected = detect_sources(frame.load_image(), gain=frame.gain, saturation=frame.saturation)
    assert len(every) >= len(detected)
    assert len(every) > len(good) > len(better) > 100
    assert every["snr"].min() < 10
    # The deeper list holds the same measurements: faint stars are still fitted with the others.
    assert {tuple(row) for row in better["x", "y", "flux"]} < {
        tuple(row) for row in good["x", "y", "flux"]
    }
    # The limit is that of an aperture of 1.5 FWHM, with 0.6 of the fit's ratio for a Gaussian.
    assert better["snr"].min() > 45
    assert 15 < good["snr"].min() < 20
    with pytest.raises(DetectionError, match=r"none of \d+ sources has .* above 1e\+06"):
        measure_sources(frame, Settings(min_snr=1e6))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"weight": "w5"}, "weight must be one of exp-sqrt, .*got 'w5'"),
        ({"r0": -5.0}, "r0 must be a positive number of px, got -5"),
        ({"lut": "maybe"}, "lut must be one of auto, none, got 'maybe'"),
        ({"refine": "all"}, "refine must be one of auto, attitude, field, pv, got 'all'"),
        ({"degree": 8}, "degree must be 'auto' or 1 to 7, got 8"),
        ({"n_grid": 2}, "n_grid must be between 4 and 1000, got 2"),
        ({"holdout": 1.0}, "holdout must be between 0 and 0.9, got 1.0"),
        ({"threshold": 0.0}, "threshold must be positive, got 0"),
        ({"min_snr": -1.0}, "min_snr must be 0 or more, got -1"),
        ({"centroids": "moment"}, "centroids must be one of psf, windowed, given"),
        ({"reference_point": "corner"}, "reference_point must be one of header, center"),
    ],
)
def test_settings_are_checked(options, message):
    with pytest.raises(ValueError, match=message):
        Settings(**options)


def test_linear_start_is_the_header_itself_for_tan():
    header = WCS(naxis=2)
    header.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    header.wcs.crpix, header.wcs.crval = [400.0, 600.0], [359.999, 80.0]
    header.wcs.cd = [[-5e-5, 2e-5], [2e-5, 5e-5]]
    start = linear_wcs(header, np.array([399.0, 599.0]))
    np.testing.assert_allclose(start.crval, header.wcs.crval, atol=1e-11)
    np.testing.assert_allclose(start.cd, header.wcs.cd, rtol=1e-6, atol=1e-13)
    x, y = np.meshgrid([0.0, 500.0, 1000.0], [0.0, 500.0, 1000.0])
    sky = header.wcs_pix2world(x.ravel(), y.ravel(), 0)
    np.testing.assert_allclose(start.pixels(*sky), [x.ravel(), y.ravel()], atol=1e-3)


def test_header_point_off_the_detector_gives_way_to_the_centre():
    header = WCS(naxis=2)
    header.wcs.crpix = [-300.0, 20.0]
    frame = SimpleNamespace(wcs=header, image_shape=(100, 200))
    np.testing.assert_array_equal(header_reference_point(frame), [99.5, 49.5])
    header.wcs.crpix = [30.0, 20.0]
    np.testing.assert_array_equal(header_reference_point(frame), [29.0, 19.0])


def test_reference_point_at_the_nearest_source(simulation, catalog):
    frame = simulation.exposures[0].frame()
    found = calibrate(frame, catalog, settings=Settings(reference_point="nearest-source"))
    crpix = found.solutions["sim"].crpix
    matches = found.calibrations[0].matches
    distance = np.hypot(matches["x"] - 511.5, matches["y"] - 511.5)
    nearest = np.argmin(distance)
    np.testing.assert_allclose(crpix, [matches["x"][nearest], matches["y"][nearest]])
    assert rms_error(simulation.exposures[0], found.calibrations[0].wcs) < 0.03


def test_a_frame_of_one_corner_is_degraded(simulation, catalog):
    """It is delivered with what it lacks, and the others are as good as ever."""
    frames = [e.frame() for e in simulation.exposures[:1]]
    sources = frames[0].load_sources()
    corner = sources[(sources["x"] < 420) & (sources["y"] < 420)]
    frames = [replace(frames[0], load_sources=corner.copy)]
    found = calibrate(frames, catalog)
    assert not found.failures
    assert list(found.summary["status"]) == ["degraded"]
    (calibration,) = found.calibrations
    assert calibration.statistics["status"] == "degraded"
    reasons = calibration.statistics["reasons"]
    assert "stars cover 1" in reasons[0]
    assert found.summary["reason"][0] == "; ".join(reasons)
    sigma_x, sigma_y, _ = calibration.uncertainty([200.0, 1000.0], [200.0, 1000.0])
    assert sigma_x[1] > 10 * sigma_x[0]
    assert sigma_y[1] > 10 * sigma_y[0]


def test_few_stars_know_how_well_they_know(simulation, catalog):
    exposure = simulation.exposures[0]
    sources = exposure.frame().load_sources()
    order = np.argsort(np.asarray(sources["flux"]))[::-1][:30]
    frame = replace(exposure.frame(), load_sources=sources[order].copy)
    found = calibrate(frame, catalog)
    assert not found.failures
    (calibration,) = found.calibrations
    assert calibration.statistics["status"] in ("solved", "degraded")
    x, y, dx, dy = exposure.wcs_error(calibration.wcs)
    sigma = np.array(calibration.uncertainty(x, y)[:2])
    inside = np.isfinite(dx)
    assert np.mean(np.abs([dx[inside], dy[inside]]) < 3 * sigma[:, inside]) > 0.9


def test_two_cameras_with_detectors_of_one_name(simulation, catalog):
    """Neither takes the other's solution."""
    frames = [
        replace(exposure.frame(), camera=camera, exposure=exposure.name)
        for exposure, camera in zip(simulation.exposures, ("north", "south", "south"))
    ]
    run = calibrate(frames, catalog)
    assert len(run.calibrations) == 3
    name = frames[0].detector
    assert sorted(run.solutions) == [f"north-{name}", f"south-{name}"]
