"""Residuals against magnitude."""

from dataclasses import dataclass

import numpy as np

from wpdc_gwcs.evaluation import evaluate, running_statistics
from wpdc_gwcs.plotting._style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    as_tables,
    get_columns,
    get_flags,
    given_axes,
    marker_size,
    new_figure,
    plain,
    running_percentiles,
    symmetric_limit,
)

__all__ = ["plot_centroids", "plot_magnitude", "plot_residuals_vs_magnitude"]


def plot_residuals_vs_magnitude(matches):
    """Draw the residuals of each axis against magnitude, and their scatter.

    Parameters
    ----------
    matches : `~astropy.table.Table`
        Matches with columns ``dx``, ``dy`` in px, and one of ``phot_g_mean_mag``, ``magnitude``,
        ``mag``, ``snr`` or ``x_err``; the first of these is used.

    Returns
    -------
    `matplotlib.figure.Figure`
        Three panels: the residuals of both axes with their running median and middle 68 %, and
        their standard deviations after 3-sigma clipping in equally filled bins.

    Raises
    ------
    ValueError
        If the table has none of these columns, or no ``x``, ``y``, ``dx`` or ``dy``.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import Table
    >>> from wpdc_gwcs.plotting import plot_residuals_vs_magnitude
    >>> x, y, dx, dy, mag = np.random.default_rng(1).uniform(18, 21, (5, 500))
    >>> table = Table({"x": x, "y": y, "dx": dx - 19.5, "dy": dy - 19.5, "mag": mag})
    >>> len(plot_residuals_vs_magnitude(table).axes)
    3
    """
    labels = _MAGNITUDES | {
        "snr": "signal-to-noise ratio",
        "x_err": r"stated error $\sigma_x$ [px]",
    }
    name = next((n for n in labels if n in matches.colnames), None)
    if name is None:
        raise ValueError(f"matches must have one of the columns {', '.join(labels)}")
    _, _, dx, dy = get_columns(matches)
    used, holdout = get_flags(matches)
    value = plain(matches[name])
    good = (used | holdout) & np.isfinite(value)
    value, dx, dy = value[good], dx[good], dy[good]
    figure = new_figure(11.5, 3.9)
    panels = figure.subplots(1, 3, sharex=True)
    panels[1].sharey(panels[0])
    limit = symmetric_limit(dx, dy)
    columns = ((dx, r"$\Delta X$", BLUE), (dy, r"$\Delta Y$", ORANGE))
    for axes, (residual, label, color) in zip(panels, columns):
        axes.plot(
            value, residual, ls="none", marker=".", ms=marker_size(len(value)), mew=0, alpha=0.5,
            color=color, rasterized=True,
        )  # fmt: skip
        center, low, middle, high = running_percentiles(value, residual)
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


def plot_magnitude(matches, *, axes=None, width=0.5):
    """Draw the residuals of both axes against magnitude, with mean and scatter in bins.

    Parameters
    ----------
    matches : `~astropy.table.Table` or iterable of them
        Columns ``x``, ``y``, ``dx``, ``dy`` in px and ``phot_g_mean_mag``, ``magnitude`` or
        ``mag``, and optionally ``used`` and ``holdout``.  Tables of several exposures are pooled.
    axes : two `matplotlib.axes.Axes`, optional
        Axes for dx and dy.  Default: new ones.
    width : float, optional
        Width of a bin, mag.

    Returns
    -------
    (2,) ndarray of `matplotlib.axes.Axes`
        Axes with the density of stars as shades, and the mean and 1 sigma of each bin, after
        3-sigma clipping.

    Raises
    ------
    ValueError
        If there is no column of magnitudes, no star has one, or the width is not positive.

    References
    ----------
    WPDC-2P, arXiv:2603.09193, figure of residuals against magnitude.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import Table
    >>> from wpdc_gwcs.plotting import plot_magnitude
    >>> x, y, dx, dy, mag = np.random.default_rng(1).uniform(18, 21, (5, 500))
    >>> table = Table({"x": x, "y": y, "dx": dx - 19.5, "dy": dy - 19.5, "mag": mag})
    >>> [a.get_xlabel() for a in plot_magnitude(table)]
    ['magnitude', 'magnitude']
    """
    value, dx, dy, label = _stars(matches)
    bins = _bins(value, dx, dy, width)
    axes = given_axes(axes, 2, 9.5, 4.0, sharey=True)
    _draw_bins(axes, value, dx, dy, bins, label)
    return axes


