import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS
from hypothesis import given, settings
from hypothesis import strategies as st

from wpdc_gwcs.simulation import (
    Distortion,
    KingCluster,
    make_camera,
    simulate,
    write_simulation,
)

SMALL = {"image_shape": (220, 300), "pixel_scale": 1.0 * u.arcsec, "distortion": 8.0}


@pytest.fixture(scope="module")
def small():
    return simulate(2, density=8, proper_motion=20 * u.mas / u.yr, epoch=2026.0, seed=5, **SMALL)


# ---- distortion


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 10_000), st.floats(1, 60), st.floats(0, 0.3))
def test_distort_inverts_undistort(seed, amplitude, waves):
    distortion = Distortion.random((1500, 2048), amplitude=amplitude, waves=waves, rng=seed)
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-0.5, 2047.5, 300), rng.uniform(-0.5, 1499.5, 300)
    back = distortion.distort(*distortion.undistort(x, y))
    # The Newton iteration ends at 1e-11 half-widths, 1e-8 px.
    np.testing.assert_allclose(back, [x, y], rtol=0, atol=1e-8)


def test_greatest_displacement_is_the_amplitude():
    distortion = Distortion.random((1024, 1024), amplitude=25.0, rng=3)
    y, x = np.mgrid[-0.5:1023.5:65j, -0.5:1023.5:65j]
    u_, v = distortion.undistort(x, y)
    assert np.hypot(u_ - x, v - y).max() == pytest.approx(25.0, rel=1e-3)


def test_centre_stays():
    distortion = Distortion.random((800, 1000), amplitude=25.0, rng=4)
    x0, y0 = distortion.center
    np.testing.assert_allclose(distortion.undistort(x0, y0), (x0, y0), atol=1e-9)
    # The linear part of the radial term is in the linear WCS.  The polynomial has none.
    h = 1e-3
    for step in ((h, 0), (0, h)):
        moved = np.subtract(distortion.undistort(x0 + step[0], y0 + step[1]), (x0, y0))
        np.testing.assert_allclose(moved, step, atol=1e-7)


def test_waves_are_too_fine_for_a_cubic():
    def misfit(waves):
        distortion = Distortion.random((2048, 2048), amplitude=40.0, waves=waves, rng=2)
        y, x = np.mgrid[0:2047:60j, 0:2047:60j].reshape(2, -1)
        a, b = x / 1024 - 1, y / 1024 - 1
        terms = np.stack([a**i * b**j for i in range(4) for j in range(4 - i)], axis=1)
        dx = distortion.undistort(x, y)[0] - x
        return np.std(dx - terms @ np.linalg.lstsq(terms, dx)[0])

    assert misfit(2.0) > 5 * misfit(0.0)


def test_no_inverse_far_away():
    distortion = Distortion.random((1024, 1024), amplitude=40.0, rng=3)
    x, y = distortion.distort([100.0, 1e9], [100.0, 0.0])
    assert np.isfinite(x).tolist() == [True, False]
    assert np.isfinite(y).tolist() == [True, False]


def test_folded_detector_is_refused():
    with pytest.raises(ValueError, match="a distortion of 800 px .* is not invertible"):
        Distortion.random((1024, 1024), amplitude=800.0, rng=3)


# ---- truth


def test_sky_and_pixel_are_inverse(small):
    exposure = small.exposures[0]
    x, y = np.array([-0.5, 10.0, 299.5]), np.array([-0.5, 200.0, 219.5])
    np.testing.assert_allclose(exposure.pixel(*exposure.sky(x, y)), [x, y], atol=1e-7)


