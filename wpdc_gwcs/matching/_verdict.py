"""The verdict: final pairs, their evidence, rivals, and refusals."""

from dataclasses import dataclass, replace

import numpy as np

from wpdc_gwcs.counts import counted
from wpdc_gwcs.exceptions import MatchError
from wpdc_gwcs.matching._evidence import Evidence, collect_evidence, judge_few
from wpdc_gwcs.matching._growth import (
    SLACK,
    final_radius,
    fit_pairs,
    grow,
    grow_locally,
    growing_radius,
    pair,
    predict,
    sample_rows,
)
from wpdc_gwcs.matching._mapping import SmoothMap, turn_and_scale
from wpdc_gwcs.matching._orientations import N_ORIENTATIONS
from wpdc_gwcs.matching._pairs import find_edges, one_to_one
from wpdc_gwcs.matching._problem import BLIND_SCALE, MIN_STARS, Problem
from wpdc_gwcs.matching._rivals import find_rival_offset

__all__ = [
    "Attempts",
    "Match",
    "carry_to_frame",
    "header_error",
    "is_explained",
    "judge_pairs",
    "prefer",
    "refusal",
    "without_rival",
]

# If either list has no more stars than this on the frame, `judge_few` is used as well; with more,
# correct matches have enough pairs to count the chance level.
_FEW = 100
# Significance and purity below which the pairs of a subset are not carried to the whole frame, to
# save time with hopeless starts.
_HOPELESS_SIGNIFICANCE, _HOPELESS_PURITY = 4.0, 0.5
# Of two matches, the one with less than this fraction of the evidence (in -2 ln P) of the other is
# worse; and the greatest number of times that a better one is searched for.
_EQUAL = 0.7
_MOST_RIVALS = 4
# Pairs agree with a match within this many radii; "most" means more than this fraction.
_EXPLAINED, _MOST = 3.0, 0.5
# A header with such a wrong area of a pixel cannot be correct up to a rotation: it is a mirror.
_MOST_STRETCH = 2.0

_HINT = "blind=True (--blind) also searches mirrored and turned frames, other scales and pointings"


@dataclass(frozen=True, eq=False)
class Match:
    """Result of a search: the mapping, the pairs and their evidence.

    The problem has the reference stars as they were turned; the mapping leads to these.
    """

    problem: Problem
    turned_mapping: SmoothMap
    mapped: np.ndarray
    radius: np.ndarray
    pairs: tuple
    n_ambiguous: int
    scatter: float
    evidence: Evidence

    @property
    def mapping(self):
        """The mapping to the reference stars in their original orientation."""
        return self.turned_mapping.turned_back(self.problem.turn)

    @property
    def parity(self):
        """-1 if the frame is mirrored, else 1."""
        return int(np.sign(np.linalg.det(self.problem.turn)))


@dataclass(frozen=True, eq=False)
class Attempts:
    """Unsuccessful attempts so far."""

    best: Evidence | None = None
    # Starts that match except in a part of the frame.
    n_partial: int = 0

    def after(self, evidence, *, partial=False):
        """Return what has been tried once this evidence was not enough."""
        best = self.best
        if best is None or evidence.significance > best.significance:
            best = evidence
        return Attempts(best, self.n_partial + bool(partial))


def carry_to_frame(seed, pairs, attempts, clock):
    """Grow first pairs of a seed's lists; rows of the pairs in the whole lists, or `None`."""
    problem = seed.problem
    sources, reference = seed.sources, seed.reference
    part = sample_rows(len(sources.points), pairs[0])
    pairs = np.searchsorted(part, pairs[0]), pairs[1]
    points = sources.points[part]
    grown = grow(problem, points, sources.limit[part], reference, pairs)
    clock.lap("grow")
    if grown is None:
        return None, attempts
    fit, pairs, mapped, radius = grown
    evidence = collect_evidence(
        points, mapped, radius, reference, fit.mapping, pairs, problem.shape, slack=SLACK
    )
    clock.lap("evidence")
    if evidence.significance < _HOPELESS_SIGNIFICANCE or evidence.purity < _HOPELESS_PURITY:
        return None, attempts.after(evidence)
    return seed.rows((part[pairs[0]], pairs[1])), attempts


