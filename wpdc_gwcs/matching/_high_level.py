"""Matching of tables and sky positions: checks and projects, then calls the core."""

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.table import QTable
from astropy.wcs.wcsapi import HighLevelWCSWrapper

from wpdc_gwcs.columns import convert, read_numbers, unit_of
from wpdc_gwcs.counts import counted
from wpdc_gwcs.exceptions import MatchError
from wpdc_gwcs.matching._core import match_planes
from wpdc_gwcs.models import local_plane, project
from wpdc_gwcs.selection import MAX_ROUNDNESS, MIN_SNR, judge_sources, left_out
from wpdc_gwcs.sky import move

__all__ = ["match_sources", "pair_table"]


def match_sources(
    sources,
    catalog,
    wcs,
    *,
    image_shape=None,
    epoch=None,
    max_roundness=MAX_ROUNDNESS,
    min_snr=MIN_SNR,
    max_mag=None,
    **options,
):
    """Match detected sources to a reference catalog.

    Parameters
    ----------
    sources : `~astropy.table.Table` or `~astropy.coordinates.SkyCoord`
        Columns ``x``, ``y`` in px, zero based; ``x_err``, ``y_err``, ``flux``, ``snr``,
        ``roundness`` and ``flags`` are used where they exist.  A `~astropy.coordinates.SkyCoord`
        stands for positions that the starting WCS gave.
    catalog : `~astropy.table.Table` or `~astropy.coordinates.SkyCoord`
        Columns ``ra``, ``dec`` (deg unless they have a unit, ICRS); ``phot_g_mean_mag`` and, with
        an `epoch`, ``pmra``, ``pmdec`` (mas / yr) and ``ref_epoch`` (yr) are used where they
        exist.
    wcs : object
        Starting WCS with the shared interface of Astropy (`astropy.wcs.WCS`, `gwcs.WCS`).
    image_shape : (int, int), optional
        Shape of the frame, ``(ny, nx)``; by default that of the WCS, or the range of the sources.
    epoch : float or `~astropy.time.Time`, optional
        Epoch of the frame in Julian years, to which the catalog is moved.  By default, the
        catalog is used as it is.
    max_roundness, min_snr : float, optional
        Selection of the sources, see `select_sources`.
    max_mag : float, optional
        Magnitude of the faintest reference stars used.
    **options
        Fields of `MatchOptions`: the range of the search, the evidence needed.

    Returns
    -------
    matches : `~astropy.table.QTable`
        One row per pair: ``source_index``, ``catalog_index`` (rows of the inputs, zero based),
        ``x``, ``y`` [pix] as measured, ``ra``, ``dec`` [deg] of the reference star at the epoch,
        ``dx``, ``dy`` [pix] the source minus its reference star in pixels of the starting WCS, and
        ``separation`` [pix] the remaining distance after the smooth mapping.
    diagnostics : MatchDiagnostics
        Evidence, the smooth mapping found, timings.

    Raises
    ------
    MatchError
        If the evidence for a match is insufficient; the message says why.
    ValueError
        If a column is missing or has the wrong unit, or the WCS cannot be used.
    TypeError
        If the sources or the catalog are neither a table nor coordinates.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import Table
    >>> from astropy.wcs import WCS
    >>> from wpdc_gwcs import match_sources
    >>> wcs = WCS(naxis=2)
    >>> wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    >>> wcs.wcs.crval, wcs.wcs.crpix, wcs.wcs.cdelt = [10, 20], [501, 501], [-1e-4, 1e-4]
    >>> rng = np.random.default_rng(1)
    >>> x, y = rng.uniform(0, 1000, (2, 100))
    >>> sky = wcs.pixel_to_world(x + 15, y - 8)
    >>> matches, diagnostics = match_sources(
    ...     Table({"x": x, "y": y}), sky, wcs, image_shape=(1000, 1000)
    ... )
    >>> len(matches), bool((matches["source_index"] == matches["catalog_index"]).all())
    (100, True)
    >>> [round(v) for v in diagnostics.shift]
    [15, -8]
    """
    wcs = wcs if hasattr(wcs, "pixel_to_world") else HighLevelWCSWrapper(wcs)
    columns = _read_sources(sources, wcs)
    ra, dec, mag = _read_catalog(catalog, epoch)
    x, y = columns["x"], columns["y"]
    if image_shape is None:
        image_shape = _find_shape(wcs, x, y)
    rules = judge_sources(columns, max_roundness=max_roundness, min_snr=min_snr)
    rows = np.flatnonzero(~np.any(list(rules.values()), axis=0))
    if len(rows) == 0:
        raise MatchError(f"no source can be used: {left_out(rules)}")
    pixels = _tangent_plane(wcs, image_shape)
    sky = wcs.pixel_to_world(x[rows], y[rows]).icrs
    xs, ys = pixels(sky.ra.deg, sky.dec.deg)
    xr, yr = pixels(ra, dec)
    if max_mag is not None and mag is not None:
        # Rows keep their numbers: positions outside the plane are not used.
        xr = np.where(mag > max_mag, np.nan, xr)

    def part(name):
        return None if columns[name] is None else columns[name][rows]

    i, j, diagnostics = match_planes(
        xs,
        ys,
        xr,
        yr,
        image_shape=image_shape,
        flux=part("flux"),
        mag=mag,
        x_err=part("x_err"),
        y_err=part("y_err"),
        **options,
    )
    k = rows[i]
    matches = pair_table(
        diagnostics,
        source_index=k,
        catalog_index=j,
        detector=(x[k], y[k]),
        sky=(ra[j], dec[j]),
        start=(xs[i], ys[i]),
        reference=(xr[j], yr[j]),
    )
    return matches, diagnostics


