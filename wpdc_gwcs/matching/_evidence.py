"""Evidence that a match is real: the pairs against chance, in the frame and in its parts."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import gammaln, pdtr, pdtrc

from wpdc_gwcs.counts import counted
from wpdc_gwcs.detector import on_detector
from wpdc_gwcs.matching._mapping import count_terms
from wpdc_gwcs.matching._pairs import find_edges, one_to_one

__all__ = [
    "AreaEvidence",
    "Evidence",
    "collect_evidence",
    "judge_few",
    "log_chance_of_order",
    "poisson_significance",
]

# Maximum number of sources for the chance level, and number of shifts.
_SAMPLE = 10_000
_N_SHIFTS = 10
# Pairs that a circle should contain, and minimum number expected for it to be judged.
_PER_AREA = 16.0
_JUDGED = 8.0
_MOST_AREAS = 16
# Probability that a correct match is refused because of the counts in any part: some of many parts
# have few pairs.  Parts are compared with the first fraction of the pairs that the better parts
# suggest, and are always good with the second one.
_PARTS_CHANCE = 0.01
_PROMISED, _PLENTY = 0.8, 0.4
# Minimum number of pairs by chance in a part, even if none was seen.
_LEAST_BY_CHANCE = 1e-3
# Maximum number of stars counted in circles: more would not improve the verdict.
_COUNTED = 60_000
# Share of the significance that is needed where all that the search could choose from is counted:
# 9 sigma (3e-18) leave twelve orders of magnitude for the hypotheses of a search, 5.2 sigma (1e-6)
# are what is left.  As all ways are counted as if each led to another match it is an upper limit:
# of 1500 random fields, in clusters and in rows too, none reached more than 0 sigma.
_SEARCH_SHARE = 0.58
# Number of orientations of the axes that a blind search tries.
_ORIENTATIONS = 8
# Leave-one-out residuals of pairs on which the mapping hangs are not looked at more closely, nor
# shares of the radius at which positions are not independent.
_MOST_LEVERAGE = 0.99
_LEAST_SHARE = 1e-3
# Parts of the sources, those with the smallest radii, of which the one that says most is taken.
_WIDEST = (0.5, 0.7, 0.85, 1.0)
# The distance to this neighbor gives the local density of reference stars.
_DENSITY_NEIGHBOR = 6
# Minimum number of reference stars within reach of a source, even if none was found.
_LEAST_REACHED = 0.5
# Minimum number of pairs for a test of the order of brightness, and maximum number used.
_ORDER_PAIRS = (5, 100)


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
        Pairs expected by chance.
    judged : bool
        Whether there are enough stars for a judgment.
    accepted : bool
        Whether the pairs exceed chance and are not far fewer than expected; true where not judged.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.matching import match_planes
    >>> x, y = np.random.default_rng(1).uniform(0, 1000, (2, 400))
    >>> i, j, found = match_planes(x, y, x + 15, y - 8, image_shape=(1000, 1000))
    >>> area = found.areas[0]
    >>> (area.x, area.y), area.n_pairs == area.n_sources, area.expected_by_chance < 1
    ((0.0, 0.0), True, True)
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
    """Numbers by which a match is accepted or refused.

    `search_significance` is that of `judge_few`, NaN for many stars.
    """

    n_pairs: int
    n_sources: int
    n_reference: int
    expected_by_chance: float
    purity: float
    completeness: float
    significance: float
    areas: tuple
    search_significance: float = np.nan

    def is_significant(self, min_significance):
        """Whether the pairs exceed chance, by counts or by the number of possible mappings."""
        return (
            self.significance >= min_significance
            or self.search_significance >= _SEARCH_SHARE * min_significance
        )

    def missing(self, options):
        """Say what is missing for the match to be accepted; an empty string if nothing is."""
        min_significance, min_purity = options.min_significance, options.min_purity
        if not self.is_significant(min_significance):
            searched = ""
            if np.isfinite(self.search_significance):
                searched = (
                    f" (or {_SEARCH_SHARE * min_significance:.1f} with all mappings of so few "
                    f"stars counted: {self.search_significance:.1f})"
                )
            return (
                f"{counted(self.n_pairs, 'pair')}, with {self.expected_by_chance:.3g} expected by "
                f"chance: a significance of {self.significance:.1f} sigma; "
                f"{min_significance:g} is needed{searched}"
            )
        if self.purity < min_purity:
            return (
                f"{counted(self.n_pairs, 'pair')}, with {self.expected_by_chance:.3g} expected by "
                f"chance: a purity of {self.purity:.3f}; {min_purity:g} is needed"
            )
        bad = [a for a in self.areas if not a.accepted]
        if bad:
            worst = max(bad, key=lambda a: a.expected - a.n_pairs)
            return (
                f"{len(bad)} of {sum(a.judged for a in self.areas)} parts of the frame lack pairs; "
                f"the worst lies within {worst.radius:.0f} px of ({worst.x:.0f}, {worst.y:.0f}): "
                f"{counted(worst.n_pairs, 'pair')}, {worst.expected:.0f} expected, "
                f"{worst.expected_by_chance:.2g} by chance"
            )
        return ""


def poisson_significance(count, expected):
    """Return the probability of at least `count` events with mean `expected`, in sigmas.

    Notes
    -----
    Uses sqrt(-2 ln P), with P bounded by the leading terms of the Poisson tail, which holds where
    P underflows.
    """
    if count <= expected:
        return 0.0
    return float(np.sqrt(max(0.0, -2 * _log_poisson_tail(count, expected))))


def _log_poisson_tail(count, expected):
    """Upper bound of ln P(at least `count`), for counts above the mean."""
    return (
        count * np.log(expected) - expected - gammaln(count + 1) - np.log1p(-expected / (count + 1))
    )


def judge_few(
    points, mapped, radius, leverage, stars, terms, pairs, shape, *, reaches, brightness=None
):
    r"""Return the significance of a short list against all mappings that could be found.

    With a few stars the chance level cannot be counted: at no shift there is a pair, and whether
    one in ten shifts or in a thousand is to be expected makes all the difference.  Here it follows
    from the density of reference stars, and what the search could choose from is counted instead.

    Parameters
    ----------
    points, mapped : (N, 2) ndarray
        Starting and mapped positions of the sources, px.
    radius : (N,) ndarray
        Pairing radius of each source, px.
    leverage : (N,) ndarray
        Variance of the mapping in units of the variance of one pair.
    stars : Stars
        The reference stars.
    terms : int
        Terms of the mapping per axis.
    pairs : (i_src, i_ref)
        The pairs.
    shape : (int, int)
        Shape of the frame.
    reaches : (float, float, float)
        Largest displacement that is searched: of a source, of a source against another one, and
        what is left of it without the linear part, px.
    brightness : (ndarray, ndarray), optional
        Brightness of the sources and of the reference stars, in any units that rise with it.

    Returns
    -------
    float
        As `poisson_significance`.

    Notes
    -----
    A mapping of T terms per axis can be laid through any T pairs, and what other pairs it makes is
    evidence.  Of N sources there are :math:`\binom N T` sets, and each source of a set may be one
    of the :math:`m_k` stars in its reach.  So the expected number of mappings that have n pairs by
    chance is at most

    .. math::
        \binom N T \prod_{k=1}^T m_k \; P(\ge n - T \mid \lambda)

    where the fourth and later stars of a set can be no further from where the first three put them
    than the distortion reaches.  P is taken at the share of the pairing radii that says most, from
    residuals of pairs predicted by the others, and for the part of the sources up to the radius
    that says most; both choices are counted too.  Wrong pairs are in no order of brightness: the
    chance of the order that they have (Kendall) is independent of P, and the product q of the two
    is worth :math:`q (1 - \ln q)` (Fisher).
    """
    i, j = pairs
    log_chance = _log_chance_of_places(points, mapped, radius, leverage, stars, terms, pairs, shape)
    if log_chance == 0:
        return 0.0
    if brightness is not None:
        log_chance += log_chance_of_order(brightness[0][i], brightness[1][j])
        log_chance += np.log1p(-log_chance)
    log_chance += _log_choices(points, mapped, stars, terms, pairs, reaches)
    return float(np.sqrt(max(0.0, -2 * log_chance)))


def _log_chance_of_places(points, mapped, radius, leverage, stars, terms, pairs, shape):
    """Logarithm of the chance of the pairs of one mapping, of which some determine it."""
    i, j = pairs
    is_paired = np.zeros(len(points), bool)
    is_paired[i] = True
    expected = _expected_within(mapped, radius, is_paired, stars, shape)
    residual = np.hypot(*(mapped[i] - stars.points[j]).T)
    share = residual / (1 - np.minimum(leverage[i], _MOST_LEVERAGE)) / radius[i]
    log_chance = 0.0
    # where the mapping is ill known radii are so wide that they say nothing, and hide the rest
    for widest in np.quantile(radius, _WIDEST):
        # the k-th is the share of the radii within which there are k pairs, at most all
        shares = np.minimum(np.sort(share[radius[i] <= widest]), 1.0)[terms:]
        count = np.arange(1, len(shares) + 1)
        level = expected[radius <= widest].sum() * np.maximum(shares, _LEAST_SHARE) ** 2
        rare = count > level
        tail = _log_poisson_tail(count[rare], level[rare])
        log_chance = min(log_chance, np.min(tail, initial=0.0))
    return float(log_chance)


def _log_choices(points, mapped, stars, terms, pairs, reaches):
    """Logarithm of the number of mappings that the pairs were chosen from."""
    i, j = pairs
    n, n_sources = len(i), len(points)
    is_paired = np.zeros(n_sources, bool)
    is_paired[i] = True
    moved = stars.points[j] - points[i]
    against = moved - moved.mean(axis=0)
    place = points[i] - points[i].mean(axis=0)
    bent = against - place @ np.linalg.lstsq(place, against, rcond=None)[0]
    # a mapping that reaches further than the limits could have been laid through more pairs
    sizes = [
        max(reach, float(np.hypot(*offset.T).max()))
        for reach, offset in zip(reaches, (moved, against, bent), strict=True)
    ]
    choices = np.log(n * len(_WIDEST) * _ORIENTATIONS)
    choices += gammaln(n_sources + 1) - gammaln(terms + 1) - gammaln(n_sources - terms + 1)
    for size, times in zip(sizes, (1, 2, terms - 3), strict=True):
        within = stars.tree.query_ball_point(mapped, size, return_length=True) - is_paired
        choices += times * np.log(max(float(within.mean()), _LEAST_REACHED))
    return float(choices)


def _expected_within(mapped, radius, is_paired, stars, shape):
    """Say how many reference stars chance puts within the radius of each source.

    From the distance to one of the nearest stars, in pixels and in units of the sides of the
    frame: on a narrow frame a circle that holds enough stars is mostly outside of it.
    """
    k = min(_DENSITY_NEIGHBOR, stars.tree.n)
    sides = np.array(shape[::-1], float)
    sides /= np.sqrt(sides.prod())
    squares = [
        cKDTree(stars.points / units).query(mapped / units, k=[k])[0][:, 0] ** 2
        for units in (np.ones(2), sides)
    ]
    return (k - is_paired) * radius**2 / np.maximum(np.minimum(*squares), radius**2)


def log_chance_of_order(one, other):
    """Logarithm of the chance that two lists without relation are in as similar an order.

    From the number of inversions (Kendall's tau), exactly.
    """
    fewest, most = _ORDER_PAIRS
    known = np.isfinite(one) & np.isfinite(other)
    one, other = one[known][:most], other[known][:most]
    if len(one) < fewest:
        return 0.0
    n_inversions = np.count_nonzero(
        np.subtract.outer(one, one) * np.subtract.outer(other, other) < 0
    )
    # the k-th value may stand before 0 to k - 1 of the others, each equally likely
    chance = np.ones(1)
    for k in range(2, len(one) + 1):
        chance = np.convolve(chance, np.full(k, 1.0 / k))
    return float(np.log(max(chance[: n_inversions // 2 + 1].sum(), 1e-300)))


def collect_evidence(detector, mapped, radius, stars, mapping, pairs, image_shape, *, slack=1.0):
    """Collect the evidence for a set of pairs.

    Parameters
    ----------
    detector, mapped : (N, 2) ndarray
        Starting and mapped positions of the sources, px.
    radius : (N,) ndarray
        Pairing radius of each source, px.
    stars : Stars
        The reference stars.
    mapping : SmoothMap
        The mapping, which takes degrees of freedom.
    pairs : (i_src, i_ref)
        The pairs.
    image_shape : (int, int)
        Shape of the frame.
    slack : float
        As used to find the pairs, see `find_edges`.

    Returns
    -------
    Evidence

    Notes
    -----
    The chance level is counted, not modeled: the mapped sources are shifted against the reference
    by vectors far longer than the radius (but short against the scale on which the density changes)
    and paired again. Each term of the mapping can bring one pair into line, so the significance
    counts the pairs less the terms.
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
    inside = on_detector(back_x, back_y, image_shape)
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
    """Evidence in circles around grid nodes over the frame, large enough to contain pairs."""
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
    # expect what the better parts have: an average would include the bad ones
    shares = [
        np.quantile(n_pairs[n > 0] / n[n > 0], 0.75) if n.any() else 0.0
        for n in (n_sources, n_reference)
    ]
    expected = np.minimum(shares[0] * n_sources, shares[1] * n_reference)
    # enough that zero pairs would be too improbable for any of so many parts
    n_parts = np.count_nonzero(expected >= _JUDGED)
    needed = max(_JUDGED, np.log(max(n_parts, 1) / _PARTS_CHANCE) / _PROMISED)
    judged = expected >= needed
    too_few = pdtr(n_pairs, _PROMISED * expected)
    enough = (too_few > _PARTS_CHANCE / max(n_parts, 1)) | (n_pairs > _PLENTY * expected)
    # chance must explain the pairs less well than a match with some losses
    floor = max(0.5 * weight / step, _LEAST_BY_CHANCE)
    too_many = pdtrc(n_pairs - 1.0, np.maximum(by_chance, floor))
    too_many = np.where(n_pairs > 0, too_many, 1.0)
    accepted = ~judged | (enough & (too_many < too_few))
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
