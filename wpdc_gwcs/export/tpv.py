"""TPV: the polynomial of a calibration itself, or one fitted to the whole mapping.

::

    sky = TAN^-1( PV(U) ) about CRVAL,    U = CD (x - CRPIX)
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from wpdc_gwcs.exceptions import FileFormatError
from wpdc_gwcs.export.cards import linear_cards, number_card
from wpdc_gwcs.export.exact import (
    astropy_sky,
    description,
    deviation,
    image_shape_of,
    require_shape,
    sample_plane,
)
from wpdc_gwcs.export.levelling import levelling_weights
from wpdc_gwcs.export.swarp import nearer_linear_part, step_errors
from wpdc_gwcs.models import LookupTable, PVPolynomial, pv_terms
from wpdc_gwcs.models.attitude import fold_attitude
from wpdc_gwcs.models.powers import fit_polynomial, shift_origin

__all__ = ["TpvFit", "fit_tpv", "fold_polynomial", "nearest_polynomial", "refit", "tpv_keywords"]

# A fit this good (px) is good enough; a higher degree would only be harder to read.
_ENOUGH_PX = 1e-3
# If no fit is that good: how much worse than the best one a lower degree may be, and how much
# worse in SWarp.
_AS_GOOD, _NEARLY = 1.02, 1.1
_DEGREES = range(1, 8)
# Nodes along each axis of a table for the residuals of a polynomial, if there was no table.
_TABLE_NODES = 50


class TpvFit(NamedTuple):
    """TPV fitted to a mapping.

    It has ``crpix`` (px, zero based), ``cd`` (deg / px), the polynomial ``pv`` that follows them,
    and the largest deviations from the exact WCS in px: ``deviation`` for exact readers, and
    ``swarp_deviation`` for SWarp, which goes from sky to pixel in three steps.  They are `None` if
    they are unknown, for example because the shape of the detector is.
    """

    crpix: np.ndarray
    cd: np.ndarray
    pv: PVPolynomial
    deviation: float | None
    swarp_deviation: float | None


def fold_polynomial(obj):
    """Return the polynomial of a calibration for the matrix of its exposure.

    Parameters
    ----------
    obj : Calibration or DistortionSolution
        What is exported.

    Returns
    -------
    pv : PVPolynomial
        ``PV(U) = A PV0(A^-1 U)``, ``A = CD CD0^-1``; exact.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs import Calibration, DistortionSolution, PVPolynomial
    >>> from wpdc_gwcs.export import fold_polynomial
    >>> cd, crpix, crval = np.diag([-8e-5, 8e-5]), np.array([511.5, 511.5]), np.array([10.0, 45.0])
    >>> solution = DistortionSolution("d1", (1024, 1024), crpix, cd, crval, PVPolynomial(pv1_7=4.0))
    >>> quarter_turn = np.array([[0, -1], [1, 0]]) @ cd
    >>> pv = fold_polynomial(Calibration("a", solution, crval=crval, cd=quarter_turn))
    >>> float(pv.pv1_7.value), round(float(pv.pv2_7.value), 9)  # the axes have changed places
    (0.0, 4.0)
    """
    exact = description(obj)
    nominal = np.asarray(exact.solution.cd)
    if np.array_equal(exact.cd, nominal):
        return exact.solution.pv
    return fold_attitude(exact.solution.pv, np.linalg.solve(nominal.T, exact.cd.T).T)


def tpv_keywords(obj, pv, *, crpix=None, cd=None):
    """Return the header of a polynomial.

    Parameters
    ----------
    obj : Calibration or DistortionSolution
        Source of CRVAL, and of CRPIX and CD by default.
    pv : PVPolynomial
        The polynomial.
    crpix : (2,) array_like, optional
        Reference point before the polynomial, px, zero based.
    cd : (2, 2) array_like, optional
        Matrix before the polynomial, deg / px.

    Returns
    -------
    header : `~astropy.io.fits.Header`
        Header; all numbers have 17 digits.
    """
    exact = description(obj)
    crpix = exact.solution.crpix if crpix is None else crpix
    header = linear_cards("TPV", crpix, exact.cd if cd is None else cd, exact.crval)
    for axis in (1, 2):
        for j, value in zip(pv.term_indices, pv.coefficients[axis - 1], strict=True):
            header.append(number_card(f"PV{axis}_{j}", value, "[deg] distortion"), end=True)
    return header


def fit_tpv(obj, degree=None):
    """Fit a TPV to the whole mapping, including the look-up table.

    Parameters
    ----------
    obj : Calibration or DistortionSolution
        What is exported.
    degree : int, optional
        Degree, 1 to 7; see `nearest_polynomial`.

    Returns
    -------
    tpv : TpvFit
        The fit.  CRPIX and CD are those of the exposure, unless SWarp is more accurate with others.

    Raises
    ------
    ValueError
        If the degree is not from 1 to 7.
    """
    exact = description(obj)
    pv, worst = nearest_polynomial(obj, degree)
    plain = TpvFit(np.asarray(exact.solution.crpix), exact.cd, pv, worst, None)
    if image_shape_of(obj) is None:
        return plain
    plain = plain._replace(swarp_deviation=_swarp_deviation(obj, plain))
    left = plain.swarp_deviation
    # Radial terms cannot be moved to another center.
    if pv.radial or (left is not None and left <= max(_NEARLY * worst, _ENOUGH_PX)):
        return plain
    cd, crpix, matrix, offset = nearer_linear_part(
        pv.as_function(), plain.cd, plain.crpix, image_shape_of(obj)
    )
    pixels, _ = sample_plane(obj)
    u = cd @ (pixels - crpix[:, np.newaxis])
    values = np.array(pv(*(matrix @ u + offset[:, np.newaxis])))
    other = TpvFit(crpix, cd, _fit(u, values, pv.degree), None, None)
    other = other._replace(
        deviation=deviation(obj, astropy_sky(tpv_keywords(obj, other.pv, crpix=crpix, cd=cd))),
        swarp_deviation=_swarp_deviation(obj, other),
    )
    if other.swarp_deviation is None or other.deviation > max(_NEARLY * worst, _ENOUGH_PX):
        return plain
    return plain if left is not None and left <= other.swarp_deviation else other


def nearest_polynomial(obj, degree=None):
    """Fit a polynomial to the whole mapping, including the look-up table.

    Parameters
    ----------
    obj : Calibration or DistortionSolution
        What is exported.
    degree : int, optional
        Degree, 1 to 7.  Default: the lowest that is accurate to 1e-3 px everywhere, or else the
        lowest that is nearly as good as any.  Without a table, the polynomial itself is returned.

    Returns
    -------
    pv : PVPolynomial
        Polynomial for the matrix of the exposure.
    deviation : float or None
        Largest deviation from the exact WCS, px; `None` if the shape of the detector is
        unknown.

    Raises
    ------
    ValueError
        If the degree is not from 1 to 7.
    """
    if degree is not None and degree not in _DEGREES:
        raise ValueError(f"degree must be from 1 to 7 for TPV, got {degree}")
    if degree is None and obj.lookup_table is None:
        try:
            pv = fold_polynomial(obj)
        except FileFormatError:
            # Radial terms cannot be sheared, but a polynomial can approximate the result.
            require_shape(obj)
        else:
            return pv, None if image_shape_of(obj) is None else _tpv_deviation(obj, pv)
    exact = description(obj)
    pixels, plane = sample_plane(obj)
    u = exact.cd @ (pixels - np.reshape(exact.solution.crpix, (2, 1)))
    trials = []
    for n in _DEGREES if degree is None else [degree]:
        trials.append(_trial(obj, _fit(u, plane, n)))
        if trials[-1][0] <= _ENOUGH_PX:
            break
        weights = levelling_weights(pixels, np.linalg.solve(exact.cd, plane), n)
        trials[-1] = min(trials[-1], _trial(obj, _fit(u, plane, n, weights)), key=lambda t: t[0])
    best = min(worst for worst, _ in trials)
    limit = max(_AS_GOOD * best, _ENOUGH_PX)
    pv = next(pv for worst, pv in trials if worst <= limit)
    return pv, _tpv_deviation(obj, pv)


def _trial(obj, pv):
    return _tpv_deviation(obj, pv, n=151), pv


def refit(obj, degree):
    """Represent the same mapping by a polynomial of another degree and a table of its residuals.

    Parameters
    ----------
    obj : Calibration or DistortionSolution
        What is exported.
    degree : int
        Degree, 1 to 7.

    Returns
    -------
    again : Calibration or DistortionSolution
        The mapping in the new form, with the nodes of the table of ``obj`` or 50 along each axis.
    """
    exact = description(obj)
    ny, nx = require_shape(obj)
    pv, _ = nearest_polynomial(obj, degree)
    table = obj.lookup_table
    if table is None:
        grids = [np.linspace(-0.5, n - 0.5, _TABLE_NODES) for n in (nx, ny)]
    else:
        grids = [table.x_grid, table.y_grid]
    x, y = np.meshgrid(*grids)
    crpix = np.reshape(exact.solution.crpix, (2, 1))
    plane = np.array(pv(*(exact.cd @ (np.array([x.ravel(), y.ravel()]) - crpix))))
    polynomial = np.linalg.solve(exact.cd, plane) + crpix
    dx, dy = (polynomial - obj.undistort(x.ravel(), y.ravel())).reshape(2, *x.shape)
    method = "cubic" if min(x.shape) >= 4 else "linear"
    solution = dataclasses.replace(
        exact.solution, cd=exact.cd, pv=pv, lookup_table=LookupTable(*grids, dx, dy, method=method)
    )
    if exact.solution is obj:
        return solution
    return dataclasses.replace(obj, solution=solution, field=None)


def _tpv_deviation(obj, pv, **options):
    return deviation(obj, astropy_sky(tpv_keywords(obj, pv)), **options)


def _swarp_deviation(obj, tpv, n=101):
    """Greatest distance, in px, between the pixels of SWarp and those of the exact WCS."""
    exact = description(obj)
    ny, nx = image_shape_of(obj)
    x, y = np.meshgrid(np.linspace(-0.5, nx - 0.5, n), np.linspace(-0.5, ny - 0.5, n))
    pixels = np.array([x.ravel(), y.ravel()])
    crpix = np.reshape(exact.solution.crpix, (2, 1))
    plane = exact.cd @ (np.array(obj.undistort(*pixels)) - crpix)
    u = tpv.cd @ (pixels - np.reshape(tpv.crpix, (2, 1)))
    errors = step_errors(tpv.pv, u, plane)
    return None if errors is None else float(np.hypot(*np.linalg.solve(tpv.cd, errors)).max())


def _fit(u, plane, degree, weights=None):
    polynomial = shift_origin(*fit_polynomial(u, plane, degree, weights))
    terms = pv_terms(degree)
    coefficients = np.array(
        [polynomial[0, terms.own, terms.other], polynomial[1, terms.other, terms.own]]
    )
    return PVPolynomial.from_coefficients(coefficients, degree=degree)
