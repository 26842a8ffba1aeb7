import numpy as np
import pytest
from astropy.modeling.fitting import Fitter, ModelLinearityError
from astropy.modeling.models import AffineTransformation2D, Mapping, Polynomial2D
from numpy.testing import assert_allclose

from wpdc_gwcs import PVPolynomial, RadialWeight, WPDCFitter
from wpdc_gwcs.exceptions import FitError
from wpdc_gwcs.fitting import fit_attitude, solve_linear
from wpdc_gwcs.models import deproject

SCALE = 2e-5  # deg / px
R0 = 4000.0


def field(rng, n=2000):
    return rng.uniform(-4600 * SCALE, 4600 * SCALE, (2, n))


def distorted(rng, degree=3):
    """Polynomial with a few hundred px of distortion at the corners."""
    model = PVPolynomial(degree)
    coefficients = np.array(model.coefficients)
    power = np.array([0, 1, 1] + [d for d in range(2, degree + 1) for _ in range(d + 1)])
    coefficients += rng.normal(size=coefficients.shape) * 30 * SCALE / (4600 * SCALE) ** power
    return PVPolynomial.from_coefficients(coefficients, degree)


class TestRadialWeight:
    @pytest.mark.parametrize(
        ("name", "expected"),
        [
            ("exp-sqrt", np.exp(-10.0)),
            ("gaussian", np.exp(-((100 / 4000) ** 2))),
            ("inverse", 4000 / 4100),
            ("inverse-square", (4000 / 4100) ** 2),
            ("uniform", 1.0),
        ],
    )
    def test_closed_form(self, name, expected):
        weight = RadialWeight(name, r0=R0)
        assert_allclose(weight([0.0, 3999.0, 4000.0, 4100.0]), [1, 1, 1, expected], rtol=1e-14)

    def test_scalar_and_shape(self):
        assert RadialWeight()(np.zeros((2, 3))).shape == (2, 3)
        assert float(RadialWeight()(0.0)) == 1.0

    def test_default_radius(self):
        assert RadialWeight.for_shape((9232, 9216)).r0 == pytest.approx(0.87 * 4608)

    def test_errors(self):
        with pytest.raises(ValueError, match="exp-sqrt.*got 'gauss'"):
            RadialWeight("gauss")
        for r0 in (-5, 0, np.nan, np.inf):
            with pytest.raises(ValueError, match="r0 must be a positive number"):
                RadialWeight("inverse", r0=r0)


class TestSolveLinear:
    def test_against_lstsq(self, rng):
        a, b, w = rng.normal(size=(50, 4)), rng.normal(size=50), rng.uniform(0.1, 1, 50)
        expected = np.linalg.lstsq(a * np.sqrt(w)[:, None], b * np.sqrt(w), rcond=None)[0]
        result = solve_linear(a, b, w, leverage=True)
        assert_allclose(result.parameters, expected, rtol=1e-12)
        normal = np.linalg.inv(a.T @ (a * w[:, None]))
        assert_allclose(result.root @ result.root.T, normal, rtol=1e-10)
        assert_allclose(result.leverage, w * np.einsum("ij,jk,ik->i", a, normal, a), rtol=1e-10)

    def test_too_few_and_degenerate(self, rng):
        with pytest.raises(FitError, match="3 stars of non-zero weight cannot determine 4"):
            solve_linear(rng.normal(size=(3, 4)), np.zeros(3))
        a = rng.normal(size=(20, 3))
        a[:, 2] = a[:, 0] + a[:, 1]
        with pytest.raises(FitError, match="only 2 of 3"):
            solve_linear(a, np.zeros(20))


