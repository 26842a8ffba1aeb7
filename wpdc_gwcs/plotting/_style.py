"""Parts that all figures share: colors, sizes, limits, columns."""

import numpy as np
from astropy.stats import SigmaClip

from wpdc_gwcs.evaluation import evaluate

__all__ = [
    "BLACK",
    "BLUE",
    "DIVERGING",
    "GREEN",
    "GREY",
    "ORANGE",
    "OTHERS",
    "SEQUENTIAL",
    "as_tables",
    "clipped_statistics",
    "format_px",
    "frame_detector",
    "get_columns",
    "get_flags",
    "marker_size",
    "given_axes",
    "new_figure",
    "plain",
    "pool",
    "round_number",
    "running_percentiles",
    "symmetric_limit",
]

#: The colors of Okabe and Ito, which are distinct for every kind of color vision.
BLUE, ORANGE, GREEN, GREY, BLACK = "#0072B2", "#D55E00", "#009E73", "#999999", "#000000"
OTHERS = (GREEN, "#CC79A7", BLACK)
DIVERGING, SEQUENTIAL = "RdBu_r", "viridis"


def new_figure(width, height):
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def given_axes(axes, n, width, height, **options):
    """Return the ``n`` given axes, or new ones side by side."""
    if axes is None:
        return new_figure(width, height).subplots(1, n, squeeze=False, **options)[0]
    axes = np.ravel(axes)
    if len(axes) != n:
        raise ValueError(f"axes must be {n}, got {len(axes)}")
    return axes


def pool(matches):
    """Positions and residuals of the usable stars of one or several tables."""
    tables = as_tables(matches)
    columns = [np.array(get_columns(t))[:, np.any(get_flags(t), axis=0)] for t in tables]
    return np.concatenate(columns, axis=1)


def as_tables(matches):
    """One table, or several, as a list."""
    tables = [matches] if hasattr(matches, "colnames") else list(matches)
    if not tables:
        raise ValueError("no table of matches was given")
    return tables


def clipped_statistics(values):
    """Mean, and the two ends of the middle 68.27 %, after 3-sigma clipping; NaN if empty."""
    values = values[np.isfinite(values)]
    if values.size == 0:
        return np.full(3, np.nan)
    values = np.asarray(SigmaClip(sigma=3.0, maxiters=None)(values, masked=False))
    return np.array([values.mean(), *np.percentile(values, (15.865, 84.135))])


def frame_detector(axes, image_shape):
    """Label the axes of a map and draw the outer edge of the detector's pixels."""
    ny, nx = image_shape
    axes.plot(
        [-0.5, nx - 0.5, nx - 0.5, -0.5, -0.5],
        [-0.5, -0.5, ny - 0.5, ny - 0.5, -0.5],
        color=GREY,
        lw=0.8,
    )
    axes.set_aspect("equal")
    axes.set_xlabel("x [px]")
    axes.set_ylabel("y [px]")


def get_columns(matches):
    """Positions and residuals of a match table as plain arrays."""
    missing = [name for name in ("x", "y", "dx", "dy") if name not in matches.colnames]
    if missing:
        raise ValueError(f"matches must have the columns x, y, dx, dy; no {', '.join(missing)}")
    return tuple(plain(matches[name]) for name in ("x", "y", "dx", "dy"))


def get_flags(matches):
    """Masks of the matches that were used and held out; without such columns, all were used."""
    n = len(matches)
    given = matches.colnames
    holdout = np.asarray(matches["holdout"], bool) if "holdout" in given else np.zeros(n, bool)
    used = np.asarray(matches["used"], bool) if "used" in given else ~holdout
    return used, holdout


def plain(column):
    return np.asarray(getattr(column, "value", column), dtype=float)


def running_percentiles(position, values, *, n_bins=25):
    """Median and middle 68 % of values in equally filled bins of position, at the bins' medians."""
    finite = np.isfinite(position) & np.isfinite(values)
    position, values = position[finite], values[finite]
    # Bins of fewer than 10 stars would show noise.
    n_bins = max(1, min(n_bins, len(position) // 10))
    if not len(position):
        return np.empty((4, 0))
    rows = np.array_split(np.argsort(position, kind="stable"), n_bins)
    return np.array(
        [[np.median(position[i]), *np.percentile(values[i], (16, 50, 84))] for i in rows]
    ).T


def symmetric_limit(*residuals):
    """Limit of an axis that shows residuals: their mean plus five times their scatter."""
    stats = evaluate(*residuals)
    limit = max(abs(stats.mean_dx), abs(stats.mean_dy))
    limit += 5 * max(stats.scatter_dx, stats.scatter_dy)
    return limit if limit > 0 else 1.0


def marker_size(n):
    return float(np.clip(120 / np.sqrt(max(n, 1)), 2, 6))


def round_number(value):
    """Round to the nearest of 1, 2 or 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(value))
    steps = np.array([1.0, 2.0, 5.0, 10.0])
    return float(steps[np.argmin(np.abs(np.log(value / power / steps)))] * power)


def format_px(value):
    return f"{value:.2g}" if abs(value) < 1 else f"{value:.1f}"
