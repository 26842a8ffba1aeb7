"""Noise of the pixels of stars: sky, photons, and errors of the profile."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from wpdc_gwcs.centroids._inverses import inverses

__all__ = ["Noise", "NoiseBins", "bin_noise", "bin_odd_noise", "estimate_noise", "least_gain"]

# Smallest error of the profile that data could show.
_MIN_MISMATCH = 0.0005

# Median of a chi square with four degrees of freedom, divided by four; number of stars in a bin.
_MEDIAN_OF_FOUR, _STARS_OF_BIN = 0.839, 15

# The noise of stars is visible if it is this many times that of the sky, in this many bins.
_ABOVE_SKY, _MIN_BINS = 2.0, 3


@dataclass(frozen=True)
class Noise:
    r"""Variance of a pixel: background, photons, and the error of the profile.

    Parameters
    ----------
    inverse_gain : float
        Counts per electron.
    mismatch : float
        Error of the profile at its peak, relative to its value there.
    asymmetry : float or None
        Part of this error that is odd about the star; None for all of it.

    Notes
    -----
    :math:`\sigma^2 = \sigma_\mathrm{sky}^2 + m / g + \epsilon^2 m m_\mathrm{peak}` with m the
    counts of the model.  The error of the profile has the form of photon noise, so the brightest
    stars are fitted with the same relative weights as stars with photon noise alone.  With the same
    relative error everywhere, an asymmetry of the wings would shift them.

    An error of the width, or of any ring about the star, makes the fit worse but does not shift the
    star, because the derivatives with respect to the position are odd about the star: their sums
    with an even error vanish.
    """

    inverse_gain: float = 0.0
    mismatch: float = 0.02
    asymmetry: float | None = None

    @property
    def of_positions(self):
        """Noise that shifts stars, for the weights and errors of their positions."""
        odd = self.mismatch if self.asymmetry is None else self.asymmetry
        return Noise(self.inverse_gain, odd)

    def variance(self, sky, model):
        """Variance of pixels with given sky and model counts."""
        model = np.maximum(model, 0)
        peak = model.max(axis=-1, keepdims=True)
        return sky.variance + model * (self.inverse_gain * sky.photons + self.mismatch**2 * peak)


class NoiseBins(NamedTuple):
    """Noise in pixels of stars, in bins of their light.

    Parameters
    ----------
    measured : (B,) ndarray
        Variance of the residuals.
    sky : (B,) ndarray
        Variance of the background.
    photons : (B,) ndarray
        Counts of the stars.  Multiplied by the counts per electron, this is the photon variance.
    square : (B,) ndarray
        Counts times those at the peak of the star.  Multiplied by the square of the relative error
        of the profile, this is the variance from that error.
    """

    measured: np.ndarray
    sky: np.ndarray
    photons: np.ndarray
    square: np.ndarray


def bin_noise(field, profile, noise, stars, *, radius, modes=(), own=None):
    """Measure the noise in pixels of well measured stars.

    Parameters
    ----------
    field, profile, noise, stars, radius
        As for `fit_stars`, with stars whose fit has converged.
    modes : sequence of Profile, optional
        Changes of the profile that are fitted to each star and do not count as noise.
    own : Stars, optional
        Models that were subtracted from the image, as for `fit_stars`.

    Returns
    -------
    NoiseBins or None
        The bins; None if there are too few pixels.
    """
    half = int(np.ceil(radius))
    xc, yc, pixels, use, sky = field.cut(stars, half, radius)
    if own is not None:
        pixels += own.light(profile, xc, yc, half)
    shares = profile.shares(stars.x, stars.y)
    basis = profile.evaluate(stars.x - xc, stars.y - yc, half, shares)
    flux = stars.flux
    model = flux[:, None] * basis[0]
    use &= model > np.sqrt(sky.variance)
    weight = use / noise.variance(sky, model)
    one = np.ones((len(flux), 1))
    own = [m.evaluate(stars.x - xc, stars.y - yc, half, one, gradient=False)[0] for m in modes]
    jacobian = np.stack([flux[:, None] * b for b in (*basis[1:], *own)] + [basis[0]], axis=1)
    n = jacobian.shape[1]
    normal = (jacobian * weight[:, None]) @ jacobian.transpose(0, 2, 1)
    good = use.sum(axis=1) >= 2 * n
    normal[~good] = np.eye(n)
    # A fit absorbs part of the scatter, most where few pixels decide: the leverage.
    inverse = inverses(normal)
    leverage = weight * np.einsum("sip,sij,sjp->sp", jacobian, inverse, jacobian)
    residual = pixels - model
    if own:
        step = inverse @ (jacobian @ (weight * residual)[:, :, None])
        residual = residual - (step.transpose(0, 2, 1) @ jacobian)[:, 0]
    use &= good[:, None] & (leverage < 0.8)
    if np.count_nonzero(use) < 50:
        return None
    residual2 = (residual**2)[use] / (1 - leverage[use])
    square = (model * model.max(axis=1, keepdims=True))[use]
    photons, variance = (model * sky.photons)[use], sky.variance[use]
    order = np.argsort(square)
    values = np.stack([residual2, variance, photons, square])[:, order]
    measured, *means = _medians(values, int(np.clip(len(order) // 50, 1, 40)))
    # 1.4826 MAD squared = median of the squares / 0.4549
    return NoiseBins(measured / 0.4549 + 1e-30, *means)


def _medians(values, n_bins):
    """Medians (..., n_bins) of values (..., N) in equally filled bins."""
    size, more = divmod(values.shape[-1], n_bins)
    split = more * (size + 1)
    parts = values[..., :split], values[..., split:]
    shapes = (more, size + 1), (n_bins - more, size)
    return np.concatenate(
        [
            np.median(part.reshape(*values.shape[:-1], *shape), axis=-1)
            for part, shape in zip(parts, shapes, strict=True)
        ],
        axis=-1,
    )


def bin_odd_noise(field, profile, noise, stars, modes, *, radius, own=None):
    r"""Measure the noise of well measured stars that is odd about them, as a shift is.

    Parameters
    ----------
    field, profile, stars, radius, own
        As for `bin_noise`.
    noise : Noise
        Noise; only its photons are used.
    modes : sequence of Profile
        Four changes of the profile that are odd about the star.

    Returns
    -------
    NoiseBins or None
        Variances in units of those of sky and photons; None if there are too few stars.

    Notes
    -----
    The amplitudes of the modes are fitted with position and flux.  Their chi square is that of sky
    and photons, plus the square of the error of the profile times :math:`\mathrm{tr}(N^{-1} B) /
    4`, where N is the normal matrix, and B the same for the form of that error.
    """
    if len(stars.x) < 2 * _STARS_OF_BIN:
        return None
    half = int(np.ceil(radius))
    xc, yc, pixels, use, sky = field.cut(stars, half, radius)
    if own is not None:
        pixels += own.light(profile, xc, yc, half)
    basis = profile.evaluate(stars.x - xc, stars.y - yc, half, profile.shares(stars.x, stars.y))
    flux = stars.flux[:, None]
    model = flux * basis[0]
    weight = use / Noise(noise.inverse_gain, 0.0).variance(sky, model)
    one = np.ones((len(flux), 1))
    odd = [m.evaluate(stars.x - xc, stars.y - yc, half, one, gradient=False)[0] for m in modes]
    fitted = np.stack([basis[0], flux * basis[1], flux * basis[2]], axis=1)
    odd = flux[:, None] * np.stack(odd, axis=1)
    weighted = fitted * weight[:, None]
    normal = weighted @ fitted.transpose(0, 2, 1)
    odd -= (inverses(normal) @ (weighted @ odd.transpose(0, 2, 1))).transpose(0, 2, 1) @ fitted
    weighted = odd * weight[:, None]
    left = weighted @ odd.transpose(0, 2, 1)
    inverse = inverses(left)
    right = (weighted @ (pixels - model)[:, :, None])[:, :, 0]
    square = np.maximum(model, 0) * model.max(axis=1, keepdims=True)
    error = (weighted * square[:, None]) @ weighted.transpose(0, 2, 1)
    square = np.einsum("sij,sji->s", inverse, error) / 4
    # A change that all stars share shifts all of them equally, which cannot be noticed.
    share = 1 / (1 + noise.mismatch**2 * square)
    common = np.linalg.pinv(np.einsum("s,sij->ij", share, left)) @ (share @ right)
    right -= left @ common
    chi2 = np.einsum("si,sij,sj->s", right, inverse, right) / 4
    order = np.argsort(square)
    bins = np.array_split(order, int(np.clip(len(order) // _STARS_OF_BIN, 1, 40)))
    measured = np.array([np.median(chi2[b]) for b in bins]) / _MEDIAN_OF_FOUR + 1e-30
    ones = np.ones(len(bins))
    return NoiseBins(measured, ones, ones, np.array([np.median(square[b]) for b in bins]))


def estimate_noise(bins, gain=None):
    """Determine the error of the profile and the gain from the noise in stars.

    Parameters
    ----------
    bins : NoiseBins or None
        As from `bin_noise`.
    gain : float, optional
        Electrons per count.  Default: estimated.

    Returns
    -------
    Noise
        Gain and mismatch.
    """
    if bins is None:
        return Noise(0.0 if gain is None else 1 / gain)
    known = bins.sky if gain is None else bins.sky + bins.photons / gain

    def variance(logs):
        photons = bins.photons * np.exp(logs[1]) if gain is None else 0.0
        return known + photons + np.exp(2 * logs[0]) * bins.square

    # Ratios, not differences, because the error of a variance is proportional to it; and a robust
    # fit, because there may be galaxies among the stars.
    start = [np.log(0.02)]
    start += [np.log(0.1 * np.median(bins.sky / bins.photons))] if gain is None else []
    logs = least_squares(
        lambda logs: np.log(bins.measured / variance(logs)),
        start,
        bounds=(
            [np.log(_MIN_MISMATCH)] + [-30] * (gain is None),
            [np.log(0.5)] + [30] * (gain is None),
        ),
        loss="soft_l1",
        f_scale=0.2,
    ).x
    inverse_gain = np.exp(logs[1]) if gain is None else 1 / gain
    return Noise(float(inverse_gain), float(np.exp(logs[0])))


def least_gain(bins):
    """Find the gain below which photons alone would make more noise than observed.

    Parameters
    ----------
    bins : NoiseBins or None
        As from `bin_noise`.

    Returns
    -------
    float
        Electrons per count; 0 if the noise of the stars is not visible above that of the sky.
    """
    if bins is None:
        return 0.0
    bright = bins.measured > _ABOVE_SKY * bins.sky
    if np.count_nonzero(bright) < _MIN_BINS:
        return 0.0
    inverse = (bins.measured - bins.sky)[bright] / bins.photons[bright]
    # Errors of the profile add to the noise, most for the brightest stars.
    return float(1 / np.quantile(inverse, 0.25))