def plot_centroids(residuals, *, limit=None, axes=None, width=0.5):
    """Draw centroid errors against magnitude, and the photon limit.

    Parameters
    ----------
    residuals : `~astropy.table.Table` or iterable of them
        Columns ``x``, ``y``, ``dx``, ``dy`` (measured minus true position) in px and
        ``phot_g_mean_mag``, ``magnitude`` or ``mag``.  The stated errors ``x_err`` and ``y_err``,
        in px, are drawn as well if the table has them.
    limit : (mag, sigma), optional
        Magnitudes, and the photon limit of the centroid error along one axis in px.  They are a
        curve, or the limits of single stars, whose binned medians are drawn.
    axes : three `matplotlib.axes.Axes`, optional
        Axes for dx, dy and their scatter.  Default: new ones.
    width : float, optional
        Width of a bin, mag.

    Returns
    -------
    (3,) ndarray of `matplotlib.axes.Axes`
        The third one shows the scatter of each bin, after 3-sigma clipping, with the limit and the
        stated error.

    Raises
    ------
    ValueError
        If there is no column of magnitudes, no star has one, or the width is not positive.

    References
    ----------
    WPDC-2P, arXiv:2603.09193, figures of centroiding residuals.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import Table
    >>> from wpdc_gwcs.plotting import plot_centroids
    >>> x, y, dx, dy, mag = np.random.default_rng(1).uniform(18, 21, (5, 500))
    >>> table = Table({"x": x, "y": y, "dx": dx - 19.5, "dy": dy - 19.5, "mag": mag})
    >>> axes = plot_centroids(table, limit=([18, 21], [0.01, 0.04]))
    >>> axes[2].get_ylabel()
    'scatter [px]'
    """
    value, dx, dy, label = _stars(residuals)
    bins = _bins(value, dx, dy, width)
    axes = given_axes(axes, 3, 11.5, 3.9)
    _draw_bins(axes[:2], value, dx, dy, bins, label)
    scatter = axes[2]
    for k, (name, color, marker) in enumerate(
        ((r"$\sigma_{\Delta X}$", BLUE, "o"), (r"$\sigma_{\Delta Y}$", ORANGE, "s"))
    ):
        scatter.plot(bins.center, bins.sigma[k], marker, ls="-", ms=4, color=color, label=name)
    stated = _stated(residuals)
    if stated is not None:
        at, typical = _medians(*stated, width)
        scatter.plot(at, typical, color=GREEN, lw=5, alpha=0.4, zorder=1, label="stated error")
    if limit is not None:
        at, typical = (np.asarray(v, float) for v in limit)
        if len(at) > _MOST_OF_CURVE:
            at, typical = _medians(at, typical, width)
        scatter.plot(at, typical, color=BLACK, ls="--", label="photon limit")
        for panel in axes[:2]:
            for sign in (-1, 1):
                panel.plot(at, sign * typical, color=BLACK, ls="--", lw=1, zorder=5)
    scatter.set_yscale("log")
    scatter.set_xlim(axes[0].get_xlim())
    scatter.set_xlabel(label)
    scatter.set_ylabel("scatter [px]")
    scatter.legend(frameon=False, fontsize="small")
    return axes


_MAGNITUDES = {"phot_g_mean_mag": "G [mag]", "magnitude": "magnitude", "mag": "magnitude"}
# Least number of stars in a bin, and the number above which shades replace points.
_LEAST, _SHADED = 5, 3000
# More points than this are single stars, not a curve.
_MOST_OF_CURVE = 200


@dataclass(frozen=True, eq=False)
class _Bins:
    """Mean and scatter of both axes in bins of magnitude."""

    center: np.ndarray
    mean: np.ndarray
    sigma: np.ndarray


