"""Residual statistics against closed forms and brute force."""

from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from wpdc_gwcs.evaluation import (
    binned_residuals,
    compare_weights,
    d80,
    detect_drift,
    evaluate,
    robust_scatter,
    running_statistics,
    tabulate_weights,
)
from wpdc_gwcs.exceptions import FitError
from wpdc_gwcs.fitting import RadialWeight
from wpdc_gwcs.models import LookupTable, PVPolynomial, deproject
from wpdc_gwcs.solution import Calibration, DistortionSolution


def test_moments_of_a_normal_distribution_with_wrong_matches():
    rng = np.random.default_rng(3)
    dx, dy = rng.normal(0.02, 0.05, 20000), rng.normal(-0.01, 0.03, 20000)
    dx[:100] += 5.0
    s = evaluate(dx, dy)
    # three sigma of the mean; the clipping at 3 sigma narrows a normal distribution by 1.4 %
    assert s.mean_dx == pytest.approx(0.02, abs=0.001)
    assert s.mean_dy == pytest.approx(-0.01, abs=0.001)
    assert s.sigma_dx == pytest.approx(0.05, rel=0.03)
    assert s.sigma_dy == pytest.approx(0.03, rel=0.03)
    assert s.scatter_dx == pytest.approx(0.05, rel=0.03)
    # 20 % and 80 % of a normal distribution are 0.8416 sigma from its mean
    assert s.d80_dx == pytest.approx(2 * 0.8416 * 0.05, rel=0.03)
    assert s.n == 20000
    assert s.n_clipped < 20000 - 100


def test_clipping_is_of_both_axes_together():
    dx = np.r_[np.tile([-0.1, 0.1], 50), 9.0]
    dy = np.r_[np.tile([-0.1, 0.1], 50), 0.0]
    s = evaluate(dx, dy)
    assert s.n_clipped == 100
    assert s.rms == pytest.approx(np.hypot(0.1, 0.1))


def test_nan_residuals_are_left_out():
    s = evaluate([0.1, np.nan, 0.3], [0.0, 0.0, np.nan])
    assert s.n == 1
    assert s.mean_dx == pytest.approx(0.1)


def test_no_stars():
    s = evaluate([], [])
    assert s.n == 0
    assert np.isnan([s.mean_dx, s.sigma_dy, s.d80_dx, s.rms]).all()
    assert np.isnan(robust_scatter([np.nan]))
    assert np.isnan(d80([]))


def test_wrong_sigma():
    with pytest.raises(ValueError, match="sigma must be positive, got 0"):
        evaluate([0.0], [0.0], sigma=0)


@given(
    values=arrays(float, st.integers(1, 50), elements=st.floats(-1e3, 1e3)),
    shift=st.floats(-10, 10),
    factor=st.floats(0.1, 10),
)
@settings(deadline=None, max_examples=50)
def test_widths_follow_shift_and_scale(values, shift, factor):
    for width in (robust_scatter, d80):
        assert width(values * factor + shift) == pytest.approx(width(values) * factor, abs=1e-9)


def test_binned_residuals_against_loops(rng):
    ny, nx, n = 60, 100, 4
    x, y = rng.uniform(-0.5, nx - 0.5, 300), rng.uniform(-0.5, ny - 0.5, 300)
    dx, dy = rng.normal(size=(2, 300))
    dx[0] = np.nan
    mean_dx, mean_dy, count = binned_residuals(x, y, dx, dy, image_shape=(ny, nx), n_bins=n)
    assert count.sum() == 299
    for iy in range(n):
        for ix in range(n):
            inside = (
                (x + 0.5 >= ix * nx / n)
                & (x + 0.5 < (ix + 1) * nx / n)
                & (y + 0.5 >= iy * ny / n)
                & (y + 0.5 < (iy + 1) * ny / n)
                & np.isfinite(dx)
            )
            assert count[iy, ix] == inside.sum()
            np.testing.assert_allclose(mean_dx[iy, ix], dx[inside].mean())
            np.testing.assert_allclose(mean_dy[iy, ix], dy[inside].mean())


