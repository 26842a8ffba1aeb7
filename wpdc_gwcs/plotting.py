"""Figures of residuals, distortion and look-up tables.

Every function returns a new `matplotlib.figure.Figure`, made without ``pyplot``: nothing is shown,
kept or switched behind the caller's back.  ``figure.savefig(path)`` writes it.
"""

import numpy as np

from wpdc_gwcs.evaluation import binned_residuals, d80, evaluate, running_statistics

__all__ = [
    "plot_cdf",
    "plot_lookup_table",
    "plot_residual_arrows",
    "plot_residual_maps",
    "plot_residuals_vs_magnitude",
    "plot_residuals_vs_position",
    "plot_weights",
]

# Okabe and Ito's colors, told apart with any color vision.
_BLUE, _ORANGE, _GREY = "#0072B2", "#D55E00", "#999999"
_OTHERS = ("#009E73", "#CC79A7", "#000000")
_DIVERGING, _SEQUENTIAL = "RdBu_r", "viridis"


def plot_residual_arrows(x, y, dx, dy, *, image_shape, title=None, n_bins=20):
    """Draw mean residuals in the cells of a grid over the detector as arrows.

    Parameters
    ----------
    x, y : (N,) array_like
        Pixel coordinates, zero based.
    dx, dy : (N,) array_like
        Residuals in px.
    image_shape : (int, int)
        Shape of the detector, ``(ny, nx)``.
    title : str, optional
        What the arrows are.
    n_bins : int, optional
        Cells along each side of the detector.

    Returns
    -------
    `matplotlib.figure.Figure`
        The figure: one arrow per cell that has stars, and the length of the arrow beside it as key.

    Examples
    --------
    >>> from wpdc_gwcs.plotting import plot_residual_arrows
    >>> figure = plot_residual_arrows(
    ...     [10, 90], [10, 90], [0.1, 0.3], [0, 0], image_shape=(100, 100), n_bins=4
    ... )
    >>> len(figure.axes)
    1
    """
    ny, nx = image_shape
    u, v, count = binned_residuals(x, y, dx, dy, image_shape=image_shape, n_bins=n_bins)
    cell = np.array([nx, ny]) / n_bins
    filled = count > 0
    iy, ix = np.nonzero(filled)
    u, v = u[filled], v[filled]
    length = np.hypot(u, v)
    # A typical arrow is as long as a cell, the longest one has room beside the outer cells; the key
    # is a round number near the typical one.
    typical = float(max(np.percentile(length, 80), length.max() / 1.9)) if length.size else 0.0
    typical = typical or 1.0

    figure = _new_figure(6.0, 6.0 * ny / nx + 0.7)
    axes = figure.subplots()
    arrows = axes.quiver(
        (ix + 0.5) * cell[0] - 0.5,
        (iy + 0.5) * cell[1] - 0.5,
        u,
        v,
        angles="xy",
        scale_units="xy",
        scale=typical / cell.min(),
        width=0.0032,
        color=_BLUE,
        pivot="tail",
    )
    key = _round_number(typical)
    axes.quiverkey(
        arrows, 0.83, 1.035, key, f"{key:g} px", labelpos="E", color=_ORANGE, coordinates="axes"
    )
    _frame_detector(axes, image_shape)
    # Arrows of the outer cells may reach over the edge.
    margin = 1.5 * cell.min()
    axes.set_xlim(-0.5 - margin, nx - 0.5 + margin)
    axes.set_ylim(-0.5 - margin, ny - 0.5 + margin)
    rms = np.sqrt(np.mean(length**2)) if length.size else np.nan
    axes.set_title(f"{title or 'Residuals'}\ncell means, rms {_format_px(rms)} px", loc="left")
    return figure


