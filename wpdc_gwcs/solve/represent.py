"""Conversion of a solution to the form of the paper: polynomial, tables, six linear numbers."""

from dataclasses import asdict, replace

import numpy as np

from wpdc_gwcs.fitting import WPDCFitter, fit_attitude, robust_sigma
from wpdc_gwcs.models import LookupTable, PVPolynomial, project, pv_terms
from wpdc_gwcs.solution import DistortionSolution, covariance_of
from wpdc_gwcs.solve.errors import extrapolation, repetition
from wpdc_gwcs.solve.evidence import truncation
from wpdc_gwcs.solve.exposure import ExposureFit
from wpdc_gwcs.solve.geometry import mean_direction
from wpdc_gwcs.solve.model import block, colored, undistorted
from wpdc_gwcs.solve.state import predict_variance
from wpdc_gwcs.solve.waves import count_places

__all__ = ["N_SIGMA", "represent_detector", "represent_frame", "split_linear", "unknown_errors"]

# Points along each axis: for the fit of the attitude, and for the uncertainty of a frame.
N_SIGMA = 17

# Nodes of the table of a field per shortest wave.
_NODES_PER_WAVE = 5

# If a frame deviates by less than this from polynomial, table and attitude, it needs no table, px.
_LEAST_FIELD = 1e-4


def represent_detector(
    o, state, k, *, weight, degree, n_grid, cd=None, table_sigma=None, factor=1.0
):
    """Return the polynomial and table of a detector.

    Parameters
    ----------
    o : Observations
        Pairs.
    state : State
        Solved state.
    k : int
        Number of the detector.
    weight : RadialWeight
        Weight for the fit of the polynomial.
    degree : int
        Degree of the PV polynomial.
    n_grid : int
        Nodes along each axis; 0 for no table.
    cd : (2, 2) ndarray, optional
        Nominal matrix.
    table_sigma : (3, n, n) ndarray, optional
        Uncertainty of the smoothed table.
    factor : float, optional
        As from `unknown_errors`.

    Returns
    -------
    DistortionSolution
        Solution without statistics.
    """
    detector = o.detectors[k]
    frame = next((f for f in state.active if o.detector_of[f] == k), None)
    x, y = detector.grid(n_grid or 50)
    cd0, crval, plane = _nominal_plane(o, state, k, frame, x, y, cd)
    offset = np.array([x, y]) - detector.crpix[:, None]
    fitter = WPDCFitter(weight=weight, pixel_scale=cd0)
    pv = fitter(PVPolynomial(degree), *(cd0 @ offset), *plane)
    pv, constant, linear = split_linear(pv)
    table = sigma = None
    if n_grid:
        target = np.linalg.solve(linear, plane - constant[:, None])
        left = np.linalg.solve(cd0, np.array(pv(*(cd0 @ offset))) - target)
        edges = [np.linspace(-0.5, n - 0.5, n_grid) for n in detector.image_shape[::-1]]
        table = LookupTable(*edges, *left.reshape(2, n_grid, n_grid))
    sigma = _instrument_sigma(o, state, frame, x, y, table_sigma, factor)
    return DistortionSolution(
        detector=detector.name,
        image_shape=detector.image_shape,
        crpix=detector.crpix,
        cd=cd0,
        crval=crval,
        pv=pv,
        lookup_table=table,
        table_sigma=sigma,
    )


def _nominal_plane(o, state, k, frame, x, y, cd):
    """Matrix, pointing and tangent plane (deg) of pixels at a nominal attitude."""
    geometry, detector = state.model.geometry, o.detectors[k]
    focal = undistorted(state.model, k, detector, x, y)
    if len(o.detectors) == 1:
        exposures = sorted({int(o.exposure_of[f]) for f in state.active})
        cd0 = geometry.cd[exposures].mean(0) if cd is None else np.asarray(cd, float)
        return cd0, mean_direction(geometry.pointing[exposures]), cd0 @ focal
    e = int(o.exposure_of[frame])
    step = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) + detector.crpix[:, None]
    at = geometry.sky(e, undistorted(state.model, k, detector, *step))
    crval = np.array(at)[:, 0]
    plane = np.array(project(*at, crval))
    return (
        plane[:, 1:] - plane[:, :1],
        crval,
        np.array(project(*geometry.sky(e, focal), crval)),
    )


def sigma_grid(covariance, n):
    sigma = np.sqrt(np.maximum(covariance[[0, 1], [0, 1]], 0.0))
    with np.errstate(invalid="ignore", divide="ignore"):
        rho = covariance[0, 1] / (sigma[0] * sigma[1])
    rho = np.where(np.isfinite(rho), np.clip(rho, -1, 1), 0.0)
    return np.array([*sigma, rho]).reshape(3, n, n)


