"""The PV (TPV) polynomial in intermediate world coordinates and its exact inverse."""

from functools import partial
from operator import attrgetter

import numpy as np
from astropy.modeling import FittableModel, Model
from astropy.modeling.parameters import Parameter
from astropy.units import Quantity

from wpdc_gwcs.models.blocks import evaluate_blocks
from wpdc_gwcs.models.mapping import PlaneMap
from wpdc_gwcs.models.powers import expand_pv
from wpdc_gwcs.models.terms import pv_terms

__all__ = ["PVInverse", "PVPolynomial"]

# Residual of the inverse in degrees: 1e-9 px of 0.04 arcsec.
_TOLERANCE_DEG = 1e-14


class PVPolynomial(FittableModel):
    """The PV polynomial of the TPV convention: ``(xi, eta)`` to ``(xi', eta')`` in degrees.

    Parameters
    ----------
    degree : int, optional
        Highest total degree, 1 to 7.
    radial : bool, optional
        Whether the terms in ``r = hypot(xi, eta)`` (indices 3, 11, 23, 39) exist.  They are
        read from headers, never fitted.
    name : str, optional
        Name of the model.
    meta : dict, optional
        Metadata of the model.
    **parameters : float or dict
        Coefficients ``pv1_0``, ``pv1_1``, ..., with FITS indices, and astropy's constraints
        (``fixed``, ``bounds``).  The default is the identity: ``pv1_1 = pv2_1 = 1``, all others 0.

    Raises
    ------
    ValueError
        If the degree is not an integer from 1 to 7.
    TypeError
        If a coefficient does not exist at this degree or is not a plain number.

    Notes
    -----
    At degree 3 (phase 1 of WPDC-2P, equation 1, with two misprints corrected)::

        xi'  = PV1_0 + PV1_1 xi + PV1_2 eta + PV1_4 xi^2 + PV1_5 xi eta + PV1_6 eta^2
                     + PV1_7 xi^3 + PV1_8 xi^2 eta + PV1_9 xi eta^2 + PV1_10 eta^3
        eta' = PV2_0 + PV2_1 eta + PV2_2 xi + PV2_4 eta^2 + PV2_5 xi eta + PV2_6 xi^2
                     + PV2_7 eta^3 + PV2_8 xi eta^2 + PV2_9 xi^2 eta + PV2_10 xi^3

    The `inverse` solves this by Newton's method.

    References
    ----------
    WPDC-2P, arXiv:2603.09193, equation 1; the TPV World Coordinate System,
    https://fits.gsfc.nasa.gov/registry/tpvwcs/tpv.html

    Examples
    --------
    >>> from wpdc_gwcs.models import PVPolynomial
    >>> pv = PVPolynomial(pv1_7=0.5, pv2_7=0.5)
    >>> xi, eta = pv(0.1, 0.2)
    >>> float(xi), float(eta)
    (0.1005, 0.204)
    >>> xi, eta = pv.inverse(xi, eta)
    >>> float(xi), float(eta)
    (0.1, 0.2)
    """

    n_inputs = 2
    n_outputs = 2
    _separable = False
    linear = True

    # Filled by __init__: which parameters there are depends on the degree.
    _param_names = ()

    def __init__(self, degree=3, *, radial=False, name=None, meta=None, **parameters):
        terms = pv_terms(degree, bool(radial))
        self._degree = int(degree)
        self._radial = bool(radial)
        names = tuple(f"pv{axis}_{j}" for axis in (1, 2) for j in terms.index)
        unknown = set(parameters) - set(names) - {"fixed", "bounds", "tied"}
        if unknown:
            raise TypeError(
                f"a PV polynomial of degree {degree} {'with' if radial else 'without'} radial "
                f"terms has no parameter {sorted(unknown)[0]!r}"
            )
        for parameter_name in set(parameters).intersection(names):
            value = parameters[parameter_name]
            if isinstance(value, Quantity) or np.ndim(value):
                raise TypeError(f"{parameter_name} must be a plain number, not {value!r}")
        self._param_names = names
        for parameter_name in names:
            parameter = Parameter(parameter_name, default=float(parameter_name.endswith("_1")))
            parameter.model = self
            self.__dict__[parameter_name] = parameter
        super().__init__(name=name, meta=meta, **parameters)
        self.inputs = ("xi", "eta")
        self.outputs = ("xi_corrected", "eta_corrected")

    @classmethod
    def from_coefficients(cls, coefficients, degree=3, radial=False, **kwargs):  # noqa: FBT002
        """Make a polynomial from an array of coefficients.

        Parameters
        ----------
        coefficients : (2, n_terms) array_like
            Coefficients of each axis in the order of `term_indices`.
        degree : int, optional
            Highest total degree.
        radial : bool, optional
            Whether radial terms are among the coefficients.
        **kwargs
            Passed on: ``name``, ``meta``.

        Returns
        -------
        polynomial : PVPolynomial
            The model.

        Raises
        ------
        ValueError
            If the shape is not ``(2, n_terms)``.
        """
        terms = pv_terms(degree, bool(radial))
        coefficients = np.asarray(coefficients, dtype=float)
        if coefficients.shape != (2, len(terms.index)):
            raise ValueError(
                f"coefficients must have the shape (2, {len(terms.index)}), not "
                f"{coefficients.shape}"
            )
        parameters = {
            f"pv{axis + 1}_{j}": coefficients[axis, k]
            for axis in (0, 1)
            for k, j in enumerate(terms.index)
        }
        return cls(degree, radial=radial, **parameters, **kwargs)

    @property
    def param_names(self):
        """Names of the coefficients, axis 1 first, by FITS index."""
        return self._param_names

    @property
    def degree(self):
        """Highest total degree."""
        return self._degree

    @property
    def radial(self):
        """Whether there are radial terms."""
        return self._radial

    @property
    def term_indices(self):
        """FITS index of each column of `coefficients`."""
        return pv_terms(self._degree, self._radial).index

    @property
    def coefficients(self):
        """Coefficients as a (2, n_terms) array in the order of `term_indices` (a copy)."""
        return np.array(self.parameters).reshape(2, -1)

    def _values(self):
        """Return all coefficients, quickly, to tell whether they are still the same."""
        return [parameter.value for parameter in attrgetter(*self._param_names)(self)]

    def _plane_map(self, coefficients):
        polynomial, radial = expand_pv(coefficients, self._degree, self._radial, np.eye(2))
        return PlaneMap(polynomial, radial=radial)

    def evaluate(self, xi, eta, *coefficients):
        """Evaluate the polynomial.

        Parameters
        ----------
        xi, eta : array_like
            Intermediate world coordinates in degrees.
        *coefficients : float
            All coefficients, axis 1 first.

        Returns
        -------
        xi, eta : ndarray
            Corrected coordinates in degrees.
        """
        coefficients = np.array([np.ravel(c)[0] for c in coefficients], dtype=float)
        return evaluate_blocks(self._plane_map(coefficients.reshape(2, -1)).evaluate, xi, eta)

    def as_function(self):
        """Return the polynomial as it is now as a plain function, without the overhead of a model.

        Returns
        -------
        function : callable
            ``function(xi, eta)`` returns both outputs.

        Examples
        --------
        >>> from wpdc_gwcs.models import PVPolynomial
        >>> xi, eta = PVPolynomial(2).as_function()([2.0], [3.0])
        >>> float(xi[0]), float(eta[0])
        (2.0, 3.0)
        """
        return partial(evaluate_blocks, self._plane_map(self.coefficients).evaluate)

    def design_matrix(self, xi, eta):
        """Return the derivatives of both outputs by their coefficients, as columns in FITS order.

        Parameters
        ----------
        xi, eta : (N,) array_like
            Intermediate world coordinates in degrees.

        Returns
        -------
        matrices : (A1, A2)
            Each (N, n_terms): ``xi' = A1 @ coefficients[0]`` and ``eta' = A2 @ coefficients[1]``.

        Examples
        --------
        >>> from wpdc_gwcs.models import PVPolynomial
        >>> a1, a2 = PVPolynomial(2).design_matrix([2.0], [3.0])
        >>> a1.tolist(), a2.tolist()
        ([[1.0, 2.0, 3.0, 4.0, 6.0, 9.0]], [[1.0, 3.0, 2.0, 9.0, 6.0, 4.0]])
        """
        xi, eta = (np.ravel(np.asarray(value, dtype=float)) for value in (xi, eta))
        xi, eta = np.broadcast_arrays(xi, eta)
        terms = pv_terms(self._degree, self._radial)
        matrices = []
        xi_powers, eta_powers = (
            np.vander(value, self._degree + 1, increasing=True) for value in (xi, eta)
        )
        radius = np.sqrt(xi * xi + eta * eta) if self._radial else None
        for own, other in ((xi_powers, eta_powers), (eta_powers, xi_powers)):
            matrix = own[:, terms.own] * other[:, terms.other]
            if self._radial:
                matrix *= radius[:, np.newaxis] ** terms.radius
            matrices.append(matrix)
        return tuple(matrices)

    def jacobian(self, xi, eta):
        """Return the derivatives of both outputs by both inputs.

        Parameters
        ----------
        xi, eta : array_like
            Intermediate world coordinates in degrees.

        Returns
        -------
        jacobian : (2, 2, ...) ndarray
            ``jacobian[i, j]`` is the derivative of output i by input j.
        """
        plane_map = self._plane_map(self.coefficients)
        rows = evaluate_blocks(plane_map.jacobian, xi, eta, n_outputs=6)[2:]
        return np.array(rows).reshape(2, 2, *rows[0].shape)

    @property
    def inverse(self):
        """The exact inverse, by Newton's method (a `PVInverse`)."""
        return PVInverse(self)


