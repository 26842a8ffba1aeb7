"""Offsets on the sky, in RA against Dec, with histograms and Gaussian fits."""

import warnings

import numpy as np
from scipy.optimize import OptimizeWarning, curve_fit

from wpdc_gwcs.plotting._style import (
    BLUE,
    GREY,
    ORANGE,
    as_tables,
    get_flags,
    given_axes,
    marker_size,
    plain,
)
from wpdc_gwcs.robust import robust_scatter

__all__ = ["plot_sky_offsets"]

_MAS = 3.6e6
_COLUMNS = ("ra", "dec", "source_ra", "source_dec")
_N_BINS = 60
# Greatest number of points that are drawn.
_MOST_POINTS = 20_000


def plot_sky_offsets(matches, *, axes=None, limit=None, title=None):
    """Draw the offsets of sources from their reference stars, in RA against Dec.

    Parameters
    ----------
    matches : `~astropy.table.Table` or iterable of them
        Columns ``ra``, ``dec`` of the reference star and ``source_ra``, ``source_dec`` of the
        source, in deg, as in ``matches.ecsv``, and optionally ``used`` and ``holdout``.  Tables of
        several exposures are pooled.
    axes : `matplotlib.axes.Axes`, optional
        Axes to draw into: they are divided into the offsets and, above and to the right, their
        histograms.  Default: new ones.
    limit : float, optional
        Half of the range that is shown, mas.  Default: the mean plus five times the scatter.
    title : str, optional
        Title of the figure.

    Returns
    -------
    (3,) ndarray of `matplotlib.axes.Axes`
        Offsets, histogram in RA, histogram in Dec.

    Raises
    ------
    ValueError
        If a column is missing, or no offset is finite.

    Notes
    -----
    Offsets are source minus reference, in RA times cos Dec.  Means and sigmas are those of
    Gaussians fitted to the histograms.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import Table
    >>> from wpdc_gwcs.plotting import plot_sky_offsets
    >>> d_ra, d_dec = np.random.default_rng(1).normal(0, 5 / 3.6e6, (2, 1000))
    >>> star = np.full(1000, 30.0)
    >>> table = Table({"ra": star, "dec": star})
    >>> table["source_ra"], table["source_dec"] = star + d_ra, star + d_dec
    >>> axes = plot_sky_offsets(table)
    >>> axes[0].texts[0].get_text()
    '1000 stars'
    """
    from mpl_toolkits.axes_grid1 import make_axes_locatable

    d_ra, d_dec = _offsets(matches)
    fits = [_fit_gaussian(values) for values in (d_ra, d_dec)]
    if limit is None:
        limit = max(abs(mean) + 5 * sigma for mean, sigma, _ in fits)
    axes = given_axes(axes, 1, 5.6, 5.4)[0]
    shown = np.random.default_rng(0).permutation(len(d_ra))[:_MOST_POINTS]
    axes.plot(
        d_ra[shown], d_dec[shown], ls="none", marker=".", ms=marker_size(len(shown)), mew=0,
        alpha=0.35, color=BLUE, rasterized=True,
    )  # fmt: skip
    axes.axhline(0, color="black", lw=0.6, ls=":")
    axes.axvline(0, color="black", lw=0.6, ls=":")
    axes.set_xlim(-limit, limit)
    axes.set_ylim(-limit, limit)
    axes.set_aspect("equal")
    axes.set_xlabel(r"$\Delta\alpha\,\cos\delta$ [mas]")
    axes.set_ylabel(r"$\Delta\delta$ [mas]")
    divider = make_axes_locatable(axes)
    above = divider.append_axes("top", "25%", pad=0.08, sharex=axes)
    right = divider.append_axes("right", "25%", pad=0.08, sharey=axes)
    edges = np.linspace(-limit, limit, _N_BINS + 1)
    fine = np.linspace(-limit, limit, 400)
    for panel, values, (mean, sigma, top), turned in (
        (above, d_ra, fits[0], False),
        (right, d_dec, fits[1], True),
    ):
        orientation = "horizontal" if turned else "vertical"
        counts, _ = np.histogram(values, edges)
        panel.stairs(counts, edges, fill=True, color=GREY, alpha=0.7, orientation=orientation)
        curve = top * (edges[1] - edges[0]) * np.exp(-0.5 * ((fine - mean) / sigma) ** 2)
        panel.plot(*((curve, fine) if turned else (fine, curve)), color=ORANGE, lw=1.6)
        panel.tick_params(labelbottom=False, labelleft=False)
        if turned:
            panel.set_xticks([])
        else:
            panel.set_yticks([])
        text = rf"$\mu$ = {mean:.3f}" + "\n" + rf"$\sigma$ = {sigma:.3f}"
        where = {"x": 0.95, "ha": "right"} if turned else {"x": 0.03, "ha": "left"}
        panel.text(y=0.97, s=text, transform=panel.transAxes, va="top", fontsize="small", **where)
    axes.text(
        0.02,
        0.98,
        f"{title + ', ' if title else ''}{len(d_ra)} stars",
        transform=axes.transAxes,
        va="top",
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1},
    )
    return np.array([axes, above, right])


def _offsets(matches):
    parts = []
    for table in as_tables(matches):
        missing = [name for name in _COLUMNS if name not in table.colnames]
        if missing:
            raise ValueError(
                f"matches must have the columns {', '.join(_COLUMNS)}; no {', '.join(missing)}"
            )
        ra, dec, source_ra, source_dec = (plain(table[name]) for name in _COLUMNS)
        d_ra = (source_ra - ra + 180.0) % 360.0 - 180.0
        part = np.array([d_ra * np.cos(np.radians(dec)), source_dec - dec]) * _MAS
        good = np.any(get_flags(table), axis=0) & np.isfinite(part).all(axis=0)
        parts.append(part[:, good])
    offsets = np.concatenate(parts, axis=1)
    if offsets.shape[1] == 0:
        raise ValueError("no match has finite offsets")
    return offsets


def _fit_gaussian(values):
    """Fit a Gaussian to the histogram: mean, sigma, stars per mas at the top.

    If the fit does not converge, median and robust scatter take its place.
    """
    middle, scatter = float(np.median(values)), robust_scatter(values)
    if not scatter > 0:
        scatter = max(float(np.std(values)), np.finfo(np.float32).tiny)
    edges = middle + scatter * np.linspace(-4, 4, _N_BINS + 1)
    height, _ = np.histogram(values, edges)
    center = 0.5 * (edges[1:] + edges[:-1])

    def gaussian(x, top, mean, sigma):
        return top * np.exp(-0.5 * ((x - mean) / sigma) ** 2)

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", OptimizeWarning)
            (top, mean, sigma), _ = curve_fit(
                gaussian, center, height, p0=(height.max(), middle, scatter)
            )
    except RuntimeError:
        top, mean, sigma = height.max(), middle, scatter
    return float(mean), abs(float(sigma)), float(top / (edges[1] - edges[0]))
