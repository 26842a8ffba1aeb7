"""Pictures of a solution, of stars, of a run, or of the explanation of a frame.

Like `wpdc_gwcs.plotting`, every function returns a new `matplotlib.figure.Figure` and touches
nothing else.
"""

import numpy as np

from wpdc_gwcs.columns import numbers_or_nan
from wpdc_gwcs.counts import counted
from wpdc_gwcs.selection import select_sources

__all__ = [
    "draw_camera",
    "draw_catalog",
    "draw_explanation",
    "draw_map",
    "draw_solution",
    "draw_sources",
    "draw_summary",
    "draw_truth",
]

# Okabe and Ito's colors, distinguishable with any color vision.
_BLUE, _ORANGE, _GREEN, _GREY = "#0072B2", "#D55E00", "#009E73", "#999999"
_STATES = {"solved": _BLUE, "degraded": "#E69F00", "failed": _ORANGE}
_ARROWS = 15
# Space between the end of an arrow and the axes, as a fraction of the detector.
_EDGE = 0.02
# More labels of right ascension would overlap.
_MOST_LABELS = 4
# More pixels than this along a side are more than the picture has.
_MOST_PIXELS = 1000


def draw_solution(solution, sigma=None):
    """Draw the distortion of a detector and its uncertainty.

    Parameters
    ----------
    solution : DistortionSolution
        Solution of the detector.
    sigma : (3, n, n) ndarray, optional
        Uncertainty of a frame instead of that of the solution.

    Returns
    -------
    `matplotlib.figure.Figure`
        Arrows, and a map of the uncertainty if it is known.
    """
    sigma = solution.table_sigma if sigma is None else sigma
    ny, nx = solution.image_shape
    figure, panels = _new_figure(1 if sigma is None else 2)
    x, y = np.meshgrid(np.linspace(0, nx - 1, _ARROWS), np.linspace(0, ny - 1, _ARROWS))
    u, v = solution.undistort(x.ravel(), y.ravel())
    _arrows(panels[0], x.ravel(), y.ravel(), u - x.ravel(), v - y.ravel(), (ny, nx), "distortion")
    if sigma is not None:
        extent = (-0.5, nx - 0.5, -0.5, ny - 0.5)
        image = panels[1].imshow(np.hypot(sigma[0], sigma[1]), origin="lower", extent=extent)
        figure.colorbar(image, ax=panels[1], label="uncertainty [px]", shrink=0.8)
        _detector(panels[1], (ny, nx), "uncertainty of the map")
    return figure


def draw_camera(camera):
    """Draw the focal plane of a camera: the outline, name and distortion of each detector.

    Parameters
    ----------
    camera : Camera
        The camera.

    Returns
    -------
    `matplotlib.figure.Figure`
        The focal plane.
    """
    return _focal_plane(camera)


def draw_truth(truths):
    """Draw the true distortion of the detectors of a simulation in the focal plane.

    Parameters
    ----------
    truths : list of FrameTruth
        The truth about the frames; one exposure of each detector is drawn.

    Returns
    -------
    `matplotlib.figure.Figure`
        The focal plane.
    """
    # The detectors of one exposure belong together; a single detector has no exposure.
    first = [t for t in truths if t.exposure == truths[0].exposure]
    return _focal_plane({t.detector: _TrueFrame(t) for t in reversed(first)}.values())


