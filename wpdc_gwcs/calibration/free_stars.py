"""Reference stars with free positions, for catalogs that are less accurate than the camera.

::

    all exposures of a star: measured - catalog position --mean of the others--> its offset
    exposures, catalog + offsets --solve--> the next solution
"""

import logging
from dataclasses import dataclass, replace

import numpy as np

from wpdc_gwcs.models import deproject, project
from wpdc_gwcs.robust import robust_scatter
from wpdc_gwcs.sky import angles, directions

__all__ = ["solve_free_stars"]

log = logging.getLogger(__name__)

# Rounds of offsets and solution.  With a catalog eight times worse than the centroids, three rounds
# reduce the differences between exposures to 0.4 of those without offsets, fifteen to 0.3.
_ROUNDS = 3

# Minimum number of stars in two or more exposures, to distinguish the errors of both sides.
_LEAST_STARS = 20

# Smallest and largest factor on the stated errors.
_LEAST_SCALE, _MOST_SCALE = 0.2, 10.0

_MAS = 3.6e6  # per deg


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Measured offsets of stars from their catalog positions: columns of all pairs.

    Parameters
    ----------
    star : (N,) ndarray of int
        Number of the star.
    offset : (2, N) ndarray
        Offsets east and north, mas.
    centroid, catalog : (N,) ndarray
        Stated variances of centroids and catalog, mas^2; 0 where they are unknown.
    told : (N,) ndarray of bool
        Mask of the pairs that the solution used and whose errors are known.
    """

    star: np.ndarray
    offset: np.ndarray
    centroid: np.ndarray
    catalog: np.ndarray
    told: np.ndarray

    def sums(self, values):
        """Sum over the usable pairs of each star."""
        return np.bincount(self.star, np.where(self.told, values, 0.0))


def solve_free_stars(exposures, result, solve):
    r"""Solve again with free positions of the stars that occur in several exposures.

    Parameters
    ----------
    exposures : list of Exposure
        Exposures with ``star`` and ``reference_err``.
    result : SolveResult
        Solution of these exposures with the unchanged catalog.
    solve : callable
        Returns the `SolveResult` of a list of exposures.

    Returns
    -------
    SolveResult
        Solution with the ``reference_offset`` of each exposure.  Its residuals are relative to the
        unchanged catalog.  Its uncertainties are those of ``result``: the offsets make the
        exposures agree with each other, but their common position still comes from the catalog.

    Notes
    -----
    The prior of an offset is the error of the catalog.  The position of a star in exposure i comes
    from the catalog and the measured offsets :math:`o_j` of the other exposures.  With the weights
    :math:`w = 1 / \sigma^2` of the centroids and the error :math:`\sigma_c` of the catalog, its
    offset is

    .. math:: d_i = \frac{\sum_{j \ne i} w_j o_j}{\sum_{j \ne i} w_j + 1 / \sigma_c^2} ,

    so no pair is compared with itself.  Offsets and solution alternate.  Factors on the errors of
    the centroids and of the catalog are learned from the scatter of the pairs of each star and from
    the scatter of their means.

    References
    ----------
    Bernstein et al. (2017), PASP 129, 074503 (reference stars with priors, gbdes).
    """
    first, moved = result, exposures
    for _ in range(_ROUNDS):
        pairs = _gather(exposures, moved, result)
        scales = _scales(pairs)
        if scales is None:
            log.warning(
                "free stars: fewer than %d stars with errors are in two or more exposures: all "
                "stay at their catalog positions", _LEAST_STARS,
            )  # fmt: skip
            return first
        moved = _moved(exposures, pairs, scales)
        result = solve(moved)
    log.info("free stars: centroid errors scaled by %.2f, catalog errors by %.2f", *scales)
    return _about_catalog(exposures, moved, first, result, scales)


def _slices(exposures):
    edges = np.concatenate([[0], np.cumsum([np.size(e.x) for e in exposures])])
    return [slice(int(a), int(b)) for a, b in zip(edges[:-1], edges[1:], strict=True)]


def _scale(exposure):
    """Mas per px."""
    return np.sqrt(abs(np.linalg.det(exposure.cd))) * _MAS


def _stated(exposure):
    """Split the stated errors: variances of the centroids along each axis, and the catalog's."""
    both = np.square([exposure.x_err, exposure.y_err])
    catalog = np.minimum(np.square(exposure.reference_err), both.mean(axis=0))
    return both - catalog, catalog


def _gather(exposures, moved, result):
    """Pairs of a result for the exposures with their stars moved."""
    slices = _slices(exposures)
    n = slices[-1].stop
    star, offset = np.full(n, -1), np.zeros((2, n))
    centroid, catalog, told = np.zeros(n), np.zeros(n), np.zeros(n, bool)
    for s, exposure, now, fit in zip(slices, exposures, moved, result.exposures, strict=True):
        if exposure.reference_err is None or fit.reason is not None:
            continue
        star[s], told[s] = exposure.star, fit.used
        plane = np.array(project(now.ra, now.dec, fit.crval))
        plane = plane + fit.cd @ np.nan_to_num([fit.dx, fit.dy])
        out, east, north = directions(exposure.ra, exposure.dec)
        apart = directions(*deproject(*plane, fit.crval))[0] - out
        offset[:, s] = np.degrees([np.sum(east * apart, 0), np.sum(north * apart, 0)]) * _MAS
        axes, reference = _stated(exposure)
        centroid[s] = axes.mean(axis=0) * _scale(exposure) ** 2
        catalog[s] = reference * _scale(exposure) ** 2
    told &= (catalog > 0) & (centroid > 0)
    number = np.unique(star, return_inverse=True)[1]
    return _Pairs(number, offset, centroid, catalog, told)


