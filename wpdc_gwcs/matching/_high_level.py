"""Matching of tables and sky positions: checks and projects, then calls the core."""

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.table import QTable
from astropy.wcs import WCS
from astropy.wcs.wcsapi import HighLevelWCSWrapper

from wpdc_gwcs.exceptions import MatchError
from wpdc_gwcs.matching._core import match_planes
from wpdc_gwcs.selection import MAX_ROUNDNESS, MIN_SNR, judge_sources, left_out

__all__ = ["match_sources", "pair_table"]


def match_sources(
    sources,
    catalog,
    wcs,
    *,
    image_shape=None,
    epoch=None,
    blind=False,
    max_roundness=MAX_ROUNDNESS,
    min_snr=MIN_SNR,
    max_mag=None,
    **options,
):
    """Match detected sources to a reference catalogue.

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
        Shape of the frame, ``(ny, nx)``; by default that of the WCS, or what the sources span.
    epoch : float or `~astropy.time.Time`, optional
        Epoch of the frame in Julian years, to which the catalogue is moved.  By default the
        catalogue is taken as it is.
    blind : bool
        Search also mirrored and turned frames, and a wider range of scale and pointing.
    max_roundness, min_snr : float
        Which sources take part, see `select_sources`.
    max_mag : float, optional
        Magnitude of the faintest reference stars that take part.
    **options
        Further options of `match_planes`.

    Returns
    -------
    matches : `~astropy.table.QTable`
        One row per pair: ``source_index``, ``catalog_index`` (rows of the inputs, zero based),
        ``x``, ``y`` [pix] as measured, ``ra``, ``dec`` [deg] of the reference star at the epoch,
        ``dx``, ``dy`` [pix] the source minus its reference star in pixels of the starting WCS, and
        ``separation`` [pix] the distance that is left once the smooth mapping is taken off.
    diagnostics : MatchDiagnostics
        Evidence, the smooth mapping found, timings.

    Raises
    ------
    MatchError
        If the evidence for a match is missing; the message says what.
    ValueError
        If a column is missing or has the wrong unit.

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
        raise MatchError(f"none of {len(x)} sources can be used: {left_out(rules)}")
    plane = _tangent_plane(wcs, image_shape)
    sky = wcs.pixel_to_world(x[rows], y[rows]).icrs
    xs, ys = plane.wcs_world2pix(sky.ra.deg, sky.dec.deg, 0)
    xr, yr = _project(plane, ra, dec)
    if max_mag is not None and mag is not None:
        # Rows stay in their places: what is not on the plane takes no part.
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
        blind=blind,
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
    """Make the table of the pairs of a match.

    Parameters
    ----------
    diagnostics : MatchDiagnostics
        What the match says about itself; goes into the ``meta`` of the table.
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
    """Plain float array of a column, masked values as NaN; None where there is no such column."""
    if name not in table.colnames:
        if required:
            raise ValueError(f"{required} must have a column {name!r}; it has {table.colnames}")
        return None
    column = table[name]
    given = getattr(column, "unit", None)
    values = np.ma.filled(np.ma.asarray(getattr(column, "value", column)).astype(float), np.nan)
    if unit is None or given is None:
        return values
    try:
        return (values * u.Unit(given)).to_value(unit)
    except u.UnitConversionError:
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
    return *_move(ra, dec, *motion, float(getattr(epoch, "jyear", epoch))), mag


def _move(ra, dec, pmra, pmdec, ref_epoch, epoch):
    """Straight motion on unit vectors; stars without a proper motion stay put."""
    factor = (epoch - ref_epoch) * np.deg2rad(1 / 3.6e6)
    east, north = np.nan_to_num(pmra * factor), np.nan_to_num(pmdec * factor)
    a, d = np.deg2rad(ra), np.deg2rad(dec)
    outward, upward = np.cos(d) - north * np.sin(d), np.sin(d) + north * np.cos(d)
    moved_ra = np.rad2deg(a + np.arctan2(east, outward)) % 360
    return moved_ra, np.rad2deg(np.arctan2(upward, np.hypot(outward, east)))


def _find_shape(wcs, x, y):
    shape = getattr(wcs, "array_shape", None)
    if shape is None and getattr(wcs, "low_level_wcs", None) is not None:
        shape = wcs.low_level_wcs.array_shape
    if shape is not None:
        return tuple(int(n) for n in shape)
    if not (np.isfinite(x) & np.isfinite(y)).any():
        raise MatchError(f"none of {len(x)} sources has a finite position")
    return int(np.ceil(np.nanmax(y))) + 1, int(np.ceil(np.nanmax(x))) + 1


def _tangent_plane(wcs, image_shape):
    """Linear WCS that touches the starting WCS in the centre of the frame."""
    ny, nx = image_shape
    center = np.array([0.5 * (nx - 1), 0.5 * (ny - 1)])
    step = 0.5
    sky = wcs.pixel_to_world(
        center[0] + step * np.array([0, 1, -1, 0, 0]), center[1] + step * np.array([0, 0, 0, 1, -1])
    ).icrs
    ra, dec = sky.ra.deg, sky.dec.deg
    if not (np.isfinite(ra) & np.isfinite(dec)).all():
        raise ValueError("wcs gives no sky position for the centre of the frame")
    plane = WCS(naxis=2)
    plane.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    plane.wcs.cunit = ["deg", "deg"]
    plane.wcs.crval = [ra[0], dec[0]]
    plane.wcs.crpix = [1, 1]
    plane.wcs.cd = np.eye(2)
    xi, eta = plane.wcs_world2pix(ra, dec, 0)
    cd = np.array([[xi[1] - xi[2], xi[3] - xi[4]], [eta[1] - eta[2], eta[3] - eta[4]]]) / (2 * step)
    if not np.isfinite(cd).all() or abs(np.linalg.det(cd)) == 0:
        raise ValueError("wcs is degenerate in the centre of the frame")
    plane.wcs.crpix = center + 1
    plane.wcs.cd = cd
    return plane


def _project(plane, ra, dec):
    """Pixels of the tangent plane; NaN for what is not a position or on the far half of the sky."""
    crval = np.deg2rad(plane.wcs.crval)
    a, d = np.deg2rad(ra), np.deg2rad(dec)
    height = np.sin(crval[1]) * np.sin(d) + np.cos(crval[1]) * np.cos(d) * np.cos(a - crval[0])
    x, y = np.full(len(ra), np.nan), np.full(len(ra), np.nan)
    near = np.isfinite(height) & (height > 0.01) & (np.abs(dec) <= 90)
    if near.any():
        x[near], y[near] = plane.wcs_world2pix(ra[near], dec[near], 0)
    return x, y
