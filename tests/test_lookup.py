from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.interpolate import RBFInterpolator

from wpdc_gwcs import ResidualMap, build_lookup_table
from wpdc_gwcs.exceptions import FitError
from wpdc_gwcs.lookup import N_FOLDS, TableChoice, choose_table
from wpdc_gwcs.lookup._smoother import Bins, Smoother, Spectrum, kernel_matrix, polynomials

SHAPE = (1500, 2048)


def waves(x, y):
    return 0.2 * np.sin(x / 200 + y / 400), 0.2 * np.cos(x / 350 - y / 250)


def residuals(rng, n, noise=0.05, function=waves):
    x, y = rng.uniform(-0.5, SHAPE[1] - 0.5, n), rng.uniform(-0.5, SHAPE[0] - 0.5, n)
    error = rng.uniform(0.7, 1.3, n) * noise
    dx, dy = function(x, y)
    return x, y, dx + rng.normal(size=n) * error, dy + rng.normal(size=n) * error, error


def make_map(rng, n=4000, fold=None, **kwargs):
    x, y, dx, dy, error = residuals(rng, n, **kwargs)
    fold = np.arange(n) % N_FOLDS if fold is None else fold
    return ResidualMap.from_residuals(
        x, y, dx, dy, x_err=error, y_err=error, image_shape=SHAPE, fold=fold
    )


def table_error(table, function=waves, n=60):
    x, y = np.meshgrid(np.linspace(0, SHAPE[1] - 1, n), np.linspace(0, SHAPE[0] - 1, n))
    return np.array(table(x, y)) - function(x, y)