def test_empty_cells_are_nan_and_bins_are_checked():
    mean_dx, mean_dy, count = binned_residuals([], [], [], [], image_shape=(10, 10), n_bins=3)
    assert np.isnan(mean_dx).all()
    assert np.isnan(mean_dy).all()
    assert count.sum() == 0
    with pytest.raises(ValueError, match="n_bins must be at least 1, got 0"):
        binned_residuals([], [], [], [], image_shape=(10, 10), n_bins=0)


SHAPE = (1000, 1200)


def make_solution(sigma):
    """Solution with a table of zeros and this uncertainty at its nodes."""
    x_grid, y_grid = np.linspace(-0.5, 1199.5, 8), np.linspace(-0.5, 999.5, 7)
    zero = np.zeros((7, 8))
    return DistortionSolution(
        "d",
        SHAPE,
        np.array([599.5, 499.5]),
        np.diag([-2e-5, 2e-5]),
        np.array([10.0, 20.0]),
        PVPolynomial(),
        lookup_table=LookupTable(x_grid, y_grid, zero, zero),
        table_sigma=np.array([zero + sigma, zero + sigma, zero]),
    )


def make_matches(rng, n, *, scatter=0.05, stated=0.05):
    x, y = rng.uniform(-0.5, 1199.5, n), rng.uniform(-0.5, 999.5, n)
    dx, dy = rng.normal(0, scatter, (2, n))
    dx[: n // 500] += rng.normal(0, 1, n // 500)  # wrong pairs
    error = np.full(n, stated)
    return Table({"x": x, "y": y, "dx": dx, "dy": dy, "x_err": error, "y_err": error})


def test_false_alarms_are_as_rare_as_stated():
    rng = np.random.default_rng(11)
    solution = make_solution(0.001)
    alarms = sum(
        detect_drift(solution, [make_matches(rng, 600) for _ in range(3)], false_alarm=0.05).drifted
        for _ in range(200)
    )
    # 200 trials of at most 5 %: more than 18 would be a chance of 1 in 500
    assert alarms <= 18


def test_errors_that_are_too_small_raise_no_alarm():
    rng = np.random.default_rng(12)
    solution = make_solution(0.001)
    alarms = [
        detect_drift(solution, make_matches(rng, 2000, stated=0.02)).drifted for _ in range(20)
    ]
    assert sum(alarms) <= 1


def test_drift_is_found_where_it_is_and_by_how_much():
    rng = np.random.default_rng(13)
    tables = [make_matches(rng, 3000) for _ in range(5)]
    for table in tables:
        table["dx"][(table["x"] < 599.5) & (table["y"] < 499.5)] += 0.03
    drift = detect_drift(make_solution(0.002), tables)
    assert drift.drifted
    assert drift.p_value < 1e-6
    assert drift.n_stars == 15000
    assert drift.amplitude == pytest.approx(0.03, rel=0.2)
    changed = drift.cells[drift.cells["changed"]]
    assert np.all(changed["x_max"].value <= 600)
    assert np.all(changed["y_max"].value <= 500)
    quarter = changed[(changed["x_max"] - changed["x_min"]).value > 500][0]
    assert quarter["dx"].value == pytest.approx(0.03, abs=5 * quarter["sigma_dx"].value)


def test_large_drift_is_not_taken_for_wrong_pairs():
    rng = np.random.default_rng(14)
    table = make_matches(rng, 4000)
    table["dy"][table["x"] > 900] -= 2.0
    drift = detect_drift(make_solution(0.002), table)
    assert drift.drifted
    assert drift.cells["dy"][0].value == pytest.approx(-2.0, abs=0.02)


def test_uncertain_table_explains_a_small_offset():
    rng = np.random.default_rng(15)
    table = make_matches(rng, 4000)
    table["dx"][(table["x"] < 599.5) & (table["y"] < 499.5)] += 0.03
    assert detect_drift(make_solution(0.001), table).drifted
    assert not detect_drift(make_solution(0.03), table).drifted


def test_drift_needs_stars_and_a_probability():
    rng = np.random.default_rng(16)
    with pytest.raises(ValueError, match="5 stars in all, too few to test"):
        detect_drift(make_solution(0.001), make_matches(rng, 5))
    with pytest.raises(ValueError, match="false_alarm must be between 0 and 1, got 2"):
        detect_drift(make_solution(0.001), make_matches(rng, 500), false_alarm=2)


def without_linear(table):
    """What the attitude of a frame leaves of its residuals."""
    columns = np.stack([np.ones(len(table)), table["x"], table["y"]], axis=1)
    for name in ("dx", "dy"):
        values = np.asarray(table[name])
        table[name] = values - columns @ np.linalg.lstsq(columns, values, rcond=None)[0]
    return table


@pytest.mark.parametrize(
    "part",
    [
        lambda u, v: (u > 0) & (v < 0),
        lambda u, v: u < -0.5,
        lambda u, v: np.maximum(abs(u), abs(v)) < 0.5,
        lambda u, v: abs(v - 0.25) < 0.25,
    ],
    ids=["corner", "strip", "center", "band"],
)
def test_what_the_attitudes_took_of_a_change_is_given_back(part):
    """A quarter changes by 0.05 px, and each frame has its linear part in its attitude."""
    rng = np.random.default_rng(17)
    tables = [make_matches(rng, 8000) for _ in range(5)]
    for table in tables:
        changed = part(table["x"] / 600 - 1, table["y"] / 500 - 1)
        table["dx"][changed] += 0.03
        table["dy"][changed] -= 0.04
    drift = detect_drift(make_solution(0.001), [without_linear(t) for t in tables])
    assert drift.drifted
    assert drift.amplitude == pytest.approx(0.05, rel=0.06)
    assert drift.area == pytest.approx(0.25, abs=0.03)
    x, y = np.meshgrid(np.linspace(0, 1199, 80), np.linspace(0, 999, 80))
    named = np.zeros(x.shape, bool)
    for c in drift.cells[drift.cells["changed"]]:
        left, right, low, high = (c[k].value for k in ("x_min", "x_max", "y_min", "y_max"))
        named |= (x >= left) & (x < right) & (y >= low) & (y < high)
    assert np.mean(named == part(x / 600 - 1, y / 500 - 1)) > 0.95
    largest = drift.cells[drift.cells["changed"]]
    largest = largest[np.argmax(largest["n"])]
    assert largest["dx"].value == pytest.approx(0.03, abs=5 * largest["sigma_dx"].value)
    assert largest["dy"].value == pytest.approx(-0.04, abs=5 * largest["sigma_dy"].value)


def test_turbulence_is_no_drift():
    """Waves that differ between frames are common to the stars of a cell, not to the frames."""
    rng = np.random.default_rng(18)
    alarms = 0
    for _ in range(30):
        tables = [make_matches(rng, 2000) for _ in range(5)]
        for table in tables:
            phase, k = rng.uniform(0, 6.28), rng.uniform(-0.015, 0.015, 2)
            wave = np.sin(k[0] * table["x"] + k[1] * table["y"] + phase)
            table["dx"] += 0.02 * wave
        alarms += detect_drift(make_solution(0.001), [without_linear(t) for t in tables]).drifted
    assert alarms <= 2


def test_small_changes_everywhere_count_together():
    """No cell alone shows a pattern of 0.006 px; the whole detector does."""
    rng = np.random.default_rng(19)
    tables = [make_matches(rng, 8000) for _ in range(5)]
    for table in tables:
        ix, iy = (np.asarray(table[c]) // s for c, s in (("x", 150.0), ("y", 125.0)))
        table["dx"] += 0.006 * np.sign(np.sin(3 * ix + 5 * iy + ix * iy))
    drift = detect_drift(make_solution(0.0), tables)
    assert drift.drifted
    assert not drift.cells["p_value"].min() * len(drift.cells) / drift.p_value < 1e-3


def test_running_statistics(rng):
    values = rng.permutation(200.0 + np.arange(100))
    dx = 0.01 * (values - 200)
    table = running_statistics(values, dx, -dx, n_bins=4)
    np.testing.assert_allclose(table["low"], [200, 225, 250, 275])
    np.testing.assert_allclose(table["high"], [224, 249, 274, 299])
    np.testing.assert_allclose(table["mean_dx"], [0.12, 0.37, 0.62, 0.87])
    np.testing.assert_allclose(table["mean_dy"], -np.asarray(table["mean_dx"]))
    assert len(running_statistics(values[:15], dx[:15], dx[:15])) == 1
    assert running_statistics([], [], [])["n"].tolist() == [0]
    with pytest.raises(ValueError, match="n_bins must be at least 1, got 0"):
        running_statistics(values, dx, dx, n_bins=0)


def make_calibrations(rng, *, n=3, stars=1500, holdout=False):
    """Frames of a detector with a quartic distortion, each in its true attitude."""
    cd, crpix = np.diag([-2e-5, 2e-5]), np.array([599.5, 499.5])
    solution = DistortionSolution("d", SHAPE, crpix, cd, np.array([10.0, 20.0]), PVPolynomial())
    found = []
    for k in range(n):
        x, y = rng.uniform(-0.5, 1199.5, stars), rng.uniform(-0.5, 999.5, stars)
        u, v = (x - crpix[0]) / 600, (y - crpix[1]) / 600
        noise = rng.normal(0, 0.02, (2, stars))
        crval = np.array([10.0 + 0.01 * k, 20.0])
        true = np.array([x - crpix[0] + u**3 + 0.5 * u**4, y - crpix[1] + v**3 - v**4])
        ra, dec = deproject(*(cd @ (true + noise)), crval)
        error = np.full(stars, 0.02)
        held = rng.uniform(size=stars) < 0.2 if holdout else np.zeros(stars, bool)
        matches = Table(
            {"x": x, "y": y, "x_err": error, "y_err": error, "ra": ra, "dec": dec,
             "dx": noise[0], "dy": noise[1], "used": ~held, "holdout": held}
        )  # fmt: skip
        found.append(Calibration(f"f{k}", solution, crval, cd, matches=matches))
    return found


def test_weights_against_least_squares(rng):
    """The polynomial of each weight against numpy; the table takes what it leaves."""
    calibrations = make_calibrations(rng)
    results = compare_weights(calibrations, r0=400.0)
    assert [r.weight.name for r in results] == list(RadialWeight.names)
    x, y = (np.concatenate([np.asarray(c.matches[k]) for c in calibrations]) for k in "xy")
    u, v = (x - 599.5) / 600, (y - 499.5) / 600
    terms = np.stack([u**i * v**j for i in range(4) for j in range(4 - i)], axis=1)
    for r in results:
        # Residual = polynomial - reference: the quartic is what no polynomial follows.
        noise = np.concatenate([np.asarray(c.matches["dx"]) for c in calibrations])
        target = u**3 + 0.5 * u**4 + noise
        root = np.sqrt(RadialWeight(r.weight.name, r0=400.0)(600 * np.hypot(u, v)))
        fit = terms @ np.linalg.lstsq(terms * root[:, None], target * root, rcond=None)[0]
        np.testing.assert_allclose(r.dx, fit - target, atol=1e-5)
        assert r.statistics.sigma_dx == pytest.approx(evaluate(fit - target, r.dy).sigma_dx, 1e-3)
        assert r.table_statistics.sigma_dx == pytest.approx(0.02, rel=0.08)
        assert not r.held_out
    total = [np.mean(r.dx**2) for r in results]
    assert min(total) == total[-1]  # least squares with equal weights, nothing clipped
    table = tabulate_weights(results)
    assert len(table) == 10
    assert list(table["table"][:2]) == ["no", "yes"]
    assert table["d80_dx"][1] == results[0].table_statistics.d80_dx


def test_weights_are_judged_by_held_out_stars(rng):
    calibrations = make_calibrations(rng, n=1, holdout=True)
    (result,) = compare_weights(calibrations[0], weights=["inverse"])
    assert result.held_out
    assert result.dx.size == calibrations[0].matches["holdout"].sum()
    assert result.weight.r0 == pytest.approx(0.87 * 500)
    assert tabulate_weights([result])["stars"][0] == "holdout"


def test_weights_need_matches_of_one_detector(rng):
    one = make_calibrations(rng, n=1)[0]
    with pytest.raises(ValueError, match="frames with their matches"):
        compare_weights(replace(one, matches=None))
    other = replace(one, solution=replace(one.solution, detector="e"))
    with pytest.raises(ValueError, match="frames must be of one detector, got 'd' .* and 'e'"):
        compare_weights([one, other])
    with pytest.raises(FitError, match="weight exp-sqrt with r0 = 3 px: .* stars"):
        compare_weights(replace(one, matches=one.matches[:8]), r0=3.0)