class TestWPDCFitter:
    def test_is_registered_with_astropy(self):
        import astropy.modeling.fitting as fitting

        assert issubclass(WPDCFitter, Fitter)
        assert fitting.WPDCFitter is WPDCFitter

    @pytest.mark.parametrize("degree", [1, 2, 3, 5, 7])
    def test_exact_recovery(self, rng, degree):
        truth = distorted(rng, degree)
        xi, eta = field(rng)
        fitter = WPDCFitter(weight=RadialWeight("inverse", r0=R0), pixel_scale=SCALE)
        model = PVPolynomial(degree)
        before = model.parameters.copy()
        fitted = fitter(model, xi, eta, *truth(xi, eta))
        assert fitted is not model
        assert_allclose(model.parameters, before)
        # Noise-free: rounding times the condition number of the scaled columns.
        assert_allclose(
            np.array(fitted(xi, eta)) / SCALE, np.array(truth(xi, eta)) / SCALE, atol=1e-8, rtol=0
        )
        assert fitter.fit_info["rank"] == 2 * len(truth.term_indices)
        assert fitter.fit_info["n_used"] == 2000

    def test_weighted_least_squares(self, rng):
        """Against lstsq of the same weighted objective, in normalized coordinates."""
        xi, eta = field(rng)
        ref = np.array([xi, eta]) + rng.normal(size=(2, 2000)) * SCALE
        ref[0] += 1e3 * eta**4
        sigma = rng.uniform(0.5, 2.0, 2000) * SCALE
        weight = RadialWeight("inverse-square", r0=2000.0)
        fitted = WPDCFitter(weight=weight, pixel_scale=SCALE)(
            PVPolynomial(), xi, eta, *ref, weights=1 / sigma
        )
        u, v = xi / 0.1, eta / 0.1
        columns = np.stack([u**i * v**j for i in range(4) for j in range(4 - i)], axis=1)
        w = np.sqrt(weight(np.hypot(xi, eta) / SCALE)) / sigma
        for axis in range(2):
            solution = np.linalg.lstsq(columns * w[:, None], ref[axis] * w, rcond=None)[0]
            assert_allclose(fitted(xi, eta)[axis] / SCALE, columns @ solution / SCALE, atol=1e-7)

    def test_distance_given_with_the_data(self, rng):
        xi, eta = field(rng)
        ref = xi + 1e3 * eta**4, eta
        weight = RadialWeight("exp-sqrt", r0=R0)
        by_scale = WPDCFitter(weight=weight, pixel_scale=SCALE)(PVPolynomial(), xi, eta, *ref)
        cd = SCALE * np.array([[0.0, 1.0], [-1.0, 0.0]])
        by_cd = WPDCFitter(weight=weight, pixel_scale=cd)(PVPolynomial(), xi, eta, *ref)
        fitter = WPDCFitter(weight=weight)
        by_distance = fitter(PVPolynomial(), xi, eta, *ref, distance=np.hypot(xi, eta) / SCALE)
        assert_allclose(by_distance.parameters, by_scale.parameters, rtol=1e-9, atol=1e-12)
        assert_allclose(by_cd.parameters, by_scale.parameters, rtol=1e-9, atol=1e-12)
        with pytest.raises(ValueError, match="needs pixel_scale"):
            fitter(PVPolynomial(), xi, eta, *ref)
        with pytest.raises(ValueError, match="distance must have one value per star"):
            fitter(PVPolynomial(), xi, eta, *ref, distance=[1.0, 2.0])

    def test_fixed_parameters(self, rng):
        truth = distorted(rng)
        xi, eta = field(rng)
        model = PVPolynomial(pv1_7=0.5)
        model.pv1_7.fixed = True
        fitter = WPDCFitter(calc_uncertainties=True)
        fitted = fitter(model, xi, eta, *truth(xi, eta))
        assert fitted.pv1_7.value == 0.5
        assert fitter.fit_info["covariance"].shape == (19, 19)
        assert "pv1_7" not in fitter.fit_info["param_names"]
        free = [n for n in truth.param_names if n.startswith("pv2")]
        assert_allclose(
            [getattr(fitted, n).value for n in free],
            [getattr(truth, n).value for n in free],
            rtol=1e-8,
        )
        assert len(fitted.stds.stds) == 19
        for name in model.param_names:
            model.fixed[name] = True
        with pytest.raises(FitError, match="all 20 parameters are fixed"):
            WPDCFitter()(model, xi, eta, xi, eta)

    def test_other_linear_models(self, rng):
        x, y = rng.uniform(-1, 1, (2, 300))
        affine = AffineTransformation2D(matrix=[[1.1, 0.2], [-0.1, 0.9]], translation=[3, 4])
        fitted = WPDCFitter()(AffineTransformation2D(), x, y, *affine(x, y))
        assert_allclose(fitted.matrix.value, affine.matrix.value, atol=1e-12)
        assert_allclose(fitted.translation.value, [3, 4], atol=1e-12)
        pair = Mapping((0, 1, 0, 1)) | Polynomial2D(2) & Polynomial2D(2)
        truth = pair.copy()
        truth.parameters = rng.normal(size=12)
        assert_allclose(
            WPDCFitter()(pair, x, y, *truth(x, y)).parameters, truth.parameters, atol=1e-12
        )

    def test_refuses_other_models(self, rng):
        x, y = rng.uniform(-1, 1, (2, 30))
        with pytest.raises(ValueError, match="2 inputs and 2 outputs, got 2 and 1"):
            WPDCFitter()(Polynomial2D(2), x, y, x, y)
        from astropy.modeling.models import Sine1D

        with pytest.raises(ModelLinearityError, match="not linear"):
            WPDCFitter()(Sine1D() & Sine1D(), x, y, x, y)
        tied = PVPolynomial()
        tied.pv1_1.tied = lambda model: model.pv2_1
        with pytest.raises(ValueError, match="tied"):
            WPDCFitter()(tied, x, y, x, y)

    @pytest.mark.parametrize("robust", ["clip", "huber"])
    def test_outliers(self, rng, robust):
        truth = distorted(rng)
        xi, eta = field(rng)
        ref = np.array(truth(xi, eta)) + rng.normal(size=(2, 2000)) * 0.05 * SCALE
        ref[:, :40] += rng.uniform(2, 30, (2, 40)) * SCALE
        fitter = WPDCFitter(robust=robust, max_iterations=30)
        fitted = fitter(PVPolynomial(), xi, eta, *ref)
        error = (np.array(fitted(xi, eta)) - truth(xi, eta)) / SCALE
        assert np.sqrt(np.mean(error**2)) < (0.006 if robust == "clip" else 0.012)
        assert fitter.fit_info["converged"]
        if robust == "clip":
            assert not np.any(fitter.fit_info["used"][:40])

    def test_covariance_is_honest(self, rng):
        """Scatter of the coefficients over repeated noise, with the masking weight of the paper."""
        truth = distorted(rng)
        xi, eta = field(rng, 600)
        fitter = WPDCFitter(weight=RadialWeight("inverse-square", r0=1500.0), pixel_scale=SCALE)
        sigma = rng.uniform(0.02, 0.1, 600) * SCALE
        found, predicted = [], []
        for _ in range(150):
            ref = np.array(truth(xi, eta)) + rng.normal(size=(2, 600)) * sigma
            found.append(fitter(PVPolynomial(), xi, eta, *ref, weights=1 / sigma).parameters)
            predicted.append(np.diag(fitter.fit_info["covariance"]))
        ratio = np.std(found, axis=0) / np.sqrt(np.mean(predicted, axis=0))
        # 150 trials: 6 % per coefficient, twenty of them.
        assert 0.95 < np.mean(ratio) < 1.05

    def test_damping_ends_at_the_optimum(self, rng):
        truth = distorted(rng)
        xi, eta = field(rng)
        ref = np.array(truth(xi, eta)) + rng.normal(size=(2, 2000)) * 0.05 * SCALE
        calls = []

        def rematch(model):
            calls.append(model.parameters.copy())
            near = np.hypot(*(np.array(model(xi, eta)) - ref)) < 150 * SCALE
            return xi[near], eta[near], *ref[:, near]

        first = np.hypot(*(np.array([xi, eta]) - ref)) < 40 * SCALE
        fitter = WPDCFitter(rematch=rematch)
        fitted = fitter(PVPolynomial(), xi[first], eta[first], *ref[:, first])
        optimum = WPDCFitter()(PVPolynomial(), xi, eta, *ref)
        difference = (np.array(fitted(xi, eta)) - optimum(xi, eta)) / SCALE
        assert np.abs(difference).max() < 1e-6
        assert fitter.fit_info["converged"]
        assert fitter.fit_info["iterations"] == len(calls)

    @pytest.mark.parametrize(
        ("change", "match"),
        [
            (lambda d: d["xi"].__setitem__(3, np.nan), "1 of 200 stars have positions or weights"),
            (lambda d: d["weights"].__setitem__(slice(2), np.inf), "2 of 200"),
            (
                lambda d: d["weights"].__setitem__(slice(None), 0.0),
                "weights of all 200 stars are zero",
            ),
            (lambda d: d["weights"].__setitem__(0, -1.0), "1 of 200 weights are negative"),
            (lambda d: d["weights"].__setitem__(slice(5, None), 0.0), "5 stars of non-zero weight"),
        ],
    )
    def test_bad_data(self, rng, change, match):
        xi, eta = field(rng, 200)
        data = {
            "xi": xi,
            "eta": eta,
            "xi_ref": xi.copy(),
            "eta_ref": eta.copy(),
            "weights": np.ones(200),
        }
        change(data)
        with pytest.raises(FitError, match=match):
            WPDCFitter()(PVPolynomial(), **data)

    def test_few_stars_and_lines(self, rng):
        xi, eta = field(rng, 9)
        with pytest.raises(FitError, match="9 stars of non-zero weight cannot determine 10"):
            WPDCFitter()(PVPolynomial(), xi, eta, xi, eta)
        with pytest.raises(FitError, match="0 stars"):
            WPDCFitter()(PVPolynomial(), [], [], [], [])
        line = np.linspace(0, 0.1, 100)
        with pytest.raises(FitError, match="of 10 coefficients"):
            WPDCFitter()(PVPolynomial(), line, line, line, line)
        with pytest.raises(ValueError, match="must have one length"):
            WPDCFitter()(PVPolynomial(), line, line, line, line[:5])

    @pytest.mark.parametrize(
        ("options", "error", "match"),
        [
            ({"weight": 3}, TypeError, "weight must be a RadialWeight"),
            ({"robust": "yes"}, ValueError, "robust must be"),
            ({"clip": 0}, ValueError, "clip must be positive"),
            ({"damping": 0}, ValueError, "damping must be above 0"),
            ({"rematch": 1}, TypeError, "rematch must be callable"),
            ({"max_iterations": 0}, ValueError, "max_iterations"),
            ({"pixel_scale": 0.0}, ValueError, "pixel_scale must be"),
        ],
    )
    def test_bad_options(self, options, error, match):
        with pytest.raises(error, match=match):
            WPDCFitter(**options)


