"""What is refused and what is delivered with reasons, each against a frame that lacks one thing."""

from types import SimpleNamespace

import numpy as np
import pytest
from astropy.table import Table
from numpy.testing import assert_allclose

from wpdc_gwcs import Calibration, DistortionSolution, PVPolynomial
from wpdc_gwcs.calibration.checks import (
    check_solution,
    coverage,
    largest_hole,
    shortcomings,
)
from wpdc_gwcs.evaluation import evaluate
from wpdc_gwcs.exceptions import FitError

SHAPE = (800, 1000)
N = 300
CD = 1e-4 * np.array([[-1.0, 0.0], [0.0, 1.0]])


class Case:
    """A frame and a calibration without fault, to be spoiled."""

    def __init__(self, rng):
        x, y = rng.uniform(0, 999, N), rng.uniform(0, 799, N)
        self.matches = Table(
            {
                "x": x,
                "y": y,
                "x_err": np.full(N, 0.05),
                "y_err": np.full(N, 0.05),
                "dx": rng.normal(0, 0.05, N),
                "dy": rng.normal(0, 0.05, N),
                "used": np.ones(N, bool),
            }
        )
        self.sigma = np.array([np.full((9, 9), 0.02), np.full((9, 9), 0.03), np.zeros((9, 9))])
        self.pv = PVPolynomial()
        self.held = np.zeros(N, bool)
        self.frame = SimpleNamespace(
            source="night/fake.fits",
            image_shape=SHAPE,
            epoch=2016.0,
            sources=Table(
                {"x": np.append(x, np.full(60, 5.0)), "y": np.append(y, np.full(60, 5.0))}
            ),
            usable=np.arange(N + 60) < N + 30,
            pairs=(np.arange(N), np.arange(N)),
            reference=Table({"ra": [1.0], "dec": [2.0], "pmra": [3.0], "pmdec": [4.0]}),
            diagnostics=SimpleNamespace(
                completeness=0.9, n_pairs=N, n_sources=N + 30, n_reference=N + 400
            ),
        )

    @property
    def calibration(self):
        solution = DistortionSolution(
            detector="d",
            image_shape=SHAPE,
            crpix=np.array([499.5, 399.5]),
            cd=CD,
            crval=np.array([10.0, 20.0]),
            pv=self.pv,
        )
        used = np.asarray(self.matches["used"])
        residuals = evaluate(self.matches["dx"][used], self.matches["dy"][used])
        statistics = {
            "n_used": int(used.sum()),
            "residuals": {"sigma_dx": residuals.sigma_dx, "sigma_dy": residuals.sigma_dy},
        }
        return Calibration(
            "fake", solution, solution.crval, CD, sigma=self.sigma, matches=self.matches,
            statistics=statistics,
        )  # fmt: skip

    def check(self, **options):
        return check_solution(self.frame, self.calibration, **options)

    def lacks(self, **options):
        return shortcomings(self.frame, self.calibration, held=self.held, **options)


@pytest.fixture
def case(rng):
    return Case(rng)


class TestCoverage:
    def test_of_a_rectangle(self):
        x, y = np.meshgrid([100.0, 350.0, 600.0], [0.0, 400.0])
        assert_allclose(coverage(x.ravel(), y.ravel(), SHAPE), 500 * 400 / 800_000)

    def test_of_a_triangle(self):
        assert_allclose(coverage([0, 1000, 0], [0, 0, 800], SHAPE), 0.5)

    @pytest.mark.parametrize("n", [0, 1, 2])
    def test_of_nothing(self, n):
        assert coverage(np.arange(n), np.arange(n), SHAPE) == 0.0

    def test_of_a_line(self):
        assert coverage(np.arange(10.0), 2 * np.arange(10.0), SHAPE) == 0.0
        assert coverage(np.ones(5), np.ones(5), SHAPE) == 0.0

    def test_of_stars_all_over(self, rng):
        assert coverage(rng.uniform(0, 1000, 2000), rng.uniform(0, 800, 2000), SHAPE) > 0.95


class TestFewDetections:
    def test_most_left_out(self, case, rng):
        many = rng.uniform(0, 799, 1500)
        case.frame.sources = Table({"x": many, "y": many})
        case.frame.usable = np.arange(1500) < N + 30
        case.frame.diagnostics.n_reference = 1300
        (reason,) = case.lacks()
        assert reason.startswith("only 300 of 1500 detections match: 1170 are left out")

    def test_few_of_the_brightest(self, case):
        sources = case.frame.sources
        # Fewer reference stars than clean detections, and the pairs are of the faint ones.
        case.frame.diagnostics.n_reference = 200
        case.frame.diagnostics.n_pairs = 100
        case.frame.pairs = np.arange(100), np.arange(100)
        sources["flux"] = np.arange(len(sources), dtype=float)
        (reason,) = case.lacks()
        assert reason.startswith("only 0 of the 200 brightest of 330 clean detections match")
        sources["flux"] = -sources["flux"]
        assert case.lacks() == []


