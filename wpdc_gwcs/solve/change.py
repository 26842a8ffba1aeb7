"""Common residuals of new exposures about a stored solution: a change of the instrument.

::

    residuals about the stored table = change (common) + field (each exposure) + noise
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import lapack
from scipy.optimize import minimize

from wpdc_gwcs.solve.basis import Basis, patch
from wpdc_gwcs.solve.model import focal_variance, residuals
from wpdc_gwcs.solve.normal import posterior_factor
from wpdc_gwcs.solve.spectrum import Spectrum
from wpdc_gwcs.solve.strength import FieldPrior, log_strength

__all__ = ["AGAINST_CHANGE", "POINTS", "Change", "find_change"]

# Number of waves of a change, and stars needed for each.
_MOST_WAVES, _STARS_PER_WAVE = 120, 2

# Log evidence required for a change beyond that of the fields of exposures, nats.
AGAINST_CHANGE = 3.0

# Additional evidence required for the two numbers of the spectrum of a change.  False alarms are
# then rarer than one in a thousand.
_LEAST_GAIN = 3.0

# Number of exposures whose fields determine the spectrum.
_EXPOSURES_TRIED = 12

# The uncertainty of a stored map is itself an estimate: maps from a few turbulent exposures are
# wrong by up to 1.7 times their uncertainty, which is not a change.  Without a table, they have as
# many parameters as a polynomial of degree 7.
_STALE_MARGIN, _FREEDOM = 2.0, 36.0

# Points along each axis for the average of a change.
POINTS = 24


@dataclass(frozen=True, eq=False)
class Change:
    """Smooth displacement of the focal plane that all new exposures of a detector share.

    Parameters
    ----------
    basis : Basis
        Waves, for each axis.
    coefficients : (2, M + 3) ndarray
        Coefficients of the waves, and of the linear part that attitudes absorb.
    half : (2, M, M + 3) ndarray
        Square roots H of the covariances, which are H^T H.
    variance : float
        Variance added to the stored map along each axis (process noise), px^2; 0 for no change.
    gain : float
        Log evidence over that of no change, nats.
    field : Spectrum or None
        Spectrum of the fields of exposures.
    """

    basis: Basis
    coefficients: np.ndarray
    half: np.ndarray
    variance: float
    gain: float
    field: Spectrum | None

    def __call__(self, focal):
        """Return the displacement ``(2, N)`` at focal plane positions, px.

        Parameters
        ----------
        focal : (2, N) ndarray
            Focal plane, px.
        """
        return self.coefficients @ _columns(self.basis, focal).T

    def covariance(self, focal):
        """Return the posterior covariance ``(2, 2, N)``, px^2.

        Parameters
        ----------
        focal : (2, N) ndarray
            Focal plane, px.
        """
        rows = _columns(self.basis, focal)
        out = np.zeros((2, 2, focal.shape[1]))
        for a in range(2):
            out[a, a] = np.sum((self.half[a] @ rows.T) ** 2, axis=0)
        return out


def _waves(basis, focal):
    m = basis.orders.shape[1]
    return basis.shapes(focal, "axes")[:m, 0].T


def _power(spectrum, basis):
    """Prior variances of the waves of one axis."""
    return replace(spectrum, kind="axes").prior(basis)[: basis.orders.shape[1]]


def find_change(o, state, k, stored):
    """Find the common residuals of new exposures of a detector about a stored solution.

    Parameters
    ----------
    o : Observations
        Pairs.
    state : State
        Solved about the stored solution.
    k : int
        Number of the detector.
    stored : DistortionSolution
        Stored solution, whose statistics have the strength of the fields of its exposures.

    Returns
    -------
    change : Change
        The change, if there is evidence for one.  Otherwise its variance is 0, and it is the likely
        error of the stored solution.
    common : Change
        The common residuals, regardless of evidence and without shrinkage.

    Notes
    -----
    Each exposure e with normal matrix G and right-hand side h has a field with prior variances P.
    With the field marginalized, its contribution to the normal matrix of the change is
    :math:`F_e = (G_e^{-1} + P)^{-1}`, and the contributions add up.  The variances of fields and
    change maximize the evidence.  A single exposure cannot separate its field from a change, so the
    strength of the fields of the stored exposures matters.
    """
    frames = [f for f in state.active if o.detector_of[f] == k and state.kept[o.slices[f]].any()]
    counts = [int(state.kept[o.slices[f]].sum()) for f in frames]
    detector = o.detectors[k]
    corners = state.model.geometry.focal(k, detector, *detector.grid(2))
    focal = state.model.geometry.focal(k, detector, *detector.grid(POINTS))
    n = int(np.clip(sum(counts) / _STARS_PER_WAVE, 12, _MOST_WAVES))
    basis = patch(corners.min(1), corners.max(1), n)
    known = stored.statistics.get("fields")
    products = [_normal(o, state, f, basis, known) for f in frames]
    errors = float(np.sqrt(np.median(state.sigma[:, state.kept] ** 2)))
    longest = 2 * float(basis.half.max())
    spacing = longest / np.sqrt(max(np.median(counts), 1.0))
    scales = np.log([min(2 * spacing, 0.5 * longest), 4 * longest])
    prior = FieldPrior(known, errors, scales, 0.5 * max(detector.image_shape))
    step = -(-len(products) // _EXPOSURES_TRIED)
    stale = _stale_power(stored, basis, detector)
    field, change, gain = _spectra(products[::step], basis, prior, errors, scales, stale)
    found = gain > AGAINST_CHANGE + _LEAST_GAIN
    broad = Spectrum(10 * max(errors, change.amplitude), change.scale)
    power = stale + _power(change, basis) if found else stale / _STALE_MARGIN**2
    one = _posterior(products, basis, field, power)
    variance = change.amplitude**2 if found else 0.0
    both = _posterior(products, basis, field, _power(broad, basis))
    return tuple(
        Change(basis, *_without_linear(basis, focal, *found), variance, gain, field)
        for found in (one, both)
    )


def _without_linear(basis, focal, coefficients, half):
    """Waves and linear columns of a change without the part that attitudes absorb."""
    rows, free = _waves(basis, focal), _linear(basis, focal)
    taken = np.linalg.lstsq(free, rows, rcond=None)[0].T
    return (
        np.hstack([coefficients, -coefficients @ taken]),
        np.concatenate([half, -half @ taken], axis=2),
    )


def _linear(basis, focal):
    u = (focal - basis.center[:, None]) / basis.half[:, None]
    return np.stack([np.ones(focal.shape[1]), *u], axis=1)


def _columns(basis, focal):
    return np.hstack([_waves(basis, focal), _linear(basis, focal)])


def _stale_power(stored, basis, detector):
    """Variances of the waves from the uncertainty of the stored table.

    They are equal for as many waves as the table has parameters.
    """
    out = np.zeros(basis.orders.shape[1])
    x, y = detector.grid(POINTS)
    variance = _STALE_MARGIN**2 * float(np.mean(stored.covariance(x, y)[[0, 1], [0, 1]]))
    if not variance > 0:
        return out
    freedom = stored.statistics.get("table", {}).get("freedom") or _FREEDOM
    # On the patch, which is larger than the detector; sines of both axes have squares of 1/4.
    share = 4 * np.prod(basis.half) / np.prod(detector.image_shape)
    n = int(np.clip(freedom * share, 6, len(out)))
    out[:n] = 4 * variance * np.prod(basis.half) / n
    return out


def _normal(o, state, f, basis, known):
    """Accumulate the normal equations of a frame along both axes, without its attitude."""
    s = o.slices[f]
    kept = state.kept[s]
    residual, focal = residuals(state.model, o, f, with_field=False)
    variance = focal_variance(state.model, o, f, state.sigma[:, s])[:, kept]
    if known and known["amplitude"] > 0:
        variance = variance + Spectrum(known["amplitude"], known["scale"]).unresolved(basis)
    rows = _waves(basis, focal[:, kept])
    free = _linear(basis, focal[:, kept])
    out = []
    for r, v in zip(-residual[:, kept], variance):
        w = 1.0 / v
        heavy = rows * w[:, None]
        cross, normal = free.T @ heavy, (free * w[:, None]).T @ free
        right = np.column_stack([cross, free.T @ (w * r)])
        solved = np.linalg.lstsq(normal, right, rcond=1e-12)[0]
        out.append(
            (heavy.T @ rows - cross.T @ solved[:, :-1], heavy.T @ r - cross.T @ solved[:, -1])
        )
    return out


def _spectra(products, basis, prior, errors, scales, stale):
    """Spectra of fields and change with the largest evidence, and its gain over no change."""
    low, high = scales

    def spectrum(p):
        return Spectrum(float(np.exp(p[0])), float(np.exp(np.clip(p[1], low, high))))

    def cost(p):
        if not np.all(np.abs(p[::2]) < 25):
            return 1e12
        beyond = np.maximum(low - p[1::2], 0) + np.maximum(p[1::2] - high, 0)
        change = stale if len(p) == 2 else stale + _power(spectrum(p[2:]), basis)
        penalty = prior.penalty(p[0], np.clip(p[1], low, high)) + 10 * np.sum(beyond**2)
        return penalty - _log_evidence(products, basis, spectrum(p[:2]), change)

    def best(starts):
        p = np.array(min(starts, key=cost))
        n = len(p)
        found = minimize(
            cost,
            p,
            method="Nelder-Mead",
            options={
                "xatol": 0.05,
                "fatol": 0.1,
                "maxfev": 60 * n,
                "initial_simplex": p + np.vstack([np.zeros(n), 0.4 * np.eye(n)]),
            },
        )
        return found.x, -found.fun  # fmt: skip

    level = prior.strength - log_strength(0.0, prior.scale, prior.wavelength)
    usual = np.array([level, prior.scale])
    alone, plain = best([usual + [a, 0.0] for a in (0.0, 1.0, 2.0)])
    middle = 0.5 * (low + high)
    starts = [
        np.array([*f, np.log(errors) + a, middle + b])
        for f in (alone, usual)
        for a in (-2.0, 0.0, 1.5)
        for b in (-0.7, 0.7)
    ]
    both, gain = best(starts)
    field = alone if gain - plain < AGAINST_CHANGE + _LEAST_GAIN else both[:2]
    return spectrum(field), spectrum(both[2:]), float(gain - plain)


def _marginal(normal, right, power):
    """Marginalize a field from normal equations; return these and its log evidence."""
    root = np.sqrt(power)
    factor, info = posterior_factor(normal, root)
    if info != 0:
        return normal, right, -np.inf
    half, _ = lapack.dtrtrs(factor, root[:, None] * np.column_stack([normal, right]), lower=1)
    matrix, side = half[:, :-1], half[:, -1]
    evidence = 0.5 * side @ side - np.sum(np.log(np.diagonal(factor)))
    return normal - matrix.T @ matrix, right - matrix.T @ side, float(evidence)


def _log_evidence(products, basis, field, change):
    power = _power(field, basis)
    total = 0.0
    for a in range(2):
        left = [_marginal(*axes[a], power) for axes in products]
        total += sum(part[2] for part in left)
        normal, right = (sum(part[i] for part in left) for i in range(2))
        total += _marginal(normal, right, change)[2]
    return total


def _posterior(products, basis, field, change):
    """Coefficients of a change of known spectrum, and square roots of their covariances."""
    means, halves = [], []
    power, root = _power(field, basis), np.sqrt(change)
    for a in range(2):
        left = [_marginal(*axes[a], power) for axes in products]
        normal, right = (sum(part[i] for part in left) for i in range(2))
        factor, _ = posterior_factor(normal, root)
        half, _ = lapack.dtrtrs(factor, np.diag(root), lower=1)
        halves.append(half)
        means.append(half.T @ (half @ right))
    return np.array(means), np.array(halves)
