"""Pooled residuals and cuts, against numbers made by hand."""

import numpy as np
import pytest
from astropy.table import Table

from wpdc_gwcs import Calibration, DistortionSolution
from wpdc_gwcs.evaluation import Cuts, evaluate, format_table, pool_residuals, tabulate_detectors
from wpdc_gwcs.models import PVPolynomial

SHAPE = (1000, 1200)


def make_frame(rng, name, detector="g-1", *, n=4000, shift=(0.0, 0.0), cd=None, **columns):
    cd = np.diag([-2e-5, 2e-5]) if cd is None else cd
    solution = DistortionSolution(
        detector, SHAPE, np.array([599.5, 499.5]), cd, np.array([10.0, 20.0]), PVPolynomial()
    )
    x, y = rng.uniform(-0.5, 1199.5, n), rng.uniform(-0.5, 999.5, n)
    dx, dy = rng.normal(0, 0.02, (2, n)) + np.reshape(shift, (2, 1))
    held = rng.uniform(size=n) < 0.2
    table = {"x": x, "y": y, "dx": dx, "dy": dy, "used": ~held, "holdout": held}
    table |= {"phot_g_mean_mag": rng.uniform(18, 24, n), "snr": rng.uniform(10, 100, n)}
    return Calibration(name, solution, solution.crval, cd, matches=Table({**table, **columns}))


def test_frames_of_a_detector_are_pooled(rng):
    frames = [
        make_frame(rng, "a", shift=(0.03, 0.0)),
        make_frame(rng, "b", shift=(-0.03, 0.01)),
        make_frame(rng, "c", "NUV-1"),
    ]
    found = pool_residuals(frames)
    assert [(r.detector, r.n_frames) for r in found] == [("NUV-1", 1), ("g-1", 2), ("all", 3)]
    dx, dy = (
        np.concatenate([f.matches[k][f.matches["used"]] for f in frames[:2]]) for k in ("dx", "dy")
    )
    assert found[1].statistics == evaluate(dx, dy)
    assert found[1].statistics.sigma_dx == pytest.approx(np.hypot(0.02, 0.03), rel=0.03)
    assert found[1].statistics.mean_dy == pytest.approx(0.005, abs=0.001)
    assert found[2].statistics.n == sum(r.statistics.n for r in found[:2])
    held = pool_residuals(frames, stars="holdout")
    assert held[1].statistics.n + found[1].statistics.n == 8000


def test_residuals_on_the_sky(rng):
    """A detector turned by 90 degrees: x is north, y is east."""
    scale = 0.1 / 3600
    frame = make_frame(rng, "a", shift=(0.05, -0.02), cd=np.array([[0, scale], [scale, 0]]))
    (found,) = pool_residuals(frame)
    assert found.mean_alpha == pytest.approx(-2.0, abs=0.1)  # mas
    assert found.mean_delta == pytest.approx(5.0, abs=0.1)
    assert found.sigma_alpha == pytest.approx(2.0, rel=0.05)
    np.testing.assert_allclose(found.d_delta, found.dx * 100)


def test_share_of_the_area(rng):
    frame = make_frame(rng, "a", n=100_000)
    third = np.asarray(frame.matches["x"]) < 399.5
    frame.matches["dx"][third] += 0.03
    frame.matches["dy"][third] += 0.03
    share = [pool_residuals(frame, limit=limit, n_bins=9)[0].share_below for limit in (0.01, 0.1)]
    assert share == [pytest.approx(2 / 3), 1.0]


def test_cuts_select_what_they_say(rng):
    frame = make_frame(rng, "a")
    m = frame.matches
    r = np.hypot(m["x"] - 599.5, m["y"] - 499.5)
    cuts = Cuts(
        min_radius=100, max_radius=400, min_magnitude=19, max_magnitude=23, min_snr=30,
        region=(200, 900, 300, 1000),
    )  # fmt: skip
    expected = (r > 100) & (r < 400) & (m["phot_g_mean_mag"] > 19) & (m["phot_g_mean_mag"] <= 23)
    expected &= (m["snr"] > 30) & (m["x"] >= 200) & (m["x"] <= 900) & (m["y"] >= 300)
    np.testing.assert_array_equal(cuts.select(m, (599.5, 499.5)), expected)
    (found,) = pool_residuals(frame, cuts=cuts)
    assert found.statistics.n == np.sum(expected & m["used"])
    corner = Cuts(max_radius=50, about=(0.0, 0.0)).select(m, (599.5, 499.5))
    np.testing.assert_array_equal(corner, np.hypot(m["x"], m["y"]) < 50)
    assert not Cuts()
    assert cuts
    assert pool_residuals(frame, cuts=Cuts(min_radius=5000)) == []


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"min_radius": 5, "max_radius": 5}, "radius must have its lower limit first, got 5 to 5"),
        ({"min_magnitude": 5, "max_magnitude": 4}, "magnitude must have its lower limit first"),
        ({"region": (0, 1, 5, 2)}, "region in y must have its lower limit first, got 5 to 2"),
        ({"region": (0, 1)}, "region must be 4 finite numbers"),
        ({"about": (0, np.nan)}, "about must be 2 finite numbers"),
        ({"min_snr": np.inf}, "min_snr must be a finite number, got inf"),
    ],
)
def test_impossible_cuts(limits, message):
    with pytest.raises(ValueError, match=message):
        Cuts(**limits)


def test_pooling_needs_what_it_needs(rng):
    frame = make_frame(rng, "a")
    with pytest.raises(ValueError, match="pool_residuals needs calibrated frames"):
        pool_residuals([])
    with pytest.raises(ValueError, match="stars must be 'used' or 'holdout', got 'all'"):
        pool_residuals(frame, stars="all")
    with pytest.raises(ValueError, match="limit must be positive, in px, got 0"):
        pool_residuals(frame, limit=0)
    frame.matches.remove_column("snr")
    with pytest.raises(ValueError, match="a limit on snr needs this column"):
        pool_residuals(frame, cuts=Cuts(min_snr=5))


def test_tables(rng):
    frames = [make_frame(rng, n, n, n=900) for n in ("NUV-1", "g-1", "g-2", "a_b")]
    found = pool_residuals(frames)
    table = tabulate_detectors(found)
    assert list(table["detector"]) == ["NUV-1", "a_b", "g-1", "g-2", "all"]
    assert table["sigma_alpha"][0] == pytest.approx(0.02 * 72, rel=0.1)
    text = format_table(found).splitlines()
    assert text[0].split() == ["Detector", "ID", "mean_dx", "sigma_dx", "mean_dy", "sigma_dy"]
    assert [line.split()[0] for line in text[2:]] == ["NUV-1", "a_b", "g-1", "g-2"]
    assert float(text[2].split()[2]) == pytest.approx(found[0].statistics.sigma_dx, abs=5e-4)
    assert "-0.000" not in "".join(text)
    latex = format_table(found, form="latex")
    assert r"a\_b & " in latex
    assert latex.count(r"\midrule") == 3
    assert latex.count(r"\\") == 5
    with pytest.raises(ValueError, match="form must be 'ascii' or 'latex', got 'html'"):
        format_table(found, form="html")
