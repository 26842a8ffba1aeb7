"""Small changes of a profile: a little more or less blur in any direction."""

import numpy as np

from wpdc_gwcs.centroids._inverses import inverses
from wpdc_gwcs.centroids._profile import Profile

__all__ = ["blur_modes", "mode_profiles", "reduced_normal"]

# Pixels further off the model than this many sigma weigh as if they were there.
_HUBER = 3.0


def blur_modes(coefficients, scale):
    """Change of a profile by a little more blur, along x, xy, y, and in the next order.

    Parameters
    ----------
    coefficients : (M, M) ndarray
        Spline coefficients of the profile.
    scale : float
        Grid steps that make an amplitude of one, about the FWHM.

    Returns
    -------
    list of (M, M) ndarray
        Coefficients of the second derivatives and of the squared Laplacian, in units of scale.
    """

    def along(c, axis):
        padded = np.pad(c, [(1, 1) if a == axis else (0, 0) for a in (0, 1)])
        low, high = (np.take(padded, np.arange(n, n + c.shape[axis]), axis) for n in (0, 2))
        return low, high

    def second(c, axis):
        low, high = along(c, axis)
        return (low - 2 * c + high) * scale**2

    def first(c, axis):
        low, high = along(c, axis)
        return 0.5 * (high - low) * scale

    xx, yy = second(coefficients, 1), second(coefficients, 0)
    laplacian = xx + yy
    return [
        xx / 8,
        first(first(coefficients, 0), 1) / 4,
        yy / 8,
        (second(laplacian, 0) + second(laplacian, 1)) / 128,
    ]


def mode_profiles(modes, oversampling):
    """Profiles of modes, to be evaluated like others.

    Parameters
    ----------
    modes : list of (M, M) ndarray
        Spline coefficients, see `blur_modes`.
    oversampling : int
        Grid steps per pixel.

    Returns
    -------
    list of Profile
        Profiles of one component each.
    """
    zero = np.zeros(1)
    return [Profile(mode.reshape(1, *mode.shape[-2:]), oversampling, zero, zero) for mode in modes]


def reduced_normal(field, profile, noise, stars, modes, radius, *, subtracted=False, robust=True):
    """Set up normal equations for the amplitudes of modes, free of position and flux.

    Parameters
    ----------
    field, profile, noise, stars, radius
        As for `fit_stars`; stars where the fit has converged.
    modes : list of (M, M) ndarray
        K modes, see `blur_modes`.
    subtracted : bool, optional
        Whether the models of all stars have been taken off the image.
    robust : bool, optional
        Whether pixels far off the model weigh less.

    Returns
    -------
    left, right : (N, K, K), (N, K) ndarray
        Normal matrices and vectors of the amplitudes, relative to the flux of the star.
    """
    half = int(np.ceil(radius))
    xc, yc, pixels, use, sky = field.cut(stars, half, radius)
    shares = profile.shares(stars.x, stars.y)
    basis = profile.evaluate(stars.x - xc, stars.y - yc, half, shares)
    flux = stars.flux[:, None]
    model = flux * basis[0]
    residual = pixels if subtracted else pixels - model
    weight = use / noise.variance(sky, model)
    if robust:
        weight *= np.minimum(1, _HUBER / np.maximum(np.abs(residual) * np.sqrt(weight), 1e-9))
    one = np.ones((len(flux), 1))
    common = [
        flux * shape.evaluate(stars.x - xc, stars.y - yc, half, one, gradient=False)[0]
        for shape in mode_profiles(modes, profile.oversampling)
    ]
    own = np.stack([flux * basis[1], flux * basis[2], basis[0]], axis=1)
    common = np.stack(common, axis=1)
    both = np.concatenate([own, common, residual[:, None]], axis=1)
    normal = (both[:, :-1] * weight[:, None]) @ both.transpose(0, 2, 1)
    # Positions and fluxes are eliminated star by star.
    solved = inverses(normal[:, :3, :3]) @ normal[:, :3, 3:]
    reduced = normal[:, 3:, 3:] - normal[:, 3:, :3] @ solved
    return reduced[:, :, :-1], reduced[:, :, -1]
