"""Phase 1 as in the paper: the weighted polynomial of one exposure, in damped steps."""

from dataclasses import dataclass

import numpy as np

from wpdc_gwcs.exceptions import FitError
from wpdc_gwcs.fitting import WPDCFitter
from wpdc_gwcs.models import PVPolynomial, project
from wpdc_gwcs.solve import Exposure

__all__ = ["DAMPING", "MAX_STEPS", "ExposurePolynomial", "fit_exposure"]

#: Fraction of each correction that is applied, and largest number of steps, as in the paper.
DAMPING, MAX_STEPS = 0.5, 10
# "Until the positional residuals converge": positions have moved by less than this, px rms.
_AT_REST = 1e-3


@dataclass(frozen=True, eq=False)
class ExposurePolynomial:
    """Polynomial of one exposure, about the tangent point of its header.

    Parameters
    ----------
    exposure : Exposure
        The exposure, with its pairs from the last match.
    crpix : (2,) ndarray
        Reference point, px, zero based.
    pv : PVPolynomial
        Polynomial for the matrix of the header, with constant and linear terms.
    covariance : (n, n) ndarray
        Covariance of its coefficients, first those of x, then those of y.
    steps : int
        Number of damped steps.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs import RadialWeight
    >>> from wpdc_gwcs.models import deproject
    >>> from wpdc_gwcs.paper import fit_exposure
    >>> from wpdc_gwcs.solve import Exposure
    >>> x, y = np.random.default_rng(1).uniform(0, 999, (2, 500))
    >>> cd = np.diag([-1e-4, 1e-4])
    >>> sky = deproject(*(cd @ [x - 500 + 1.024, y - 500]), (10.0, 20.0))
    >>> exposure = Exposure("a", x, y, *sky, crval=(10.0, 20.0), cd=cd)
    >>> fit = fit_exposure(exposure, (500.0, 500.0), weight=RadialWeight("w1", r0=435))
    >>> round(float(fit.pv.pv1_0.value / cd[0, 0]), 3)  # of the 1.024 px that were put in
    1.023
    >>> fit.correct(100.0, 200.0)[0].round(3)
    array([101.023, 200.   ])
    """

    exposure: Exposure
    crpix: np.ndarray
    pv: PVPolynomial
    covariance: np.ndarray
    steps: int

    def correct(self, x, y):
        """Remove the distortion that the polynomial describes.

        Parameters
        ----------
        x, y : (N,) array_like
            Detector pixels, zero based.

        Returns
        -------
        (2, N) ndarray
            X' and Y', undistorted px.
        """
        return _corrected(self.pv, self.exposure.cd, self.crpix, x, y)

    def residuals(self):
        """Compute the residuals of the pairs, X' - X_ref and Y' - Y_ref.

        Returns
        -------
        (2, N) ndarray
            Residuals, px; NaN where a position is NaN.
        """
        return self.correct(self.exposure.x, self.exposure.y) - _reference(
            self.exposure, self.crpix
        )

    @property
    def used(self):
        """Mask of the pairs used in the fit: allowed and finite."""
        return _usable(self.exposure)

    def variance(self, x, y):
        """Compute the covariance of corrected positions from the scatter of the stars in the fit.

        Parameters
        ----------
        x, y : (N,) array_like
            Detector pixels, zero based.

        Returns
        -------
        (2, 2, N) ndarray
            Covariances, px2.
        """
        cd = np.asarray(self.exposure.cd)
        inverse = np.linalg.inv(cd)
        n = len(self.covariance) // 2
        columns = self.pv.design_matrix(*(cd @ _offset(self.crpix, x, y)))
        blocks = self.covariance[:n, :n], self.covariance[n:, n:]
        own = [np.einsum("ij,jk,ik->i", c, v, c) for c, v in zip(columns, blocks, strict=True)]
        return np.einsum("ik,jk,kn->ijn", inverse, inverse, np.array(own))


