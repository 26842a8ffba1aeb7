"""The search: starts from patterns or a given mapping, growth to the whole frame, verdict."""

import logging
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from wpdc_gwcs.exceptions import MatchError
from wpdc_gwcs.matching._evidence import collect_evidence
from wpdc_gwcs.matching._features import (
    MAX_NEIGHBOURS,
    N_NEIGHBOURS,
    compare_patterns,
    density_ratio_map,
    neighbour_pattern,
    select_coherent,
)
from wpdc_gwcs.matching._mapping import fit_smooth_map, scatter_of
from wpdc_gwcs.matching._pairs import find_edges, one_to_one

__all__ = ["Limits", "Search", "Stars"]

logger = logging.getLogger(__name__)

# Sources of the bright subsets that are tried in turn; None stands for all.
_LEVELS = (500, 2000, None)
# Reference stars per source in a subset: more, since the cuts in flux and magnitude never
# correspond exactly.
_REFERENCE_SURPLUS = 2.0
# Stars to look up by their neighbourhood, first and second try.
_ANCHORS = (48, 200)
# Sources that take part in fits of the mapping: more would not make it better.
_FIT_SAMPLE = 20_000
# Pairing radius in units of the scatter: while the mapping grows, and in the end (chance to lose a
# right pair: 3e-7).
_GROW_RADIUS = 5.0
_FINAL_RADIUS = 5.5
_SMALLEST_RADIUS = 0.05
# A radius must not reach further than where this many stars are expected by chance.
_MAX_CROWDING = 0.25
_LOCAL_NEIGHBOURS = 16

_HINT = (
    "if the header may be mirrored, turned by 90 degrees, off in scale by up to 5 % or off in "
    "pointing by up to a quarter of the frame, widen the search with blind=True (--blind)"
)


@dataclass(frozen=True, eq=False)
class Stars:
    """One list of stars: positions, tree and how wide a radius may be at each of them."""

    points: np.ndarray
    tree: cKDTree
    limit: np.ndarray

    @classmethod
    def build(cls, points):
        tree = cKDTree(points)
        return cls(points, tree, _crowding_limit(points, tree))


@dataclass(frozen=True)
class Limits:
    """How wrong the start may be."""

    max_shift: float
    max_rotation: float
    max_scale: float
    max_distortion: float
    half_diagonal: float

    @property
    def curvature(self):
        return 2 * self.max_distortion / self.half_diagonal**2

    @property
    def gradient(self):
        return 2 * self.max_distortion / self.half_diagonal

    def reach(self, distance):
        """Largest displacement at a distance from the centre of the frame."""
        linear = np.deg2rad(self.max_rotation) + self.max_scale
        return (
            self.max_shift
            + linear * distance
            + self.max_distortion * (distance / self.half_diagonal) ** 2
        )


