"""A stored solution followed over time: against residuals whose drift is known."""

import numpy as np
import pytest
from astropy.table import Table

from wpdc_gwcs import DistortionSolution, PVPolynomial, plotting, write
from wpdc_gwcs.cli.app import run
from wpdc_gwcs.evaluation import residuals_of_attitude, split_periods, track_drift
from wpdc_gwcs.io import write_table
from wpdc_gwcs.models import LookupTable
from wpdc_gwcs.solution import Calibration

SIZE, ERROR, DRIFT = 1000, 0.05, 0.03


def solution_of(detector):
    return DistortionSolution(
        detector, (SIZE, SIZE), np.full(2, 0.5 * (SIZE - 1)), np.diag([-2e-5, 2e-5]),
        np.array([10.0, 20.0]), PVPolynomial(),
    )  # fmt: skip


def matches_of(rng, *, drift=0.0, n=2000):
    """Residuals of a frame; a quarter of the detector has moved along x."""
    x, y = rng.uniform(0, SIZE - 1, (2, n))
    dx, dy = rng.normal(0, ERROR, (2, n))
    dx[(x < SIZE / 2) & (y < SIZE / 2)] += drift
    error = np.full(n, ERROR)
    used = np.ones(n, bool)
    return Table(
        {"x": x, "y": y, "dx": dx, "dy": dy, "x_err": error, "y_err": error, "used": used,
         "holdout": ~used}
    )  # fmt: skip


@pytest.fixture(scope="module")
def history():
    rng = np.random.default_rng(4)
    periods = [
        ([2020 + k], [matches_of(rng, drift=DRIFT * (k > 2)) for _ in range(3)]) for k in range(5)
    ]
    return track_drift(solution_of("d"), iter(periods), false_alarm=0.002)


def test_alarms_where_it_has_drifted_and_by_how_much(history):
    assert history.periods["drifted"].tolist() == [False] * 3 + [True] * 2
    np.testing.assert_allclose(history.alarms["amplitude"].value, DRIFT, rtol=0.2)
    np.testing.assert_allclose(history.alarms["area"], 0.25, atol=0.06)
    assert history.periods["n_stars"].tolist() == [6000] * 5
    np.testing.assert_allclose(history.periods["sigma_dy"].value, ERROR, rtol=0.05)
    mean = history.periods["mean_dx"].value
    np.testing.assert_allclose(mean, [0, 0, 0, DRIFT / 4, DRIFT / 4], atol=4 * ERROR / 6000**0.5)


def test_means_of_cells_are_those_of_their_stars(history):
    cells = history.cells
    assert len(cells) == 5 * 16
    moved = (cells["x_max"].value <= SIZE / 2) & (cells["y_max"].value <= SIZE / 2)
    assert moved.sum() == 5 * 4
    late = np.asarray(cells["period"]) > 2
    # Of 375 stars in each cell; errors are never smaller than frames and stars scatter.
    ratio = cells["sigma_dx"].value / (ERROR / 375**0.5)
    assert 0.85 < ratio.min()
    assert ratio.max() < 1.5
    expected = np.where(moved & late, DRIFT, 0.0)
    pull = (cells["dx"].value - expected) / cells["sigma_dx"].value
    assert np.abs(pull).max() < 4
    assert 0.6 < pull.std() < 1.2


def test_few_stars_are_not_tested():
    rng = np.random.default_rng(5)
    found = track_drift(solution_of("d"), [([np.nan], [matches_of(rng, n=5)])])
    assert np.isnan(found.periods["p_value"]).all()
    assert not found.periods["drifted"].any()
    assert len(found.cells) == 0
    for plot in (plotting.plot_drift_history, plotting.plot_cell_history):
        assert plot(found).axes[0].get_title(loc="left").startswith("d: ")
    with pytest.raises(ValueError, match="no period was given"):
        track_drift(solution_of("d"), [])


@pytest.mark.parametrize(("epochs", "width"), [([2020.0], 2 / 365.25), ([2020.0, 2020.1], 0.2)])
def test_a_single_period_is_drawn_on_an_axis_of_its_length(epochs, width):
    rng = np.random.default_rng(5)
    tables = [matches_of(rng, n=50) for _ in epochs]
    figure = plotting.plot_drift_history(track_drift(solution_of("d"), [(epochs, tables)]))
    for axes in figure.axes:
        low, high = axes.get_xlim()
        assert low < np.mean(epochs) < high
        assert high - low == pytest.approx(width)


@pytest.mark.parametrize(
    ("days", "expected"),
    [(1.0, [[1], [2, 0], [3]]), (10.0, [[1, 2, 0, 3]]), (2.0, [[1, 2, 0], [3]])],
)
def test_periods(days, expected):
    epochs = 2020 + np.array([1.9, 0.0, 1.0, 2.5]) / 365.25
    assert [p.tolist() for p in split_periods(epochs, days)] == expected


