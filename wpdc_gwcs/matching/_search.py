"""The search: starts from patterns or a given mapping, growth to the whole frame, verdict."""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from wpdc_gwcs.exceptions import MatchError
from wpdc_gwcs.matching._evidence import Evidence, collect_evidence, judge_few
from wpdc_gwcs.matching._features import (
    MAX_NEIGHBOURS,
    N_NEIGHBOURS,
    compare_patterns,
    density_ratio_map,
    neighbour_pattern,
    select_coherent,
)
from wpdc_gwcs.matching._local import LocalCorrection
from wpdc_gwcs.matching._mapping import (
    SmoothMap,
    find_narrow_axis,
    fit_smooth_map,
    scatter_of,
    turn_and_scale,
)
from wpdc_gwcs.matching._pairs import find_edges, find_nearest, one_to_one
from wpdc_gwcs.matching._rivals import find_rival_offset

__all__ = ["Limits", "Match", "Search", "Stars", "first_pairs"]

# Fewer stars than this in either list cannot give evidence whatever they do.
MIN_STARS = 8

# Where either list has no more stars than this on the frame, the few are judged by `judge_few` too:
# with more, right matches have enough pairs for the chance level to be counted.
_FEW = 100

# Sources of the bright subsets that are tried in turn; then all.
_LEVELS = (500, 2000)
# Reference stars per source in a subset: more, since the cuts in flux and magnitude never
# correspond exactly.
_REFERENCE_SURPLUS = 2.0
# Sources per star of the sparser list in a subset.
_SOURCE_SURPLUS = 1.3
# Stars to look up by their neighbourhood and neighbours to compare, try by try.
_TRIES = ((16, 8), (49, 12), (196, 24))
# Comparisons of neighbours in one try.
_BUDGET = 100_000_000
# Starts that may end well but for a part of the frame.
_MOST_PARTIAL = 3
# Groups of hypotheses that are followed up.
_N_SEEDS = 8
# Groups with this share of the support of one that has led to a match are followed too; a second
# match with this share of the evidence of the first (in -2 ln P) is as good, and the better one of
# two is looked for this many times.
_RIVAL_SUPPORT = 0.3
_EQUAL = 0.7
_MOST_RIVALS = 4
# Triples of pairs tried for a linear mapping, and the share of pairs that should follow it.
_N_TRIPLES = 1000
_AGREEING_SHARE = 0.2
# Sources that take part in fits of the mapping: more would not make it better.
_FIT_SAMPLE = 20_000
# Lists up to this length try lower orders when they are stuck.
_EXPLORED = 3000
# Pairing radius in units of the scatter: while the mapping grows, and in the end (chance to lose a
# right pair: 3e-7).
_GROW_RADIUS = 5.0
_FINAL_RADIUS = 5.5
_SMALLEST_RADIUS = 0.05
# Radius about a mapping that the caller gives.
_START_RADIUS = 20.0
# A radius must not reach further than where this many stars are expected by chance.
_MAX_CROWDING = 0.25
# While growing, a radius that would be larger by no more than this factor is cut to that limit.
_SLACK = 2.5
# Radius that may be used where stars are so sparse that 0.3 % are expected by chance within it.
_WIDE_RADIUS = 20.0
_HARMLESS = np.sqrt(0.003 / _MAX_CROWDING)
# No header is right up to a rotation and yet so far off in the area of a pixel: that is a mirror.
_MOST_STRETCH = 2.0
# Clipping once the pairs are nearly pure, in units of the scatter.
_LOOSE_CLIP = 50.0

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


@dataclass(frozen=True, eq=False)
class Match:
    """What a search found: the mapping, the pairs and their evidence."""

    turn: np.ndarray
    turned_mapping: SmoothMap
    mapped: np.ndarray
    radius: np.ndarray
    pairs: tuple
    n_ambiguous: int
    scatter: float
    evidence: Evidence

    @property
    def mapping(self):
        """The mapping of the frame as it was given."""
        return _turn_mapping(self.turned_mapping, self.turn)

    @property
    def parity(self):
        """-1 where the frame is mirrored."""
        return int(np.sign(np.linalg.det(self.turn)))


