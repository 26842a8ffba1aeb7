"""Maps over a detector."""

import numpy as np

from wpdc_gwcs.plotting._style import (
    DIVERGING,
    SEQUENTIAL,
    new_figure,
)

__all__ = ["draw_maps", "plot_lookup_table"]


def draw_maps(maps, extent, image_shape, *, level=99):
    """Draw maps side by side.

    Parameters
    ----------
    maps : list of (ndarray, str, bool)
        Values, their label, and whether they have a sign.
    extent : (float, float, float, float)
        Left, right, lower and upper edges of the maps, px.
    image_shape : (int, int)
        Shape of the detector, ``(ny, nx)``.
    level : float, optional
        Percentile of the signed values at which their scale ends.

    Returns
    -------
    `matplotlib.figure.Figure`
        Figure with one panel for each map.  Signed maps share a scale that is symmetric about zero
        and ends at ``level``, so that a cell with one bad star does not hide the others.
    """
    ny, nx = image_shape
    figure = new_figure(11.5, 11.5 / 3 * min(ny / nx, 1.6) + 1.1)
    panels = figure.subplots(1, len(maps), sharey=True)
    signed = np.abs(np.concatenate([values.ravel() for values, _, sign in maps if sign]))
    top = float(np.nanpercentile(signed, level)) if np.isfinite(signed).any() else 0.0
    top = top or 1.0
    for axes, (values, label, sign) in zip(panels, maps):
        options = {"cmap": DIVERGING, "vmin": -top, "vmax": top} if sign else {"cmap": SEQUENTIAL}
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


def plot_lookup_table(table):
    """Draw maps of a look-up table.

    Parameters
    ----------
    table : LookupTable
        The table.

    Returns
    -------
    `matplotlib.figure.Figure`
        Three maps, of the table's dx, its dy and its amplitude, with one pixel per node.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs import LookupTable
    >>> from wpdc_gwcs.plotting import plot_lookup_table
    >>> nodes = np.linspace(-0.5, 1023.5, 20)
    >>> x, y = np.meshgrid(nodes, nodes)
    >>> table = LookupTable(nodes, nodes, 0.1 * np.sin(x / 200), 0.1 * np.cos(y / 150))
    >>> figure = plot_lookup_table(table)
    >>> [axes.get_xlabel() for axes in figure.axes[:3]]
    ['x [px]', 'x [px]', 'x [px]']
    """
    x, y = np.asarray(table.x_grid), np.asarray(table.y_grid)
    dx, dy = np.asarray(table.dx), np.asarray(table.dy)
    half_x, half_y = (x[1] - x[0]) / 2, (y[1] - y[0]) / 2
    extent = (x[0] - half_x, x[-1] + half_x, y[0] - half_y, y[-1] + half_y)
    figure = draw_maps(
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
