"""Overview of a catalog: area on the sky, number of stars per magnitude, quality."""

import numpy as np
from astropy import units as u
from astropy.table import QTable
from scipy.ndimage import binary_erosion

from wpdc_gwcs.columns import numbers_or_nan
from wpdc_gwcs.sky import angles, directions

__all__ = ["count_by_magnitude", "distrusted", "sky_area"]

# Mean number of stars per cell, enough that no cell inside the area is empty by chance.
_STARS_PER_CELL = 8
# A thousand cells along a side are fine enough.
_FINEST = 10


def sky_area(catalog):
    """Estimate how much of the sky a catalog covers.

    Parameters
    ----------
    catalog : `~astropy.table.Table`
        As returned by `read_catalog`.

    Returns
    -------
    float
        Square degrees, accurate to a few percent for a thousand stars; 0 without stars.

    Notes
    -----
    Counts the square cells of an equal-area projection that have stars; cells at the edge count
    half.
    """
    if len(catalog) == 0:
        return 0.0
    outward = directions(np.asarray(catalog["ra"], float), np.asarray(catalog["dec"], float))[0]
    center = outward.mean(axis=1)
    center = center / max(np.linalg.norm(center), 1e-9)
    _, east, north = (v[:, 0] for v in directions(*angles(center[:, None])))
    # Lambert's azimuthal projection, which preserves areas.
    factor = np.sqrt(2 / np.maximum(1 + center @ outward, 1e-12))
    x, y = east @ outward * factor, north @ outward * factor
    # Rotated, so that the edges of a box do not coincide with those of cells.
    x, y = 0.8 * x + 0.6 * y, 0.8 * y - 0.6 * x
    side = max(np.ptp(x), np.ptp(y), 1e-12)
    area = side**2
    for n in 2 ** np.arange(1, _FINEST + 1):
        # A border of empty cells all around.
        seen = np.zeros((n + 3, n + 3), bool)
        seen[tuple(1 + ((v - v.min()) / side * n).astype(int) for v in (x, y))] = True
        if len(x) < _STARS_PER_CELL * seen.sum():
            break
        area = (seen.sum() + binary_erosion(seen).sum()) / 2 * (side / n) ** 2
    return float(area * np.degrees(1) ** 2)


def count_by_magnitude(catalog):
    """Count stars by magnitude.

    Parameters
    ----------
    catalog : `~astropy.table.Table`
        As returned by `read_catalog`.

    Returns
    -------
    `~astropy.table.QTable`
        ``mag_from`` and ``mag_to``, ``n``, ``density`` (per square degree of the catalog's
        area), ``with_motion`` (fraction) and ``position_error`` (median, mas, NaN where unknown).
    """
    mag = numbers_or_nan(catalog, "phot_g_mean_mag")
    motion = np.isfinite(numbers_or_nan(catalog, "pmra") * numbers_or_nan(catalog, "pmdec"))
    error = np.hypot(numbers_or_nan(catalog, "ra_error"), numbers_or_nan(catalog, "dec_error"))
    area = max(sky_area(catalog), np.finfo(float).tiny)
    known = np.isfinite(mag)
    low = np.unique(np.floor(mag[known]))
    rows = {name: [] for name in ("n", "with_motion", "position_error")}
    for one in low:
        here = known & (np.floor(mag) == one)
        errors = error[here & np.isfinite(error)] / np.sqrt(2)
        rows["n"].append(int(here.sum()))
        rows["with_motion"].append(float(motion[here].mean()))
        rows["position_error"].append(float(np.median(errors)) if len(errors) else np.nan)
    table = QTable({"mag_from": low * u.mag, "mag_to": (low + 1) * u.mag})
    table["n"] = np.array(rows["n"], int)
    table["density"] = table["n"] / area / u.deg**2
    table["with_motion"] = np.array(rows["with_motion"], float)
    table["position_error"] = np.array(rows["position_error"], float) * u.mas
    return table


def distrusted(catalog, *, max_ruwe=None, max_error=None):
    """Mark the stars whose astrometry is not good enough.

    Parameters
    ----------
    catalog : `~astropy.table.Table`
        As returned by `read_catalog`.
    max_ruwe : float, optional
        Largest accepted RUWE; above 1.4, a single-star solution is doubtful.
    max_error : float, optional
        Largest accepted position error along either axis, mas, at the epoch of the catalog.

    Returns
    -------
    dict
        Mask of the stars that break a rule, by the name of the rule; an unknown value breaks no
        rule.
    """
    broken = {}
    if max_ruwe is not None:
        broken[f"RUWE above {max_ruwe:g}"] = numbers_or_nan(catalog, "ruwe") > max_ruwe
    if max_error is not None:
        errors = [numbers_or_nan(catalog, f"{axis}_error") for axis in ("ra", "dec")]
        broken[f"error above {max_error:g} mas"] = np.fmax(*errors) > max_error
    return broken
