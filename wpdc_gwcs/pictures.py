"""Pictures of a solution, of stars, of a run, or of the explanation of a frame.

Like `wpdc_gwcs.plotting`, every function returns a new `matplotlib.figure.Figure` and touches
nothing else.
"""

import numpy as np

from wpdc_gwcs.columns import numbers_or_nan

__all__ = ["draw_catalog", "draw_explanation", "draw_solution", "draw_sources", "draw_summary"]

# Okabe and Ito's colors, distinguishable with any color vision.
_BLUE, _ORANGE, _GREEN, _GREY = "#0072B2", "#D55E00", "#009E73", "#999999"
_STATES = {"solved": _BLUE, "degraded": "#E69F00", "failed": _ORANGE}
_ARROWS = 15


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
        figure.colorbar(image, ax=panels[1], label="px", shrink=0.8)
        _detector(panels[1], (ny, nx), "uncertainty of the map")
    return figure


def draw_sources(sources, usable=None, image_shape=None):
    """Draw the positions of sources on a detector, and which of them are used.

    Parameters
    ----------
    sources : `~astropy.table.Table`
        Table with ``x`` and ``y``.
    usable : (N,) ndarray of bool, optional
        Mask of the used ones; by default those without flags.
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
        A map, East to the left, and a histogram.
    """
    figure, (left, right) = _new_figure(2)
    ra, dec = (np.asarray(stars[name], float) for name in ("ra", "dec"))
    # Relative to the center, so that RA 0 does not split the map.
    middle = np.degrees(np.angle(np.exp(1j * np.radians(ra)).mean())) % 360
    x = middle + (ra - middle + 180) % 360 - 180
    # More points would only make it black.
    step = max(1, len(x) // 20_000)
    left.plot(x[::step], dec[::step], ".", ms=2, color=_BLUE, alpha=0.6)
    left.invert_xaxis()
    left.ticklabel_format(useOffset=False)
    stretch = max(np.cos(np.radians(np.clip(np.median(dec), -85, 85))), 0.1)
    left.set(xlabel="RA (deg)", ylabel="Dec (deg)", aspect=1 / stretch, title=f"{len(x)} stars")
    mag = numbers_or_nan(stars, "phot_g_mean_mag")
    mag = mag[np.isfinite(mag)]
    if len(mag):
        low, high = np.floor(mag.min() * 2) / 2, np.ceil(mag.max() * 2) / 2
        right.hist(mag, bins=np.arange(low, high + 0.51, 0.5), color=_BLUE)
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
        A point for each frame, in their order.
    """
    figure, (panel,) = _new_figure(1, width=9.0)
    status = np.array([str(s) for s in summary["status"]])
    sigma = np.hypot(numbers_or_nan(summary, "sigma_dx"), numbers_or_nan(summary, "sigma_dy"))
    order = np.arange(len(summary)) + 1
    for state, color in _STATES.items():
        here = status == state
        if here.any():
            label = f"{here.sum()} {state}"
            height = np.where(np.isfinite(sigma[here]), sigma[here] / np.sqrt(2), 0.0)
            mark = "x" if state == "failed" else "o"
            panel.plot(order[here], height, mark, color=color, label=label)
    panel.set(xlabel="frame", ylabel="scatter of the residuals (px)")
    panel.set_ylim(bottom=0)
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
        flags = numbers_or_nan(sources, "flags")
        usable = ~(flags > 0)
    if shape is None:
        shape = (int(np.nanmax(y)) + 1, int(np.nanmax(x)) + 1)
    out = f"{np.sum(~usable)} left out"
    panel.plot(x[~usable], y[~usable], "x", ms=4, color=_ORANGE, label=out)
    label = f"{np.sum(usable)} used"
    panel.plot(x[usable], y[usable], "o", ms=3, mfc="none", color=_BLUE, label=label)
    _detector(panel, shape, f"{len(x)} sources")
    panel.legend(loc="upper right", framealpha=0.9, fontsize=8)


def _reference(panel, told):
    from matplotlib.patches import Rectangle

    ny, nx = told.frame.image_shape
    x, y = told.references.T
    panel.plot(x, y, ".", ms=2, color=_GREY, label=f"{len(x)} reference stars in reach")
    starts = told.starts[np.isfinite(told.starts).all(axis=1)]
    panel.plot(*starts.T, ".", ms=2, color=_BLUE, label="sources, by the header")
    panel.add_patch(Rectangle((0, 0), nx, ny, fill=False, color=_ORANGE, lw=2))
    panel.set(aspect="equal", xlabel="x (px)", ylabel="y (px)", title="catalog and frame")
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
    panel.set(xlabel="shift in x (px)", ylabel="shift in y (px)", title=title)


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
    # Long arrows are a twelfth of the detector, so that they do not hide each other.
    scale = 12 * max(typical, key) / max(shape)
    options = {
        "angles": "xy",
        "scale_units": "xy",
        "width": 0.003,
        "color": _BLUE,
        "clip_on": False,
    }
    arrows = panel.quiver(x, y, dx, dy, scale=scale, **options)
    panel.quiverkey(arrows, 0.82, 1.03, key, f"{key:g} px", labelpos="E", coordinates="axes")
    _detector(panel, shape, title)


def _detector(panel, shape, title):
    ny, nx = shape
    panel.set(xlim=(-0.06 * nx, 1.06 * nx), ylim=(-0.06 * ny, 1.06 * ny), aspect="equal")
    panel.set(xlabel="x (px)", ylabel="y (px)")
    panel.set_title(title, loc="left", fontsize=10)


def _new_figure(n, width=None):
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width or 5.2 * n, 4.8), layout="constrained")
    return figure, np.atleast_1d(figure.subplots(1, n))