def pair_table(diagnostics, *, source_index, catalog_index, detector, sky, start, reference):
    """Build the table of the pairs of a match.

    Parameters
    ----------
    diagnostics : MatchDiagnostics
        Diagnostics of the match, for the ``meta`` of the table.
    source_index, catalog_index : (n,) array_like of int
        Rows of the pairs in the two lists.
    detector : (x, y)
        Measured positions of the sources, px.
    sky : (ra, dec)
        Positions of the reference stars at the epoch of the frame, deg.
    start, reference : (x, y)
        Sources and reference stars in the plane in which they were matched, px.

    Returns
    -------
    `~astropy.table.QTable`
        Columns as described at `match_sources`.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.matching import match_planes, pair_table
    >>> x, y = np.random.default_rng(1).uniform(0, 1000, (2, 200))
    >>> ra, dec = 10.0 - 1e-4 * x, 1e-4 * y
    >>> i, j, found = match_planes(x, y, x + 15, y - 8, image_shape=(1000, 1000))
    >>> pairs = pair_table(
    ...     found, source_index=i, catalog_index=j, detector=(x[i], y[i]), sky=(ra[j], dec[j]),
    ...     start=(x[i], y[i]), reference=(x[j] + 15, y[j] - 8),
    ... )
    >>> len(pairs), pairs.colnames[:4], round(float(pairs["dx"][0].value), 6)
    (200, ['source_index', 'catalog_index', 'x', 'y'], -15.0)
    """
    mapped = diagnostics.mapping(*start)
    return QTable(
        {
            "source_index": np.asarray(source_index, int),
            "catalog_index": np.asarray(catalog_index, int),
            "x": detector[0] * u.pix,
            "y": detector[1] * u.pix,
            "ra": sky[0] * u.deg,
            "dec": sky[1] * u.deg,
            "dx": (start[0] - reference[0]) * u.pix,
            "dy": (start[1] - reference[1]) * u.pix,
            "separation": np.hypot(*np.subtract(mapped, reference)) * u.pix,
        },
        meta={"evidence": diagnostics.to_dict()},
    )


def _values(table, name, unit=None, *, required=None):
    """Column as a float array, with NaN for masked values; None if it is missing."""
    if name not in table.colnames:
        if required:
            raise ValueError(f"{required} must have a column {name!r}; it has {table.colnames}")
        return None
    try:
        values = read_numbers(table[name])[0]
    except ValueError as problem:
        raise ValueError(f"column {name!r} {problem}") from None
    given = unit_of(table[name], unit)
    try:
        return values if unit is None else convert(values, given, unit)
    except ValueError:
        raise ValueError(f"column {name!r} must have a unit like {unit}; got {given}") from None


