"""Conversion of a PV polynomial to the axes of another attitude."""

import numpy as np

from wpdc_gwcs.exceptions import FileFormatError
from wpdc_gwcs.models.polynomial import PVPolynomial
from wpdc_gwcs.models.powers import expand_pv
from wpdc_gwcs.models.terms import pv_terms

__all__ = ["fold_attitude"]


def fold_attitude(pv, matrix):
    """Rewrite a PV polynomial for other axes.

    Parameters
    ----------
    pv : `~wpdc_gwcs.models.PVPolynomial`
        Polynomial in U.
    matrix : (2, 2) ndarray
        A.

    Returns
    -------
    folded : `~wpdc_gwcs.models.PVPolynomial`
        The polynomial PV' with ``PV'(U) = A PV(A^-1 U)``, of the same degree.

    Raises
    ------
    FileFormatError
        If there are radial terms and A does more than turn, mirror and scale.
    """
    matrix = np.asarray(matrix, float)
    if np.array_equal(matrix, np.eye(2)):
        return pv
    polynomial, radial = expand_pv(pv.coefficients, pv.degree, pv.radial, np.linalg.inv(matrix))
    polynomial = np.einsum("ij,jpq->ipq", matrix, polynomial)
    length = np.sqrt(abs(np.linalg.det(matrix)))
    if radial is not None:
        if not np.allclose(
            matrix @ matrix.T, length**2 * np.eye(2), rtol=0, atol=1e-12 * length**2
        ):
            raise FileFormatError(
                "a PV polynomial with radial terms can only be rotated and scaled as a whole, "
                f"got the matrix {matrix.tolist()}"
            )
        radial = (matrix @ radial) * length ** -np.arange(radial.shape[1], dtype=float)
    terms = pv_terms(pv.degree, pv.radial)
    coefficients = np.zeros((2, len(terms.index)))
    for k, (own, other, power) in enumerate(zip(terms.own, terms.other, terms.radius, strict=True)):
        if power:
            coefficients[:, k] = 0.0 if radial is None else radial[:, power]
        else:
            coefficients[:, k] = polynomial[0, own, other], polynomial[1, other, own]
    return PVPolynomial.from_coefficients(coefficients, degree=pv.degree, radial=pv.radial)