def test_sources_are_reference_stars(small):
    exposure = small.exposures[1]
    sources = exposure.sources[exposure.sources["reference_index"] >= 0]
    star = small.reference[sources["reference_index"]]
    sky = SkyCoord(
        star["ra"],
        star["dec"],
        pm_ra_cosdec=star["pmra"],
        pm_dec=star["pmdec"],
    )
    # Ten years on, by the star's true motion (noise of the reference, milliarcseconds, is 1e-3 px).
    moved = sky.spherical_offsets_by(star["pmra"] * 10 * u.yr, star["pmdec"] * 10 * u.yr)
    x, y = exposure.pixel(moved.ra.deg, moved.dec.deg)
    pull = np.concatenate(
        [(sources["x"] - x) / sources["x_err"], (sources["y"] - y) / sources["y_err"]]
    )
    assert len(pull) > 100
    assert np.std(pull) == pytest.approx(1, abs=0.15)
    still = np.hypot(*np.subtract(exposure.pixel(sky.ra.deg, sky.dec.deg), (x, y)))
    assert np.median(still) > 0.1


def test_header_is_nominal(small):
    exposure = small.exposures[0]
    header = WCS(exposure.header)
    assert header.wcs.ctype[0] == "RA---TAN"
    assert header.array_shape is None or header.array_shape == exposure.image_shape
    x, y, dx, dy = exposure.wcs_error(header)
    assert x.shape == dx.shape == (101 * 101,)
    # Pointing error of 2 arcsec per axis and distortion of 8 px.
    assert 1 < np.hypot(dx, dy).max() < 25
    assert exposure.header["MJD-OBS"] == pytest.approx(61041.5, abs=1)


def test_wcs_error_of_the_truth_is_zero(small):
    exposure = small.exposures[0]
    *_, dx, dy = exposure.wcs_error(exposure.sky)
    np.testing.assert_allclose([dx, dy], 0, atol=1e-7)


def test_wcs_error_has_the_sign_of_the_residuals(small):
    exposure = small.exposures[0]

    def shifted(x, y):
        true_x, true_y = exposure.distortion.undistort(x, y)
        return exposure.linear_wcs.wcs_pix2world(true_x + 0.5, true_y, 0)

    *_, dx, dy = exposure.wcs_error(shifted, n_grid=5)
    np.testing.assert_allclose(dx, 0.5, atol=1e-6)
    np.testing.assert_allclose(dy, 0, atol=1e-6)


def test_same_seed_same_simulation_and_one_more_exposure_changes_nothing():
    one, two = simulate(2, density=5, **SMALL), simulate(3, density=5, **SMALL)
    assert (one.reference["ra"] == two.reference["ra"]).all()
    for a, b in zip(one.exposures, two.exposures):
        assert np.array_equal(a.sources["x"], b.sources["x"])
    assert not np.array_equal(
        one.reference["ra"], simulate(2, density=5, seed=2, **SMALL).reference["ra"]
    )


def test_without_noise_positions_are_exact():
    exposure = simulate(1, density=8, noise=False, spurious=0.2, **SMALL).exposures[0]
    true = exposure.sources["reference_index"] >= 0
    assert 0 < np.sum(~true) < np.sum(true)
    stars = {int(i): (x, y) for i, x, y in exposure.stars.iterrows("reference_index", "x", "y")}
    for i, x, y in exposure.sources[true].iterrows("reference_index", "x", "y"):
        assert (x, y) == pytest.approx(stars[int(i)], abs=1e-9)


def test_reference_limit():
    simulation = simulate(1, density=8, reference_limit=18.0, **SMALL)
    assert simulation.reference["phot_g_mean_mag"].max() <= 18 * u.mag
    exposure = simulation.exposures[0]
    sources = exposure.sources[exposure.sources["reference_index"] >= 0]
    star = simulation.reference[sources["reference_index"]]
    x, y = exposure.pixel(star["ra"].to_value(u.deg), star["dec"].to_value(u.deg))
    assert np.abs(x - sources["x"]).max() < 1


