"""Effects of other stars on a fit: neighbors, and hidden companions."""

import numpy as np
from scipy.spatial import KDTree

from wpdc_gwcs.centroids._build import rank_in_parts
from wpdc_gwcs.centroids._inverses import inverses
from wpdc_gwcs.centroids._joint import cross_products, pairs_that_share
from wpdc_gwcs.centroids._modes import blur_modes, companions, odd_modes, reduced_normal
from wpdc_gwcs.threads import map_threads

__all__ = ["judge_profiles", "weigh_neighbors"]

# Number of stars processed at a time, which limits the memory for their pixels.
_CHUNK = 4000

# Companions that are searched for, in magnitudes fainter than the star; the logarithm of the odds
# for any of them that noise exceeds for one single star in a hundred; and an error of the share of
# light.  If the share is known better than this, the limit is larger in proportion: companions of
# bright stars exceed it by far, and bright stars are few.
_FAINTER = np.linspace(0, 4, 9)
_ODDS, _KNOWN = 1.2, 0.017
# Number of nearest stars, and of the best measured stars of all, that show how profiles differ.
_NEAREST, _BEST = 25, 300
_LEAST = 20
# Variance of a median over that of a mean.
_MEDIAN_COST = 1.57
# Limit for outliers, in median absolute widths; and with fewer stars than this, both sides count.
_OUTLIER, _FEW = 6.0, 60