def _instrument_sigma(o, state, frame, x, y, table_sigma, factor):
    """Uncertainty of shared terms without the part that attitudes absorb, on a grid."""
    n = int(np.sqrt(len(x)))
    table = None if table_sigma is None else covariance_of(table_sigma.reshape(3, -1))
    growth = factor * _growth(o, state, int(o.detector_of[frame]), x, y)
    covariance = predict_variance(
        o, state, frame, x, y, table=table, growth=growth, instrument_only=True
    )
    return sigma_grid(covariance, n)


def _growth(o, state, k, x, y):
    """Factors on the errors of the distortion of a detector by the distance to its stars."""
    detector, behind = o.detectors[k], _behind(o, state, k)
    stars = detector.normalized(o.x[behind], o.y[behind])
    return extrapolation(np.array(stars), np.array(detector.normalized(x, y)))


def unknown_errors(o, state, k):
    """Return the factor for the errors of a distortion due to what its terms do not know.

    These are errors of reference stars that exposures share, and degrees beyond the last one.

    Parameters
    ----------
    o : Observations
        Pairs.
    state : State
        Solved state.
    k : int
        Number of the detector.
    """
    behind = _behind(o, state, k)
    variance = np.mean(state.sigma[:, behind] ** 2, axis=0)
    factor = np.sqrt(repetition(o.star[behind], variance, o.reference[behind]))
    side = max(o.detectors[k].image_shape)
    n_places = count_places(np.array([o.x[behind], o.y[behind]]) / side)
    for term in state.model.scoped("detector"):
        if term.decay:
            factor *= truncation(state.model.sigma[term.name], n_places)
    return factor


def _behind(o, state, k):
    """Mark the pairs that determine the distortion of a detector."""
    behind = np.zeros(len(o), bool)
    for f in state.active:
        if o.detector_of[f] == k:
            behind[o.slices[f]] = state.kept[o.slices[f]]
    return behind


def represent_frame(o, state, f, solution, *, n_grid, table_sigma, places, factor=1.0):
    """Return attitude, field and uncertainty of a frame, given the solution of its detector.

    Parameters
    ----------
    o : Observations
        Pairs.
    state : State
        Solved state.
    f : int
        Number of the frame.
    solution : DistortionSolution
        Solution of its detector.
    n_grid : int
        Maximum number of nodes of the field table along each axis; 0 for no table, so that the
        remaining field is part of the uncertainty.
    table_sigma : (3, n, n) ndarray or None
        Uncertainty of the smoothed table, or of a stored solution.
    places : dict
        Undistorted positions of grids, and factors by the distance to the stars, which all frames
        of a detector share.
    factor : float, optional
        As from `unknown_errors`.

    Returns
    -------
    dict
        Fields of an `ExposureFit`.
    """
    k, e = int(o.detector_of[f]), int(o.exposure_of[f])
    detector, geometry = o.detectors[k], state.model.geometry

    def sky(x, y, with_field):
        focal = undistorted(state.model, k, detector, x, y)
        if with_field and f in state.model.fields:
            focal = focal + state.model.fields[f](focal)
        return geometry.sky(e, focal)

    def place(x, y):
        key = (detector.name, len(x), float(x[1]))
        if key not in places:
            places[key] = np.array(solution.undistort(x, y)) - detector.crpix[:, None]
        return places[key]

    x, y = detector.grid(N_SIGMA)
    at = sky(x, y, True)
    z = place(x, y)
    start = o.frames[f]
    fit = fit_attitude(*z, *at, crpix=(0.0, 0.0), crval=start.crval, cd=start.cd, clip=np.inf)
    left = np.array([fit.dx, fit.dy])
    field = None
    if n_grid and (f in state.model.fields or np.abs(left).max() > _LEAST_FIELD):
        field = _field_table(state, f, detector, sky, place, fit, n_grid)
    gx, gy = detector.grid(N_SIGMA)
    table = None
    if table_sigma is not None:
        table = replace(solution, table_sigma=table_sigma).covariance(gx, gy)
    key = (detector.name, "growth")
    if key not in places:
        places[key] = factor * _growth(o, state, k, gx, gy)
    covariance = predict_variance(o, state, f, gx, gy, table=table, growth=places[key])
    if field is None:
        covariance = covariance + left[:, None] * left
    sigma = sigma_grid(covariance, N_SIGMA)
    return {
        "crval": fit.crval,
        "cd": fit.cd,
        "sigma": sigma,
        "field": field,
        "color_shift": _color_shift(o, state, f),
    }


