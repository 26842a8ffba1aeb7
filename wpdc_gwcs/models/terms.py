"""The one table of PV terms: which power of what each FITS ``PVi_j`` multiplies."""

from functools import cache
from typing import NamedTuple

import numpy as np

__all__ = ["MAX_DEGREE", "PVTerms", "pv_terms"]

#: Highest degree of the TPV convention.
MAX_DEGREE = 7

# FITS index of the radial term r**s.  They are between the polynomial terms: no formula.
_RADIAL_INDEX = {1: 3, 3: 11, 5: 23, 7: 39}


class PVTerms(NamedTuple):
    """Terms of a PV polynomial, in the order of their FITS index.

    Term ``k`` of axis ``i`` is ``PVi_{index[k]} * a**own[k] * b**other[k] * r**radius[k]``, where
    ``a`` is the coordinate of axis ``i`` itself (xi for axis 1, eta for axis 2), ``b`` that of the
    other axis and ``r = hypot(xi, eta)``.

    Examples
    --------
    >>> from wpdc_gwcs.models import pv_terms
    >>> terms = pv_terms(3)
    >>> k = terms.index.tolist().index(8)
    >>> int(terms.own[k]), int(terms.other[k])  # PV1_8 is the coefficient of xi^2 eta
    (2, 1)
    """

    index: np.ndarray
    own: np.ndarray
    other: np.ndarray
    radius: np.ndarray


@cache
def pv_terms(degree, radial=False):  # noqa: FBT002
    """Return the PV terms up to a degree.

    Parameters
    ----------
    degree : int
        Highest total degree, 1 to 7.
    radial : bool, optional
        Whether the radial terms (``r``, ``r**3``, ``r**5``, ``r**7``: indices 3, 11, 23, 39) are
        included.

    Returns
    -------
    terms : PVTerms
        Named tuple of read-only integer arrays ``index, own, other, radius``.

    Raises
    ------
    ValueError
        If the degree is not an integer from 1 to 7.

    Notes
    -----
    The order is that of the TPV convention: ``a``, ``b``, ``r``; ``a**2``, ``a b``, ``b**2``;
    ``a**3``, ... (https://fits.gsfc.nasa.gov/registry/tpvwcs/tpv.html).

    Examples
    --------
    >>> from wpdc_gwcs.models import pv_terms
    >>> terms = pv_terms(2)
    >>> terms.index.tolist(), terms.own.tolist(), terms.other.tolist()
    ([0, 1, 2, 4, 5, 6], [0, 1, 0, 2, 1, 0], [0, 0, 1, 0, 1, 2])
    >>> pv_terms(1, radial=True).index.tolist()
    [0, 1, 2, 3]
    """
    if degree != int(degree) or not 1 <= degree <= MAX_DEGREE:
        raise ValueError(f"degree must be an integer from 1 to {MAX_DEGREE}, not {degree!r}")
    rows = []
    index = 0
    for total in range(int(degree) + 1):
        for other in range(total + 1):
            rows.append((index, total - other, other, 0))
            index += 1
        if total in _RADIAL_INDEX:
            if radial:
                rows.append((index, 0, 0, total))
            index += 1
    columns = np.array(rows).T.copy()
    columns.flags.writeable = False
    return PVTerms(*columns)