class TestContradictions:
    def test_a_map_that_folds(self, case):
        # As in `test_a_map_that_comes_close_to_folding`, beyond the fold.
        case.pv = PVPolynomial(pv1_7=-1.2 / (3 * 0.05**2))
        with pytest.raises(FitError, match=r"a.*: the map folds, .* factors of -0\.\d+ to 1"):
            case.check()

    def test_a_good_solution_passes(self, case):
        case.check()
        assert case.lacks() == []

    @pytest.mark.parametrize(("known", "least"), [(False, 10), (True, 4)])
    def test_too_few_stars_agree(self, case, known, least):
        case.matches["used"][least:] = False
        case.check(known=known)
        case.matches["used"][least - 1 :] = False
        with pytest.raises(
            FitError, match=f"fake.fits: only {least - 1} stars .*; at least {least} are"
        ):
            case.check(known=known)

    def test_residuals_of_pixels(self, case):
        case.matches["dy"] *= 50
        with pytest.raises(FitError, match=r"residuals scatter by 2\.\d+ px; at most 1.0 px"):
            case.check()

    def test_centroids_as_bad_as_that(self, case):
        for name in ("dx", "dy", "x_err", "y_err"):
            case.matches[name] *= 50
        case.check()
        for name in ("dx", "dy"):
            case.matches[name] *= 4
        with pytest.raises(FitError, match=r"or 3 times their errors of 2.50 px"):
            case.check()

    def test_a_stored_solution_that_was_better(self, case):
        stored = SimpleNamespace(statistics={"sigma_px": 0.05})
        case.matches["dx"] *= 6
        case.check()
        with pytest.raises(FitError, match=r"by 0\.\d+ px, those of the stored solution by 0.05"):
            case.check(stored=stored)
        # Five times as much, up to a quarter of a pixel, is the weather.
        case.matches["dx"] *= 0.6
        case.check(stored=stored)
        case.check(stored=SimpleNamespace(statistics={}))


class TestShortcomings:
    def test_stars_in_one_part(self, case):
        case.matches["x"] *= 0.3
        (reason,) = case.lacks()
        assert reason.startswith("its 300 stars cover 29% of")
        assert "of the detector (x 2 to 299 of 1000 px, y 3 to 796 of 800)" in reason
        assert case.lacks(known=True) == []

    def test_uncertain_map(self, case):
        case.sigma[1, :, 0] = 0.7
        (reason,) = case.lacks()
        assert reason == (
            "the map is uncertain by more than 0.25 px over 11% of the detector, by 0.7 px at worst"
        )
        case.sigma[1, :, 0] = 0.03
        case.sigma[0, 0, 0] = 0.7  # one corner of 81 nodes
        assert case.lacks() == []

    def test_clipped_pairs(self, case):
        case.matches["used"][::3] = False
        assert case.lacks() == ["only 200 of 300 matched stars agree with the solution"]
        # Stars that were held out on purpose are no loss.
        case.held[::3] = True
        assert case.lacks() == []

    def test_few_stars_match(self, case):
        case.frame.diagnostics.completeness = 0.2
        (reason,) = case.lacks()
        assert (
            reason == "only 300 of 330 clean detections and 700 reference stars on the frame match"
        )

    def test_no_epoch(self, case):
        case.frame.epoch = None
        (reason,) = case.lacks()
        assert reason == "the frame has no epoch: the stars' motions could not be applied (--epoch)"
        case.frame.reference.remove_columns(["pmra", "pmdec"])
        assert case.lacks() == []

    def test_a_map_that_comes_close_to_folding(self, case):
        # d(xi + c xi^3) / d xi = 1 + 3 c xi^2, and xi = 0.05 at the edges.
        case.pv = PVPolynomial(pv1_7=-0.7 / (3 * 0.05**2))
        (reason,) = case.lacks()
        assert reason.startswith("the map changes the area of pixels by factors of 0.")
        assert " to 1." in reason
        case.pv = PVPolynomial(pv1_7=-0.2 / (3 * 0.05**2))
        assert case.lacks() == []

    def test_a_part_that_is_off(self, case):
        corner = (case.matches["x"] < 250) & (case.matches["y"] < 200)
        assert corner.sum() >= 10
        case.matches["dx"][corner] += 0.6
        (reason,) = case.lacks()
        assert reason.startswith("1 of ")
        assert "parts of the frame are off by up to 0." in reason

    def test_everything_at_once(self, case):
        """Reasons stand in one order, one for each lack."""
        case.matches["x"] *= 0.3
        case.sigma[:2] = np.inf
        case.frame.epoch = None
        case.frame.diagnostics.completeness = 0.1
        assert [r.split()[1] for r in case.lacks()] == ["300", "map", "300", "frame"]


class TestLargestHole:
    def test_empty_middle(self, rng):
        """Stars along the rim span all of the detector and say nothing of its middle."""
        t = rng.uniform(-1, 1, (2, 4000))
        x, y = 500 * (t[:, np.abs(t).max(axis=0) > 0.8] + 1)
        assert coverage(x, y, (1000, 1000)) > 0.98
        assert_allclose(largest_hole(x, y, (1000, 1000)), np.pi * 0.4**2, rtol=0.05)

    def test_stars_all_over(self, rng):
        x, y = rng.uniform(0, 4000, 200), rng.uniform(0, 128, 200)
        assert largest_hole(x, y, (128, 4000)) < 0.1

    def test_no_stars(self):
        assert largest_hole([], [], (10, 10)) == 1.0
