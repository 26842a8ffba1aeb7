"""The solution of the paper for a group of exposures: polynomials, tables, uncertainties."""

import logging

import numpy as np
from scipy.spatial import cKDTree

from wpdc_gwcs.exceptions import FitError
from wpdc_gwcs.fitting import WPDCFitter
from wpdc_gwcs.models import PVPolynomial
from wpdc_gwcs.paper.polynomial import DAMPING, MAX_STEPS, fit_exposure
from wpdc_gwcs.paper.table import build_raw_table, raw_noise
from wpdc_gwcs.robust import robust_sigma
from wpdc_gwcs.solution import DistortionSolution
from wpdc_gwcs.solve import ExposureFit, SolveResult
from wpdc_gwcs.solve.represent import N_SIGMA, sigma_grid, split_linear

__all__ = ["solve_literally"]

log = logging.getLogger(__name__)


def solve_literally(
    exposures,
    crpix,
    *,
    image_shape,
    weight,
    degree=3,
    n_grid=50,
    lut="auto",
    solution=None,
    rematch=None,
):
    """Solve exposures as in the paper: a polynomial for each, and a raw table per detector.

    Parameters
    ----------
    exposures : sequence of Exposure
        Pairs of each exposure of each detector, with ``crval`` and ``cd`` of its header.
    crpix : sequence of (2,) array_like
        Reference point of each exposure, px, zero based.
    image_shape : dict
        Shape ``(ny, nx)`` of each detector by its name.
    weight : dict
        `RadialWeight` of each detector.
    degree : int, optional
        Degree of the polynomials, 1 to 7; 3 in the paper.
    n_grid : int, optional
        Nodes of the table along each axis; 50 in the paper.
    lut : {'auto', 'none'}, optional
        The table of the paper, or polynomials alone.
    solution : dict, optional
        Stored solutions by detector, whose tables are used as they are.
    rematch : callable, optional
        ``rematch(k, correct)`` matches exposure ``k`` again with corrected positions and returns
        it, see `fit_exposure`.

    Returns
    -------
    result : SolveResult
        The solution of a detector has its table, and the mean of the polynomials without their
        linear parts.  Each exposure has its own polynomial ``pv`` about ``crpix``.
    exposures : list of Exposure
        The exposures with the pairs of the last step.

    Raises
    ------
    ValueError
        If ``lut`` has a wrong value, or the lists differ in length.

    Notes
    -----
    ``sigma`` of an exposure combines the extrapolated formal error of its polynomial with the
    scatter of neighboring residuals, which is also the noise of a table through raw residuals.  The
    scatter includes the differences between the polynomials of the exposures.  ``sigma`` does not
    include the distortion that the damped steps leave, if it differs between exposures, the error
    of linear interpolation between nodes, or extrapolation beyond the outermost stars.

    References
    ----------
    WPDC-2P, arXiv:2603.09193, sections 3.2 and 3.3.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs import RadialWeight
    >>> from wpdc_gwcs.models import deproject
    >>> from wpdc_gwcs.paper import solve_literally
    >>> from wpdc_gwcs.solve import Exposure
    >>> x, y = np.random.default_rng(1).uniform(0, 999, (2, 500))
    >>> cd = np.diag([-1e-4, 1e-4])
    >>> u, v = (x - 500) / 500, (y - 500) / 500
    >>> sky = deproject(*(cd @ [x - 500 + 3 * u * (u**2 + v**2), y - 500]), (10.0, 20.0))
    >>> exposure = Exposure("a", x, y, *sky, crval=(10.0, 20.0), cd=cd, detector="d1")
    >>> result, _ = solve_literally(
    ...     [exposure], [(500.0, 500.0)], image_shape={"d1": (1000, 1000)},
    ...     weight={"d1": RadialWeight("w1", r0=435)},
    ... )
    >>> result.exposures[0].pv.degree, len(result.solutions["d1"].lookup_table.x_grid)
    (3, 50)
    """
    if lut not in ("auto", "none"):
        raise ValueError(f"lut must be 'auto' or 'none', got {lut!r}")
    exposures, solution = list(exposures), solution or {}
    found, reasons = {}, {}
    for k, (exposure, point) in enumerate(zip(exposures, crpix, strict=True)):
        again = None if rematch is None else lambda correct, k=k: rematch(k, correct)
        try:
            found[k] = fit_exposure(
                exposure, point, weight=weight[exposure.detector], degree=degree, rematch=again
            )
        except FitError as err:
            reasons[k] = str(err)
            log.warning("exposure %s left out: %s", exposure.name, err)
    solutions, pools, shares = {}, {}, {}
    for name in dict.fromkeys(e.detector for e in exposures):
        of = [k for k in found if exposures[k].detector == name]
        if not of:
            continue
        pool = [(found[k].exposure.x, found[k].exposure.y, *found[k].residuals()) for k in of]
        stars = [np.array(p)[:, found[k].used] for k, p in zip(of, pool, strict=True)]
        counts = np.array([s.shape[1] for s in stars])
        shares |= dict(zip(of, counts / counts.sum(), strict=True))
        stars = pools[name] = np.concatenate(stars, axis=1)
        if name in solution:
            solutions[name] = solution[name]
            continue
        try:
            table = (
                None
                if lut == "none"
                else build_raw_table(*stars, image_shape=image_shape[name], n_grid=n_grid)
            )
        except FitError as err:
            reasons |= dict.fromkeys(of, str(err))
            continue
        solutions[name] = _detector(
            name, [found[k] for k in of], stars, table, image_shape[name], n_grid,
            {"method": "paper", "weight": weight[name].name, "r0": float(weight[name].r0),
             "degree": degree, "n_grid": n_grid, "lut": lut, "refine": "pv"},
        )  # fmt: skip
    fits = []
    for k, exposure in enumerate(exposures):
        if k in reasons:
            fits.append(_rejected(exposure, reasons[k]))
            continue
        name = exposure.detector
        stored = solution.get(name)
        fits.append(_exposure_fit(found[k], solutions[name], stored, pools[name], shares[k], lut))
    rejected = {exposures[k].name: reason for k, reason in reasons.items()}
    last = [found[k].exposure if k in found else e for k, e in enumerate(exposures)]
    return SolveResult(solutions, tuple(fits), rejected), last


