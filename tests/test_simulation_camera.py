"""Cameras of several detectors, fields anywhere on the sky, and the truth in files."""

from dataclasses import replace

import asdf
import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import Table
from astropy.wcs import WCS

from wpdc_gwcs.exceptions import FileFormatError
from wpdc_gwcs.io import read_frames
from wpdc_gwcs.simulation import CAMERAS, make_camera, read_truth, simulate, write_simulation

TINY = {"image_shape": (160, 150), "pixel_scale": 2.0 * u.arcsec, "distortion": 4.0}
BANDS = {"NUV": 4, "u": 2, "g": 2, "r": 2, "i": 2, "z": 2, "y": 4}


def test_main_survey_camera_has_its_eighteen_detectors():
    camera = make_camera("csst-msc")
    names = [d.name for d in camera.detectors]
    assert sorted(names) == sorted(f"{b}-{k + 1}" for b, n in BANDS.items() for k in range(n))
    assert {d.image_shape for d in camera.detectors} == {(9232, 9216)}
    assert all(d.band == d.name.split("-")[0] for d in camera.detectors)
    # No two detectors overlap: they are apart by more than a side along one axis.
    places = np.array([d.center for d in camera.detectors])
    apart = np.abs(places[:, None] - places) / (9216, 9232)
    np.fill_diagonal(apart[..., 0], 9)
    assert apart.max(axis=2).min() > 1
    size = {d.name: d.distortion.greatest() for d in camera.detectors}
    assert max(size, key=size.get)[0] == "y"
    assert max(size.values()) == pytest.approx(200, abs=0.1)  # with its fine waves
    assert size["NUV-2"] < 80


def test_headers_put_detectors_where_the_camera_has_them():
    """Centers of the headers, projected about the pointing, are the places in the focal plane."""
    center = SkyCoord(0.001, -60.0, unit="deg")
    camera = make_camera("csst-msc", **TINY)
    simulation = simulate(1, camera=camera, center=center, density=1.0, roll=20 * u.deg)
    plane = WCS(naxis=2)
    plane.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    plane.wcs.crval = [center.ra.deg, center.dec.deg]
    c, s = np.cos(np.deg2rad(20)), np.sin(np.deg2rad(20))
    plane.wcs.cd = 2 / 3600 * np.array([[-c, s], [s, c]])
    for detector, exposure in zip(camera.detectors, simulation.exposures, strict=True):
        x, y = exposure.wcs.wcs_pix2world([detector.distortion.center], 0)[0]
        found = plane.wcs_world2pix([[x, y]], 0)[0] + 1
        np.testing.assert_allclose(found, detector.center, atol=1e-6)
        assert exposure.name == f"csst-msc-01-{detector.name}"
        assert exposure.header["INSTRUME"] == "CSST-MSC"
        assert exposure.header["FILTER"] == detector.band


@pytest.mark.parametrize("camera", ["csst-msc", "bass-90prime"])
def test_camera_is_rigid(camera):
    """Angles between pixels of two detectors are the same wherever the camera points."""
    quiet = {"pointing_error": 0 * u.arcsec, "roll_error": 0 * u.deg, "dither": 0 * u.deg}
    separations = []
    for dec in (-90.0, -30.0, 89.99):
        names = {"csst-msc": ["y-1", "g-2"], "bass-90prime": ["CCD1", "CCD4"]}[camera]
        one = simulate(
            1,
            camera=make_camera(camera, **TINY),
            detectors=names,
            center=SkyCoord(359.9999, dec, unit="deg"),
            density=0.0,
            roll=35 * u.deg,
            **quiet,
        ).exposures
        points = [SkyCoord(*e.sky([10.0, 90.0], [20.0, 140.0]), unit="deg") for e in one]
        separations.append(points[0].separation(points[1]).arcsec)
    np.testing.assert_allclose(separations[1:], separations[:-1], atol=1e-6)


def test_90prime_has_one_tangent_point_between_its_chips():
    simulation = simulate(1, camera="bass-90prime", density=0.5, **TINY)
    headers = [e.header for e in simulation.exposures]
    assert len({(h["CRVAL1"], h["CRVAL2"]) for h in headers}) == 1
    for h in headers:
        assert not (0 < h["CRPIX1"] <= h["NAXIS1"] and 0 < h["CRPIX2"] <= h["NAXIS2"])
    signs = {(np.sign(h["CD1_1"]), np.sign(h["CD2_2"])) for h in headers}
    assert len(signs) == 4


