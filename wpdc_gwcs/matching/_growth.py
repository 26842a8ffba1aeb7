"""Growth: from a few first pairs to a smooth mapping and the pairs of the whole frame."""

import numpy as np

from wpdc_gwcs.matching._local import LocalCorrection
from wpdc_gwcs.matching._mapping import find_narrow_axis, fit_smooth_map
from wpdc_gwcs.matching._pairs import find_edges, find_nearest, one_to_one
from wpdc_gwcs.matching._problem import MAX_CROWDING
from wpdc_gwcs.robust import plane_scatter

__all__ = [
    "SLACK",
    "final_radius",
    "fit_pairs",
    "grow",
    "grow_locally",
    "grow_once",
    "growing_radius",
    "pair",
    "predict",
    "sample_rows",
]

# Maximum number of sources in fits of the mapping: more would not improve it.
_FIT_SAMPLE = 20_000
# Lists up to this length try lower orders if they are stuck, which takes as long as all the rest.
_EXPLORED = 3000
# Minimum gain of a lower order, in pairs and as a fraction of the pairs: less may be chance.
_MORE_PAIRS, _MORE_SHARE = 2.0, 0.05
# Maximum number of rounds of growth; nearly all converge within ten.
_MOST_ROUNDS, _MOST_LOCAL_ROUNDS = 40, 12
# Sets of pairs are equal if they differ by less than this fraction: a few stars may alternate.
_ALIKE = 0.999
# Pairing radius in units of the scatter: while the mapping grows, and in the end (chance to lose a
# right pair: 3e-7).
_GROW_RADIUS = 5.0
_FINAL_RADIUS = 5.5
# Minimum error of catalogs and centroids, px.
_SMALLEST_RADIUS = 0.05
# While growing, a radius that would be larger by no more than this factor is cut to the limit that
# the density of stars sets; a larger one says nothing.
SLACK = 2.5
# Expected number of stars by chance within the radius that is allowed where stars are sparse.
_WIDE_RADIUS = 20.0
_HARMLESS = np.sqrt(0.003 / MAX_CROWDING)
# Clipping limit once the pairs are nearly pure, in units of the scatter.
_LOOSE_CLIP = 50.0
# Fraction of the sources, those with the smallest errors, that show the unexplained scatter.
_BEST_SHARE = 0.3


def fit_pairs(problem, points, reference, *, max_order=None, **options):
    """Fit a smooth mapping in the frame's own units."""
    return fit_smooth_map(
        *points.T,
        *reference.T,
        center=problem.frame.center,
        scale=problem.frame.scale,
        max_order=max_order or problem.options.max_order,
        narrow=find_narrow_axis(problem.shape),
        **options,
    )


def grow(problem, points, limit, reference, pairs):
    """Grow first pairs as far as possible.

    A high order may fit the present pairs and predict nothing beyond them.  So when the pairs no
    longer change, lower orders are tried too, and one that yields clearly more pairs is continued.
    """
    grown = _grow_to_rest(problem, points, limit, reference, pairs)
    if grown is None or len(points) > _EXPLORED:
        return grown
    net = _count_net(grown, reference)
    order = grown[0].mapping.order
    while order > 1:
        order -= 1
        step = grow_once(problem, points, limit, reference, grown[1], order)
        if step is None or _count_net(step, reference) < net + max(_MORE_PAIRS, _MORE_SHARE * net):
            continue
        further = _grow_to_rest(problem, points, limit, reference, step[1])
        if further is not None and _count_net(further, reference) > net + 1.0:
            grown, net = further, _count_net(further, reference)
            order = grown[0].mapping.order
    return grown


def _grow_to_rest(problem, points, limit, reference, pairs):
    """Fit, predict and pair again with the radius of the fit until the pairs no longer change."""
    grown = None
    for _ in range(_MOST_ROUNDS):
        step = grow_once(problem, points, limit, reference, pairs, problem.options.max_order)
        if step is None:
            break
        at_rest = grown is not None and _are_alike(step[1], pairs)
        grown, pairs = step, step[1]
        if at_rest:
            break
    return grown


def grow_once(problem, points, limit, reference, pairs, max_order):
    """Fit and pair again: fit, pairs, mapped positions, radii; `None` without a fit."""
    i, j = pairs
    fit = fit_pairs(problem, points[i], reference.points[j], max_order=max_order)
    if fit is None:
        return None
    mapped, leverage = predict(points, fit, None)
    radius = growing_radius(fit, leverage)
    pairs, radius = pair(mapped, radius, limit, reference)
    return fit, pairs, mapped, radius


