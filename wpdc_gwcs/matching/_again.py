"""New pairs from known ones, for positions that have changed."""

import numpy as np
from scipy.spatial import cKDTree

from wpdc_gwcs.matching._growth import predict
from wpdc_gwcs.matching._local import LocalCorrection
from wpdc_gwcs.matching._mapping import find_narrow_axis, fit_smooth_map
from wpdc_gwcs.matching._pairs import _as_points, find_edges, one_to_one
from wpdc_gwcs.robust import plane_scatter

__all__ = ["pair_again"]

# Radius in units of the scatter of left-out pairs, and its minimum, px: as in a first match.
_RADIUS, _LEAST_RADIUS = 5.5, 0.05
# The pairs have been judged before: clip only what no distortion explains.
_LOOSE_CLIP = 50.0


def pair_again(xs, ys, xr, yr, i_src, i_ref, *, image_shape):
    """Pair two lists again, with the positions that the known pairs predict.

    Parameters
    ----------
    xs, ys : (N,) array_like
        Positions of the sources, px, corrected for the known distortion.
    xr, yr : (M,) array_like
        Positions of the reference stars in the same plane, px.
    i_src, i_ref : (n,) array_like of int
        Rows of the known pairs.
    image_shape : (int, int)
        Shape of the frame, ``(ny, nx)``.

    Returns
    -------
    i_src, i_ref : (n,) ndarray of int
        Rows of the new pairs, in the order of the source rows; the known pairs if there are too few
        of them for a prediction.

    Raises
    ------
    ValueError
        If the lengths of the coordinates differ.

    Notes
    -----
    A smooth mapping is fitted to the pairs, and a moving local plane to its residuals.  A source is
    paired within 5.5 times the robust scatter of left-out pairs, if there is exactly one star and
    this star has no other source.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.matching import pair_again
    >>> x, y = np.random.default_rng(1).uniform(0, 1000, (2, 200))
    >>> known = np.arange(150)
    >>> i, j = pair_again(x, y, 1.01 * x + 5, 1.01 * y, known, known, image_shape=(1000, 1000))
    >>> len(i), bool((i == j).all())
    (200, True)
    """
    points, partners = _as_points("xs", "ys", xs, ys), _as_points("xr", "yr", xr, yr)
    i_src, i_ref = np.asarray(i_src, int), np.asarray(i_ref, int)
    ny, nx = image_shape
    before, after = points[i_src], partners[i_ref]
    fit = fit_smooth_map(
        *before.T,
        *after.T,
        center=np.array([0.5 * (nx - 1), 0.5 * (ny - 1)]),
        scale=0.5 * max(nx, ny),
        clip=_LOOSE_CLIP,
        narrow=find_narrow_axis(image_shape),
    )
    if fit is None:
        return i_src, i_ref
    residual = after - np.column_stack(fit.mapping(*before.T))
    local = LocalCorrection.if_worthwhile(before, residual)
    scatter = fit.scatter
    if local is not None:
        scatter = plane_scatter(*(residual - local(before, leave_out=True)[0]).T)
    good = np.flatnonzero(np.isfinite(points).all(axis=1))
    stars = np.flatnonzero(np.isfinite(partners).all(axis=1))
    mapped, leverage = predict(points[good], fit, local)
    radius = np.maximum(_RADIUS * scatter * np.sqrt(1 + leverage), _LEAST_RADIUS)
    i, j, _ = find_edges(mapped, cKDTree(partners[stars]), radius)
    keep, _ = one_to_one(i, j, len(good), len(stars))
    return good[i[keep]], stars[j[keep]]
