"""The solution of exposures whose distortion and pointings are known."""

from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table
from numpy.testing import assert_allclose

from wpdc_gwcs import RadialWeight, build_wcs
from wpdc_gwcs.exceptions import FitError
from wpdc_gwcs.models import deproject, project
from wpdc_gwcs.solution import Calibration
from wpdc_gwcs.solve import Exposure, solve

SHAPE = (2000, 2048)
CRPIX = np.array([1023.5, 999.5])
CD = 2e-5 * np.array([[-1.0, 0.03], [0.03, 1.0]])
NOISE = 0.05
WEIGHT = RadialWeight("exp-sqrt", r0=900.0)


def cubic(x, y):
    """Distortion of 12 px at the corners that a cubic describes, without linear part."""
    u, v = (x - CRPIX[0]) / 1024, (y - CRPIX[1]) / 1024
    return 3 * u * (u * u + v * v) + u * v, 3 * v * (u * u + v * v) - 2 * u * u


def smooth(x, y):
    """The same with structure that no cubic takes: 0.5 px at the corners."""
    u, v = (x - CRPIX[0]) / 1024, (y - CRPIX[1]) / 1024
    dx, dy = cubic(x, y)
    return dx + 0.5 * u**3 * v**2, dy - 0.4 * u**5 + 0.1 * np.sin(4 * v)


class Field:
    """Exposures of one detector whose truth is known."""

    def __init__(
        self,
        rng,
        n=5,
        stars=400,
        distortion=smooth,
        noise=NOISE,
        cds=None,
        crval=(40.0, 20.0),
        dither=0.005,
    ):
        self.distortion = distortion
        self.cds = [CD] * n if cds is None else cds
        ra = crval[0] + dither * rng.normal(size=n) / np.cos(np.radians(crval[1]))
        self.crvals = np.stack([ra % 360, crval[1] + dither * rng.normal(size=n)], axis=1)
        self.exposures = []
        for k, (true_cd, true_crval) in enumerate(zip(self.cds, self.crvals)):
            x, y = rng.uniform(0, SHAPE[1] - 1, stars), rng.uniform(0, SHAPE[0] - 1, stars)
            ra, dec = self.sky(k, x, y)
            error = rng.uniform(0.6, 1.4, stars) * noise
            x, y = x + rng.normal(size=stars) * error, y + rng.normal(size=stars) * error
            start = np.array(deproject(2e-4, -1e-4, true_crval))
            if noise == 0:
                error = None
            self.exposures.append(
                Exposure(
                    f"e{k}",
                    x,
                    y,
                    ra,
                    dec,
                    start,
                    true_cd @ [[1.002, 0.003], [-0.003, 1.002]],
                    error,
                    error,
                    detector="det-1",
                )
            )

    def sky(self, k, x, y):
        dx, dy = self.distortion(x, y)
        return deproject(*(self.cds[k] @ [x + dx - CRPIX[0], y + dy - CRPIX[1]]), self.crvals[k])

    def errors(self, result, k, n=41):
        """Error of exposure k on a grid over the detector, (2, n, n) px along the true axes."""
        x, y = np.meshgrid(np.linspace(0, SHAPE[1] - 1, n), np.linspace(0, SHAPE[0] - 1, n))
        sky = frame_of(result, k).wcs(x, y)
        dx, dy = self.distortion(x, y)
        place = np.tensordot(
            np.linalg.inv(self.cds[k]), np.array(project(*sky, self.crvals[k])), axes=1
        )
        return place - [x + dx - CRPIX[0], y + dy - CRPIX[1]]

    def rms(self, result):
        kept = [k for k, f in enumerate(result.exposures) if f.reason is None]
        return float(
            np.sqrt(np.mean([np.sum(self.errors(result, k) ** 2, axis=0).mean() for k in kept]))
        )

    def solve(self, **options):
        weight = None if options.get("lut") == "none" else WEIGHT
        return solve(
            self.exposures, image_shape=SHAPE, crpix=CRPIX, **{"weight": weight, **options}
        )