def test_periods_that_cannot_be():
    assert split_periods([], 1.0) == []
    with pytest.raises(ValueError, match="every frame must have an epoch"):
        split_periods([2020.0, np.nan], 1.0)
    with pytest.raises(ValueError, match="days must be positive, got 0"):
        split_periods([2020.0], 0)


def test_what_a_field_has_taken_is_put_back(rng):
    """A frame whose field has taken the drift of a quarter shows it again, less a linear part."""
    matches = matches_of(rng, drift=DRIFT)
    grid = np.linspace(-0.5, SIZE - 0.5, 41)
    x, y = np.meshgrid(grid, grid)
    field = LookupTable(grid, grid, DRIFT * np.sin(x / 60), DRIFT * np.cos(y / 60))
    one = Calibration("f", solution_of("d"), np.array([10.0, 20.0]), np.diag([-2e-5, 2e-5]), field)
    taken = matches.copy()
    shift = field(np.asarray(matches["x"]), np.asarray(matches["y"]))
    for name, values in zip(("dx", "dy"), shift, strict=True):
        taken[name] = matches[name] - values
    back = residuals_of_attitude(one, taken)
    rows = np.stack([np.ones(len(matches)), matches["x"], matches["y"]], axis=1)
    for name in ("dx", "dy"):
        expected = matches[name] - rows @ np.linalg.lstsq(rows, matches[name], rcond=None)[0]
        np.testing.assert_allclose(back[name], expected, atol=1e-12)
    plain = Calibration("f", solution_of("d"), np.array([10.0, 20.0]), np.diag([-2e-5, 2e-5]))
    assert residuals_of_attitude(plain, taken) is taken


def test_figures_show_the_alarms(history):
    figure = plotting.plot_drift_history(history)
    means, scatter, change = figure.axes
    assert "5 periods, 15 frames, 2 alarms" in means.get_title(loc="left")
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert "alarm" in labels
    line = change.get_lines()[0]
    np.testing.assert_array_equal(line.get_xdata(), 2020 + np.arange(5))
    np.testing.assert_array_equal(line.get_ydata(), history.periods["amplitude"].value)
    image = plotting.plot_cell_history(history).axes[0].get_images()[0].get_array()
    assert image.shape == (16, 5)
    np.testing.assert_allclose(image[0, 3:], DRIFT, atol=0.01)


@pytest.fixture
def survey(tmp_path):
    """Results of two detectors, of which one drifts; and their solutions."""
    rng = np.random.default_rng(6)
    rows = []
    for detector in "ab":
        write(solution_of(detector), tmp_path / f"{detector}.solution.asdf")
        for k in range(4):
            table = matches_of(rng, drift=DRIFT * (detector == "b" and k > 1))
            write_table(table, tmp_path / f"{detector}{k}.matches.ecsv")
            rows.append((f"{detector}{k}", detector, 2020 + (k // 2) / 12))
    names = ("frame", "detector", "epoch")
    write_table(Table(rows=rows, names=names), tmp_path / "summary.ecsv")
    return tmp_path


def test_frames_of_other_detectors_are_left_alone(survey, capsys):
    assert run(["monitor", str(survey / "a.solution.asdf"), str(survey)]) == 0
    assert "a: no drift found" in (out := capsys.readouterr().out)
    assert "8000 stars in 4 frames" in out
    assert run(["monitor", str(survey / "b.solution.asdf"), str(survey)]) == 1
    captured = capsys.readouterr()
    assert "b: has drifted" in captured.out
    assert "wpdc calibrate --solution ... --update" in captured.err
    write(solution_of("c"), survey / "c.solution.asdf")
    assert run(["monitor", str(survey / "c.solution.asdf"), str(survey)]) == 2
    assert "is for detector c, the frames are from a, b" in capsys.readouterr().err


def test_a_survey_on_the_command_line(survey, capsys):
    out = survey / "out.ecsv"
    arguments = [str(survey / "b.solution.asdf"), str(survey), "--every", "10"]
    more = ["--output", str(out), "--plots", str(survey / "plots")]
    assert run(["monitor", *arguments, *more]) == 1
    told = capsys.readouterr().out.splitlines()
    assert told[0] == "b: 1 alarm in 2 periods, 4 frames"
    assert told[1].startswith("  2020.0833 to 2020.0833: drifted by 0.0")
    assert list(Table.read(out)["drifted"]) == [False, True]
    assert len(Table.read(survey / "out.cells.ecsv")) == 32
    assert sorted(p.name for p in (survey / "plots").iterdir()) == [
        "b.cells.png", "b.history.png",
    ]  # fmt: skip
    assert run(["monitor", *arguments, *more]) == 2
    assert "file exists" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--every", "0"], "--every must be positive, in days, got 0"),
        (["--false-alarm", "2"], "--false-alarm must be between 0 and 1, got 2"),
        (["--every", "1"], "a0.matches.ecsv: --every needs an epoch"),
    ],
)
def test_monitor_refuses_in_one_line(survey, capsys, options, message):
    (survey / "summary.ecsv").unlink()
    assert run(["monitor", str(survey / "a.solution.asdf"), str(survey), *options]) == 2
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 1
    assert message in errors[0]