def judge_pairs(problem, pairs, attempts, clock):
    """Grow over all stars, pair with the final radius, judge: a `Match`, or `None`."""
    points = problem.sources
    fit = fit_pairs(problem, points[pairs[0]], problem.stars.points[pairs[1]])
    if fit is None:
        return None, attempts
    part = sample_rows(len(points))
    some, limit = points[part], problem.limit[part]
    mapped, leverage = predict(some, fit, None)
    pairs, _ = pair(mapped, growing_radius(fit, leverage), limit, problem.stars)
    grown = grow(problem, some, limit, problem.stars, pairs)
    if grown is None:
        clock.lap("refine")
        return None, attempts
    fit, local, pairs, scatter = grow_locally(problem, some, limit, *grown[:2])
    clock.lap("refine")
    if len(pairs[0]) < MIN_STARS:
        return None, attempts
    mapped, leverage = predict(points, fit, local)
    radius = final_radius(problem, mapped, (part[pairs[0]], pairs[1]), scatter, leverage)
    i, j, _ = find_edges(mapped, problem.stars.tree, radius, limit=problem.stars.limit)
    keep, n_ambiguous = one_to_one(i, j, len(points), len(problem.stars.points))
    pairs = i[keep], j[keep]
    clock.lap("pair")
    evidence = collect_evidence(
        points, mapped, radius, problem.stars, fit.mapping, pairs, problem.shape
    )
    if min(evidence.n_sources, evidence.n_reference) <= _FEW:
        judged = _judge_few(problem, points, mapped, radius, leverage, fit.n_terms, pairs)
        evidence = replace(evidence, search_significance=judged)
    clock.lap("evidence")
    options = problem.options
    if evidence.missing(options):
        # Correct except in a part of the frame: other starts rarely help.
        partial = evidence.is_significant(options.min_significance)
        return None, attempts.after(evidence, partial=partial)
    match = Match(problem, fit.mapping, mapped, radius, pairs, n_ambiguous, scatter, evidence)
    return match, attempts


def _judge_few(problem, points, mapped, radius, leverage, terms, pairs):
    limits = problem.limits
    reach = limits.reach(limits.half_diagonal)
    blind = problem.options.blind
    known = problem.flux is not None and problem.brightness is not None
    return judge_few(
        points,
        mapped,
        radius,
        leverage,
        problem.stars,
        terms,
        pairs,
        problem.shape,
        reaches=(reach, reach - limits.max_shift, limits.max_distortion),
        orientations=N_ORIENTATIONS if blind else 1,
        brightness=(problem.flux, problem.brightness) if known else None,
    )


def is_explained(match, i, j):
    """Return whether most of some candidate pairs agree with a match to within a few radii."""
    gap = np.hypot(*(match.mapped[i] - match.problem.stars.points[j]).T)
    return np.mean(gap <= _EXPLAINED * match.radius[i]) > _MOST


def prefer(one, other):
    """Choose the better of two matches; refuse if both are equally good and not the same."""
    _, a, b = np.intersect1d(one.pairs[0], other.pairs[0], return_indices=True)
    strengths = [m.evidence.significance**2 for m in (one, other)]
    better, worse = (one, other) if strengths[0] >= strengths[1] else (other, one)
    if len(a) and np.mean(one.pairs[1][a] == other.pairs[1][b]) > _MOST:
        return better
    if min(strengths) < _EQUAL * max(strengths):
        return better
    places = (m.problem.turned_back(m.mapped) for m in (one, other))
    gap = np.median(np.hypot(*np.subtract(*places).T))
    raise MatchError(
        f"the match is ambiguous: {counted(one.evidence.n_pairs, 'pair')} "
        f"({one.evidence.significance:.1f} sigma) and {counted(other.evidence.n_pairs, 'pair')} "
        f"({other.evidence.significance:.1f} sigma) of two mappings that are {gap:.4g} px "
        "apart fit about equally well: the field or the catalog repeats itself"
    )


