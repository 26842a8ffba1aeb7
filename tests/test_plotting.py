"""Figures: what they show, read back from the artists."""

import re

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


def cloud(rng, n=4000, *, sigma=0.05, mag=True):
    """Table of residuals that grow with magnitude, and with x on the right."""
    x, y = rng.uniform(-0.5, 999.5, n), rng.uniform(-0.5, 799.5, n)
    dx, dy = rng.normal(0, sigma, (2, n))
    table = Table({"x": x, "y": y, "dx": dx, "dy": dy})
    if mag:
        table["phot_g_mean_mag"] = rng.uniform(18, 21, n)
        factor = table["phot_g_mean_mag"] - 17
        table["dx"] *= factor
        table["dy"] *= factor
    return table


def no_labels_overlap(figure):
    """Check that no two of the texts of a figure that are shown lie on each other."""
    figure.canvas.draw()
    boxes = []
    for axes in figure.axes:
        texts = [*axes.texts, axes.title, axes.xaxis.label, axes.yaxis.label]
        for axis, limits in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
            low, high = sorted(limits)
            for tick in axis.get_major_ticks():
                if low <= tick.get_loc() <= high:
                    texts += [t for t in (tick.label1, tick.label2) if t.get_visible()]
        boxes += [(t.get_text(), t.get_window_extent()) for t in texts if t.get_text().strip()]
    for k, (text, box) in enumerate(boxes):
        for other, second in boxes[:k]:
            assert not box.padded(-1).overlaps(second.padded(-1)), (text, other)


def test_before_and_after(rng, saved):
    after = [cloud(rng, mag=False), cloud(rng, mag=False)]
    before = [t.copy() for t in after]
    for t in before:
        t["dx"] += 20 * (t["x"] - 500) / 500
    axes = plotting.plot_before_after(before, after, image_shape=SHAPE, titles=("raw", "done"))
    assert axes.shape == (2, 5)
    figure = saved(axes[0, 0].figure)
    for main, title in zip(axes[:, 0], ("raw", "done"), strict=True):
        quiver = next(c for c in main.collections if hasattr(c, "U"))
        assert quiver.U.size == 400
        assert any(title in t.get_text() for a in figure.axes for t in a.texts)
    # of 8000 stars, 4000 are shown: dx against x above, against y to the right
    above, right = axes[0, 1], axes[0, 3]
    x, dx = above.lines[0].get_data()
    assert len(x) == 4000
    assert np.corrcoef(x, dx)[0, 1] > 0.99
    dx, y = right.lines[0].get_data()
    assert abs(np.corrcoef(dx, y)[0, 1]) < 0.1
    no_labels_overlap(figure)


def test_before_and_after_in_axes_given(rng):
    from matplotlib.figure import Figure

    mine = Figure().subplots(1, 2)
    table = cloud(rng, 300)
    axes = plotting.plot_before_after(table, table, image_shape=SHAPE, axes=mine)
    assert list(axes[:, 0]) == list(mine)
    with pytest.raises(ValueError, match="axes must be 2, got 1"):
        plotting.plot_before_after(table, table, image_shape=SHAPE, axes=mine[0])
    with pytest.raises(ValueError, match="no table of matches was given"):
        plotting.plot_before_after([], [], image_shape=SHAPE)


def detectors():
    """Two frames side by side, 1200 px apart, with a distortion along x of one of them."""
    from wpdc_gwcs import Calibration, DistortionSolution, PVPolynomial
    from wpdc_gwcs.models import deproject

    cd = np.array([[-1e-4, 0.0], [0.0, 1e-4]])
    found = []
    for k, name in enumerate(("a-1", "b-2")):
        # 4 px at the right edge of the second
        pv = PVPolynomial(pv1_4=-k * 4e-4 / (500e-4) ** 2)
        crpix = np.array([499.5, 399.5])
        crval = np.array(deproject(*(cd @ [1200.0 * k, 0.0]), (30.0, 20.0)))
        solution = DistortionSolution(name, SHAPE, crpix, cd, crval, pv)
        found.append(Calibration(name, solution, crval, cd))
    return found