def grow_locally(problem, points, limit, fit, pairs):
    """Subtract the common residuals of neighboring pairs, and pair again until convergence.

    The pairs are nearly pure by now, so the polynomial is fitted without clipping: clipping
    would keep it from following where the distortion is steepest, in the corners.
    """
    scatter, local = fit.scatter, None
    reference = problem.stars
    for _ in range(_MOST_LOCAL_ROUNDS):
        i, j = pairs
        fit = fit_pairs(problem, points[i], reference.points[j], clip=_LOOSE_CLIP) or fit
        residual = reference.points[j] - np.column_stack(fit.mapping(*points[i].T))
        local = LocalCorrection.if_worthwhile(points[i], residual)
        scatter = fit.scatter
        if local is not None:
            scatter = plane_scatter(*(residual - local(points[i], leave_out=True)[0]).T)
        mapped, leverage = predict(points, fit, local)
        error = scatter * np.sqrt(1 + leverage)
        # A wider radius is harmless where stars are sparse, and the mapping can follow unexpected
        # distortion.
        near = find_nearest(reference.tree, mapped, 1)[1]
        harmless = _HARMLESS * np.minimum(limit, reference.limit[near])
        radius = np.maximum(_GROW_RADIUS * error, np.minimum(_WIDE_RADIUS * error, harmless))
        before, (pairs, _) = pairs, pair(mapped, radius, limit, reference)
        if _are_alike(pairs, before):
            break
    return fit, local, pairs, scatter


def final_radius(problem, mapped, pairs, scatter, leverage):
    """Return the radius of every source from its own error and that of the mapping there."""
    if problem.errors is None:
        own = np.full(len(mapped), scatter)
    else:
        i, j = pairs
        difference = mapped[i] - problem.stars.points[j]
        error = problem.errors[i]
        # The unexplained scatter is the same for all stars, so it is measured from the best ones.
        small = error <= np.quantile(error, _BEST_SHARE)
        floor = max(0.0, plane_scatter(*difference[small].T) ** 2 - np.median(error[small]) ** 2)
        factor = plane_scatter(*(difference / np.sqrt(error**2 + floor)[:, None]).T)
        own = factor * np.sqrt(problem.errors**2 + floor)
    radius = _FINAL_RADIUS * np.sqrt(own**2 + scatter**2 * leverage)
    return np.maximum(radius, _SMALLEST_RADIUS)


def growing_radius(fit, leverage):
    """Return the radius while the mapping grows, from its scatter and uncertainty there."""
    return _GROW_RADIUS * fit.scatter * np.sqrt(1 + leverage)


def pair(mapped, radius, limit, reference):
    """Find the unambiguous pairs while the mapping grows, and the radii that were used."""
    radius = np.maximum(radius, _SMALLEST_RADIUS)
    radius = np.where(radius > SLACK * limit, 0.0, np.minimum(radius, limit))
    i, j, _ = find_edges(mapped, reference.tree, radius, limit=reference.limit, slack=SLACK)
    keep, _ = one_to_one(i, j, len(mapped), len(reference.points))
    return (i[keep], j[keep]), radius


def predict(sources, fit, local):
    """Map positions, and compute the variance in units of the variance of one pair."""
    mapped = np.column_stack(fit.mapping(*sources.T))
    leverage = fit.leverage(*sources.T)
    if local is None:
        return mapped, leverage
    correction, local_leverage = local(sources)
    return mapped + correction, leverage + local_leverage


def sample_rows(n, extra=()):
    """Choose enough rows for a fit, in order, including some required ones."""
    step = max(1, -(-n // _FIT_SAMPLE))
    rows = np.arange(0, n, step)
    return np.union1d(rows, extra).astype(int) if step > 1 and len(extra) else rows


def _count_net(grown, reference):
    """Count the pairs beyond those expected by chance at the radii used."""
    _, (i, _), mapped, radius = grown
    near = find_nearest(reference.tree, mapped, 1)[1]
    return len(i) - MAX_CROWDING * float(((radius / reference.limit[near]) ** 2).sum())


def _are_alike(pairs, others):
    """Return whether two sets of pairs are nearly the same."""
    a, b = (i * (1 << 32) + j for i, j in (pairs, others))
    return 2 * len(np.intersect1d(a, b, assume_unique=True)) >= _ALIKE * (len(a) + len(b))