def turbulence(rng, amplitude, scale, waves=400):
    """Curl-free displacement with the spectrum of von Karman, px: a sum of plane waves."""
    # The cumulative distribution of k is 1 - (1 + (k / k0)^2)^(-5/6).
    k = 2 * np.pi / scale * np.sqrt(rng.uniform(size=waves) ** (-6 / 5) - 1)
    angle, phase = rng.uniform(0, 2 * np.pi, (2, waves))
    unit = np.array([np.cos(angle), np.sin(angle)])

    def displacement(x, y):
        x, y = np.asarray(x)[..., None], np.asarray(y)[..., None]
        wave = np.cos(k * (unit[0] * x + unit[1] * y) + phase) * 2 * amplitude / np.sqrt(waves)
        return np.array([wave @ unit[0], wave @ unit[1]])

    return displacement


def corner(rng, stars, size):
    """One exposure whose stars are all in one corner."""
    field = Field(rng, n=1, stars=10)
    x, y = rng.uniform(0, size, (2, stars))
    ra, dec = field.sky(0, x, y)
    error = np.full(stars, NOISE)
    x, y = x + rng.normal(size=stars) * error, y + rng.normal(size=stars) * error
    old = field.exposures[0]
    field.exposures = [
        Exposure("e0", x, y, ra, dec, old.crval, old.cd, error, error, detector="det-1")
    ]
    return field


def frame_of(result, k):
    """Calibration of exposure k as `calibrate` delivers it."""
    fit, solution = result.exposures[k], result.solution
    return Calibration(
        fit.name,
        solution if fit.pv is None else replace(solution, pv=fit.pv),
        fit.crval,
        fit.cd,
        field=fit.field,
        sigma=fit.sigma,
    )


@pytest.fixture(scope="module")
def solved():
    field = Field(np.random.default_rng(3), n=6)
    return field, field.solve()