@dataclass(eq=False)
class Search:
    """One search: two lists and the rules; tries starts until one has evidence."""

    sources: np.ndarray
    stars: Stars
    source_rows: np.ndarray
    reference_rows: np.ndarray
    n_duplicates: int
    flux: np.ndarray | None
    brightness: np.ndarray | None
    errors: np.ndarray | None
    shape: tuple
    frame: SmoothMap
    limits: Limits
    max_order: int
    rules: dict
    best_failure: object = None
    seen: set = field(default_factory=set)
    n_partial: int = 0

    # starts

    @cached_property
    def limit(self):
        """Largest radius that says something at each source."""
        return _crowding_limit(self.sources, cKDTree(self.sources))

    def from_start(self, start, clock):
        """Begin with a mapping that is known to be nearly right."""
        part = _sample(len(self.sources))
        mapped = np.column_stack(start(*self.sources[part].T))
        radius = np.minimum(self.limit[part], _START_RADIUS)
        pairs, _ = _pair(mapped, radius, self.limit[part], self.stars)
        clock.lap("start")
        found = self.finish(np.eye(2), (part[pairs[0]], pairs[1]), clock)
        if found is None:
            raise self.refusal(hint=False)
        return self.without_rival(found, clock)

    def by_patterns(self, blind, clock):
        """Look stars up by their neighbourhoods, bright ones first."""
        turns = _orientations() if blind else [np.eye(2)]
        for rows_s, rows_r in self.subsets():
            reference = self.stars
            if len(rows_r) < len(reference.points):
                reference = Stars.build(reference.points[rows_r])
            for n_anchors, n_neighbours in _TRIES:
                seeds = []
                for turn in turns:
                    sources = Stars.build(self.turned(turn)[rows_s])
                    n_near, _ = self.neighbourhood(sources, reference, N_NEIGHBOURS)
                    hypotheses, groups = self.seeds(
                        sources,
                        reference,
                        self.flux_rank(rows_s),
                        n_anchors,
                        n_neighbours,
                        _BUDGET // len(turns),
                    )
                    seeds += [
                        (support, turn, sources, hypotheses.take(rows), n_near)
                        for support, rows in groups
                    ]
                clock.lap("patterns")
                seeds.sort(key=lambda seed: -seed[0])
                found = self.follow(seeds[:_N_SEEDS], rows_s, reference, rows_r, clock)
                if found is not None:
                    return found
        raise self.refusal(hint=not blind)

    def follow(self, seeds, rows_s, reference, rows_r, clock):
        """Follow groups of hypotheses until one has evidence, and those that could rival it."""
        best, best_support, beyond = None, 0.0, None
        for support, turn, sources, hypotheses, n_near in seeds:
            if best is not None and (
                support < _RIVAL_SUPPORT * best_support
                or self.is_explained(best, rows_s[hypotheses.source], rows_r[hypotheses.reference])
            ):
                continue
            for pairs in first_pairs(sources, reference, hypotheses, n_near):
                found = self.try_pairs(turn, sources, rows_s, reference, rows_r, pairs, clock)
                if found is None:
                    if self.n_partial >= _MOST_PARTIAL and best is None:
                        raise self.refusal(hint=False)
                    continue
                error = self.header_error(found)
                if error is not None:
                    beyond = beyond or error
                elif best is None:
                    best, best_support = found, support
                else:
                    best = self.prefer(best, found)
                break
        if best is not None:
            return self.without_rival(best, clock)
        if beyond is not None:
            raise beyond
        return None

    def try_pairs(self, turn, sources, rows_s, reference, rows_r, pairs, clock):
        """Grow from first pairs of a subset to the frame; None without evidence."""
        pairs = self.grow_from(sources, reference, pairs, clock)
        if pairs is None:
            return None
        pairs = rows_s[pairs[0]], rows_r[pairs[1]]
        key = turn.tobytes(), _key(pairs)
        if key in self.seen:
            return None
        self.seen.add(key)
        return self.finish(turn, pairs, clock)

    def turned(self, turn):
        """All sources, turned about the centre of the frame."""
        return (self.sources - self.frame.center) @ turn.T + self.frame.center

    def subsets(self):
        """Rows of sources and reference stars to try in turn, bright ones first.

        A subset has about as many stars of either list as the sparser one has on the frame: what is
        fainter than the limit of the other list can only disturb.
        """
        ny, nx = self.shape
        everything = np.arange(len(self.sources)), np.arange(len(self.stars.points))
        if self.flux is not None and self.brightness is not None:
            x, y = self.stars.points.T
            inside = (x > -0.5) & (x < nx - 0.5) & (y > -0.5) & (y < ny - 0.5)
            most = _SOURCE_SURPLUS * min(len(self.sources), max(np.count_nonzero(inside), 1))
            by_flux = np.argsort(-self.flux, kind="stable")
            by_mag = np.argsort(-self.brightness, kind="stable")
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

    def flux_rank(self, rows):
        """Order in which stars are preferred as anchors; None without fluxes."""
        return None if self.flux is None else -self.flux[rows]

    def neighbourhood(self, sources, reference, n_neighbours):
        """Neighbours to look at on either side, for so many in the sparser list."""
        ratio, _, _ = density_ratio_map(*sources.points.T, *reference.points.T, self.shape)
        many, few = np.quantile(ratio, [0.75, 0.25])
        return tuple(
            int(min(MAX_NEIGHBOURS, np.ceil(n_neighbours * max(1.0, surplus))))
            for surplus in (many, 1 / few)
        )

    def seeds(self, sources, reference, rank, n_anchors, n_neighbours, budget):
        """Hypotheses for a spread of anchors and the groups among them that agree."""
        n_source, n_reference = self.neighbourhood(sources, reference, n_neighbours)
        anchors = self.anchors(sources.points, rank, n_anchors)
        distance = np.hypot(*(sources.points[anchors] - self.frame.center).T)
        limits = self.limits
        hypotheses = compare_patterns(
            sources.tree,
            anchors,
            reference.tree,
            reach=limits.reach(distance),
            n_source=n_source,
            n_reference=n_reference,
            max_log_scale=limits.max_scale + limits.gradient,
            max_rotation=np.deg2rad(limits.max_rotation) + limits.gradient,
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
        # empty cells leave room for second stars of full ones; central stars first, where the
        # distortion is weakest as a rule
        chosen = order[np.argsort(place, kind="stable")[:n_anchors]]
        return chosen[np.argsort(np.hypot(*(sources[chosen] - self.frame.center).T))]

    # growth

    def grow_from(self, sources, reference, pairs, clock):
        """Pairs of a subset that follow from first pairs, or None without evidence."""
        part = _sample(len(sources.points), pairs[0])
        pairs = np.searchsorted(part, pairs[0]), pairs[1]
        points = sources.points[part]
        grown = self.grow(points, sources.limit[part], reference, pairs)
        clock.lap("grow")
        if grown is None:
            return None
        fit, pairs, mapped, radius = grown
        evidence = collect_evidence(
            points, mapped, radius, reference, fit.mapping, pairs, self.shape, slack=_SLACK
        )
        clock.lap("evidence")
        # loose: this only spares hopeless starts the full round
        if evidence.significance < 4 or evidence.purity < 0.5:
            self.note_failure(evidence)
            return None
        return part[pairs[0]], pairs[1]

    def grow(self, points, limit, reference, pairs):
        """Grow first pairs as far as they carry.

        A high order may fit the stars that are there and predict nothing beyond them.  So when the
        pairs stay, lower orders are tried too, and one that brings clearly more pairs carries on.
        """
        grown = self.grow_to_rest(points, limit, reference, pairs)
        if grown is None or len(points) > _EXPLORED:
            return grown
        net = _count_net(grown, reference)
        order = grown[0].mapping.order
        while order > 1:
            order -= 1
            step = self.grow_once(points, limit, reference, grown[1], order)
            if step is None or _count_net(step, reference) < net + max(2.0, 0.05 * net):
                continue
            further = self.grow_to_rest(points, limit, reference, step[1])
            if further is not None and _count_net(further, reference) > net + 1.0:
                grown, net = further, _count_net(further, reference)
                order = grown[0].mapping.order
        return grown

    def grow_to_rest(self, points, limit, reference, pairs, *, rounds=40):
        """Fit, predict, pair again with the radius of the fit until the pairs stay."""
        grown = None
        for _ in range(rounds):
            step = self.grow_once(points, limit, reference, pairs, self.max_order)
            if step is None:
                break
            at_rest = grown is not None and _are_alike(step[1], pairs)
            grown, pairs = step, step[1]
            if at_rest:
                break
        return grown

    def grow_once(self, points, limit, reference, pairs, max_order):
        """Fit and pair again: fit, pairs, mapped positions, radii; `None` without a fit."""
        i, j = pairs
        fit = self.fit(points[i], reference.points[j], max_order=max_order)
        if fit is None:
            return None
        mapped, leverage = _predict(points, fit, None)
        radius = _GROW_RADIUS * fit.scatter * np.sqrt(1 + leverage)
        pairs, radius = _pair(mapped, radius, limit, reference)
        return fit, pairs, mapped, radius

    def grow_locally(self, points, limit, fit, pairs, *, rounds=12):
        """Take off what neighbouring pairs have in common, and pair again until the pairs stay.

        The pairs are nearly pure by now, so the polynomial is fitted without clipping: clipping
        would keep it from following where the distortion is steepest, in the corners.
        """
        scatter, local = fit.scatter, None
        reference = self.stars
        for _ in range(rounds):
            i, j = pairs
            fit = self.fit(points[i], reference.points[j], clip=_LOOSE_CLIP) or fit
            residual = reference.points[j] - np.column_stack(fit.mapping(*points[i].T))
            local = LocalCorrection.if_worthwhile(points[i], residual)
            scatter = fit.scatter
            if local is not None:
                scatter = scatter_of(*(residual - local(points[i], leave_out=True)[0]).T)
            mapped, leverage = _predict(points, fit, local)
            error = scatter * np.sqrt(1 + leverage)
            # where stars are sparse a wider radius costs nothing, and lets the mapping follow what
            # it could not foresee
            near = find_nearest(reference.tree, mapped, 1)[1]
            harmless = _HARMLESS * np.minimum(limit, reference.limit[near])
            radius = np.maximum(_GROW_RADIUS * error, np.minimum(_WIDE_RADIUS * error, harmless))
            before, (pairs, _) = pairs, _pair(mapped, radius, limit, reference)
            if _are_alike(pairs, before):
                break
        return fit, local, pairs, scatter

    def finish(self, turn, pairs, clock):
        """Grow over all stars, pair with the final radius, judge; None without evidence."""
        points = self.turned(turn)
        fit = self.fit(points[pairs[0]], self.stars.points[pairs[1]])
        if fit is None:
            return None
        part = _sample(len(points))
        some, limit = points[part], self.limit[part]
        mapped, leverage = _predict(some, fit, None)
        radius = _GROW_RADIUS * fit.scatter * np.sqrt(1 + leverage)
        pairs, _ = _pair(mapped, radius, limit, self.stars)
        grown = self.grow(some, limit, self.stars, pairs)
        if grown is None:
            clock.lap("refine")
            return None
        fit, local, pairs, scatter = self.grow_locally(some, limit, *grown[:2])
        clock.lap("refine")
        if len(pairs[0]) < MIN_STARS:
            return None
        mapped, leverage = _predict(points, fit, local)
        radius = self.final_radius(mapped, (part[pairs[0]], pairs[1]), scatter, leverage)
        i, j, _ = find_edges(mapped, self.stars.tree, radius, limit=self.stars.limit)
        keep, n_ambiguous = one_to_one(i, j, len(points), len(self.stars.points))
        pairs = i[keep], j[keep]
        clock.lap("pair")
        evidence = collect_evidence(
            points, mapped, radius, self.stars, fit.mapping, pairs, self.shape
        )
        if min(evidence.n_sources, evidence.n_reference) <= _FEW:
            limits = self.limits
            reach = limits.reach(limits.half_diagonal)
            judged = judge_few(
                points,
                mapped,
                radius,
                leverage,
                self.stars,
                fit.n_terms,
                pairs,
                self.shape,
                reaches=(reach, reach - limits.max_shift, limits.max_distortion),
                brightness=None
                if self.flux is None or self.brightness is None
                else (self.flux, self.brightness),
            )
            evidence = replace(evidence, search_significance=judged)
        clock.lap("evidence")
        if evidence.missing(**self.rules):
            self.note_failure(evidence)
            # right as a whole but for a part of the frame: other starts seldom help
            self.n_partial += evidence.is_significant(self.rules["min_significance"])
            return None
        return Match(turn, fit.mapping, mapped, radius, pairs, n_ambiguous, scatter, evidence)

    def fit(self, points, reference, *, max_order=None, **options):
        """Fit a smooth mapping in the frame's own units."""
        return fit_smooth_map(
            *points.T,
            *reference.T,
            center=self.frame.center,
            scale=self.frame.scale,
            max_order=max_order or self.max_order,
            narrow=find_narrow_axis(self.shape),
            **options,
        )

    def final_radius(self, mapped, pairs, scatter, leverage):
        """Radius of every source from its own error and that of the mapping where it stands."""
        if self.errors is None:
            own = np.full(len(mapped), scatter)
        else:
            i, j = pairs
            difference = mapped[i] - self.stars.points[j]
            error = self.errors[i]
            # what the errors do not explain is the same for all: take it from the best stars
            small = error <= np.quantile(error, 0.3)
            floor = max(0.0, scatter_of(*difference[small].T) ** 2 - np.median(error[small]) ** 2)
            factor = scatter_of(*(difference / np.sqrt(error**2 + floor)[:, None]).T)
            own = factor * np.sqrt(self.errors**2 + floor)
        radius = _FINAL_RADIUS * np.sqrt(own**2 + scatter**2 * leverage)
        return np.maximum(radius, _SMALLEST_RADIUS)

    # rivals

    def is_explained(self, match, i, j):
        """Whether most of some candidate pairs agree with a match to within a few radii."""
        gap = np.hypot(*(match.mapped[i] - self.stars.points[j]).T)
        return np.mean(gap <= 3 * match.radius[i]) > 0.5

    def prefer(self, one, other):
        """Choose the better of two matches; refuse if both are equally good and not the same."""
        _, a, b = np.intersect1d(one.pairs[0], other.pairs[0], return_indices=True)
        strengths = [m.evidence.significance**2 for m in (one, other)]
        better, worse = (one, other) if strengths[0] >= strengths[1] else (other, one)
        if len(a) and np.mean(one.pairs[1][a] == other.pairs[1][b]) > 0.5:
            return better
        if min(strengths) < _EQUAL * max(strengths):
            return better
        gap = np.median(np.hypot(*(one.mapped - other.mapped).T))
        raise MatchError(
            f"the match is ambiguous: {one.evidence.n_pairs} pairs "
            f"({one.evidence.significance:.1f} sigma) and {other.evidence.n_pairs} pairs "
            f"({other.evidence.significance:.1f} sigma) of two mappings that are {gap:.4g} px "
            "apart suit about equally well: the field or the catalogue repeats itself"
        )

    def without_rival(self, match, clock):
        """Make sure that no shift matches the same sources to other stars equally well."""
        for _ in range(_MOST_RIVALS):
            i, j = match.pairs
            offset = find_rival_offset(
                match.mapped[i],
                j,
                self.stars.tree,
                float(np.median(match.radius)),
                center=-match.turned_mapping.linear_part()[0],
                max_offset=self.limits.max_shift,
            )
            clock.lap("rivals")
            if offset is None:
                return match
            mapped = match.mapped + offset
            pairs, _ = _pair(mapped, match.radius, self.limit, self.stars)
            if len(pairs[0]) < MIN_STARS:
                return match
            rival = self.finish(match.turn, pairs, clock)
            if rival is None or self.header_error(rival) is not None:
                return match
            better = self.prefer(match, rival)
            if better is match:
                return match
            match = better
        raise MatchError(
            f"the match is ambiguous: {_MOST_RIVALS} times over another shift suited the sources "
            "better: the field or the catalogue repeats itself"
        )

    # refusals

    def header_error(self, match):
        """Build the error that names what is further from the header than allowed, or None.

        Rotation and scale are those at the center of the frame, or those of the pairs as a whole
        where these are closer to the header: with few pairs in a part of the frame only, the
        mapping means nothing at the center.
        """
        shift, at_center = match.turned_mapping.linear_part()
        rows = match.pairs[0]
        place, mapped = self.turned(match.turn)[rows], match.mapped[rows]
        of_pairs = np.linalg.lstsq(place - place.mean(axis=0), mapped - mapped.mean(axis=0), None)[
            0
        ].T
        area = float(np.linalg.det(of_pairs))
        if not 1 / _MOST_STRETCH < area < _MOST_STRETCH:
            # on a narrow frame a mirror is within reach of the other limits
            return MatchError(
                f"the starting WCS is mirrored or stretched: the pairs change the area of the "
                f"frame by a factor of {area:.3g}; {_HINT}"
            )
        turned, scaled = zip(
            *(turn_and_scale(matrix, self.shape) for matrix in (at_center, of_pairs)), strict=True
        )
        limits = self.limits
        for what, value, most, unit in (
            ("pointing", float(np.hypot(*shift)), limits.max_shift, "px"),
            ("rotation", min(np.abs(turned)), limits.max_rotation, "deg"),
            ("scale", 100 * min(np.abs(np.subtract(scaled, 1))), 100 * limits.max_scale, "%"),
        ):
            if value > most:
                return MatchError(
                    f"the {what} of the starting WCS is off by {value:.4g} {unit}, "
                    f"{most:.4g} {unit} are allowed; {_HINT}"
                )
        return None

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


def first_pairs(sources, reference, hypotheses, n_neighbours):
    """Yield sets of pairs to start from, the most promising first."""
    pairs = _neighbour_pairs(sources, reference, hypotheses, n_neighbours)
    yield pairs
    if len(hypotheses) > 1:
        agreeing = _agreeing_pairs(sources.points, reference.points, pairs)
        if agreeing is not None:
            yield agreeing
    if len(hypotheses) > 1 or n_neighbours > N_NEIGHBOURS:
        alone = _neighbour_pairs(sources, reference, hypotheses.take(slice(0, 1)), n_neighbours)
        yield alone
        if n_neighbours > N_NEIGHBOURS:
            # most neighbours are not in the other list: chance has many of them
            agreeing = _agreeing_pairs(sources.points, reference.points, alone)
            if agreeing is not None:
                yield agreeing


def _agreeing_pairs(sources, reference, pairs):
    """Pairs that follow one linear mapping best, by the least quantile of the residuals.

    Finds the right pairs where they are a minority, which least squares with clipping does not.
    """
    i, j = pairs
    if len(i) < 6:
        return None
    rng = np.random.default_rng(len(i))
    triples = rng.integers(len(i), size=(_N_TRIPLES, 3))
    at, to = sources[i], reference[j]
    design = np.dstack([np.ones((_N_TRIPLES, 3)), at[triples]])
    size = np.abs(np.linalg.det(design))
    # three stars in a row determine nothing
    triples, design = triples[size > np.median(size)], design[size > np.median(size)]
    linear = np.linalg.solve(design, to[triples])
    left = np.column_stack([np.ones(len(i)), at]) @ linear - to
    left = np.hypot(left[..., 0], left[..., 1])
    quantile = np.quantile(left, _AGREEING_SHARE, axis=1)
    best = left[np.argmin(quantile)]
    keep = best <= 2.0 * quantile.min()
    return i[keep], j[keep]


def _neighbour_pairs(sources, reference, hypotheses, n_neighbours):
    """First pairs: the stars of a group of hypotheses and neighbours that coincide."""
    log_d, angle, neighbour = neighbour_pattern(sources.tree, hypotheses.source, n_neighbours)
    distance = np.exp(log_d + hypotheses.log_scale[:, None])
    angle = angle + hypotheses.rotation[:, None]
    place = reference.points[hypotheses.reference][:, None, :] + np.stack(
        [distance * np.cos(angle), distance * np.sin(angle)], axis=-1
    )
    gap, found = find_nearest(reference.tree, place.reshape(-1, 2), 1)
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


def _sample(n, extra=()):
    """Rows of a list that are enough for a fit, in order, with some that must be among them."""
    step = max(1, -(-n // _FIT_SAMPLE))
    rows = np.arange(0, n, step)
    return np.union1d(rows, extra).astype(int) if step > 1 and len(extra) else rows


def _pair(mapped, radius, limit, reference):
    """Unambiguous pairs while the mapping grows, and the radii that were used."""
    radius = np.maximum(radius, _SMALLEST_RADIUS)
    radius = np.where(radius > _SLACK * limit, 0.0, np.minimum(radius, limit))
    i, j, _ = find_edges(mapped, reference.tree, radius, limit=reference.limit, slack=_SLACK)
    keep, _ = one_to_one(i, j, len(mapped), len(reference.points))
    return (i[keep], j[keep]), radius


def _count_net(grown, reference):
    """Pairs less those that chance gives at the radii used."""
    _, (i, _), mapped, radius = grown
    near = find_nearest(reference.tree, mapped, 1)[1]
    return len(i) - _MAX_CROWDING * float(((radius / reference.limit[near]) ** 2).sum())


def _are_alike(pairs, others):
    """Whether two sets of pairs differ by next to nothing: a few stars may come and go for ever."""
    a, b = (i * (1 << 32) + j for i, j in (pairs, others))
    return 2 * len(np.intersect1d(a, b, assume_unique=True)) >= 0.999 * (len(a) + len(b))


def _key(pairs):
    return hash((pairs[0].tobytes(), pairs[1].tobytes()))


def _predict(sources, fit, local):
    """Map positions; also the variance of that in units of the variance of one pair."""
    mapped = np.column_stack(fit.mapping(*sources.T))
    leverage = fit.leverage(*sources.T)
    if local is None:
        return mapped, leverage
    correction, local_leverage = local(sources)
    return mapped + correction, leverage + local_leverage


def _crowding_limit(points, tree):
    """Radius within which `_MAX_CROWDING` stars are expected, by the sixth neighbour."""
    k = min(6, tree.n - 1)
    if k < 1:
        return np.full(tree.n, np.inf)
    distance = find_nearest(tree, points, [k + 1])[0][:, 0]
    return distance * np.sqrt(_MAX_CROWDING / k)
