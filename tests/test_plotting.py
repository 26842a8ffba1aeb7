"""Figures: what they show, read back from the artists."""

import numpy as np
import pytest
from astropy.table import Table

from wpdc_gwcs import plotting
from wpdc_gwcs.evaluation import WeightResult, d80, evaluate
from wpdc_gwcs.fitting import RadialWeight
from wpdc_gwcs.models import LookupTable

SHAPE = (800, 1000)


@pytest.fixture
def matches(rng):
    n = 3000
    x, y = rng.uniform(-0.5, 999.5, n), rng.uniform(-0.5, 799.5, n)
    holdout = rng.uniform(size=n) < 0.2
    dx, dy = 0.1 + rng.normal(0, 0.05, n), rng.normal(0, 0.05, n)
    dx[:5] = 40.0
    used = ~holdout
    used[:5] = False
    holdout[:5] = False
    return Table(
        {"x": x, "y": y, "dx": dx, "dy": dy, "used": used, "holdout": holdout},
        units={"dx": "pix"},
    )


@pytest.fixture
def saved(tmp_path):
    """Checks that a figure can be written, whatever it shows."""

    def save(figure):
        path = tmp_path / "figure.png"
        figure.savefig(path, dpi=50)
        assert path.read_bytes().startswith(b"\x89PNG")
        return figure

    return save


def test_arrows_show_the_mean_of_each_cell(saved):
    x, y = np.meshgrid(np.linspace(0, 999, 60), np.linspace(0, 799, 60))
    dx, dy = np.full(x.shape, 0.02), np.where(x < 500, -0.01, 0.01)
    figure = saved(
        plotting.plot_residual_arrows(
            x.ravel(), y.ravel(), dx.ravel(), dy.ravel(), image_shape=SHAPE, title="after"
        )
    )
    axes = figure.axes[0]
    quiver = next(c for c in axes.collections if hasattr(c, "U"))
    assert quiver.U.size == 20 * 20
    np.testing.assert_allclose(quiver.U, 0.02)
    np.testing.assert_allclose(np.abs(quiver.V), 0.01)
    assert axes.get_xlabel() == "x [px]"
    title = axes.get_title(loc="left")
    assert title.startswith("after")
    assert f"{np.hypot(0.02, 0.01):.2g} px" in title


def test_arrows_stay_in_the_picture(rng):
    x, y = np.meshgrid(np.linspace(0, 999, 60), np.linspace(0, 799, 60))
    dx, dy = rng.standard_t(3, (2, x.size))
    figure = plotting.plot_residual_arrows(x.ravel(), y.ravel(), dx, dy, image_shape=SHAPE)
    axes = figure.axes[0]
    quiver = next(c for c in axes.collections if hasattr(c, "U"))
    for start, arrow, (low, high) in (
        (quiver.X, quiver.U, axes.get_xlim()),
        (quiver.Y, quiver.V, axes.get_ylim()),
    ):
        tip = start + arrow / quiver.scale
        assert low < tip.min()
        assert tip.max() < high


def test_arrows_without_stars(saved):
    saved(plotting.plot_residual_arrows([], [], [], [], image_shape=SHAPE))


def test_residuals_against_position(matches, saved):
    figure = saved(plotting.plot_residuals_vs_position(matches))
    assert len(figure.axes) == 4
    first = figure.axes[0]
    shown = {line.get_label(): line for line in first.lines}
    assert len(shown["not used"].get_xdata()) == 5
    assert len(shown["held out"].get_xdata()) == matches["holdout"].sum()
    median = shown["running median"].get_ydata()
    np.testing.assert_allclose(median, 0.1, atol=0.03)
    # wrong pairs do not set the scale
    assert first.get_ylim()[1] < 1
    assert figure.axes[2].get_ylabel() == r"$\Delta Y$ [px]"


def test_residual_maps_count_the_stars(matches, saved):
    figure = saved(plotting.plot_residual_maps(matches, image_shape=SHAPE, n_bins=5))
    images = [axes.images[0].get_array() for axes in figure.axes[:3]]
    assert images[2].sum() == (matches["used"] | matches["holdout"]).sum()
    np.testing.assert_allclose(images[0], 0.1, atol=0.03)


def test_lookup_table_is_drawn_node_by_node(saved):
    x_grid, y_grid = np.linspace(-0.5, 999.5, 6), np.linspace(-0.5, 799.5, 5)
    dx = np.arange(30.0).reshape(5, 6)
    figure = saved(plotting.plot_lookup_table(LookupTable(x_grid, y_grid, dx, -dx)))
    images = [axes.images[0].get_array() for axes in figure.axes[:3]]
    np.testing.assert_allclose(images[0], dx)
    np.testing.assert_allclose(images[1], -dx)
    np.testing.assert_allclose(images[2], np.hypot(dx, dx))
    assert figure.axes[0].get_xlim() == (-0.5, 999.5)


def test_cdf_has_a_curve_per_axis_and_its_width(matches, saved):
    figure = saved(plotting.plot_cdf(matches))
    labels = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert len(labels) == 4
    assert all("d80 = 0.08" in label for label in labels)


def test_missing_columns_are_named(matches):
    matches.remove_column("dy")
    with pytest.raises(ValueError, match="must have the columns x, y, dx, dy; no dy"):
        plotting.plot_cdf(matches)


def test_magnitudes_are_found_by_name(matches, saved, rng):
    with pytest.raises(ValueError, match="matches must have one of the columns phot_g_mean_mag"):
        plotting.plot_residuals_vs_magnitude(matches)
    matches["snr"] = rng.uniform(10, 1000, len(matches))
    figure = saved(plotting.plot_residuals_vs_magnitude(matches))
    assert figure.axes[0].get_xlabel() == "signal-to-noise ratio"
    assert figure.axes[0].get_xscale() == "log"
    matches["phot_g_mean_mag"] = rng.uniform(17, 24, len(matches))
    matches["phot_g_mean_mag"][:100] = np.nan
    figure = saved(plotting.plot_residuals_vs_magnitude(matches))
    assert figure.axes[2].get_xlabel() == "G [mag]"
    for line in figure.axes[2].get_lines():
        np.testing.assert_allclose(line.get_ydata(), 0.05, rtol=0.2)


def test_weights_are_told_apart(saved, rng):
    results = []
    for k, name in enumerate(RadialWeight.names):
        dx, dy = rng.normal(0, 0.1 * (k + 1), (2, 400))
        results.append(
            WeightResult(
                RadialWeight(name), dx, dy, 0.5 * dx, 0.5 * dy, evaluate(dx, dy),
                evaluate(0.5 * dx, 0.5 * dy), held_out=False,
            )
        )  # fmt: skip
    figure = saved(plotting.plot_weights(results))
    panels = figure.axes
    assert len(panels) == 4
    for axes, name in zip(panels, ("dx", "dy", "table_dx", "table_dy")):
        texts = [t.get_text() for t in axes.get_legend().get_texts()]
        assert [t.split(":")[0] for t in texts] == list(RadialWeight.names)
        for r, text in zip(results, texts):
            assert float(text.split()[-2]) == pytest.approx(d80(getattr(r, name)), rel=0.06)
    looks = {(line.get_color(), line.get_linestyle()) for line in panels[0].get_lines()[2:]}
    assert len(looks) == 5
