"""Errors of pairs and attitudes, and what attitudes have in common."""

import numpy as np
from scipy.optimize import nnls

from wpdc_gwcs.fitting import robust_sigma

# Scale, rotation and the two shears of a small linear map (bxx, bxy, byx, byy).
_MODES = np.array([[1, 0, 0, 1], [0, -1, 1, 0], [1, 0, 0, -1], [0, 1, 1, 0]]) / np.sqrt(2)
_MODE_NAMES = ("scale", "rotation", "stretch", "shear")


def worse_scatter(values):
    """Robust scatter about zero of the worse of two axes."""
    return max(robust_sigma(v) for v in values)


def error_model(residual, sigma, *, fit_floor):
    """Scale s and floor f of the errors: robust variance of the residuals = (s sigma)^2 + f^2.

    Stars are put into groups of equal error; the variances of the groups are fitted, each with its
    own uncertainty.
    """
    order = np.argsort(sigma.ravel())
    r, e = residual.ravel()[order], sigma.ravel()[order]
    groups = max(1, min(12, len(r) // 200)) if fit_floor else 1
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
        # Errors that say nothing about the residuals.
        scale2 = 1e-6
    return float(np.sqrt(scale2)), float(np.sqrt(floor2))


def attitude_variance(covariance, z):
    """Variances of both axes at positions z about the reference point, ``(2, ...)``."""
    row = np.stack([np.ones_like(z[0]), z[0], z[1]])
    return np.array(
        [np.einsum("i...,ij,j...->...", row, covariance[i : i + 3, i : i + 3], row) for i in (0, 3)]
    )


def pool_linear(b, covariance):
    """Draw the linear parts of exposures towards their mean by as much as their scatter warrants.

    Each mode has its own variance between exposures, estimated as the posterior mean under a flat
    prior of the standard deviation (restricted likelihood), which is never zero: a few exposures do
    not prove that nothing varies.
    """
    n = len(b)
    modes = b.reshape(n, 4) @ _MODES.T
    linear = np.array([1, 2, 4, 5])
    error = np.einsum("ki,eij,kj->ek", _MODES, covariance[:, linear][:, :, linear], _MODES)
    variance, mean = np.empty(4), np.empty(4)
    for m in range(4):
        typical = np.sqrt(np.median(error[:, m]))
        spread = np.std(modes[:, m])
        tau = np.linspace(0.0, 5.0 * max(spread, typical), 400)
        total = error[:, m] + tau[:, None] ** 2
        w = 1.0 / total
        centre = np.sum(w * modes[:, m], axis=1) / w.sum(1)
        like = -0.5 * (
            np.log(total).sum(1)
            + np.log(w.sum(1))
            + np.sum(w * (modes[:, m] - centre[:, None]) ** 2, axis=1)
        )
        like = np.exp(like - like.max())
        variance[m] = np.sum(like * tau**2) / np.sum(like)
        w = 1.0 / (error[:, m] + variance[m])
        mean[m] = np.sum(w * modes[:, m]) / w.sum()
    prior = _MODES.T @ np.diag(1.0 / variance) @ _MODES
    posterior, covariances = [], []
    for k in range(n):
        precision = np.linalg.inv(covariance[k])
        right = precision @ np.array([0, *b[k].ravel()[:2], 0, *b[k].ravel()[2:]])
        right[linear] += prior @ (_MODES.T @ mean)
        precision[np.ix_(linear, linear)] += prior
        c = np.linalg.inv(precision)
        theta = (c @ right).reshape(2, 3)
        posterior.append((theta[:, 0], theta[:, 1:]))
        covariances.append(c)
    return posterior, covariances, dict(zip(_MODE_NAMES, map(float, np.sqrt(variance))))
