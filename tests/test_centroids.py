import numpy as np
import pytest
from astropy.table import Table
from photutils.psf import GriddedPSFModel, ImagePSF, PSFPhotometry, SourceGrouper
from scipy.interpolate import BSpline
from scipy.special import erf

from wpdc_gwcs.centroids import (
    _blends,
    _build,
    _fit,
    _profile,
    _residual,
    build_epsf,
    fit_centroids,
    measure_psf,
    residual_of,
    subtract_stars,
)
from wpdc_gwcs.detection import (
    FLAG_BLENDED,
    FLAG_FIT_FAILED,
    detect_companions,
    detect_sources,
    subtract_background,
)
from wpdc_gwcs.exceptions import CentroidWarning

SHAPE = (512, 500)
RMS = 6.0
GAIN = 2.0
# Core and halo, (share, sigma in px): not a Moffat profile, and undersampled (FWHM 1.7 px).
CORE, HALO = (0.75, 0.55), (0.25, 1.4)


def stars_image(shape, x, y, flux, *, widen=0.0):
    """Stars integrated over every pixel: exact, by the error function."""
    image = np.zeros(shape)
    u, v = 2 * x / shape[1] - 1, 2 * y / shape[0] - 1
    for k in range(len(x)):
        xc, yc = int(round(x[k])), int(round(y[k]))
        ix = np.arange(max(xc - 14, 0), min(xc + 15, shape[1]))
        iy = np.arange(max(yc - 14, 0), min(yc + 15, shape[0]))
        for share, sigma in (CORE, HALO):
            sx, sy = (
                np.sqrt(2) * sigma * (1 + widen * (u[k] ** 2 + v[k] ** 2) + stretch)
                for stretch in (0.5 * widen * u[k], -0.5 * widen * u[k])
            )
            cx = erf((ix + 0.5 - x[k]) / sx) - erf((ix - 0.5 - x[k]) / sx)
            cy = erf((iy + 0.5 - y[k]) / sy) - erf((iy - 0.5 - y[k]) / sy)
            image[iy[0] : iy[-1] + 1, ix[0] : ix[-1] + 1] += flux[k] * share * cy[:, None] * cx / 4
    return image


def star_grid(rng, step, margin=16):
    gy, gx = np.mgrid[margin : SHAPE[0] - margin : step, margin : SHAPE[1] - margin : step]
    n, jitter = gx.size, step / 6
    return (
        gx.ravel() + rng.uniform(-jitter, jitter, n),
        gy.ravel() + rng.uniform(-jitter, jitter, n),
    )


def observe(model, rng, gain=GAIN):
    return rng.poisson((model + 50) * gain) / gain + rng.normal(0, RMS, model.shape)


def nearest(sources, x, y):
    distance = np.hypot(np.subtract.outer(x, sources["x"]), np.subtract.outer(y, sources["y"]))
    return distance.argmin(axis=1), distance.min(axis=1)


@pytest.fixture(scope="module")
def frame():
    """500 isolated stars of all fluxes with a PSF that varies, measured."""
    rng = np.random.default_rng(7)
    x, y = star_grid(rng, 22)
    flux = 10 ** rng.uniform(2.9, 5.2, x.size)
    image = observe(stars_image(SHAPE, x, y, flux, widen=0.05), rng)
    background = subtract_background(image)
    sources = detect_sources(background, gain=GAIN)
    epsf = build_epsf(background, sources, gain=GAIN)
    result = fit_centroids(background, sources, epsf, gain=GAIN)
    index, distance = nearest(result, x, y)
    found = distance < 1
    return {
        "background": background,
        "sources": sources,
        "epsf": epsf,
        "result": result,
        "index": index[found],
        "x": x[found],
        "y": y[found],
        "flux": flux[found],
    }


def residuals(frame, rows, table="result"):
    index = frame["index"][rows]
    return np.concatenate([np.asarray(frame[table][c])[index] - frame[c][rows] for c in ("x", "y")])


