"""The state of a solution between steps, and the linear step to the next one.

Functions take observations and a frozen state, and return a new state.
"""

import logging
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.ndimage import maximum_filter

from wpdc_gwcs.solve.errors import (
    MODE_NAMES,
    MODES,
    clip_outliers,
    error_model,
    frame_scale,
    linear_scatter,
)
from wpdc_gwcs.solve.evidence import inflation, learn_sequence
from wpdc_gwcs.solve.model import Model, block, design, focal_variance, residuals
from wpdc_gwcs.solve.normal import Posterior, accumulate, frame_equations, posterior

__all__ = ["State", "linear_step", "predict_variance", "with_clipping", "with_error_models"]

log = logging.getLogger(__name__)

# Minimum number of exposures to estimate the scatter of attitudes.
_MIN_EXPOSURES_POOL = 5

# Linear maps that differ by more than this do so on purpose (another roll of the camera).
_MAX_POOLED = 0.05

# With more stars in a frame, the leverage of most is negligible.  It is computed for stars
# that determine their own place more than all others do, which are found from the variance of the
# model on this many nodes along each axis, because the variance is smooth.
_MANY_STARS, _LARGE_LEVERAGE, _NODES = 200, 0.5, 9

# Rounding errors of a leverage near one.
_MAX_LEVERAGE = 0.999

# Minimum learned standard deviations, px: of any group; of color terms, per magnitude.
_LEAST_SIGMA, _LEAST_COLOR = 1e-9, 1e-4


@dataclass(frozen=True, eq=False)
class State:
    """The state of a solution.

    Parameters
    ----------
    model : Model
        Geometry, coefficients, tables, fields.
    sigma : (2, N) ndarray
        Errors of the pairs along the axes of their detector, px.
    kept : (N,) ndarray of bool
        Pairs that are fitted.
    reason : tuple
        Reason why each frame was left out, or `None`.
    spectra : dict
        Spectrum of the field of each exposure, or `None`.
    bases : dict
        Basis of each detector for fields that are marginalized.
    error_models : dict
        Scale and floor of the errors.
    pooled : dict
        Scatter of the linear modes of attitudes between exposures.
    pull : tuple, optional
        Prior variances and means of those modes.
    own : (E, K, K) ndarray, optional
        Normal matrices of the exposures, with their priors, of the last linear step.
    posterior : Posterior, optional
        Posterior of the last linear step.
    freedom : float
        Effective number of parameters of the last linear step.
    """

    model: Model
    sigma: np.ndarray
    kept: np.ndarray
    reason: tuple
    spectra: dict = field(default_factory=dict)
    bases: dict = field(default_factory=dict)
    error_models: dict = field(default_factory=dict)
    pooled: dict = field(default_factory=dict)
    pull: tuple | None = None
    own: np.ndarray | None = None
    posterior: Posterior | None = None
    freedom: float = 0.0

    @property
    def active(self):
        """Frames that are not left out."""
        return [f for f, reason in enumerate(self.reason) if reason is None]

    def spectrum(self, o, frame):
        """Spectrum of the field of a frame's exposure, or None.

        Parameters
        ----------
        o : Observations
            Pairs.
        frame : int
            Number of the frame.
        """
        return self.spectra.get(int(o.exposure_of[frame]))

    def noise(self, o, frame):
        """Return variances of the pairs along the focal plane, including unresolved waves.

        Parameters
        ----------
        o : Observations
            Pairs.
        frame : int
            Number of the frame.
        """
        s = o.slices[frame]
        variance = focal_variance(self.model, o, frame, self.sigma[:, s])
        spectrum = self.spectrum(o, frame)
        if spectrum is not None:
            variance = variance + spectrum.unresolved(self.bases[int(o.detector_of[frame])])
        return variance


def _products(o, state):
    model = state.model
    for f in state.active:
        s = o.slices[f]
        kept = state.kept[s]
        residual, focal = residuals(model, o, f, with_field=False)
        variance = state.noise(o, f)[:, kept]
        columns = design(model, o, f, o.x[s][kept], o.y[s][kept], o.color[s][kept])
        k, e = int(o.detector_of[f]), int(o.exposure_of[f])
        spectrum = state.spectrum(o, f)
        marginal = None
        if spectrum is not None:
            basis = state.bases[k]
            marginal = basis.along(focal[:, kept], spectrum.kind), spectrum.prior(basis)
        yield k, e, *frame_equations(columns, -residual[:, kept], 1.0 / variance, field=marginal)


