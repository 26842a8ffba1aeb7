"""The field of an exposure: a smooth random displacement of the focal plane.

The atmosphere shifts the stars of one exposure by a few hundredths of a pixel, with correlations
over several arcminutes; focus, filter and flexure bend it.  This is a Gaussian process with a von
Karman spectrum, written as a sum of sine waves on a patch slightly larger than the detector, plus a
few polynomials.  The waves are the shapes of a linear model, and the spectrum is the prior of their
coefficients, so the field is one more term with a prior.

::

    residuals, noise --spectrum by evidence--> `Spectrum`
                     --posterior--> coefficients and covariance --Field--> displacement, variance
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve, lapack

from wpdc_gwcs.solve.basis import Basis, inner_products
from wpdc_gwcs.solve.spectrum import Spectrum

__all__ = ["Field", "fit_field"]


@dataclass(frozen=True, eq=False)
class Field:
    """Posterior of the field over one patch.

    Parameters
    ----------
    basis : Basis
        Waves.
    spectrum : Spectrum
        Prior.
    coefficients : (M,) ndarray
        Coefficients of the columns of the design.
    root : (M, M) ndarray
        Lower factor of the posterior precision in units of the prior.
    freedom : float
        Effective number of parameters for each star behind the field.
    """

    basis: Basis
    spectrum: Spectrum
    coefficients: np.ndarray
    root: np.ndarray
    freedom: float

    def __call__(self, focal):
        """Return the displacement ``(2, N)`` at focal plane positions, px.

        Parameters
        ----------
        focal : (2, N) ndarray
            Focal plane, px.

        Returns
        -------
        ndarray
            Displacement in px of the focal plane.
        """
        shapes = self.basis.shapes(focal, self.spectrum.kind)
        return (self.coefficients @ shapes.reshape(len(shapes), -1)).reshape(2, -1)

    def conditioned(self, focal, rows, focal_stars, star_rows, weight):
        """Return rows of other terms minus the response of the field, and its covariance.

        Parameters
        ----------
        focal : (2, N) ndarray
            Positions of the rows, px.
        rows : (2, N, P) ndarray
            Columns of the other terms there.
        focal_stars : (2, S) ndarray
            Positions of the stars of the field, px.
        star_rows : (2, S, P) ndarray
            Columns of the other terms there.
        weight : (2, S) ndarray
            Inverse variances of the stars.

        Returns
        -------
        rows : (2, N, P) ndarray
            Rows without the part that the field absorbs at the stars.
        covariance : (2, 2, N) ndarray
            Covariance of the field with the other terms fixed, including unresolved waves.
        """
        weight = 1.0 / (1.0 / weight + self.spectrum.unresolved(self.basis))
        waves = self._scaled(focal_stars)
        flat = star_rows.reshape(waves.shape[1], -1)
        right = waves @ (flat * weight.reshape(-1, 1))
        here = self._scaled(focal)
        solved = cho_solve((self.root, True), right, check_finite=False)
        return rows - (here.T @ solved).reshape(rows.shape), self._covariance(here)

    def covariance(self, focal):
        """Return the posterior covariance, including unresolved waves.

        Parameters
        ----------
        focal : (2, N) ndarray
            Focal plane, px.

        Returns
        -------
        (2, 2, N) ndarray
            Covariance in px^2 of the focal plane.
        """
        return self._covariance(self._scaled(focal))

    @property
    def wave(self):
        """Wave vectors ``(2, M)``, rad / px."""
        return self.basis.wave

    def _scaled(self, focal):
        """Shapes in units of their prior, both axes side by side, ``(M, 2 N)``."""
        shapes = self.basis.shapes(focal, self.spectrum.kind)
        root = np.sqrt(self.spectrum.prior(self.basis))
        return shapes.reshape(len(shapes), -1) * root[:, None]

    def _covariance(self, scaled):
        """Covariance at places with these shapes, in units of the prior."""
        half = lapack.dtrtrs(self.root, scaled, lower=1)[0]
        half = half.reshape(len(half), 2, -1)
        covariance = np.einsum("man,mbn->abn", half, half)
        covariance[[0, 1], [0, 1]] += self.spectrum.unresolved(self.basis)
        return covariance


def fit_field(basis, spectrum, focal, residual, variance):
    """Return the posterior of a field with a known spectrum.

    Parameters
    ----------
    basis : Basis
        Waves.
    spectrum : Spectrum
        Prior.
    focal, residual, variance : (2, N) ndarray
        Positions, residuals and their variances without the field, px.

    Returns
    -------
    Field
        Field with its mean and covariance.
    """
    weight = 1.0 / (variance + spectrum.unresolved(basis))
    root = np.sqrt(spectrum.prior(basis))
    parts, right = basis.along(focal, spectrum.kind), np.zeros(len(root))
    for a, (mine, rows) in enumerate(parts):
        rows *= root[mine, None]
        rows *= np.sqrt(weight[a])
        right[mine] += rows @ (np.sqrt(weight[a]) * residual[a])
    inner = inner_products(parts)
    inner[np.diag_indices_from(inner)] += 1.0
    lower, _ = lapack.dpotrf(inner, lower=1, clean=1)
    coefficients = root * lapack.dpotrs(lower, right, lower=1)[0]
    inverse, _ = lapack.dtrtri(lower, lower=1)
    freedom = (len(root) - np.sum(inverse**2)) / max(focal.shape[1], 1)
    # Single precision: a camera has a thousand of these, and errors need no seven digits.
    return Field(basis, spectrum, coefficients, lower.astype(np.float32), float(freedom))