class PVInverse(Model):
    """The inverse of a `PVPolynomial`, accurate to rounding, by Newton's method.

    The result is NaN if the iteration finds no solution with a vanishing residual.

    Parameters
    ----------
    polynomial : PVPolynomial
        The polynomial to invert.
    **kwargs
        ``name`` and ``meta`` of the model.

    Examples
    --------
    >>> from wpdc_gwcs.models import PVPolynomial
    >>> inverse = PVPolynomial(pv1_7=0.5).inverse
    >>> type(inverse).__name__
    'PVInverse'
    >>> xi, eta = inverse([0.1005, -0.2], [0.0, 0.0])
    >>> xi.round(6).tolist()
    [0.1, -0.196222]
    """

    n_inputs = 2
    n_outputs = 2
    _separable = False

    # astropy takes a model without Parameters for one that wants Quantities.
    uses_quantity = False

    def __init__(self, polynomial, **kwargs):
        self.polynomial = polynomial
        super().__init__(**kwargs)
        self.inputs = ("xi_corrected", "eta_corrected")
        self.outputs = ("xi", "eta")

    def evaluate(self, xi, eta):
        """Invert the polynomial.

        Parameters
        ----------
        xi, eta : array_like
            Corrected coordinates in degrees.

        Returns
        -------
        xi, eta : ndarray
            Intermediate world coordinates in degrees.
        """
        plane_map = self.polynomial._plane_map(self.polynomial.coefficients)
        return evaluate_blocks(plane_map.inverse(tolerance=_TOLERANCE_DEG), xi, eta)

    @property
    def inverse(self):
        """The polynomial (a copy)."""
        return self.polynomial.copy()
