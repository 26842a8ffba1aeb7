"""Draw the stages of the match on a real frame, for docs/explanation/matching.rst.

python docs/figures/matching.py FRAME CATALOG docs/images

The pictures of the page show CFHT/WIRCam frame 1325839p (one sensor, J) and the Gaia DR2 stars of
the same sky, with a header that is wrong on purpose by 15 arcsec and 1 degree.
"""

import argparse
import io
from pathlib import Path

import matplotlib as mpl
import numpy as np
from astropy import units as u
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from PIL import Image

from wpdc_gwcs.calibration import measure_sources
from wpdc_gwcs.calibration.start import detector_center, linear_wcs, sky_of
from wpdc_gwcs.catalogs import propagate, read_catalog
from wpdc_gwcs.io import read_frames
from wpdc_gwcs.matching import MatchOptions, match_planes, pair_nearest, select_sources
from wpdc_gwcs.matching._features import (
    N_NEIGHBORS,
    density_ratio_map,
    neighbor_pattern,
)
from wpdc_gwcs.matching._growth import fit_pairs, grow_locally, grow_once
from wpdc_gwcs.matching._hypotheses import count_neighbors, find_groups, first_pairs
from wpdc_gwcs.matching._problem import Stars, prepare_problem

# Okabe and Ito's colors, told apart with any color vision.
BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#999999"
SHIFT, TURN = np.array([9.0, 12.0]) / 3600, 1.0  # deg
N_ANCHORS = 49
CLIP = 5.0  # as in the package: radius in units of the scatter


class Stages:
    """The stages of one match, called one after the other."""

    def __init__(self, frame, catalog):
        self.shape = frame.image_shape
        wcs = frame.wcs.deepcopy()
        c, s = np.cos(np.deg2rad(TURN)), np.sin(np.deg2rad(TURN))
        wcs.wcs.cd = wcs.wcs.cd @ [[c, -s], [s, c]]
        wcs.wcs.crval = wcs.wcs.crval + SHIFT / [np.cos(np.deg2rad(wcs.wcs.crval[1])), 1]
        self.image = frame.load_image()
        self.all = measure_sources(frame)
        self.use = select_sources(self.all)
        x, y = (np.asarray(u.Quantity(self.all[k]).value, float) for k in "xy")
        self.all_x, self.all_y = x, y
        reference = propagate(catalog, frame.epoch)
        start = linear_wcs(wcs, detector_center(self.shape))
        self.xs, self.ys = start.pixels(*sky_of(wcs, x[self.use], y[self.use]))
        self.xr, self.yr = start.pixels(np.asarray(reference["ra"]), np.asarray(reference["dec"]))
        keep = np.isfinite(self.xr) & (np.hypot(self.xr - 1024, self.yr - 1024) < 4000)
        self.xr, self.yr = self.xr[keep], self.yr[keep]
        options = {
            "image_shape": self.shape,
            "x_err": np.asarray(self.all["x_err"], float)[self.use],
            "y_err": np.asarray(self.all["y_err"], float)[self.use],
        }
        planes = self.xs, self.ys, self.xr, self.yr
        self.problem = prepare_problem(*planes, **options, options=MatchOptions())
        self.i, self.j, self.diagnostics = match_planes(*planes, **options)
        self.truth = dict(
            zip(
                np.searchsorted(self.problem.source_rows, self.i),
                np.searchsorted(self.problem.reference_rows, self.j),
                strict=True,
            )
        )
        self.sources = Stars.build(self.problem.sources)
        self.reference = self.problem.stars
        self.n_near = count_neighbors(self.problem, self.sources, self.reference, N_NEIGHBORS)
        self.hypotheses, self.groups = find_groups(
            self.problem, self.sources, self.reference, None, N_ANCHORS, N_NEIGHBORS, 10**8
        )

    def is_right(self, i, j):
        """Whether pairs are those of the final match."""
        return np.array([self.truth.get(a) == b for a, b in zip(i, j, strict=True)])


def new_figure(n, width=9.6, height=None, **options):
    """Figure with n panels in a row."""
    figure = Figure(figsize=(width, height or width / n), layout="constrained")
    panels = figure.subplots(1, n, **options)
    return figure, np.atleast_1d(panels)


