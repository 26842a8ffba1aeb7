"""A stored solution: the instrument as a table of a model, and how new exposures change it.

::

    residuals about the stored table = change (common) + field (each exposure) + noise
        --evidence--> no change: residuals are pooled with the stored ones
                      a change: the stored ones are moved by it and count for less, then pooled
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import lapack
from scipy.optimize import minimize

from wpdc_gwcs.lookup import TableChoice, build_lookup_table, choose_table
from wpdc_gwcs.models import LookupTable
from wpdc_gwcs.solve.field import Basis, Spectrum, patch
from wpdc_gwcs.solve.fields import with_fields
from wpdc_gwcs.solve.model import focal_variance, residuals, undistorted
from wpdc_gwcs.solve.tables import residual_maps

__all__ = [
    "Change",
    "StoredMap",
    "find_change",
    "summarize_fields",
    "unswallowed_maps",
    "updated_solution",
]

# Waves of a change, and stars for each.
_MOST_WAVES, _STARS_PER_WAVE = 120, 2

# Log evidence that a change must have beyond that of the exposures' own fields, nats.
_AGAINST_CHANGE = 3.0

# What is learnt about a change's spectrum beyond that (two numbers): a false alarm is then rarer
# than one in a thousand.
_LEAST_GAIN = 3.0

# Exposures whose fields tell the spectrum.
_EXPOSURES_TRIED = 12

# Scatter of the logarithm of the fields' strength where nothing is known of it, and the number of
# exposures that this guess is worth; least strength in units of the stars' errors.
_LOG_STRENGTH, _GUESS_WEIGHT = 1.0, 0.5
_LEAST_STRENGTH = 0.1

# The uncertainty of a stored map is itself an estimate: maps of a few turbulent exposures are wrong
# by up to 1.7 times as much as they state, which is no change.  They have as many parameters as a
# polynomial of degree 7 where there is no table.
_STALE_MARGIN, _FREEDOM = 2.0, 36.0

# Points along each axis on which a change is averaged.
_POINTS = 24


@dataclass(frozen=True, eq=False)
class StoredMap:
    """Displacements that a stored solution subtracts: pixel less undistorted pixel.

    Parameters
    ----------
    solution : DistortionSolution
        The instrument.
    """

    solution: object

    def __call__(self, x, y):
        """Displacement of pixels.

        Parameters
        ----------
        x, y : (N,) ndarray
            Pixels.

        Returns
        -------
        (2, N) ndarray
            Px.
        """
        return np.array([x, y]) - np.array(self.solution.undistort(x, y))


@dataclass(frozen=True, eq=False)
class Change:
    """Smooth displacement of the focal plane that all new exposures of a detector share.

    Parameters
    ----------
    basis : Basis
        Waves, for each axis.
    coefficients : (2, M + 3) ndarray
        Of the waves, and of the linear part that attitudes take from them.
    half : (2, M, M + 3) ndarray
        Products of these with themselves, H^T H, are the covariances.
    variance : float
        Variance added to the stored map along each axis (process noise), px^2; 0 for no change.
    gain : float
        Log evidence over that of no change, nats.
    field : Spectrum or None
        Of the exposures' own fields.
    """

    basis: Basis
    coefficients: np.ndarray
    half: np.ndarray
    variance: float
    gain: float
    field: Spectrum | None

    def __call__(self, focal):
        """Displacement ``(2, N)`` at focal plane positions, px.

        Parameters
        ----------
        focal : (2, N) ndarray
            Focal plane, px.
        """
        return self.coefficients @ _columns(self.basis, focal).T

    def covariance(self, focal):
        """Posterior covariance ``(2, 2, N)``, px^2.

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
    return basis.design(focal, "axes")[0, :, :m]


def _power(spectrum, basis):
    """Prior variances of the waves of one axis."""
    return replace(spectrum, kind="axes").prior(basis)[: basis.orders.shape[1]]