@pytest.mark.parametrize("dec", [90.0, -89.9, 0.0, 45.0])
@pytest.mark.parametrize("camera", CAMERAS)
def test_sources_are_stars_of_the_catalog_anywhere(camera, dec):
    simulation = simulate(
        2,
        camera=camera,
        center=SkyCoord([0.0, 200.0], [dec, 10.0], unit="deg"),
        density=[3.0, 4.0],
        noise=False,
        spurious=0.0,
        lost=0.0,
        resolution=0.0,
        saturation=1e9,
        epoch=2016.0,
        proper_motion=0 * u.mas / u.yr,
        **TINY,
    )
    reference = simulation.reference
    assert np.array_equal(reference["source_id"] - reference["source_id"][0], range(len(reference)))
    for exposure in simulation.exposures:
        index = exposure.sources["reference_index"]
        x, y = exposure.pixel(reference["ra"].value[index], reference["dec"].value[index])
        np.testing.assert_allclose(x, exposure.sources["x"], atol=1e-7)
        np.testing.assert_allclose(y, exposure.sources["y"], atol=1e-7)
        if exposure._detector.depth == 0:
            # 3 or 4 stars per square arcmin on 26.7: not one of them is missing.
            assert 50 < len(index) < 145


def test_detectors_see_as_deep_as_they_are():
    simulation = simulate(1, camera="csst-msc", density=40.0, spurious=0.0, **TINY)
    n = {e.detector: len(e.sources) for e in simulation.exposures}
    assert n["NUV-1"] < 0.35 * n["g-1"]
    assert n["NUV-1"] < n["y-1"] < n["g-1"]
    faint = {e.detector: e.sources["snr"].min() for e in simulation.exposures}
    assert faint["NUV-1"] > 5


def test_lists_tell_no_stars_apart_that_the_psf_does_not():
    options = {"camera": make_camera("csst-msc", fwhm=4.0, **TINY), "density": 100.0}
    one = simulate(1, detectors=["g-1"], resolution=0.0, **options).exposures[0].sources
    two = simulate(1, detectors=["g-1"], **options).exposures[0].sources
    left = np.isin(one["x"], two["x"])
    x, y = np.asarray(one["x"]), np.asarray(one["y"])
    apart = np.hypot(x - x[:, None], y - y[:, None])
    brighter = one["flux"] > np.asarray(one["flux"])[:, None]
    assert 0 < left.sum() < len(one)
    np.testing.assert_array_equal(~left, ((apart < 4.0) & brighter).any(axis=1))


def test_catalog_is_the_truth_where_it_has_no_errors():
    simulation = simulate(1, density=5.0, catalog_errors=False, **TINY)
    assert "ra_error" not in simulation.reference.colnames
    stars = simulation.exposures[0].stars
    star = simulation.reference[stars["reference_index"]]
    np.testing.assert_allclose(star["ra"].value, stars["ra"], rtol=0, atol=1e-12)


def test_colors_and_galaxies():
    plain = simulate(1, density=5.0, **TINY)
    rich = simulate(1, density=5.0, colors=(1.0, 0.3), galaxies=20.0, **TINY)
    assert "bp_rp" not in plain.reference.colnames
    assert rich.reference["bp_rp"].value.mean() == pytest.approx(1.0, abs=0.1)
    before, after = (s.exposures[0].sources for s in (plain, rich))
    # The stars stay as they are.
    assert set(np.asarray(before["x"])) < set(np.asarray(after["x"]))
    n = len(after) - len(before)
    assert n == pytest.approx(20 * 160 * 150 / 900, abs=4 * np.sqrt(530))
    new = ~np.isin(after["x"], before["x"])
    assert (after["reference_index"][new] == -1).all()
    assert np.std(after["roundness"][new]) > 0.3


def test_camera_of_ones_own():
    camera = make_camera("csst-msc", **TINY)
    own = replace(camera, name="two", detectors=camera.detectors[:2], fwhm=4.0)
    simulation = simulate(1, camera=own, density=2.0)
    assert [e.name for e in simulation.exposures] == ["two-01-y-1", "two-01-i-1"]
    with pytest.raises(ValueError, match="detectors must have different names"):
        replace(camera, detectors=camera.detectors[:1] * 2)
    with pytest.raises(ValueError, match="fwhm must be positive, not -1"):
        replace(camera, fwhm=-1)