def delivered_residual(o, f, solution, parts):
    """Return residuals ``(2, N)`` of the pairs of a frame in its delivered WCS, px.

    Parameters
    ----------
    o : Observations
        Pairs.
    f : int
        Number of the frame.
    solution : DistortionSolution
        Solution of its detector.
    parts : dict
        Result of the frame.
    """
    s = o.slices[f]
    finite = o.finite[s]
    residual = np.full((2, len(finite)), np.nan)
    crpix = np.asarray(solution.crpix)[:, None]
    place = np.array(solution.undistort(o.x[s][finite], o.y[s][finite])) - crpix
    plane = np.array(project(o.ra[s][finite], o.dec[s][finite], parts["crval"]))
    residual[:, finite] = place - np.linalg.solve(parts["cd"], plane)
    return residual


def _field_table(state, f, detector, sky, place, fit, n_grid):
    ny, nx = detector.image_shape
    n = [n_grid, n_grid]
    if f in state.model.fields:
        basis = state.model.fields[f].basis
        shortest = 2 * np.pi / np.abs(basis.wave).max()
        n = [int(np.clip(np.ceil(_NODES_PER_WAVE * s / shortest), 8, max(n_grid, 8)))
             for s in (nx, ny)]  # fmt: skip
    edges = [np.linspace(-0.5, s - 0.5, m) for s, m in zip((nx, ny), n)]
    x, y = (a.ravel() for a in np.meshgrid(*edges))
    plane = np.array(project(*sky(x, y, True), fit.crval))
    left = place(x, y) - np.linalg.solve(fit.cd, plane)
    return LookupTable(*edges, *left.reshape(2, n[1], n[0]))


def _color_shift(o, state, f):
    """Displacement per magnitude, constant and linear, in undistorted px about CRPIX."""
    if not any(t.chromatic for t in state.model.terms):
        return None
    k, e = int(o.detector_of[f]), int(o.exposure_of[f])
    detector = o.detectors[k]
    x, y = detector.grid(N_SIGMA)
    b, _ = block(state.model, k, detector, x, y, np.ones_like(x))
    shift = colored(state.model, e, b)
    shift = np.linalg.solve(state.model.geometry.matrix[k], shift)
    rows = np.stack([np.ones_like(x), x - detector.crpix[0], y - detector.crpix[1]], axis=1)
    return np.linalg.lstsq(rows, shift.T, rcond=None)[0].T


def frame_fit(o, state, f, residual, parts):
    """Build the result of a frame.

    Parameters
    ----------
    o : Observations
        Pairs.
    state : State
        Current state.
    f : int
        Number of the frame.
    residual : (2, N) ndarray
        Residuals of all pairs, px.
    parts : dict
        Result of the frame.
    """
    s, start = o.slices[f], o.frames[f]
    rejected = state.reason[f] is not None
    residual = np.where(o.finite[s], residual[:, s], np.nan)
    kept = state.kept[s]
    spectrum = state.spectrum(o, f)
    statistics = {
        "n_pairs": int(kept.size),
        "n_used": int(kept.sum()),
        "scatter_dx": robust_sigma(residual[0][kept]),
        "scatter_dy": robust_sigma(residual[1][kept]),
    }
    if spectrum is not None:
        statistics["field"] = asdict(spectrum)
    if rejected:
        parts = {"crval": np.asarray(start.crval, float), "cd": np.asarray(start.cd, float)}
    return ExposureFit(
        name=start.name,
        dx=residual[0],
        dy=residual[1],
        x_err=state.sigma[0, s],
        y_err=state.sigma[1, s],
        used=kept,
        reason=state.reason[f],
        statistics=statistics,
        **parts,
    )


def split_linear(pv):
    """Split constant and linear parts from a polynomial, PV = c + L PV'.

    Parameters
    ----------
    pv : PVPolynomial
        Polynomial.

    Returns
    -------
    pv : PVPolynomial
        Polynomial without a constant, with unit linear terms.
    constant, linear : (2,) and (2, 2) ndarray
        The parts c (deg) and L.
    """
    terms = pv_terms(pv.degree)
    own, other = pv.coefficients
    # Terms of axis 2 are in (eta, xi): bring both axes to the order of axis 1.
    swap = np.array(
        [
            int(np.flatnonzero((terms.own == b) & (terms.other == a))[0])
            for a, b in zip(terms.own, terms.other)
        ]
    )
    both = np.array([own, other[swap]])
    constant, linear = both[:, 0].copy(), both[:, 1:3].copy()
    both[:, 0] = 0.0
    both = np.linalg.solve(linear, both)
    both[:, 1:3] = np.eye(2)
    return PVPolynomial.from_coefficients([both[0], both[1][swap]], pv.degree), constant, linear