def _read_sources(sources, wcs):
    names = ("x_err", "y_err", "flux", "snr", "roundness", "flags")
    if isinstance(sources, SkyCoord):
        x, y = wcs.world_to_pixel(sources)
        return {"x": np.atleast_1d(x), "y": np.atleast_1d(y), **dict.fromkeys(names)}
    if not hasattr(sources, "colnames"):
        raise TypeError(f"sources must be a Table or a SkyCoord; got {type(sources).__name__}")
    columns = {name: _values(sources, name, required="sources") for name in ("x", "y")}
    return columns | {name: _values(sources, name) for name in names}


def _read_catalog(catalog, epoch):
    """Positions in deg at the epoch, and magnitudes."""
    if isinstance(catalog, SkyCoord):
        icrs = catalog.icrs
        ra, dec, mag = np.atleast_1d(icrs.ra.deg), np.atleast_1d(icrs.dec.deg), None
        motion = None
        if "s" in icrs.data.differentials and catalog.obstime is not None:
            unit = u.mas / u.yr
            motion = (
                np.atleast_1d(icrs.pm_ra_cosdec.to_value(unit)),
                np.atleast_1d(icrs.pm_dec.to_value(unit)),
                np.broadcast_to(catalog.obstime.jyear, ra.shape),
            )
    elif hasattr(catalog, "colnames"):
        ra = _values(catalog, "ra", u.deg, required="catalog")
        dec = _values(catalog, "dec", u.deg, required="catalog")
        mag = _values(catalog, "phot_g_mean_mag")
        motion = tuple(
            _values(catalog, name, unit)
            for name, unit in (
                ("pmra", u.mas / u.yr),
                ("pmdec", u.mas / u.yr),
                ("ref_epoch", u.yr),
            )
        )
        motion = None if any(m is None for m in motion) else motion
    else:
        raise TypeError(f"catalog must be a Table or a SkyCoord; got {type(catalog).__name__}")
    if epoch is None or motion is None:
        return ra, dec, mag
    pmra, pmdec, ref_epoch = motion
    years = float(getattr(epoch, "jyear", epoch)) - ref_epoch
    # Stars without a proper motion are not moved.
    known = np.isfinite(pmra) & np.isfinite(pmdec) & np.isfinite(years)
    ra, dec = np.array(ra), np.array(dec)
    ra[known], dec[known] = move(ra[known], dec[known], pmra[known], pmdec[known], years[known])[:2]
    return ra, dec, mag


def _find_shape(wcs, x, y):
    shape = getattr(wcs, "array_shape", None)
    if shape is None and getattr(wcs, "low_level_wcs", None) is not None:
        shape = wcs.low_level_wcs.array_shape
    if shape is not None:
        return tuple(int(n) for n in shape)
    if not (np.isfinite(x) & np.isfinite(y)).any():
        raise MatchError(f"none of {counted(len(x), 'source')} has a finite position")
    return int(np.ceil(np.nanmax(y))) + 1, int(np.ceil(np.nanmax(x))) + 1


def _tangent_plane(wcs, image_shape):
    """Return the linear map of the tangent plane of the WCS at the center of the frame.

    Returns a function from RA and Dec to pixels.
    """
    ny, nx = image_shape
    center = np.array([0.5 * (nx - 1), 0.5 * (ny - 1)])

    def sky(x, y):
        icrs = wcs.pixel_to_world(x, y).icrs
        return icrs.ra.deg, icrs.dec.deg

    crval, cd = local_plane(sky, *center, step=0.5)
    if not np.isfinite(crval).all():
        raise ValueError("wcs must have a sky position at the center of the frame, has none")
    if not np.isfinite(cd).all() or abs(np.linalg.det(cd)) == 0:
        raise ValueError("wcs must be invertible at the center of the frame, is not")

    def pixels(ra, dec):
        plane = np.array(project(ra, np.where(np.abs(dec) <= 90, dec, np.nan), crval))
        return np.linalg.solve(cd, plane) + center[:, None]

    return pixels
