"""Errors of pairs: clipping, error model, scatter of attitudes."""

import numpy as np
from scipy.optimize import nnls
from scipy.spatial import cKDTree

from wpdc_gwcs.fitting import robust_sigma

__all__ = [
    "clip_outliers",
    "error_model",
    "extrapolation",
    "frame_scale",
    "linear_scatter",
    "repetition",
    "worse_scatter",
]

# Scale, rotation and the two shears of a small linear map (bxx, bxy, byx, byy).
MODES = np.array([[1, 0, 0, 1], [0, -1, 1, 0], [1, 0, 0, -1], [0, 1, 1, 0]]) / np.sqrt(2)
MODE_NAMES = ("scale", "rotation", "stretch", "shear")

# Weight of the errors of all frames in each frame, in degrees of freedom.
_POOLED_FREEDOM = 200.0

# Weight of the stated errors, in degrees of freedom: a few stars do not prove them wrong.
_STATED_FREEDOM = 40.0

# Errors where there are no stars have heavier tails than a normal distribution.  They grow with the
# distance to the nearest star in units of the spacing of stars, beyond one spacing and up to this
# many more.  Above this number of stars, gaps do not shrink any further.  The values are from
# benchmarks/few_stars.py: where there are no stars, 99 % of errors must be within three sigma.
_GROWTH, _FARTHEST, _ENOUGH_STARS = 0.5, 3.0, 100


def worse_scatter(values):
    """Return the robust scatter about zero of the worse of two axes.

    Parameters
    ----------
    values : sequence of (N,) array_like
        Residuals of each axis.
    """
    return max(robust_sigma(v) for v in values)


def clip_outliers(observations, residual, sigma, leverage, clip, *, local=np.inf, relax=1.0):
    """Clip outliers.

    Parameters
    ----------
    observations : Observations
        Pairs.
    residual, sigma : (2, N) ndarray
        Residuals and their errors, px.
    leverage : (2, N) ndarray
        Leverage of each star: the diagonal of the hat matrix for fitted stars; 0 if negligible.
    clip : float
        Limit in robust standard deviations.
    local : float, optional
        How much larger residuals may be in one part of a detector than elsewhere.
    relax : float, optional
        Multiplies the limit.

    Returns
    -------
    (N,) ndarray of bool
        Pairs kept.

    Notes
    -----
    A pair is compared with its neighbors on the detector and with the other pairs of its frame.
    Where the instrument is not yet known, often far from most stars, all residuals are large, and
    clipping them would keep it unknown.  The residual of a star with high leverage is small even if
    the star is wrong, so a star is judged by the prediction of the other stars.
    """
    o = observations
    normalized = np.abs(residual) / (sigma * np.sqrt(np.clip(1.0 - leverage, 1e-3, None)))
    usable = o.valid & np.isfinite(normalized).all(0)
    if not usable.any():
        return usable
    overall = worse_scatter(normalized[:, usable])
    limit = np.full(len(o), overall)
    for k, detector in enumerate(o.detectors):
        member = np.zeros(len(o), bool)
        for f in np.flatnonzero(o.detector_of == k):
            member[o.slices[f]] = True
        member &= usable
        n = int(member.sum())
        if not n:
            continue
        g = int(np.clip(np.sqrt(n / 100), 1, 12))
        ny, nx = detector.image_shape
        cell = np.clip((o.x[member] + 0.5) * g / nx, 0, g - 1).astype(int) * g
        cell += np.clip((o.y[member] + 0.5) * g / ny, 0, g - 1).astype(int)
        order = np.argsort(cell, kind="stable")
        scale = np.full(g * g, overall)
        values = normalized[:, member]
        for part in np.split(order, np.flatnonzero(np.diff(cell[order])) + 1):
            scale[cell[part[0]]] = worse_scatter(values[:, part])
        limit[member] = np.clip(scale[cell], overall, local * overall)
    for s in o.slices:
        if usable[s].any():
            limit[s] = np.maximum(limit[s], worse_scatter(normalized[:, s][:, usable[s]]))
    limit = relax * clip * np.maximum(limit, 1e-10)
    return usable & (np.max(np.where(usable, normalized, 0.0), axis=0) <= limit)