def test_cluster_has_the_density_of_king():
    king = KingCluster(density=3000, core_radius=20 * u.arcsec, tidal_radius=90 * u.arcsec)
    exposure = simulate(1, density=0, cluster=king, pointing_error=0 * u.arcsec, **SMALL).exposures[
        0
    ]
    x, y = exposure.distortion.undistort(exposure.stars["x"], exposure.stars["y"])
    r = np.hypot(x - 149.5, y - 109.5)  # px of one arcsec
    assert 60 < r.max() < 90.5

    def surface(r):
        edge = 1 / np.hypot(1, 90 / 20)
        return ((1 / np.hypot(1, r / 20) - edge) / (1 - edge)) ** 2

    for low, high in ((0, 10), (10, 20), (20, 40), (40, 80)):
        fine = np.linspace(low, high, 4001)
        expected = np.trapezoid(2 * np.pi * fine * 3000 / 3600 * surface(fine), fine)
        count = np.sum((r >= low) & (r < high))
        assert abs(count - expected) < 4 * np.sqrt(expected)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n_exposures": 0}, "n_exposures must be at least 1, not 0"),
        ({"density": -1}, "density must be not negative, not -1"),
        ({"fwhm": 0}, "fwhm must be positive, not 0"),
        ({"image_shape": (10, 100)}, "image_shape must be at least 16 px"),
        ({"magnitudes": (20, 15)}, "magnitudes must be"),
        ({"lost": 2}, "lost must be between 0 and 1, not 2"),
        ({"seed": -1}, "seed must be 0 or more, not -1"),
        ({"density": [1, 2]}, r"density must be one number, or one for each field \(1\)"),
        ({"epoch": [2016, 2017]}, r"epoch must be one number, or one for each exposure \(5\)"),
        ({"density": 1e9}, "density must give fewer than 100,000,000 stars"),
        ({"galaxies": -1}, "galaxies must be not negative, not -1"),
        ({"camera": "hst"}, "camera must be one of generic, csst-msc, bass-90prime, not hst"),
        ({"camera": "csst-msc", "detectors": ["g-9"]}, "detectors must be among y-1, .*not g-9"),
        ({"camera": "csst-msc", "detector": "a"}, "detector must be left out for a camera"),
        ({"dither": np.nan * u.deg}, "dither must be finite"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(ValueError, match=message):
        simulate(**options)


def test_scale_needs_a_unit():
    with pytest.raises(TypeError, match="pixel_scale must be a Quantity in arcsec"):
        simulate(1, pixel_scale=0.3)


def test_options_that_no_camera_has():
    with pytest.raises(TypeError, match="simulate has no option pixelscale"):
        simulate(1, pixelscale=0.3 * u.arcsec)
    with pytest.raises(TypeError, match="a Camera has its options already and takes no fwhm"):
        simulate(1, camera=make_camera(), fwhm=3.0)
    with pytest.raises(TypeError, match="cluster must be a KingCluster or None, not 0.5"):
        simulate(1, cluster=0.5)


@pytest.mark.parametrize(
    ("radii", "message"),
    [((0, 5), "core_radius must be positive"), ((5, 4), "tidal_radius must be above core_radius")],
)
def test_impossible_cluster(radii, message):
    with pytest.raises(ValueError, match=message):
        KingCluster(10.0, *(radii * u.arcsec))


# ---- images


@pytest.fixture(scope="module")
def lone():
    """Few stars, far from each other."""
    return simulate(
        1,
        seed=8,
        density=1.5,
        image_shape=(500, 600),
        pixel_scale=0.5 * u.arcsec,
        distortion=8.0,
        magnitudes=(16.0, 18.0),
    ).exposures[0]


def isolated(exposure, margin=40):
    x, y = exposure.stars["x"].data, exposure.stars["y"].data
    ny, nx = exposure.image_shape
    apart = np.hypot(x - x[:, None], y - y[:, None])
    np.fill_diagonal(apart, np.inf)
    edge = np.minimum.reduce([x, y, nx - 1 - x, ny - 1 - y])
    return np.flatnonzero((apart.min(axis=1) > margin) & (edge > margin))


def test_image_has_the_flux_and_the_position_of_its_stars(lone):
    image = lone.render(noise=False).astype(float)
    background = 200.0 * (1 + 0.05 * (np.arange(600) / 600 - 0.5)) / lone.header["GAIN"]
    image -= background
    rows = isolated(lone)
    assert len(rows) > 3
    by_index = dict(lone.sources.iterrows("reference_index", "flux"))
    for star in lone.stars[rows]:
        ix, iy = round(star["x"]), round(star["y"])
        stamp = image[iy - 20 : iy + 21, ix - 20 : ix + 21]
        y, x = np.mgrid[iy - 20 : iy + 21, ix - 20 : ix + 21]
        total = stamp.sum()
        # float32 pixels and what the stamps leave out: 1e-3 of the flux, 1e-3 px.
        assert (x * stamp).sum() / total == pytest.approx(star["x"], abs=1e-3)
        assert (y * stamp).sum() / total == pytest.approx(star["y"], abs=1e-3)
        if star["reference_index"] in by_index:
            assert total == pytest.approx(by_index[star["reference_index"]], rel=1e-3)


def test_image_noise_is_photons_and_readout(lone):
    image = lone.render().astype(float)
    assert image.dtype == float
    assert np.array_equal(image, lone.render())
    dark = lone.render(noise=False) < 200.0 / 1.5 * 1.03
    excess = (image - lone.render(noise=False))[dark] * lone.header["GAIN"]
    assert np.mean(excess) == pytest.approx(0, abs=0.2)
    assert np.var(excess) == pytest.approx(200 + 5**2, rel=0.02)


def test_pixels_end_at_saturation():
    exposure = simulate(
        1, density=5, magnitudes=(10.0, 18.0), slope=0.05, saturation=20000.0, **SMALL
    ).exposures[0]
    image = exposure.render()
    assert image.max() == np.float32(20000 / 1.5)
    assert exposure.header["SATURATE"] < image.max()


def test_galaxies_and_cosmic_rays_add_light(lone):
    plain = lone.render(noise=False).sum(dtype=float)
    assert lone.render(noise=False, galaxies=5.0).sum(dtype=float) > plain
    assert lone.render(noise=False, cosmic_rays=5).sum(dtype=float) > plain


def test_frames(lone):
    frame = lone.frame()
    assert frame.load_image is None
    assert "reference_index" not in frame.load_sources().colnames
    assert frame.image_shape == (500, 600)
    image = lone.frame(image=True)
    assert image.load_sources is None
    assert image.load_image().shape == (500, 600)


# ---- files


def test_files(small, tmp_path):
    files = write_simulation(small, tmp_path / "new", images=(0,))
    reference = Table.read(files["reference"])
    assert reference["ra"].unit == u.deg
    assert len(reference) == len(small.reference)
    image = fits.getdata(files["frames"][0])
    assert image.shape == (220, 300)
    assert files["headers"][0] is None
    sources = Table.read(files["frames"][1])
    np.testing.assert_allclose(sources["x"], small.exposures[1].sources["x"])
    header = fits.Header.fromtextfile(files["headers"][1])
    assert WCS(header).wcs.crval == pytest.approx(small.exposures[1].wcs.wcs.crval)


def test_ldac(small, tmp_path):
    files = write_simulation(small, tmp_path, images=(), sources="ldac")
    assert files["headers"] == [None, None]
    with fits.open(files["frames"][0]) as hdus:
        assert [hdu.name for hdu in hdus] == ["PRIMARY", "LDAC_IMHEAD", "LDAC_OBJECTS"]
        np.testing.assert_allclose(
            hdus[2].data["XWIN_IMAGE"], small.exposures[0].sources["x"] + 1, rtol=1e-12
        )
    content = files["frames"][0].read_bytes()
    assert b"CTYPE1  = 'RA---TAN'" in content
    # The cards are padded with blanks: no NUL after the END of the header that is carried.
    end = content.index(b"END" + b" " * 77, content.index(b"LDAC_IMHEAD") + 2880)
    assert b"\0" not in content[end : end + 80]


def test_files_are_kept(small, tmp_path):
    write_simulation(small, tmp_path, images=())
    with pytest.raises(FileExistsError, match=r"sim-reference.fits: file exists"):
        write_simulation(small, tmp_path, images=())
    write_simulation(small, tmp_path, images=(), overwrite=True)


def test_unknown_form(small, tmp_path):
    with pytest.raises(ValueError, match="sources must be 'ecsv' or 'ldac', not 'csv'"):
        write_simulation(small, tmp_path, sources="csv")