def linear_step(o, state, *, learn=10, pool=True):
    """Solve for all terms at once about the current model, and learn their variances.

    Parameters
    ----------
    o : Observations
        Pairs.
    state : State
        Where the solution stands.
    learn : int, optional
        Steps of expectation maximization of the variances.
    pool : bool, optional
        Whether attitudes are shrunk toward their mean according to their scatter.

    Returns
    -------
    State
        State with the new model and its posterior.
    """
    model = state.model
    scopes = [model.scoped(scope) for scope in ("camera", "detector", "exposure")]
    sizes = tuple(sum(t.size for t in terms) for terms in scopes)
    counts = (len(o.detectors), o.n_exposures)
    blocks = accumulate(_products(o, state), sizes, counts)
    values = _values(model, scopes[0], ()), _values(model, scopes[1], (counts[0],))
    own, own_pull = _exposure_prior(o, state, scopes[2])
    sigma = {t.name: model.sigma[t.name] for t in scopes[0] + scopes[1]}
    for step in range(max(learn, 1)):
        priors = [
            np.broadcast_to(_precision(terms, sigma), value.shape)
            for terms, value in zip(scopes, values)
        ]
        pulls = [-p * v for p, v in zip(priors, values)]
        found = posterior(blocks, *priors, own, (*pulls, own_pull))
        if step + 1 < learn:
            sigma = _learned(scopes, sigma, values, found)
    model = _applied(model, scopes, values, found, sigma)
    freedom = _freedom(found, priors, own)
    # The means are for the most probable variances; the errors include their uncertainty.
    wide = _inflated(scopes, sigma, found)
    priors = [np.broadcast_to(_precision(t, wide), v.shape) for t, v in zip(scopes, values)]
    found = posterior(blocks, *priors, own, (*pulls, own_pull))
    state = replace(
        state, model=model, own=blocks.exposures + own, posterior=found, freedom=freedom
    )
    return _pooled(o, state, scopes[2]) if pool else state


def _values(model, terms, count):
    """Coefficients of the terms of a scope side by side."""
    return np.concatenate(
        [np.zeros((*count, 0)), *(model.coefficients[t.name] for t in terms)], axis=-1
    )


def _precision(terms, sigma):
    return np.concatenate([np.zeros(0), *(1.0 / sigma[t.name][t.groups] ** 2 for t in terms)])


def _learned(scopes, sigma, values, found):
    """Learn the standard deviations of all groups: one step of expectation maximization."""
    out = {}
    means = found.camera, found.detectors
    for terms, value, mean, variance in zip(scopes, values, means, found.variances()):
        square = (value + mean) ** 2 + variance
        square = np.atleast_2d(square)
        place = 0
        for t in terms:
            mine = square[:, place : place + t.size]
            place += t.size
            n = len(t.start)
            total = np.bincount(t.groups, mine.sum(0), n)
            count = np.bincount(t.groups, minlength=n) * len(mine)
            if t.decay:
                out[t.name] = learn_sequence(total, count, sigma[t.name], t.decay)
            else:
                out[t.name] = np.sqrt(total / count)
            out[t.name] = np.maximum(out[t.name], _LEAST_SIGMA)
    return out


def _inflated(scopes, sigma, found):
    """Inflate the standard deviations of all groups for their uncertainty."""
    out = dict(sigma)
    for terms, variance in zip(scopes, found.variances()):
        variance = np.atleast_2d(variance)
        place = 0
        for t in terms:
            mine = variance[:, place : place + t.size] / sigma[t.name][t.groups] ** 2
            place += t.size
            if t.decay:
                groups = t.groups == np.arange(len(t.start))[:, None]
                out[t.name] = sigma[t.name] * inflation((1.0 - mine) @ groups.T)
    return out