def weigh_neighbors(field, profile, noise, stars, covariance, radius, unsure):
    r"""Compute how neighbors increase the errors of stars that were fitted in turn with them.

    Parameters
    ----------
    field, profile, noise, radius
        As for `fit_stars`.
    stars : Stars
        All stars as fitted; those without a fit have the flux that they may have.
    covariance : (N, 3, 3) ndarray
        Covariance of the fit of each star alone; NaN where there is no fit.
    unsure : (N,) ndarray
        Relative error of the light of each star in the pixels of its neighbors.

    Returns
    -------
    joint : (N, 3, 3) ndarray
        Covariance of a fit of all stars together; NaN where a star and its neighbors cannot be
        separated.
    shift : (N,) ndarray
        Error of the position in px from errors of the models of the neighbors.

    Notes
    -----
    With :math:`N_{ij}` the weighted products of the derivatives of stars i and j over the pixels of
    i, the covariance of a star with its neighbors eliminated is

    .. math::
        C_i = \Big(N_{ii} - \sum_j N_{ij} N_{jj}^{-1} N_{ji}\Big)^{-1},

    and the whole light of neighbor j would shift it by
    :math:`(N_{ii}^{-1} N_{ij})_{xf} f_j`.
    """
    joint, shift = covariance.copy(), np.zeros(len(stars.x))
    fitted = np.isfinite(covariance).all(axis=(1, 2))
    pairs = pairs_that_share(stars, radius)
    if len(pairs) == 0:
        return joint, shift
    i, j = pairs.T
    cross = cross_products(field, profile, noise, stars, pairs, radius)
    back = np.roll(np.arange(len(i)), len(i) // 2)
    known = fitted[i]
    moved = covariance[i[known]] @ cross[known][:, :, 2:]
    moved = np.hypot(moved[:, 0, 0], moved[:, 1, 0]) * stars.flux[j[known]]
    np.add.at(shift, i[known], (unsure[j[known]] * moved) ** 2)
    both = fitted[i] & fitted[j]
    taken = cross[both] @ covariance[j[both]] @ cross[back[both]]
    loss = np.zeros_like(covariance)
    np.add.at(loss, i[both], taken)
    rows = np.unique(i[both])
    normal = np.linalg.inv(covariance[rows]) - 0.5 * (loss[rows] + loss[rows].transpose(0, 2, 1))
    joint[rows] = _inverse(normal)
    return joint, np.sqrt(shift)


def _inverse(normal):
    """Inverses of symmetric matrices, NaN where they are not positive definite."""
    scale = np.sqrt(np.abs(np.einsum("sii->si", normal)))
    scale = np.where(scale > 0, scale, 1.0)
    scaled = normal / scale[:, :, None] / scale[:, None, :]
    good = np.linalg.eigvalsh(scaled)[:, 0] > 1e-3
    scaled[~good] = np.eye(3)
    inverse = np.linalg.inv(scaled) / scale[:, :, None] / scale[:, None, :]
    inverse[~good] = np.nan
    return inverse


def judge_profiles(field, profile, noise, stars, clean, fwhm, radius, *, subtracted=False):
    r"""Test whether the profiles of stars are those of one star or of two.

    Parameters
    ----------
    field, profile, noise, radius
        As for `fit_stars`.
    stars : Stars
        The stars as fitted; those that are not to be tested have no flux.
    clean : (N,) ndarray of bool
        True for stars that may show what profiles have in common.
    fwhm : float
        FWHM in px.
    subtracted : bool, optional
        Whether the models of all stars have been subtracted from the image.

    Returns
    -------
    broad : (N,) ndarray of bool
        True for the stars that two stars describe better than one.
    excess : (N,) ndarray
        Reduced chi square caused by differences between the profiles of the stars of the frame.

    Notes
    -----
    A companion that is closer than the width of the PSF makes a star broader and asymmetric: these
    are the effects that position and flux of the star cannot absorb.  They are nearly a sum of the
    second and higher derivatives of the profile.  The amplitudes of these derivatives are fitted,
    and the common part of the nearest bright stars is subtracted.  Then the likelihood of a
    companion, averaged over directions and magnitudes, is compared with the likelihood of a single
    star.  Differences between profiles from other causes (colors, or an imperfect PSF) are measured
    from the stars that are narrower, because no companion makes a star narrower.
    """
    broad, excess = np.zeros(len(stars.x), bool), np.zeros(len(stars.x))
    rows = np.flatnonzero(stars.flux > 0)
    clean = np.flatnonzero(clean[rows])
    if len(clean) < _LEAST:
        return broad, excess
    stars = stars.take(rows)
    mean, scale = profile.coefficients.mean(axis=0), fwhm * profile.oversampling
    modes = blur_modes(mean, scale) + odd_modes(mean, scale)
    changes = companions(mean, modes, scale)
    options = {"radius": radius, "subtracted": subtracted}

    def normal(n):
        return _normal(field, profile, noise, stars.take(slice(n, n + _CHUNK)), modes, **options)

    parts = map_threads(normal, range(0, len(rows), _CHUNK))
    left, right, freedom = (np.concatenate(column) for column in zip(*parts, strict=True))
    covariance = inverses(left)
    amplitude = np.einsum("sij,sj->si", covariance, right)
    before = np.einsum("si,sij,sj->s", amplitude, left, amplitude)
    best = _best_everywhere(stars, clean, covariance[clean].trace(axis1=1, axis2=2))
    common, unsure = _common(stars, amplitude, covariance, best)
    amplitude -= common
    narrower = amplitude[best] @ changes.mean(axis=1) <= 0
    differences = _differences(amplitude[best], covariance[best], narrower)
    weight = inverses(covariance + unsure + (1 + _MEDIAN_COST / _NEAREST) * differences)
    after = np.einsum("si,sij,sj->s", amplitude, weight, amplitude)
    excess[rows] = (before - after) / freedom
    pushed = weight @ changes
    # One over the error of the share of light of a companion.
    known = np.sqrt(np.maximum(np.einsum("id,sid->sd", changes, pushed), 1e-300))
    share = np.einsum("si,sid->sd", amplitude, pushed) / known**2
    limit = _ODDS * np.maximum(_KNOWN * known.mean(axis=1), 1)
    broad[rows] = _log_odds(share, known) > limit
    return broad, excess


def _log_odds(share, known):
    """Logarithm of the odds (N,) for a companion of any position and brightness.

    The arguments are the shares of the light (N, K) that a companion at each place seems to have,
    and one over their errors.
    """
    total = []
    for light in 10 ** (-0.4 * _FAINTER):
        odds = light * known**2 * (share - 0.5 * light)
        # Relative to the greatest of a star: no exponential overflows, and NumPy is quick with it.
        most = odds.max(axis=1)
        total.append(np.log(np.exp(odds - most[:, None]).sum(axis=1)) + most)
    return np.logaddexp.reduce(total, axis=0) - np.log(share.shape[1] * len(total))


def _normal(field, profile, noise, stars, modes, *, radius, subtracted):
    """Set up the normal equations of the modes, and the freedom of fits without them."""
    half = int(np.ceil(radius))
    use = field.cut(stars, half, radius)[3]
    left, right = reduced_normal(
        field, profile, noise, stars, modes, radius, subtracted=subtracted, robust=False
    )
    return left, right, np.maximum(use.sum(axis=1) - 3, 1)


def _best_everywhere(stars, clean, size):
    """Rows of the best measured stars, about the same number from each part of the frame.

    Otherwise all of them could be in one cluster, and show nothing about a corner.
    """
    size = np.where(size > 0, size, np.inf)
    clean = clean[np.argsort(size, kind="stable")]
    places = np.column_stack([stars.x[clean], stars.y[clean]])
    rank = rank_in_parts(places, places.min(axis=0), places.max(axis=0))
    n = int(np.clip(len(clean) // 4, _LEAST, _BEST))
    return clean[np.argsort(rank, kind="stable")[:n]]


def _common(stars, amplitude, covariance, best):
    """Median amplitudes of the nearest well measured stars, and their covariance."""
    places = np.column_stack([stars.x, stars.y])
    tree = KDTree(places[best])
    k = min(_NEAREST, len(best))
    near = best[tree.query(places[best], k=k)[1]]
    noise = _MEDIAN_COST / k * covariance[near].mean(axis=1)
    # Use those of the nearest of the best stars, which differ little.
    nearest = tree.query(places)[1]
    return np.median(amplitude[near], axis=1)[nearest], noise[nearest]


def _differences(amplitude, covariance, narrower):
    """Covariance (R, R) of the differences between the profiles of stars.

    They depend on color and brightness, or on position where the PSF is imperfect.  They are
    measured from stars that are narrower than usual, because no companion makes a star narrower;
    if there are few stars, from all of them, because the brightest ones determine the PSF.
    """
    size = np.linalg.norm(amplitude, axis=1)
    told = size < _OUTLIER * np.median(size)
    if len(size) > _FEW:
        told &= narrower
    seen = np.einsum("si,sj->ij", amplitude[told], amplitude[told]) / max(told.sum(), 1)
    sizes, axes = np.linalg.eigh(seen - covariance[told].mean(axis=0))
    return (axes * np.maximum(sizes, 0)) @ axes.T
