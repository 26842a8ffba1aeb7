"""One frame, matched to the reference catalog."""

import time
from dataclasses import dataclass

import numpy as np
from astropy.table import Table

from wpdc_gwcs.calibration.measure import measure_sources, rules_of
from wpdc_gwcs.calibration.settings import Settings
from wpdc_gwcs.calibration.start import (
    LinearWCS,
    detector_center,
    header_reference_point,
    linear_wcs,
    sky_of,
)
from wpdc_gwcs.catalogs import (
    Region,
    catalog_source,
    fill_motions,
    propagate,
    read_catalog,
    scale_errors,
    select_cone,
)
from wpdc_gwcs.catalogs.cone import separations
from wpdc_gwcs.columns import numbers_or_none
from wpdc_gwcs.exceptions import MatchError, WPDCError
from wpdc_gwcs.matching import match_planes
from wpdc_gwcs.selection import left_out
from wpdc_gwcs.solution import has_inverse
from wpdc_gwcs.stages import announce

__all__ = [
    "FailedFrame",
    "MatchedFrame",
    "catalog_of_frame",
    "sky_of_frame",
    "match_frame",
    "reference_in_reach",
    "usable_sources",
    "with_errors",
]

_ERROR_FLOOR = 0.01  # px


@dataclass(frozen=True, eq=False)
class MatchedFrame:
    """One frame, measured and matched, as input of the joint solution.

    Parameters
    ----------
    name, source, detector : str
        As in `~wpdc_gwcs.frame.Frame`.
    image_shape : (int, int)
        Shape ``(ny, nx)`` in px.
    wcs : object
        Starting WCS of the frame.
    sources : `~astropy.table.Table`
        Measured sources.
    usable : (N,) ndarray of bool
        Mask of the sources that may be matched.
    reference : `~astropy.table.Table`
        Reference stars in reach of the frame, at its epoch, with their ``catalog_index``.
    pairs : (i, j) of ndarray of int
        Rows of the pairs in ``sources`` and in ``reference``.
    start : LinearWCS
        WCS from which the match started.
    diagnostics : MatchDiagnostics
        Evidence for the match.
    from_image : bool
        Whether the sources were measured on an image.
    seconds : float
        Time that measuring and matching took, s.
    exposure, camera : str, optional
        As in `~wpdc_gwcs.frame.Frame`.
    epoch : float, optional
        Epoch of the frame, Julian years.
    left_out : str, optional
        Numbers of sources that each rule excludes, in words.

    Examples
    --------
    >>> from wpdc_gwcs import simulate
    >>> from wpdc_gwcs.calibration import match_frame
    >>> sky = simulate(1, image_shape=(512, 512), density=60, distortion=3, seed=1)
    >>> exposure = sky.exposures[0]
    >>> matched = match_frame(exposure.frame(), sky.reference)
    >>> i, j = matched.pairs
    >>> truth = exposure.sources["reference_index"][i]
    >>> int((matched.reference["catalog_index"][j] != truth).sum())  # wrong pairs
    0
    """

    name: str
    source: str
    detector: str
    image_shape: tuple[int, int]
    wcs: object
    sources: Table
    usable: np.ndarray  # mask over sources
    reference: Table  # at the epoch of the frame, with catalog_index
    pairs: tuple[np.ndarray, np.ndarray]  # rows of sources and of reference
    start: LinearWCS
    diagnostics: object
    from_image: bool
    seconds: float
    exposure: str | None = None  # as in `Frame`: with others of the camera, or on its own
    camera: str | None = None
    epoch: float | None = None
    left_out: str | None = None  # how many sources each rule has left out, where that was counted

    @property
    def n_sources(self):
        """Number of sources."""
        return len(self.sources)


@dataclass(frozen=True, eq=False)
class FailedFrame:
    """A frame that could not be matched.

    Parameters
    ----------
    error : WPDCError
        Reason of the failure.
    n_sources : int
        Number of measured sources.
    seconds : float
        Time until the failure, s.
    sources : `~astropy.table.Table`, optional
        Measured sources.
    """

    error: WPDCError
    n_sources: int
    seconds: float
    sources: Table | None = None


