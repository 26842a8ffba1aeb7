"""A separate polynomial for each exposure, as in the first phase of the paper: ``refine="pv"``."""

import logging

import numpy as np

from wpdc_gwcs.fitting import WPDCFitter
from wpdc_gwcs.models import PVPolynomial, deproject, project
from wpdc_gwcs.solve.represent import N_SIGMA, sigma_grid, split_linear

__all__ = ["own_polynomial"]

log = logging.getLogger(__name__)

# Stars needed per coefficient within the radius of full weight.
_STARS_PER_TERM = 3


def own_polynomial(o, state, f, solution, parts, residual, weights):
    """Fit a separate polynomial to a frame, with a fixed table.

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
    parts : dict
        Result of the frame with the shared polynomial, which is kept if there are too few stars.
    residual : (2, N) ndarray
        Residuals of all pairs; those of the frame are replaced.
    weights : dict
        Radial weight of each detector.

    Returns
    -------
    dict
        Result of the frame.
    """
    s = o.slices[f]
    kept = state.kept[s]
    detector = o.detector(f)
    weight = weights[detector.name]
    offset = np.array([o.x[s], o.y[s]]) - detector.crpix[:, None]
    n_terms = len(solution.pv.term_indices)
    if np.sum(weight(np.hypot(*offset[:, kept])) > 0.5) < _STARS_PER_TERM * n_terms:
        log.info("exposure %s keeps the shared polynomial", o.frames[f].name)
        return parts
    cd0, inverse = solution.cd, np.linalg.inv(solution.cd)
    table = np.zeros((2, len(kept)))
    if solution.lookup_table is not None:
        inside = o.finite[s]
        table[:, inside] = solution.lookup_table(o.x[s][inside], o.y[s][inside])

    def reference(crval, cd):
        return np.linalg.solve(cd, np.array(project(o.ra[s], o.dec[s], crval)))

    target = (reference(parts["crval"], parts["cd"]) + table)[:, kept]
    fitter = WPDCFitter(weight=weight, pixel_scale=cd0)
    pv = fitter(
        PVPolynomial(solution.pv.degree),
        *(cd0 @ offset[:, kept]),
        *(cd0 @ target),
        weights=1.0 / np.sqrt(cd0**2 @ state.sigma[:, s][:, kept] ** 2),
    )
    covariance = fitter.fit_info["covariance"]
    pv, constant, linear = split_linear(pv)
    # The table follows the polynomial, so the gauge does not change its linear part.
    crval = np.array(deproject(*(parts["cd"] @ inverse @ constant), parts["crval"]))
    cd = parts["cd"] @ inverse @ linear @ cd0
    place = inverse @ np.array(pv(*(cd0 @ offset))) - table
    residual[:, s] = place - reference(crval, cd)
    x, y = detector.grid(N_SIGMA)
    columns = pv.design_matrix(*(cd0 @ (np.array([x, y]) - detector.crpix[:, None])))
    blocks = covariance[:n_terms, :n_terms], covariance[n_terms:, n_terms:]
    variance = [np.einsum("ij,jk,ik->i", c, v, c) for c, v in zip(columns, blocks)]
    total = np.einsum("ik,jk,kn->ijn", inverse, inverse, np.array(variance))
    if solution.lookup_table is not None:
        total = total + solution.covariance(x, y)
    return parts | {
        "crval": crval, "cd": cd, "pv": pv, "field": None, "sigma": sigma_grid(total, N_SIGMA)
    }  # fmt: skip