def _exposure_prior(o, state, own):
    """Prior of the exposures' unknowns: broad, and the pooled linear modes of their attitudes."""
    model = state.model
    sizes = [t.size for t in own]
    k, n = sum(sizes), o.n_exposures
    precision, pull = np.zeros((n, k, k)), np.zeros((n, k))
    start = 0
    for t, size in zip(own, sizes):
        i = np.arange(start, start + size)
        p = 1.0 / model.sigma[t.name][t.groups] ** 2
        precision[:, i, i] = p
        if t.chromatic:
            pull[:, i] = -p * model.coefficients[t.name]
        start += size
    if state.pull is not None:
        variance, mean, center = state.pull
        radius = model.geometry.radius
        prior = MODES.T @ np.diag(1.0 / variance) @ MODES / radius**2
        linear = np.array([1, 2, 4, 5])
        b = (np.linalg.solve(center, model.geometry.cd) - np.eye(2)).reshape(n, 4)
        precision[:, linear[:, None], linear] += prior
        pull[:, linear] += (MODES.T @ mean - b) * radius @ prior
    return precision, pull


def _freedom(found, priors, own):
    """Effective number of parameters, without those fixed by priors."""
    total = 0.0
    for prior, variance in zip(priors, found.variances()):
        total += variance.size - np.sum(prior * variance)
    return float(total + sum(len(c) - np.sum(c * p) for c, p in zip(found.conditional, own)))


def _applied(model, scopes, values, found, sigma):
    """Model after a linear step: attitudes go into the geometry, exactly."""
    coefficients = dict(model.coefficients)
    sigmas = model.sigma | sigma
    for terms, value, mean in zip(scopes, values, (found.camera, found.detectors)):
        total, place = value + mean, 0
        for t in terms:
            coefficients[t.name] = total[..., place : place + t.size]
            place += t.size
    geometry = model.geometry
    pointing, cd = geometry.pointing.copy(), geometry.cd.copy()
    place = 0
    for t in scopes[2]:
        a = found.exposures[:, place : place + t.size]
        place += t.size
        if t.chromatic:
            coefficients[t.name] = coefficients[t.name] + a
            size = np.sqrt(np.mean(coefficients[t.name] ** 2))
            sigmas[t.name] = np.full(len(t.start), max(size, _LEAST_COLOR))
            continue
        for e in range(len(a)):
            b = a[e].reshape(2, 3)
            pointing[e], cd[e] = geometry.moved(e, b[:, 0], np.eye(2) + b[:, 1:] / geometry.radius)
    geometry = replace(geometry, pointing=pointing, cd=cd)
    return model.changed(geometry=geometry, coefficients=coefficients, sigma=sigmas)


def _pooled(o, state, own):
    """Learn how much scale, rotation and skew vary between exposures."""
    if o.n_exposures < _MIN_EXPOSURES_POOL:
        return state
    cd = state.model.geometry.cd
    center = cd.mean(0)
    active = sorted({int(o.exposure_of[f]) for f in state.active})
    b = np.linalg.solve(center, cd) - np.eye(2)
    if len(active) < _MIN_EXPOSURES_POOL or np.abs(b[active]).max() > _MAX_POOLED:
        return replace(state, pull=None, pooled={})
    # Estimates from the stars of each exposure alone: remove the prior.
    precision, pull = _exposure_prior(o, state, own)
    before, _ = _exposure_prior(o, replace(state, pull=None), own)
    radius = state.model.geometry.radius
    scale = np.array([1, 1 / radius, 1 / radius] * 2)
    estimates, covariances = [], []
    for e in active:
        data = state.own[e] - (precision[e] - before[e])
        covariance = np.linalg.inv(data)[:6, :6]
        # The estimate with the prior is a mean, weighted by precision, of the prior and the data.
        now = (b[e].reshape(4) * radius)[[0, 1, 2, 3]]
        shift = np.linalg.solve(data, -pull[e])[[1, 2, 4, 5]]
        estimates.append(((now + shift) / radius).reshape(2, 2))
        covariances.append(covariance * scale[:, None] * scale)
    variance, mean = linear_scatter(np.array(estimates), np.array(covariances))
    names = dict(zip(MODE_NAMES, map(float, np.sqrt(variance))))
    return replace(state, pull=(variance, mean, center), pooled=names)


