"""Weighted linear least squares: radial weights, the astropy fitter, the attitude of an exposure.

::

    (xi, eta), (xi_ref, eta_ref) --WPDCFitter, RadialWeight--> polynomial
    undistorted px, (ra, dec)    --fit_attitude-------------> CRVAL, CD and their covariance

Everything is solved by QR and SVD of columns scaled to unit length, never by normal equations of
raw powers.

astropy imports this module while it imports its own fitters (entry point ``astropy.modeling``):
only numpy and the base classes may be imported at module level.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from astropy.modeling.fitting import (
    Covariance,
    Fitter,
    ModelLinearityError,
    StandardDeviations,
    _validate_constraints,
)

from wpdc_gwcs.exceptions import FitError

__all__ = ["AttitudeFit", "RadialWeight", "WPDCFitter", "fit_attitude"]

_WEIGHTS = ("exp-sqrt", "gaussian", "inverse", "inverse-square", "uniform")

# 1 / 0.6745: turns a median absolute deviation into the standard deviation of a normal
# distribution.
_MAD_TO_SIGMA = 1.482602218505602


@dataclass(frozen=True)
class RadialWeight:
    r"""Weight of a star by its distance from the reference point.

    Parameters
    ----------
    name : {'exp-sqrt', 'gaussian', 'inverse', 'inverse-square', 'uniform'}, optional
        Weighting function outside ``r0``; inside, every weight is 1.
    r0 : float, optional
        Radius in px within which all stars weigh the same.

    Raises
    ------
    ValueError
        If the name is unknown or ``r0`` is not a positive number.

    Notes
    -----
    With :math:`r_d` the distance from the reference point, for :math:`r_d > r_0` (equations 6 to 9
    of the paper, the bracket of the Gaussian put where it lets the weight fall):

    ==================  ======================================
    ``exp-sqrt``        :math:`\exp(-\\sqrt{r_d - r_0})`
    ``gaussian``        :math:`\exp(-((r_d - r_0) / r_0)^2)`
    ``inverse``         :math:`r_0 / r_d`
    ``inverse-square``  :math:`(r_0 / r_d)^2`
    ``uniform``         1
    ==================  ======================================

    The weight multiplies the *squared* residual.  ``exp-sqrt`` falls to 5e-5 within 100 px: it is a
    hard mask, and a polynomial fitted with it is an extrapolation outside ``r0``.

    References
    ----------
    WPDC-2P, arXiv:2603.09193, section 3.2.

    Examples
    --------
    >>> from wpdc_gwcs import RadialWeight
    >>> RadialWeight("inverse", r0=4000.0)([0.0, 4000.0, 8000.0])
    array([1. , 1. , 0.5])
    """

    name: str = "exp-sqrt"
    r0: float = 4000.0

    def __post_init__(self):
        if self.name not in _WEIGHTS:
            raise ValueError(f"weight must be one of {', '.join(_WEIGHTS)}, got {self.name!r}")
        if not (np.isfinite(self.r0) and self.r0 > 0):
            raise ValueError(f"r0 must be a positive number of px, got {self.r0}")

    @classmethod
    def for_shape(cls, image_shape, name="exp-sqrt"):
        """Weight with the default radius of a detector: 0.87 times half its shorter side.

        Parameters
        ----------
        image_shape : (int, int)
            Shape ``(ny, nx)`` of the detector in px.
        name : str, optional
            Weighting function.

        Returns
        -------
        RadialWeight
            With ``r0`` in px.
        """
        return cls(name, r0=0.87 * 0.5 * min(image_shape))

    def __call__(self, r):
        """Evaluate the weight.

        Parameters
        ----------
        r : array_like
            Distance from the reference point in px.

        Returns
        -------
        ndarray
            Weights between 0 and 1, of the shape of ``r``.
        """
        r = np.asarray(r, dtype=float)
        outside = np.maximum(r, self.r0)  # every function is 1 at r0
        if self.name == "exp-sqrt":
            return np.exp(-np.sqrt(outside - self.r0))
        if self.name == "gaussian":
            return np.exp(-(((outside - self.r0) / self.r0) ** 2))
        if self.name == "inverse":
            return self.r0 / outside
        if self.name == "inverse-square":
            return (self.r0 / outside) ** 2
        return np.ones_like(r)


class LinearSolution(NamedTuple):
    """Weighted linear least squares, see `solve_linear`."""

    parameters: np.ndarray
    rank: int
    condition: float
    root: np.ndarray  # (p, p): root @ root.T = inverse of the weighted normal matrix
    leverage: np.ndarray | None


def solve_linear(design, target, weight=None, *, leverage=False):
    """Minimise ``sum(weight * (target - design @ p)**2)`` by QR and SVD of scaled columns.

    Parameters
    ----------
    design : (N, p) ndarray
        Columns of the linear model.
    target : (N,) or (N, k) ndarray
        Values to be reproduced; several right-hand sides share the factorisation.
    weight : (N,) ndarray, optional
        Weight of the squared residual.
    leverage : bool, optional
        Also return the diagonal of the hat matrix.

    Returns
    -------
    LinearSolution
        Parameters ``(p,)`` or ``(p, k)``; rank and condition number of the scaled, weighted
        columns.

    Raises
    ------
    FitError
        If there are fewer rows of non-zero weight than columns, or the columns are not independent.
    """
    n, p = design.shape
    if weight is not None:
        root_weight = np.sqrt(weight)
        n = int(np.count_nonzero(root_weight))
        design = design * root_weight[:, None]
        target = target * (root_weight if target.ndim == 1 else root_weight[:, None])
    if n < p:
        raise FitError(f"{n} stars of non-zero weight cannot determine {p} coefficients")
    scale = np.sqrt(np.einsum("ij,ij->j", design, design))
    if not np.all(scale > 0):
        raise FitError(
            f"{int(np.sum(~(scale > 0)))} of {p} coefficients have no weight: the weights are "
            "zero or vanish at the stars"
        )
    # QR first: the SVD is then of a small triangle, whatever the number of stars.
    q, r = np.linalg.qr(design / scale)
    u, s, vt = np.linalg.svd(r)
    rank = int(np.sum(s > s[0] * p * np.finfo(float).eps))
    if rank < p:
        raise FitError(
            f"the {n} stars determine only {rank} of {p} coefficients: they lie too close "
            "together or on one line"
        )
    root = (vt.T / s) / scale[:, None]
    parameters = root @ (u.T @ (q.T @ target))
    hat = np.einsum("ij,ij->i", q, q) if leverage else None
    return LinearSolution(parameters, rank, float(s[0] / s[-1]), root, hat)


def robust_sigma(values):
    """Scatter about zero that outliers do not move: 1.4826 times the median absolute value."""
    return _MAD_TO_SIGMA * float(np.median(np.abs(values))) if len(values) else np.nan


class WPDCFitter(Fitter):
    r"""Distance-weighted linear least squares for models of two inputs and two outputs.

    Parameters
    ----------
    weight : RadialWeight, optional
        Weight of a star by its distance from the reference point; uniform if not given.
    pixel_scale : float or (2, 2) array_like, optional
        Size of a pixel in the unit of ``xi`` and ``eta``, or the CD matrix: the distance from the
        reference point is ``hypot(CD^-1 (xi, eta))`` px.  Not needed for uniform weights or where
        ``distance`` is given with the data.
    robust : {None, 'clip', 'huber'}, optional
        What happens to outliers: nothing, iterative clipping, or Huber weights.
    clip : float, optional
        Limit in robust standard deviations (1.4826 times the median absolute residual) beyond which
        a star is left out (``clip``) or its weight falls with its residual (``huber``).
    damping : float, optional
        Share of a correction that is applied before the stars are matched again, 0 to 1; only used
        with ``rematch``.
    rematch : callable, optional
        ``rematch(model)`` returns the data ``(xi, eta, xi_ref, eta_ref)`` or ``(xi, eta, xi_ref,
        eta_ref, weights)`` matched anew with the corrected positions.  The result is the undamped
        optimum of the last matches.
    max_iterations : int, optional
        Greatest number of damped corrections, and of robust iterations of each solution.
    calc_uncertainties : bool, optional
        Attach ``cov_matrix`` and ``stds`` to the returned model, as astropy's fitters do.

    Attributes
    ----------
    fit_info : dict
        Of the last call: ``covariance`` of the free parameters (with ``param_names``), ``rank``,
        ``condition``, ``iterations`` (re-matchings), ``robust_iterations``, ``converged``,
        ``n_used``, ``used`` (mask of the stars kept), ``rms`` and ``scatter`` of the residuals of
        each output, ``chi2``, ``residuals`` ``(2, N)``.

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    Minimises :math:`\sum w(r_i) \Delta_i^2 / \sigma_i^2` for each output, with ``weights`` =
    :math:`1/\sigma_i` as in astropy's fitters and :math:`w(r)` the radial weight (the paper's
    objective, equation 5, with its square put back).  The covariance is that of the estimate,
    :math:`M^{-1} A^T W V W A M^{-1}`, for weights that are not inverse variances; the variances are
    scaled by the reduced :math:`\chi^2` of each output, as in astropy.

    References
    ----------
    WPDC-2P, arXiv:2603.09193, section 3.2.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs import PVPolynomial, RadialWeight, WPDCFitter
    >>> truth = PVPolynomial(pv1_1=1.001, pv1_7=0.3, pv2_8=-0.2)
    >>> xi, eta = np.random.default_rng(1).uniform(-0.1, 0.1, (2, 500))
    >>> fitter = WPDCFitter(weight=RadialWeight("exp-sqrt", r0=4000), pixel_scale=2e-5)
    >>> model = fitter(PVPolynomial(), xi, eta, *truth(xi, eta))
    >>> float(model.pv1_7.value), fitter.fit_info["rank"]
    (0.3, 20)
    """

    supported_constraints = ["fixed"]

    def __init__(
        self,
        weight=None,
        *,
        pixel_scale=None,
        robust=None,
        clip=3.0,
        damping=0.5,
        rematch=None,
        max_iterations=10,
        calc_uncertainties=False,
    ):
        if weight is None:
            weight = RadialWeight("uniform")
        if not callable(weight):
            raise TypeError(f"weight must be a RadialWeight or a function of px, got {weight!r}")
        if robust not in (None, "clip", "huber"):
            raise ValueError(f"robust must be None, 'clip' or 'huber', got {robust!r}")
        if not clip > 0:
            raise ValueError(f"clip must be positive, got {clip}")
        if not 0 < damping <= 1:
            raise ValueError(f"damping must be above 0 and at most 1, got {damping}")
        if rematch is not None and not callable(rematch):
            raise TypeError(f"rematch must be callable, got {rematch!r}")
        if not max_iterations >= 1:
            raise ValueError(f"max_iterations must be at least 1, got {max_iterations}")
        if pixel_scale is not None:
            pixel_scale = np.asarray(pixel_scale, dtype=float)
            if pixel_scale.ndim == 0:
                pixel_scale = pixel_scale * np.eye(2)
            if pixel_scale.shape != (2, 2) or not np.linalg.matrix_rank(pixel_scale) == 2:
                raise ValueError(
                    "pixel_scale must be a non-zero number or an invertible 2 x 2 matrix, got "
                    f"{pixel_scale}"
                )
        # The optimiser and statistic of the base class serve non-linear fits; there is none here.
        self.weight = weight
        self.pixel_scale = pixel_scale
        self.robust = robust
        self.clip = float(clip)
        self.damping = float(damping)
        self.rematch = rematch
        self.max_iterations = int(max_iterations)
        self._calc_uncertainties = calc_uncertainties
        self.fit_info = {}

    def __call__(
        self,
        model,
        xi,
        eta,
        xi_ref,
        eta_ref,
        weights=None,
        *,
        distance=None,
        inplace=False,
    ):
        """Fit a model to pairs of positions.

        Parameters
        ----------
        model : `~astropy.modeling.FittableModel`
            Model of two inputs and two outputs, linear in its parameters (a `PVPolynomial` of any
            degree, an `~astropy.modeling.models.AffineTransformation2D`, two
            `~astropy.modeling.models.Polynomial2D` joined by ``&``).  Fixed parameters keep their
            values.
        xi, eta : (N,) array_like
            Positions before the correction; usually deg.
        xi_ref, eta_ref : (N,) array_like
            Positions of the reference, in the same unit.
        weights : float, (N,) or (2, N) array_like, optional
            1/sigma of each star, or of each output and star.
        distance : (N,) array_like, optional
            Distance from the reference point in px, instead of the one found with ``pixel_scale``.
        inplace : bool, optional
            Change the model given instead of a copy.

        Returns
        -------
        `~astropy.modeling.FittableModel`
            Copy of the model with the fitted parameters.

        Raises
        ------
        FitError
            If the data hold NaN, are fewer than the free coefficients, or do not determine them.
        ModelLinearityError
            If the model is not linear in its parameters.
        UnsupportedConstraintError
            If parameters are tied or bounded.
        ValueError
            If the model does not have two inputs and two outputs, or the arrays differ in length.
        """
        if (model.n_inputs, model.n_outputs) != (2, 2):
            raise ValueError(
                f"model must have 2 inputs and 2 outputs, got {model.n_inputs} and "
                f"{model.n_outputs}"
            )
        _validate_constraints(self.supported_constraints, model)
        fitted = model if inplace else model.copy()
        free = _free_parameters(fitted)
        if not np.any(free):
            raise FitError(f"all {free.size} parameters are fixed: nothing to fit")

        data = self._check_data(xi, eta, xi_ref, eta_ref, weights, distance)
        iterations, converged = 0, True
        if self.rematch is not None:
            data, iterations, converged = self._iterate_matches(fitted, free, data)
        solution, info = self._solve(fitted, free, data)
        fitted.parameters = solution

        names = [n for n, is_free in zip(_parameter_names(fitted), free) if is_free]
        self.fit_info = {
            **info,
            "param_names": names,
            "iterations": iterations,
            "converged": bool(converged and info["converged"]),
        }
        if self._calc_uncertainties:
            fitted.cov_matrix = Covariance(info["covariance"], names)
            fitted.stds = StandardDeviations(info["covariance"], names)
        return fitted

    def _check_data(self, xi, eta, xi_ref, eta_ref, weights=None, distance=None):
        """Positions, reference, 1/sigma and radial weight as clean float arrays."""
        arrays = [np.asarray(a, dtype=float).ravel() for a in (xi, eta, xi_ref, eta_ref)]
        n = arrays[0].size
        if any(a.size != n for a in arrays):
            raise ValueError(
                f"xi, eta, xi_ref and eta_ref must have one length, got {[a.size for a in arrays]}"
            )
        position, reference = np.array(arrays[:2]), np.array(arrays[2:])
        inverse_sigma = np.ones((2, n))
        if weights is not None:
            weights = np.asarray(weights, dtype=float)
            inverse_sigma = np.array(np.broadcast_to(weights, (2, n)))
        bad = ~(np.isfinite(position) & np.isfinite(reference) & np.isfinite(inverse_sigma)).all(0)
        if np.any(bad):
            raise FitError(
                f"{bad.sum()} of {n} stars have positions or weights that are NaN or infinite"
            )
        if np.any(inverse_sigma < 0):
            raise FitError(f"{np.any(inverse_sigma < 0, axis=0).sum()} of {n} weights are negative")
        radial = self._radial_weight(position, distance)
        if n and not np.any(radial * inverse_sigma):
            raise FitError(f"the weights of all {n} stars are zero")
        return position, reference, inverse_sigma, radial

    def _radial_weight(self, position, distance):
        if getattr(self.weight, "name", None) == "uniform":
            return np.ones(position.shape[1])
        if distance is None:
            if self.pixel_scale is None:
                raise ValueError(
                    "a weight that depends on the distance in px needs pixel_scale (when the "
                    "fitter is made) or distance "
                    "(when it is called)"
                )
            distance = np.hypot(*np.linalg.solve(self.pixel_scale, position))
        distance = np.asarray(distance, dtype=float).ravel()
        if distance.size != position.shape[1]:
            raise ValueError(
                f"distance must have one value per star, got {distance.size} for "
                f"{position.shape[1]}"
            )
        return self.weight(distance)

    def _iterate_matches(self, model, free, data):
        """Damp and re-match until the undamped solution keeps its own matches."""
        current = np.array(model.parameters)
        for damped in range(1, self.max_iterations + 1):  # noqa: B007
            solution, _ = self._solve(model, free, data)
            current = current + self.damping * (solution - current)
            model.parameters = current
            data, before = self._check_data(*self.rematch(model)), data
            if _same_matches(data, before):
                break
        # The damped model is still (1 - damping)^n of the way off; its matches need not be those of
        # the optimum.
        for undamped in range(1, self.max_iterations + 1):  # noqa: B007
            solution, _ = self._solve(model, free, data)
            model.parameters = solution
            data, before = self._check_data(*self.rematch(model)), data
            if _same_matches(data, before):
                return data, damped + undamped, True
        return data, damped + undamped, False

    def _solve(self, model, free, data):
        """Undamped optimum for fixed matches; robust weights are iterated."""
        position, reference, inverse_sigma, radial = data
        offset, design = _linear_form(model, free, position)
        target = reference - offset
        used = np.ones(position.shape[1], bool)
        down = np.ones_like(target)
        groups = _independent_outputs(design)
        converged = self.robust is None
        for iteration in range(1, self.max_iterations + 1):  # noqa: B007
            weight = radial * inverse_sigma**2 * down * used
            parameters = np.zeros(free.sum())
            parts = []
            for outputs, columns in groups:
                rows = design[outputs][:, :, columns].reshape(-1, columns.sum())
                part = solve_linear(
                    rows, target[outputs].ravel(), weight[outputs].ravel(), leverage=True
                )
                parameters[columns] = part.parameters
                parts.append((outputs, columns, rows, part))
            residual = target - design @ parameters
            if self.robust is None:
                break
            normalised = np.abs(residual * inverse_sigma)
            # The scale is that of the stars the fit answers for: outside r0 the polynomial is an
            # extrapolation.
            core = radial > 0.5 if np.sum(radial > 0.5) > free.sum() else radial > 0
            sigma = np.array(
                [robust_sigma(a[core & (s > 0)]) for a, s in zip(normalised, inverse_sigma)]
            )
            limit = self.clip * np.maximum(sigma, np.finfo(float).tiny)[:, None]
            if self.robust == "clip":
                keep = np.all(
                    normalised <= np.maximum(limit, 1e-12 * np.abs(target * inverse_sigma).max()),
                    axis=0,
                )
                converged = np.array_equal(keep, used)
                used = keep
            else:
                before = down
                down = limit / np.maximum(normalised, limit)
                converged = np.max(np.abs(down - before), initial=0.0) < 1e-6
            if converged:
                break
        covariance = np.zeros((free.sum(), free.sum()))
        chi2 = 0.0
        for outputs, columns, rows, part in parts:
            w = weight[outputs].ravel()
            v = np.where(inverse_sigma[outputs] > 0, inverse_sigma[outputs], 1.0).ravel() ** -2
            r = residual[outputs].ravel()
            dof = np.sum(w * v * (1.0 - part.leverage))
            scale = np.sum(w * r**2) / dof if dof > 0 else np.nan
            half = rows @ part.root
            meat = half.T @ (half * (w * w * v * scale)[:, None])
            covariance[np.ix_(columns, columns)] = part.root @ meat @ part.root.T
            chi2 += float(np.sum(w * r**2))
        solution = np.array(model.parameters)
        solution[free] = parameters
        kept = used & np.any(weight > 0, axis=0)
        info = {
            "covariance": covariance,
            "rank": sum(part.rank for *_, part in parts),
            "condition": max(part.condition for *_, part in parts),
            "robust_iterations": iteration,
            "converged": bool(converged),
            "n_used": int(kept.sum()),
            "used": kept,
            "residuals": residual,
            "rms": np.sqrt(np.mean(residual[:, kept] ** 2, axis=1)),
            "scatter": np.array([robust_sigma(r[kept]) for r in residual]),
            "chi2": chi2,
        }
        return solution, info


def _free_parameters(model):
    """Mask over ``model.parameters`` of those that are fitted."""
    free = np.zeros(len(model.parameters), bool)
    for name in model.param_names:
        free[model._param_metrics[name]["slice"]] = not model.fixed[name]
    return free


def _parameter_names(model):
    """One name per entry of ``model.parameters``; entries of array parameters are numbered."""
    names = []
    for name in model.param_names:
        size = getattr(model, name).size
        names += [name] if size == 1 else [f"{name}[{i}]" for i in range(size)]
    return names


def _linear_form(model, free, position):
    """Write the model as ``offset + design @ parameters[free]``: ``(2, N)`` and ``(2, N, p)``."""
    trial = model.copy()
    base = np.array(model.parameters)
    base[free] = 0.0

    def evaluate(parameters):
        trial.parameters = parameters
        return np.array(trial(*position, with_bounding_box=False), dtype=float)

    offset = evaluate(base)
    n_free = int(free.sum())
    if hasattr(model, "design_matrix"):
        # A PVPolynomial knows its columns; each axis has its own parameters.
        columns = _pv_columns(model, position, free)
        if columns is not None:
            return offset, columns
    design = np.empty((2, position.shape[1], n_free))
    for column, index in enumerate(np.flatnonzero(free)):
        unit = base.copy()
        unit[index] = 1.0
        design[:, :, column] = evaluate(unit) - offset
    # Linear or not: astropy's flag says no for every compound model, so ask the model itself.
    probe = base.copy()
    probe[free] = 1.0 + np.sqrt(2.0) * np.arange(1, n_free + 1)
    direct = evaluate(probe)
    if not np.allclose(
        direct, offset + design @ probe[free], rtol=1e-9, atol=1e-9 * np.abs(direct).max(initial=0)
    ):
        raise ModelLinearityError(f"{type(model).__name__} is not linear in its parameters")
    return offset, design


def _pv_columns(model, position, free):
    """Design columns of a `PVPolynomial`, in the order of its parameters."""
    order = {
        f"pv{axis}_{j}": (axis - 1, k) for axis in (1, 2) for k, j in enumerate(model.term_indices)
    }
    if set(order) != set(model.param_names):
        return None
    matrices = model.design_matrix(*position)
    design = np.zeros((2, position.shape[1], int(free.sum())))
    names = [n for n, is_free in zip(model.param_names, free) if is_free]
    for column, name in enumerate(names):
        axis, k = order[name]
        design[axis, :, column] = matrices[axis][:, k]
    return design


def _independent_outputs(design):
    """Split the problem where no parameter acts on both outputs: two small QRs, not a large one."""
    acts = np.any(design != 0, axis=1)
    if np.any(acts[0] & acts[1]):
        return [(np.array([True, True]), np.ones(design.shape[2], bool))]
    groups = [(np.array([True, False]), acts[0]), (np.array([False, True]), ~acts[0])]
    return [(outputs, columns) for outputs, columns in groups if np.any(columns)]


def _same_matches(data, before):
    return all(a.shape == b.shape and np.array_equal(a, b) for a, b in zip(data, before))


@dataclass(frozen=True, eq=False)
class AttitudeFit:
    """Attitude of one exposure: where it points, and its linear scale and orientation.

    Parameters
    ----------
    crval : (2,) ndarray
        RA and Dec of the reference point, deg.
    cd : (2, 2) ndarray
        Linear matrix, deg / px.
    covariance : (6, 6) ndarray
        Covariance of the errors (ax, bxx, bxy, ay, byx, byy) that the attitude leaves in the
        undistorted position: dX = ax + bxx X + bxy Y and dY = ay + byx X + byy Y, with X, Y in px
        from the reference point.
    dx, dy : (N,) ndarray
        Residuals X - X_ref, Y - Y_ref in undistorted px, of all stars given.
    used : (N,) ndarray of bool
        Stars kept by the fit.
    scale : (2,) ndarray
        Robust scatter of the kept residuals divided by their errors (of the residuals in px,
        without errors).
    iterations : int
        Iterations until CRVAL no longer moved.
    """

    crval: np.ndarray
    cd: np.ndarray
    covariance: np.ndarray
    dx: np.ndarray
    dy: np.ndarray
    used: np.ndarray
    scale: np.ndarray
    iterations: int


# Six numbers from fewer stars than this are at the mercy of a single wrong pair.
MIN_STARS_ATTITUDE = 10

_MAX_ITERATIONS = 50


def fit_attitude(x, y, ra, dec, *, crpix, crval, cd, x_err=None, y_err=None, clip=4.0, used=None):
    """Fit CRVAL and CD of one exposure, six numbers, to all its stars with the instrument fixed.

    Parameters
    ----------
    x, y : (N,) array_like
        Undistorted pixel coordinates, zero based: PV and look-up table already applied.
    ra, dec : (N,) array_like
        Reference positions, deg.
    crpix : (2,) array_like
        Reference point, px, zero based.
    crval : (2,) array_like
        Starting RA and Dec of the reference point, deg.
    cd : (2, 2) array_like
        Starting matrix, deg / px.
    x_err, y_err : (N,) array_like, optional
        Total 1-sigma errors in px; equal weights if not given.
    clip : float, optional
        Stars with a residual of more than this many robust standard deviations in either axis are
        left out, iterated.
    used : (N,) array_like of bool, optional
        Stars that may be used.

    Returns
    -------
    AttitudeFit
        The attitude, its covariance and the residuals of all stars.

    Raises
    ------
    FitError
        If fewer than ten stars remain, or they do not determine six numbers.

    Notes
    -----
    The stars are projected about the current CRVAL, ``CD^-1 (xi, eta) = a + B (X, Y)`` is solved by
    weighted least squares, CD becomes CD B and CRVAL the sky position of the reference point;
    repeated until CRVAL stands still, so that the fit holds on the sphere for any dither and close
    to the poles.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.fitting import fit_attitude
    >>> from wpdc_gwcs.models import deproject
    >>> cd = np.array([[-2e-5, 0.0], [0.0, 2e-5]])
    >>> x, y = np.random.default_rng(1).uniform(0, 2000, (2, 200))
    >>> ra, dec = deproject(*(cd @ (x - 1000, y - 1000)), (120.0, 30.0))
    >>> fit = fit_attitude(x, y, ra, dec, crpix=(1000, 1000), crval=(120.001, 30.0), cd=1.001 * cd)
    >>> bool(np.allclose(fit.crval, (120.0, 30.0), rtol=0, atol=1e-10))
    True
    """
    from wpdc_gwcs.models import deproject, project

    z = np.array([np.asarray(x, float) - crpix[0], np.asarray(y, float) - crpix[1]])
    ra, dec = np.asarray(ra, float), np.asarray(dec, float)
    crval, cd = np.array(crval, dtype=float), np.array(cd, dtype=float)
    n = z.shape[1]
    has_errors = x_err is not None and y_err is not None
    sigma = np.array([x_err, y_err], dtype=float) if has_errors else np.ones((2, n))
    allowed = np.isfinite(z).all(0) & np.isfinite(ra) & np.isfinite(dec)
    allowed &= (np.isfinite(sigma) & (sigma > 0)).all(0)
    if used is not None:
        allowed &= np.asarray(used, bool)
    kept = allowed.copy()
    for iteration in range(1, _MAX_ITERATIONS + 1):
        plane = np.array(project(ra, dec, crval))
        kept &= np.isfinite(plane).all(0)
        if kept.sum() < MIN_STARS_ATTITUDE:
            raise FitError(
                f"{kept.sum()} of {n} stars are left for the attitude, at least "
                f"{MIN_STARS_ATTITUDE} are needed"
            )
        inverse = np.linalg.inv(cd)
        solution, covariance = _linear_attitude(
            z[:, kept], inverse @ plane[:, kept], sigma[:, kept]
        )
        # The reference point's own place on the tangent plane becomes the new CRVAL.
        shift = cd @ solution[:, 0]
        crval = np.array(deproject(*shift, crval))
        cd = cd @ solution[:, 1:]
        moved = (
            np.abs(solution[:, 0]).max()
            + np.abs(solution[:, 1:] - np.eye(2)).max() * np.abs(z[:, kept]).max()
        )
        plane = np.array(project(ra, dec, crval))
        residual = z - np.linalg.solve(cd, plane)
        normalised = np.abs(residual) / sigma
        scale = np.array([robust_sigma(a[kept]) for a in normalised])
        limit = clip * np.maximum(scale, 1e-10)
        keep = allowed & np.all(normalised <= limit[:, None], axis=0)
        settled = np.array_equal(keep, kept)
        kept = (
            keep if iteration < _MAX_ITERATIONS // 2 else kept
        )  # a star on the limit may come and go
        if moved < 1e-9 and (settled or iteration >= _MAX_ITERATIONS // 2):
            break
    if not has_errors:
        covariance = (
            covariance * np.mean(residual[:, kept] ** 2) * kept.sum() / max(kept.sum() - 3, 1)
        )
    return AttitudeFit(crval, cd, covariance, residual[0], residual[1], kept, scale, iteration)


def _linear_attitude(z, target, sigma):
    """Solve ``target = a + B z``; returns (2, 3) [a, B] and the (6, 6) covariance."""
    length = np.sqrt(np.mean(z**2)) or 1.0
    rows = np.stack([np.ones(z.shape[1]), z[0] / length, z[1] / length], axis=1)
    unit = np.array([1.0, length, length])
    solution, covariance = np.empty((2, 3)), np.zeros((6, 6))
    for axis in range(2):
        # Small numbers: the correction to the current attitude, not the position.
        fit = solve_linear(rows, target[axis] - z[axis], sigma[axis] ** -2)
        solution[axis] = fit.parameters / unit
        root = fit.root / unit[:, None]
        covariance[3 * axis : 3 * axis + 3, 3 * axis : 3 * axis + 3] = root @ root.T
    solution[:, 1:] += np.eye(2)
    return solution, covariance