def without_rival(match, clock):
    """Make sure that no shift matches the same sources to other stars equally well."""
    problem = match.problem
    for _ in range(_MOST_RIVALS):
        i, j = match.pairs
        offset = find_rival_offset(
            match.mapped[i],
            j,
            problem.stars.tree,
            float(np.median(match.radius)),
            center=-match.turned_mapping.linear_part()[0],
            max_offset=problem.limits.max_shift,
        )
        clock.lap("rivals")
        if offset is None:
            return match
        pairs, _ = pair(match.mapped + offset, match.radius, problem.limit, problem.stars)
        if len(pairs[0]) < MIN_STARS:
            return match
        rival, _ = judge_pairs(problem, pairs, Attempts(), clock)
        if rival is None or header_error(rival) is not None:
            return match
        better = prefer(match, rival)
        if better is match:
            return match
        match = better
    raise MatchError(
        f"the match is ambiguous: {_MOST_RIVALS} times in a row, another shift fitted the sources "
        "better: the field or the catalog repeats itself"
    )


def header_error(match):
    """Build the error for a match that is farther from the header than allowed, or None.

    Rotation and scale are those at the center of the frame, or those of the pairs as a whole
    where these are closer to the header: with few pairs in a part of the frame only, the
    mapping means nothing at the center.
    """
    problem, limits = match.problem, match.problem.limits
    shift, at_center = match.turned_mapping.linear_part()
    rows = match.pairs[0]
    of_pairs = _fit_matrix(problem.sources[rows], match.mapped[rows])
    area = float(np.linalg.det(of_pairs))
    if not 1 / _MOST_STRETCH < area < _MOST_STRETCH:
        # On a narrow frame, a mirrored mapping may be within the other limits.
        return MatchError(
            f"the starting WCS is mirrored or stretched: the pairs change the area of the "
            f"frame by a factor of {area:.3g}{_hint(problem)}",
            # A mirrored mapping has no rotation and no scale.
            found=_describe(match) if area > 0 else None,
        )
    turned, scaled = zip(
        *(turn_and_scale(matrix, problem.shape) for matrix in (at_center, of_pairs)), strict=True
    )
    for what, value, most, unit in (
        ("pointing", float(np.hypot(*shift)), limits.max_shift, "px"),
        ("rotation", min(np.abs(turned)), _most_rotation(match), "deg"),
        ("scale", 100 * min(np.abs(np.subtract(scaled, 1))), 100 * limits.max_scale, "%"),
    ):
        if value > most:
            hint = _hint(problem)
            if what == "scale" and value > 100 * BLIND_SCALE:
                hint = f"; the pairs have {scaled[1]:.4g} times its scale"
            return MatchError(
                f"the {what} of the starting WCS is off by {value:.4g} {unit}, "
                f"at most {most:.4g} {unit} is allowed{hint}",
                found=_describe(match),
            )
    return None


def _most_rotation(match):
    """Largest rotation from the orientation that was tried, deg."""
    options = match.problem.options
    if options.blind and match.evidence.significance >= options.min_significance:
        # Any rotation.  With few stars, not all mappings in between have been counted.
        return 180.0
    return match.problem.limits.max_rotation


def _fit_matrix(points, mapped):
    """Fit the matrix of an affine mapping by least squares."""
    centered = points - points.mean(axis=0), mapped - mapped.mean(axis=0)
    return np.linalg.lstsq(*centered, None)[0].T


def _describe(match):
    """Describe by how much the header is off, for an error."""
    problem, rows = match.problem, match.pairs[0]
    matrix = _fit_matrix(problem.sources[rows], problem.turned_back(match.mapped[rows]))
    if match.parity < 0:
        matrix = matrix @ np.diag([-1, 1])
    rotation, scale = turn_and_scale(matrix, problem.shape)
    return {
        "n_pairs": len(rows),
        "shift": tuple(map(float, match.mapping.linear_part()[0])),
        "rotation": rotation,
        "scale": scale,
        "parity": match.parity,
    }


def _hint(problem):
    """Suggest a wider search where that has not been tried."""
    return "" if problem.options.blind else f"; {_HINT}"


def refusal(problem, attempts, *, hint=True):
    """Build the error that says what was missing."""
    n_sources, n_reference = len(problem.sources), len(problem.stars.points)
    if attempts.best is None:
        reason = "no group of sources has the pattern of any group of reference stars"
    else:
        reason = (
            attempts.best.missing(problem.options)
            or "the pairs found in one part do not carry over to the whole frame"
        )
    return MatchError(
        f"no match with sufficient evidence ({counted(n_sources, 'source')}, "
        f"{counted(n_reference, 'reference star')} in reach): {reason}"
        + (_hint(problem) if hint else "")
    )