# ---- files


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    simulation = simulate(
        2,
        camera="csst-msc",
        detectors=["NUV-1", "g-1"],
        center=SkyCoord(0.0, -90.0, unit="deg"),
        density=30.0,
        epoch=2026.0,
        waves=0.05,
        proper_motion=30 * u.mas / u.yr,
        **TINY,
    )
    folder = tmp_path_factory.mktemp("truth")
    return simulation, folder, write_simulation(simulation, folder, images=(1,), sources="ldac")


def test_truth_is_exact_for_everyone(written):
    """A stock gwcs from the file against the closed form: rounding alone, at a pole."""
    simulation, folder, _ = written
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-0.5, 149.5, 400), rng.uniform(-0.5, 159.5, 400)
    with asdf.open(folder / "truth.asdf") as file:
        assert set(file["frames"]) == {e.name for e in simulation.exposures}
        for exposure in simulation.exposures:
            wcs = file["frames"][exposure.name]["wcs"]
            assert wcs.pixel_shape == (150, 160)
            error = exposure.error_at(wcs, x, y)
            np.testing.assert_allclose(error, 0, atol=1e-8)


def test_truth_comes_back(written):
    simulation, folder, files = written
    truth = read_truth(folder)
    assert truth.camera == "csst-msc"
    assert truth.catalog == files["reference"]
    assert [truth.files[e.name] for e in simulation.exposures] == files["frames"]
    for exposure in simulation.exposures:
        frame = truth.frames[exposure.name]
        assert (frame.detector, frame.exposure) == (exposure.detector, exposure.exposure)
        assert frame.epoch == exposure.epoch
        x, y = np.array([3.0, 140.0]), np.array([150.0, 2.0])
        np.testing.assert_array_equal(frame.sky(x, y), exposure.sky(x, y))
        np.testing.assert_allclose(frame.pixel(*frame.sky(x, y)), (x, y), atol=1e-8)


def test_truth_star_by_star(written):
    simulation, folder, files = written
    truth, reference = read_truth(folder), Table.read(files["reference"])
    for k, name in enumerate(e.name for e in simulation.exposures):
        frame, stars = truth.frames[name], truth.stars(name)
        np.testing.assert_allclose(frame.pixel(stars["ra"], stars["dec"]), (stars["x"], stars["y"]))
        assert stars["x"].unit == u.pix
        assert stars["ra"].unit == u.deg
        known = reference[stars["catalog_index"]]
        np.testing.assert_allclose(known["phot_g_mean_mag"], stars["magnitude"])
        if k == 1:
            assert "source_index" not in stars.colnames
            continue
        seen = stars[stars["source_index"] >= 0]
        (read,) = read_frames(files["frames"][k])
        sources = read.load_sources()
        # Centroid errors of 0.02 px and more.
        assert np.abs(sources["x"][seen["source_index"]] - seen["x"]).max() < 1
        assert len(seen) <= len(sources)


def test_frames_of_a_mosaic_know_each_other(written):
    simulation, _, files = written
    frames = [read_frames(p)[0] for p in files["frames"]]
    given = [e.frame() for e in simulation.exposures]
    for a, b in zip(frames, given, strict=True):
        assert (a.camera, a.exposure, a.detector) == (b.camera, b.exposure, b.detector)
        assert a.camera == "CSSTMSC"
        # Dates in headers are UTC with milliseconds, epochs dynamical: a minute is 2e-6 yr.
        assert a.epoch == pytest.approx(b.epoch, abs=4e-6)


def test_damaged_truth(written, tmp_path):
    _, folder, _ = written
    with pytest.raises(FileFormatError, match="no such file: the truth of a simulation"):
        read_truth(tmp_path)
    content = (folder / "truth.asdf").read_bytes()
    (tmp_path / "truth.asdf").write_bytes(content.replace(b"detector: NUV-1", b"detector: other"))
    with pytest.raises(FileFormatError, match="damaged 'truth' tree"):
        read_truth(tmp_path)
    (tmp_path / "truth.asdf").write_bytes(content.replace(b"truth:", b"other:"))
    with pytest.raises(FileFormatError, match="must have a 'truth' tree"):
        read_truth(tmp_path)
