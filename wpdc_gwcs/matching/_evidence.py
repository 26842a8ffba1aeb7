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
# Probability that a correct match is refused because of too few pairs in some part.  Parts need not
# have more than the first fraction of the pairs expected from the better parts, and are always good
# with more than the second fraction.
_PARTS_CHANCE = 0.01
_PROMISED, _PLENTY = 0.8, 0.4
# Minimum number of pairs by chance in a part, even if none was seen.
_LEAST_BY_CHANCE = 1e-3
# Maximum number of stars counted in circles: more would not improve the verdict.
_COUNTED = 60_000
# Fraction of the required significance if all mappings that the search could choose from are
# counted: 9 sigma (3e-18) leave twelve orders of magnitude for the hypotheses of a search, without
# which 5.2 sigma (1e-6) are enough.  The count is an upper limit, as if each choice led to another
# match: of 1500 random fields, including clusters and rows, none reached more than 0 sigma.
_SEARCH_SHARE = 0.58
# Maximum leverage in leave-one-out residuals, for pairs that determine the mapping, and minimum
# fraction of the radius, below which positions are not independent.
_MOST_LEVERAGE = 0.99
_LEAST_SHARE = 1e-3
# Fractions of the sources, those with the smallest radii; the most significant one is used.
_WIDEST = (0.5, 0.7, 0.85, 1.0)
# The distance to this neighbor gives the local density of reference stars.
_DENSITY_NEIGHBOR = 6
# Minimum number of reference stars within reach of a source, even if none was found.
_LEAST_REACHED = 0.5
# Minimum number of pairs for a test of the order of brightness, and maximum number used.
_ORDER_PAIRS = (5, 100)


@dataclass(frozen=True)
class AreaEvidence:
    """Evidence in one part of the frame: a circle, which may overlap others.

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
        Whether the pairs exceed chance and are not far fewer than expected; also true if the area
        is not judged.

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

    The ``search_significance`` comes from `judge_few`; it is NaN for many stars.
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
        """Return whether the pairs exceed chance, by counts or by possible mappings."""
        return (
            self.significance >= min_significance
            or self.search_significance >= _SEARCH_SHARE * min_significance
        )

    def missing(self, options):
        """Describe what is missing for the match to be accepted; an empty string if nothing is."""
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
    """Return the significance of at least `count` events with the mean `expected`, in sigmas.

    Notes
    -----
    This is sqrt(-2 ln P), with an upper limit of P from the leading terms of the Poisson tail,
    which also works if P underflows.
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
    points,
    mapped,
    radius,
    leverage,
    stars,
    terms,
    pairs,
    shape,
    *,
    reaches,
    orientations=1,
    brightness=None,
):
    r"""Return the significance of a short list against all mappings that could be found.

    With few stars, the chance level cannot be counted: there are no pairs at any shift, and it
    would be decisive whether one is expected in ten shifts or in a thousand.  Here the chance level
    comes from the density of reference stars, and the choices of the search are counted instead.

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
        Largest displacements in the search, px: of a source, of a source relative to another one,
        and of a source without the linear part.
    orientations : int, optional
        Number of orientations of the frame that are searched.
    brightness : (ndarray, ndarray), optional
        Brightness of the sources and of the reference stars, in any units that rise with it.

    Returns
    -------
    float
        Significance in sigmas, as from `poisson_significance`.

    Notes
    -----
    A mapping with T terms per axis fits any T pairs exactly, so only further pairs are evidence.
    There are :math:`\binom{N}{T}` sets of N sources, and each source of a set may be one of the
    :math:`m_k` stars in its reach.  So the expected number of mappings that have n pairs by chance
    is at most

    .. math::
        \binom{N}{T} \prod_{k=1}^T m_k \; P(\ge n - T \mid \lambda) ,

    where the first three stars of a set predict the others to within the distortion.  P is the most
    significant value over fractions of the pairing radii, with residuals of pairs predicted by the
    others, and over parts of the sources with small radii.  Both choices are counted, too.  Wrong
    pairs are not in the order of brightness.  The chance of the observed order (Kendall) is
    independent of P, and the product q of the two has the probability :math:`q (1 - \ln q)`
    (Fisher).
    """
    i, j = pairs
    log_chance = _log_chance_of_places(points, mapped, radius, leverage, stars, terms, pairs, shape)
    if log_chance == 0:
        return 0.0
    if brightness is not None:
        log_chance += log_chance_of_order(brightness[0][i], brightness[1][j])
        log_chance += np.log1p(-log_chance)
    log_chance += _log_choices(points, mapped, stars, terms, pairs, reaches, orientations)
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
    # Where the mapping is poorly known, the radii are so wide that they would hide the evidence.
    for widest in np.quantile(radius, _WIDEST):
        # The k-th value is the fraction of the radii within which there are k pairs.
        shares = np.minimum(np.sort(share[radius[i] <= widest]), 1.0)[terms:]
        count = np.arange(1, len(shares) + 1)
        level = expected[radius <= widest].sum() * np.maximum(shares, _LEAST_SHARE) ** 2
        rare = count > level
        tail = _log_poisson_tail(count[rare], level[rare])
        log_chance = min(log_chance, np.min(tail, initial=0.0))
    return float(log_chance)


