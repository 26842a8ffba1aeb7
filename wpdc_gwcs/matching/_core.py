"""The core: two lists of plane positions in, one-to-one pairs and their evidence out."""

import time

import numpy as np

from wpdc_gwcs.exceptions import MatchError
from wpdc_gwcs.matching._diagnostics import MatchDiagnostics
from wpdc_gwcs.matching._mapping import MAX_ORDER, SmoothMap, turn_and_scale
from wpdc_gwcs.matching._search import MIN_STARS, Limits, Search, Stars
from wpdc_gwcs.threads import one_blas_thread

__all__ = ["match_planes", "prepare_search"]


# Displacement by distortion that is searched for, px; on a small detector as a share of its side:
# what such a limit allows in scale and rotation grows as the detector shrinks.
_MAX_DISTORTION = 250.0
_MAX_DISTORTION_SHARE = 0.12


@one_blas_thread
def match_planes(
    xs,
    ys,
    xr,
    yr,
    *,
    image_shape,
    flux=None,
    mag=None,
    x_err=None,
    y_err=None,
    start=None,
    blind=False,
    max_shift=None,
    max_rotation=3.0,
    max_scale=0.03,
    max_distortion=None,
    max_order=MAX_ORDER,
    min_significance=9.0,
    min_purity=0.9,
):
    """Find which source is which reference star, from positions in one plane.

    Parameters
    ----------
    xs, ys : (N,) array_like
        Positions of the sources in pixels of the starting WCS, zero based.
    xr, yr : (M,) array_like
        Positions of the reference stars in the same pixels: projected about the tangent point of
        the starting WCS.
    image_shape : (int, int)
        Shape of the frame, ``(ny, nx)``.
    flux : (N,) array_like, optional
        Brightness of the sources in any linear unit: brighter is larger.
    mag : (M,) array_like, optional
        Magnitudes of the reference stars.  With both, bright stars are matched first; without, all
        at once.
    x_err, y_err : (N,) array_like, optional
        Errors of the source positions, px; they set the final radius star by star.
    start : SmoothMap, optional
        A mapping to begin with (``mapping`` of earlier diagnostics) in place of the search by
        patterns.
    blind : bool
        Search also mirrored frames, frames turned by 90, 180 and 270 degrees, scales off by up to
        6 % and
        pointings off by up to 0.3 of the frame.
    max_shift : float, optional
        Largest error of the pointing, px; default 0.15 of the longer side, at least 450 px.
    max_rotation : float
        Largest error of the rotation at the centre of the frame, deg.
    max_scale : float
        Largest relative error of the scale at the centre of the frame.
    max_distortion : float, optional
        Largest displacement by distortion on the frame, px; default 250, and at most 0.12 of the
        longer side.
    max_order : int
        Highest order of the smooth mapping.
    min_significance : float
        Significance over chance that the pairs must have, sigma; 0.7 of it do where stars are so
        few that all mappings the search could have found are counted.
    min_purity : float
        Least share of right pairs.

    Returns
    -------
    i_src, i_ref : (n,) ndarray of int
        Rows of the pairs in the inputs, in order of the source row.
    diagnostics : MatchDiagnostics
        Evidence, mapping and timings.

    Raises
    ------
    MatchError
        If the evidence for a match is missing; the message says which.
    ValueError
        If lengths or options are not valid.

    Notes
    -----
    The stages are described in `wpdc_gwcs.matching`.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.matching import match_planes
    >>> rng = np.random.default_rng(1)
    >>> x, y = rng.uniform(0, 1000, (2, 200))
    >>> turned = x + 20 - 0.01 * y, y - 12 + 0.01 * x
    >>> i, j, diagnostics = match_planes(x[::-1], y[::-1], *turned, image_shape=(1000, 1000))
    >>> bool((i == 199 - j).all()), len(i), round(diagnostics.rotation, 3)
    (True, 200, 0.573)
    """
    clock = _Clock()
    search = prepare_search(
        xs,
        ys,
        xr,
        yr,
        image_shape=image_shape,
        flux=flux,
        mag=mag,
        x_err=x_err,
        y_err=y_err,
        blind=blind,
        max_shift=max_shift,
        max_rotation=max_rotation,
        max_scale=max_scale,
        max_distortion=max_distortion,
        max_order=max_order,
        min_significance=min_significance,
        min_purity=min_purity,
    )
    clock.lap("prepare")
    found = (
        search.from_start(start, clock) if start is not None else search.by_patterns(blind, clock)
    )
    evidence, mapping, (i, j) = found.evidence, found.mapping, found.pairs
    shift, matrix = mapping.linear_part()
    if found.parity < 0:
        matrix = matrix @ np.diag([-1, 1])
    rotation, scale = turn_and_scale(matrix, search.shape)
    return (
        *_in_source_order(search.source_rows[i], search.reference_rows[j]),
        MatchDiagnostics(
            n_sources=evidence.n_sources,
            n_reference=evidence.n_reference,
            n_pairs=evidence.n_pairs,
            expected_by_chance=evidence.expected_by_chance,
            purity=evidence.purity,
            completeness=evidence.completeness,
            significance=evidence.significance,
            n_ambiguous=found.n_ambiguous,
            n_duplicates=search.n_duplicates,
            scatter=found.scatter,
            radius=float(np.median(found.radius)),
            mapping=mapping,
            shift=(float(shift[0]), float(shift[1])),
            rotation=rotation,
            scale=scale,
            parity=found.parity,
            areas=evidence.areas,
            timings=clock.laps,
            search_significance=evidence.search_significance,
        ),
    )


