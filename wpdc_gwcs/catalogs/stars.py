"""Repeated rows of a star in a catalog."""

import warnings

import numpy as np

from wpdc_gwcs.copies import group_copies
from wpdc_gwcs.counts import counted
from wpdc_gwcs.exceptions import WPDCWarning
from wpdc_gwcs.sky import directions, move

__all__ = ["one_of_each", "read_identifiers"]

# Largest distance of copies of a star, arcsec; twice this for rows with the same identifier.
_COPY_REACH = 1.0
_MAS = np.pi / 180.0 / 3.6e6


def one_of_each(columns, keep, identifiers, name):
    """Mark one row per star among the rows that are kept.

    Parameters
    ----------
    columns : dict
        Columns of the checked table.
    keep : (N,) ndarray of bool
        Rows kept so far.
    identifiers : (N,) ndarray or None
        Identifiers of the stars.
    name : str
        Name of the input in messages.

    Returns
    -------
    (n,) ndarray of bool
        Mask over the kept rows: for each star, the row with the most and most precise values.

    Warns
    -----
    WPDCWarning
        If rows repeat a star.
    """
    part = {c: v[keep] for c, v in columns.items()}
    n = len(part["ra"])
    ra, dec = _at_one_epoch(part)
    points = np.stack(directions(ra, dec)[0], axis=1)
    links = None
    if identifiers is not None:
        links = _same_identifier(identifiers[keep], points)
    errors = None
    if "ra_error" in part and "dec_error" in part:
        errors = np.hypot(part["ra_error"], part["dec_error"]) / np.sqrt(2) * _MAS
    star = group_copies(
        points,
        reach=_COPY_REACH * 1e3 * _MAS,
        errors=errors,
        mag=part.get("phot_g_mean_mag"),
        links=links,
    )
    known = np.zeros(n)
    for column in ("pmra", "pmdec", "phot_g_mean_mag", "parallax"):
        if column in part:
            known += np.isfinite(part[column])
    rank = np.nan_to_num(errors, nan=np.inf) if errors is not None else np.zeros(n)
    order = np.lexsort((np.arange(n), rank, -known, star))
    first = np.concatenate([[True], star[order][1:] != star[order][:-1]])
    best = np.zeros(n, bool)
    best[order[first]] = True
    if not best.all():
        again = np.flatnonzero(~best)
        warnings.warn(
            f"{name}: {len(again)} of {counted(n, 'row')} repeat a star that another row has (for "
            f"example at RA {part['ra'][again[0]]:.6f} Dec {part['dec'][again[0]]:.6f} deg): one "
            "row per star is kept",
            WPDCWarning,
        )
    return best


def _at_one_epoch(part):
    """Positions at a common epoch, if the rows have different epochs and motions."""
    ra, dec = part["ra"], part["dec"]
    if not {"pmra", "pmdec", "ref_epoch"} <= set(part) or np.ptp(part["ref_epoch"]) == 0:
        return ra, dec
    years = np.nanmedian(part["ref_epoch"]) - part["ref_epoch"]
    known = np.isfinite(years * part["pmra"] * part["pmdec"])
    ra, dec = ra.copy(), dec.copy()
    ra[known], dec[known] = move(
        ra[known], dec[known], part["pmra"][known], part["pmdec"][known], years[known]
    )[:2]
    return ra, dec


def _same_identifier(identifiers, points):
    """Pairs of rows with the same identifier; none if identifiers are not unique to stars."""
    order = np.argsort(identifiers, kind="stable")
    i, j = order[:-1], order[1:]
    same = (identifiers[i] == identifiers[j]) & (identifiers[i] > 0)
    i, j = i[same], j[same]
    near = np.linalg.norm(points[i] - points[j], axis=1) <= 2 * _COPY_REACH * 1e3 * _MAS
    return (i[near], j[near]) if 2 * near.sum() > len(near) else (i[:0], j[:0])


def read_identifiers(table, spelled):
    """Read integer identifiers of the stars.

    Parameters
    ----------
    table : `~astropy.table.Table`
        The input.
    spelled : dict
        Names of its columns.

    Returns
    -------
    (N,) ndarray or None
        Identifiers, 0 for none; `None` without such a column.
    """
    if "source_id" not in spelled:
        return None
    column = table[spelled["source_id"]]
    values = np.ma.getdata(column)
    if np.asarray(values).dtype.kind not in "iu":
        return None
    mask = getattr(column, "mask", None)
    return np.asarray(values) if mask is None else np.where(mask, 0, np.asarray(values))
