"""Hypotheses: candidate pairs of sources and reference stars, from patterns of neighbors."""

from dataclasses import dataclass

import numpy as np

from wpdc_gwcs.detector import on_detector
from wpdc_gwcs.matching._features import (
    MAX_NEIGHBORS,
    N_NEIGHBORS,
    compare_patterns,
    density_ratio_map,
    neighbor_pattern,
    select_coherent,
)
from wpdc_gwcs.matching._orientations import orientations
from wpdc_gwcs.matching._pairs import find_nearest
from wpdc_gwcs.matching._problem import MIN_STARS, Problem, Stars

__all__ = [
    "Seed",
    "bright_subsets",
    "count_neighbors",
    "find_groups",
    "first_pairs",
    "find_seeds",
]

# Numbers of sources in the bright subsets that are tried in turn; then all are used.
_LEVELS = (500, 2000)
# Reference stars per source in a subset: more, since the cuts in flux and magnitude never
# correspond exactly.
_REFERENCE_SURPLUS = 2.0
# Sources per star of the sparser list in a subset.
_SOURCE_SURPLUS = 1.3
# Stars to look up by their neighborhood and neighbors to compare, try by try: the first finds
# most fields in a tenth of a second, the last those where half of the neighbors are missing.
_TRIES = ((16, 8), (49, 12), (196, 24))
# Maximum number of comparisons in one try: some seconds.
_BUDGET = 100_000_000
# Maximum number of groups of hypotheses to follow.
_N_SEEDS = 8
# Number of triples of pairs tried for a linear mapping, and fraction of pairs that should agree.
_N_TRIPLES = 1000
_AGREEING_SHARE = 0.2


@dataclass(frozen=True, eq=False)
class Seed:
    """A group of consistent hypotheses, and the lists that it refers to."""

    problem: Problem
    support: float
    sources: Stars
    reference: Stars
    source_rows: np.ndarray
    reference_rows: np.ndarray
    hypotheses: object
    n_near: int

    def pairs_to_try(self):
        """Yield first pairs as rows of the lists of the seed."""
        return first_pairs(self.sources, self.reference, self.hypotheses, self.n_near)

    def rows(self, pairs):
        """Convert pairs of the lists of the seed to rows of the whole lists."""
        return self.source_rows[pairs[0]], self.reference_rows[pairs[1]]


def find_seeds(problem):
    """Yield a list of seeds for each try, those with most support first.

    Bright stars are tried first, then more of them, then all, each with more and more anchors.
    """
    problems = [problem]
    if problem.options.blind:
        problems = [problem.turned(turn) for turn in orientations()]
    for rows_s, rows_r in bright_subsets(problem):
        sources = Stars.build(problem.sources[rows_s])
        references = [turned.stars for turned in problems]
        if len(rows_r) < len(problem.stars.points):
            references = [Stars.build(stars.points[rows_r]) for stars in references]
        rank = None if problem.flux is None else -problem.flux[rows_s]
        for n_anchors, n_neighbors in _TRIES:
            seeds = []
            for turned, reference in zip(problems, references, strict=True):
                n_near, _ = count_neighbors(turned, sources, reference, N_NEIGHBORS)
                hypotheses, groups = find_groups(
                    turned,
                    sources,
                    reference,
                    rank,
                    n_anchors,
                    n_neighbors,
                    _BUDGET // len(problems),
                )
                lists = sources, reference, rows_s, rows_r
                seeds += [
                    Seed(turned, support, *lists, hypotheses.take(rows), n_near)
                    for support, rows in groups
                ]
            seeds.sort(key=lambda seed: -seed.support)
            yield seeds[:_N_SEEDS]


def bright_subsets(problem):
    """Yield rows of sources and reference stars to try in turn, bright ones first.

    A subset has about as many stars of either list as the sparser one has on the frame: stars
    fainter than the limit of the other list could only disturb.
    """
    ny, nx = problem.shape
    everything = np.arange(len(problem.sources)), np.arange(len(problem.stars.points))
    if problem.flux is not None and problem.brightness is not None:
        x, y = problem.stars.points.T
        inside = on_detector(*problem.stars.points.T, problem.shape)
        most = _SOURCE_SURPLUS * min(len(problem.sources), max(np.count_nonzero(inside), 1))
        by_flux = np.argsort(-problem.flux, kind="stable")
        by_mag = np.argsort(-problem.brightness, kind="stable")
        counted = np.cumsum(inside[by_mag])
        before = 0
        for level in _LEVELS:
            n = int(min(level, most))
            last = int(np.searchsorted(counted, _REFERENCE_SURPLUS * n)) + 1
            rows = np.sort(by_flux[:n]), np.sort(by_mag[:last])
            size = len(rows[0]) + len(rows[1])
            if n >= MIN_STARS and before < size < len(everything[0]) + len(everything[1]):
                yield rows
            before = size
    yield everything


def count_neighbors(problem, sources, reference, n_neighbors):
    """Numbers of neighbors to compare in both lists, given that of the sparser list."""
    ratio, _, _ = density_ratio_map(*sources.points.T, *reference.points.T, problem.shape)
    many, few = np.quantile(ratio, [0.75, 0.25])
    return tuple(
        int(min(MAX_NEIGHBORS, np.ceil(n_neighbors * max(1.0, surplus))))
        for surplus in (many, 1 / few)
    )