def prepare_search(
    xs,
    ys,
    xr,
    yr,
    *,
    image_shape,
    flux=None,
    mag=None,
    x_err=None,
    y_err=None,
    blind=False,
    max_shift=None,
    max_rotation=3.0,
    max_scale=0.03,
    max_distortion=None,
    max_order=MAX_ORDER,
    min_significance=9.0,
    min_purity=0.9,
):
    """Check and clean the two lists: the first stage of `match_planes`, which has the parameters.

    Returns
    -------
    Search
        The lists and the rules, ready for the stages that follow.
    """
    ny, nx = (int(n) for n in image_shape)
    if min(ny, nx) < 1:
        raise ValueError(f"image_shape must be two positive numbers (ny, nx); got {image_shape}")
    sources, rows_s, flux, duplicates_s = _prepare("xs", "ys", xs, ys, flux, "flux")
    brightness = None if mag is None else -np.asarray(mag, float)
    reference, rows_r, brightness, duplicates_r = _prepare("xr", "yr", xr, yr, brightness, "mag")
    errors = _combine_errors(x_err, y_err, len(np.atleast_1d(xs)))
    errors = None if errors is None else errors[rows_s]
    half_diagonal = 0.5 * np.hypot(nx, ny)
    if blind:
        max_shift = max(0.3 * max(nx, ny), max_shift or 0.0)
        max_scale = max(0.06, max_scale)
    elif max_shift is None:
        max_shift = max(450.0, 0.15 * max(nx, ny))
    if max_distortion is None:
        max_distortion = min(_MAX_DISTORTION, _MAX_DISTORTION_SHARE * max(image_shape))
    limits = Limits(max_shift, max_rotation, max_scale, max_distortion, half_diagonal)
    frame = SmoothMap.identity((ny, nx))
    near = np.hypot(*(reference - frame.center).T) < half_diagonal + limits.reach(half_diagonal)
    reference, rows_r = reference[near], rows_r[near]
    brightness = None if brightness is None else brightness[near]
    for name, points in (
        ("sources", sources),
        ("reference stars in reach of the frame", reference),
    ):
        if len(points) < MIN_STARS:
            raise MatchError(
                f"too few {name} to match: {len(points)} with usable positions, "
                f"{MIN_STARS} are needed"
            )
    return Search(
        sources=sources,
        stars=Stars.build(reference),
        source_rows=rows_s,
        reference_rows=rows_r,
        n_duplicates=duplicates_s + duplicates_r,
        flux=flux,
        brightness=brightness,
        errors=errors,
        shape=(ny, nx),
        frame=frame,
        limits=limits,
        max_order=max_order,
        rules={"min_significance": min_significance, "min_purity": min_purity},
    )


class _Clock:
    """Seconds by stage; a stage that comes back adds up."""

    def __init__(self):
        self.laps = {}
        self._last = time.perf_counter()

    def lap(self, name):
        now = time.perf_counter()
        self.laps[name] = self.laps.get(name, 0.0) + now - self._last
        self._last = now


def _prepare(name_x, name_y, x, y, brightness, name_brightness):
    """Finite, distinct positions with their rows; brightness only if it orders the stars."""
    x, y = np.asarray(x, float), np.asarray(y, float)
    if x.ndim != 1 or x.shape != y.shape:
        raise ValueError(
            f"{name_x} and {name_y} must be one-dimensional and of equal length; "
            f"got {x.shape}, {y.shape}"
        )
    rows = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    points = np.column_stack([x[rows], y[rows]])
    order = np.lexsort(points.T)
    again = np.zeros(len(rows), bool)
    again[order[1:]] = (np.diff(points[order], axis=0) == 0).all(axis=1)
    first = np.flatnonzero(~again)
    n_duplicates = len(rows) - len(first)
    points, rows = points[first], rows[first]
    if brightness is not None:
        brightness = np.asarray(brightness, float)
        if brightness.shape != x.shape:
            raise ValueError(
                f"{name_brightness} must have one value per star; "
                f"got {brightness.shape} for {x.shape}"
            )
        brightness = brightness[rows]
        known = np.isfinite(brightness)
        # ties or gaps in more than half of the values leave no order to speak of
        if known.sum() < 0.5 * len(rows) or len(np.unique(brightness[known])) < 0.5 * known.sum():
            brightness = None
        else:
            brightness = np.where(known, brightness, -np.inf)
    return points, rows, brightness, n_duplicates


def _combine_errors(x_err, y_err, n):
    """One error per star, or None."""
    given = [np.asarray(e, float) for e in (x_err, y_err) if e is not None]
    for e in given:
        if e.shape != (n,):
            raise ValueError(
                f"x_err and y_err must have one value per source; got {e.shape} for {n} sources"
            )
    if not given:
        return None
    errors = np.sqrt(np.mean(np.square(given), axis=0))
    good = np.isfinite(errors) & (errors > 0)
    if not good.any():
        return None
    return np.where(good, errors, np.max(errors[good]))


def _in_source_order(i, j):
    order = np.argsort(i, kind="stable")
    return i[order], j[order]
