"""Residuals before and after a calibration: arrows over the detector, and profiles."""

import numpy as np

from wpdc_gwcs.plotting._style import (
    BLUE,
    GREY,
    ORANGE,
    format_px,
    given_axes,
    pool,
    symmetric_limit,
)
from wpdc_gwcs.plotting.arrows import draw_arrows

__all__ = ["plot_before_after"]

# Height of a profile as a share of the map, and gap between them, inches.
_HEIGHT, _GAP = "22%", 0.08


def plot_before_after(
    before,
    after,
    *,
    image_shape,
    axes=None,
    n_bins=20,
    titles=("before", "after"),
    n_points=4000,
    seed=0,
):
    """Draw residuals before and after a calibration side by side.

    Parameters
    ----------
    before, after : `~astropy.table.Table` or iterable of them
        Columns ``x``, ``y``, ``dx``, ``dy`` in px, and optionally ``used`` and ``holdout``.  Tables
        of several exposures are pooled.  `~wpdc_gwcs.evaluation.uncorrected_residuals` returns the
        residuals before a calibration.
    image_shape : (int, int)
        Shape of the detector, ``(ny, nx)``.
    axes : two `matplotlib.axes.Axes`, optional
        Axes to draw into: each is divided into a map and, above and to the right, its profiles.
        Default: new ones.
    n_bins : int, optional
        Cells along each side of the detector.
    titles : (str, str), optional
        Titles of the two maps.
    n_points : int, optional
        Largest number of stars in the profiles.
    seed : int, optional
        Seed for the choice of these stars.

    Returns
    -------
    (2, 5) ndarray of `matplotlib.axes.Axes`
        Before and after: the map; dx and dy against x; dx and dy against y.

    Raises
    ------
    ValueError
        If a column is missing, there is no table, or the number of axes is wrong.

    Examples
    --------
    >>> from wpdc_gwcs import calibrate, simulate
    >>> from wpdc_gwcs.evaluation import uncorrected_residuals
    >>> from wpdc_gwcs.plotting import plot_before_after
    >>> sky = simulate(2, image_shape=(1000, 1000), density=30, distortion=10, seed=2)
    >>> run = calibrate([e.frame() for e in sky.exposures], sky.reference)
    >>> axes = plot_before_after(
    ...     [uncorrected_residuals(c) for c in run.calibrations],
    ...     [c.matches for c in run.calibrations],
    ...     image_shape=(1000, 1000),
    ... )
    >>> axes.shape, axes[0, 1].get_ylabel() == axes[0, 3].get_xlabel()
    ((2, 5), True)
    """
    ny, nx = image_shape
    axes = given_axes(axes, 2, 11.0, 5.0 * min(ny / nx, 1.6) + 0.6)
    panels = zip(axes, (before, after), titles, strict=True)
    return np.array(
        [_draw_one(m, *pool(t), image_shape, n_bins, o, n_points, seed) for m, t, o in panels]
    )


def _draw_one(main, x, y, dx, dy, image_shape, n_bins, title, n_points, seed):
    from matplotlib.ticker import MaxNLocator
    from mpl_toolkits.axes_grid1 import make_axes_locatable

    arrows = draw_arrows(main, x, y, dx, dy, image_shape=image_shape, n_bins=n_bins)
    chosen = np.random.default_rng(seed).permutation(len(x))[:n_points]
    limit = symmetric_limit(dx, dy)
    style = {"ls": "none", "marker": ".", "ms": 2, "mew": 0, "alpha": 0.4, "rasterized": True}
    divider = make_axes_locatable(main)
    above, right = [], []
    for residual, name, color in ((dx, r"$\Delta X$", BLUE), (dy, r"$\Delta Y$", ORANGE)):
        panel = divider.append_axes("top", _HEIGHT, pad=_GAP, sharex=main)
        panel.plot(x[chosen], residual[chosen], color=color, **style)
        panel.axhline(0, color="black", lw=0.6)
        panel.set_ylim(-limit, limit)
        panel.tick_params(labelbottom=False)
        panel.set_ylabel(f"{name} [px]", fontsize="small")
        above.append(panel)
        panel = divider.append_axes("right", _HEIGHT, pad=_GAP, sharey=main)
        panel.plot(residual[chosen], y[chosen], color=color, **style)
        panel.axvline(0, color="black", lw=0.6)
        panel.set_xlim(-limit, limit)
        panel.tick_params(axis="y", labelleft=False)
        # Ticks and label go above, into the space between the profiles.
        panel.xaxis.tick_top()
        panel.xaxis.set_label_position("top")
        panel.tick_params(axis="x", rotation=90)
        panel.set_xlabel(f"{name} [px]", fontsize="small")
        right.append(panel)
    for panel in above + right:
        panel.tick_params(labelsize="small")
        panel.spines[:].set_color(GREY)
        axis = panel.yaxis if panel in above else panel.xaxis
        # No ticks at the ends: their numbers would touch those of the next panel.
        axis.set_major_locator(MaxNLocator(3, symmetric=True, prune="both"))
    for axis in (main.xaxis, main.yaxis):
        axis.set_major_locator(MaxNLocator(5, integer=True))
    above[1].text(
        1.05,
        1.0,
        f"{title}\nrms {format_px(arrows.rms)} px\n"
        rf"arrows $\times$ {float(f'{arrows.magnification:.2g}'):g}",
        transform=above[1].transAxes,
        va="top",
    )
    arrows.draw_key(main, 1.09, 1.27)
    return np.array([main, *above, *right])