def frame_axes(panel, shape, margin=0.0):
    """Axes of the detector in pixels, in equal scale."""
    ny, nx = shape
    panel.set(xlim=(-margin, nx + margin), ylim=(-margin, ny + margin), aspect="equal")
    panel.set(xlabel="x [px]", ylabel="y [px]")


def draw_preparation(stages):
    figure, (left, right) = new_figure(2)
    low, high = np.percentile(stages.image, [20, 99.5])
    left.imshow(stages.image, cmap="gray_r", vmin=low, vmax=high, origin="lower")
    for mask, color, marker, text in (
        (stages.use, BLUE, "o", "take part"),
        (~stages.use, ORANGE, "x", "flagged, elongated or faint"),
    ):
        face = {"facecolors": "none"} if marker == "o" else {}
        left.scatter(
            stages.all_x[mask], stages.all_y[mask], s=40, marker=marker, edgecolors=color,
            color=color if marker == "x" else None, label=f"{text}", **face,
        )  # fmt: skip
    left.set(xlim=(700, 1300), ylim=(700, 1300), xlabel="x [px]", ylabel="y [px]")
    left.set_title(f"{stages.use.sum()} of {len(stages.use)} sources (a part of the frame)")
    left.legend(loc="upper right", framealpha=0.95)
    limits = stages.problem.limits
    reach = limits.half_diagonal + limits.reach(limits.half_diagonal)
    points = stages.reference.points
    # every fifth, or the picture would be a blue disc
    right.plot(stages.xr[::5], stages.yr[::5], ".", ms=1.5, color=GREY)
    right.plot(*points[::5].T, ".", ms=1.5, color=BLUE)
    right.add_patch(Circle((1024, 1024), reach, fill=False, color="k", lw=2))
    right.add_patch(Rectangle((0, 0), *stages.shape[::-1], fill=False, color=ORANGE, lw=3))
    frame_axes(right, stages.shape, 1700)
    box = {"facecolor": "w", "edgecolor": ORANGE, "pad": 2}
    right.text(1024, 2048, "frame", ha="center", va="center", bbox=box)
    right.set_title(f"{len(points)} reference stars in reach (circle)")
    return figure


def draw_density(stages):
    figure, panels = new_figure(3, height=2.9)
    ratio, x_edges, y_edges = density_ratio_map(
        *stages.sources.points.T, *stages.reference.points.T, stages.shape
    )
    counts = [
        np.histogram2d(y, x, bins=(y_edges, x_edges))[0]
        for x, y in (stages.sources.points.T, stages.reference.points.T)
    ]
    for panel, values, title, form in zip(
        panels, (*counts, ratio), ("sources", "reference stars", "ratio"), ("", "", ".2f"),
        strict=True,
    ):  # fmt: skip
        limits = {"vmin": 0} | ({} if form else {"vmax": np.max(counts)})
        mesh = panel.pcolormesh(x_edges, y_edges, values, cmap="cividis", **limits)
        figure.colorbar(mesh, ax=panel, shrink=0.8)
        frame_axes(panel, stages.shape)
        panel.set_title(f"{title}: {np.min(values):.3g} to {np.max(values):.3g}")
    for panel in panels[1:]:
        panel.set_ylabel("")
    return figure