def fit_exposure(exposure, crpix, *, weight, degree=3, rematch=None):
    """Fit the distance-weighted polynomial of one exposure, as the paper does.

    Parameters
    ----------
    exposure : Exposure
        Pairs, and the header's ``crval`` and ``cd``.
    crpix : (2,) array_like
        Reference point, px, zero based.
    weight : RadialWeight
        Weight of a star by its distance from the reference point.
    degree : int, optional
        Degree of the polynomial, 1 to 7; 3 in the paper.
    rematch : callable, optional
        ``rematch(correct)`` matches the stars again and returns an `Exposure` with the new pairs,
        where ``correct(x, y)`` returns corrected positions.  Default: the pairs do not change.

    Returns
    -------
    ExposurePolynomial
        The polynomial after the last step.

    Raises
    ------
    FitError
        If there are too few stars within ``r0``, or if they do not determine the polynomial.

    Notes
    -----
    Starting from the identity, each step adds half of the correction that a weighted least-squares
    fit finds.  There are at most ten steps, and none after a step that moves the positions by less
    than 0.001 px (rms).  After ten steps, 1/1024 of the distortion is left: 0.2 px of 200 px.  The
    errors of the positions are not used.

    References
    ----------
    WPDC-2P, arXiv:2603.09193, section 3.2.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs import RadialWeight
    >>> from wpdc_gwcs.models import deproject
    >>> from wpdc_gwcs.paper import fit_exposure
    >>> from wpdc_gwcs.solve import Exposure
    >>> x, y = np.random.default_rng(1).uniform(0, 999, (2, 500))
    >>> cd = 1e-4 * np.array([[-1, 0], [0, 1]])
    >>> sky = deproject(*(cd @ [x - 500 + 1.024, y - 500]), (10.0, 20.0))
    >>> exposure = Exposure("a", x, y, *sky, crval=(10.0, 20.0), cd=cd)
    >>> fit = fit_exposure(exposure, (500.0, 500.0), weight=RadialWeight("w1", r0=435))
    >>> fit.steps, float(np.abs(fit.residuals()).max().round(4))
    (10, 0.001)
    """
    crpix = np.asarray(crpix, float)
    fitter = WPDCFitter(weight=weight, pixel_scale=exposure.cd)
    pv = PVPolynomial(degree)
    for step in range(1, MAX_STEPS + 1):  # noqa: B007
        place = _corrected(pv, exposure.cd, crpix, exposure.x, exposure.y)
        optimum = _fit(fitter, pv, exposure, crpix, weight)
        before = pv.parameters.copy()
        pv = pv.copy()
        pv.parameters = before + DAMPING * (optimum.parameters - before)
        moved = _corrected(pv, exposure.cd, crpix, exposure.x, exposure.y) - place
        if step == MAX_STEPS or np.sqrt(np.nanmean(moved**2)) < _AT_REST:
            break
        if rematch is not None:
            exposure = rematch(_Correction(pv, exposure.cd, crpix))
    return ExposurePolynomial(exposure, crpix, pv, fitter.fit_info["covariance"], step)


@dataclass(frozen=True, eq=False)
class _Correction:
    """Return the correction by a polynomial as a function of positions."""

    pv: PVPolynomial
    cd: np.ndarray
    crpix: np.ndarray

    def __call__(self, x, y):
        return _corrected(self.pv, self.cd, self.crpix, x, y)


def _fit(fitter, pv, exposure, crpix, weight):
    used = _usable(exposure)
    offset = _offset(crpix, exposure.x, exposure.y)[:, used]
    n_terms = len(pv.term_indices)
    inside = int(np.sum(np.hypot(*offset) <= weight.r0)) if weight.name != "uniform" else used.sum()
    if inside <= n_terms:
        where = "" if weight.name == "uniform" else f" within r0 = {weight.r0:.6g} px"
        raise FitError(
            f"a polynomial of degree {pv.degree} needs more than {n_terms} stars{where} in every "
            f"exposure with method='paper', has {inside}"
        )
    cd = np.asarray(exposure.cd)
    reference = np.array(project(exposure.ra, exposure.dec, exposure.crval))[:, used]
    return fitter(pv, *(cd @ offset), *reference)


def _usable(exposure):
    columns = (exposure.x, exposure.y, exposure.ra, exposure.dec)
    good = np.isfinite(np.array(columns, float)).all(axis=0)
    return good if exposure.use is None else good & np.asarray(exposure.use, bool)


def _offset(crpix, x, y):
    return np.array([np.asarray(x, float) - crpix[0], np.asarray(y, float) - crpix[1]])


def _corrected(pv, cd, crpix, x, y):
    plane = np.array(pv(*(cd @ _offset(crpix, x, y))))
    return np.linalg.solve(cd, plane) + np.reshape(crpix, (2, 1))


def _reference(exposure, crpix):
    plane = np.array(project(exposure.ra, exposure.dec, exposure.crval))
    return np.linalg.solve(exposure.cd, plane) + np.reshape(crpix, (2, 1))