class TestSolve:
    @pytest.mark.parametrize("n", [1, 4])
    def test_noise_free_cubic_is_recovered(self, rng, n):
        field = Field(rng, n=n, distortion=cubic, noise=0)
        result = field.solve(lut="none")
        # Iterated until no exposure moves by 1e-4 px.
        assert field.rms(result) < 1e-4
        for fit, crval in zip(result.exposures, field.crvals):
            assert_allclose(fit.crval, crval, atol=1e-4 * 2e-5 * 5, rtol=0)
            assert_allclose(fit.cd, CD, atol=1e-9 * 2e-5 * 1e3, rtol=0)

    def test_gauge(self, solved):
        """CRVAL is the sky at CRPIX and CD the local scale there, but for the table."""
        _, result = solved
        coefficients = result.solution.pv.coefficients
        assert_allclose(coefficients[:, :3], [[0, 1, 0], [0, 1, 0]], atol=1e-15)
        fit = result.exposures[0]
        wcs = build_wcs(
            crpix=CRPIX,
            cd=fit.cd,
            crval=fit.crval,
            pv=result.solution.pv,
            pv_cd=result.solution.cd,
            image_shape=SHAPE,
        )
        assert_allclose(wcs(*CRPIX), fit.crval, atol=1e-12)

    def test_reaches_the_floor(self, solved):
        field, result = solved
        # Attitude: 0.05 sqrt(2 / 400) to 0.05 sqrt(6 / 400), as far as pooling goes; table: about
        # 0.05 sqrt(2 * 25 / 2400).
        assert field.rms(result) < 0.010
        assert result.solution.detector == "det-1"
        assert result.rejected == {}
        assert result.solution.lookup_table is not None
        assert_allclose(result.solution.statistics["error_scale"], 1.0, atol=0.1)
        assert result.solution.residual_map.n_stars > 0.98 * 6 * 400

    def test_uncertainty_is_honest(self, solved):
        field, result = solved
        pulls = []
        for k in range(len(result.exposures)):
            frame = frame_of(result, k)
            x, y = np.meshgrid(np.linspace(0, SHAPE[1] - 1, 41), np.linspace(0, SHAPE[0] - 1, 41))
            sigma_x, sigma_y, _ = frame.uncertainty(x, y)
            pulls += [field.errors(result, k)[0] / sigma_x, field.errors(result, k)[1] / sigma_y]
        assert 0.6 < np.sqrt(np.mean(np.square(pulls))) < 1.4

    def test_held_out_stars(self, solved, rng):
        """They are predicted with the promised error, and have no influence at all."""
        field = Field(rng, n=5)
        use = rng.uniform(size=400) > 0.2
        field.exposures = [replace(e, use=use) for e in field.exposures]
        choice = {"det-1": solved[1].table_info.choice}
        result = field.solve(table_choice=choice)
        pulls = []
        for k, (pairs, fit) in enumerate(zip(field.exposures, result.exposures)):
            frame = frame_of(result, k)
            sigma = frame.uncertainty(pairs.x, pairs.y)[:2]
            assert not np.any(fit.used[~use])
            pulls += [
                (d / np.hypot(e, s))[~use]
                for d, e, s in zip((fit.dx, fit.dy), (fit.x_err, fit.y_err), sigma)
            ]
        # 400 stars, two axes: 2.5 %.
        assert 0.9 < np.std(pulls) < 1.1
        moved = [replace(e, x=np.where(use, e.x, e.x + 3)) for e in field.exposures]
        field.exposures = moved
        again = field.solve(table_choice=choice)
        assert_allclose(again.exposures[2].crval, result.exposures[2].crval, rtol=0, atol=1e-13)
        assert_allclose(again.solution.lookup_table.dx, result.solution.lookup_table.dx, atol=1e-12)

    @pytest.mark.parametrize("crval", [(0.0, -45.0), (123.0, 89.99)])
    def test_sky_is_round(self, rng, crval):
        field = Field(rng, n=3, crval=crval, distortion=cubic)
        result = field.solve(lut="none")
        assert field.rms(result) < 0.02
        separation = project(*result.solution.crval, crval)
        assert np.hypot(*separation) < 0.02

    def test_swapped_axes_and_given_cd(self, rng):
        swapped = 2e-5 * np.array([[0.0, 1.0], [1.0, 0.0]])
        field = Field(rng, n=2, cds=[swapped] * 2, distortion=cubic)
        nominal = swapped @ [[1.001, 0.0], [0.002, 0.999]]
        result = field.solve(lut="none", cd=nominal)
        assert_allclose(result.solution.cd, nominal)
        assert field.rms(result) < 0.015

    def test_errors_per_axis(self, rng):
        """A star that is well measured along one axis only."""
        field = Field(rng, n=2, distortion=cubic)
        exposures = []
        for e in field.exposures:
            bad = np.arange(400) < 200
            y = e.y + np.where(bad, rng.normal(0, 2, 400), 0)
            exposures.append(replace(e, y=y, y_err=np.where(bad, 2.0, e.y_err)))
        field.exposures = exposures
        assert field.rms(field.solve(lut="none")) < 0.015

    def test_degree_and_weights(self, rng):
        field = Field(rng, n=2, noise=0, distortion=lambda x, y: (2e-13 * (x - 1000) ** 4, 0 * y))
        result = field.solve(lut="none", degree=4)
        assert result.solution.pv.degree == 4
        assert field.rms(result) < 1e-4
        uniform = solve(
            field.exposures, image_shape=SHAPE, lut="none", weight=RadialWeight("uniform")
        )
        assert uniform.solution.settings["weight"] == "uniform"
        assert uniform.solution.pv.degree == 3
        assert_allclose(uniform.solution.crpix, [1023.5, 999.5])

    @pytest.mark.parametrize("refine", ["auto", "attitude"])
    def test_polynomial_alone(self, rng, refine):
        """Without a table there is no fine structure, and the residuals are those of the WCS."""
        field = Field(rng, n=2)
        result = field.solve(lut="none", refine=refine)
        assert result.solution.lookup_table is None
        for k, (pairs, fit) in enumerate(zip(field.exposures, result.exposures)):
            assert fit.field is None
            x, y = frame_of(result, k).undistort(pairs.x, pairs.y)
            plane = np.linalg.solve(fit.cd, np.array(project(pairs.ra, pairs.dec, fit.crval)))
            assert_allclose([fit.dx, fit.dy], [x, y] - CRPIX[:, None] - plane, atol=1e-3)
        # A cubic leaves 0.5 px at the corners.
        assert field.rms(result) > 0.03

    def test_residuals_are_those_of_the_wcs(self, solved):
        field, result = solved
        for k, (pairs, fit) in enumerate(zip(field.exposures, result.exposures)):
            x, y = frame_of(result, k).undistort(pairs.x, pairs.y)
            inside = np.isfinite(x)
            assert inside.sum() > 390
            plane = np.linalg.solve(fit.cd, np.array(project(pairs.ra, pairs.dec, fit.crval)))
            expected = [x, y] - CRPIX[:, None] - plane
            assert_allclose(np.array([fit.dx, fit.dy])[:, inside], expected[:, inside], atol=1e-3)