def error_model(residual, sigma, *, stated, freedom):
    """Fit scale s and floor f of the errors: robust variance = (s sigma)^2 + f^2.

    Parameters
    ----------
    residual, sigma : (2, N) ndarray
        Residuals, inflated for the degrees of freedom of the fit, and their errors.
    stated : bool
        Whether the errors were given.  If so, there is a floor, and few stars do not overrule them.
    freedom : float
        Degrees of freedom of the residuals.

    Returns
    -------
    scale, floor : float
        Scale and floor of the errors.

    Notes
    -----
    Stars are put into groups of equal error; the variances of the groups are fitted, each with its
    own uncertainty.
    """
    order = np.argsort(sigma.ravel())
    r, e = residual.ravel()[order], sigma.ravel()[order]
    groups = max(1, min(12, len(r) // 200)) if stated else 1
    parts = np.array_split(np.arange(len(r)), groups)
    # Residuals over errors: a group may hold a wide range of errors.
    e2 = np.array([np.median(e[i] ** 2) for i in parts])
    v = np.array([robust_sigma(r[i] / e[i]) ** 2 for i in parts]) * e2
    if groups > 1 and e2.max() > 1.5 * e2.min():
        scale2, floor2 = nnls(
            np.stack([e2, np.ones_like(e2)], axis=1) / v[:, None], np.ones_like(v)
        )[0]
    else:
        scale2, floor2 = np.median(v / e2), 0.0
    if scale2 <= 0:
        # The errors are unrelated to the residuals.
        scale2 = 1e-6
    if stated:
        share = freedom / (freedom + _STATED_FREEDOM)
        scale2, floor2 = share * scale2 + 1.0 - share, share * floor2
    return float(np.sqrt(scale2)), float(np.sqrt(floor2))


def frame_scale(pull, freedom):
    """Return the scale of the errors of one frame relative to all, for its seeing.

    Parameters
    ----------
    pull : (2, N) ndarray
        Residuals over errors.
    freedom : float
        Degrees of freedom of the residuals.

    Returns
    -------
    float
        Factor of the errors; near 1 for few stars.
    """
    own = np.mean([robust_sigma(p) ** 2 for p in pull])
    return float(np.sqrt((freedom * own + _POOLED_FREEDOM) / (freedom + _POOLED_FREEDOM)))


def extrapolation(stars, places):
    """Return factors for the uncertainty of a distortion, by the distance to its stars.

    Parameters
    ----------
    stars, places : (2, N) ndarray
        Positions of stars, and positions for the factors, -1 to 1 along each side of the detector.

    Returns
    -------
    (N,) ndarray
        Factors: 1 among the stars, and larger far from them.
    """
    n = stars.shape[1]
    if not n:
        return np.full(places.shape[1], 1.0 + _GROWTH * _FARTHEST)
    spacing = 2.0 / np.sqrt(min(n, _ENOUGH_STARS))
    distance, _ = cKDTree(stars.T).query(places.T)
    return 1.0 + _GROWTH * np.clip(distance / spacing - 1.0, 0.0, _FARTHEST)


def repetition(star, variance, reference):
    """Return the factor on the variance of shared terms for shared reference stars.

    Parameters
    ----------
    star : (N,) ndarray of int
        Number of the star of each pair; -1 where it is unknown.
    variance : (N,) ndarray
        Variances of the pairs, which were fitted as if all errors were independent.
    reference : (N,) ndarray
        Part of the variances that is due to reference stars.

    Returns
    -------
    float
        1 if no star occurs twice or references have no errors; at most the number of times that
        stars occur.

    Notes
    -----
    A star with n pairs contributes to shared terms only the mean of its pairs, whose variance is
    that of the reference plus 1/n of the remaining variance.
    """
    if not len(star):
        return 1.0
    _, number = np.unique(star, return_inverse=True)
    # Unknown stars count as different stars.
    alone = star < 0
    number[alone] = number.max() + 1 + np.arange(np.count_nonzero(alone))
    centroid = np.bincount(number, 1.0 / np.maximum(variance * (1.0 - reference), 1e-300))
    shared = np.bincount(number, variance * reference) / np.maximum(np.bincount(number), 1)
    known = centroid > 0
    told = np.sum(1.0 / (shared[known] + 1.0 / centroid[known]))
    return float(max(np.sum(1.0 / variance) / told, 1.0))


def linear_scatter(b, covariance):
    """Estimate variances and means of the modes of the linear maps of exposures.

    Parameters
    ----------
    b : (E, 2, 2) ndarray
        Linear maps of the exposures minus unity.
    covariance : (E, 6, 6) ndarray
        Covariance of (ax, bxx, bxy, ay, byx, byy).

    Returns
    -------
    variance, mean : (4,) ndarray
        Variance and mean of scale, rotation, stretch and shear.

    Notes
    -----
    Each mode has its own variance between exposures, estimated as the posterior mean under a flat
    prior of the standard deviation (restricted likelihood), which is never zero: a few exposures do
    not prove that nothing varies.
    """
    n = len(b)
    modes = b.reshape(n, 4) @ MODES.T
    linear = np.array([1, 2, 4, 5])
    error = np.einsum("ki,eij,kj->ek", MODES, covariance[:, linear][:, :, linear], MODES)
    variance, mean = np.empty(4), np.empty(4)
    for m in range(4):
        typical = np.sqrt(np.median(error[:, m]))
        spread = np.std(modes[:, m])
        tau = np.linspace(0.0, 5.0 * max(spread, typical), 400)
        total = error[:, m] + tau[:, None] ** 2
        w = 1.0 / total
        center = np.sum(w * modes[:, m], axis=1) / w.sum(1)
        like = -0.5 * (
            np.log(total).sum(1)
            + np.log(w.sum(1))
            + np.sum(w * (modes[:, m] - center[:, None]) ** 2, axis=1)
        )
        like = np.exp(like - like.max())
        variance[m] = np.sum(like * tau**2) / np.sum(like)
        w = 1.0 / (error[:, m] + variance[m])
        mean[m] = np.sum(w * modes[:, m]) / w.sum()
    return variance, mean
