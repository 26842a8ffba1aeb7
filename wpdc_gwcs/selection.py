"""Selection of the sources for a match: the definition of a usable star."""

from functools import lru_cache

import numpy as np
from scipy.spatial import KDTree

from wpdc_gwcs.columns import read_numbers
from wpdc_gwcs.counts import counted
from wpdc_gwcs.detector import on_detector
from wpdc_gwcs.flags import FLAG_NAMES
from wpdc_gwcs.threads import count_threads

__all__ = ["MAX_ROUNDNESS", "MIN_SNR", "judge_sources", "left_out", "select_sources"]

# Criteria for stars (section 3.1 of the paper): rounder than galaxies, and well measured.
MAX_ROUNDNESS = 0.3
MIN_SNR = 10.0

# The typical roundness is that of neighboring stars if there are enough, because optics and field
# rotation stretch stars differently over a detector; else that of all stars.
_NEIGHBORS = 40
_MIN_LOCAL = 120
# Sources whose roundness is more than noise, by signal-to-noise ratio; without any, all.
_ROUND_SNR = 30.0
_MIN_ROUND = 10
# Scatter of the roundness by noise, times the signal-to-noise ratio; how many times it counts.
_ROUNDNESS_NOISE = 1.0
_N_SIGMA = 2.5


def select_sources(sources, *, image_shape=None, max_roundness=MAX_ROUNDNESS, min_snr=MIN_SNR):
    """Mark the sources for a match: those with a position, clean, round and bright enough.

    Parameters
    ----------
    sources : `~astropy.table.Table`
        As for `match_sources`.
    image_shape : (int, int), optional
        Shape ``(ny, nx)`` of the detector, to leave out sources outside of it.
    max_roundness : float, optional
        Largest difference from the typical roundness of the stars of the frame, beyond noise.
    min_snr : float, optional
        Smallest signal-to-noise ratio.

    Returns
    -------
    (N,) ndarray of bool
        True for selected sources.

    Notes
    -----
    Roundness is relative to the stars of the frame: the typical roundness is the most frequent one,
    among the nearest stars if there are more than a hundred.  Unknown values (NaN, or a missing
    column) exclude nothing.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import Table
    >>> from wpdc_gwcs.matching import select_sources
    >>> trailed = Table({"x": [1.0, 2.0, 3.0], "y": [1.0, 2.0, 3.0], "roundness": [0.8, 0.8, 0.0]})
    >>> select_sources(trailed).tolist()
    [True, True, False]
    """
    rules = judge_sources(
        sources, image_shape=image_shape, max_roundness=max_roundness, min_snr=min_snr
    )
    return ~np.any(list(rules.values()), axis=0)


def judge_sources(sources, *, image_shape=None, max_roundness=MAX_ROUNDNESS, min_snr=MIN_SNR):
    """Return the sources that each rule excludes.

    Parameters
    ----------
    sources : `~astropy.table.Table` or mapping
        As for `select_sources`; missing columns of a mapping may be `None`.
    image_shape : (int, int), optional
        Shape ``(ny, nx)`` of the detector, to leave out sources outside of it.
    max_roundness, min_snr : float, optional
        As for `select_sources`.

    Returns
    -------
    dict
        An (N,) mask for each rule, by a description of the excluded sources; a source that breaks
        several rules counts for the first one.
    """
    x, y = (_column(sources, name) for name in ("x", "y"))
    rules = {"without a position": ~(np.isfinite(x) & np.isfinite(y))}
    with np.errstate(invalid="ignore"):
        if image_shape is not None:
            rules["beside the detector"] = ~on_detector(x, y, image_shape)
        flags = _column(sources, "flags")
        if flags is not None:
            flags = np.nan_to_num(flags).astype(np.int64)
            for bit, name in FLAG_NAMES.items():
                rules[name] = flags & bit != 0
            rules["with other flags"] = flags & ~sum(FLAG_NAMES) != 0
        snr = _column(sources, "snr")
        snr = np.full(len(x), np.nan) if snr is None else snr
        rules[f"below S/N {min_snr:g}"] = snr < min_snr
        roundness = _column(sources, "roundness")
        if roundness is not None:
            clean = ~np.any(list(rules.values()), axis=0)
            off, scatter = _roundness_difference(
                *(np.ascontiguousarray(v, float).tobytes() for v in (x, y, roundness, snr)),
                clean.tobytes(),
            )
            noise = np.hypot(scatter, _ROUNDNESS_NOISE / np.where(snr > 0, snr, np.inf))
            rules["not round"] = np.abs(off) > np.hypot(max_roundness, _N_SIGMA * noise)
    seen = np.zeros(len(x), bool)
    for name, out in rules.items():
        rules[name] = out & ~seen
        seen |= out
    return rules


def left_out(rules):
    """Describe how many sources each rule excludes.

    Parameters
    ----------
    rules : dict
        As from `judge_sources`.

    Returns
    -------
    str
        For example "593 of 602 sources left out: 590 not round, 3 saturated".
    """
    counts = {name: int(out.sum()) for name, out in rules.items() if out.any()}
    total = sum(counts.values())
    of = len(next(iter(rules.values())))
    if total == 0:
        return f"none of {counted(of, 'source')} left out"
    parts = sorted(counts.items(), key=lambda item: -item[1])
    return f"{total} of {counted(of, 'source')} left out: " + ", ".join(
        f"{n} {name}" for name, n in parts
    )


def _column(sources, name):
    if name not in getattr(sources, "colnames", sources):
        return None
    column = sources[name]
    return None if column is None else read_numbers(column)[0]


# Cached: every stage needs the same sources, and finding neighbors is slow.
@lru_cache(maxsize=1)
def _roundness_difference(x, y, roundness, snr, clean):
    """Difference of the roundness from the typical one of the frame or its part, and scatter.

    The scatter is that of bright stars about the typical value.  Columns are passed as bytes.
    """
    x, y, roundness, snr = (np.frombuffer(v) for v in (x, y, roundness, snr))
    clean = np.frombuffer(clean, bool)
    known = clean & np.isfinite(roundness)
    bright = known & ~(snr < _ROUND_SNR)
    known = bright if bright.sum() >= _MIN_ROUND else known
    rows = np.flatnonzero(known)
    if len(rows) < _MIN_ROUND:
        # For a handful of stars, the median is as good as anything.
        return roundness - (np.median(roundness[rows]) if len(rows) > 2 else 0.0), 0.0
    typical = np.full(len(x), _crowded_half(roundness[rows])[0])
    if len(rows) >= _MIN_LOCAL:
        # Sources that another rule excludes need not be judged.
        placed = np.flatnonzero(clean & np.isfinite(x) & np.isfinite(y))
        tree = KDTree(np.column_stack([x[rows], y[rows]]))
        _, near = tree.query(
            np.column_stack([x[placed], y[placed]]), k=_NEIGHBORS, workers=count_threads()
        )
        typical[placed] = np.median(roundness[rows][near], axis=1)
    difference = roundness - typical
    return difference, _crowded_half(difference[rows])[1]


def _crowded_half(values):
    """Center and scatter of the shortest half of the values: the value typical of stars."""
    values = np.sort(values)
    n = (len(values) + 1) // 2
    width = values[n - 1 :] - values[: len(values) - n + 1]
    first = int(np.argmin(width))
    # Half of a normal distribution lies within 0.674 standard deviations.
    return float(np.median(values[first : first + n])), float(width[first] / 1.349)