def draw_features(stages):
    """One star, its right and a wrong candidate, and how their neighbors differ."""
    problem = stages.problem
    h = stages.hypotheses
    right_ones = np.flatnonzero(stages.is_right(h.source, h.reference))
    pick = right_ones[0]
    star, partner = h.source[pick], h.reference[pick]
    others = np.flatnonzero((h.source == star) & (h.reference != partner))
    figure = Figure(figsize=(9.6, 6.4), layout="constrained")
    panels = figure.subplots(2, 3)
    lists = [
        ("source", stages.sources, star, BLUE),
        ("right star", stages.reference, partner, GREEN),
        ("wrong star", stages.reference, h.reference[others[0]], ORANGE),
    ]
    patterns = []
    for panel, (title, stars, row, color) in zip(panels[0], lists, strict=True):
        x, y = stars.points[row]
        n = stages.n_near[stars is stages.reference]
        log_d, angle, neighbor = neighbor_pattern(stars.tree, [row], n)
        patterns.append((log_d[0], angle[0]))
        panel.plot(*stars.points.T, ".", ms=4, color=GREY)
        for other in stars.points[neighbor[0]]:
            panel.plot([x, other[0]], [y, other[1]], "-", lw=1, color=color)
        panel.plot(*stars.points[neighbor[0]].T, "o", ms=6, color=color)
        panel.plot(x, y, "*", ms=17, color=color, mec="k")
        panel.set(xlim=(x - 100, x + 100), ylim=(y - 100, y + 100), aspect="equal", xlabel="x [px]")
        panel.set_title(f"{title}, {n} neighbors")
    panels[0, 0].set_ylabel("y [px]")
    panel = panels[1, 0]
    for (log_d, angle), (title, _, _, color), marker in zip(
        patterns[:2], lists[:2], "os", strict=True
    ):
        panel.plot(np.rad2deg(angle), np.exp(log_d), marker, ms=8, mfc="none", mew=2, color=color,
                   label=title)  # fmt: skip
    panel.set(xlabel=r"$\theta$ [deg]", ylabel="d [px, log scale]", yscale="log", ylim=(4, 130))
    panel.set_yticks([5, 10, 20, 50, 100], ["5", "10", "20", "50", "100"], minor=False)
    panel.set_yticks([], minor=True)
    panel.set_title("patterns of both")
    panel.legend(loc="lower left")
    for panel, candidate, (title, _, _, color) in zip(
        panels[1, 1:], (pick, others[0]), lists[1:], strict=True
    ):
        log_d, angle = patterns[1 if candidate == pick else 2]
        d_log = log_d[None] - patterns[0][0][:, None]
        d_angle = np.rad2deg((angle[None] - patterns[0][1][:, None] + np.pi) % (2 * np.pi) - np.pi)
        panel.plot(d_angle, d_log, "o", ms=6, mfc="none", color=color)
        half = 0.5 * h.width[candidate]
        center = np.rad2deg(h.rotation[candidate]), h.log_scale[candidate]
        panel.add_patch(
            Rectangle(
                (center[0] - np.rad2deg(half), center[1] - half), np.rad2deg(2 * half), 2 * half,
                fill=False, lw=2, color="k",
            )
        )  # fmt: skip
        limit = problem.limits.max_scale + problem.limits.gradient
        turn = problem.limits.max_rotation + np.rad2deg(problem.limits.gradient)
        panel.set(xlim=(-turn, turn), ylim=(-limit, limit))
        panel.set(xlabel=r"difference of $\theta$ [deg]", ylabel="difference of log d")
        panel.set_title(
            f"{title}: {h.count[candidate]:.0f} agree\n({h.expected[candidate]:.1g} by chance)"
        )
    return figure


def draw_votes(stages):
    figure, (left, right) = new_figure(2)
    h = stages.hypotheses
    good = stages.is_right(h.source, h.reference)
    stars = np.unique(h.source)
    order = np.argsort([-h.surprise[h.source == s].max() for s in stars])
    place = np.empty(len(stars), int)
    place[order] = np.arange(len(stars))
    where = place[np.searchsorted(stars, h.source)]
    left.plot(where[~good], h.surprise[~good], "x", color=ORANGE, label="other candidates")
    left.plot(where[good], h.surprise[good], "o", color=BLUE, label="right candidates")
    left.set(xlabel="star looked up", ylabel=r"surprise ($-\log_{10}$ of chance)")
    left.set_title(f"{len(h)} candidates for {len(stars)} stars")
    left.legend()
    _, rows = stages.groups[0]
    rest = np.setdiff1d(np.arange(len(h)), rows)
    for part, color, width in ((rest, ORANGE, 0.003), (rows, BLUE, 0.006)):
        at = stages.sources.points[h.source[part]]
        step = stages.reference.points[h.reference[part]] - at
        right.quiver(*at.T, *step.T, color=color, angles="xy", scale_units="xy", scale=1,
                     width=width, alpha=0.9 if part is rows else 0.35)  # fmt: skip
    frame_axes(right, stages.shape, 150)
    right.set_title(f"{len(rows)} candidates tell one story (blue)")
    return figure


def first_fit(stages):
    """Seed of few hypotheses with the fit of its first pairs, in which outliers are clipped."""
    rows = stages.groups[0][1]
    pairs = next(
        first_pairs(
            stages.sources, stages.reference, stages.hypotheses.take(rows), stages.n_near[0]
        )
    )
    fit = fit_pairs(
        stages.problem, stages.sources.points[pairs[0]], stages.reference.points[pairs[1]]
    )
    return pairs, fit