def draw_map(pixels, title):
    """Draw the pixels of a weight map or a mask.

    Parameters
    ----------
    pixels : (ny, nx) ndarray
        The map.
    title : str
        Title of the picture.

    Returns
    -------
    `matplotlib.figure.Figure`
        The pixels, thinned out if there are more than the picture has.
    """
    ny, nx = pixels.shape
    figure, (panel,) = _new_figure(1)
    step = max(1, max(pixels.shape) // _MOST_PIXELS)
    extent = (-0.5, nx - 0.5, -0.5, ny - 0.5)
    image = panel.imshow(pixels[::step, ::step], origin="lower", extent=extent)
    figure.colorbar(image, ax=panel, shrink=0.8)
    _detector(panel, (ny, nx), title)
    return figure


def draw_sources(sources, usable=None, image_shape=None):
    """Draw the positions of sources on a detector, and which of them are used.

    Parameters
    ----------
    sources : `~astropy.table.Table`
        Table with ``x`` and ``y``.
    usable : (N,) ndarray of bool, optional
        Mask of the used ones; by default those that a run without options uses.
    image_shape : (int, int), optional
        Shape of the detector.

    Returns
    -------
    `matplotlib.figure.Figure`
        The positions.
    """
    figure, (panel,) = _new_figure(1)
    _sources(panel, sources, usable, image_shape)
    return figure


def draw_catalog(stars):
    """Draw the positions of the stars of a catalog, and the number per magnitude.

    Parameters
    ----------
    stars : `~astropy.table.Table`
        As returned by `read_catalog`.

    Returns
    -------
    `matplotlib.figure.Figure`
        A map, East to the left, and a histogram if there are magnitudes.
    """
    mag = numbers_or_nan(stars, "phot_g_mean_mag")
    mag = mag[np.isfinite(mag)]
    figure, (left, *others) = _new_figure(2 if len(mag) else 1)
    ra, dec = (np.asarray(stars[name], float) for name in ("ra", "dec"))
    # Relative to the center, so that RA 0 does not split the map.
    middle = np.degrees(np.angle(np.exp(1j * np.radians(ra)).mean())) % 360
    x = middle + (ra - middle + 180) % 360 - 180
    # More points would only make it black.
    step = max(1, len(x) // 20_000)
    left.plot(x[::step], dec[::step], ".", ms=2, color=_BLUE, alpha=0.6)
    left.invert_xaxis()
    left.ticklabel_format(useOffset=False)
    # Labels with all digits of a small field are wide.
    left.locator_params(axis="x", nbins=_MOST_LABELS)
    stretch = max(np.cos(np.radians(np.clip(np.median(dec), -85, 85))), 0.1)
    left.set(xlabel="RA [deg]", ylabel="Dec [deg]", aspect=1 / stretch, title=f"{len(x)} stars")
    for right in others:
        low, high = np.floor(mag.min() * 2) / 2, np.ceil(mag.max() * 2) / 2
        right.hist(mag, bins=np.arange(low, max(high, low + 0.5) + 0.25, 0.5), color=_BLUE)
        right.set_yscale("log")
        right.set(xlabel="magnitude", ylabel="stars per half magnitude")
    return figure


def draw_summary(summary):
    """Draw the scatter of the residuals of each frame of a run, and which frames failed.

    Parameters
    ----------
    summary : `~astropy.table.Table`
        One row for each frame.

    Returns
    -------
    `matplotlib.figure.Figure`
        A point for each frame, in their order; a line from bottom to top for a frame without
        residuals, such as one that failed.
    """
    figure, (panel,) = _new_figure(1, width=9.0)
    status = np.array([str(s) for s in summary["status"]])
    sigma = np.hypot(numbers_or_nan(summary, "sigma_dx"), numbers_or_nan(summary, "sigma_dy"))
    order = np.arange(len(summary)) + 1
    for state, color in _STATES.items():
        here = status == state
        if here.any():
            # A failed frame has no residuals, and so no place on the axis of their scatter.
            known = here & np.isfinite(sigma) & (state != "failed")
            label = f"{here.sum()} {state}"
            if known.any():
                panel.plot(order[known], sigma[known] / np.sqrt(2), "o", color=color, label=label)
                label = None
            across = panel.get_xaxis_transform()
            rest = order[here & ~known]
            if len(rest):
                panel.vlines(rest, 0, 1, color=color, ls="--", transform=across, label=label)
    panel.set(xlabel="frame", ylabel="scatter of the residuals [px]")
    panel.set(xlim=(0.3, len(summary) + 0.7))
    known = sigma[(status != "failed") & np.isfinite(sigma)]
    if len(known) and known.max() > 0:
        panel.set_ylim(0, 1.1 * known.max() / np.sqrt(2))
    else:
        panel.set_yticks([])
    if len(summary) <= 30:
        names = [str(name) for name in summary["frame"]]
        panel.set_xticks(order, names, rotation=60, ha="right", fontsize=8)
    panel.legend()
    return figure


def draw_explanation(told):
    """Draw the stages of a frame: its sources, the reference stars, the match, the residuals.

    Parameters
    ----------
    told : Explanation
        As returned by `explain_frame`.

    Returns
    -------
    `matplotlib.figure.Figure`
        Four panels; stages that the frame did not reach are empty, with the reason.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.5, 9.6), layout="constrained")
    panels = figure.subplots(2, 2).ravel()
    shape = told.frame.image_shape
    figure.suptitle(f"{told.frame.name}: {told.status}")
    if told.sources is not None:
        _sources(panels[0], told.sources, told.usable, shape)
    if told.references is not None:
        _reference(panels[1], told)
        _match(panels[2], told)
    if told.calibration is not None:
        _residuals(panels[3], told.calibration.matches, shape)
    for panel, stage in zip(panels, ("sources", "catalog", "match", "solution"), strict=True):
        if not panel.has_data():
            failed = next((s for s in told.stages if not s.went_well), None)
            why = "" if failed is None else f": ends with the {failed.name}"
            panel.set_axis_off()
            panel.text(0.5, 0.5, f"no {stage}{why}", ha="center", transform=panel.transAxes)
    return figure


def _sources(panel, sources, usable, shape):
    x, y = numbers_or_nan(sources, "x"), numbers_or_nan(sources, "y")
    if usable is None:
        usable = select_sources(sources, image_shape=shape)
    if shape is None:
        shape = (int(np.nanmax(y)) + 1, int(np.nanmax(x)) + 1)
    if not usable.all():
        out = f"{np.sum(~usable)} left out"
        panel.plot(x[~usable], y[~usable], "x", ms=4, color=_ORANGE, label=out)
    label = f"{np.sum(usable)} used"
    panel.plot(x[usable], y[usable], "o", ms=3, mfc="none", color=_BLUE, label=label)
    _detector(panel, shape, counted(len(x), "source"))
    # Beside the title, where it hides no source.
    place = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.2}
    panel.legend(**place, ncols=2, frameon=False, fontsize=8, columnspacing=1.0)


def _reference(panel, told):
    from matplotlib.patches import Rectangle

    ny, nx = told.frame.image_shape
    x, y = told.references.T
    panel.plot(x, y, ".", ms=2, color=_GREY, label=f"{len(x)} reference stars in reach")
    starts = told.starts[np.isfinite(told.starts).all(axis=1)]
    panel.plot(*starts.T, ".", ms=2, color=_BLUE, label="sources, by the header")
    panel.add_patch(Rectangle((0, 0), nx, ny, fill=False, color=_ORANGE, lw=2))
    panel.set(aspect="equal", xlabel="x [px]", ylabel="y [px]", title="catalog and frame")
    panel.legend(loc="upper right", framealpha=0.9, fontsize=8)


def _match(panel, told):
    if told.match is not None:
        i, j = told.match.pairs
        x, y = (np.asarray(told.match.sources[n], float)[i] for n in ("x", "y"))
        start = told.match.start
        sky = told.match.wcs.pixel_to_world_values(x, y)
        here = np.column_stack(start.pixels(*(np.asarray(c, float) for c in sky)))
        stars = told.match.reference[j]
        there = start.pixels(np.asarray(stars["ra"], float), np.asarray(stars["dec"], float))
        step = np.column_stack(there) - here
        _arrows(panel, x, y, *step.T, told.frame.image_shape, f"{len(i)} pairs: header to catalog")
        return
    # If sources and stars are the same, one displacement is more frequent than others.
    starts = told.starts[np.isfinite(told.starts).all(axis=1)][:400]
    reach = 0.2 * max(told.frame.image_shape) + 500
    difference = (told.references[None, :, :] - starts[:, None, :]).reshape(-1, 2)
    difference = difference[(np.abs(difference) < reach).all(axis=1)]
    counts, *_ = np.histogram2d(*difference.T, bins=120, range=[[-reach, reach]] * 2)
    panel.imshow(counts.T, origin="lower", extent=[-reach, reach, -reach, reach], cmap="viridis")
    expected = max(counts.mean(), 1e-9)
    title = f"no match: displacements (most: {counts.max():.0f}, mean: {expected:.1f})"
    panel.set(xlabel="shift in x [px]", ylabel="shift in y [px]", title=title)


def _residuals(panel, matches, shape):
    used = np.asarray(matches["used"], bool)
    x, y, dx, dy = (numbers_or_nan(matches, name) for name in ("x", "y", "dx", "dy"))
    rest = (~used).sum()
    panel.plot(x[~used], y[~used], "x", ms=4, color=_ORANGE)
    title = f"residuals of {used.sum()} stars ({rest} not used)"
    _arrows(panel, x[used], y[used], dx[used], dy[used], shape, title)


def _arrows(panel, x, y, dx, dy, shape, title):
    length = np.hypot(dx, dy)
    typical = np.nanpercentile(length, 90) if np.isfinite(length).any() else 0.0
    key = 10.0 ** np.floor(np.log10(max(typical, 1e-6)))
    key *= next(f for f in (5, 2, 1) if f * key <= typical or f == 1)
    # Long arrows are a twelfth of the detector, so that they do not hide each other; the longest
    # one is at most a quarter.
    longest = np.nanmax(length) if np.isfinite(length).any() else 0.0
    scale = max(12 * max(typical, key), 4 * longest) / max(shape)
    options = {"angles": "xy", "scale_units": "xy", "width": 0.003, "color": _BLUE}
    arrows = panel.quiver(x, y, dx, dy, scale=scale, **options)
    panel.quiverkey(arrows, 0.82, 1.03, key, f"{key:g} px", labelpos="E", coordinates="axes")
    _detector(panel, shape, title)
    # The axes hold all arrows, which may lead out of the detector.
    for ends, (low, high), limit in (
        (x + dx / scale, panel.get_xlim(), panel.set_xlim),
        (y + dy / scale, panel.get_ylim(), panel.set_ylim),
    ):
        ends, edge = ends[np.isfinite(ends)], _EDGE * max(shape)
        if len(ends):
            limit(min(low, ends.min() - edge), max(high, ends.max() + edge))


def _detector(panel, shape, title):
    ny, nx = shape
    panel.set(xlim=(-0.06 * nx, 1.06 * nx), ylim=(-0.06 * ny, 1.06 * ny), aspect="equal")
    panel.set(xlabel="x [px]", ylabel="y [px]")
    panel.set_title(title, loc="left", fontsize=10)


def _focal_plane(detectors):
    from wpdc_gwcs.plotting import plot_focal_plane

    return plot_focal_plane(detectors).figure


class _TrueFrame:
    """The truth about a frame in the form of a calibration."""

    def __init__(self, truth):
        linear = truth.linear_wcs.wcs
        self.solution = self
        self.detector, self.image_shape = truth.detector, truth.image_shape
        self.crpix, self.crval, self.cd = linear.crpix - 1, linear.crval, linear.cd
        self.undistort = truth.distortion.undistort


def _new_figure(n, width=None):
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width or 5.2 * n, 4.8), layout="constrained")
    return figure, np.atleast_1d(figure.subplots(1, n))