def test_focal_plane(saved):
    axes = plotting.plot_focal_plane(detectors(), n_arrows=5, magnification=10)
    saved(axes.figure)
    assert [t.get_text() for t in axes.texts if "-" in t.get_text()] == ["a-1", "b-2"]
    quiver = next(c for c in axes.collections if hasattr(c, "U"))
    assert quiver.U.size == 2 * 25
    np.testing.assert_allclose(quiver.V, 0, atol=1e-6)
    np.testing.assert_allclose(quiver.U[:25], 0, atol=1e-6)
    # arrows stand in thousands of px: those of the outer columns are at 0.8 of the half width
    np.testing.assert_allclose(np.max(quiver.U[25:]), 1e-3 * 4 * 0.8**2, rtol=1e-3)
    offsets = np.array(quiver.get_offsets())
    np.testing.assert_allclose(
        offsets[25:].mean(axis=0) - offsets[:25].mean(axis=0), [1.2, 0], atol=1e-3
    )
    assert "10" in axes.get_title(loc="left")
    # at most, which is in the outermost column of pixels, 499.5 px from the middle
    assert "3.99 px" in axes.get_title(loc="left")
    no_labels_overlap(axes.figure)


def test_focal_plane_of_a_camera_is_the_same():
    from wpdc_gwcs.camera import build_camera

    frames = detectors()
    camera = build_camera("both", [frames], {c.frame: c.solution for c in frames})
    both = [
        next(c for c in plotting.plot_focal_plane(d).collections if hasattr(c, "U"))
        for d in (frames, camera)
    ]
    np.testing.assert_allclose(both[0].U, both[1].U, atol=1e-6)


def test_focal_plane_wants_every_detector_once():
    frames = detectors()
    with pytest.raises(ValueError, match="got 'a-1' twice"):
        plotting.plot_focal_plane([*frames, frames[0]])
    with pytest.raises(ValueError, match="at least one detector"):
        plotting.plot_focal_plane([])
    with pytest.raises(ValueError, match="n_arrows must be at least 1, got 0"):
        plotting.plot_focal_plane(frames, n_arrows=0)


def test_slices_are_means_and_middle_two_thirds(rng, saved):
    table = cloud(rng, 40_000, mag=False)
    shifted = table.copy()
    shifted["dx"] = shifted["dx"] + np.where(table["x"] > 511.5, 0.2, 0.0)
    axes = plotting.plot_slices({"flat": table, "step": shifted}, image_shape=SHAPE)
    figure = saved(axes[0].figure)
    flat, step = axes[0].containers
    np.testing.assert_allclose(flat[0].get_ydata(), 0, atol=2e-3)
    np.testing.assert_allclose(step[0].get_ydata(), [0, 0.2], atol=2e-3)
    # The second slice ends with the detector; both labels stand beside its center.
    np.testing.assert_allclose(
        (flat[0].get_xdata() + step[0].get_xdata()) / 2, [255.5, (511.5 + 999.5) / 2]
    )
    bars = np.array([s[:, 1] for s in flat[2][0].get_segments()])
    np.testing.assert_allclose(np.diff(bars), 0.1, rtol=0.03)
    assert [t.get_text() for t in axes[0].get_legend().get_texts()] == ["flat", "step"]
    no_labels_overlap(figure)
    with pytest.raises(ValueError, match="width must be positive px, got 0"):
        plotting.plot_slices({"flat": table}, image_shape=SHAPE, width=0)
    with pytest.raises(ValueError, match="at least one solution"):
        plotting.plot_slices({}, image_shape=SHAPE)


def test_weights_in_axes_given_and_within_a_radius(rng):
    from matplotlib.figure import Figure

    n = 2000
    x, y = rng.uniform(0, 1000, (2, n))
    distance = np.hypot(x - 500, y - 500)
    dx = rng.normal(0, np.where(distance < 300, 0.1, 1.0))
    s = evaluate(dx, dx)
    result = WeightResult(RadialWeight("w1"), dx, dx, dx, dx, s, s, False, x, y, distance)
    axes = Figure().subplots()
    assert plotting.plot_weights([result], axes) is axes
    inner = result.within(300)
    assert len(inner.dx) == np.sum(distance <= 300)
    assert inner.statistics.sigma_dx < 0.15
    assert f"exp-sqrt: {d80(dx):.2g} px" in axes.get_legend().get_texts()[0].get_text()
    slices = plotting.plot_slices({"w1": result}, image_shape=(1000, 1000))
    assert len(slices[0].containers) == 1
    with pytest.raises(ValueError, match="no star is within 0.001 px"):
        result.within(1e-3)
    with pytest.raises(ValueError, match="component must be one of dx, dy"):
        plotting.plot_weights([result], axes, component="dz")