class TestAttitudes:
    def test_pooling_helps_where_attitudes_agree(self, rng):
        field = Field(rng, n=8, stars=100, distortion=cubic)
        pooled, free = field.solve(lut="none"), field.solve(lut="none", pool_attitudes=False)
        assert field.rms(pooled) < 0.85 * field.rms(free)
        variation = pooled.solution.statistics["attitude_variation"]
        assert set(variation) == {"scale", "rotation", "stretch", "shear"}

    def test_pooling_does_not_bend_real_differences(self, rng):
        cds = [CD @ (np.eye(2) + 1e-3 * rng.normal(size=(2, 2))) for _ in range(8)]
        field = Field(rng, n=8, stars=100, distortion=cubic, cds=cds)
        pooled, free = field.solve(lut="none"), field.solve(lut="none", pool_attitudes=False)
        assert field.rms(pooled) < 1.02 * field.rms(free)
        assert_allclose(pooled.solution.statistics["attitude_variation"]["scale"], 1e-3, rtol=0.8)

    @pytest.mark.parametrize("stars", [9, 20, 100])
    def test_new_exposure_of_a_stored_solution(self, solved, rng, stars):
        _, stored = solved
        field = Field(rng, n=2, stars=stars)
        result = field.solve(solution=stored.solution)
        assert result.solution is stored.solution
        # Three numbers per axis from the stars, and the error of the instrument.
        assert field.rms(result) < 0.01 + 2 * NOISE * np.sqrt(6 / stars)

    def test_stored_solution_of_another_detector(self, solved, rng):
        field = Field(rng, n=1)
        with pytest.raises(FitError, match=r"\(2000, 2048\) px.*\(1000, 1000\)"):
            solve(field.exposures, image_shape=(1000, 1000), solution=solved[1].solution)

    def test_attitude_from_a_corner(self, solved, rng):
        """Forty stars within 60 px tell nothing of the far corner, and the result says so."""
        field = corner(rng, 40, 60.0)
        result = field.solve(solution=solved[1].solution)
        sigma_x, sigma_y, _ = frame_of(result, 0).uncertainty(2000.0, 1950.0)
        error = np.abs(field.errors(result, 0)[:, -1, -1])
        assert min(sigma_x, sigma_y) > 0.3
        assert np.all(error < 3.5 * np.array([sigma_x, sigma_y]))
        # Among them it is that of the table in the corner, and of the shift.
        near = frame_of(result, 0).uncertainty(30.0, 30.0)[:2]
        assert max(near) < NOISE


class TestUpdate:
    def test_merges_residuals(self, solved, rng):
        field, stored = solved
        new = Field(rng, n=6)
        result = new.solve(solution=stored.solution, update=True)
        assert result.table_info.candidates
        before, after = stored.solution.residual_map, result.solution.residual_map
        assert after.n_stars - before.n_stars == sum(f.used.sum() for f in result.exposures)
        assert np.nanmean(result.solution.table_sigma[0]) < np.nanmean(
            stored.solution.table_sigma[0]
        )
        assert new.rms(result) < 0.010
        assert_allclose(result.solution.pv.parameters, stored.solution.pv.parameters)
        # The stored one is not touched.
        assert stored.solution.residual_map.n_stars == before.n_stars

    def test_needs_a_stored_map(self, solved, rng):
        bare = replace(solved[1].solution, residual_map=None)
        with pytest.raises(FitError, match="holds no residual map"):
            Field(rng, n=2).solve(solution=bare, update=True)
        with pytest.raises(ValueError, match="update needs a stored solution"):
            Field(rng, n=2).solve(update=True)


