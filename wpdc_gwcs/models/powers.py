"""Polynomials of the plane in powers of both coordinates: expanded, fitted, differentiated."""

import math

import numpy as np

from wpdc_gwcs.models.terms import pv_terms

__all__ = ["derivative", "expand_pv", "fit_polynomial", "shift_origin"]


def _linear_power(coefficients, power):
    """Coefficients of ``(c0 a + c1 b)**power`` by the power of ``a``, lowest first."""
    c0, c1 = coefficients
    return np.array([math.comb(power, i) * c0**i * c1 ** (power - i) for i in range(power + 1)])


def expand_pv(coefficients, degree, radial, matrix):
    """Expand a PV polynomial of ``matrix @ (u, v)`` into powers of u and v.

    Parameters
    ----------
    coefficients : (2, n_terms) ndarray
        In the order of `~wpdc_gwcs.models.pv_terms`.
    degree : int
        Degree of the polynomial.
    radial : bool
        Whether radial terms are among the coefficients.
    matrix : (2, 2) ndarray
        Linear map from (u, v) to (xi, eta).

    Returns
    -------
    polynomial : (2, degree + 1, degree + 1) ndarray
        ``polynomial[k, p, q]`` multiplies ``u**p v**q`` in output k.
    radial_polynomial : (2, degree + 1) ndarray or None
        ``radial_polynomial[k, s]`` multiplies ``r**s`` in output k; `None` without radial terms.
    """
    terms = pv_terms(degree, radial)
    n = degree + 1
    polynomial = np.zeros((2, n, n))
    in_radius = np.zeros((2, n))
    powers = [[_linear_power(row, p) for p in range(n)] for row in matrix]
    for axis in (0, 1):
        own_powers, other_powers = powers[axis], powers[1 - axis]
        for value, own, other, radius in zip(
            coefficients[axis], terms.own, terms.other, terms.radius, strict=True
        ):
            if value == 0.0:
                continue
            if radius:
                in_radius[axis, radius] += value
                continue
            total = own + other
            homogeneous = np.convolve(own_powers[own], other_powers[other])
            polynomial[axis, np.arange(total + 1), total - np.arange(total + 1)] += (
                value * homogeneous
            )
    return polynomial, (in_radius if in_radius.any() else None)


def fit_polynomial(points, values, degree, weights=None):
    """Fit a map of the plane by polynomials.

    Parameters
    ----------
    points, values : (2, N) array_like
        Points and their images.
    degree : int
        Total degree.
    weights : (N,) ndarray, optional
        Weights of the squared errors; all the same by default.

    Returns
    -------
    polynomial : (2, degree + 1, degree + 1) ndarray
        ``polynomial[k, p, q]`` multiplies ``u**p v**q`` in output k, where (u, v) is the point
        minus the origin.
    origin : (float, float)
        Center of the points.
    """
    origin = tuple(0.5 * (point.min() + point.max()) for point in points)
    # Scaled for the solution only: later, floating-point powers lose no accuracy.
    scale = 0.5 * max(np.ptp(point) for point in points)
    u, v = ((point - center) / scale for point, center in zip(points, origin, strict=True))
    powers = [(p, q) for p in range(degree + 1) for q in range(degree + 1 - p)]
    matrix = np.stack([u**p * v**q for p, q in powers], axis=1)
    values = np.stack(values, axis=1)
    if weights is not None:
        root = np.sqrt(weights)[:, np.newaxis]
        matrix, values = matrix * root, values * root
    fit = np.linalg.lstsq(matrix, values, rcond=None)[0]
    polynomial = np.zeros((2, degree + 1, degree + 1))
    for (p, q), pair in zip(powers, fit, strict=True):
        polynomial[:, p, q] = pair / scale ** (p + q)
    return polynomial, origin


def shift_origin(polynomial, origin):
    """Rewrite polynomials about an origin as polynomials about zero.

    Parameters
    ----------
    polynomial : (2, n, n) ndarray
        ``polynomial[k, p, q]`` multiplies ``(u - origin[0])**p (v - origin[1])**q``.
    origin : (float, float)
        The origin.

    Returns
    -------
    polynomial : (2, n, n) ndarray
        The same in powers of u and v.
    """
    n = polynomial.shape[1]
    shifts = [
        [
            [math.comb(p, a) * (-center) ** (p - a) if a <= p else 0.0 for p in range(n)]
            for a in range(n)
        ]
        for center in origin
    ]
    return np.einsum("ap,bq,kpq->kab", *map(np.array, shifts), polynomial)


def derivative(coefficients, axis):
    """Differentiate a polynomial of the plane.

    Parameters
    ----------
    coefficients : (n, n) ndarray
        ``coefficients[p, q]`` multiplies ``u**p v**q``.
    axis : int
        0 for the derivative with respect to u, 1 for that with respect to v.

    Returns
    -------
    derivative : (n - 1, n - 1) ndarray
        Coefficients of the derivative, (1, 1) for n = 1.
    """
    n = len(coefficients)
    if n == 1:
        return np.zeros((1, 1))
    factors = np.arange(1.0, n)
    if axis == 0:
        return coefficients[1:, : n - 1] * factors[:, np.newaxis]
    return coefficients[: n - 1, 1:] * factors