def draw_clipping(stages):
    figure, (left, right) = new_figure(2, height=4.4)
    (i, j), fit = first_fit(stages)
    mapped = np.column_stack(fit.mapping(*stages.sources.points[i].T))
    residual = mapped - stages.reference.points[j]
    good = stages.is_right(i, j)
    limit = CLIP * fit.scatter
    for mask, color, marker, text in (
        (good, BLUE, "o", "right pairs"),
        (~good, ORANGE, "x", "wrong pairs"),
    ):
        left.plot(*residual[mask].T, marker, ms=5, mfc="none", color=color,
                  label=f"{mask.sum()} {text}")  # fmt: skip
    left.add_patch(Circle((0, 0), limit, fill=False, color="k", lw=2))
    left.set(xlim=(-6 * limit, 6 * limit), ylim=(-6 * limit, 6 * limit), aspect="equal")
    left.set(xlabel="residual in x [px]", ylabel="residual in y [px]")
    left.set_title(f"clipped outside of {limit:.2g} px")
    left.legend(loc="upper right")
    length = np.hypot(*residual.T)
    bins = np.geomspace(0.01, max(30, length.max()), 40)
    right.hist([length[good], length[~good]], bins=bins, stacked=True, color=[BLUE, ORANGE])
    right.axvline(np.median(length), color=GREEN, lw=2, ls="--", label="median")
    right.axvline(limit, color="k", lw=2, label="5 robust standard deviations")
    right.set(xscale="log", xlabel="residual [px]", ylabel="pairs")
    right.set_title(f"order {fit.mapping.order}, scatter {fit.scatter:.2g} px, "
                    f"{fit.used.sum()} of {len(i)} used")  # fmt: skip
    right.legend()
    return figure


def draw_growth(stages):
    """From the first pairs of a single star to the frame, round by round, and the fine step."""
    problem = stages.problem
    h = stages.hypotheses
    at = np.flatnonzero(stages.is_right(h.source, h.reference))[:1]
    *_, pairs = first_pairs(stages.sources, stages.reference, h.take(at), stages.n_near[0])
    rounds = [(None, pairs, None, None)]
    points, limit = stages.sources.points, stages.sources.limit
    while len(rounds) < 25:
        step = grow_once(
            problem, points, limit, stages.reference, rounds[-1][1], problem.options.max_order
        )
        rounds.append(step)
        if len(rounds) > 2 and len(step[1][0]) == len(rounds[-2][1][0]):
            break
    fit, local, fine, _ = grow_locally(problem, points, limit, rounds[-1][0], rounds[-1][1])
    shown = [0, 1, 2, len(rounds) - 1]
    figure = Figure(figsize=(9.6, 6.4), layout="constrained")
    panels = figure.subplots(2, 3).ravel()
    for panel, n in zip(panels[[0, 1, 3, 4]], shown, strict=True):
        i, j = rounds[n][1]
        good = stages.is_right(i, j)
        panel.plot(*points.T, ".", ms=1, color=GREY)
        panel.plot(*points[i[good]].T, ".", ms=4, color=BLUE)
        panel.plot(*points[i[~good]].T, "x", ms=6, color=ORANGE)
        frame_axes(panel, stages.shape)
        text = "start" if n == 0 else f"round {n}, order {rounds[n][0].mapping.order}"
        panel.set_title(f"{text}: {len(i)} pairs")
    radius = rounds[1][3]
    mesh = panels[2].scatter(*points.T, c=np.where(radius > 0, radius, np.nan), s=3, cmap="cividis",
                             norm="log")  # fmt: skip
    bar = figure.colorbar(mesh, ax=panels[2], label="px", shrink=0.7)
    bar.set_ticks([0.5, 1, 2, 5], labels=["0.5", "1", "2", "5"])
    bar.ax.minorticks_off()
    frame_axes(panels[2], stages.shape)
    panels[2].set_title("radius after round 1")
    before = rounds[-1][0].scatter
    residual = stages.reference.points[fine[1]] - np.column_stack(fit.mapping(*points[fine[0]].T))
    if local is not None:
        residual = residual - local(points[fine[0]], leave_out=True)[0]
    old = rounds[-1][1]
    left = stages.reference.points[old[1]] - np.column_stack(
        rounds[-1][0].mapping(*points[old[0]].T)
    )
    bins = np.linspace(0, 6 * before, 50)
    panels[5].hist(np.hypot(*left.T), bins=bins, histtype="step", lw=2, color=ORANGE,
                   label=f"grown: {len(old[0])}")  # fmt: skip
    panels[5].hist(np.hypot(*residual.T), bins=bins, histtype="step", lw=2, color=BLUE,
                   label=f"fine: {len(fine[0])}")  # fmt: skip
    panels[5].set(xlabel="residual [px]", ylabel="pairs", title="the fine step")
    panels[5].set_box_aspect(1)
    panels[5].legend()
    return figure