def _scales(pairs):
    """Factors on the stated errors of centroids and catalog; `None` if there are too few stars."""
    weight = _inverse(pairs.centroid)
    n, total = pairs.sums(1.0), pairs.sums(weight)
    several = n >= 2
    if np.count_nonzero(several) < _LEAST_STARS:
        return None
    mean = np.array([pairs.sums(weight * o) for o in pairs.offset])[:, several] / total[several]
    whole = np.zeros((2, len(n)))
    whole[:, several] = mean
    use = pairs.told & several[pairs.star]
    of = pairs.star[use]
    spread = pairs.centroid[use] * (1.0 - weight[use] / total[of])
    within = robust_scatter(((pairs.offset[:, use] - whole[:, of]) / np.sqrt(spread)).ravel())
    within = np.clip(within, _LEAST_SCALE, _MOST_SCALE)
    stated = pairs.sums(pairs.catalog)[several] / n[several]
    between = robust_scatter((mean / np.sqrt(stated)).ravel()) ** 2
    between -= within**2 * np.median(1.0 / (total[several] * stated))
    return within, np.clip(np.sqrt(max(between, 0.0)), _LEAST_SCALE, _MOST_SCALE)


def _inverse(values):
    return np.divide(1.0, values, out=np.zeros_like(values), where=values > 0)


def _posterior(pairs, scales, *, others):
    """Offsets of stars, mas, and their variances: of all pairs, or for each of the other ones."""
    weight = np.where(pairs.told, _inverse(scales[0] ** 2 * pairs.centroid), 0.0)
    own = weight if others else 0.0
    prior = _inverse(scales[1] ** 2 * pairs.catalog)
    precision = pairs.sums(weight)[pairs.star] - own + prior
    pulled = [pairs.sums(weight * o)[pairs.star] - own * o for o in pairs.offset]
    # Without an error of the catalog there is no offset.
    variance = np.where(prior > 0, _inverse(precision), 0.0)
    return variance * pulled, variance


def _moved(exposures, pairs, scales):
    """Exposures with their stars where the other exposures, and the catalog, put them."""
    offset, variance = _posterior(pairs, scales, others=True)
    found = []
    for s, exposure in zip(_slices(exposures), exposures, strict=True):
        if exposure.reference_err is None:
            found.append(exposure)
            continue
        out, east, north = directions(exposure.ra, exposure.dec)
        de, dn = np.radians(offset[:, s] / _MAS)
        ra, dec = angles(out + de * east + dn * north)
        reference = variance[s] / _scale(exposure) ** 2
        centroid, _ = _stated(exposure)
        x_err, y_err = np.sqrt(np.maximum(scales[0] ** 2 * centroid, 0.0) + reference)
        found.append(
            replace(
                exposure, ra=ra, dec=dec, x_err=x_err, y_err=y_err,
                reference_err=np.sqrt(reference),
            )
        )  # fmt: skip
    return found


def _about_catalog(exposures, moved, first, result, scales):
    """Make a result with residuals about the catalog, and the uncertainties of the first one."""
    pairs = _gather(exposures, moved, result)
    offset, _ = _posterior(pairs, scales, others=False)
    fits = []
    for s, exposure, now, fit, before in zip(
        _slices(exposures), exposures, moved, result.exposures, first.exposures, strict=True
    ):
        if exposure.reference_err is None or fit.reason is not None or before.reason is not None:
            fits.append(fit)
            continue
        step = np.array(project(now.ra, now.dec, fit.crval))
        step = np.linalg.solve(fit.cd, step - project(exposure.ra, exposure.dec, fit.crval))
        catalog = (scales[1] * np.asarray(exposure.reference_err)) ** 2
        x_err, y_err = (
            np.sqrt(np.maximum(e**2 - now.reference_err**2, 0.0) + catalog)
            for e in (fit.x_err, fit.y_err)
        )
        kept = offset[:, s]
        statistics = {
            "centroid_scale": float(scales[0]),
            "catalog_scale": float(scales[1]),
            "rms_offset_mas": float(np.sqrt(np.mean(kept[:, fit.used] ** 2))),
        }
        fits.append(
            replace(
                fit, dx=fit.dx + step[0], dy=fit.dy + step[1], x_err=x_err, y_err=y_err,
                sigma=before.sigma, reference_offset=kept,
                statistics=dict(fit.statistics) | {"free_stars": statistics},
            )
        )  # fmt: skip
    solutions = {
        name: replace(solution, table_sigma=first.solutions[name].table_sigma)
        if name in first.solutions else solution
        for name, solution in result.solutions.items()
    }  # fmt: skip
    return replace(result, exposures=tuple(fits), solutions=solutions)
