"""Fields of exposures against dense Gaussian processes and the spectrum of von Karman."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.special import gamma, kv
from scipy.stats import multivariate_normal

from wpdc_gwcs.solve.basis import patch
from wpdc_gwcs.solve.field import fit_field
from wpdc_gwcs.solve.spectrum import Spectrum, learn_spectra, products

LOW, HIGH = np.array([-1000.0, -600.0]), np.array([1000.0, 900.0])
KINDS = ("curl-free", "axes")


def design_of(basis, focal, kind="curl-free"):
    """Displacements of unit coefficients, a column for each: ``(2, N, K)``."""
    return np.moveaxis(basis.shapes(focal, kind), 0, -1)


def places(rng, n, low=LOW, high=HIGH):
    return low[:, None] + (high - low)[:, None] * rng.uniform(size=(2, n))


def dense(basis, spectrum, here, there=None):
    """Covariance ``(2 N, 2 M)`` of the field between places, by the waves one by one."""
    rows = [
        design_of(basis, f, spectrum.kind).reshape(2 * f.shape[1], -1)
        for f in (here, here if there is None else there)
    ]
    return sum(p * np.outer(a, b) for p, a, b in zip(spectrum.prior(basis), rows[0].T, rows[1].T))


def von_karman(distance, scale):
    """Correlation of a field with a spectrum (k^2 + k0^2)^(-11/6): Matern with nu = 5 / 6."""
    z = 2 * np.pi * np.asarray(distance) / scale
    return 2 ** (1 / 6) / gamma(5 / 6) * z ** (5 / 6) * kv(5 / 6, z)


class TestBasis:
    def test_patch(self):
        basis = patch(LOW, HIGH, 50)
        assert_allclose(basis.center, [0, 150])
        assert_allclose(basis.half, [1200, 900])
        number = np.hypot(*basis.wave)
        assert np.all(np.diff(number) >= -1e-15)
        # The longest ones, all of them.
        j, k = np.meshgrid(np.arange(1, 60), np.arange(1, 60))
        every = np.sort(np.hypot(0.5 * np.pi * j / 1200, 0.5 * np.pi * k / 900).ravel())
        assert_allclose(number, every[:50])

    @pytest.mark.parametrize("n", [12, 200])
    def test_of_a_narrow_detector(self, n):
        basis = patch([0, 0], [4000, 200], n)
        assert basis.orders.shape == (2, n)
        assert len(set(map(tuple, basis.orders.T))) == n

    def test_no_curl(self, rng):
        basis, step = patch(LOW, HIGH, 30), 1e-3
        focal = places(rng, 20)
        right, up = focal + [[step], [0]], focal + [[0], [step]]
        design = [design_of(basis, f)[:, :, :-2] for f in (focal, right, up)]
        curl = (design[1][1] - design[0][1]) - (design[2][0] - design[0][0])
        slope = np.abs(design[1] - design[0]).max()
        assert_allclose(curl / slope, 0, atol=1e-5)

    def test_gradient_of_waves(self, rng):
        """The displacement is the gradient of the waves that 'axes' has along each axis."""
        basis, step = patch(LOW, HIGH, 30), 1e-3
        focal = places(rng, 20)
        wave = [design_of(basis, focal + s, "axes")[0, :, :30] for s in
                ([[step], [0]], [[-step], [0]], [[0], [step]], [[0], [-step]])]  # fmt: skip
        design = design_of(basis, focal)
        assert_allclose((wave[0] - wave[1]) / (2 * step), design[0, :, :30], atol=1e-11)
        assert_allclose((wave[2] - wave[3]) / (2 * step), design[1, :, :30], atol=1e-11)

    @pytest.mark.parametrize("kind", KINDS)
    def test_constants_are_last(self, rng, kind):
        design = design_of(patch(LOW, HIGH, 5), places(rng, 3), kind)
        assert_allclose(design[:, :, -2:], np.broadcast_to(np.eye(2)[:, None], (2, 3, 2)))


class TestSpectrum:
    @pytest.mark.parametrize("kind", KINDS)
    @pytest.mark.parametrize("scale", [300.0, 1500.0])
    def test_variance_is_that_of_the_amplitude(self, rng, kind, scale):
        """Waves, constants and what is too short for them add up to amplitude^2 along an axis."""
        spectrum = Spectrum(0.07, scale, kind=kind)
        basis = patch(LOW, HIGH, 400)
        # Waves vanish at the rim, and with them a little of the variance near it.
        inner = places(rng, 200, 0.7 * LOW, 0.7 * HIGH)
        variance = np.mean(design_of(basis, inner, kind) ** 2, axis=1) @ spectrum.prior(basis)
        total = variance + spectrum.unresolved(basis)
        # The rim is a quarter of the longer outer scale away.
        assert_allclose(total.mean(), 0.07**2, rtol=0.1 if scale == 300 else 0.2)
        assert_allclose(total, 0.07**2, rtol=0.2 if scale == 300 else 0.3)

    @pytest.mark.parametrize("kind", KINDS)
    def test_correlation_is_that_of_von_karman(self, rng, kind):
        spectrum = Spectrum(1.0, 800.0, kind=kind)
        basis = patch(4 * LOW, 4 * HIGH, 4000)
        here = places(rng, 100)
        for distance in (100.0, 300.0, 700.0):
            angle = rng.uniform(0, 2 * np.pi, 100)
            there = here + distance * np.array([np.cos(angle), np.sin(angle)])
            rows = design_of(basis, here, kind), design_of(basis, there, kind)
            both = np.einsum("anm,m,anm->n", rows[0], spectrum.prior(basis), rows[1]).mean() / 2
            # A hundred pairs of places; the patch is six outer scales wide.
            assert_allclose(both, von_karman(distance, 800.0), atol=0.03)

    def test_stretch_turns_with_its_angle(self):
        basis = patch([-500, -500], [500, 500], 60)
        along = Spectrum(1.0, 400.0, 2.0, 0.0).prior(basis)[:-2]
        across = Spectrum(1.0, 400.0, 2.0, 0.5 * np.pi).prior(basis)[:-2]
        swapped = [list(map(tuple, basis.orders.T)).index((k, j)) for j, k in basis.orders.T]
        assert_allclose(along[swapped], across)
        inverse = Spectrum(1.0, 400.0, 0.5, 0.5 * np.pi).prior(basis)[:-2]
        assert_allclose(inverse, along)
        assert not np.allclose(along, across)


class TestEvidence:
    @pytest.mark.parametrize("kind", KINDS)
    def test_is_the_ratio_of_dense_likelihoods(self, rng, kind):
        basis, spectrum = patch(LOW, HIGH, 15), Spectrum(0.05, 900.0, 1.5, 0.3, kind)
        focal = places(rng, 25)
        variance = rng.uniform(0.02, 0.05, (2, 25)) ** 2
        residual = rng.normal(0, 0.05, (2, 25))
        noise = np.diag(variance.ravel())
        expected = multivariate_normal(cov=noise + dense(basis, spectrum, focal)).logpdf(
            residual.ravel()
        ) - multivariate_normal(cov=noise).logpdf(residual.ravel())
        found = products(basis, focal, residual, 1 / variance).log_evidence(spectrum)
        assert_allclose(found, expected, rtol=1e-8)

    @pytest.mark.parametrize("kind", KINDS)
    @pytest.mark.parametrize("turned", [False, True])
    def test_with_free_terms(self, rng, kind, turned):
        """They are in both hypotheses, with a prior as wide as one likes, also along both axes."""
        basis, spectrum = patch(LOW, HIGH, 15), Spectrum(0.05, 900.0, kind=kind)
        focal = places(rng, 25)
        variance = rng.uniform(0.02, 0.05, (2, 25)) ** 2
        residual = rng.normal(0, 0.05, (2, 25))
        free = np.zeros((2, 25, 4))
        free[0, :, 0] = free[1, :, 1] = 1.0
        free[0, :, 2], free[1, :, 3] = focal / 1000
        if turned:
            free[1, :, 2] = -focal[1] / 1000
        flat = free.reshape(50, 4)
        noise = np.diag(variance.ravel()) + 1e4 * flat @ flat.T
        expected = multivariate_normal(cov=noise + dense(basis, spectrum, focal)).logpdf(
            residual.ravel()
        ) - multivariate_normal(cov=noise).logpdf(residual.ravel())
        found = products(basis, focal, residual, 1 / variance, nuisance=free)
        assert_allclose(found.log_evidence(spectrum), expected, atol=1e-4)
        # What is free does not matter.
        moved = residual + free @ [0.3, -0.1, 0.2, 0.7]
        again = products(basis, focal, moved, 1 / variance, nuisance=free)
        assert_allclose(again.log_evidence(spectrum), found.log_evidence(spectrum), atol=1e-8)

    def test_nothing_without_amplitude(self, rng):
        focal = places(rng, 30)
        found = products(patch(LOW, HIGH, 12), focal, rng.normal(size=(2, 30)), np.ones((2, 30)))
        assert_allclose(found.log_evidence(Spectrum(1e-9, 500.0)), 0, atol=1e-12)


class TestFitField:
    @pytest.fixture
    def fitted(self, rng):
        basis, spectrum = patch(LOW, HIGH, 40), Spectrum(0.08, 700.0, 1.3, 1.0)
        focal = places(rng, 60)
        variance = rng.uniform(0.02, 0.06, (2, 60)) ** 2
        residual = rng.normal(0, 0.08, (2, 60))
        field = fit_field(basis, spectrum, focal, residual, variance)
        noise = np.diag(variance.ravel() + spectrum.unresolved(basis))
        total = noise + dense(basis, spectrum, focal)
        return field, focal, variance, residual, total

    def test_mean_is_that_of_a_gaussian_process(self, rng, fitted):
        field, focal, _, residual, total = fitted
        there = places(rng, 15)
        cross = dense(field.basis, field.spectrum, there, focal)
        expected = cross @ np.linalg.solve(total, residual.ravel())
        assert_allclose(field(there).ravel(), expected, atol=1e-10)

    def test_covariance_and_what_it_follows(self, rng, fitted):
        """To single precision, in which the factor of the precision is kept."""
        field, focal, variance, _, total = fitted
        there = places(rng, 15)
        rows, star_rows = rng.normal(size=(2, 15, 3)), rng.normal(size=(2, 60, 3))
        less, covariance = field.conditioned(there, rows, focal, star_rows, 1 / variance)
        cross = dense(field.basis, field.spectrum, there, focal)
        followed = cross @ np.linalg.solve(total, star_rows.reshape(120, 3))
        assert_allclose(less.reshape(30, 3), rows.reshape(30, 3) - followed, atol=2e-5)
        posterior = dense(field.basis, field.spectrum, there)
        posterior -= cross @ np.linalg.solve(total, cross.T)
        posterior += field.spectrum.unresolved(field.basis) * np.eye(30)
        expected = posterior.reshape(2, 15, 2, 15)
        for a in range(2):
            for b in range(2):
                assert_allclose(covariance[a, b], np.diagonal(expected[a, :, b]), atol=1e-7)

    def test_far_from_stars_it_is_the_prior(self):
        basis, spectrum = patch(LOW, HIGH, 200), Spectrum(0.08, 400.0)
        star, far = np.array([[-500.0], [-200.0]]), np.array([[600.0], [600.0]])
        field = fit_field(basis, spectrum, star, np.ones((2, 1)), np.full((2, 1), 1e-4))
        assert_allclose(field(far), 0, atol=0.02)
        assert np.all(field(star) > 0.5)


def simulated(rng, spectrum, basis, *, n=250, noise=0.02):
    """Products of one frame whose field is drawn from a spectrum."""
    focal = places(rng, n)
    prior = spectrum.prior(basis)
    coefficients = np.sqrt(prior) * rng.normal(size=len(prior))
    residual = design_of(basis, focal, spectrum.kind) @ coefficients + rng.normal(0, noise, (2, n))
    return focal, residual, np.full((2, n), noise**-2)


class TestLearnSpectra:
    SCALES = (200.0, 8000.0)

    @pytest.mark.parametrize("kind", KINDS)
    def test_amplitude_scale_and_kind(self, rng, kind):
        truth = Spectrum(0.06, 800.0, kind=kind)
        fine, basis = patch(LOW, HIGH, 150), patch(LOW, HIGH, 80)
        data = {e: simulated(rng, truth, fine) for e in range(6)}

        def make(frame, kinds):
            return products(basis, *data[frame], kinds=kinds)

        found = learn_spectra({e: [e] for e in data}, make, start=0.02, scales=self.SCALES)
        assert {s.kind for s in found.values()} == {kind}
        # The field of a patch of three outer scales tells its amplitude to a third.
        assert_allclose([s.amplitude for s in found.values()], 0.06, rtol=0.4)
        scales = [s.scale for s in found.values()]
        assert_allclose(np.exp(np.mean(np.log(scales))), 800.0, rtol=0.4)

    @pytest.mark.parametrize("bend", [0.0, 0.1])
    def test_polynomials_beside_the_waves(self, rng, bend):
        """A saddle of random size along each axis, beside turbulence that is no gradient of it."""
        truth, fine = Spectrum(0.03, 500.0), patch(LOW, HIGH, 150)
        basis = patch(LOW, HIGH, 80, bends=True)
        data = {}
        for e in range(6):
            focal, residual, weight = simulated(rng, truth, fine)
            u, v = (focal - 0.5 * (LOW + HIGH)[:, None]) / (0.5 * (HIGH - LOW)[:, None])
            a, b = bend * rng.normal(size=2)
            data[e] = focal, residual + [a * u * v, b * (u**2 - v**2)], weight

        def make(frame, kinds):
            return products(basis, *data[frame], kinds=kinds)

        found = learn_spectra({e: [e] for e in data}, make, start=0.02, scales=self.SCALES)
        bends = np.array([s.bend for s in found.values()])
        if not bend:
            assert not bends.any()
            return
        assert np.sum(bends > 0.02) >= 4
        focal, residual, weight = data[0]
        at = places(rng, 400)
        u, v = (at - 0.5 * (LOW + HIGH)[:, None]) / (0.5 * (HIGH - LOW)[:, None])
        straight = Spectrum(0.05, 800.0)
        fields = [
            fit_field(basis, s, focal, residual, 1 / weight)(at) for s in (found[0], straight)
        ]
        rows = np.stack([np.ones_like(u), u, v, u * v, u**2, v**2], axis=1)
        # What of it is bent as the residuals are.
        bent = [np.linalg.lstsq(rows, f.T, rcond=None)[0][3:] for f in fields]
        u, v = (focal - 0.5 * (LOW + HIGH)[:, None]) / (0.5 * (HIGH - LOW)[:, None])
        rows = np.stack([np.ones_like(u), u, v, u * v, u**2, v**2], axis=1)
        wanted = np.linalg.lstsq(rows, residual.T, rcond=None)[0][3:]
        assert np.linalg.norm(bent[0] - wanted) < 0.8 * np.linalg.norm(bent[1] - wanted)

    def test_noise_is_no_field(self, rng):
        basis, nothing = patch(LOW, HIGH, 40), Spectrum(1e-12, 800.0)
        data = {e: simulated(rng, nothing, basis) for e in range(3)}

        def make(frame, kinds):
            return products(basis, *data[frame], kinds=kinds)

        frames = {e: [e] for e in data}
        options = {"start": 0.02, "scales": self.SCALES}
        assert learn_spectra(frames, make, **options) == {0: None, 1: None, 2: None}
        forced = learn_spectra(frames, make, force=True, **options)
        assert max(s.amplitude for s in forced.values()) < 0.01
        assert learn_spectra({}, make, **options) == {}

    @pytest.mark.parametrize(("share", "is_theirs"), [(0.0, False), (0.3, False), (3.0, True)])
    def test_what_all_have_in_common_is_the_detectors(self, rng, share, is_theirs):
        """Fields of the exposures beside one that is the same in all, so many times as large."""
        truth, basis = Spectrum(0.03, 800.0), patch(LOW, HIGH, 60)
        size = len(truth.prior(basis))
        common, *own = np.sqrt(truth.prior(basis)) * rng.normal(size=(5, size))
        data = {}
        for e in range(4):
            focal = places(rng, 250)
            field = design_of(basis, focal) @ (common + share * own[e])
            noise = rng.normal(0, 0.02, field.shape)
            data[e] = focal, field + noise, np.full(field.shape, 0.02**-2)

        def make(frame, kinds):
            return products(basis, *data[frame], kinds=kinds)

        found = learn_spectra({e: [e] for e in data}, make, start=0.02, scales=self.SCALES)
        assert all((s is not None) == is_theirs for s in found.values())

    def test_a_stretched_field(self, rng):
        truth = Spectrum(0.08, 600.0, 2.0, 0.6)
        basis = patch(LOW, HIGH, 100)
        data = {e: simulated(rng, truth, basis, n=400) for e in range(4)}

        def make(frame, kinds):
            return products(basis, *data[frame], kinds=kinds)

        found = learn_spectra({0: [0, 1, 2, 3]}, make, start=0.03, scales=self.SCALES)[0]
        turned = replace(found, angle=found.angle % np.pi)
        assert 1.4 < turned.stretch < 2.8
        assert_allclose(turned.angle, 0.6, atol=0.3)