def draw_evidence(stages):
    figure, panels = new_figure(3, height=3.7)
    d = stages.diagnostics
    xs, ys = stages.xs[stages.i], stages.ys[stages.i]
    every = slice(None, None, max(1, len(xs) // 250))
    panels[0].quiver(
        xs[every], ys[every], (stages.xr[stages.j] - xs)[every], (stages.yr[stages.j] - ys)[every],
        color=BLUE, angles="xy", scale_units="xy", scale=1, width=0.004,
    )  # fmt: skip
    frame_axes(panels[0], stages.shape, 80)
    panels[0].set_title(f"{d.n_pairs} pairs, every {every.step}th drawn")
    mapped_x, mapped_y = d.mapping(stages.xs, stages.ys)
    shifts = np.geomspace(0.01, 100, 60)
    for angle, color in ((0.0, BLUE), (2.0, ORANGE)):
        count = [
            len(pair_nearest(mapped_x + s * np.cos(angle), mapped_y + s * np.sin(angle),
                             stages.xr, stages.yr, d.radius)[0])
            for s in shifts
        ]  # fmt: skip
        panels[1].plot(shifts, count, ".-", color=color, label=f"towards {np.rad2deg(angle):.0f}°")
    panels[1].axhline(d.expected_by_chance, color="k", ls="--", lw=1.5, label="chance")
    panels[1].set(xscale="log", yscale="symlog", ylim=(0, 2 * d.n_pairs))
    panels[1].set_box_aspect(1)
    panels[1].set(xlabel="shift of the sources [px]", ylabel="pairs")
    panels[1].set_title(f"{d.n_pairs} against {d.expected_by_chance:.1f}: {d.significance:.0f} σ")
    panels[1].legend(loc="lower left", bbox_to_anchor=(0, 0.3))
    share = [a.n_pairs / a.expected for a in d.areas]
    mesh = panels[2].scatter(
        [a.x for a in d.areas], [a.y for a in d.areas], c=share, s=90, cmap="cividis", vmin=0.6,
        vmax=1.2, edgecolors=["k" if a.accepted else ORANGE for a in d.areas],
    )  # fmt: skip
    area = d.areas[len(d.areas) // 2 + 4]
    panels[2].add_patch(Circle((area.x, area.y), area.radius, fill=False, color="k", lw=1.5))
    figure.colorbar(mesh, ax=panels[2], shrink=0.75)
    frame_axes(panels[2], stages.shape, 80)
    panels[2].set_title(f"pairs / expected in {len(d.areas)} circles")
    return figure


PICTURES = {
    "preparation": draw_preparation,
    "density": draw_density,
    "features": draw_features,
    "votes": draw_votes,
    "clipping": draw_clipping,
    "growth": draw_growth,
    "evidence": draw_evidence,
}


def save(figure, path):
    """Write a small PNG: 256 colors are plenty for lines, points and one color scale."""
    full = io.BytesIO()
    figure.savefig(full, dpi=90)
    few = (
        Image.open(full)
        .convert("RGB")
        .quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    )
    few.save(path, optimize=True)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("frame", help="image with a header of the right sky")
    parser.add_argument("catalog", help="reference catalog")
    parser.add_argument("folder", type=Path, help="where the pictures go")
    parser.add_argument("--only", nargs="+", choices=PICTURES, default=PICTURES)
    a = parser.parse_args()
    stages = Stages(read_frames(a.frame)[0], read_catalog(a.catalog))
    print({k: v for k, v in stages.diagnostics.to_dict().items() if k != "areas"})
    for name in a.only:
        path = a.folder / f"matching_{name}.png"
        with mpl.rc_context({"axes.titlesize": 11}):
            save(PICTURES[name](stages), path)
        print(path, path.stat().st_size)


if __name__ == "__main__":
    main()