class TestRefine:
    def test_own_polynomials(self, solved, rng):
        field = Field(rng, n=3, stars=600)
        choice = {"det-1": solved[1].table_info.choice}
        result = field.solve(refine="pv", table_choice=choice)
        assert all(f.pv is not None for f in result.exposures)
        assert_allclose([f.pv.pv1_1.value for f in result.exposures], 1.0)
        assert all(f.field is None for f in result.exposures)
        assert all(np.isfinite(f.sigma).all() for f in result.exposures)
        # The star noise of one exposure, extrapolated from r0 to the corners.
        shared = field.solve(table_choice=choice)
        assert field.rms(shared) < field.rms(result) < 0.15

    def test_auto_keeps_what_predicts(self, solved, rng):
        """Where exposures differ by six numbers, they get no field."""
        choice = {"det-1": solved[1].table_info.choice}
        result = Field(rng, n=3, stars=300).solve(table_choice=choice)
        for fit in result.exposures:
            assert fit.pv is None
            assert "field" not in fit.statistics

    def test_auto_follows_an_unstable_instrument(self, rng):
        """Two states of an instrument, 4 px apart at the corners: the fields take what differs."""
        field = Field(rng, n=4, stars=600, distortion=cubic)
        other = Field(rng, n=4, stars=600, distortion=lambda x, y: [1.3 * d for d in cubic(x, y)])
        mixed = [
            *field.exposures[:2],
            *(replace(e, name="o" + e.name) for e in other.exposures[:2]),
        ]
        result = solve(mixed, image_shape=SHAPE, crpix=CRPIX, weight=RadialWeight("uniform"))
        assert result.rejected == {}
        assert all(f.field is not None for f in result.exposures)
        assert max(f.statistics["scatter_dx"] for f in result.exposures) < 1.3 * NOISE

    def test_turbulence(self, rng):
        """Fields with the spectrum of von Karman, drawn as random plane waves."""
        field = Field(rng, n=3, stars=900)
        atmosphere = [turbulence(rng, 0.1, 2500.0) for _ in range(3)]
        # Where the atmosphere moves a star by +d, its pixel is at +d.
        field.exposures = [
            replace(e, x=e.x + dx, y=e.y + dy)
            for e, (dx, dy) in zip(
                field.exposures, (a(e.x, e.y) for a, e in zip(atmosphere, field.exposures))
            )
        ]
        plain, auto = field.solve(refine="attitude"), field.solve()
        assert all(f.field is None for f in plain.exposures)
        assert all(f.field is not None for f in auto.exposures)
        x, y = np.meshgrid(np.linspace(0, SHAPE[1] - 1, 41), np.linspace(0, SHAPE[0] - 1, 41))

        def errors(result):
            # The sky at a pixel is that of the star that was moved there.
            return np.array([field.errors(result, k) + atmosphere[k](x, y) for k in range(3)])

        sigma = np.array([frame_of(auto, k).uncertainty(x, y)[:2] for k in range(3)])
        assert np.std(errors(auto)) < 0.6 * np.std(errors(plain))
        assert 0.6 < np.sqrt(np.mean((errors(auto) / sigma) ** 2)) < 1.4

    def test_field_on_demand(self, rng):
        result = Field(rng, n=2, stars=200, distortion=cubic).solve(lut="none", refine="field")
        for fit in result.exposures:
            assert fit.field is not None
            assert fit.statistics["field"]["amplitude"] < NOISE


