"""Noise of the pixels of stars: sky, photons, and what the profile does not describe."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from wpdc_gwcs.centroids._inverses import inverses

__all__ = ["Noise", "NoiseBins", "bin_noise", "bin_odd_noise", "estimate_noise", "least_gain"]

# Error of the profile below which nobody's data can tell.
_MIN_MISMATCH = 0.0005

# Median of a chi square with four degrees of freedom, for each of them; stars in a bin.
_MEDIAN_OF_FOUR, _STARS_OF_BIN = 0.839, 15

# Noise of stars shows where it is so many times that of the sky, in so many bins.
_ABOVE_SKY, _MIN_BINS = 2.0, 3


@dataclass(frozen=True)
class Noise:
    r"""Variance of a pixel: background, photons, and what the profile does not describe.

    Parameters
    ----------
    inverse_gain : float
        Counts per electron.
    mismatch : float
        Error of the profile at its peak, relative to its value there.
    asymmetry : float or None
        That part of it that is odd about the star; None for all of it.

    Notes
    -----
    :math:`\sigma^2 = \sigma_\mathrm{sky}^2 + m / g + \epsilon^2 m m_\mathrm{peak}` with m the
    model's counts.  The error of the profile has the form of photon noise, so that the brightest
    stars are fitted with the same relative weights as those with photon noise alone; the same
    relative error everywhere would shift them by whatever asymmetry the wings have.

    An error of the width, or of any ring about the star, makes the fit worse and moves nobody: the
    derivatives by the position are odd about the star, and the sums with what is even vanish.
    """

    inverse_gain: float = 0.0
    mismatch: float = 0.02
    asymmetry: float | None = None

    @property
    def of_positions(self):
        """The noise that moves stars, for the weights and errors of their positions."""
        odd = self.mismatch if self.asymmetry is None else self.asymmetry
        return Noise(self.inverse_gain, odd)

    def variance(self, sky, model):
        """Variance for pixels of given sky and model counts."""
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
        That of the background.
    photons : (B,) ndarray
        Counts of the stars: times the counts per electron, the variance of their photons.
    square : (B,) ndarray
        Counts times those of the star's peak: times the square of the relative error of the
        profile, the variance that it brings.
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
        As for `fit_stars`; stars where the fit has converged.
    modes : sequence of Profile, optional
        Changes of the profile that each star may have for its own: what they take up is no noise.
    own : Stars, optional
        Models that were subtracted from the image, as for `fit_stars`.

    Returns
    -------
    NoiseBins or None
        The bins; None where there are too few pixels.
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
    # A fit takes part of the scatter away, most where few pixels decide: the leverage.
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
    """Medians (..., n_bins) of values (..., N) in bins of as many each, the first ones one more."""
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
    r"""Measure the noise in what is odd about well measured stars, as the shift of a star is.

    Parameters
    ----------
    field, profile, stars, radius, own
        As for `bin_noise`.
    noise : Noise
        Its photons count.
    modes : sequence of Profile
        Four changes of the profile that are odd about the star.

    Returns
    -------
    NoiseBins or None
        Variances in units of those by sky and photons; None where there are too few stars.

    Notes
    -----
    The amplitudes of the modes are fitted with position and flux.  Their chi square is that of sky
    and photons, and grows with the square of the profile's error by :math:`\mathrm{tr}(N^{-1} B) /
    4`, where N is the normal matrix and B what the form of that error makes of it.
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
    # What all stars have in common shifts them alike, which no star can tell from where it is.
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
    """Learn from the noise in stars how far the profile is off, and the gain.

    Parameters
    ----------
    bins : NoiseBins or None
        As from `bin_noise`.
    gain : float, optional
        Electrons per count; estimated if not given.

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

    # Ratios, not differences: a variance is uncertain in proportion to itself; and robustly, for
    # galaxies among the stars.
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
    """Find the gain below which photons alone would make more noise than there is.

    Parameters
    ----------
    bins : NoiseBins or None
        As from `bin_noise`.

    Returns
    -------
    float
        Electrons per count; 0 where the noise of the stars does not show above that of the sky.
    """
    if bins is None:
        return 0.0
    bright = bins.measured > _ABOVE_SKY * bins.sky
    if np.count_nonzero(bright) < _MIN_BINS:
        return 0.0
    inverse = (bins.measured - bins.sky)[bright] / bins.photons[bright]
    # Errors of the profile add to the noise, most for the brightest stars.
    return float(1 / np.quantile(inverse, 0.25))
