"""Residuals of one frame: as arrows, as maps, against position, and their distribution."""

import numpy as np

from wpdc_gwcs.evaluation import binned_residuals, d80
from wpdc_gwcs.plotting._style import (
    BLUE,
    GREY,
    ORANGE,
    format_px,
    get_columns,
    get_flags,
    marker_size,
    new_figure,
    running_percentiles,
    symmetric_limit,
)
from wpdc_gwcs.plotting.arrows import draw_arrows
from wpdc_gwcs.plotting.maps import draw_maps

__all__ = ["plot_cdf", "plot_residual_arrows", "plot_residual_maps", "plot_residuals_vs_position"]


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
        Title of the figure.
    n_bins : int, optional
        Cells along each side of the detector.

    Returns
    -------
    `matplotlib.figure.Figure`
        One arrow per cell that has stars, and a key for the length of the arrows.

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
    figure = new_figure(6.0, 6.0 * ny / nx + 0.7)
    axes = figure.subplots()
    arrows = draw_arrows(axes, x, y, dx, dy, image_shape=image_shape, n_bins=n_bins)
    arrows.draw_key(axes, 0.83, 1.035)
    axes.set_title(
        f"{title or 'Residuals'}\ncell means, rms {format_px(arrows.rms)} px", loc="left"
    )
    return figure


def plot_residuals_vs_position(matches):
    """Draw the residuals of each axis against x and against y, with running medians.

    Parameters
    ----------
    matches : `~astropy.table.Table`
        Matches with columns ``x``, ``y``, ``dx``, ``dy`` in px, and optionally ``used`` and
        ``holdout``.

    Returns
    -------
    `matplotlib.figure.Figure`
        Four panels.  Stars of the fit and held-out stars differ in color; clipped stars are gray.
        The line is the running median of the stars of the fit and the held-out stars, and the band
        holds the middle 68 % of them.

    Raises
    ------
    ValueError
        If a column ``x``, ``y``, ``dx`` or ``dy`` is missing.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import Table
    >>> from wpdc_gwcs.plotting import plot_residuals_vs_position
    >>> x, y, dx, dy = np.random.default_rng(1).uniform(0, 1000, (4, 500))
    >>> table = Table({"x": x, "y": y, "dx": dx / 1e4, "dy": dy / 1e4})
    >>> len(plot_residuals_vs_position(table).axes)
    4
    """
    x, y, dx, dy = get_columns(matches)
    used, holdout = get_flags(matches)
    good = used | holdout
    figure = new_figure(9.0, 6.0)
    panels = figure.subplots(2, 2, sharex="col", sharey=True)
    limit = symmetric_limit(dx[good], dy[good])
    for row, (residual, name) in zip(panels, ((dx, r"$\Delta X$"), (dy, r"$\Delta Y$"))):
        for axes, position in zip(row, (x, y)):
            for chosen, color, label in (
                (~good, GREY, "not used"),
                (used & ~holdout, BLUE, "in the fit"),
                (holdout, ORANGE, "held out"),
            ):
                if chosen.any():
                    axes.plot(
                        position[chosen],
                        residual[chosen],
                        ls="none",
                        marker=".",
                        ms=marker_size(len(x)),
                        mew=0,
                        alpha=0.5,
                        color=color,
                        label=label,
                        rasterized=True,
                    )
            center, low, middle, high = running_percentiles(position[good], residual[good])
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
        Matches with columns ``x``, ``y``, ``dx``, ``dy`` in px, and optionally ``used`` and
        ``holdout``.
    image_shape : (int, int)
        Shape of the detector, ``(ny, nx)``.
    n_bins : int, optional
        Cells along each axis.

    Returns
    -------
    `matplotlib.figure.Figure`
        Three maps: dx, dy and stars per cell, of the stars of the fit and the held-out ones.

    Raises
    ------
    ValueError
        If a column ``x``, ``y``, ``dx`` or ``dy`` is missing.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import Table
    >>> from wpdc_gwcs.plotting import plot_residual_maps
    >>> x, y, dx, dy = np.random.default_rng(1).uniform(0, 1000, (4, 500))
    >>> table = Table({"x": x, "y": y, "dx": dx / 1e4, "dy": dy / 1e4})
    >>> figure = plot_residual_maps(table, image_shape=(1000, 1000), n_bins=5)
    >>> figure.axes[0].get_ylabel()
    'y [px]'
    """
    used, holdout = get_flags(matches)
    good = used | holdout
    columns = [column[good] for column in get_columns(matches)]
    mean_dx, mean_dy, count = binned_residuals(*columns, image_shape=image_shape, n_bins=n_bins)
    ny, nx = image_shape
    extent = (-0.5, nx - 0.5, -0.5, ny - 0.5)
    return draw_maps(
        [
            (mean_dx, r"mean $\Delta X$ [px]", True),
            (mean_dy, r"mean $\Delta Y$ [px]", True),
            (np.where(count, count, np.nan), "stars per cell", False),
        ],
        extent,
        image_shape,
    )


def plot_cdf(matches):
    """Draw the cumulative distribution of the residuals, with the widths d80.

    Parameters
    ----------
    matches : `~astropy.table.Table`
        Matches with columns ``x``, ``y``, ``dx``, ``dy`` in px, and optionally ``used`` and
        ``holdout``.

    Returns
    -------
    `matplotlib.figure.Figure`
        One panel with a curve for each axis; thin curves for the held-out stars.

    Raises
    ------
    ValueError
        If a column ``x``, ``y``, ``dx`` or ``dy`` is missing.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import Table
    >>> from wpdc_gwcs.plotting import plot_cdf
    >>> x, y, dx, dy = np.random.default_rng(1).uniform(0, 1000, (4, 500))
    >>> table = Table({"x": x, "y": y, "dx": dx / 1e4, "dy": dy / 1e4})
    >>> plot_cdf(table).axes[0].get_xlabel()
    'residual [px]'
    """
    _, _, dx, dy = get_columns(matches)
    used, holdout = get_flags(matches)
    figure = new_figure(6.0, 4.2)
    axes = figure.subplots()
    for level in (0.2, 0.8):
        axes.axhline(level, color=GREY, lw=0.8, ls=":")
    for values, color, name in ((dx, BLUE, r"$\Delta X$"), (dy, ORANGE, r"$\Delta Y$")):
        for chosen, width, label in ((used & ~holdout, 1.8, ""), (holdout, 0.9, ", held out")):
            shown = values[chosen & np.isfinite(values)]
            if shown.size:
                axes.ecdf(
                    shown,
                    color=color,
                    lw=width,
                    label=f"{name}{label}: d80 = {format_px(d80(shown))} px",
                )
    limit = symmetric_limit(dx[used | holdout], dy[used | holdout])
    axes.set_xlim(-limit, limit)
    axes.set_ylim(0, 1)
    axes.set_xlabel("residual [px]")
    axes.set_ylabel("cumulative share of the stars")
    axes.legend(loc="upper left", edgecolor="none", framealpha=1, fontsize="small")
    return figure