def plot_residuals_vs_position(matches):
    """Draw the residuals of each axis against x and against y, with running medians.

    Parameters
    ----------
    matches : `~astropy.table.Table`
        Matches with columns ``x``, ``y``, ``dx``, ``dy`` in px, ``used`` and ``holdout``.

    Returns
    -------
    `matplotlib.figure.Figure`
        Four panels.  Stars of the fit and held-out stars have their own colors, stars that are
        neither (clipped) are grey; the line is the running median of the first two and the band
        holds the middle 68 % of them.
    """
    x, y, dx, dy = _get_columns(matches)
    used, holdout = _get_flags(matches)
    good = used | holdout
    figure = _new_figure(9.0, 6.0)
    panels = figure.subplots(2, 2, sharex="col", sharey=True)
    limit = _symmetric_limit(dx[good], dy[good])
    for row, (residual, name) in zip(panels, ((dx, r"$\Delta X$"), (dy, r"$\Delta Y$"))):
        for axes, position in zip(row, (x, y)):
            for chosen, color, label in (
                (~good, _GREY, "not used"),
                (used & ~holdout, _BLUE, "in the fit"),
                (holdout, _ORANGE, "held out"),
            ):
                if chosen.any():
                    axes.plot(
                        position[chosen],
                        residual[chosen],
                        ls="none",
                        marker=".",
                        ms=_marker_size(len(x)),
                        mew=0,
                        alpha=0.5,
                        color=color,
                        label=label,
                        rasterized=True,
                    )
            center, low, middle, high = _running_percentiles(position[good], residual[good])
            axes.fill_between(center, low, high, color="black", alpha=0.15, lw=0, zorder=3)
            axes.plot(center, middle, color="black", lw=1.5, zorder=4, label="running median")
            axes.axhline(0, color="black", lw=0.6, ls=":")
            axes.set_ylim(-limit, limit)
        row[0].set_ylabel(f"{name} [px]")
    panels[1, 0].set_xlabel("x [px]")
    panels[1, 1].set_xlabel("y [px]")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    legend = figure.legend(
        handles, labels, loc="outside upper center", ncols=len(labels), frameon=False
    )
    for handle in legend.legend_handles:
        handle.set_alpha(1)
        if handle.get_marker() == ".":
            handle.set_markersize(9)
    return figure


def plot_residual_maps(matches, *, image_shape, n_bins=20):
    """Draw maps of the mean residuals and of the number of stars over the detector.

    Parameters
    ----------
    matches : `~astropy.table.Table`
        Matches with columns ``x``, ``y``, ``dx``, ``dy`` in px, ``used`` and ``holdout``.
    image_shape : (int, int)
        Shape of the detector, ``(ny, nx)``.
    n_bins : int, optional
        Cells along each axis.

    Returns
    -------
    `matplotlib.figure.Figure`
        Three maps: dx, dy and stars per cell, of the stars of the fit and the held-out ones.
    """
    used, holdout = _get_flags(matches)
    good = used | holdout
    columns = [column[good] for column in _get_columns(matches)]
    mean_dx, mean_dy, count = binned_residuals(*columns, image_shape=image_shape, n_bins=n_bins)
    ny, nx = image_shape
    extent = (-0.5, nx - 0.5, -0.5, ny - 0.5)
    return _draw_maps(
        [
            (mean_dx, r"mean $\Delta X$ [px]", True),
            (mean_dy, r"mean $\Delta Y$ [px]", True),
            (np.where(count, count, np.nan), "stars per cell", False),
        ],
        extent,
        image_shape,
    )


def plot_lookup_table(table):
    """Draw maps of a look-up table.

    Parameters
    ----------
    table : LookupTable
        The table.

    Returns
    -------
    `matplotlib.figure.Figure`
        Three maps, of the table's dx, dy and of its amplitude, with the nodes as pixels.
    """
    x, y = np.asarray(table.x_grid), np.asarray(table.y_grid)
    dx, dy = np.asarray(table.dx), np.asarray(table.dy)
    half_x, half_y = (x[1] - x[0]) / 2, (y[1] - y[0]) / 2
    extent = (x[0] - half_x, x[-1] + half_x, y[0] - half_y, y[-1] + half_y)
    figure = _draw_maps(
        [
            (dx, r"$\Delta X_\mathrm{LUT}$ [px]", True),
            (dy, r"$\Delta Y_\mathrm{LUT}$ [px]", True),
            (np.hypot(dx, dy), "amplitude [px]", False),
        ],
        extent,
        (y[-1] - y[0], x[-1] - x[0]),
        level=100,
    )
    for axes in figure.axes[:3]:
        axes.set_xlim(x[0], x[-1])
        axes.set_ylim(y[0], y[-1])
    return figure


def plot_cdf(matches):
    """Draw the cumulative distribution of the residuals, with the widths d80.

    Parameters
    ----------
    matches : `~astropy.table.Table`
        Matches with columns ``x``, ``y``, ``dx``, ``dy`` in px, ``used`` and ``holdout``.

    Returns
    -------
    `matplotlib.figure.Figure`
        One panel with a curve for each axis; thin curves for the held-out stars.
    """
    _, _, dx, dy = _get_columns(matches)
    used, holdout = _get_flags(matches)
    figure = _new_figure(6.0, 4.2)
    axes = figure.subplots()
    for level in (0.2, 0.8):
        axes.axhline(level, color=_GREY, lw=0.8, ls=":")
    for values, color, name in ((dx, _BLUE, r"$\Delta X$"), (dy, _ORANGE, r"$\Delta Y$")):
        for chosen, width, label in ((used & ~holdout, 1.8, ""), (holdout, 0.9, ", held out")):
            shown = values[chosen & np.isfinite(values)]
            if shown.size:
                axes.ecdf(
                    shown,
                    color=color,
                    lw=width,
                    label=f"{name}{label}: d80 = {_format_px(d80(shown))} px",
                )
    limit = _symmetric_limit(dx[used | holdout], dy[used | holdout])
    axes.set_xlim(-limit, limit)
    axes.set_ylim(0, 1)
    axes.set_xlabel("residual [px]")
    axes.set_ylabel("cumulative share of the stars")
    axes.legend(loc="upper left", edgecolor="none", framealpha=1, fontsize="small")
    return figure


