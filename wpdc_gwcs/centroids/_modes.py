"""Small changes of a profile: more or less blur, asymmetry, a companion."""

import numpy as np

from wpdc_gwcs.centroids._inverses import inverses
from wpdc_gwcs.centroids._profile import Profile, shift_matrix, spline_coefficients

__all__ = ["blur_modes", "companions", "mode_profiles", "odd_modes", "reduced_normal"]

# Pixels that deviate by more than this many sigma have the weight of pixels at this limit.
_HUBER = 3.0

# Positions of companions: distance in FWHM, and number of directions.
_DISTANCE, _N_ANGLES = 0.6, 12


def blur_modes(coefficients, scale):
    """Compute the change of a profile by a little more blur along x, xy, y, and in the next order.

    Parameters
    ----------
    coefficients : (M, M) ndarray
        Spline coefficients of the profile.
    scale : float
        Grid steps for an amplitude of one, about the FWHM.

    Returns
    -------
    list of (M, M) ndarray
        Coefficients of the second derivatives and of the squared Laplacian, in units of scale.
    """
    xx, yy = _second(coefficients, 1, scale), _second(coefficients, 0, scale)
    laplacian = xx + yy
    return [
        xx / 8,
        _first(_first(coefficients, 0, scale), 1, scale) / 4,
        yy / 8,
        (_second(laplacian, 0, scale) + _second(laplacian, 1, scale)) / 128,
    ]


def odd_modes(coefficients, scale):
    """Compute the change of a profile by a little more light on one side, in all directions.

    Parameters
    ----------
    coefficients, scale
        As for `blur_modes`.

    Returns
    -------
    list of (M, M) ndarray
        Coefficients of the four third derivatives, in units of scale.
    """
    xx, yy = _second(coefficients, 1, scale), _second(coefficients, 0, scale)
    return [_first(c, axis, scale) / 16 for c in (xx, yy) for axis in (1, 0)]


def companions(coefficients, modes, scale):
    """Compute the change of a profile by a companion, as amplitudes of modes.

    Parameters
    ----------
    coefficients, scale
        As for `blur_modes`.
    modes : list of (M, M) ndarray
        R modes.

    Returns
    -------
    (R, K) ndarray
        Amplitudes of the modes, free of shifts and changes of flux, for each of K positions of a
        companion as bright as the star.
    """
    size = len(coefficients)
    angle = 2 * np.pi * np.arange(_N_ANGLES) / _N_ANGLES
    x, y = (_DISTANCE * scale * f(angle) for f in (np.cos, np.sin))
    shifted = [
        shift_matrix(size, -v) @ coefficients @ shift_matrix(size, -u).T
        for u, v in zip(x, y, strict=True)
    ]
    own = [coefficients, *(_first(coefficients, axis, scale) for axis in (0, 1))]
    basis = np.stack([*own, *modes]).reshape(len(own) + len(modes), -1)
    shifted = spline_coefficients(np.stack(shifted)).reshape(len(x), -1)
    return np.linalg.solve(basis @ basis.T, basis @ shifted.T)[len(own) :]


def _neighbors(c, axis):
    padded = np.pad(c, [(1, 1) if a == axis else (0, 0) for a in (0, 1)])
    return (np.take(padded, np.arange(n, n + c.shape[axis]), axis) for n in (0, 2))


def _first(c, axis, scale):
    low, high = _neighbors(c, axis)
    return 0.5 * (high - low) * scale


def _second(c, axis, scale):
    low, high = _neighbors(c, axis)
    return (low - 2 * c + high) * scale**2


def mode_profiles(modes, oversampling):
    """Make profiles of modes, which are evaluated like other profiles.

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
        As for `fit_stars`, with stars whose fit has converged.
    modes : list of (M, M) ndarray
        K modes, see `blur_modes`.
    subtracted : bool, optional
        Whether the models of all stars have been subtracted from the image.
    robust : bool, optional
        Whether pixels that deviate strongly from the model have less weight.

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