def _log_choices(points, mapped, stars, terms, pairs, reaches, orientations):
    """Logarithm of the number of mappings that the pairs were chosen from."""
    i, j = pairs
    n, n_sources = len(i), len(points)
    is_paired = np.zeros(n_sources, bool)
    is_paired[i] = True
    moved = stars.points[j] - points[i]
    against = moved - moved.mean(axis=0)
    place = points[i] - points[i].mean(axis=0)
    bent = against - place @ np.linalg.lstsq(place, against, rcond=None)[0]
    # A mapping that reaches beyond the limits could have been fitted to more pairs.
    sizes = [
        max(reach, float(np.hypot(*offset.T).max()))
        for reach, offset in zip(reaches, (moved, against, bent), strict=True)
    ]
    choices = np.log(n * len(_WIDEST) * orientations)
    choices += gammaln(n_sources + 1) - gammaln(terms + 1) - gammaln(n_sources - terms + 1)
    for size, times in zip(sizes, (1, 2, terms - 3), strict=True):
        within = stars.tree.query_ball_point(mapped, size, return_length=True) - is_paired
        choices += times * np.log(max(float(within.mean()), _LEAST_REACHED))
    return float(choices)


def _expected_within(mapped, radius, is_paired, stars, shape):
    """Compute how many reference stars are expected by chance within the radius of each source.

    This comes from the distance to one of the nearest stars, in pixels and in units of the sides of
    the frame, because on a narrow frame a circle with enough stars is mostly outside.
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
    """Return the log probability that two unrelated lists are in as similar an order.

    It is exact, from the number of inversions (Kendall's tau).
    """
    fewest, most = _ORDER_PAIRS
    known = np.isfinite(one) & np.isfinite(other)
    one, other = one[known][:most], other[known][:most]
    if len(one) < fewest:
        return 0.0
    n_inversions = np.count_nonzero(
        np.subtract.outer(one, one) * np.subtract.outer(other, other) < 0
    )
    # The k-th value comes before 0 to k - 1 of the others with equal probabilities.
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
        The mapping, whose terms are degrees of freedom.
    pairs : (i_src, i_ref)
        The pairs.
    image_shape : (int, int)
        Shape of the frame.
    slack : float, optional
        As used to find the pairs, see `find_edges`.

    Returns
    -------
    Evidence
        The evidence.

    Notes
    -----
    The chance level is counted, not modeled.  The mapped sources are shifted against the reference
    stars and paired again.  The shifts are much longer than the radius, but shorter than the scale
    on which the density changes.  Each term of the mapping can make one pair fit, so the
    significance is that of the number of pairs minus the number of terms.
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
    # If there is none at all, half a pair in all shifts together.
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
        # A golden-angle spiral: directions and lengths have no common period.
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
    # The better parts set the expectation, because an average would include the bad ones.
    shares = [
        np.quantile(n_pairs[n > 0] / n[n > 0], 0.75) if n.any() else 0.0
        for n in (n_sources, n_reference)
    ]
    expected = np.minimum(shares[0] * n_sources, shares[1] * n_reference)
    # Enough that zero pairs would be too improbable in any of the parts.
    n_parts = np.count_nonzero(expected >= _JUDGED)
    needed = max(_JUDGED, np.log(max(n_parts, 1) / _PARTS_CHANCE) / _PROMISED)
    judged = expected >= needed
    too_few = pdtr(n_pairs, _PROMISED * expected)
    enough = (too_few > _PARTS_CHANCE / max(n_parts, 1)) | (n_pairs > _PLENTY * expected)
    # Chance has to explain the pairs less well than a match with some losses.
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