def match_frame(frame, catalog, settings=None, *, sources=None, solution=None):
    """Measure one frame and match it to the reference catalog.

    Parameters
    ----------
    frame : Frame
        Image or source list.
    catalog : path-like, Table, SkyCoord, GaiaArchive or HatsCatalog
        Reference catalog: what `read_catalog` takes, or has returned.
    settings : Settings, optional
        Settings; the defaults work for any camera.
    sources : `~astropy.table.Table`, optional
        Result of `measure_sources`, if the frame has already been measured.
    solution : DistortionSolution, optional
        Stored solution of the detector, which removes the distortion before the match.

    Returns
    -------
    MatchedFrame
        Sources, reference stars at the epoch of the frame, and the pairs.

    Raises
    ------
    DetectionError, MatchError
        If there are no stars, or the evidence for a match is not sufficient.

    Examples
    --------
    >>> from wpdc_gwcs import simulate
    >>> from wpdc_gwcs.calibration import match_frame
    >>> sky = simulate(1, image_shape=(512, 512), density=60, distortion=3, seed=1)
    >>> matched = match_frame(sky.exposures[0].frame(), sky.reference)
    >>> matched.n_sources, len(matched.pairs[0]), matched.diagnostics.purity
    (387, 349, 1.0)
    """
    settings = Settings() if settings is None else settings
    began = time.perf_counter()
    if "catalog_index" not in getattr(catalog, "colnames", ()):
        source = catalog_source(catalog, max_mag=settings.max_mag)
        sky = sky_of_frame(frame, settings, solution=solution)
        catalog = read_catalog(source, region=None if sky is None else Region(*sky))
    if sources is None:
        sources = measure_sources(frame, settings)
    announce("matching")
    sources = with_errors(sources)
    rules = rules_of(sources, frame, settings)
    usable = ~np.any(list(rules.values()), axis=0)
    counts = left_out(rules)
    x, y = np.asarray(sources["x"], float), np.asarray(sources["y"], float)
    start = _start(frame, solution)
    if solution is None:
        xs, ys = start.pixels(*sky_of(frame.wcs, x, y))
    else:
        xs, ys = solution.undistort(x, y)
    reference = reference_in_reach(frame, catalog, start, settings)
    xr, yr = start.pixels(np.asarray(reference["ra"]), np.asarray(reference["dec"]))
    pick = np.flatnonzero(usable & np.isfinite(xs) & np.isfinite(ys))
    try:
        i_src, i_ref, diagnostics = match_planes(
            xs[pick],
            ys[pick],
            xr,
            yr,
            flux=numbers_or_none(sources, "flux", pick),
            mag=numbers_or_none(reference, "phot_g_mean_mag"),
            x_err=numbers_or_none(sources, "x_err", pick),
            y_err=numbers_or_none(sources, "y_err", pick),
            image_shape=frame.image_shape,
            blind=settings.blind,
        )
    except MatchError as err:
        raise MatchError(f"{err} ({counts})", found=err.found) from err
    return MatchedFrame(
        name=frame.name,
        source=frame.source,
        detector=frame.detector,
        image_shape=frame.image_shape,
        wcs=frame.wcs,
        sources=sources,
        usable=usable,
        reference=reference,
        pairs=(pick[i_src], i_ref),
        start=start,
        diagnostics=diagnostics,
        from_image=frame.load_image is not None,
        seconds=time.perf_counter() - began,
        exposure=frame.exposure,
        camera=frame.camera,
        epoch=frame.epoch,
        left_out=counts,
    )


def with_errors(sources):
    """Add errors from the signal-to-noise ratio to a list without errors.

    Parameters
    ----------
    sources : `~astropy.table.Table`
        Measured sources.

    Returns
    -------
    `~astropy.table.Table`
        The same table, or a copy with ``x_err`` and ``y_err`` in px.  Their scale is fitted later.
    """
    if "snr" not in sources.colnames or {"x_err", "y_err"} <= set(sources.colnames):
        return sources
    sources = sources.copy()
    # A star of FWHM 2.4 px has a centroid error of 1 / snr px, and no centroid is perfect.
    error = np.hypot(1.0 / np.maximum(numbers_or_none(sources, "snr"), 1.0), _ERROR_FLOOR)
    sources["x_err"] = sources["y_err"] = error
    return sources


def usable_sources(sources, frame, settings):
    """Mark the sources that may be matched.

    Parameters
    ----------
    sources : `~astropy.table.Table`
        Measured sources.
    frame : Frame
        The frame, for its shape.
    settings : Settings
        ``max_roundness`` and ``min_snr`` are used.

    Returns
    -------
    (N,) ndarray of bool
        Mask of the sources, see `wpdc_gwcs.matching.select_sources`.
    """
    return ~np.any(list(rules_of(sources, frame, settings).values()), axis=0)


def _start(frame, solution):
    """Linear WCS from which the match of a frame starts."""
    point = header_reference_point(frame) if solution is None else solution.crpix
    start = linear_wcs(frame.wcs, point)
    if not has_inverse(start.cd):
        raise MatchError(
            f"{frame.source}: the starting WCS must be invertible, its matrix is "
            f"{start.cd.tolist()} deg / px at pixel {point.tolist()}"
        )
    return start