class TestResidualMap:
    def test_moments_of_one_bin(self, rng):
        x, y, dx, dy, error = residuals(rng, 50)
        one = ResidualMap.from_residuals(
            x, y, dx, dy, x_err=error, y_err=2 * error, image_shape=SHAPE, shape=(1, 1)
        )
        w = 1 / (2.5 * error**2)
        assert_allclose(one.mean[:, 0, 0], [np.average(d, weights=w) for d in (dx, dy)])
        assert_allclose(one.centroid[:, 0, 0], [np.average(p, weights=w) for p in (x, y)])
        expected = [np.sqrt(np.sum((w * e) ** 2)) / w.sum() for e in (error, 2 * error)]
        assert_allclose(one.sigma[:, 0, 0], expected)
        bins = Bins(one)
        half = 1024.0
        assert_allclose(
            bins.moments[:, 0] * half**2,
            [np.cov(x, y, aweights=w, ddof=0)[i] for i in ((0, 0), (0, 1), (1, 1))],
            rtol=1e-9,
        )

    def test_bins_are_where_the_stars_are(self, rng):
        total = make_map(rng, 20000)
        my, mx = total.shape
        assert (my % 12, mx % 12) == (0, 0)
        cx, cy = total.centroid
        ix, iy = np.meshgrid(np.arange(mx), np.arange(my))
        filled = total.counts > 0
        assert np.all(np.floor((cx + 0.5) * mx / SHAPE[1])[filled] == ix[filled])
        assert np.all(np.floor((cy + 0.5) * my / SHAPE[0])[filled] == iy[filled])
        assert total.n_stars == total.counts.sum() == 20000
        assert np.all(np.isnan(total.mean[0]) == ~filled)

    @settings(deadline=None, max_examples=20)
    @given(st.lists(st.integers(0, 40), min_size=3, max_size=3), st.integers(0, 2**31))
    def test_addition_is_associative_and_equals_pooling(self, sizes, seed):
        rng = np.random.default_rng(seed)
        parts = [residuals(rng, n) for n in sizes]
        a, b, c = (
            ResidualMap.from_residuals(*p[:4], x_err=p[4], y_err=p[4], image_shape=SHAPE, fold=k)
            for k, p in enumerate(parts)
        )
        assert_allclose(((a + b) + c).sums, (a + (b + c)).sums, rtol=1e-12)
        assert (a + b) == (b + a)
        all_ = [np.concatenate(v) for v in zip(*parts)]
        pooled = ResidualMap.from_residuals(
            *all_[:4], x_err=all_[4], y_err=all_[4], image_shape=SHAPE,
            fold=np.repeat([0, 1, 2], sizes),
        )  # fmt: skip
        assert_allclose((a + b + c).sums, pooled.sums, rtol=1e-9, atol=1e-9)

    def test_constant_size(self, rng):
        few, many = make_map(rng, 10), make_map(rng, 10000)
        assert (few + many).sums.shape == few.sums.shape == many.sums.shape

    @pytest.mark.parametrize("factor", [2, 3, 4])
    def test_coarsen(self, rng, factor):
        x, y, dx, dy, error = residuals(rng, 5000)
        fine = ResidualMap.from_residuals(x, y, dx, dy, x_err=error, y_err=error, image_shape=SHAPE)
        shape = tuple(n // factor for n in fine.shape)
        direct = ResidualMap.from_residuals(
            x, y, dx, dy, x_err=error, y_err=error, image_shape=SHAPE, shape=shape
        )
        assert_allclose(fine.coarsen(factor).sums, direct.sums, rtol=1e-7, atol=1e-5)
        with pytest.raises(ValueError, match="factor 5 does not divide"):
            fine.coarsen(5)

    def test_folds(self, rng):
        total = make_map(rng)
        assert total.folds.tolist() == list(range(N_FOLDS))
        parts = total.only(2) + total.without(2)
        assert_allclose(parts.sums, total.sums)
        assert total.only(2).folds.tolist() == [2]

    def test_tree(self, rng):
        total = make_map(rng)
        assert ResidualMap.from_tree(total.to_tree()) == total
        with pytest.raises(ValueError, match="columns of the residual map"):
            ResidualMap.from_tree({**total.to_tree(), "columns": ["n"]})

    def test_unusable_stars_are_left_out(self):
        x = [10.0, np.nan, -5.0, 10.0, 10.0, 10.0, -0.5, 2047.5]
        e = [0.1, 0.1, 0.1, 0.0, np.nan, np.inf, 0.1, 0.1]
        total = ResidualMap.from_residuals(x, 10.0, 0.1, 0.1, x_err=e, y_err=e, image_shape=SHAPE)
        assert total.n_stars == 3
        empty = ResidualMap.from_residuals([], [], [], [], x_err=[], y_err=[], image_shape=SHAPE)
        assert empty.n_stars == 0
        assert empty == ResidualMap(SHAPE)
        assert "0 stars" in repr(empty)

    def test_errors(self):
        with pytest.raises(ValueError, match="must have the same geometry"):
            ResidualMap(SHAPE) + ResidualMap((1500, 2000))
        with pytest.raises(ValueError, match="sums must have shape"):
            ResidualMap(SHAPE, np.zeros((3, 3)))
        with pytest.raises(ValueError, match="two positive sizes"):
            ResidualMap((0, 10))
        with pytest.raises(TypeError):
            ResidualMap(SHAPE) + 1


class TestNumerics:
    """The smoother is scipy's; cross-validation is checked against explicit matrices."""

    @pytest.mark.parametrize(
        ("kernel", "epsilon", "degree"),
        [("thin_plate_spline", 1.0, 3), ("quintic", 1.0, 2), ("gaussian", 3.0, 1)],
    )
    def test_surface_equals_scipy(self, rng, kernel, epsilon, degree):
        bins = Bins(make_map(rng, 600).coarsen(4))
        choice = TableChoice(kernel, degree, 1e-2, epsilon)
        u, v = rng.uniform(-1, 1, (2, 50))
        expected = RBFInterpolator(
            np.stack([bins.u, bins.v], axis=1), bins.value, kernel=kernel, epsilon=epsilon,
            degree=degree, smoothing=1e-2 * bins.variance,
        )(np.stack([u, v], axis=1))  # fmt: skip
        assert_allclose(Smoother(bins, choice)(bins.value)(u, v), expected, atol=1e-7)

    @pytest.mark.parametrize(("kernel", "least"), [("quintic", 2), ("gaussian", 1)])
    def test_without_its_kernel_a_surface_is_a_polynomial(self, rng, kernel, least):
        """What saves time for flat choices is what their kernels would give."""
        bins = Bins(make_map(rng, 600).coarsen(4))
        spectrum = Spectrum(bins, kernel, 1.0, least)
        smoothing = 1e5 * spectrum.eigenvalues.max()
        _, freedom = next(iter(spectrum.scores(bins.value, np.array([smoothing]), [least])))
        flat = TableChoice(kernel, least, smoothing, freedom=float(freedom[0]))
        full = replace(flat, freedom=0.0)
        assert flat.flat
        assert not full.flat
        u, v = rng.uniform(-1, 1, (2, 50))
        expected = Smoother(bins, full)(bins.value)(u, v)
        assert_allclose(
            Smoother(bins, flat)(bins.value)(u, v), expected, atol=1e-3 * np.ptp(expected)
        )

    @pytest.mark.parametrize(
        ("kernel", "epsilon", "least"),
        [
            ("thin_plate_spline", 1.0, 1), ("quintic", 1.0, 2), ("gaussian", 0.5, 1),
            ("gaussian", 6.0, 1),
        ],
    )  # fmt: skip
    def test_generalized_cross_validation(self, rng, kernel, epsilon, least):
        bins = Bins(make_map(rng, 400).coarsen(4))
        m = len(bins)
        spectrum = Spectrum(bins, kernel, epsilon, least)
        relative = np.array([1e-6, 1e-3, 1.0])
        smoothing = relative * spectrum.eigenvalues.max()
        degrees = [least, 4]
        found = spectrum.scores(bins.value, smoothing, degrees)
        for degree, (scores, freedom) in zip(degrees, found):
            basis = polynomials(bins.u, bins.v, degree)
            for s, score, free in zip(smoothing, scores, freedom):
                k = kernel_matrix(kernel, epsilon, bins.u, bins.v, bins.u, bins.v)
                p = basis.shape[1]
                k += s * np.diag(bins.variance)
                system = np.block([[k, basis], [basis.T, np.zeros((p, p))]])
                hat = np.eye(m) - s * bins.variance[:, None] * np.linalg.inv(system)[:m, :m]
                residual = (bins.value - hat @ bins.value) * np.sqrt(bins.weight)[:, None]
                expected = np.sum(residual**2) * m / (2 * (m - np.trace(hat)) ** 2)
                assert_allclose(free, np.trace(hat), rtol=1e-4)
                assert_allclose(score, expected, rtol=1e-4)


class TestBuildLookupTable:
    def test_nodes_and_accuracy(self, rng):
        table, info = build_lookup_table(make_map(rng, 12000), 40)
        assert_allclose(table.x_grid, np.linspace(-0.5, 2047.5, 40))
        assert_allclose(table.y_grid, np.linspace(-0.5, 1499.5, 40))
        error = table_error(table)
        # About 60 free numbers of 12,000 stars would give 0.05 sqrt(60 / 12000) = 0.0035 per axis.
        assert np.sqrt(np.mean(error**2)) < 0.006
        assert info.choice == info.candidates[0]
        assert info.candidates[-1].kernel == "none"
        assert_allclose(info.chi2, 1.0, atol=0.15)

    def test_uncertainty_at_the_nodes(self, rng):
        table, info = build_lookup_table(make_map(rng, 6000), 30)
        assert info.sigma.shape == (3, 30, 30)
        x, y = np.meshgrid(table.x_grid, table.y_grid)
        pulls = []
        columns = np.stack([np.ones_like(x), x, y], axis=-1).reshape(-1, 3)
        for k, truth in enumerate(waves(x, y)):
            error = ([table.dx, table.dy][k] - truth).ravel()
            # The uncertainty is meant without the linear part.
            error = error - columns @ np.linalg.lstsq(columns, error, rcond=None)[0]
            pulls.append(error / info.sigma[k].ravel())
        assert 0.6 < np.sqrt(np.mean(np.square(pulls))) < 1.4

    def test_means_over_bins_are_not_values(self, rng):
        """A strong curvature within the bins must not end in the table."""

        def bowl(x, y):
            u, v = (x - 1000) / 1000, (y - 700) / 1000
            return 40 * u**4, 30 * v**3 * u

        table, _ = build_lookup_table(make_map(rng, 12000, function=bowl), 50)
        # The fourth power alone bends by 60 px per bin's breadth squared: 0.02 px if ignored.
        assert np.sqrt(np.mean(table_error(table, bowl) ** 2)) < 0.006

    def test_no_table_where_there_is_nothing(self, rng):
        nothing = make_map(rng, function=lambda x, y: (0 * x, 0 * y))
        table, info = build_lookup_table(nothing)
        assert table is None
        assert info.choice.kernel == "none"
        assert info.sigma is None
        forced, info = build_lookup_table(nothing, lut="always")
        assert info.choice.kernel != "none"
        assert np.abs(forced.dx).max() < 0.03
        assert build_lookup_table(make_map(rng), lut="none")[0] is None

    def test_given_choice_and_draft(self, rng):
        bins = make_map(rng, 8000)
        choice, candidates = choose_table(bins)
        assert choice == candidates[0]
        again, info = build_lookup_table(bins, 25, choice=choice)
        table, _ = build_lookup_table(bins, 25)
        assert_allclose(again.dx, table.dx, atol=1e-12)
        assert info.candidates == ()
        draft, info = build_lookup_table(bins, 25, draft=True)
        assert info.choice.kernel == "quintic"
        assert_allclose(draft.dx, table.dx, atol=0.05)
        rough = replace(choice, smoothing=choice.smoothing * 1e-3)
        rough, _ = build_lookup_table(bins, 25, choice=rough)
        assert np.std(table_error(rough)) > 1.2 * np.std(table_error(table))

    def test_maps_of_exposures(self, rng):
        maps = [make_map(rng, 1500, fold=0) for _ in range(4)]
        table, info = build_lookup_table(maps, 20)
        assert np.sqrt(np.mean(table_error(table) ** 2)) < 0.02
        # One exposure alone: generalized cross-validation.
        alone, _ = build_lookup_table(make_map(rng, 6000, fold=0), 20)
        assert np.sqrt(np.mean(table_error(alone) ** 2)) < 0.02

    def test_linear_table(self, rng):
        table, _ = build_lookup_table(make_map(rng), 20, method="linear")
        assert table.method == "linear"

    def test_all_stars_in_a_few_bins(self, rng):
        """They are enough, but say nothing of the rest of the detector."""
        x, y = rng.uniform(0, 200, (2, 400))
        corner = ResidualMap.from_residuals(
            x, y, *rng.normal(0, 0.05, (2, 400)), x_err=0.05, y_err=0.05, image_shape=(2048, 2048)
        )
        for draft in (False, True):
            table, info = build_lookup_table(corner, draft=draft)
            assert table is None
            assert info.choice.kernel == "none"

    def test_errors(self, rng):
        few = make_map(rng, 30)
        assert build_lookup_table(few)[0] is None
        with pytest.raises(FitError, match="30 stars in .* cannot determine a look-up table; 60"):
            build_lookup_table(few, lut="always")
        with pytest.raises(FitError, match="no residual map"):
            build_lookup_table([])
        with pytest.raises(ValueError, match="n_grid must be between 4 and 1000, got 3"):
            build_lookup_table(few, 3)
        with pytest.raises(ValueError, match="lut must be"):
            build_lookup_table(few, lut="yes")