def _detector(name, polynomials, stars, table, image_shape, n_grid, settings):
    """Return what the exposures of a detector share: the table and the mean polynomial."""
    first = polynomials[0]
    crpix, degree = first.crpix, settings["degree"]
    ny, nx = image_shape
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(0, nx, 21), np.linspace(0, ny, 21)))
    offset = np.array([x, y]) - crpix[:, None]
    cd, mean = None, 0.0
    for one in polynomials:
        # A polynomial remains one for the matrix of the exposure, about the common point.
        one_cd = np.asarray(one.exposure.cd)
        plane = one_cd @ (one.correct(x, y) - crpix[:, None])
        pv = WPDCFitter()(PVPolynomial(degree), *(one_cd @ offset), *plane)
        pv, _, linear = split_linear(pv)
        cd = linear @ one_cd if cd is None else cd
        mean = mean + np.linalg.solve(one_cd, np.array(pv(*(one_cd @ offset)))) / len(polynomials)
    pv = WPDCFitter()(PVPolynomial(degree), *(cd @ offset), *(cd @ mean))
    pv, _, _ = split_linear(pv)
    sigma = None
    if table is not None:
        nodes = np.meshgrid(
            np.linspace(-0.5, nx - 0.5, N_SIGMA), np.linspace(-0.5, ny - 0.5, N_SIGMA)
        )
        noise = raw_noise(*stars, *nodes)
        sigma = sigma_grid(_diagonal(noise**2), N_SIGMA)
    return DistortionSolution(
        detector=name,
        image_shape=image_shape,
        crpix=crpix,
        cd=cd,
        crval=np.asarray(first.exposure.crval, float),
        pv=pv,
        lookup_table=table,
        table_sigma=sigma,
        settings=settings,
        statistics={
            "n_exposures": len(polynomials),
            "n_used": stars.shape[1],
            "damping": DAMPING,
            "max_steps": MAX_STEPS,
            "steps": [one.steps for one in polynomials],
        },
    )


def _exposure_fit(one, solution, stored, stars, share, lut):
    """Assemble the result of one exposure."""
    exposure = one.exposure
    residual = one.residuals()
    ny, nx = solution.image_shape
    grid = np.meshgrid(np.linspace(-0.5, nx - 0.5, N_SIGMA), np.linspace(-0.5, ny - 0.5, N_SIGMA))
    x, y = (a.ravel() for a in grid)
    covariance = one.variance(x, y)
    if lut == "none" or solution.lookup_table is None:
        # The error is all that the polynomial leaves, and it must show.
        covariance = covariance + _left(stars, x, y)
    else:
        finite = np.isfinite(residual).all(axis=0)
        at = np.array([exposure.x, exposure.y], float)[:, finite]
        residual = residual.copy()
        residual[:, finite] -= np.array(solution.lookup_table(*at))
        # The table has the error of this polynomial, from its own stars, and subtracts it again.
        known = 0.0 if stored is not None else share
        covariance = (1.0 - known) * covariance + np.nan_to_num(solution.covariance(x, y))
    used = one.used
    scatter = [robust_sigma(r[used]) for r in residual]
    given = [
        np.full(len(used), typical) if errors is None else np.asarray(errors, float)
        for errors, typical in zip((exposure.x_err, exposure.y_err), scatter, strict=True)
    ]
    return ExposureFit(
        name=exposure.name,
        crval=np.asarray(exposure.crval, float),
        cd=np.asarray(exposure.cd, float),
        dx=residual[0],
        dy=residual[1],
        x_err=given[0],
        y_err=given[1],
        used=used,
        sigma=sigma_grid(covariance, N_SIGMA),
        pv=one.pv,
        crpix=one.crpix,
        statistics={
            "n_pairs": int(used.size),
            "n_used": int(used.sum()),
            "scatter_dx": scatter[0],
            "scatter_dy": scatter[1],
            "steps": one.steps,
        },
    )


# Number of stars around a point whose mean residual shows what a polynomial leaves there.
_LEFT_NEIGHBORS = 15


def _left(stars, x, y):
    """Square of the distortion that the polynomials leave, from the nearest residuals."""
    k = min(_LEFT_NEIGHBORS, stars.shape[1])
    _, near = cKDTree(stars[:2].T).query(np.stack([x, y], axis=1), k=k)
    mean = np.median(stars[2:, np.reshape(near, (-1, k))], axis=2)
    return mean[:, None] * mean


def _diagonal(variance):
    covariance = np.zeros((2, 2, variance.shape[1]))
    covariance[[0, 1], [0, 1]] = variance
    return covariance


def _rejected(exposure, reason):
    """Return an exposure that could not be solved, unchanged."""
    n = len(exposure.x)
    nothing = np.full(n, np.nan)
    return ExposureFit(
        name=exposure.name,
        crval=np.asarray(exposure.crval, float),
        cd=np.asarray(exposure.cd, float),
        dx=nothing,
        dy=nothing,
        x_err=nothing,
        y_err=nothing,
        used=np.zeros(n, bool),
        reason=reason,
    )