def _stars(matches):
    """Magnitude and residuals of the stars of all tables, and the label of the magnitude."""
    parts, names = [], set()
    for table in as_tables(matches):
        name = next((n for n in _MAGNITUDES if n in table.colnames), None)
        if name is None:
            raise ValueError(f"matches must have one of the columns {', '.join(_MAGNITUDES)}")
        names.add(name)
        _, _, dx, dy = get_columns(table)
        part = np.array([plain(table[name]), dx, dy])
        good = np.any(get_flags(table), axis=0) & np.isfinite(part).all(axis=0)
        parts.append(part[:, good])
    stars = np.concatenate(parts, axis=1)
    if stars.shape[1] == 0:
        raise ValueError("no match has a magnitude")
    label = _MAGNITUDES[names.pop()] if len(names) == 1 else "magnitude"
    return *stars, label


def _stated(residuals):
    """Magnitude and stated error of the stars of all tables; `None` if a table has no errors."""
    parts = []
    for table in as_tables(residuals):
        if not {"x_err", "y_err"} <= set(table.colnames):
            return None
        name = next(n for n in _MAGNITUDES if n in table.colnames)
        error = np.sqrt((plain(table["x_err"]) ** 2 + plain(table["y_err"]) ** 2) / 2)
        parts.append(np.array([plain(table[name]), error])[:, np.any(get_flags(table), axis=0)])
    return np.concatenate(parts, axis=1)


def _numbers(value, width):
    """Return the bin of each star and the bin centers; bins begin at multiples of the width."""
    first = np.floor(value.min() / width)
    number = (np.floor(value / width) - first).astype(int)
    return number, (first + np.arange(number.max() + 1) + 0.5) * width


def _split(number, values):
    order = np.argsort(number, kind="stable")
    ends = np.searchsorted(number[order], np.arange(1, number.max() + 1))
    return np.split(values[..., order], ends, axis=-1)


def _bins(value, dx, dy, width):
    if not width > 0:
        raise ValueError(f"width must be positive, in mag, got {width}")
    number, center = _numbers(value, width)
    parts = _split(number, np.array([dx, dy]))
    kept = [k for k, part in enumerate(parts) if part.shape[1] >= _LEAST]
    found = [evaluate(*parts[k]) for k in kept]
    return _Bins(
        center[kept],
        np.array([[s.mean_dx for s in found], [s.mean_dy for s in found]]),
        np.array([[s.sigma_dx for s in found], [s.sigma_dy for s in found]]),
    )


def _medians(value, error, width):
    good = np.isfinite(value) & np.isfinite(error)
    value, error = value[good], error[good]
    number, center = _numbers(value, width)
    parts = _split(number, error)
    kept = [k for k, part in enumerate(parts) if len(part) >= _LEAST]
    return center[kept], np.array([np.median(parts[k]) for k in kept])


def _draw_bins(axes, value, dx, dy, bins, label):
    limit = symmetric_limit(dx, dy)
    for k, (panel, residual, name) in enumerate(
        zip(axes, (dx, dy), (r"$\Delta X$", r"$\Delta Y$"), strict=True)
    ):
        if len(value) > _SHADED:
            panel.hexbin(
                value, residual, gridsize=(70, 45), cmap="Greys", bins="log", mincnt=1, lw=0.1,
                extent=(value.min(), value.max(), -limit, limit), rasterized=True,
            )  # fmt: skip
        else:
            panel.plot(
                value, residual, ls="none", marker=".", ms=marker_size(len(value)), mew=0,
                color=GREY, alpha=0.6, rasterized=True,
            )  # fmt: skip
        panel.axhline(0, color=BLACK, lw=0.6, ls=":")
        panel.errorbar(
            bins.center, bins.mean[k], yerr=bins.sigma[k], color=ORANGE, lw=1.6, capsize=2.5,
            marker="o", ms=3.5, zorder=4,
        )  # fmt: skip
        panel.set_ylim(-limit, limit)
        panel.set_xlabel(label)
        panel.set_ylabel(f"{name} [px]")
        panel.tick_params(labelleft=True)