def plot_residuals_vs_magnitude(matches):
    """Draw the residuals of each axis against magnitude, and their scatter.

    Parameters
    ----------
    matches : `~astropy.table.Table`
        Matches with columns ``dx``, ``dy`` in px, and one of ``phot_g_mean_mag``, ``magnitude``,
        ``mag``, ``snr`` or ``x_err``: the first of these that is there.

    Returns
    -------
    `matplotlib.figure.Figure`
        Three panels: the residuals of both axes with their running median and middle 68 %, and
        their standard deviations after 3-sigma clipping in equally filled bins.

    Raises
    ------
    ValueError
        If none of the columns is there.
    """
    labels = {
        "phot_g_mean_mag": "G [mag]",
        "magnitude": "magnitude",
        "mag": "magnitude",
        "snr": "signal-to-noise ratio",
        "x_err": r"stated error $\sigma_x$ [px]",
    }
    name = next((n for n in labels if n in matches.colnames), None)
    if name is None:
        raise ValueError(f"matches must have one of the columns {', '.join(labels)}")
    _, _, dx, dy = _get_columns(matches)
    used, holdout = _get_flags(matches)
    value = _plain(matches[name])
    good = (used | holdout) & np.isfinite(value)
    value, dx, dy = value[good], dx[good], dy[good]
    figure = _new_figure(11.5, 3.9)
    panels = figure.subplots(1, 3, sharex=True)
    panels[1].sharey(panels[0])
    limit = _symmetric_limit(dx, dy)
    columns = ((dx, r"$\Delta X$", _BLUE), (dy, r"$\Delta Y$", _ORANGE))
    for axes, (residual, label, color) in zip(panels, columns):
        axes.plot(
            value, residual, ls="none", marker=".", ms=_marker_size(len(value)), mew=0, alpha=0.5,
            color=color, rasterized=True,
        )  # fmt: skip
        center, low, middle, high = _running_percentiles(value, residual)
        axes.fill_between(center, low, high, color="black", alpha=0.15, lw=0, zorder=3)
        axes.plot(center, middle, color="black", lw=1.5, zorder=4)
        axes.axhline(0, color="black", lw=0.6, ls=":")
        axes.set_ylim(-limit, limit)
        axes.set_ylabel(f"{label} [px]")
    table = running_statistics(value, dx, dy, n_bins=12)
    for column, (_, label, color) in zip(("sigma_dx", "sigma_dy"), columns):
        panels[2].plot(table["middle"], table[column], "o-", ms=4, color=color, label=label)
    panels[2].set_ylim(bottom=0)
    panels[2].set_ylabel(r"$\sigma$ after clipping [px]")
    panels[2].legend(frameon=False)
    for axes in panels:
        axes.set_xlabel(labels[name])
        if name in ("snr", "x_err") and np.all(value > 0):
            axes.set_xscale("log")
    return figure


def plot_weights(results):
    """Draw the cumulative distributions of the residuals with each radial weight.

    Parameters
    ----------
    results : list of WeightResult
        As returned by `~wpdc_gwcs.evaluation.compare_weights`.

    Returns
    -------
    `matplotlib.figure.Figure`
        Four panels: both axes, without and with a look-up table; d80 of each weight in the keys.
    """
    figure = _new_figure(9.5, 7.0)
    panels = figure.subplots(2, 2, sharey=True, sharex="row")
    colors = (_BLUE, _ORANGE, *_OTHERS)
    styles = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)))
    rows = (("polynomial alone", ("dx", "dy")), ("with table", ("table_dx", "table_dy")))
    for row, (title, names) in zip(panels, rows):
        limit = max(
            _symmetric_limit(*(getattr(r, name) for name in names)) for r in results
        )  # fmt: skip
        for axes, name, label in zip(row, names, (r"$\Delta X$", r"$\Delta Y$")):
            for level in (0.2, 0.8):
                axes.axhline(level, color=_GREY, lw=0.8, ls=":")
            for k, r in enumerate(results):
                values = np.sort(getattr(r, name))
                axes.plot(
                    values,
                    (np.arange(values.size) + 0.5) / values.size,
                    color=colors[k % len(colors)],
                    ls=styles[k % len(styles)],
                    lw=1.5,
                    label=f"{r.weight.name}: {_format_px(d80(values))} px",
                )
            axes.set_xlim(-0.6 * limit, 0.6 * limit)
            axes.set_ylim(0, 1)
            axes.set_xlabel(f"{label} [px], {title}")
            axes.legend(loc="upper left", edgecolor="none", framealpha=0.9, fontsize="small",
                        title="d80", title_fontsize="small")  # fmt: skip
        row[0].set_ylabel("cumulative share of the stars")
    return figure