def all_residuals(o, state, *, with_field=True):
    """Return the residuals of all pairs along the axes of their detectors, px.

    Parameters
    ----------
    o : Observations
        Pairs.
    state : State
        Where the solution stands.
    with_field : bool, optional
        Whether the fields are part of the model.
    """
    out = np.full((2, len(o)), np.nan)
    for f, s in enumerate(o.slices):
        residual, _ = residuals(state.model, o, f, with_field=with_field)
        out[:, s] = np.linalg.solve(state.model.geometry.matrix[o.detector_of[f]], residual)
    return out


def with_clipping(o, state, clip, *, local=np.inf, relax=1.0, thorough=False):
    """Return the state with outliers clipped again; see `clip_outliers`.

    Parameters
    ----------
    o : Observations
        Pairs.
    state : State
        Where the solution stands.
    clip : float
        Limit in robust standard deviations.
    local : float, optional
        How much larger residuals may be in one part of a detector.
    relax : float, optional
        Multiplies the limit.
    thorough : bool, optional
        Whether stars of frames with many stars, too, are judged by what the others predict, which
        takes longer.
    """
    residual = all_residuals(o, state)
    leverage = np.zeros((2, len(o)))
    for f in state.active:
        s = o.slices[f]
        if thorough or s.stop - s.start <= _MANY_STARS:
            leverage[:, s] = _leverage(o, state, f)
    usable = np.zeros(len(o), bool)
    for f in state.active:
        usable[o.slices[f]] = True
    limited = replace(o, valid=o.valid & usable)
    kept = clip_outliers(limited, residual, state.sigma, leverage, clip, local=local, relax=relax)
    return replace(state, kept=kept)


def _leverage(o, state, frame):
    """Leverage of the pairs of a frame ``(2, N)``; zero where it is negligible.

    The residual of a fitted star is smaller than its error, that of others is larger: theirs is
    negative.
    """
    s, spectrum = o.slices[frame], state.spectrum(o, frame)
    # Waves that are too short for the field are noise.
    basis = state.bases.get(int(o.detector_of[frame]))
    noise = 0.0 if spectrum is None else spectrum.unresolved(basis)

    def variances(x, y):
        # Waves of the pixels are not of the linear step: they would count some stars twice.
        covariance = predict_variance(o, state, frame, x, y, static=False)
        return covariance[[0, 1], [0, 1]] - noise

    x, y, own = o.x[s], o.y[s], state.sigma[:, s] ** 2 + noise
    told, least = np.flatnonzero(o.finite[s]), 0.0
    if len(own[0]) > _MANY_STARS:
        least = _LARGE_LEVERAGE
        near = _nearby(variances, o.detector(frame), x[told], y[told])
        told = told[np.any(near > least * own[:, told], axis=0)]
    out = np.zeros(own.shape)
    if len(told):
        share = variances(x[told], y[told]) / own[:, told]
        share[:, share.max(0) < least] = 0.0
        out[:, told] = np.where(state.kept[s][told], np.minimum(share, _MAX_LEVERAGE), -share)
    return out


def _nearby(variances, detector, x, y):
    """Largest variance along each axis on the four nodes about each place, ``(2, N)``."""
    nodes = variances(*detector.grid(_NODES)).reshape(2, _NODES, _NODES)
    largest = maximum_filter(nodes, (1, 2, 2), origin=(0, -1, -1))[:, :-1, :-1]
    column, row = (
        np.clip((0.5 * (w + 1.0) * (_NODES - 1)).astype(int), 0, _NODES - 2)
        for w in detector.normalized(x, y)
    )
    return largest[:, row, column]


