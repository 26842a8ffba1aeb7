"""Detectors that are matched start the others: a small camera whose truth is a closed formula."""

from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table
from astropy.wcs import WCS

from wpdc_gwcs.calibration import MatchedFrame, Settings, calibrate, match_frame
from wpdc_gwcs.calibration.focal_plane import focal_planes
from wpdc_gwcs.calibration.geometry import LocalPairs, fit_geometry
from wpdc_gwcs.calibration.matched import FailedFrame
from wpdc_gwcs.calibration.mosaic import start_from_neighbors
from wpdc_gwcs.catalogs import read_catalog
from wpdc_gwcs.exceptions import MatchError
from wpdc_gwcs.frame import Frame
from wpdc_gwcs.models import deproject, project

SIDE, SCALE = 800, 1e-4
CENTERS = {f"C{i}": np.array([(i % 3 - 1) * 850.0, (i // 3 - 0.5) * 870.0]) for i in range(6)}
RADIUS = 1850.0
# Errors of the header, px: places of the detectors, and the optics at the rim.
_RNG = np.random.default_rng(7)
PLACES = {d: _RNG.uniform(-15, 15, 2) for d in CENTERS}
OPTICS = 25.0


def turn(degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s], [s, c]])


def true_sky(detector, x, y, pointing, roll):
    """Sky of pixels of a detector."""
    at = np.column_stack([x, y]) - SIDE / 2 + CENTERS[detector] + PLACES[detector]
    r2 = (at**2).sum(axis=1)[:, None] / RADIUS**2
    at = at + OPTICS * at / RADIUS * r2 + [0.2, -0.3] * r2
    return deproject(*(at @ np.diag([-1, 1]) @ turn(roll).T * SCALE).T, pointing)


def header_wcs(detector, pointing, roll):
    """Linear WCS of a detector, two px and 0.01 deg off."""
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crval = np.asarray(pointing) + [2 * SCALE, -1 * SCALE]
    wcs.wcs.crpix = SIDE / 2 + 1 - CENTERS[detector]
    wcs.wcs.cd = SCALE * turn(roll + 0.01) @ np.diag([-1.0, 1.0])
    return wcs


@pytest.fixture(scope="module")
def stars():
    rng = np.random.default_rng(1)
    n = 4000
    return Table(
        {
            "ra": 150 + rng.uniform(-0.32, 0.32, n),
            "dec": rng.uniform(-0.3, 0.3, n),
            "phot_g_mean_mag": rng.uniform(14, 20, n),
        }
    )


@pytest.fixture(scope="module")
def catalog(stars):
    return read_catalog(stars)


def sources_of(stars, detector, pointing, roll, rng):
    """Stars on a detector, with a centroid noise of 0.02 px."""
    x, y = np.full((2, len(stars)), SIDE / 2)
    goal = np.column_stack(project(stars["ra"], stars["dec"], pointing))
    for _ in range(30):
        now = np.column_stack(project(*true_sky(detector, x, y, pointing, roll), pointing))
        step = (goal - now) @ turn(roll) @ np.diag([-1, 1]) / SCALE
        x, y = x + step[:, 0], y + step[:, 1]
    on = np.flatnonzero((x > 0) & (x < SIDE - 1) & (y > 0) & (y < SIDE - 1))
    x, y = np.array([x[on], y[on]]) + rng.normal(scale=0.02, size=(2, len(on)))
    return Table(
        {
            "x": x,
            "y": y,
            "flux": 10 ** (-0.4 * np.asarray(stars["phot_g_mean_mag"][on])),
            "true_row": on,
        }
    )


def make_frames(stars, exposures, few=None, seed=0):
    """Frames of exposures (pointing, roll); of the detectors in `few` so many stars are left."""
    rng = np.random.default_rng(seed)
    frames = []
    for number, (pointing, roll) in enumerate(exposures):
        for detector in CENTERS:
            table = sources_of(stars, detector, pointing, roll, rng)
            if detector in (few or {}):
                table = table[rng.permutation(len(table))[: few[detector]]]
            frames.append(
                Frame(
                    f"e{number}_{detector}",
                    detector,
                    (SIDE, SIDE),
                    header_wcs(detector, pointing, roll),
                    load_sources=lambda table=table: table,
                    exposure=str(number),
                    camera="CAM",
                )
            )
    return frames


def match_alone(frames, catalog):
    results = {}
    for frame in frames:
        sources = frame.load_sources()
        try:
            results[frame.name] = match_frame(frame, catalog, sources=sources)
        except MatchError as err:
            results[frame.name] = FailedFrame(err, len(sources), 0.0, sources)
    return results


def matched_names(results):
    return [name for name, r in results.items() if isinstance(r, MatchedFrame)]


def n_wrong(result):
    i, j = result.pairs
    true = np.asarray(result.sources["true_row"])[i]
    return int(np.sum(true != np.asarray(result.reference["catalog_index"])[j]))


EXPOSURES = [((150.0, 0.0), 0.0), ((150.01, 0.008), 33.0), ((149.99, -0.01), 180.0)]


def test_detectors_of_few_stars_are_matched_from_their_neighbors(stars, catalog):
    frames = make_frames(stars, EXPOSURES, few={"C1": 6, "C5": 7})
    alone = match_alone(frames, catalog)
    assert len(matched_names(alone)) == 12
    results = start_from_neighbors(frames, alone, catalog)
    assert list(results) == list(alone)
    assert len(matched_names(results)) == 18
    for name, result in results.items():
        assert n_wrong(result) == 0
        if result.detector in ("C1", "C5"):
            assert len(result.pairs[0]) >= len(result.sources) - 1
            assert (result.camera, result.exposure) == ("CAM", name[1])
            # the start is good to the distortion within a detector
            i, j = result.pairs
            x, y = result.start.pixels(result.reference["ra"][j], result.reference["dec"][j])
            assert np.hypot(x - result.sources["x"][i], y - result.sources["y"][i]).max() < 15
        else:
            assert result is alone[name]


def test_one_detector_of_six_starts_the_others(stars, catalog):
    few = {d: 14 for d in CENTERS if d != "C4"}
    frames = make_frames(stars, EXPOSURES[:1], few=few)
    alone = match_alone(frames, catalog)
    for name in alone:
        if name != "e0_C4":
            error = MatchError("as if it could not")
            sources = frames[list(alone).index(name)].load_sources()
            alone[name] = FailedFrame(error, len(sources), 0.0, sources)
    results = start_from_neighbors(frames, alone, catalog)
    assert len(matched_names(results)) == 6
    assert sum(n_wrong(r) for r in results.values()) == 0


def test_a_detector_poor_in_every_exposure_is_matched_in_all_together(stars, catalog):
    frames = make_frames(stars, EXPOSURES, few={"C0": 5})
    results = start_from_neighbors(frames, match_alone(frames, catalog), catalog)
    assert len(matched_names(results)) == 18
    assert sum(n_wrong(r) for r in results.values()) == 0


def test_false_sources_are_refused_with_the_reason_they_had(stars, catalog):
    frames = make_frames(stars, EXPOSURES[:2], few={"C3": 7})
    rng = np.random.default_rng(3)
    false = Table({"x": rng.uniform(0, SIDE, 40), "y": rng.uniform(0, SIDE, 40)})
    for detector, table in (("C2", false), ("C3", false[:7])):
        frames = [
            replace(f, load_sources=lambda t=table: t) if f.detector == detector else f
            for f in frames
        ]
    alone = match_alone(frames, catalog)
    results = start_from_neighbors(frames, alone, catalog)
    for name in ("e0_C2", "e0_C3", "e1_C2", "e1_C3"):
        assert results[name] is alone[name]
    assert len(matched_names(results)) == 8


def test_a_match_that_the_others_contradict_is_made_anew(stars, catalog):
    frames = make_frames(stars, EXPOSURES[:2])
    alone = match_alone(frames, catalog)
    assert len(matched_names(alone)) == 12
    wrong = alone["e1_C2"]
    reference = wrong.reference.copy()
    reference["ra"] = reference["ra"] + 60 * SCALE
    results = start_from_neighbors(
        frames, {**alone, "e1_C2": replace(wrong, reference=reference)}, catalog
    )
    assert len(matched_names(results)) == 12
    again = results["e1_C2"]
    np.testing.assert_array_equal(again.pairs[0], wrong.pairs[0])
    columns = (again.reference, again.pairs[1]), (wrong.reference, wrong.pairs[1])
    np.testing.assert_array_equal(*(r["catalog_index"][j] for r, j in columns))
    assert np.ptp(np.asarray(again.reference["ra"])) > 0
    assert all(results[n] is r for n, r in alone.items() if n != "e1_C2")


def test_a_match_of_few_pairs_that_cannot_be_made_anew_fails(stars, catalog):
    frames = make_frames(stars, EXPOSURES[:1])
    alone = match_alone(frames, catalog)
    x, y = np.random.default_rng(5).uniform(0, SIDE, (2, 30))
    ra, dec = true_sky("C2", x + 500, y, *EXPOSURES[0])
    doubtful = replace(
        alone["e0_C2"],
        sources=Table({"x": x, "y": y}),
        usable=np.ones(30, bool),
        reference=Table({"ra": ra, "dec": dec, "catalog_index": np.arange(30)}),
        pairs=(np.arange(30), np.arange(30)),
    )
    for share, kept in ((0.2, False), (0.9, True)):
        diagnostics = replace(doubtful.diagnostics, completeness=share)
        doubtful = replace(doubtful, diagnostics=diagnostics)
        result = start_from_neighbors(frames, {**alone, "e0_C2": doubtful}, catalog)["e0_C2"]
        if kept:
            assert result is doubtful
        else:
            assert isinstance(result, FailedFrame)
            assert "contradicts those of the other detectors of exposure 0" in str(result.error)


def test_frames_on_their_own_are_left_alone(stars, catalog):
    frames = make_frames(stars, EXPOSURES[:2], few={"C1": 6})
    alone = match_alone(frames, catalog)
    for keys in ({"camera": None}, {"exposure": None}):
        free = [replace(f, **keys) for f in frames]
        assert start_from_neighbors(free, alone, catalog) == alone
    # an exposure without any match has nothing to start from
    none = {n: r for n, r in alone.items() if n.startswith("e0")}
    empty = {
        f.name: FailedFrame(MatchError("no"), 0, 0.0, f.load_sources()[:0])
        for f in frames
        if f.exposure == "1"
    }
    results = start_from_neighbors(frames, {**none, **empty}, catalog)
    assert len(matched_names(results)) == 6
    assert all(results[n] is r for n, r in empty.items())
    assert all(r is empty[n] for n, r in start_from_neighbors(
        [f for f in frames if f.exposure == "1"], empty, catalog).items())  # fmt: skip


def test_the_calibration_of_a_mosaic(stars, catalog):
    frames = make_frames(stars, EXPOSURES[:2], few={"C1": 7})
    run = calibrate(frames, catalog, settings=Settings(blind=True))
    assert list(run.summary["camera"]) == ["CAM"] * 12
    assert list(run.summary["exposure"]) == ["0"] * 6 + ["1"] * 6
    assert list(run.summary["n_pairs"][run.summary["detector"] == "C1"]) == [7, 7]


# --- geometry -----------------------------------------------------------------------------------


def true_pairs(frame, pointing, roll, n=60):
    x, y = np.random.default_rng(len(frame.name)).uniform(0, SIDE, (2, n))
    return LocalPairs(x, y, *true_sky(frame.detector, x, y, pointing, roll))


def prediction_error(prediction, frame, pointing, roll):
    x, y = np.array([(100.0, 400.0, 700.0), (150.0, 350.0, 650.0)])
    here = prediction.pixel_to_world_values(x, y)
    there = true_sky(frame.detector, x, y, pointing, roll)
    error = np.subtract(project(*here, pointing), project(*there, pointing)) / SCALE
    return np.hypot(*error.mean(axis=1))


def test_a_known_place_makes_the_prediction_exact(stars):
    frames = make_frames(stars[:10], EXPOSURES)
    (plane,) = focal_planes(frames)
    sky = {e.exposure: EXPOSURES[int(e.exposure)] for e in frames}
    pairs = {f.name: true_pairs(f, *sky[f.exposure]) for f in frames if f.name != "e1_C3"}
    geometry = None
    for _ in range(3):
        geometry = fit_geometry(plane, pairs, geometry)
    frame = plane.frames["e1_C3"]
    prediction = geometry.predict(frame)
    assert prediction.shift < 0.3
    assert prediction_error(prediction, frame, *EXPOSURES[1]) < 0.1
    # nobody has seen the place of a detector: that is the error
    pairs = {n: p for n, p in pairs.items() if not n.endswith("C3")}
    prediction = fit_geometry(plane, pairs).predict(frame)
    assert 10 < prediction.shift < 40
    assert prediction_error(prediction, frame, *EXPOSURES[1]) < 3 * prediction.shift


def test_nothing_is_predicted_for_an_exposure_without_pairs(stars):
    frames = make_frames(stars[:10], EXPOSURES[:2])
    (plane,) = focal_planes(frames)
    pairs = {f.name: true_pairs(f, *EXPOSURES[0]) for f in frames if f.exposure == "0"}
    assert fit_geometry(plane, pairs).predict(plane.frames["e1_C0"]) is None


def test_headers_of_another_geometry_are_another_focal_plane(stars):
    frames = make_frames(stars[:10], EXPOSURES)
    moved = []
    for frame in frames:
        if frame.exposure == "2" and frame.detector in ("C0", "C1", "C5"):
            wcs = frame.wcs.deepcopy()
            wcs.wcs.crpix = wcs.wcs.crpix + [200.0, -150.0]
            frame = replace(frame, wcs=wcs)
        moved.append(frame)
    planes = focal_planes(moved)
    assert sorted(sorted(p.exposures) for p in planes) == [["0", "1"], ["2"]]