def test_bright_stars_at_the_photon_limit(frame):
    bright = frame["flux"] > 3e4
    d = residuals(frame, bright)
    assert bright.sum() > 100
    # windowed centroids of undersampled stars are off by the pixel phase
    assert np.std(residuals(frame, bright, "sources")) > 4 * np.std(d)
    assert np.std(d) < 0.008
    assert abs(np.mean(d)) < 0.002


def test_no_pixel_phase_error(frame):
    bright = frame["flux"] > 1e4
    d = residuals(frame, bright)
    phase = 2 * np.pi * np.concatenate([frame["x"][bright], frame["y"][bright]])
    terms = np.stack([np.sin(phase), np.cos(phase), np.sin(2 * phase), np.cos(2 * phase)], axis=1)
    amplitudes = np.linalg.lstsq(terms, d, rcond=None)[0]
    assert np.abs(amplitudes).max() < 0.003


@pytest.mark.parametrize(("low", "high"), [(800, 3000), (3000, 20000), (20000, 2e5)])
def test_errors_are_honest(frame, low, high):
    rows = (frame["flux"] > low) & (frame["flux"] < high)
    index = frame["index"][rows]
    errors = np.concatenate([frame["result"][c][index] for c in ("x_err", "y_err")])
    pulls = residuals(frame, rows) / errors
    assert 0.85 < 1.4826 * np.median(np.abs(pulls)) < 1.2
    # the PSF is learnt from the same stars: a little of their noise is in it
    assert np.median(frame["result"]["chi2"][index]) == pytest.approx(0.95, abs=0.2)


def test_faint_stars_near_the_cramer_rao_bound(frame):
    rows = np.flatnonzero((frame["flux"] > 800) & (frame["flux"] < 3000))
    bounds = []
    for k in rows:
        # the bound for known flux and PSF, from the exact profile by differences
        one, h = np.array([1.0]), 1e-3
        x, y, flux = (frame[c][k : k + 1] for c in ("x", "y", "flux"))
        corner = np.floor([x[0] - 12, y[0] - 12])
        shape = (25, 25)
        # the varying part of the PSF is small: taken at the center
        left, right = (stars_image(shape, x - corner[0] + d, y - corner[1], flux) for d in (-h, h))
        model = stars_image(shape, x - corner[0], y - corner[1], flux)
        variance = RMS**2 + (model + 50) / GAIN
        bounds.append(one[0] / np.sqrt((((right - left) / 2 / h) ** 2 / variance).sum()))
    d = residuals(frame, rows)
    scaled = d / np.concatenate([bounds, bounds])
    assert 1.4826 * np.median(np.abs(scaled)) < 1.25


def test_varying_psf_is_recognised(frame):
    assert isinstance(frame["epsf"], GriddedPSFModel)
    # broadest in the corners: the peak of the profile is lower there
    peaks = frame["epsf"].data.max(axis=(1, 2)).reshape(5, 5)
    assert peaks[2, 2] > 1.03 * peaks[[0, 0, -1, -1], [0, -1, 0, -1]].max()