def with_error_models(o, state):
    """Return the state with new scale and floor of the errors; see `error_model`.

    Parameters
    ----------
    o : Observations
        Pairs.
    state : State
        Where the solution stands.
    """
    residual = all_residuals(o, state)
    kept, n = state.kept, 2 * int(state.kept.sum())
    taken = state.freedom + sum(
        field.freedom * state.kept[o.slices[f]].sum() for f, field in state.model.fields.items()
    )
    left = max(n - taken, 0.05 * n)
    inflation = np.sqrt(n / left)
    sigma, models = state.sigma.copy(), {}
    for name, members in (("stated", o.has_errors), ("unknown", ~o.has_errors)):
        group = kept & members
        if not np.any(group):
            continue
        scale, floor = error_model(
            residual[:, group] * inflation,
            o.sigma[:, group],
            stated=name == "stated",
            freedom=left * group.sum() / kept.sum(),
        )
        sigma[:, members] = np.sqrt((scale * o.sigma[:, members]) ** 2 + floor**2)
        models[name] = {"n": int(group.sum()), "scale": scale, "floor": floor}
    for f in state.active:
        s = o.slices[f]
        kept_here = state.kept[s]
        if kept_here.any():
            pull = residual[:, s][:, kept_here] * inflation / sigma[:, s][:, kept_here]
            sigma[:, s] *= frame_scale(pull, 2 * kept_here.sum() * left / n)
    return replace(state, sigma=sigma, error_models=models)


def predict_variance(
    o, state, frame, x, y, *, table=None, growth=None, instrument_only=False, static=True
):
    """Return the covariance of calibrated positions of pixels, without centroid errors.

    Parameters
    ----------
    o : Observations
        Pairs.
    state : State
        Solved state.
    frame : int
        Number of the frame.
    x, y : (N,) ndarray
        Pixels.
    table : (2, 2, N) ndarray, optional
        Covariance of the look-up table; it replaces that of the shared terms where it is larger,
        because both describe the same surface.
    growth : (N,) ndarray, optional
        Factors of the standard deviations of the shared terms, see `extrapolation`.
    instrument_only : bool, optional
        Whether to leave out the numbers and the field of the exposure.
    static : bool, optional
        Whether to include the waves that belong to the pixels.

    Returns
    -------
    (2, 2, N) ndarray
        Px^2 along the axes of the detector.

    Notes
    -----
    With w the shared terms, a the numbers of the exposure and c the field, whose means depend on w
    and a through the stars: cov = v C_w v^T + cov(a | w) + cov(c | w, a), where v is the row of the
    shared terms minus the response of a and c.
    """
    model, found = state.model, state.posterior
    k, e = int(o.detector_of[frame]), int(o.exposure_of[frame])
    rows = design(model, o, frame, x, y).rows
    extra = np.zeros((2, 2, len(x)))
    if frame in model.fields and not instrument_only:
        rows, extra = _with_field(o, state, frame, x, y, rows)
    own = rows[:, :, -found.exposures.shape[1] :]

    def product(matrix, side):
        n = side.shape[1]
        right = (side.reshape(2 * n, -1) @ matrix).reshape(side.shape)
        return np.einsum("anp,bnp->abn", right, side)

    conditional = product(found.conditional[e], own)
    instrument = product(found.joint(k, e), rows) - conditional
    if static and k in model.statics:
        instrument = instrument + model.statics[k].covariance(
            block(model, k, o.detectors[k], x, y)[1]
        )
    inverse = np.linalg.inv(model.geometry.matrix[k])

    def turned(matrix):
        return np.einsum("ia,abn,jb->ijn", inverse, matrix, inverse)

    instrument = turned(instrument)
    if growth is not None:
        instrument = growth**2 * instrument
    if table is not None:
        larger = table[0, 0] + table[1, 1] > instrument[0, 0] + instrument[1, 1]
        instrument = np.where(larger, table, instrument)
    if instrument_only:
        return instrument
    return instrument + turned(conditional + extra)


def _with_field(o, state, frame, x, y, rows):
    """Rows of pixels minus the response of the field, and the covariance of the field."""
    model = state.model
    posterior_field = model.fields[frame]
    s = o.slices[frame]
    kept = state.kept[s]
    k = int(o.detector_of[frame])
    _, focal = block(model, k, o.detectors[k], x, y)
    _, focal_stars = residuals(model, o, frame)
    stars = design(model, o, frame, o.x[s][kept], o.y[s][kept]).rows
    weight = 1.0 / focal_variance(model, o, frame, state.sigma[:, s][:, kept])
    return posterior_field.conditioned(focal, rows, focal_stars[:, kept], stars, weight)