def _new_figure(width, height):
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _frame_detector(axes, image_shape):
    """Label the axes of a map and draw the outer edge of the detector's pixels."""
    ny, nx = image_shape
    axes.plot(
        [-0.5, nx - 0.5, nx - 0.5, -0.5, -0.5],
        [-0.5, -0.5, ny - 0.5, ny - 0.5, -0.5],
        color=_GREY,
        lw=0.8,
    )
    axes.set_aspect("equal")
    axes.set_xlabel("x [px]")
    axes.set_ylabel("y [px]")


def _draw_maps(maps, extent, image_shape, *, level=99):
    """Draw maps beside each other.

    The signed ones share a scale that is symmetric about zero and ends at a percentile, so that a
    cell with one bad star does not hide the others.
    """
    ny, nx = image_shape
    figure = _new_figure(11.5, 11.5 / 3 * min(ny / nx, 1.6) + 1.1)
    panels = figure.subplots(1, len(maps), sharey=True)
    signed = np.abs(np.concatenate([values.ravel() for values, _, sign in maps if sign]))
    top = float(np.nanpercentile(signed, level)) if np.isfinite(signed).any() else 0.0
    top = top or 1.0
    for axes, (values, label, sign) in zip(panels, maps):
        options = {"cmap": _DIVERGING, "vmin": -top, "vmax": top} if sign else {"cmap": _SEQUENTIAL}
        axes.set_facecolor("0.85")  # cells without stars
        image = axes.imshow(
            values, origin="lower", extent=extent, interpolation="nearest", **options
        )
        over = np.nanmax(np.abs(values), initial=0) > top if sign else False
        figure.colorbar(
            image,
            ax=axes,
            label=label,
            location="top",
            shrink=0.9,
            pad=0.03,
            extend="both" if over else "neither",
        )
        axes.set_xlabel("x [px]")
    panels[0].set_ylabel("y [px]")
    return figure


def _get_columns(matches):
    """Positions and residuals of a match table as plain arrays."""
    missing = [name for name in ("x", "y", "dx", "dy") if name not in matches.colnames]
    if missing:
        raise ValueError(f"matches must have the columns x, y, dx, dy; no {', '.join(missing)}")
    return tuple(_plain(matches[name]) for name in ("x", "y", "dx", "dy"))


def _get_flags(matches):
    """Which matches the fit used and which were held out; all used where the table says nothing."""
    n = len(matches)
    given = matches.colnames
    holdout = np.asarray(matches["holdout"], bool) if "holdout" in given else np.zeros(n, bool)
    used = np.asarray(matches["used"], bool) if "used" in given else ~holdout
    return used, holdout


def _plain(column):
    return np.asarray(getattr(column, "value", column), dtype=float)


def _running_percentiles(position, values, *, n_bins=25):
    """Median and middle 68 % of values in equally filled bins of position, at the bins' medians."""
    finite = np.isfinite(position) & np.isfinite(values)
    position, values = position[finite], values[finite]
    # A bin of fewer than 10 stars would draw noise.
    n_bins = max(1, min(n_bins, len(position) // 10))
    if not len(position):
        return np.empty((4, 0))
    rows = np.array_split(np.argsort(position, kind="stable"), n_bins)
    return np.array(
        [[np.median(position[i]), *np.percentile(values[i], (16, 50, 84))] for i in rows]
    ).T


def _symmetric_limit(*residuals):
    """Limit of an axis that shows residuals: five times their scatter, about zero."""
    stats = evaluate(*residuals)
    limit = max(abs(stats.mean_dx), abs(stats.mean_dy))
    limit += 5 * max(stats.scatter_dx, stats.scatter_dy)
    return limit if limit > 0 else 1.0


def _marker_size(n):
    return float(np.clip(120 / np.sqrt(max(n, 1)), 2, 6))


def _round_number(value):
    """Nearest of 1, 2, 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(value))
    steps = np.array([1.0, 2.0, 5.0, 10.0])
    return float(steps[np.argmin(np.abs(np.log(value / power / steps)))] * power)


def _format_px(value):
    return f"{value:.2g}" if abs(value) < 1 else f"{value:.1f}"