def find_groups(problem, sources, reference, rank, n_anchors, n_neighbors, budget):
    """Make hypotheses for spread anchors, and find consistent groups among them."""
    n_source, n_reference = count_neighbors(problem, sources, reference, n_neighbors)
    anchors = _choose_anchors(problem, sources.points, rank, n_anchors)
    distance = np.hypot(*(sources.points[anchors] - problem.frame.center).T)
    limits = problem.limits
    hypotheses = compare_patterns(
        sources.tree,
        anchors,
        reference.tree,
        reach=limits.reach(distance),
        n_source=n_source,
        n_reference=n_reference,
        max_log_scale=limits.max_scale + limits.gradient,
        max_rotation=np.deg2rad(limits.max_turn) + limits.gradient,
        budget=budget,
    )
    area = np.pi * (limits.half_diagonal + limits.reach(limits.half_diagonal)) ** 2
    groups = select_coherent(
        hypotheses,
        sources.points,
        reference.points,
        curvature=limits.curvature,
        density=len(reference.points) / area,
        max_difference=limits.max_scale + limits.gradient,
    )
    return hypotheses, groups


def _choose_anchors(problem, sources, rank, n_anchors):
    """Spread anchors over the frame: the brightest (or most central) star of each cell."""
    n = len(sources)
    if n <= n_anchors:
        return np.arange(n)
    side = int(np.sqrt(n_anchors))
    ny, nx = problem.shape
    u = np.clip(sources[:, 0] / nx * side, 0, side - 1e-9)
    v = np.clip(sources[:, 1] / ny * side, 0, side - 1e-9)
    cell = v.astype(int) * side + u.astype(int)
    if rank is None:
        rank = np.hypot(u % 1 - 0.5, v % 1 - 0.5)
    order = np.lexsort((rank, cell))
    first = np.concatenate([[True], cell[order][1:] != cell[order][:-1]])
    starts = np.flatnonzero(first)
    place = np.arange(n) - np.repeat(starts, np.diff(np.append(starts, n)))
    # Empty cells leave room for second stars of full ones; central stars come first, because the
    # distortion is usually weakest there.
    chosen = order[np.argsort(place, kind="stable")[:n_anchors]]
    return chosen[np.argsort(np.hypot(*(sources[chosen] - problem.frame.center).T))]


def first_pairs(sources, reference, hypotheses, n_neighbors):
    """Yield sets of pairs to start from, the most promising first."""
    pairs = _neighbor_pairs(sources, reference, hypotheses, n_neighbors)
    yield pairs
    if len(hypotheses) > 1:
        agreeing = _agreeing_pairs(sources.points, reference.points, pairs)
        if agreeing is not None:
            yield agreeing
    if len(hypotheses) > 1 or n_neighbors > N_NEIGHBORS:
        alone = _neighbor_pairs(sources, reference, hypotheses.take(slice(0, 1)), n_neighbors)
        yield alone
        if n_neighbors > N_NEIGHBORS:
            # Most neighbors are missing in the other list, so many coincidences are due to chance.
            agreeing = _agreeing_pairs(sources.points, reference.points, alone)
            if agreeing is not None:
                yield agreeing


def _agreeing_pairs(sources, reference, pairs):
    """Pairs that agree best with a linear mapping, by the smallest quantile of the residuals.

    Unlike least squares with clipping, this finds the correct pairs even if they are a minority.
    """
    i, j = pairs
    if len(i) < 6:
        return None
    rng = np.random.default_rng(len(i))
    triples = rng.integers(len(i), size=(_N_TRIPLES, 3))
    at, to = sources[i], reference[j]
    design = np.dstack([np.ones((_N_TRIPLES, 3)), at[triples]])
    size = np.abs(np.linalg.det(design))
    # Three stars on a line do not determine a mapping.
    triples, design = triples[size > np.median(size)], design[size > np.median(size)]
    linear = np.linalg.solve(design, to[triples])
    left = np.column_stack([np.ones(len(i)), at]) @ linear - to
    left = np.hypot(left[..., 0], left[..., 1])
    quantile = np.quantile(left, _AGREEING_SHARE, axis=1)
    best = left[np.argmin(quantile)]
    keep = best <= 2.0 * quantile.min()
    return i[keep], j[keep]


def _neighbor_pairs(sources, reference, hypotheses, n_neighbors):
    """First pairs: the stars of a group of hypotheses and neighbors that coincide."""
    log_d, angle, neighbor = neighbor_pattern(sources.tree, hypotheses.source, n_neighbors)
    distance = np.exp(log_d + hypotheses.log_scale[:, None])
    angle = angle + hypotheses.rotation[:, None]
    place = reference.points[hypotheses.reference][:, None, :] + np.stack(
        [distance * np.cos(angle), distance * np.sin(angle)], axis=-1
    )
    gap, found = find_nearest(reference.tree, place.reshape(-1, 2), 1)
    gap, found = gap.reshape(distance.shape), found.reshape(distance.shape)
    good = np.isfinite(distance) & (gap <= 0.7 * hypotheses.width[:, None] * distance)
    relative = np.where(good, gap / distance, np.inf)
    i = np.concatenate([hypotheses.source, neighbor[good]])
    j = np.concatenate([hypotheses.reference, found[good]])
    relative = np.concatenate([np.zeros(len(hypotheses)), relative[good]])
    # One pair per star of either list: the closest one.
    for side in (0, 1):
        order = np.lexsort((relative, (i, j)[side]))
        _, first = np.unique((i, j)[side][order], return_index=True)
        keep = order[first]
        i, j, relative = i[keep], j[keep], relative[keep]
    return i, j