class TestFitAttitude:
    cd = SCALE * np.array([[-1.0, 0.02], [0.01, 1.0]])

    def stars(self, rng, crval, n=300, cd=None):
        x, y = rng.uniform(0, 9215, (2, n))
        cd = self.cd if cd is None else cd
        return x, y, *deproject(*(cd @ (x - 4608, y - 4608)), crval)

    @pytest.mark.parametrize(
        "crval", [(120.0, 30.0), (0.01, -60.0), (10.0, 89.97), (200.0, -89.999)]
    )
    def test_exact_recovery(self, rng, crval):
        x, y, ra, dec = self.stars(rng, crval)
        start = (crval[0], crval[1] - 0.02)
        fit = fit_attitude(x, y, ra, dec, crpix=(4608, 4608), crval=start, cd=1.005 * self.cd)
        back = np.array(deproject(*(fit.cd @ (x - 4608, y - 4608)), fit.crval))
        cosine = np.cos(np.radians(dec))
        assert np.abs((back[0] - ra + 180) % 360 - 180).max() * cosine.max() < 1e-10
        assert_allclose(back[1], dec, atol=1e-10, rtol=0)
        assert np.abs([fit.dx, fit.dy]).max() < 1e-5

    def test_outliers_and_unused(self, rng):
        x, y, ra, dec = self.stars(rng, (120.0, 30.0))
        x = x + rng.normal(0, 0.05, 300)
        y = y + rng.normal(0, 0.05, 300)
        x[:10] += rng.uniform(3, 20, 10)
        use = np.arange(300) < 250
        error = np.full(300, 0.05)
        fit = fit_attitude(
            x,
            y,
            ra,
            dec,
            crpix=(4608, 4608),
            crval=(120, 30),
            cd=self.cd,
            x_err=error,
            y_err=error,
            used=use,
        )
        assert not np.any(fit.used[:10])
        assert not np.any(fit.used[250:])
        assert fit.used.sum() > 230
        assert np.isfinite(fit.dx).all()
        assert_allclose(fit.scale, 1.0, atol=0.2)

    def test_covariance(self, rng):
        at = np.array([[1.0, 3000.0, -2000.0]])
        offsets, predicted = [], []
        x, y, ra, dec = self.stars(rng, (120.0, 30.0), 60)
        error = rng.uniform(0.02, 0.1, 60)
        z = at[0, 1:]
        true = deproject(*(self.cd @ z), (120.0, 30.0))
        from wpdc_gwcs.models import project

        for _ in range(300):
            noise = rng.normal(size=(2, 60)) * error
            fit = fit_attitude(
                x + noise[0], y + noise[1], ra, dec, crpix=(4608, 4608), crval=(120, 30),
                cd=self.cd, x_err=error, y_err=error, clip=10.0,
            )  # fmt: skip
            offsets.append(np.linalg.solve(fit.cd, project(*true, fit.crval)) - z)
            predicted.append(
                [(at @ fit.covariance[i : i + 3, i : i + 3] @ at.T).item() for i in (0, 3)]
            )
        ratio = np.std(offsets, axis=0) / np.sqrt(np.mean(predicted, axis=0))
        assert_allclose(ratio, 1.0, atol=0.15)

    def test_errors(self, rng):
        x, y, ra, dec = self.stars(rng, (120.0, 30.0), 9)
        with pytest.raises(FitError, match="9 of 9 stars are left"):
            fit_attitude(x, y, ra, dec, crpix=(0, 0), crval=(120, 30), cd=self.cd)
        x, y, ra, dec = self.stars(rng, (120.0, 30.0), 50)
        with pytest.raises(FitError, match="0 of 50 stars are left"):
            fit_attitude(x, y, ra, dec, crpix=(0, 0), crval=(300, -30), cd=self.cd)
        with pytest.raises(FitError, match="determine only 2 of 3"):
            fit_attitude(x, x, ra, ra, crpix=(0, 0), crval=(120, 120), cd=self.cd)
