"""Weighted least squares for the position and flux of many stars at once."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.ndimage import percentile_filter

from wpdc_gwcs import kernels
from wpdc_gwcs.cutouts import cut_squares, on_image
from wpdc_gwcs.threads import map_threads

__all__ = [
    "Field",
    "StarFits",
    "Stars",
    "fit_radius",
    "fit_stars",
    "normal_step",
    "star_like",
]

# Number of stars fitted at a time, which limits the memory for their pixels.
_CHUNK = 4000

_MAX_STEP = 0.5  # px per iteration
_MAX_ITERATIONS = 12
_CONVERGED = 1e-4  # px


class Sky(NamedTuple):
    """Noise of the background in pixels.

    Parameters
    ----------
    variance : (N, n) ndarray
        Variance.
    photons : (N, n) ndarray or float
        Variance of photons relative to that from the gain, for pixels that differ in response.
    """

    variance: np.ndarray
    photons: np.ndarray | float

    def take(self, rows):
        """Background of the given rows."""
        photons = self.photons
        return Sky(self.variance[rows], photons if np.isscalar(photons) else photons[rows])


@dataclass(frozen=True, eq=False)
class Field:
    """Pixels to fit.

    Parameters
    ----------
    image, rms : (ny, nx) ndarray
        Image without background, and the noise of the background.
    mask : (ny, nx) bool ndarray or None
        True where a pixel must not be used.
    photons : (ny, nx) ndarray or None
        As in `Sky`; None for pixels of one response.
    full : (ny, nx) bool ndarray or None
        True where a pixel is saturated, and must not be used either.
    """

    image: np.ndarray
    rms: np.ndarray
    mask: np.ndarray | None
    photons: np.ndarray | None = None
    full: np.ndarray | None = None

    def cut(self, stars, half, radius):
        """Make cut-outs around stars.

        Parameters
        ----------
        stars : Stars
            N stars.
        half : int
            The cut-outs are 2 half + 1 px wide.
        radius : float
            Radius in px of the pixels to use.

        Returns
        -------
        xc, yc : (N,) int ndarray
            Central pixels.
        pixels : (N, n) ndarray
            Values.
        use : (N, n) bool ndarray
            True where a pixel is on the image, good and within the radius.
        sky : Sky
            Noise of the background.
        """
        xc, yc = np.rint(stars.x).astype(int), np.rint(stars.y).astype(int)
        step = np.arange(-half, half + 1)

        def cut(image):
            return cut_squares(image, xc, yc, half).reshape(len(xc), len(step) ** 2)

        use = on_image(self.image.shape, xc, yc, half) & (np.hypot(step[:, None], step) <= radius)
        use = use.reshape(len(xc), len(step) ** 2)
        for hidden in (self.mask, self.full):
            if hidden is not None:
                use &= ~cut(hidden)
        variance = cut(self.rms).astype(float) ** 2
        photons = 1.0 if self.photons is None else cut(self.photons)
        return xc, yc, cut(self.image).astype(float), use, Sky(variance, photons)


class Stars(NamedTuple):
    """Positions in px and fluxes in counts, (N,) ndarrays."""

    x: np.ndarray
    y: np.ndarray
    flux: np.ndarray

    def take(self, rows):
        """Stars of the given rows."""
        return Stars(*(column[rows] for column in self))

    def light(self, profile, xc, yc, half):
        """Evaluate the models of the stars in their cut-outs.

        Parameters
        ----------
        profile : Profile
            The PSF.
        xc, yc : (N,) int ndarray
            Central pixels.
        half : int
            The cut-outs are 2 half + 1 px wide.

        Returns
        -------
        (N, n) ndarray
            Counts.
        """
        shares = profile.shares(self.x, self.y)
        value = profile.evaluate(self.x - xc, self.y - yc, half, shares, gradient=False)[0]
        return np.multiply(value, self.flux[:, None], out=value)


@dataclass(frozen=True, eq=False)
class StarFits:
    """Result of `fit_stars`: one entry per star.

    Parameters
    ----------
    stars : Stars
        Positions and fluxes.
    covariance : (N, 3, 3) ndarray
        Of x, y and flux; NaN where the fit failed.
    chi2 : (N,) ndarray
        Chi square per degree of freedom.
    valid : (N,) bool ndarray
        True where the fit converged.
    """

    stars: Stars
    covariance: np.ndarray
    chi2: np.ndarray
    valid: np.ndarray

    @classmethod
    def unfitted(cls, stars):
        """Return start values in place of fits; those without a flux are invalid."""
        n = len(stars.x)
        return cls(stars, np.full((n, 3, 3), np.nan), np.full(n, np.nan), stars.flux > 0)

    def updated(self, rows, other):
        """Return these fits with some rows replaced by those of other fits."""
        columns = []
        for old, new in zip(self._columns(), other._columns()):
            column = old.copy()
            column[rows] = new
            columns.append(column)
        x, y, flux, *rest = columns
        return StarFits(Stars(x, y, flux), *rest)

    def moved(self, rows, stars):
        """Return these fits with other positions and fluxes of some."""
        columns = [old.copy() for old in self.stars]
        for column, new in zip(columns, stars, strict=True):
            column[rows] = new
        return replace(self, stars=Stars(*columns))

    def _columns(self):
        return *self.stars, self.covariance, self.chi2, self.valid


def fit_radius(fwhm):
    """Return the radius of the pixels to which stars are fitted.

    Parameters
    ----------
    fwhm : float
        FWHM in px.

    Returns
    -------
    float
        Radius in px: 1.25 FWHM, but at least 2.5 px.
    """
    return max(1.25 * fwhm, 2.5)


def fit_stars(field, profile, noise, stars, *, radius, own=None):
    """Fit position and flux of stars, each on the pixels within a radius of its start.

    Parameters
    ----------
    field : Field
        Pixels.
    profile : Profile
        The PSF.
    noise : Noise
        Variance of the pixels.
    stars : Stars
        Start values.
    radius : float
        Radius in px of the pixels used.
    own : Stars, optional
        Models of these stars were subtracted from the image: each star gets its own back.

    Returns
    -------
    StarFits
        The fits.
    """

    def fit(start):
        rows = slice(start, start + _CHUNK)
        mine = None if own is None else own.take(rows)
        return _fit_chunk(field, profile, noise, stars.take(rows), radius, mine)

    parts = map_threads(fit, range(0, max(len(stars.x), 1), _CHUNK))
    x, y, flux, *rest = (np.concatenate(columns) for columns in zip(*parts))
    return StarFits(Stars(x, y, flux), *rest)


def _fit_chunk(field, profile, noise, stars, radius, own):
    half = int(np.ceil(radius))
    xc, yc, pixels, use, sky = field.cut(stars, half, radius)
    if own is not None:
        pixels += own.light(profile, xc, yc, half)
    x, y, flux = (np.array(v, dtype=float) for v in stars)
    shares = profile.shares(x, y)
    flux = np.maximum(flux, 1e-6)
    x0, y0, positions = x.copy(), y.copy(), noise.of_positions
    converged = np.zeros(len(x), bool)
    active = np.arange(len(x))
    for _ in range(_MAX_ITERATIONS):
        basis = profile.evaluate(
            x[active] - xc[active], y[active] - yc[active], half, shares[active]
        )
        step, *_rest = normal_step(
            basis, flux[active], pixels[active], use[active], sky.take(active), positions
        )
        shift = np.clip(step[:, :2], -_MAX_STEP, _MAX_STEP)
        x[active] += shift[:, 0]
        y[active] += shift[:, 1]
        # A flux that would turn negative is made smaller step by step.
        flux[active] = np.maximum(flux[active] + step[:, 2], 0.2 * flux[active])
        away = np.hypot(x[active] - x0[active], y[active] - y0[active]) > radius
        done = (np.abs(shift).max(axis=1, initial=0) < _CONVERGED) & (
            np.abs(step[:, 2]) < 1e-3 * flux[active]
        )
        converged[active[done & ~away]] = True
        active = active[~done & ~away]
        if len(active) == 0:
            break
    else:
        # Slow but close enough: what is left is far below the error.
        converged[active] = np.abs(shift[~done & ~away]).max(axis=1, initial=0) < 3e-3
    basis = profile.evaluate(x - xc, y - yc, half, shares)
    _step, covariance, chi2 = normal_step(basis, flux, pixels, use, sky, positions)
    if positions.mismatch != noise.mismatch:
        _step, _covariance, chi2 = normal_step(basis, flux, pixels, use, sky, noise)
    positive = np.einsum("sii->si", covariance).min(axis=1, initial=np.inf) > 0
    valid = converged & positive & np.isfinite(chi2)
    covariance[~valid] = np.nan
    return x, y, flux, covariance, chi2, valid


def normal_step(basis, flux, pixels, use, sky, noise):
    """Take a Gauss-Newton step of every star.

    Parameters
    ----------
    basis : (3, N, n) ndarray
        Profiles and their derivatives.
    flux : (N,) ndarray
        Fluxes.
    pixels, use, sky
        As from `Field.cut`.
    noise : Noise
        Variance of the pixels.

    Returns
    -------
    step : (N, 3) ndarray
        Steps of x, y and flux.
    covariance : (N, 3, 3) ndarray
        Their covariance; NaN where the equations are singular.
    chi2 : (N,) ndarray
        Chi square per degree of freedom.
    """
    n = len(flux)
    step, covariance, chi2 = np.empty((n, 3)), np.empty((n, 3, 3)), np.empty(n)
    photons = None if np.isscalar(sky.photons) else np.ascontiguousarray(sky.photons, dtype=float)
    numbers = np.array([noise.inverse_gain, noise.mismatch])
    kernels.star_steps(
        basis, flux, pixels, use, sky.variance, photons, numbers, step, covariance, chi2
    )
    return step, covariance, chi2


def star_like(flux, chi2, valid, *, limit=2.5, width=31):
    """Mark the fits that are as good as those of sources of about the same flux.

    Parameters
    ----------
    flux, chi2 : (N,) ndarray
        Fluxes and reduced chi squares.
    valid : (N,) bool ndarray
        True where the fit converged.
    limit : float, optional
        Greatest chi square relative to the typical one of sources of similar flux.
    width : int, optional
        Number of sources of similar flux.

    Returns
    -------
    (N,) bool ndarray
        True for fits that look like single stars.
    """
    rows = np.flatnonzero(valid)
    if len(rows) < 5:
        return valid.copy()
    rows = rows[np.argsort(flux[rows])]
    # A quantile below the median, because galaxies and cosmic rays may be the majority.
    typical = percentile_filter(chi2[rows], 35, size=min(width, len(rows)), mode="nearest")
    result = np.zeros(len(flux), bool)
    result[rows] = chi2[rows] < limit * typical
    return result