class Search:
    """One search: two lists and the rules; tries starts until one has evidence."""

    def __init__(
        self,
        sources,
        stars,
        flux,
        mag,
        errors,
        shape,
        frame,
        limits,
        max_order,
        min_significance,
        min_purity,
    ):
        self.sources, self.stars, self.flux, self.mag, self.errors = (
            sources,
            stars,
            flux,
            mag,
            errors,
        )
        self.shape, self.frame, self.limits, self.max_order = shape, frame, limits, max_order
        self.rules = {"min_significance": min_significance, "min_purity": min_purity}
        self.best_failure = None

    # starts

    def from_start(self, start, clock):
        """Begin with a mapping that is known to be nearly right."""
        mapped = np.column_stack(start(*self.sources.T))
        radius = np.minimum(_crowding_limit(self.sources, cKDTree(self.sources)), 20.0)
        i, j, _ = find_edges(mapped, self.stars.tree, radius, limit=self.stars.limit)
        keep, _ = one_to_one(i, j, len(self.sources), len(self.stars.points))
        clock.lap("start")
        found = self.finish(self.sources, (i[keep], j[keep]), clock)
        if found is None:
            raise self.refusal(hint=False)
        return *found, 1

    def by_patterns(self, blind, clock):
        """Look stars up by their neighbourhoods, bright ones first."""
        turns = _orientations() if blind else [np.eye(2)]
        for rows_s, rows_r in self.subsets():
            reference = self.stars if rows_r is None else Stars.build(self.stars.points[rows_r])
            if rows_r is None:
                rows_r = np.arange(len(reference.points))
            subset = self.sources[rows_s]
            tried = 0
            for n_anchors in _ANCHORS:
                if n_anchors != _ANCHORS[0] and tried >= len(subset):
                    break
                tried = n_anchors
                seeds = []
                for turn in turns:
                    turned = (subset - self.frame.center) @ turn.T + self.frame.center
                    hypotheses, groups = self.seeds(
                        turned, reference, self.flux_rank(rows_s), n_anchors
                    )
                    seeds += [
                        (support, turn, turned, hypotheses.take(rows)) for support, rows in groups
                    ]
                clock.lap("patterns")
                seeds.sort(key=lambda seed: -seed[0])
                for _, turn, turned, hypotheses in seeds[:8]:
                    found = self.grow_from(turned, reference, hypotheses, clock)
                    if found is None:
                        continue
                    i, j = found
                    pairs = rows_s[i], rows_r[j]
                    everything = (self.sources - self.frame.center) @ turn.T + self.frame.center
                    found = self.finish(everything, pairs, clock)
                    if found is not None:
                        self.check_header(found[0])
                        return (
                            _turn_mapping(found[0], turn),
                            *found[1:],
                            int(np.sign(np.linalg.det(turn))),
                        )
        raise self.refusal(hint=not blind)

    def subsets(self):
        """Rows of sources and reference stars to try in turn, bright ones first."""
        both = self.flux is not None and self.mag is not None
        nx, ny = self.shape[1], self.shape[0]
        x, y = self.stars.points.T
        inside = (x > -0.5) & (x < nx - 0.5) & (y > -0.5) & (y < ny - 0.5)
        for level in _LEVELS:
            if level is None:
                yield np.arange(len(self.sources)), None
            elif both and level < 0.7 * len(self.sources):
                rows_s = np.sort(np.argsort(-self.flux, kind="stable")[:level])
                order = np.argsort(-self.mag, kind="stable")
                wanted = _REFERENCE_SURPLUS * level
                counted = np.cumsum(inside[order])
                rows_r = np.sort(order[: int(np.searchsorted(counted, wanted)) + 1])
                yield rows_s, rows_r

    def flux_rank(self, rows):
        """Order in which stars are preferred as anchors; None without fluxes."""
        return None if self.flux is None else -self.flux[rows]

    def seeds(self, sources, reference, rank, n_anchors):
        """Hypotheses for a spread of anchors and the groups among them that agree."""
        ratio, _, _ = density_ratio_map(*sources.T, *reference.points.T, self.shape)
        many, few = np.quantile(ratio, [0.75, 0.25])
        n_source = int(min(MAX_NEIGHBOURS, np.ceil(N_NEIGHBOURS * max(1.0, many))))
        n_reference = int(min(MAX_NEIGHBOURS, np.ceil(N_NEIGHBOURS * max(1.0, 1 / few))))
        anchors = self.anchors(sources, rank, n_anchors)
        distance = np.hypot(*(sources[anchors] - self.frame.center).T)
        limits = self.limits
        hypotheses = compare_patterns(
            sources,
            anchors,
            reference.tree,
            reach=limits.reach(distance),
            n_source=n_source,
            n_reference=n_reference,
            max_log_scale=limits.max_scale + limits.gradient,
            max_rotation=np.deg2rad(limits.max_rotation) + limits.gradient,
        )
        area = np.pi * (limits.half_diagonal + limits.reach(limits.half_diagonal)) ** 2
        groups = select_coherent(
            hypotheses,
            sources,
            reference.points,
            curvature=limits.curvature,
            density=len(reference.points) / area,
            max_difference=limits.max_scale + limits.gradient,
        )
        return hypotheses, groups

    def anchors(self, sources, rank, n_anchors):
        """Spread anchors over the frame: the brightest (or most central) star of each cell."""
        n = len(sources)
        if n <= n_anchors:
            return np.arange(n)
        side = int(np.sqrt(n_anchors))
        ny, nx = self.shape
        u = np.clip(sources[:, 0] / nx * side, 0, side - 1e-9)
        v = np.clip(sources[:, 1] / ny * side, 0, side - 1e-9)
        cell = v.astype(int) * side + u.astype(int)
        if rank is None:
            rank = np.hypot(u % 1 - 0.5, v % 1 - 0.5)
        order = np.lexsort((rank, cell))
        first = np.concatenate([[True], cell[order][1:] != cell[order][:-1]])
        starts = np.flatnonzero(first)
        place = np.arange(n) - np.repeat(starts, np.diff(np.append(starts, n)))
        # empty cells leave room for second stars of full ones
        return order[np.argsort(place, kind="stable")[:n_anchors]]

    # growth

    def grow_from(self, sources, reference, hypotheses, clock):
        """Pairs of a subset that follow from a group of hypotheses, or None without evidence."""
        pairs = _neighbour_pairs(sources, reference, hypotheses)
        grown = self.grow(sources, reference, pairs)
        clock.lap("grow")
        if grown is None:
            return None
        fit, pairs, mapped, radius = grown
        evidence = collect_evidence(
            sources,
            mapped,
            radius,
            reference.points,
            reference.tree,
            reference.limit,
            fit.mapping,
            pairs,
            self.shape,
        )
        clock.lap("evidence")
        # loose: this only spares hopeless starts the full round
        if evidence.significance < 4 or evidence.purity < 0.5:
            self.note_failure(evidence)
            return None
        return pairs

    def grow(self, sources, reference, pairs, *, rounds=40):
        """Fit, predict, pair again with the radius of the fit until the pairs stay."""
        limit_s = _crowding_limit(sources, cKDTree(sources))
        before = None
        result = None
        for _ in range(rounds):
            i, j = pairs
            fit = fit_smooth_map(
                *sources[i].T,
                *reference.points[j].T,
                center=self.frame.center,
                scale=self.frame.scale,
                max_order=self.max_order,
            )
            if fit is None:
                return result
            mapped = np.column_stack(fit.mapping(*sources.T))
            radius = _GROW_RADIUS * fit.scatter * np.sqrt(1 + fit.leverage(*sources.T))
            radius = np.maximum(radius, _SMALLEST_RADIUS)
            radius[radius > limit_s] = 0.0
            i, j, _ = find_edges(mapped, reference.tree, radius, limit=reference.limit)
            keep, _ = one_to_one(i, j, len(sources), len(reference.points))
            pairs = i[keep], j[keep]
            result = fit, pairs, mapped, radius
            key = hash((i[keep].tobytes(), j[keep].tobytes()))
            if key == before:
                break
            before = key
        return result

    def finish(self, sources, pairs, clock):
        """Grow over all stars, pair with the final radius, judge; None without evidence."""
        step = max(1, -(-len(sources) // _FIT_SAMPLE))
        fit = fit_smooth_map(
            *sources[pairs[0]].T,
            *self.stars.points[pairs[1]].T,
            center=self.frame.center,
            scale=self.frame.scale,
            max_order=self.max_order,
        )
        if fit is None:
            return None
        part = np.arange(0, len(sources), step)
        mapped = np.column_stack(fit.mapping(*sources[part].T))
        radius = np.maximum(
            _GROW_RADIUS * fit.scatter * np.sqrt(1 + fit.leverage(*sources[part].T)),
            _SMALLEST_RADIUS,
        )
        i, j, _ = find_edges(mapped, self.stars.tree, radius, limit=self.stars.limit)
        keep, _ = one_to_one(i, j, len(part), len(self.stars.points))
        grown = self.grow(sources[part], self.stars, (i[keep], j[keep]))
        clock.lap("refine")
        if grown is None:
            return None
        fit, (i, j), _, _ = grown
        i = part[i]
        mapped = np.column_stack(fit.mapping(*sources.T))
        mapped, scatter = _correct_locally(sources, mapped, self.stars.points, (i, j), fit.scatter)
        radius = self.final_radius(mapped, (i, j), scatter)
        i, j, _ = find_edges(mapped, self.stars.tree, radius, limit=self.stars.limit)
        keep, n_ambiguous = one_to_one(i, j, len(sources), len(self.stars.points))
        pairs = i[keep], j[keep]
        clock.lap("pair")
        evidence = collect_evidence(
            sources,
            mapped,
            radius,
            self.stars.points,
            self.stars.tree,
            self.stars.limit,
            fit.mapping,
            pairs,
            self.shape,
        )
        clock.lap("evidence")
        if evidence.missing(**self.rules):
            self.note_failure(evidence)
            return None
        return fit.mapping, evidence, pairs, n_ambiguous, scatter, float(np.median(radius))

    def final_radius(self, mapped, pairs, scatter):
        """Radius of every source from its own error, scaled to the scatter that is seen."""
        i, j = pairs
        if self.errors is None:
            return np.full(len(mapped), max(_SMALLEST_RADIUS, _FINAL_RADIUS * scatter))
        difference = mapped[i] - self.stars.points[j]
        error = self.errors[i]
        # what the errors do not explain is the same for all: take it from the stars with small
        # errors
        small = error <= np.quantile(error, 0.3)
        floor = max(0.0, scatter_of(*difference[small].T) ** 2 - np.median(error[small]) ** 2)
        factor = scatter_of(*(difference / np.sqrt(error**2 + floor)[:, None]).T)
        return np.maximum(
            _SMALLEST_RADIUS, _FINAL_RADIUS * factor * np.sqrt(self.errors**2 + floor)
        )

    # refusals

    def check_header(self, mapping):
        """Refuse what is further from the header than allowed, naming it."""
        shift, matrix = mapping.linear_part()
        shift = float(np.hypot(*shift))
        rotation = float(
            np.rad2deg(np.arctan2(matrix[1, 0] - matrix[0, 1], matrix[0, 0] + matrix[1, 1]))
        )
        scale = float(np.sqrt(abs(np.linalg.det(matrix))))
        limits = self.limits
        for what, value, most, unit in (
            ("pointing", shift, limits.max_shift, "px"),
            ("rotation", abs(rotation), limits.max_rotation, "deg"),
            ("scale", 100 * abs(scale - 1), 100 * limits.max_scale, "%"),
        ):
            if value > most:
                raise MatchError(
                    f"the {what} of the starting WCS is off by {value:.4g} {unit}, "
                    f"{most:.4g} {unit} are allowed; {_HINT}"
                )

    def note_failure(self, evidence):
        if self.best_failure is None or evidence.significance > self.best_failure.significance:
            self.best_failure = evidence

    def refusal(self, *, hint):
        """Build the error that says what was missing."""
        counts = f"{len(self.sources)} sources, {len(self.stars.points)} reference stars in reach"
        if self.best_failure is None:
            reason = "no group of sources has the pattern of any group of reference stars"
        else:
            reason = (
                self.best_failure.missing(**self.rules)
                or "the pairs of a part do not carry over to the frame"
            )
        return MatchError(
            f"no match with sufficient evidence ({counts}): {reason}"
            + (f"; {_HINT}" if hint else "")
        )


def _orientations():
    """List the eight ways to read a rectangle's axes, the plain one first."""
    quarter = np.array([[0.0, -1.0], [1.0, 0.0]])
    flip = np.diag([-1.0, 1.0])
    turns = [np.linalg.matrix_power(quarter, n) for n in range(4)]
    return turns + [turn @ flip for turn in turns]


def _turn_mapping(mapping, turn):
    """Rewrite the mapping of a turned frame as one of the frame itself, exactly."""
    if (turn == np.eye(2)).all():
        return mapping
    n = mapping.order + 2
    u, v = np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n))
    x, y = (
        mapping.center[0] + mapping.scale * u.ravel(),
        mapping.center[1] + mapping.scale * v.ravel(),
    )
    turned = (np.column_stack([x, y]) - mapping.center) @ turn.T + mapping.center
    fit = fit_smooth_map(
        x,
        y,
        *mapping(*turned.T),
        center=mapping.center,
        scale=mapping.scale,
        max_order=mapping.order,
    )
    return fit.mapping