def find_change(o, state, k, stored):
    """Find what the new exposures of a detector have in common beyond a stored solution.

    Parameters
    ----------
    o : Observations
        Pairs.
    state : State
        Solved about the stored solution.
    k : int
        Number of the detector.
    stored : DistortionSolution
        Its statistics tell how strong the fields of its exposures were.

    Returns
    -------
    change : Change
        What the evidence says, of the variance 0 if it speaks for none: then what the stored
        solution may well have been wrong by.
    common : Change
        What the exposures have in common whatever the evidence, not drawn to zero.

    Notes
    -----
    Each exposure e of normal matrix G and right-hand side h has a field of prior variances P,
    which leaves :math:`F_e = (G_e^{-1} + P)^{-1}` for the change; these add up.  The variances of
    fields and change are those of the largest evidence.  A single exposure cannot tell its field
    from a change: there it matters how strong the fields of the stored exposures were.
    """
    frames = [f for f in state.active if o.detector_of[f] == k and state.kept[o.slices[f]].any()]
    counts = [int(state.kept[o.slices[f]].sum()) for f in frames]
    detector = o.detectors[k]
    corners = state.model.geometry.focal(k, detector, *detector.grid(2))
    focal = state.model.geometry.focal(k, detector, *detector.grid(_POINTS))
    n = int(np.clip(sum(counts) / _STARS_PER_WAVE, 12, _MOST_WAVES))
    basis = patch(corners.min(1), corners.max(1), n)
    known = stored.statistics.get("fields")
    products = [_normal(o, state, f, basis, known) for f in frames]
    errors = float(np.sqrt(np.median(state.sigma[:, state.kept] ** 2)))
    longest = 2 * float(basis.half.max())
    spacing = longest / np.sqrt(max(np.median(counts), 1.0))
    scales = np.log([min(2 * spacing, 0.5 * longest), 4 * longest])
    prior = _FieldPrior(known, errors, scales, 0.5 * max(detector.image_shape))
    step = -(-len(products) // _EXPOSURES_TRIED)
    stale = _stale_power(stored, basis, detector)
    field, change, gain = _spectra(products[::step], basis, prior, errors, scales, stale)
    found = gain > _AGAINST_CHANGE + _LEAST_GAIN
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
    """Waves and linear columns of a change without what attitudes take of it, over a detector."""
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
    """Variances of the waves by the uncertainty of the stored table.

    The same for as many waves as it has parameters.
    """
    out = np.zeros(basis.orders.shape[1])
    x, y = detector.grid(_POINTS)
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
    """Accumulate the normal equations of a frame along both axes, its attitude taken out."""
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


class _FieldPrior:
    """What is known of the strength of an exposure's field, see `_strength`."""

    def __init__(self, known, errors, scales, wavelength):
        self.wavelength = wavelength
        self.known = bool(known)
        self.scale = 0.5 * scales.sum()
        level = np.log(0.5 * errors)
        self.scatter = 1.5
        if known:
            if known["amplitude"] > 0:
                self.scale = float(np.clip(np.log(known["scale"]), *scales))
            level = np.log(max(known["amplitude"], _LEAST_STRENGTH * errors))
            self.scatter = known["scatter"]
        self.strength = level + _strength(0.0, self.scale, wavelength)

    def penalty(self, amplitude, scale):
        """Minus the log prior of the logarithms of amplitude and scale."""
        strength = _strength(amplitude, scale, self.wavelength) - self.strength
        return 0.5 * (strength / self.scatter) ** 2 + 0.5 * ((scale - self.scale) / 0.7) ** 2


def _strength(amplitude, scale, wavelength):
    """Logarithm of the root of a field's power at a wavelength, from those of amplitude and scale.

    At half the side of a detector it is well known; amplitude and outer scale, mostly larger than
    the detector, are not.
    """
    return amplitude + scale - 11 / 12 * np.log1p((np.exp(scale) / wavelength) ** 2)


def _spectra(products, basis, prior, errors, scales, stale):
    """Spectra of fields and change of the largest evidence, and its gain over no change."""
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

    level = prior.strength - _strength(0.0, prior.scale, prior.wavelength)
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
    field = alone if gain - plain < _AGAINST_CHANGE + _LEAST_GAIN else both[:2]
    return spectrum(field), spectrum(both[2:]), float(gain - plain)


def _marginal(normal, right, power):
    """Give what a field leaves of normal equations, and the log evidence of the field."""
    root = np.sqrt(power)
    inner = normal * root[:, None] * root
    inner[np.diag_indices_from(inner)] += 1.0
    factor, info = lapack.dpotrf(inner, lower=1, overwrite_a=1)
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
    """Coefficients of a change of known spectrum, and the halves of their covariances."""
    means, halves = [], []
    power, root = _power(field, basis), np.sqrt(change)
    for a in range(2):
        left = [_marginal(*axes[a], power) for axes in products]
        normal, right = (sum(part[i] for part in left) for i in range(2))
        inner = normal * root[:, None] * root + np.eye(len(root))
        factor = np.linalg.cholesky(inner)
        half = np.linalg.solve(factor, np.diag(root))
        halves.append(half)
        means.append(half.T @ (half @ right))
    return np.array(means), np.array(halves)


def unswallowed_maps(o, state, group, base, commons):
    """Residual maps without the exposures' fields, but with all that the exposures share.

    Parameters
    ----------
    o : Observations
        Pairs.
    state : State
        Solved about the stored solution.
    group : (N,) ndarray of int
        Group of each pair in cross-validation.
    base : sequence of callable
        For each detector what to put back instead of its present table.
    commons : dict
        Detector to the `Change` that its exposures have in common.

    Returns
    -------
    list of ResidualMap
        One for each detector.
    """
    model = state.model.changed(fields={}, statics=commons)
    fields = {}
    if any(state.spectra.values()):
        spectra = {}
        for e, own in state.spectra.items():
            common = next(
                (commons[int(o.detector_of[f])].field for f in o.frames_of(e)
                 if int(o.detector_of[f]) in commons), None
            )  # fmt: skip
            spectra[e] = own and common and replace(common, kind=own.kind)
        fields = with_fields(o, replace(state, model=model, spectra=spectra)).model.fields
    return residual_maps(o, replace(state, model=model.changed(fields=fields, statics={})),
                         group, base)  # fmt: skip


def change_on(o, state, k, change, x, y):
    """Displacement of pixels of a detector by a change, and its covariance.

    Parameters
    ----------
    o : Observations
        Pairs.
    state : State
        Solved about the stored solution.
    k : int
        Number of the detector.
    change : Change
        Of the focal plane.
    x, y : (N,) ndarray
        Pixels.

    Returns
    -------
    moved : (2, N) ndarray
        Px along the axes of the detector.
    covariance : (2, 2, N) ndarray
        Px^2.
    """
    inverse = np.linalg.inv(state.model.geometry.matrix[k])
    focal = undistorted(state.model.changed(statics={}), k, o.detectors[k], x, y)
    covariance = np.einsum("ia,abn,jb->ijn", inverse, change.covariance(focal), inverse)
    return inverse @ change(focal), covariance


def updated_solution(o, state, k, change, solution, new, n_grid):
    """Add the residuals of new exposures to a stored solution, and make its table anew.

    Parameters
    ----------
    o : Observations
        Pairs.
    state : State
        Solved about the stored solution.
    k : int
        Number of the detector.
    change : Change or None
        What the new exposures say; `None` where the detector has none.
    solution : DistortionSolution
        The stored solution.
    new : ResidualMap
        Residuals of the new exposures about its polynomial.
    n_grid : int
        Nodes of the table along each axis.

    Returns
    -------
    solution : DistortionSolution
        Updated; ``statistics["updates"]`` has one entry more.
    info : TableInfo
        Of its table.
    """
    entry = {
        "n_exposures": 0 if change is None else len({
            int(o.exposure_of[f]) for f in state.active if o.detector_of[f] == k
        }),
        "process_noise": 0.0, "evidence": 0.0, "rms_change_px": 0.0, "max_change_px": 0.0,
    }  # fmt: skip
    old = solution.residual_map
    moved = change is not None and change.variance > 0
    if change is not None:
        entry |= {"process_noise": change.variance, "evidence": change.gain - _AGAINST_CHANGE}
    if moved:
        old, summary = follow(o, state, k, change, solution)
        entry |= summary
    merged = old + new
    # The table of a detector of a mosaic comes from more than its own stars.
    of_mosaic = "optics" in solution.statistics.get("learned", {}) or len(o.detectors) > 1
    choice, candidates = (TableChoice("none"), ()) if of_mosaic else choose_table(merged)
    table, info = build_lookup_table(merged, n_grid, choice=choice)
    sigma, info = info.sigma, replace(info, candidates=candidates)
    if table is None:
        table, sigma, info = solution.lookup_table, solution.table_sigma, None
        if change is not None:
            table = _moved_table(o, state, k, change, table, n_grid)
    if change is not None:
        # The table knows the errors of the stars, not the fields of the exposures.
        x, y = o.detectors[k].grid(n_grid)
        _, covariance = change_on(o, state, k, change, x, y)
        spread = covariance[[0, 1], [0, 1]]
        if not moved:
            # Where the stored map was less certain than elsewhere, it still is.
            before = solution.covariance(x, y)[[0, 1], [0, 1]]
            if np.all(before > 0):
                spread = before * min(np.mean(spread) / np.mean(before), 1.0)
        spread = np.sqrt(spread).reshape(2, n_grid, n_grid)
        if info is None:
            sigma = np.array([*spread, np.zeros_like(spread[0])])
        else:
            sigma = np.array([*np.maximum(sigma[:2], spread), sigma[2]])
    statistics = {**solution.statistics,
                  "updates": [*solution.statistics.get("updates", []), entry]}  # fmt: skip
    return replace(
        solution, lookup_table=table, table_sigma=sigma, residual_map=merged,
        statistics=statistics,
    ), info  # fmt: skip


def _moved_table(o, state, k, change, table, n_grid):
    """Table of a detector after a change, which may be the first to need one."""
    if not np.any(change.coefficients):
        return table
    if table is None:
        shape = o.detectors[k].image_shape
        edges = [np.linspace(-0.5, n - 0.5, n_grid) for n in shape[::-1]]
        zero = np.zeros((n_grid, n_grid))
        table = LookupTable(*edges, zero, zero)
    x, y = np.meshgrid(table.x_grid, table.y_grid)
    shift, _ = change_on(o, state, k, change, x.ravel(), y.ravel())
    dx, dy = np.array([table.dx, table.dy]) - shift.reshape(2, *x.shape)
    return LookupTable(table.x_grid, table.y_grid, dx, dy, method=table.method)


def follow(o, state, k, change, solution):
    """Residual map of a stored solution after a change, and the change on the detector.

    Parameters
    ----------
    o : Observations
        Pairs.
    state : State
        Solved about the stored solution.
    k : int
        Number of the detector.
    change : Change
        What has changed.
    solution : DistortionSolution
        The stored solution.

    Returns
    -------
    residual_map : ResidualMap
        Moved, and of as much less weight as the change is less certain than the stored table.
    summary : dict
        ``rms_change_px`` and ``max_change_px`` over the detector.
    """
    x, y = o.detectors[k].grid(_POINTS)
    moved, covariance = change_on(o, state, k, change, x, y)
    size = np.hypot(*moved)
    before = np.nanmean(solution.covariance(x, y)[[0, 1], [0, 1]])
    if not np.isfinite(before):
        before = 0.0
    added = float(np.mean(covariance[[0, 1], [0, 1]]))
    factor = before / (before + added) if before + added > 0 else 1.0
    total = solution.residual_map
    centers = np.nan_to_num(total.centroid)
    at, _ = change_on(o, state, k, change, *centers.reshape(2, -1))
    residual_map = total.displaced(*-at.reshape(2, *total.shape)).weighted(factor)
    return residual_map, {
        "rms_change_px": float(np.sqrt(np.mean(size**2))),
        "max_change_px": float(size.max()),
    }


def summarize_fields(spectra, image_shape, previous=None):
    """Typical field of some exposures, for the updates to come.

    Parameters
    ----------
    spectra : sequence of Spectrum or None
        Of the exposures; `None` for none.
    image_shape : (int, int)
        Shape of the detector.
    previous : dict, optional
        The same of the exposures of the stored solution.

    Returns
    -------
    dict
        ``n`` exposures, ``amplitude`` (px) and ``scale`` (px) of the typical field, and
        ``scatter`` of the logarithm of the strength; amplitude 0 where there were no fields.
    """
    found = [s for s in spectra if s is not None]
    n, guess = len(spectra), _GUESS_WEIGHT * _LOG_STRENGTH**2
    if not found:
        scatter = np.sqrt(guess / max(n - 1 + _GUESS_WEIGHT, 1))
        own = {"n": n, "amplitude": 0.0, "scale": 1.0, "scatter": float(scatter)}
    else:
        scale = np.mean([np.log(s.scale) for s in found])
        wavelength = 0.5 * max(image_shape)
        strengths = np.array(
            [_strength(np.log(s.amplitude), np.log(s.scale), wavelength) for s in found]
        )
        square = guess + np.sum((strengths - strengths.mean()) ** 2)
        own = {
            "n": n,
            "amplitude": float(np.exp(strengths.mean() - _strength(0.0, scale, wavelength))),
            "scale": float(np.exp(scale)),
            "scatter": float(np.sqrt(square / max(len(found) - 1 + _GUESS_WEIGHT, 1))),
        }
    if not previous or (previous["amplitude"] == 0) != (own["amplitude"] == 0):
        return own if not previous or own["n"] >= previous["n"] else previous
    total = own["n"] + previous["n"]
    share = own["n"] / total
    merged = {k: float(share * own[k] + (1 - share) * previous[k]) for k in ("scale", "scatter")}
    amplitude = share * own["amplitude"] + (1 - share) * previous["amplitude"]
    return {"n": total, "amplitude": float(amplitude), **merged}
