"""Neighbor patterns: identification of stars from relative positions alone.

The neighbors of a star are described by ``(log d, theta)``.  A common rotation and scale of the
neighborhood is a common shift in that plane.  So two stars are compared by finding the shift at
which most of their neighbors coincide.  The number of coincidences expected by chance follows from
the number of differences.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import gammainc

from wpdc_gwcs.detector import on_detector
from wpdc_gwcs.matching._pairs import find_nearest

__all__ = [
    "Hypotheses",
    "compare_patterns",
    "density_ratio_map",
    "neighbor_pattern",
    "select_coherent",
]

# Widths of the coincidence box in (log d, theta): from fine to coarse, the data pick (adaptive
# threshold).
BOX_WIDTHS = (0.02, 0.04, 0.08)
# Decimal logarithm of the improbability at which an agreement puts a hypothesis into a group.
_LEAST_WORTH = 1.0
# Number of anchors that are compared at any cost.
_LEAST_ANCHORS = 8
# Minimum number of coinciding neighbors for a hypothesis.
_LEAST_COUNT = 3
# Differences held in memory at a time.
_CHUNK = 2_000_000
# Boxes per difference up to which they are counted in an array of all boxes.
_DENSE = 20
N_NEIGHBORS = 12
MAX_NEIGHBORS = 160


def density_ratio_map(xs, ys, xr, yr, image_shape, *, per_cell=40.0):
    """Return the local ratio of source to reference density, on a grid over the frame.

    Parameters
    ----------
    xs, ys, xr, yr : ndarray
        Positions of sources and reference stars, px.
    image_shape : (int, int)
        Shape of the frame, ``(ny, nx)``.
    per_cell : float, optional
        Mean number of stars of the sparser list in a cell, which sets the size of the cells.

    Returns
    -------
    ratio : (ny_cells, nx_cells) ndarray
        Sources per reference star; one star is added to both counts, so empty cells have 1.
    x_edges, y_edges : ndarray
        Edges of the cells, px.
    """
    ny, nx = image_shape
    inside = on_detector(xr, yr, image_shape)
    fewest = max(1, min(len(xs), np.count_nonzero(inside)))
    n_cells = int(np.clip(np.sqrt(fewest / per_cell), 1, 32))
    x_edges = np.linspace(-0.5, nx - 0.5, n_cells + 1)
    y_edges = np.linspace(-0.5, ny - 0.5, n_cells + 1)
    counts = [np.histogram2d(y, x, bins=(y_edges, x_edges))[0] for x, y in ((xs, ys), (xr, yr))]
    return (counts[0] + 1) / (counts[1] + 1), x_edges, y_edges


def neighbor_pattern(tree, rows, n_neighbors):
    """Return the neighbors of some stars in polar coordinates.

    Parameters
    ----------
    tree : `~scipy.spatial.cKDTree`
        Tree of all stars of the list.
    rows : (n,) ndarray of int
        Stars whose neighbors are wanted.
    n_neighbors : int
        Number of neighbors.

    Returns
    -------
    log_distance, angle : (n, k) ndarray
        Natural logarithm of the distance in px, and direction in rad; NaN if the list has too few
        stars.
    neighbor : (n, k) ndarray of int
        Row of each neighbor.
    """
    points = tree.data
    k = min(n_neighbors, tree.n - 1)
    distance, neighbor = find_nearest(tree, points[rows], k + 1)
    distance, neighbor = distance[:, 1:], neighbor[:, 1:]
    step = points[neighbor] - points[rows][:, None, :]
    with np.errstate(divide="ignore"):
        log_distance = np.where(distance > 0, np.log(distance), np.nan)
    return log_distance, np.arctan2(step[..., 1], step[..., 0]), neighbor


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """Candidate pairs of a source and a reference star, with local scale and rotation.

    Parameters
    ----------
    source, reference : (n,) ndarray of int
        Rows in the two lists.
    log_scale, rotation : (n,) ndarray
        Natural logarithm of the scale, and rotation in rad, of the neighborhood of the reference
        star relative to that of the source.
    count, expected : (n,) ndarray
        Number of coinciding neighbors, and number expected by chance.
    surprise : (n,) ndarray
        Minus the decimal logarithm of the probability that a wrong candidate is as good.
    width : (n,) ndarray
        Width of the coincidence box.
    """

    source: np.ndarray
    reference: np.ndarray
    log_scale: np.ndarray
    rotation: np.ndarray
    count: np.ndarray
    expected: np.ndarray
    surprise: np.ndarray
    width: np.ndarray

    def __len__(self):
        return len(self.source)

    def take(self, rows):
        """Return some rows as a new object."""
        return Hypotheses(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


def compare_patterns(
    sources,
    anchors,
    tree,
    *,
    reach,
    n_source,
    n_reference,
    max_log_scale,
    max_rotation,
    budget,
    per_anchor=4,
):
    """Compare the neighbor patterns of some sources with those of all reference stars in reach.

    Parameters
    ----------
    sources : `~scipy.spatial.cKDTree`
        Tree of the sources.
    anchors : (n,) ndarray of int
        Sources to find.
    tree : `~scipy.spatial.cKDTree`
        Tree of the reference stars.
    reach : (n,) ndarray
        Largest displacement of each anchor, px.
    n_source, n_reference : int
        Neighbors to look at on either side.
    max_log_scale, max_rotation : float
        Largest difference of local scale (natural log) and rotation (rad).
    budget : int
        Maximum number of differences of neighbors; the last anchors are left out to respect it.
    per_anchor : int
        Candidates to keep for every source.

    Returns
    -------
    Hypotheses
        The best candidates, most surprising first.
    """
    sizes = tree.query_ball_point(sources.data[anchors], reach, return_length=True)
    affordable = np.cumsum(sizes) * n_source * n_reference <= budget
    affordable[:_LEAST_ANCHORS] = True
    anchors, reach = anchors[affordable], reach[affordable]
    source_log, source_angle, _ = neighbor_pattern(sources, anchors, n_source)
    candidates = tree.query_ball_point(sources.data[anchors], reach, return_sorted=False)
    sizes = np.array([len(c) for c in candidates])
    if sizes.sum() == 0:
        return Hypotheses(*(np.empty(0, int),) * 2, *(np.empty(0),) * 6)
    wanted = np.concatenate([np.asarray(c, int) for c in candidates])
    rows, where = np.unique(wanted, return_inverse=True)
    reference_log, reference_angle, _ = neighbor_pattern(tree, rows, n_reference)
    anchor_of = np.repeat(np.arange(len(anchors)), sizes)
    per_pair = source_log.shape[1] * reference_log.shape[1]
    parts = []
    chunk = max(1, _CHUNK // max(1, per_pair))
    for start in range(0, len(anchor_of), chunk):
        part = slice(start, start + chunk)
        parts.append(
            _coincidences(
                source_log[anchor_of[part]],
                source_angle[anchor_of[part]],
                reference_log[where[part]],
                reference_angle[where[part]],
                max_log_scale,
                max_rotation,
            )
        )
    log_scale, rotation, count, expected, surprise, width = (
        np.concatenate(p) for p in zip(*parts, strict=True)
    )
    order = np.lexsort((-surprise, anchor_of))
    first = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    rank = np.arange(len(order)) - np.repeat(first, sizes)
    # A star is at most one reference star, so second-best candidates are wrong and show what chance
    # produces: 10**-surprise becomes the probability of a single wrong candidate.
    second = surprise[order[(rank == 1)]]
    if len(second):
        surprise = surprise - max(0.0, np.median(second) - np.log10(np.median(sizes) / 2 + 1))
    order = order[(rank < per_anchor) & (surprise[order] > 0)]
    order = order[np.argsort(-surprise[order], kind="stable")]
    return Hypotheses(
        anchors[anchor_of[order]],
        rows[where[order]],
        log_scale[order],
        rotation[order],
        count[order],
        expected[order],
        surprise[order],
        width[order],
    )


def _coincidences(log_s, angle_s, log_r, angle_r, max_log_scale, max_rotation):
    """Find the best common shift in (log d, theta) of patterns (P, ks) against (P, kr)."""
    n, n_source = log_s.shape
    n_reference = log_r.shape[1]
    # Angles in 1/65536 turns: short integers wrap round by themselves.
    turn_s, turn_r = (
        np.rint(a * (2**15 / np.pi)).astype(np.int32).astype(np.uint16) for a in (angle_s, angle_r)
    )
    most = np.uint16(min(2**15 - 1, max_rotation * (2**15 / np.pi)))
    turn = turn_r[:, None, :] - turn_s[:, :, None] + most
    found = np.flatnonzero(turn <= 2 * most)
    d_angle = (turn.ravel()[found].astype(float) - most) * (np.pi / 2**15)
    pair, ks = found // (n_source * n_reference), found // n_reference % n_source
    d_log = log_r[pair, found % n_reference] - log_s[pair, ks]
    near = np.abs(d_log) <= max_log_scale
    pair, d_log, d_angle = pair[near], d_log[near], d_angle[near]
    surprise, half, expected, center = _fullest_boxes(
        pair, d_log, d_angle, n, max_log_scale, max_rotation
    )
    inside = np.abs(d_log - center[0, pair]) <= half[pair]
    inside &= np.abs(d_angle - center[1, pair]) <= half[pair]
    pair, d_log, d_angle = pair[inside], d_log[inside], d_angle[inside]
    count = np.bincount(pair, minlength=n)
    mean = [
        np.bincount(pair, weights=d, minlength=n) / np.maximum(count, 1) for d in (d_log, d_angle)
    ]
    return *mean, count, expected, surprise, 2 * half


def _fullest_boxes(pair, d_log, d_angle, n, max_log_scale, max_rotation):
    """Find the most surprising box of every pattern: its surprise, half width, chance, center.

    Boxes of every width stand on four staggered grids, so that none straddles an edge on all of
    them.  What shares a box of one width with too few others does so in every box of half the
    width, since that lies in one of the wider ones: wide boxes are counted first, and narrow ones
    only where they may be full.
    """
    in_range = np.bincount(pair, minlength=n)
    surprise, half, expected = np.zeros(n), np.zeros(n), np.zeros(n)
    center = np.zeros((2, n))
    for width in BOX_WIDTHS[::-1]:
        if width > 2 * max(max_log_scale, max_rotation):
            continue
        share = min(1.0, width**2 / (4 * max_log_scale * max_rotation))
        n_angle = int(2 * max_rotation / width) + 3
        per_pair = n_angle * (int(2 * max_log_scale / width) + 3)
        promising = np.zeros(len(pair), bool)
        # Of two equally surprising boxes, the narrower one is more accurate in scale and rotation.
        best = np.where(surprise > 0, np.nextafter(surprise, 0), 0.0)
        for edge in ((0.0, 0.0), (0.0, 0.5), (0.5, 0.0), (0.5, 0.5)):
            box = ((d_log + max_log_scale) / width + edge[0]).astype(np.int64) * n_angle
            box += ((d_angle + max_rotation) / width + edge[1]).astype(np.int64)
            box += pair * per_pair
            full, count, member = _count_in_boxes(box, n * per_pair)
            promising |= member
            owner, place = full // per_pair, full % per_pair
            chance = np.maximum((in_range[owner] - count) * share, 1e-3)
            now = -np.log10(np.maximum(gammainc(count, chance), 1e-300))
            better = np.flatnonzero(now > best[owner])
            better = better[np.lexsort((now[better], owner[better]))]
            # The last box of each owner is its best.
            better = better[np.diff(owner[better], append=-1) != 0]
            owner = owner[better]
            best[owner] = surprise[owner] = now[better]
            expected[owner], half[owner] = chance[better], width / 2
            center[0, owner] = (place[better] // n_angle + 0.5 - edge[0]) * width - max_log_scale
            center[1, owner] = (place[better] % n_angle + 0.5 - edge[1]) * width - max_rotation
        pair, d_log, d_angle = pair[promising], d_log[promising], d_angle[promising]
    return surprise, half, expected, center


def _count_in_boxes(box, n_boxes):
    """Boxes with enough members, their counts, and which members are in such a box."""
    if n_boxes > _DENSE * len(box):
        # With few members in many boxes, keep only boxes with members.
        order = np.argsort(box, kind="stable")
        start = np.flatnonzero(np.diff(box[order], prepend=-1))
        count = np.diff(start, append=len(box))
        member = np.empty(len(box), bool)
        member[order] = np.repeat(count >= _LEAST_COUNT, count)
        keep = count >= _LEAST_COUNT
        return box[order[start[keep]]], count[keep], member
    count = np.bincount(box, minlength=n_boxes)
    full = np.flatnonzero(count >= _LEAST_COUNT)
    return full, count[full], count[box] >= _LEAST_COUNT


def select_coherent(
    hypotheses,
    sources,
    reference,
    *,
    curvature,
    density,
    max_difference,
    max_seeds=8,
    most=500,
):
    """Find groups of consistent hypotheses.

    Two hypotheses agree if the local scale and rotation of one predict the position of the other,
    within the width of its box and the curvature of the distortion over the distance between them.

    Parameters
    ----------
    hypotheses : Hypotheses
        Candidates, most surprising first.
    sources, reference : ndarray
        Positions of the two lists, px.
    curvature : float
        Largest second derivative of the distortion, 1/px.
    density : float
        Reference stars per square pixel, for the probability that two agree by chance.
    max_difference : float
        Largest difference of scale and rotation that was allowed.
    max_seeds : int, optional
        Maximum number of groups.
    most : int, optional
        Maximum number of hypotheses that are used.

    Returns
    -------
    list of (support, rows)
        Sum of the surprises of each group, and its rows in `hypotheses`, best first.
    """
    h = hypotheses.take(slice(0, most))
    if len(h) == 0:
        return []
    at, to = sources[h.source], reference[h.reference]
    step = at[None] - at[:, None]
    c, s = np.exp(h.log_scale) * np.cos(h.rotation), np.exp(h.log_scale) * np.sin(h.rotation)
    predicted = to[:, None, :] + np.stack(
        [
            c[:, None] * step[..., 0] - s[:, None] * step[..., 1],
            s[:, None] * step[..., 0] + c[:, None] * step[..., 1],
        ],
        axis=-1,
    )
    distance = np.hypot(step[..., 0], step[..., 1])
    error = np.hypot(predicted[..., 0] - to[None, :, 0], predicted[..., 1] - to[None, :, 1])
    tolerance = 3.0 + 0.5 * h.width[:, None] * distance + 0.5 * curvature * distance**2
    slack = h.width[:, None] + h.width[None, :] + curvature * distance
    agree = (
        (error <= tolerance)
        & (np.abs(h.log_scale[:, None] - h.log_scale[None]) <= slack)
        & (np.abs(h.rotation[:, None] - h.rotation[None]) <= slack)
    )
    # An agreement counts as the surprise of the other one, less that of a choice among all stars
    # in reach.  Scale and rotation must agree as well.
    share = np.minimum(1.0, (slack / max_difference) ** 2)
    worth = h.surprise[None] - np.log10((1 + density * np.pi * tolerance**2) * share)
    worth = np.where(agree & (h.source[:, None] != h.source[None]), np.maximum(worth, 0.0), 0.0)
    np.fill_diagonal(worth, h.surprise)
    # A source counts once in a group, with its best hypothesis.
    order = np.argsort(h.source, kind="stable")
    starts = np.flatnonzero(np.concatenate([[True], np.diff(h.source[order]) > 0]))
    support = np.maximum.reduceat(worth[:, order], starts, axis=1).sum(axis=1)
    groups, taken = [], np.zeros(len(h), bool)
    for seed in np.argsort(-support, kind="stable"):
        if taken[seed]:
            continue
        members = np.flatnonzero(worth[seed] > _LEAST_WORTH)
        members = members[np.argsort(-worth[seed, members], kind="stable")]
        _, once = np.unique(h.source[members], return_index=True)
        members = members[np.sort(once)]
        taken[members] = True
        groups.append((float(support[seed]), members))
        if len(groups) == max_seeds:
            break
    return groups