@pytest.mark.parametrize("n", [2000, 8000])
def test_magnitude_bins(rng, saved, n):
    axes = plotting.plot_magnitude([cloud(rng, n), cloud(rng, n)])
    figure = saved(axes[0].figure)
    bars = axes[0].containers[0]
    np.testing.assert_allclose(bars[0].get_xdata(), [18.25, 18.75, 19.25, 19.75, 20.25, 20.75])
    half = np.array([np.ptp(s[:, 1]) / 2 for s in bars[2][0].get_segments()])
    np.testing.assert_allclose(half, 0.05 * (bars[0].get_xdata() - 17), rtol=0.15)
    assert axes[0].get_xlabel() == "G [mag]"
    no_labels_overlap(figure)


def test_magnitude_needs_magnitudes(rng):
    with pytest.raises(ValueError, match="one of the columns phot_g_mean_mag, magnitude, mag"):
        plotting.plot_magnitude(cloud(rng, 100, mag=False))
    table = cloud(rng, 100)
    table["phot_g_mean_mag"] = np.nan
    with pytest.raises(ValueError, match="no match has a magnitude"):
        plotting.plot_magnitude(table)
    with pytest.raises(ValueError, match="width must be positive, in mag, got -1"):
        plotting.plot_magnitude(cloud(rng, 100), width=-1)


def test_centroids_beside_the_photon_limit(rng, saved):
    table = cloud(rng)
    table["x_err"] = table["y_err"] = 0.05 * (table["phot_g_mean_mag"] - 17)
    curve = np.linspace(18, 21, 20), np.linspace(0.04, 0.16, 20)
    axes = plotting.plot_centroids(table, limit=curve)
    figure = saved(axes[0].figure)
    lines = {line.get_label(): line for line in axes[2].lines}
    np.testing.assert_allclose(lines["photon limit"].get_ydata(), curve[1])
    x, stated = lines["stated error"].get_data()
    np.testing.assert_allclose(stated, 0.05 * (x - 17), rtol=0.02)
    measured = lines[r"$\sigma_{\Delta X}$"].get_ydata()
    np.testing.assert_allclose(measured, stated, rtol=0.15)
    no_labels_overlap(figure)
    # limits of single stars are drawn as medians
    each = np.asarray(table["phot_g_mean_mag"]), 0.5 * np.asarray(table["x_err"])
    axes = plotting.plot_centroids(table, limit=each)
    limit = next(line for line in axes[2].lines if line.get_label() == "photon limit")
    np.testing.assert_allclose(limit.get_ydata(), 0.5 * stated, rtol=0.02)


def sky_table(rng, n=20_000):
    star = np.full(n, 359.99999)
    dec = np.full(n, 60.0)
    d_ra, d_dec = rng.normal(1.0, 5.0, n) / 3.6e6, rng.normal(-2.0, 9.0, n) / 3.6e6
    return Table(
        {"ra": star, "dec": dec, "source_ra": (star + d_ra / 0.5) % 360, "source_dec": dec + d_dec}
    )


def test_sky_offsets_have_gaussians(rng, saved):
    table = sky_table(rng)
    table["source_dec"][:100] += 1.0  # wrong pairs do not move the fit
    axes = plotting.plot_sky_offsets([table, sky_table(rng)], title="ours")
    figure = saved(axes[0].figure)
    found = [float(v) for a in axes[1:] for v in re.findall(r"= (-?[\d.]+)", a.texts[0].get_text())]
    np.testing.assert_allclose(found, [1.0, 5.0, -2.0, 9.0], atol=0.2)
    assert axes[0].texts[0].get_text() == "ours, 40000 stars"
    # the curve lies on the histogram
    x, curve = axes[1].lines[0].get_data()
    assert abs(curve.max() / axes[1].patches[0].get_data().values.max() - 1) < 0.1
    no_labels_overlap(figure)


def test_sky_offsets_refuse_what_they_cannot_draw(rng):
    table = sky_table(rng, 10)
    del table["source_ra"]
    with pytest.raises(ValueError, match="no source_ra"):
        plotting.plot_sky_offsets(table)
    table["source_ra"] = np.nan
    with pytest.raises(ValueError, match="no match has finite offsets"):
        plotting.plot_sky_offsets(table)