def _neighbour_pairs(sources, reference, hypotheses):
    """First pairs: the stars of a group of hypotheses and neighbours that coincide."""
    tree = cKDTree(sources)
    log_d, angle, neighbour = neighbour_pattern(sources, tree, hypotheses.source, N_NEIGHBOURS)
    distance = np.exp(log_d + hypotheses.log_scale[:, None])
    angle = angle + hypotheses.rotation[:, None]
    place = reference.points[hypotheses.reference][:, None, :] + np.stack(
        [distance * np.cos(angle), distance * np.sin(angle)], axis=-1
    )
    gap, found = reference.tree.query(place.reshape(-1, 2), workers=2)
    gap, found = gap.reshape(distance.shape), found.reshape(distance.shape)
    good = np.isfinite(distance) & (gap <= 0.7 * hypotheses.width[:, None] * distance)
    relative = np.where(good, gap / distance, np.inf)
    i = np.concatenate([hypotheses.source, neighbour[good]])
    j = np.concatenate([hypotheses.reference, found[good]])
    relative = np.concatenate([np.zeros(len(hypotheses)), relative[good]])
    # one pair per star of either list: the closest
    for side in (0, 1):
        order = np.lexsort((relative, (i, j)[side]))
        _, first = np.unique((i, j)[side][order], return_index=True)
        keep = order[first]
        i, j, relative = i[keep], j[keep], relative[keep]
    return i, j


def _correct_locally(sources, mapped, reference, pairs, scatter):
    """Take off what neighbouring pairs have in common, if that helps pairs left out."""
    i, j = pairs
    if len(i) < 4 * _LOCAL_NEIGHBOURS:
        return mapped, scatter
    residual = reference[j] - mapped[i]
    tree = cKDTree(sources[i])
    _, near = tree.query(sources[i], k=_LOCAL_NEIGHBOURS + 1, workers=2)
    left_out = residual - np.median(residual[near[:, 1:]], axis=1)
    now = scatter_of(*left_out.T)
    if now > 0.9 * scatter_of(*residual.T):
        return mapped, scatter
    _, near = tree.query(sources, k=_LOCAL_NEIGHBOURS, workers=2)
    return mapped + np.median(residual[near], axis=1), now


def _crowding_limit(points, tree):
    """Radius within which `_MAX_CROWDING` stars are expected, by the sixth neighbour."""
    k = min(6, tree.n - 1)
    if k < 1:
        return np.full(tree.n, np.inf)
    distance = tree.query(points, k=[k + 1], workers=2)[0][:, 0]
    return distance * np.sqrt(_MAX_CROWDING / k)
