"""The astropy fitter for models of two inputs and two outputs."""

import numpy as np
from astropy.modeling.fitting import (
    Covariance,
    Fitter,
    ModelLinearityError,
    StandardDeviations,
    _validate_constraints,
)

from wpdc_gwcs.exceptions import FitError
from wpdc_gwcs.fitting.linear import solve_linear
from wpdc_gwcs.fitting.radial import RadialWeight
from wpdc_gwcs.robust import robust_sigma

__all__ = ["WPDCFitter"]


class WPDCFitter(Fitter):
    r"""Distance-weighted linear least squares for models of two inputs and two outputs.

    Parameters
    ----------
    weight : RadialWeight, optional
        Weight of a star by its distance from the reference point.  Default: uniform.
    pixel_scale : float or (2, 2) array_like, optional
        Size of a pixel in the unit of ``xi`` and ``eta``, or the CD matrix: the distance from the
        reference point is ``hypot(CD^-1 (xi, eta))`` px.  Not needed for uniform weights, or if
        ``distance`` is given with the data.
    robust : {None, 'clip', 'huber'}, optional
        Treatment of outliers: none, iterative clipping, or Huber weights.
    clip : float, optional
        Limit in robust standard deviations (1.4826 times the median absolute residual).  Beyond it,
        a star is left out (``clip``), or its weight decreases with its residual (``huber``).
    damping : float, optional
        Fraction of a correction that is applied before the stars are matched again, 0 to 1.  Only
        used with ``rematch``.
    rematch : callable, optional
        ``rematch(model)`` matches the stars again, with the corrected positions, and returns the
        data ``(xi, eta, xi_ref, eta_ref)`` or ``(xi, eta, xi_ref, eta_ref, weights)``.  The result
        is the undamped optimum of the last matches.
    max_iterations : int, optional
        Greatest number of damped corrections, and of robust iterations in each solution.
    calc_uncertainties : bool, optional
        Whether to attach ``cov_matrix`` and ``stds`` to the returned model, as the fitters of
        astropy do.

    Attributes
    ----------
    fit_info : dict
        Results of the last call: ``covariance`` of the free parameters (with ``param_names``),
        ``rank``, ``condition``, ``iterations`` (re-matchings), ``robust_iterations``,
        ``converged``, ``n_used``, ``used`` (mask of the stars kept), ``rms`` and ``scatter`` of the
        residuals of each output, ``chi2``, ``residuals`` ``(2, N)``.

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    Minimizes :math:`\sum w(r_i) \Delta_i^2 / \sigma_i^2` for each output, with ``weights`` =
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
        # The optimizer and the statistic of the base class are for non-linear fits only.
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
            Reference positions in the same unit.
        weights : float, (N,) or (2, N) array_like, optional
            1/sigma of each star, or of each output and star.  Default: 1.
        distance : (N,) array_like, optional
            Distance from the reference point in px.  Default: computed with ``pixel_scale``.
        inplace : bool, optional
            Whether to change the given model instead of a copy.

        Returns
        -------
        `~astropy.modeling.FittableModel`
            Copy of the model with the fitted parameters.

        Raises
        ------
        FitError
            If the data contain NaN, are fewer than the free coefficients, or do not determine them.
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
        # The damped model is still off by a factor (1 - damping)^n of the initial error, so its
        # matches may differ from those of the optimum.
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
            normalized = np.abs(residual * inverse_sigma)
            # The scale is that of the stars that the fit represents: outside r0, the polynomial is
            # an extrapolation.
            core = radial > 0.5 if np.sum(radial > 0.5) > free.sum() else radial > 0
            sigma = np.array(
                [robust_sigma(a[core & (s > 0)]) for a, s in zip(normalized, inverse_sigma)]
            )
            limit = self.clip * np.maximum(sigma, np.finfo(float).tiny)[:, None]
            if self.robust == "clip":
                keep = np.all(
                    normalized <= np.maximum(limit, 1e-12 * np.abs(target * inverse_sigma).max()),
                    axis=0,
                )
                converged = np.array_equal(keep, used)
                used = keep
            else:
                before = down
                down = limit / np.maximum(normalized, limit)
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
    # The flag of astropy says "not linear" for every compound model, so test the model itself.
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
    """Split the problem if no parameter acts on both outputs: two small QRs, not a large one."""
    acts = np.any(design != 0, axis=1)
    if np.any(acts[0] & acts[1]):
        return [(np.array([True, True]), np.ones(design.shape[2], bool))]
    groups = [(np.array([True, False]), acts[0]), (np.array([False, True]), ~acts[0])]
    return [(outputs, columns) for outputs, columns in groups if np.any(columns)]


def _same_matches(data, before):
    return all(a.shape == b.shape and np.array_equal(a, b) for a, b in zip(data, before))