class TestRobustness:
    def test_wrong_pairs(self, solved, rng):
        field = Field(rng, n=5)
        for e in field.exposures:
            e.x[:8] += rng.normal(0, 8, 8)
            e.y[:8] += rng.normal(0, 8, 8)
        result = field.solve(table_choice={"det-1": solved[1].table_info.choice})
        assert field.rms(result) < 0.012
        assert np.mean([f.used[:8].mean() for f in result.exposures]) < 0.15

    @pytest.mark.parametrize("wrong", ["all", "half"])
    def test_exposure_with_wrong_matches_is_named(self, rng, wrong):
        field = Field(rng, n=25, stars=150, distortion=cubic)
        e = field.exposures[5]
        order = np.arange(150)
        order[: 150 if wrong == "all" else 75] = rng.permutation(150 if wrong == "all" else 75)
        field.exposures[5] = replace(e, ra=e.ra[order], dec=e.dec[order])
        result = field.solve(lut="none")
        assert list(result.rejected) == ["e5"]
        assert "wrong pairs" in result.rejected["e5"]
        assert_allclose(result.exposures[5].crval, e.crval)
        assert not result.exposures[5].used.any()
        assert field.rms(result) < 0.012

    def test_alone_with_wrong_matches(self, rng):
        field = Field(rng, n=1, stars=300)
        e = field.exposures[0]
        field.exposures = [replace(e, ra=e.ra[::-1], dec=e.dec[::-1])]
        with pytest.raises(
            FitError, match="exposure e0: its residuals scatter by .* px: wrong pairs"
        ):
            field.solve()

    def test_exposure_of_another_sky(self, rng):
        field = Field(rng, n=3, distortion=cubic)
        field.exposures[1] = replace(field.exposures[1], crval=np.array([250.0, -70.0]))
        result = field.solve(lut="none")
        assert list(result.rejected) == ["e1"]

    @pytest.mark.parametrize("scale", [0.3, 3.0])
    def test_wrong_scale_of_the_errors(self, rng, scale):
        field = Field(rng, n=3, distortion=cubic)
        field.exposures = [
            replace(e, x_err=e.x_err * scale, y_err=e.y_err * scale) for e in field.exposures
        ]
        result = field.solve(lut="none")
        assert_allclose(result.solution.statistics["error_scale"], 1 / scale, rtol=0.1)
        assert_allclose(np.median(result.exposures[0].x_err), NOISE, rtol=0.1)

    def test_unknown_errors(self, rng):
        field = Field(rng, n=3, distortion=cubic)
        field.exposures = [replace(e, x_err=None, y_err=None) for e in field.exposures]
        result = field.solve(lut="none")
        assert_allclose(result.exposures[0].x_err, NOISE, rtol=0.12)
        assert field.rms(result) < 0.015

    def test_each_kind_of_errors_has_its_model(self, rng):
        """Stated errors that are half of what they should be, and exposures without any."""
        field = Field(rng, n=4, distortion=cubic)
        field.exposures = [
            replace(e, x_err=e.x_err / 2, y_err=e.y_err / 2)
            if k < 2
            else replace(e, x_err=None, y_err=None)
            for k, e in enumerate(field.exposures)
        ]
        result = field.solve(lut="none")
        models = result.solution.statistics["error_models"]
        assert_allclose(models["stated"]["scale"], 2.0, rtol=0.15)
        assert_allclose(models["unknown"]["scale"], NOISE, rtol=0.15)
        assert models["stated"]["n"] + models["unknown"]["n"] == sum(
            f.used.sum() for f in result.exposures
        )
        assert result.solution.statistics["error_scale"] == models["stated"]["scale"]
        for k, error in ((0, field.exposures[0].x_err * 2), (3, np.full(400, NOISE))):
            assert_allclose(np.median(result.exposures[k].x_err), np.median(error), rtol=0.15)

    def test_floor(self, rng):
        """Errors that are too optimistic for bright stars."""
        field = Field(rng, n=3, distortion=cubic, stars=1500)
        field.exposures = [
            replace(e, x=e.x + rng.normal(0, 0.1, 1500), y=e.y + rng.normal(0, 0.1, 1500))
            for e in field.exposures
        ]
        result = field.solve(lut="none")
        assert_allclose(result.solution.statistics["error_floor"], 0.1, rtol=0.2)

    def test_some_bad_errors_and_positions(self, rng):
        field = Field(rng, n=2, distortion=cubic)
        e = field.exposures[0]
        e.x_err[:5], e.y_err[5:10], e.x[10:15] = np.nan, 0.0, np.nan
        result = field.solve(lut="none")
        fit = result.exposures[0]
        assert not fit.used[:15].any()
        assert np.isfinite(fit.dx[:10]).all()
        assert np.isnan(fit.dx[10:15]).all()
        assert field.rms(result) < 0.02

    @pytest.mark.parametrize(
        ("change", "match"),
        [
            (
                {"x_err": np.full(400, np.nan)},
                "none of 400 pairs can be used: .* 400 have errors that are NaN",
            ),
            ({"y_err": np.zeros(400)}, "400 have errors"),
            ({"x": np.full(400, np.nan)}, "400 have NaN positions"),
            ({"use": np.zeros(400, bool)}, "400 are held out"),
            ({"x": np.full(400, 5000.0)}, "400 lie off the detector of 2048 x 2000 px"),
        ],
    )
    def test_nothing_usable(self, rng, change, match):
        field = Field(rng, n=1)
        field.exposures = [replace(field.exposures[0], **change)]
        with pytest.raises(FitError, match=match):
            field.solve()

    @pytest.mark.parametrize(
        ("change", "match"),
        [
            ({"cd": np.zeros((2, 2))}, r"exposure e0: .* got .* and \[\[0.0, 0.0\]"),
            ({"crval": np.array([np.nan, 3.0])}, r"exposure e0: .* got \[nan, 3.0\]"),
        ],
    )
    def test_nowhere_to_start(self, rng, change, match):
        field = Field(rng, n=1)
        field.exposures = [replace(field.exposures[0], **change)]
        with pytest.raises(FitError, match=match):
            field.solve()

    @pytest.mark.parametrize("lut", ["auto", "none"])
    @pytest.mark.parametrize("stars", [5, 9, 25])
    def test_few_stars(self, rng, lut, stars):
        """What they do not tell, the priors do not invent, and the uncertainty knows."""
        field = Field(
            rng, n=1, stars=stars, distortion=lambda x, y: (1e-6 * (x - 1000) ** 2, 0 * y)
        )
        result = field.solve(lut=lut)
        frame = frame_of(result, 0)
        x, y = np.meshgrid(np.linspace(0, SHAPE[1] - 1, 41), np.linspace(0, SHAPE[0] - 1, 41))
        sigma = np.array(frame.uncertainty(x, y)[:2])
        error = field.errors(result, 0)
        assert np.mean(np.abs(error) < 3 * sigma) > 0.9
        # The whole distortion is 1 px: 25 stars see a third of it at least.
        assert field.rms(result) < (0.3 if stars == 25 else 10.0)

    def test_no_stars(self, rng):
        with pytest.raises(FitError, match="none of 0 pairs can be used"):
            Field(rng, n=1, stars=0).solve()

    def test_all_stars_in_a_corner(self, rng):
        """It is delivered, and is uncertain by as much as it is wrong elsewhere."""
        field = corner(rng, 400, 300.0)
        result = field.solve()
        x, y = np.meshgrid(np.linspace(0, SHAPE[1] - 1, 41), np.linspace(0, SHAPE[0] - 1, 41))
        sigma = np.array(frame_of(result, 0).uncertainty(x, y)[:2])
        assert np.mean(np.abs(field.errors(result, 0)) < 3 * sigma) > 0.9
        assert sigma.max() > 1.0
        assert frame_of(result, 0).uncertainty(150.0, 150.0)[0] < 0.03

    @pytest.mark.parametrize(("off", "n"), [(0.0, 1), (1.0, 1), (0.3, 3)])
    def test_star_that_holds_a_corner(self, rng, off, n):
        """A star that the model follows is judged by what the others predict for its place."""
        field = Field(rng, n=n, stars=500)
        lone = []
        for k, e in enumerate(field.exposures):
            near = np.hypot(e.x, e.y - SHAPE[0]) < 350
            i = np.flatnonzero(near)[0]
            e.x[i], e.y[i], e.x_err[i], e.y_err[i] = 25.0, 1970.0, 0.015, 0.015
            e.ra[i], e.dec[i] = field.sky(k, e.x[i], e.y[i])
            near[i] = False
            field.exposures[k] = replace(e, use=~near)
            lone.append(i)
        field.exposures[0].y[lone[0]] += off
        result = field.solve()
        used = [fit.used[i] for fit, i in zip(result.exposures, lone)]
        assert used == [off == 0.0] + [True] * (n - 1)
        error = field.errors(result, 0)[:, -1, 0]
        sigma = np.array(frame_of(result, 0).uncertainty(0.0, SHAPE[0] - 1.0)[:2])
        assert np.all(np.abs(error) < 3 * sigma)

    def test_no_stars_within_r0(self, rng):
        """The polynomial is that of the map, not of the stars of full weight."""
        field = Field(rng, n=1, stars=800)
        far = np.hypot(field.exposures[0].x - CRPIX[0], field.exposures[0].y - CRPIX[1]) > 800
        field.exposures = [replace(field.exposures[0], use=far)]
        result = solve(
            field.exposures, image_shape=SHAPE, crpix=CRPIX, weight=RadialWeight(r0=500.0)
        )
        x, y = np.meshgrid(np.linspace(0, SHAPE[1] - 1, 41), np.linspace(0, SHAPE[0] - 1, 41))
        sigma = np.array(frame_of(result, 0).uncertainty(x, y)[:2])
        assert np.mean(np.abs(field.errors(result, 0)) < 3 * sigma) > 0.95
        assert field.rms(result) < 0.06

    def test_bad_options(self, rng):
        field = Field(rng, n=1, stars=50)
        with pytest.raises(ValueError, match="refine must be one of auto, attitude, field, pv"):
            field.solve(refine="all")
        with pytest.raises(ValueError, match="degree must be 'auto' or an integer .*, got 8"):
            field.solve(degree=8)
        with pytest.raises(ValueError, match="lut must be"):
            field.solve(lut="maybe")
        with pytest.raises(FitError, match="no exposure"):
            solve([], image_shape=SHAPE)
        field.exposures = [replace(field.exposures[0], ra=np.zeros(3))]
        with pytest.raises(
            ValueError, match="exposure e0: ra must have as many values as x, has 3, x has 50"
        ):
            field.solve()