def test_epsf_follows_the_true_profile(rng):
    x, y = star_grid(rng, 22)
    flux = 10 ** rng.uniform(3.5, 5.0, x.size)
    background = subtract_background(observe(stars_image(SHAPE, x, y, flux), rng))
    epsf = build_epsf(background, detect_sources(background, gain=GAIN), gain=GAIN, vary="never")
    assert isinstance(epsf, ImagePSF)
    size = epsf.data.shape[0]
    u = (np.arange(size) - size // 2) / 4
    truth = 0
    for share, sigma in (CORE, HALO):
        s = np.sqrt(2) * sigma
        c = (erf((0.5 - u) / s) + erf((0.5 + u) / s)) / 2
        truth = truth + share * c[:, None] * c
    assert np.abs(epsf.data - truth).max() < 0.01 * truth.max()
    assert epsf.data.sum() / 16 == pytest.approx(1, abs=1e-3)


def test_photutils_agrees(frame):
    background, sources = frame["background"], frame["sources"]
    rows = frame["index"][np.argsort(frame["flux"])[-60::12]]
    error = np.sqrt(background.rms**2 + np.maximum(background.image, 0) / GAIN)
    middle = ImagePSF(frame["epsf"].data[12], oversampling=4)
    ours = fit_centroids(background, sources, middle, gain=GAIN)[rows]
    photometry = PSFPhotometry(middle, (5, 5), grouper=SourceGrouper(1), aperture_radius=4)
    start = Table({"x": sources["x"][rows], "y": sources["y"][rows]})
    theirs = photometry(background.image.astype(float), error=error, init_params=start)
    for axis in "xy":
        np.testing.assert_allclose(ours[axis], theirs[f"{axis}_fit"], atol=0.01)
    np.testing.assert_allclose(ours["flux"], theirs["flux_fit"], rtol=0.03)


def test_neighbors_are_taken_off(rng):
    x, y = star_grid(rng, 30)
    flux = np.full(x.size, 20000.0)
    angle = rng.uniform(0, 2 * np.pi, x.size)
    paired = rng.uniform(size=x.size) < 0.5
    xn, yn = x[paired] + 4 * np.cos(angle[paired]), y[paired] + 4 * np.sin(angle[paired])
    allx, ally = np.append(x, xn), np.append(y, yn)
    image = stars_image(SHAPE, allx, ally, np.append(flux, flux[paired]))
    background = subtract_background(observe(image, rng))
    sources = detect_sources(background, gain=GAIN)
    epsf = build_epsf(background, sources, gain=GAIN)
    once = fit_centroids(background, sources, epsf, gain=GAIN, passes=1)
    result = fit_centroids(background, sources, epsf, gain=GAIN)
    index, distance = nearest(result, allx, ally)
    assert (distance < 0.5).all()
    d = np.asarray(result["x"])[index] - allx
    before = np.asarray(once["x"])[index] - allx
    assert np.std(d[np.append(paired, np.ones(len(xn), bool))]) < 0.012
    assert np.std(before) > 1.5 * np.std(d)


def test_companions_on_the_flanks_are_found_and_taken_off(rng):
    x, y = star_grid(rng, 24)
    flux = 10 ** rng.uniform(4.0, 4.8, x.size)
    # Every third star has a companion of a tenth of its light, too near for a peak of its own.
    angle = rng.uniform(0, 2 * np.pi, x.size)
    pair = np.arange(x.size) % 3 == 0
    x2, y2 = (x + 2.1 * np.cos(angle))[pair], (y + 2.1 * np.sin(angle))[pair]
    image = stars_image(SHAPE, x, y, flux) + stars_image(SHAPE, x2, y2, 0.1 * flux[pair])
    background = subtract_background(observe(image, rng))
    sources = detect_sources(background, gain=GAIN)
    epsf = build_epsf(background, sources, gain=GAIN)
    before = fit_centroids(background, sources, epsf, gain=GAIN)
    residual = subtract_stars(background, before, epsf, gain=GAIN)
    more = detect_companions(residual, sources, gain=GAIN)
    start = more.copy()
    for name in ("x", "y", "flux"):
        start[name][: len(before)] = before[name]
    after = fit_centroids(background, start, epsf, gain=GAIN, refit=True, passes=6)

    def error(table):
        return np.median(nearest(table, x[pair], y[pair])[1])

    assert np.mean(nearest(before, x2, y2)[1] < 0.5) < 0.2
    assert np.mean(nearest(after, x2, y2)[1] < 0.5) > 0.85
    assert error(after) < 0.3 * error(before)
    assert np.mean(after["flags"][nearest(after, x2, y2)[0]] & FLAG_BLENDED > 0) > 0.85
    # Stars without companion are where they were.
    index, _ = nearest(after, x[~pair], y[~pair])
    assert np.median(np.hypot(after["x"] - start["x"], after["y"] - start["y"])[index]) < 1e-3
    # The known sources come first, as they were; hardly anything but companions is added.
    assert np.array_equal(more["x"][: len(sources)], sources["x"])
    assert more.meta == sources.meta
    index, distance = nearest(more[len(sources) :], x2, y2)
    assert len(more) - len(sources) < np.sum(distance < 0.7) + 0.03 * len(x)


def test_subtracted_stars_leave_noise(frame):
    background, result = frame["background"], frame["result"]
    residual = subtract_stars(background, result, frame["epsf"], gain=GAIN)
    assert (residual.rms >= background.rms).all()
    assert np.std(residual.image / residual.rms) == pytest.approx(1, abs=0.05)
    assert np.abs(residual.image / residual.rms).max() < 7
    # What has no fit stays where it is.
    kept = result.copy()
    kept["chi2"][frame["index"][0]] = np.nan
    x, y = np.rint(frame["x"][0]).astype(int), np.rint(frame["y"][0]).astype(int)
    one = subtract_stars(background, kept, frame["epsf"], gain=GAIN)
    assert one.image[y, x] == pytest.approx(background.image[y, x], rel=1e-3)
    # Nothing is added to stars that stand alone.
    assert len(detect_companions(residual, frame["sources"])) <= len(result) + 2
    with pytest.raises(ValueError, match="threshold must be positive, got 0"):
        detect_companions(residual, frame["sources"], threshold=0)


def test_models_are_taken_off_the_image_itself(frame):
    background, sources, epsf = (frame[name] for name in ("background", "sources", "epsf"))
    before = background.image.copy()
    work = background.copy()
    fitted = fit_centroids(work, sources, epsf, gain=GAIN, overwrite=True)
    np.testing.assert_array_equal(background.image, before)
    expected = frame["result"]
    np.testing.assert_allclose(fitted["x"], expected["x"], rtol=1e-9)
    # What is left is the image without the stars, however often each has been drawn anew.
    residual = subtract_stars(background, fitted, epsf, gain=GAIN)
    np.testing.assert_allclose(work.image, residual.image, atol=2e-3 * background.noise)
    # Fits that go on from there are those of the whole image.
    again = fit_centroids(
        work, fitted, epsf, gain=GAIN, refit=True, subtracted=fitted, overwrite=True
    )
    whole = fit_centroids(background, fitted, epsf, gain=GAIN, refit=True)
    good = np.isfinite(whole["chi2"])
    assert good.mean() > 0.98
    for name in ("x", "y"):
        off = (again[name] - whole[name])[good] / whole["x_err"][good]
        assert np.abs(off).max() < 0.02
    np.testing.assert_allclose(again["x_err"][good], whole["x_err"][good], rtol=5e-3)


def test_parts_of_the_work_change_nothing(frame, monkeypatch):
    for module, name, size in ((_fit, "_CHUNK", 60), (_blends, "_CHUNK", 60)):
        monkeypatch.setattr(module, name, size)
    monkeypatch.setattr(_residual, "_STRIP", 40 * SHAPE[1])
    sources, expected = frame["sources"], frame["result"]
    again = fit_centroids(frame["background"], sources, frame["epsf"], gain=GAIN)
    for name in expected.colnames:
        np.testing.assert_allclose(again[name], expected[name], rtol=1e-8, err_msg=name)


def test_residuals_are_the_same_in_strips_and_whole(frame):
    background, result, epsf = (frame[name] for name in ("background", "result", "epsf"))
    whole = subtract_stars(background, result, epsf, gain=GAIN)
    parts = residual_of(background, result, epsf, gain=GAIN)
    assert parts.shape == whole.image.shape
    for start, stop in ((0, 37), (37, 160), (160, whole.image.shape[0])):
        strip = parts.rows(start, stop)
        np.testing.assert_allclose(strip.image, whole.image[start:stop], atol=1e-3)
        np.testing.assert_allclose(strip.rms, whole.rms[start:stop], rtol=1e-5)
    found = detect_companions(parts, frame["sources"], gain=GAIN)
    assert len(found) == len(detect_companions(whole, frame["sources"], gain=GAIN))


def test_psf_without_photutils_is_the_same(frame):
    background, sources = frame["background"], frame["sources"]
    profile = measure_psf(background, sources, gain=GAIN)
    result = fit_centroids(background, sources, profile, gain=GAIN)
    np.testing.assert_allclose(result["x"], frame["result"]["x"], atol=1e-7)


def test_first_round_has_the_positions_without_the_judgement(frame):
    background, sources, epsf = (frame[name] for name in ("background", "sources", "epsf"))
    rough = fit_centroids(background, sources, epsf, gain=GAIN, judge=False)
    for name in ("x", "y", "flux"):
        np.testing.assert_array_equal(rough[name], frame["result"][name])


def test_unknown_gain_is_learnt(frame):
    background, sources = frame["background"], frame["sources"]
    epsf = build_epsf(background, sources)
    result = fit_centroids(background, sources, epsf)
    ratio = result["x_err"] / frame["result"]["x_err"]
    assert np.nanmedian(ratio) == pytest.approx(1, abs=0.15)


def test_table_is_copied_and_columns_carried(frame):
    sources = frame["sources"].copy()
    sources["name"] = np.arange(len(sources))
    before = sources.copy()
    result = fit_centroids(frame["background"], sources, frame["epsf"], gain=GAIN)
    for name in before.colnames:
        np.testing.assert_array_equal(sources[name], before[name])
    np.testing.assert_array_equal(result["name"], sources["name"])
    assert result.meta["fwhm"] == sources.meta["fwhm"]
    for name in ("x_err", "y_err", "flux_err", "snr", "chi2"):
        assert name in result.colnames


def test_no_star_keeps_its_place_and_is_flagged(frame):
    sources = frame["sources"][:5].copy()
    sources["x"][2], sources["y"][2] = 250.0, 3.0e3  # off the image
    sources["x"][3], sources["y"][3] = 5.0, 5.0  # empty sky
    sources["flux"][3] = 100.0
    result = fit_centroids(frame["background"], sources, frame["epsf"], gain=GAIN)
    assert result["flags"][2] & FLAG_FIT_FAILED
    assert result["x"][2] == 250.0
    assert np.isnan(result["chi2"][2])
    assert np.isfinite(result["x"][3])
    assert (result["flags"][[0, 1, 4]] == frame["result"]["flags"][[0, 1, 4]]).all()


def test_too_few_stars_warn(rng):
    x, y = np.array([60.3, 130.2, 200.8]), np.array([70.1, 150.6, 90.4])
    image = observe(stars_image((240, 250), x, y, np.full(3, 20000.0)), rng)
    background = subtract_background(image)
    sources = detect_sources(background)
    with pytest.warns(CentroidWarning, match="3 bright, clean, isolated stars, 8 needed"):
        assert build_epsf(background, sources) is None


def test_a_dozen_stars_suffice(rng):
    x, y = star_grid(rng, 120)
    image = observe(stars_image(SHAPE, x, y, np.full(x.size, 40000.0)), rng)
    background = subtract_background(image)
    sources = detect_sources(background, gain=GAIN)
    result = fit_centroids(background, sources, build_epsf(background, sources), gain=GAIN)
    index, _ = nearest(result, x, y)
    clean = result["flags"][index] == 0
    assert 12 <= clean.sum() <= 16
    assert np.std((np.asarray(result["x"])[index] - x)[clean]) < 0.012


def test_plain_array_and_nan_pixels(frame):
    background, sources = frame["background"], frame["sources"]
    image = background.image.astype(float)
    same = fit_centroids(image, sources, frame["epsf"], gain=GAIN, error=background.rms)
    np.testing.assert_allclose(same["x"], frame["result"]["x"], atol=1e-6)
    star = frame["index"][np.argmax(frame["flux"])]
    image[int(sources["y"][star].round()) + 1, int(sources["x"][star].round())] = np.nan
    result = fit_centroids(image, sources, frame["epsf"], gain=GAIN, error=background.rms)
    assert result["x"][star] == pytest.approx(frame["result"]["x"][star], abs=0.02)


def test_wrong_arguments(frame):
    background, sources, epsf = (frame[c] for c in ("background", "sources", "epsf"))
    with pytest.raises(ValueError, match="error must be given"):
        fit_centroids(background.image, sources, epsf)
    with pytest.raises(ValueError, match="error must not be given"):
        fit_centroids(background, sources, epsf, error=1.0)
    with pytest.raises(ValueError, match="error must be positive"):
        fit_centroids(background.image, sources, epsf, error=0.0)
    with pytest.raises(ValueError, match="2-D"):
        build_epsf(background.image[0], sources, error=1.0)
    with pytest.raises(ValueError, match="passes"):
        fit_centroids(background, sources, epsf, passes=0)
    with pytest.raises(ValueError, match="vary"):
        build_epsf(background, sources, vary="yes")
    with pytest.raises(ValueError, match="odd sides"):
        fit_centroids(background, sources, ImagePSF(np.ones((20, 20)), oversampling=4))
    with pytest.raises(ValueError, match="no FWHM"):
        fit_centroids(background, Table({"x": [3.0], "y": [3.0], "flux": [1.0]}), epsf)


def test_empty_table(frame):
    result = fit_centroids(frame["background"], frame["sources"][:0], frame["epsf"])
    assert len(result) == 0
    assert "chi2" in result.colnames


def test_profile_is_photutils_image_psf(rng):
    samples = _profile.moffat_samples([np.log(0.8), np.log(2.0), 0.1, 0.05], 8, 4)
    profile = _profile.Profile.constant(samples, 4)
    model = ImagePSF(samples, oversampling=4)
    dx, dy = rng.uniform(-0.7, 0.7, (2, 20))
    values = profile.evaluate(dx, dy, 4, np.ones((20, 1)))
    yy, xx = np.mgrid[-4:5, -4:5]
    for k in range(20):
        expected = model.evaluate(xx, yy, 1, dx[k], dy[k])
        np.testing.assert_allclose(values[0, k].reshape(9, 9), expected, atol=1e-7)
    h = 1e-5
    for axis, (hx, hy) in enumerate([(h, 0), (0, h)]):
        slope = [
            profile.evaluate(dx + s * hx, dy + s * hy, 4, np.ones((20, 1)))[0] for s in (-1, 1)
        ]
        np.testing.assert_allclose(values[1 + axis], (slope[1] - slope[0]) / 2 / h, atol=1e-8)


def test_profile_far_from_the_star_is_zero():
    samples = _profile.moffat_samples([np.log(0.8), np.log(2.0), 0.0, 0.0], 6, 4)
    profile = _profile.Profile.constant(samples, 4)
    far = np.array([100.0, -1e6])
    assert (profile.evaluate(far, far, 3, np.ones((2, 1))) == 0).all()


def test_splines_with_a_knot_more_are_the_same(rng):
    """Against the values of scipy's B-splines."""
    coefficients = np.zeros((21, 3))
    coefficients[3:-3] = rng.normal(size=(15, 3))
    finer = _build._halved(coefficients)
    knots, fine = np.arange(-2.0, 23.0), np.arange(-2.0, 43.0) / 2
    place = np.linspace(1, 19, 200)
    assert finer.shape == (41, 3)
    for before, after in zip(coefficients.T, finer.T, strict=True):
        expected = BSpline(knots, before, 3)(place)
        np.testing.assert_allclose(BSpline(fine, after, 3)(place), expected, atol=1e-14)
