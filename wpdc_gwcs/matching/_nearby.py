"""Matching of a few stars whose positions are known to within a given error."""

import time
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import gammaln

from wpdc_gwcs.counts import counted
from wpdc_gwcs.exceptions import MatchError
from wpdc_gwcs.matching._diagnostics import MatchDiagnostics
from wpdc_gwcs.matching._mapping import SmoothMap
from wpdc_gwcs.matching._pairs import find_edges, one_to_one
from wpdc_gwcs.robust import plane_scatter

__all__ = ["match_nearby"]

# A linear mapping fits any three pairs: the fourth one is the first evidence.
MIN_PAIRS = 4
# Probability that chance alone gives as many pairs anywhere in the search: so low that a camera of
# a hundred detectors is still wrong in less than one run of a thousand.
_MAX_CHANCE = 1e-5
# Maximum number of stars in the search for the shift: more would not improve its peak.
_MOST_STARS = 300
_MOST_OFFSETS = 400_000
# Sides of the boxes in which offsets are counted, px.
_BOXES = (1.5, 4.0, 10.0, 25.0, 60.0)
# Maximum number of peaks to follow.
_N_PEAKS = 4
# Pairing radius in units of the scatter, and its bounds, px: centroids are not better than the
# lower one, and pairs that disagree more than the upper one prove nothing.
_N_SIGMA = 5.0
_RADII = (0.5, 6.0)
# A second shift with this fraction of the pairs means that the field repeats itself.
_RIVAL_SHARE = 0.7
# Minimum number of pairs for a rotation and scale, and for a full linear mapping.
_FOR_SIMILARITY, _FOR_LINEAR = 3, 6


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A linear mapping and its pairs."""

    linear: np.ndarray  # (3, 2): constant, x, y
    pairs: tuple
    n_ambiguous: int
    scatter: float
    radius: float
    by_chance: float
    log_chance: float


def match_nearby(
    xs, ys, xr, yr, *, image_shape, max_shift, max_bend, flux=None, mag=None, tiles=None
):
    r"""Pair sources with reference stars whose positions are nearly known.

    Parameters
    ----------
    xs, ys : (N,) array_like
        Predicted positions of the sources, px, zero based; all are finite.
    xr, yr : (M,) array_like
        Positions of the reference stars in the same pixels.
    image_shape : (int, int)
        Shape of the frame, ``(ny, nx)``.
    max_shift : float
        Largest common error of the prediction for the whole frame, px.
    max_bend : float
        Largest remaining error on the frame without the shift (rotation, stretch), px.
    flux : (N,) array_like, optional
        Brightness of the sources.
    mag : (M,) array_like, optional
        Magnitudes of the reference stars.
    tiles : ((N,) array_like, (M,) array_like), optional
        Numbers of the exposures of sources and reference stars, if several exposures share one
        mapping; pairs are made within an exposure.

    Returns
    -------
    i_src, i_ref : (n,) ndarray of int
        Rows of the pairs.
    linear : (3, 2) ndarray
        Mapping from predicted to reference pixels about the center of the frame:
        ``(1, x - x_c, y - y_c) @ linear`` is to be added.
    diagnostics : MatchDiagnostics
        Evidence.

    Raises
    ------
    MatchError
        If there are too few pairs, or they could be due to chance.

    Notes
    -----
    The offsets of pairs are counted in boxes, and a linear mapping grows from the most surprising
    boxes within the given bounds.  If n pairs are found within the radius r, and chance predicts
    :math:`\lambda` of them, the evidence is the Poisson tail :math:`P(\ge n \mid \lambda)` times
    the number of mappings that the search has tried.  This is at most
    :math:`(1 + s/r)^2 (1 + b/r)^4` for the largest shift s and bend b.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.matching import match_nearby
    >>> x, y = np.random.default_rng(1).uniform(0, 1000, (2, 12))
    >>> i, j, linear, found = match_nearby(
    ...     x, y, x + 5, y - 3, image_shape=(1000, 1000), max_shift=20, max_bend=2
    ... )
    >>> len(i), linear[0].round(6).tolist()
    (12, [5.0, -3.0])
    """
    began = time.perf_counter()
    local = np.column_stack([xs, ys]), np.column_stack([xr, yr])
    sources, reference = local
    if tiles is not None:
        # Side by side, farther apart than the range of any search.
        step = np.array([100.0 * (max(image_shape) + max_shift + max_bend), 0.0])
        sources, reference = (
            p + np.asarray(t, float)[:, None] * step for p, t in zip(local, tiles, strict=True)
        )
    if len(sources) < MIN_PAIRS or len(reference) < MIN_PAIRS:
        raise MatchError(
            f"too few stars to match: {counted(len(sources), 'source')} and "
            f"{counted(len(reference), 'reference star')} in reach; {MIN_PAIRS} of each are needed"
        )
    center = np.array([0.5 * (image_shape[1] - 1), 0.5 * (image_shape[0] - 1)])
    scale = 0.5 * np.hypot(*image_shape)
    tree = cKDTree(reference)
    at = np.column_stack([np.ones(len(sources)), local[0] - center])
    bright = _brightest(local[0], flux), _brightest(local[1], mag, inside=image_shape)
    candidates = []
    for shift, reach in _peaks(sources[bright[0]], reference[bright[1]], max_shift, max_bend):
        grown = _grow(sources, at, reference, tree, scale, shift, reach, max_shift, max_bend)
        if grown is not None:
            candidates.append(grown)
    if not candidates:
        raise MatchError("no pairs where the neighboring detectors predict them")
    candidates.sort(key=lambda c: c.log_chance)
    best = candidates[0]
    n = len(best.pairs[0])
    if n < MIN_PAIRS or best.log_chance > np.log(_MAX_CHANCE):
        raise MatchError(
            f"{counted(n, 'pair')} where the neighboring detectors predict them, "
            f"{best.by_chance:.2g} expected by chance: not enough to be sure"
        )
    for other in candidates[1:]:
        apart = np.hypot(*(other.linear[0] - best.linear[0])) > 2 * best.radius
        if apart and len(other.pairs[0]) >= _RIVAL_SHARE * n:
            raise MatchError(
                f"the match is ambiguous: {n} and {len(other.pairs[0])} pairs at two shifts that "
                f"are {np.hypot(*(other.linear[0] - best.linear[0])):.3g} px apart"
            )
    back = local[1] - best.linear[0]
    on_frame = ((back > -0.5) & (back < np.array(image_shape[::-1]) - 0.5)).all(axis=1)
    n_reference = max(int(on_frame.sum()), n)
    size = 0.5 * max(image_shape)
    coefficients = best.linear.T * np.array([1.0, size, size])
    turn = np.eye(2) + best.linear[1:].T
    return (
        *best.pairs,
        best.linear,
        MatchDiagnostics(
            n_sources=len(sources),
            n_reference=n_reference,
            n_pairs=n,
            expected_by_chance=best.by_chance,
            purity=1 - min(1.0, best.by_chance * (1 - n / len(sources)) / n),
            completeness=n / min(len(sources), n_reference),
            significance=float(np.sqrt(-2 * best.log_chance)),
            n_ambiguous=best.n_ambiguous,
            n_duplicates=0,
            scatter=best.scatter,
            radius=best.radius,
            mapping=SmoothMap(1, coefficients, center, size),
            shift=(float(best.linear[0, 0]), float(best.linear[0, 1])),
            rotation=float(np.rad2deg(np.arctan2(turn[1, 0] - turn[0, 1], np.trace(turn)))),
            scale=float(np.sqrt(abs(np.linalg.det(turn)))),
            parity=1,
            areas=(),
            timings={"nearby": time.perf_counter() - began},
        ),
    )


def _brightest(points, brightness, *, inside=None):
    """Rows of the brightest stars, or of all without an order."""
    rows = np.arange(len(points))
    if len(points) <= _MOST_STARS:
        return rows
    if brightness is None or np.isfinite(brightness).sum() < 0.5 * len(points):
        return rows
    brightness = np.asarray(brightness, float)
    if inside is None:
        order = np.argsort(np.where(np.isfinite(brightness), -brightness, np.inf), kind="stable")
        return order[:_MOST_STARS]
    # Magnitudes of a list that reaches beyond the frame: it gets twice as many stars, because the
    # cuts in flux and magnitude never correspond exactly.
    order = np.argsort(np.where(np.isfinite(brightness), brightness, np.inf), kind="stable")
    ny, nx = inside
    on_frame = ((points > 0) & (points < [nx, ny])).all(axis=1)[order]
    return order[: np.searchsorted(np.cumsum(on_frame), 2 * _MOST_STARS) + 1]


def _peaks(sources, reference, max_shift, max_bend):
    """Shifts at which surprisingly many pairs agree, with the reach of the boxes."""
    reach = max_shift + max_bend
    tree = cKDTree(reference)
    counts = tree.query_ball_point(sources, reach, return_length=True)
    most = max(1, int(np.searchsorted(np.cumsum(counts), _MOST_OFFSETS)))
    found = tree.query_ball_point(sources[:most], reach, return_sorted=False)
    owner = np.repeat(np.arange(len(found)), [len(f) for f in found])
    if len(owner) == 0:
        return []
    offset = reference[np.concatenate([np.asarray(f, int) for f in found])]
    offset = offset - sources[owner]
    density = len(offset) / (np.pi * reach**2)
    peaks = []
    for width in _BOXES:
        if width > 2 * reach + _BOXES[0]:
            break
        expected = density * width**2
        for edge in ((0.0, 0.0), (0.0, 0.5), (0.5, 0.0), (0.5, 0.5)):
            cell = np.floor(offset / width + edge).astype(np.int64)
            _, box, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
            score = count * (np.log(count / expected) - 1)
            for k in np.argsort(-score)[:_N_PEAKS]:
                if count[k] >= 2 or len(sources) < 3:
                    peaks.append((score[k], offset[box.ravel() == k].mean(axis=0), width))
    peaks.sort(key=lambda p: -p[0])
    chosen = []
    for _, shift, width in peaks:
        # The same peak in boxes of another size or grid is not a new start.
        if all(np.hypot(*(shift - s)) > 0.7 * min(width, w) for s, w in chosen):
            chosen.append((shift, width))
        if len(chosen) == 2 * _N_PEAKS:
            break
    return [(shift, max(width, min(max_bend, 2 * width))) for shift, width in chosen]


def _grow(sources, at, reference, tree, scale, shift, reach, max_shift, max_bend):
    """Grow a linear mapping from a shift, within bounds; `None` if it does not hold."""
    linear = np.zeros((3, 2))
    linear[0] = shift
    radius, scatter, before = reach, reach, None
    for _ in range(12):
        moved = sources + at @ linear
        i, j, _ = _pair(moved, tree, radius)
        if len(i) == 0:
            return None
        linear = _fit(at[i], reference[j] - sources[i], scale)
        left = reference[j] - sources[i] - at[i] @ linear
        free = _terms(len(i))
        scatter = plane_scatter(*left.T) * np.sqrt(len(i) / max(1.0, len(i) - free / 2))
        key = i.tobytes(), j.tobytes()
        if key == before:
            break
        before = key
        # Never wider: as the mapping rotates, it reaches the stars at the edge.
        radius = float(np.clip(_N_SIGMA * scatter, _RADII[0], max(0.7 * radius, _RADII[0])))
    radius = float(np.clip(_N_SIGMA * scatter, *_RADII))
    bend = np.linalg.norm(linear[1:], 2) * scale
    if np.hypot(*linear[0]) > max_shift + radius or bend > max_bend + radius:
        return None
    moved = sources + at @ linear
    i, j, n_ambiguous = _pair(moved, tree, radius)
    if len(i) < 2:
        return None
    by_chance = _by_chance(moved, i, tree, radius)
    trials = 2 * np.log1p(max_shift / radius) + 4 * np.log1p(max_bend / radius)
    n = len(i)
    # Leading terms of the Poisson tail: an upper limit for n well above the mean.
    log_chance = 0.0
    if n > by_chance:
        log_chance = n * np.log(by_chance) - by_chance - gammaln(n + 1)
        log_chance -= np.log1p(-by_chance / (n + 1))
    return _Candidate(
        linear, (i, j), n_ambiguous, scatter, radius, by_chance, min(0.0, log_chance + trials)
    )


def _pair(moved, tree, radius):
    i, j, _ = find_edges(moved, tree, np.full(len(moved), radius))
    keep, n_ambiguous = one_to_one(i, j, len(moved), tree.n)
    return i[keep], j[keep], n_ambiguous


def _terms(n):
    return 2 if n < _FOR_SIMILARITY else 4 if n < _FOR_LINEAR else 6


def _fit(at, offset, scale):
    """Shift, similarity or linear mapping, as many pairs allow, without outliers."""
    keep = np.ones(len(at), bool)
    for _ in range(3):
        a, d = at[keep], offset[keep]
        terms = _terms(len(a))
        linear = np.zeros((3, 2))
        if terms == 2:
            linear[0] = np.median(d, axis=0)
        elif terms == 4:
            one, x, y = (a / np.array([1.0, scale, scale])).T
            zero = np.zeros_like(one)
            design = np.vstack(
                [np.column_stack([one, zero, x, -y]), np.column_stack([zero, one, y, x])]
            )
            c = np.linalg.lstsq(design, np.concatenate([d[:, 0], d[:, 1]]), rcond=None)[0]
            linear[0], linear[1], linear[2] = c[:2], c[2:] / scale, [-c[3] / scale, c[2] / scale]
        else:
            linear = np.linalg.lstsq(a / [1.0, scale, scale], d, rcond=None)[0]
            linear[1:] /= scale
        left = np.hypot(*(offset - at @ linear).T)
        new = left <= max(_N_SIGMA * 0.85 * np.median(left[keep]), _RADII[0])
        if (new == keep).all() or new.sum() < 2:
            break
        keep = new
    return linear


def _by_chance(moved, paired, tree, radius):
    """Pairs expected by chance: from the density of reference stars about each source."""
    wide = max(10 * radius, 1.5 * _typical_distance(tree))
    near = tree.query_ball_point(moved, wide, return_length=True).astype(float)
    near[paired] -= 1
    # Half a star if none is near, because the density is not zero.
    return float(np.sum(np.maximum(near, 0.5)) * (radius / wide) ** 2)


def _typical_distance(tree):
    k = min(4, tree.n)
    distance = tree.query(tree.data[:: max(1, tree.n // 200)], k=[k])[0]
    return float(np.median(distance))
