"""History of a stored solution: residuals, drift, and each cell of the detector."""

import numpy as np

from wpdc_gwcs.counts import counted
from wpdc_gwcs.plotting._style import BLACK, BLUE, DIVERGING, GREY, ORANGE, new_figure

__all__ = ["plot_cell_history", "plot_drift_history"]

# A day, in years.
_ONE_NIGHT = 1 / 365.25
# Labels of cells along each side of the detector.
_MOST_LABELS = 16


def plot_drift_history(history):
    """Draw the residuals of a detector over time, and the periods that raise an alarm.

    Parameters
    ----------
    history : DriftHistory
        What `wpdc_gwcs.evaluation.track_drift` returned.

    Returns
    -------
    `matplotlib.figure.Figure`
        Three panels over time: mean residuals with their errors, scatter, and the size of the
        change.  Periods that raise an alarm are marked in all of them.

    Examples
    --------
    >>> from wpdc_gwcs import calibrate, simulate
    >>> from wpdc_gwcs.evaluation import track_drift
    >>> from wpdc_gwcs.plotting import plot_drift_history
    >>> sky = simulate(2, image_shape=(1000, 1000), density=30, distortion=10, seed=2)
    >>> run = calibrate([e.frame() for e in sky.exposures], sky.reference)
    >>> periods = [([2016.0], [c.matches]) for c in run.calibrations]
    >>> history = track_drift(run.solutions["sim"], periods)
    >>> len(plot_drift_history(history).axes)
    3
    """
    table = history.periods
    time, label = _time_of(table)
    figure = new_figure(9.0, 7.5)
    means, scatter, change = figure.subplots(3, 1, sharex=True)
    root = np.sqrt(np.maximum(np.asarray(table["n_stars"], float), 1.0))
    for axis, color in (("x", BLUE), ("y", ORANGE)):
        name = rf"$\Delta {axis.upper()}$"
        mean, sigma = (table[f"{kind}_d{axis}"].value for kind in ("mean", "sigma"))
        means.errorbar(time, mean, sigma / root, fmt="o-", ms=4, lw=1, color=color, label=name)
        scatter.plot(time, sigma, "o-", ms=4, lw=1, color=color, label=name)
    means.axhline(0, color=BLACK, lw=0.6, ls=":")
    means.set_ylabel("mean residual [px]")
    scatter.set_ylabel(r"$\sigma$ [px]")
    highest = [np.nanmax(np.abs(table[n].value), initial=0.0) for n in ("sigma_dx", "sigma_dy")]
    scatter.set_ylim(0, 1.2 * max(highest) or 1.0)
    drifted = np.asarray(table["drifted"], bool)
    change.plot(time, table["amplitude"].value, "o-", ms=4, lw=1, color=BLACK)
    change.set_ylabel("change [px rms]")
    change.set_ylim(0, 1.2 * table["amplitude"].value.max() or 0.1)
    change.set_xlabel(label)
    if len(table) == 1:
        # Without this, a single epoch would be drawn on an axis of two centuries.
        length = float(table["last_epoch"][0] - table["first_epoch"][0])
        margin = max(length, _ONE_NIGHT) if label.startswith("epoch") else 1.0
        change.set_xlim(time[0] - margin, time[0] + margin)
    untested = ~np.isfinite(np.asarray(table["p_value"], float))
    for mask, color, name in ((drifted, "#CC0000", "alarm"), (untested, GREY, "too few stars")):
        for axes in (means, scatter, change):
            for k, t in enumerate(time[mask]):
                axes.axvline(t, color=color, lw=4, alpha=0.25, label=name if k == 0 else None)
    for axes in (means, scatter, change):
        axes.grid(alpha=0.3)
        axes.ticklabel_format(axis="x", useOffset=False)
    handles, labels = means.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=len(labels), frameon=False)
    n = int(drifted.sum())
    means.set_title(
        f"{history.detector}: {counted(len(table), 'period')}, "
        f"{counted(int(np.sum(table['n_frames'])), 'frame')}, "
        f"{counted(n, 'alarm')}",
        loc="left",
    )
    return figure


def plot_cell_history(history):
    """Draw the mean residual of each cell of a detector over time.

    Parameters
    ----------
    history : DriftHistory
        What `wpdc_gwcs.evaluation.track_drift` returned.

    Returns
    -------
    `matplotlib.figure.Figure`
        Two maps, one for each axis, with a row for each cell, named by its center, and a column for
        each period.  Cells with too few stars are blank.  Periods that raise an alarm are marked
        below.

    Examples
    --------
    >>> from wpdc_gwcs import calibrate, simulate
    >>> from wpdc_gwcs.evaluation import track_drift
    >>> from wpdc_gwcs.plotting import plot_cell_history
    >>> sky = simulate(2, image_shape=(1000, 1000), density=30, distortion=10, seed=2)
    >>> run = calibrate([e.frame() for e in sky.exposures], sky.reference)
    >>> periods = [([2016.0], [c.matches]) for c in run.calibrations]
    >>> figure = plot_cell_history(track_drift(run.solutions["sim"], periods))
    >>> len(figure.axes[0].get_yticklabels()) > 0
    True
    """
    table, cells = history.periods, history.cells
    place = [0.5 * (cells[f"{a}_min"].value + cells[f"{a}_max"].value) for a in ("y", "x")]
    names, row = np.unique(np.round(np.stack(place, axis=1), 3), axis=0, return_inverse=True)
    row = np.ravel(row)
    figure = new_figure(2.5 + min(max(0.3 * len(table), 5.0), 14.0), 7.5)
    panels = figure.subplots(2, 1, sharex=True)
    values = np.full((2, max(len(names), 1), len(table)), np.nan)
    for k, axis in enumerate("xy"):
        values[k, row, np.asarray(cells["period"])] = cells[f"d{axis}"].value
    limit = np.nanpercentile(np.abs(values), 99) if np.isfinite(values).any() else 1.0
    for panel, image, axis in zip(panels, values, "XY"):
        drawn = panel.imshow(
            image, aspect="auto", cmap=DIVERGING, vmin=-limit, vmax=limit, interpolation="nearest"
        )
        panel.set_facecolor("0.85")
        shown = range(0, len(names), -(-len(names) // _MOST_LABELS) if len(names) else 1)
        panel.set_yticks(list(shown), [f"{names[k][1]:.0f}, {names[k][0]:.0f}" for k in shown])
        panel.set_ylabel("center of the cell: x, y [px]")
        figure.colorbar(drawn, ax=panel, label=rf"mean $\Delta {axis}$ [px]")
    for k in np.flatnonzero(table["drifted"]):
        panels[1].plot(
            k, -0.03, "^", color="#CC0000", clip_on=False, transform=panels[1].get_xaxis_transform()
        )
    time, label = _time_of(table)
    shown = np.unique(np.linspace(0, len(table) - 1, min(len(table), 5)).round().astype(int))
    panels[1].tick_params(axis="x", pad=8)
    digits = 3 if label.startswith("epoch") else 0
    panels[1].set_xticks(shown, [f"{time[k]:.{digits}f}" for k in shown])
    panels[1].set_xlabel(f"{label}; triangles: alarms")
    panels[0].set_title(f"{history.detector}: mean residuals, cell by cell", loc="left")
    return figure


def _time_of(table):
    """Middle of each period, or its number where frames have no epochs."""
    epochs = 0.5 * (np.asarray(table["first_epoch"]) + np.asarray(table["last_epoch"]))
    if np.isfinite(epochs).all():
        return epochs, "epoch [yr]"
    return np.arange(len(table)), "number of the period"
