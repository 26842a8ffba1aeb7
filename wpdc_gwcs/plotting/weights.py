"""The radial weights side by side."""

import numpy as np

from wpdc_gwcs.evaluation import d80
from wpdc_gwcs.plotting._style import (
    BLUE,
    GREY,
    ORANGE,
    OTHERS,
    format_px,
    new_figure,
    symmetric_limit,
)

__all__ = ["plot_weights"]


def plot_weights(results, axes=None, *, component="dx"):
    """Draw the cumulative distributions of the residuals with each radial weight.

    Parameters
    ----------
    results : list of WeightResult
        As returned by `~wpdc_gwcs.evaluation.compare_weights`.
    axes : `matplotlib.axes.Axes`, optional
        Axes for one distribution.  Default: a new figure with all four.
    component : {'dx', 'dy', 'table_dx', 'table_dy'}, optional
        Distribution that goes into ``axes``: of the polynomial alone, or with its table.

    Returns
    -------
    `matplotlib.figure.Figure` or `matplotlib.axes.Axes`
        The given axes.  Without ``axes``, a figure of four panels: both axes of the detector,
        without and with a look-up table.  The legends have the d80 of each weight.

    Raises
    ------
    ValueError
        If ``component`` is none of these.

    Examples
    --------
    >>> from wpdc_gwcs import calibrate, simulate
    >>> from wpdc_gwcs.evaluation import compare_weights
    >>> from wpdc_gwcs.plotting import plot_weights
    >>> sky = simulate(2, image_shape=(1000, 1000), density=30, distortion=10, seed=2)
    >>> run = calibrate([e.frame() for e in sky.exposures], sky.reference)
    >>> figure = plot_weights(compare_weights(run.calibrations))
    >>> len(figure.axes)
    4
    """
    if component not in _COMPONENTS:
        raise ValueError(f"component must be one of {', '.join(_COMPONENTS)}, got {component!r}")
    if axes is not None:
        _draw(axes, results, component, _limit(results, component))
        axes.set_ylabel("cumulative share of the stars")
        return axes
    figure = new_figure(9.5, 7.0)
    panels = figure.subplots(2, 2, sharey=True, sharex="row")
    for row, names in zip(panels, (("dx", "dy"), ("table_dx", "table_dy"))):
        limit = max(_limit(results, name) for name in names)
        for panel, name in zip(row, names):
            _draw(panel, results, name, limit)
        row[0].set_ylabel("cumulative share of the stars")
    return figure


_COMPONENTS = {
    "dx": r"$\Delta X$ [px], polynomial alone",
    "dy": r"$\Delta Y$ [px], polynomial alone",
    "table_dx": r"$\Delta X$ [px], with table",
    "table_dy": r"$\Delta Y$ [px], with table",
}
_STYLES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)))


def _limit(results, name):
    values = [getattr(r, name) for r in results]
    return 0.6 * max(symmetric_limit(v, v) for v in values)


def _draw(axes, results, name, limit):
    colors = (BLUE, ORANGE, *OTHERS)
    for level in (0.2, 0.8):
        axes.axhline(level, color=GREY, lw=0.8, ls=":")
    for k, r in enumerate(results):
        values = np.sort(getattr(r, name))
        axes.plot(
            values,
            (np.arange(values.size) + 0.5) / values.size,
            color=colors[k % len(colors)],
            ls=_STYLES[k % len(_STYLES)],
            lw=1.5,
            label=f"{r.weight.name}: {format_px(d80(values))} px",
        )
    axes.set_xlim(-limit, limit)
    axes.set_ylim(0, 1)
    # Labels such as -0.075 must not touch.
    axes.locator_params(axis="x", nbins=5)
    axes.set_xlabel(_COMPONENTS[name])
    axes.legend(
        loc="upper left", edgecolor="none", framealpha=0.9, fontsize="small", title="d80",
        title_fontsize="small",
    )  # fmt: skip
