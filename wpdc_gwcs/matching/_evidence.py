"""Evidence that a match is real: the pairs against chance, in the frame and in its parts."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import gammaln, pdtr

from wpdc_gwcs.matching._mapping import count_terms
from wpdc_gwcs.matching._pairs import find_edges, one_to_one

__all__ = ["AreaEvidence", "Evidence", "collect_evidence", "poisson_significance"]

# Sources looked at for the chance level, and shifts tried.
_SAMPLE = 10_000
_N_SHIFTS = 10
# Pairs that a circle should hold, and those it must lead one to expect before it is judged.
_PER_AREA = 16.0
_JUDGED = 8.0
_MOST_AREAS = 16
# Stars counted in circles: more would not sharpen the verdict.
_COUNTED = 60_000


@dataclass(frozen=True)
class AreaEvidence:
    """Evidence in one part of the frame: a circle about a position; circles overlap.

    Parameters
    ----------
    x, y, radius : float
        The circle, px.
    n_sources, n_reference, n_pairs : int
        Stars of either list in it, and pairs.
    expected : float
        Pairs expected from the stars of both lists, if the area were like the better parts of the
        frame.
    expected_by_chance : float
        Pairs that chance gives.
    judged : bool
        Whether there are enough stars to say anything.
    accepted : bool
        Whether the pairs exceed chance and are not far fewer than expected; true where not judged.
    """

    x: float
    y: float
    radius: float
    n_sources: int
    n_reference: int
    n_pairs: int
    expected: float
    expected_by_chance: float
    judged: bool
    accepted: bool


@dataclass(frozen=True)
class Evidence:
    """Numbers on which a match is accepted or refused."""

    n_pairs: int
    n_sources: int
    n_reference: int
    expected_by_chance: float
    purity: float
    completeness: float
    significance: float
    areas: tuple

    def missing(self, *, min_significance, min_purity):
        """Say what is missing for the match to be accepted; an empty string if nothing is."""
        if self.significance < min_significance:
            return (
                f"{self.n_pairs} pairs with {self.expected_by_chance:.3g} expected by chance "
                f"have a significance of {self.significance:.1f} sigma, "
                f"{min_significance:g} are needed"
            )
        if self.purity < min_purity:
            return (
                f"of {self.n_pairs} pairs {self.expected_by_chance:.3g} are expected by chance: "
                f"a purity of {self.purity:.3f}, {min_purity:g} is needed"
            )
        bad = [a for a in self.areas if not a.accepted]
        if bad:
            worst = max(bad, key=lambda a: a.expected - a.n_pairs)
            return (
                f"{len(bad)} of {sum(a.judged for a in self.areas)} parts of the frame lack pairs; "
                f"worst is {worst.radius:.0f} px about ({worst.x:.0f}, {worst.y:.0f}): "
                f"{worst.n_pairs} pairs, {worst.expected:.0f} expected, "
                f"{worst.expected_by_chance:.2g} by chance"
            )
        return ""


def poisson_significance(count, expected):
    """Express the chance to see at least `count` where `expected` are expected as sigmas.

    Notes
    -----
    Uses sqrt(-2 ln P), with P bounded by the leading terms of the Poisson tail, which holds where
    P underflows.
    """
    if count <= expected:
        return 0.0
    log_p = (
        count * np.log(expected) - expected - gammaln(count + 1) - np.log1p(-expected / (count + 1))
    )
    return float(np.sqrt(max(0.0, -2 * log_p)))


def collect_evidence(detector, mapped, radius, stars, mapping, pairs, image_shape, *, slack=1.0):
    """Measure what a set of pairs is worth.

    Parameters
    ----------
    detector, mapped : (N, 2) ndarray
        Starting and mapped positions of the sources, px.
    radius : (N,) ndarray
        Pairing radius of each source, px.
    stars : Stars
        The reference stars.
    mapping : SmoothMap
        The mapping, which also costs degrees of freedom.
    pairs : (i_src, i_ref)
        The pairs.
    image_shape : (int, int)
        Shape of the frame.
    slack : float
        As it was used to find the pairs, see `find_edges`.

    Returns
    -------
    Evidence

    Notes
    -----
    The chance level is counted, not modelled: the mapped sources are shifted against the reference
    by vectors
    far longer than the radius (but short against the scale on which the density changes) and
    paired again.
    Each term of the mapping can bring one pair into line, so the significance counts the pairs
    less the terms.
    """
    ny, nx = image_shape
    i_src, i_ref = pairs
    n_pairs = len(i_src)
    usable = np.flatnonzero(radius > 0)
    step = max(1, -(-len(usable) // _SAMPLE))
    sample = usable[::step]
    by_chance, hits = _count_by_chance(mapped[sample], radius[sample], stars, slack)
    by_chance *= len(usable) / max(1, len(sample))
    hit_weight = len(usable) / max(1, len(sample)) / _N_SHIFTS
    back_x, back_y = mapping.inverse(*stars.points.T)
    inside = (back_x > -0.5) & (back_x < nx - 0.5) & (back_y > -0.5) & (back_y < ny - 0.5)
    n_reference = int(np.count_nonzero(inside))
    n_sources = len(detector)
    # half a pair in all shifts together where none was seen
    floor = 0.5 * hit_weight
    terms = count_terms(mapping.order)
    unpaired = max(0.0, 1 - n_pairs / max(1, n_sources))
    purity = 1 - min(1.0, by_chance * unpaired / n_pairs) if n_pairs else 0.0
    areas = ()
    if n_pairs:
        areas = _judge_areas(
            detector,
            np.column_stack([back_x, back_y])[inside],
            detector[i_src],
            detector[sample[hits]],
            hit_weight,
            image_shape,
        )
    return Evidence(
        n_pairs=n_pairs,
        n_sources=n_sources,
        n_reference=n_reference,
        expected_by_chance=float(by_chance),
        purity=float(purity),
        completeness=float(n_pairs / max(1, min(n_sources, n_reference))),
        significance=poisson_significance(max(0, n_pairs - terms), max(by_chance, floor)),
        areas=tuple(areas),
    )


def _count_by_chance(mapped, radius, stars, slack):
    """Mean number of pairs at shifted positions, and the sources in them, all shifts."""
    if len(mapped) == 0:
        return 0.0, np.empty(0, int)
    base = max(15.0, 6 * float(np.median(radius)))
    hits = []
    for k in range(_N_SHIFTS):
        # golden-angle spiral: directions and lengths without a common period
        length = base * (1 + 2 * (k + 0.5) / _N_SHIFTS)
        shift = length * np.array([np.cos(2.39996 * k), np.sin(2.39996 * k)])
        i, j, _ = find_edges(mapped + shift, stars.tree, radius, limit=stars.limit, slack=slack)
        keep, _ = one_to_one(i, j, len(mapped), len(stars.points))
        hits.append(i[keep])
    hits = np.concatenate(hits)
    return len(hits) / _N_SHIFTS, hits


def _judge_areas(sources, reference, pairs, chance, weight, image_shape):
    """Evidence in circles about the nodes of a grid over the frame, wide enough to hold pairs."""
    ny, nx = image_shape
    step = max(1, len(sources) // _COUNTED)
    lists = [p[::step] for p in (sources, reference, pairs)]
    side = int(np.clip(np.sqrt(len(lists[2]) / _PER_AREA), 3, _MOST_AREAS))
    grid = np.meshgrid(np.linspace(0, nx - 1, side), np.linspace(0, ny - 1, side))
    nodes = np.column_stack([g.ravel() for g in grid])
    trees = [cKDTree(p) for p in lists]
    k = int(np.ceil(_PER_AREA * len(lists[0]) / max(1, len(lists[2]))))
    radius = trees[0].query(nodes, k=[min(k, trees[0].n)])[0][:, 0]
    radius = np.maximum(radius, 0.6 * max(nx, ny) / (side - 1))
    n_sources, n_reference, n_pairs = (
        tree.query_ball_point(nodes, radius, return_length=True) for tree in trees
    )
    by_chance = np.zeros(len(nodes))
    if len(chance):
        by_chance = cKDTree(chance).query_ball_point(nodes, radius, return_length=True)
        by_chance = by_chance * weight / step
    # the better parts of the frame say what to expect: an average would be pulled down by the bad
    shares = [
        np.quantile(n_pairs[n > 0] / n[n > 0], 0.75) if n.any() else 0.0
        for n in (n_sources, n_reference)
    ]
    expected = np.minimum(shares[0] * n_sources, shares[1] * n_reference)
    judged = expected >= _JUDGED
    # p < 1e-3 either way: more than chance, and not far fewer than expected beyond scatter
    floor = max(0.5 * weight / step, 1e-3)
    exceeds = [
        poisson_significance(n, max(c, floor)) > 3.7
        for n, c in zip(n_pairs, by_chance, strict=True)
    ]
    enough = (pdtr(n_pairs, 0.8 * expected) > 1e-3) | (n_pairs > 0.4 * expected)
    accepted = ~judged | (np.array(exceeds) & enough)
    return [
        AreaEvidence(
            x=float(nodes[i, 0]),
            y=float(nodes[i, 1]),
            radius=float(radius[i]),
            n_sources=int(n_sources[i]) * step,
            n_reference=int(n_reference[i]) * step,
            n_pairs=int(n_pairs[i]) * step,
            expected=float(expected[i]) * step,
            expected_by_chance=float(by_chance[i]) * step,
            judged=bool(judged[i]),
            accepted=bool(accepted[i]),
        )
        for i in range(len(nodes))
    ]
