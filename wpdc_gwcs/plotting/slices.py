"""Mean residuals in slices of a detector, for several solutions."""

import numpy as np

from wpdc_gwcs.plotting._style import (
    BLUE,
    GREY,
    ORANGE,
    OTHERS,
    clipped_statistics,
    given_axes,
    pool,
)

__all__ = ["plot_slices"]

_MARKERS = "osD^v"


def plot_slices(residuals, *, image_shape, axes=None, width=512):
    """Draw the mean residuals in slices of the detector, with the middle 68.27 % as bars.

    Parameters
    ----------
    residuals : dict
        Residuals of each solution by its label, for example ``unweighted`` and ``weighted``.  They
        are a table with columns ``x``, ``y``, ``dx``, ``dy`` in px, an iterable of tables, or a
        `WeightResult` of `~wpdc_gwcs.evaluation.compare_weights`.
    image_shape : (int, int)
        Shape of the detector, ``(ny, nx)``.
    axes : two `matplotlib.axes.Axes`, optional
        Axes for dx against x and dy against y.  Default: new ones.
    width : float, optional
        Width of a slice, px; the paper's is 512.

    Returns
    -------
    (2,) ndarray of `matplotlib.axes.Axes`
        Both panels.

    Raises
    ------
    ValueError
        If the width is not positive, or there is nothing to draw.

    Notes
    -----
    Means and percentiles are after 3-sigma clipping within each slice.

    References
    ----------
    WPDC-2P, arXiv:2603.09193, figure of weighted and unweighted solutions.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import Table
    >>> from wpdc_gwcs.plotting import plot_slices
    >>> x, y, dx, dy = np.random.default_rng(1).uniform(0, 1000, (4, 500))
    >>> table = Table({"x": x, "y": y, "dx": dx / 1e4, "dy": dy / 1e4})
    >>> axes = plot_slices({"weighted": table}, image_shape=(1000, 1000), width=250)
    >>> [a.get_xlabel() for a in axes]
    ['x [px]', 'y [px]']
    """
    if not width > 0:
        raise ValueError(f"width must be positive px, got {width}")
    if not residuals:
        raise ValueError("residuals must have at least one solution")
    ny, nx = image_shape
    axes = given_axes(axes, 2, 9.5, 4.0, sharey=True)
    colors = (BLUE, ORANGE, *OTHERS)
    for k, (label, matches) in enumerate(residuals.items()):
        x, y, dx, dy = _columns(matches)
        shift = (k - (len(residuals) - 1) / 2) * 0.12 * width
        panels = zip(axes, (x, y), (dx, dy), (nx, ny), strict=True)
        for panel, position, residual, n in panels:
            center, mean, low, high = _slices(position, residual, n, width)
            panel.errorbar(
                center + shift, mean, yerr=[mean - low, high - mean], fmt=_MARKERS[k % 5],
                ms=4, lw=1.2, capsize=2, color=colors[k % len(colors)], label=label,
            )  # fmt: skip
    for panel, name, n, axis in zip(axes, (r"$\Delta X$", r"$\Delta Y$"), (nx, ny), "xy"):
        panel.axhline(0, color=GREY, lw=0.8, zorder=0)
        panel.set_xlim(-0.5, n - 0.5)
        panel.set_xlabel(f"{axis} [px]")
        panel.set_ylabel(f"{name} [px]")
        panel.tick_params(labelleft=True)
    axes[0].legend(frameon=False, loc="best")
    return axes


def _columns(matches):
    if hasattr(matches, "weight"):
        return matches.x, matches.y, matches.dx, matches.dy
    return pool(matches)


def _slices(position, residual, n, width):
    """Center, mean, and lower and upper end of the bar of each slice that has stars."""
    count = max(1, int(np.ceil(n / width)))
    number = np.clip(((position + 0.5) // width).astype(int), 0, count - 1)
    order = np.argsort(number, kind="stable")
    parts = np.split(residual[order], np.searchsorted(number[order], np.arange(1, count)))
    rows = np.array([clipped_statistics(part) for part in parts])
    # The last slice may be narrower.
    edges = np.minimum(np.arange(count + 1) * width, n) - 0.5
    center = 0.5 * (edges[1:] + edges[:-1])
    good = np.isfinite(rows[:, 0])
    return center[good], *rows[good].T