@pytest.mark.parametrize(
    ("sensor", "table", "cubic_only"), [("NE", 10.5, 17.5), ("NW", 10.2, 17.5)]
)
def test_wircam_sensor(shared_data, sensor, table, cubic_only):
    """Real pairs of one sensor without errors, without a WCS, 20 % held out; scatter in mas."""
    rows = Table.read(shared_data / "wircam" / "matched_NE_NW.ecsv.gz", format="ascii.ecsv")
    rows = rows[np.asarray(rows["qq"]) == sensor]
    x, y = np.asarray(rows["xmeas"], float) - 1, np.asarray(rows["ymeas"], float) - 1
    ra, dec = np.asarray(rows["ra"], float), np.asarray(rows["dec"], float)
    center = np.array([np.median(ra), np.median(dec)])
    # A straight line through the pairs, robustly, is all the starting WCS there is.
    columns, kept = (
        np.stack([np.ones_like(x), x - 1023.5, y - 1023.5], axis=1),
        np.ones(len(x), bool),
    )
    plane = np.array(project(ra, dec, center)).T
    for _ in range(10):
        linear = np.linalg.lstsq(columns[kept], plane[kept], rcond=None)[0]
        residual = np.hypot(*(plane - columns @ linear).T)
        kept = residual < 5 * np.median(residual)
    start = deproject(*linear[0], center), linear[1:].T

    def scatter(lut, split):
        use = np.random.default_rng(split).uniform(size=len(x)) > 0.2
        exposure = Exposure(sensor, x, y, ra, dec, *start, use=use)
        fit = solve([exposure], image_shape=(2048, 2048), lut=lut).exposures[0]
        scale = 3.6e6 * np.sqrt(abs(np.linalg.det(fit.cd)))
        held = [d[~use] * scale for d in (fit.dx, fit.dy)]
        return [1.4826 * np.median(np.abs(h - np.median(h))) for h in held]

    # The scatter of one split is known to 5 %.
    assert np.mean([scatter("none", split) for split in range(3)], axis=0).max() <= cubic_only
    assert np.mean([scatter("auto", split) for split in range(3)]) <= table


def test_given_choice(solved):
    """The settings found before make the same table, without trying others."""
    field, result = solved
    again = field.solve(table_choice={"det-1": result.table_info.choice})
    assert result.table_info.candidates
    assert again.table_info.candidates == ()
    assert_allclose(field.rms(again), field.rms(result), rtol=0.05)