def _reach(frame, start, settings):
    """Center and radius, deg, of the sky in which a match of the frame is sought."""
    ny, nx = frame.image_shape
    center = detector_center(frame.image_shape)
    ra, dec = (float(c) for c in np.ravel(sky_of(frame.wcs, *center[:, None])))
    # As wide as the match searches, see `match_planes`.
    margin = max(nx, ny) * (0.5 if settings.blind else 0.2) + 500
    return ra, dec, (np.hypot(nx, ny) / 2 + margin) * start.scale


def sky_of_frame(frame, settings, *, solution=None):
    """Return the part of the sky whose stars are needed for a frame and for its neighbors.

    Parameters
    ----------
    frame : Frame
        The frame, for its WCS.
    settings : Settings
        Settings of the run; a blind search needs a larger part.
    solution : DistortionSolution, optional
        Stored solution of the detector.

    Returns
    -------
    tuple of float or None
        RA and Dec of the center, and radius, deg; `None` if the WCS cannot be used, so the frame
        will fail.
    """
    try:
        ra, dec, radius = _reach(frame, _start(frame, solution), settings)
    except Exception:  # noqa: BLE001  Users may pass any WCS; the match reports what is wrong.
        return None
    if not (np.isfinite([ra, dec, radius]).all() and radius < 180):
        return None
    # A frame with a worse header is searched around its neighbors.  A star without a known motion
    # moves with its thirty nearest neighbors, so these are needed, too.
    return ra, dec, 1.25 * radius + 0.1


def catalog_of_frame(frame, catalog, settings, *, solution=None):
    """Cut the reference catalog to the part that a frame may need, for another process.

    Parameters
    ----------
    frame : Frame
        The frame, for its WCS.
    catalog : `~astropy.table.Table`
        Reference catalog after `fill_motions`.
    settings : Settings
        Settings of the run; a blind search needs a larger part.
    solution : DistortionSolution, optional
        Stored solution of the detector.

    Returns
    -------
    `~astropy.table.Table`
        Rows from which `match_frame` selects the same stars as from the whole catalog.
    """
    reach = _reach(frame, _start(frame, solution), settings)
    near = select_cone(catalog, *reach)
    # Without stars, those that tell what is wrong.
    return near if len(near) else catalog[_elsewhere(catalog, *reach)]


def _elsewhere(catalog, ra, dec, radius):
    """Rows of the star nearest to a position, and to that with right ascension read as hours."""
    if not len(catalog):
        return []
    rows = [int(np.argmin(separations(catalog, ra, dec)))]
    if ra < 24.0:
        distance = separations(catalog, 15.0 * ra, dec)
        if distance.min() <= radius:
            rows.append(int(np.argmin(distance)))
    return rows


def _tell_elsewhere(catalog, ra, dec, radius):
    """Say where the stars of a catalog without any near a position are."""
    rows = _elsewhere(catalog, ra, dec, radius)
    if not rows:
        return ""
    star = catalog[rows[0]]
    distance = separations(catalog, ra, dec, rows)[0]
    if distance <= radius:
        # It is there, but fainter than the limit.
        return ""
    text = (
        f"; its nearest star is {distance:.3g} deg away, at RA {star['ra']:.4f} "
        f"Dec {star['dec']:.4f}"
    )
    if len(rows) > 1:
        text += f"; it has stars at RA {15.0 * ra:.4f}: is the right ascension in hours"
    return text


def reference_in_reach(frame, catalog, start, settings):
    """Select the reference stars that may be on the frame, at its epoch.

    Parameters
    ----------
    frame : Frame
        The frame, for its WCS and epoch.
    catalog : `~astropy.table.Table`
        Reference catalog.
    start : LinearWCS
        WCS from which the match starts, for its scale.
    settings : Settings
        Settings of the run; a blind search needs a larger part of the sky.

    Returns
    -------
    `~astropy.table.Table`
        Rows of the catalog at the epoch of the frame.

    Raises
    ------
    MatchError
        If there are no such stars.
    """
    ra, dec, radius = _reach(frame, start, settings)
    # Before the cut, which would remove neighbors; in a run, this has been done for all frames.
    near = select_cone(fill_motions(catalog), ra, dec, radius)
    if settings.max_mag is not None and "phot_g_mean_mag" in near.colnames:
        near = near[~(np.asarray(near["phot_g_mean_mag"], float) > settings.max_mag)]
    if len(near) == 0:
        raise MatchError(
            f"{frame.source}: the catalog has no star within {radius:.3f} deg of the frame's "
            f"center, RA {ra:.4f} Dec {dec:.4f} deg{_tell_elsewhere(catalog, ra, dec, radius)}"
        )
    near = scale_errors(near)
    return near if frame.epoch is None else propagate(near, frame.epoch, parallax=True)
