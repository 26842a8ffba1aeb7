"""The effective PSF of a frame, learnt from its own stars."""

from dataclasses import replace

import numpy as np
from scipy.linalg import LinAlgError, solveh_banded
from scipy.spatial import KDTree

from wpdc_gwcs.centroids._fit import estimate_noise, fit_stars
from wpdc_gwcs.centroids._profile import (
    Profile,
    cutouts,
    moffat_samples,
    spline_coefficients,
    spline_taps,
)

__all__ = ["OVERSAMPLING", "fit_moffat", "learn_profile", "select_stars", "vary_profile"]

OVERSAMPLING = 4

_SIGMA_PER_FWHM = 1 / np.sqrt(8 * np.log(2))

# Expected size of the difference between the PSF and a Moffat profile, relative to the profile:
# of its fourth differences (in units of a Gaussian's), and of itself.
_ROUGHNESS = 0.15
_DEVIATION = 0.3

# Pixels further off the model than this many sigma weigh as if they were there.
_HUBER = 3.0


def select_stars(x, y, flux, snr, quality, fwhm, shape, *, n_max, min_snr):
    """Choose bright, isolated stars that are spread over the frame.

    Parameters
    ----------
    x, y, flux, snr : (N,) ndarray
        All sources.
    quality : (N,) bool ndarray
        True for those that are single, clean stars.
    fwhm : float
        FWHM in px.
    shape : (int, int)
        Shape of the image.
    n_max : int
        Greatest number of stars.
    min_snr : float
        Least signal-to-noise ratio.

    Returns
    -------
    (n,) int ndarray
        Rows, the brightest first.
    """
    candidate = quality & (snr >= min_snr) & (flux > 0)
    pairs = KDTree(np.column_stack([x, y])).query_pairs(4 * fwhm, output_type="ndarray")
    if len(pairs):
        i, j = np.concatenate([pairs, pairs[:, ::-1]]).T
        near = np.hypot(x[i] - x[j], y[i] - y[j]) / fwhm
        # Tolerable neighbours are the fainter the nearer they are; what they leave is clipped.
        limit = 0.02 * np.maximum(near - 1, 0) ** 2
        candidate[i[flux[j] > limit * flux[i]]] = False
    rows = np.flatnonzero(candidate)
    rows = rows[np.argsort(flux[rows])[::-1]]
    if len(rows) <= n_max:
        return rows
    # The same number from each of 6 x 6 fields, as far as they have as many.
    field = np.clip(6 * y[rows] / shape[0], 0, 5).astype(int) * 6
    field += np.clip(6 * x[rows] / shape[1], 0, 5).astype(int)
    order = np.argsort(field, kind="stable")
    first = np.searchsorted(field[order], np.arange(36))
    rank = np.empty(len(rows), int)
    rank[order] = np.arange(len(rows)) - first[field[order]]
    return rows[np.sort(np.argsort(rank, kind="stable")[:n_max])]


def fit_moffat(image, rms, mask, noise, stars, fwhm, *, half, radius):
    """Fit one elliptical, pixel-integrated Moffat profile to stars.

    Parameters
    ----------
    image, rms, mask, noise
        As for `fit_stars`.
    stars : (x, y, flux) tuple of (N,) ndarray
        Start values.
    fwhm : float
        FWHM in px to start from.
    half : int
        Half-width in px of the profile's grid.
    radius : float
        Radius in px of the pixels fitted.

    Returns
    -------
    shape : (4,) ndarray
        Parameters, see `moffat_samples`.
    stars : tuple of (N,) ndarray
        Positions and fluxes.

    Notes
    -----
    An analytic profile knows nothing of pixels, so its fit gives positions without error that
    depends on the pixel phase.  A free profile cannot find that error by itself: positions off by
    any function of the phase go with a profile that fits as well.
    """
    shape = np.array([np.log(max(0.5 * np.sqrt(max(fwhm**2 - 0.7, 0.3)), 0.3)), np.log(2.0), 0, 0])
    steps = np.array([0.02, 0.05, 0.01, 0.01])

    def profile_of(parameters):
        return Profile.constant(moffat_samples(parameters, half, OVERSAMPLING), OVERSAMPLING)

    x, y, flux = stars
    size = int(np.ceil(radius))
    damping = 1e-3
    for _ in range(8):
        profile = profile_of(shape)
        fits = fit_stars(image, rms, mask, profile, noise, x, y, flux, radius=radius)
        good = fits.valid & (fits.chi2 < 3 * np.median(fits.chi2))
        if good.sum() < 3:
            break
        x, y, flux = (
            np.where(fits.valid, new, old)
            for new, old in zip((fits.x, fits.y, fits.flux), (x, y, flux))
        )
        xs, ys, fs = x[good], y[good], flux[good, None]
        xc, yc = np.rint(xs).astype(int), np.rint(ys).astype(int)
        pixels, use = cutouts(image, xc, yc, size)
        if mask is not None:
            use &= ~cutouts(mask, xc, yc, size)[0]
        step = np.arange(-size, size + 1)
        use &= (np.hypot(step[:, None], step) <= radius).ravel()
        basis = profile.evaluate(xs - xc, ys - yc, size)
        model = fs * basis[0]
        weight = use / noise.variance(cutouts(rms, xc, yc, size)[0].astype(float) ** 2, model)
        residual = pixels - model
        scale = np.sqrt(weight)
        weight = weight * np.minimum(1, _HUBER / np.maximum(np.abs(residual) * scale, 1e-9))
        slopes = [
            fs
            * (profile_of(shape + d).evaluate(xs - xc, ys - yc, size, gradient=False)[0] - basis[0])
            / d.sum()
            for d in np.diag(steps)
        ]
        own = np.stack([fs * basis[1], fs * basis[2], basis[0]], axis=1)
        common = np.stack(slopes, axis=1)
        # Positions and fluxes are eliminated star by star.
        nn = (own * weight[:, None]) @ own.transpose(0, 2, 1)
        nc = (own * weight[:, None]) @ common.transpose(0, 2, 1)
        cc = (common * weight[:, None]) @ common.transpose(0, 2, 1)
        rn = (own * weight[:, None]) @ residual[:, :, None]
        rc = (common * weight[:, None]) @ residual[:, :, None]
        solved = np.linalg.pinv(nn) @ np.concatenate([nc, rn], axis=2)
        left = (cc - nc.transpose(0, 2, 1) @ solved[:, :, :4]).sum(axis=0)
        right = (rc - nc.transpose(0, 2, 1) @ solved[:, :, 4:]).sum(axis=0)[:, 0]
        left[np.diag_indices(4)] *= 1 + damping
        change = np.clip(np.linalg.lstsq(left, right, rcond=None)[0], -0.3, 0.3)
        shape = shape + change
        shape = np.clip(
            shape,
            [np.log(0.2), np.log(0.3), -0.6, -0.6],
            [np.log(fwhm * 2), np.log(30.0), 0.6, 0.6],
        )
        if np.abs(change).max() < 3e-3:
            break
    return shape, (x, y, flux)


def learn_profile(image, rms, mask, noise, stars, base, *, fwhm, radius, gain, iterations=4):
    """Refine a profile and the positions of its stars in turn.

    Parameters
    ----------
    image, rms, mask, noise
        As for `fit_stars`.
    stars : (x, y, flux) tuple of (N,) ndarray
        Start values.
    base : (M, M) ndarray
        Samples of the profile to start from.
    fwhm : float
        FWHM in px.
    radius : float
        Radius in px of the pixels that positions are fitted on.
    gain : float or None
        Electrons per count.
    iterations : int, optional
        Number of rounds.

    Returns
    -------
    profile : Profile
        Profile, normalised and centred.
    stars : tuple of (n,) ndarray
        Positions and fluxes of the stars kept.
    kept : (n,) int ndarray
        Their rows.
    noise : Noise
        Noise with the profile's own error.
    """
    x, y, flux = stars
    kept = np.arange(len(x))
    profile = Profile.constant(base, OVERSAMPLING)
    start = profile
    for _ in range(iterations):
        fits = fit_stars(image, rms, mask, profile, noise, x, y, flux, radius=radius)
        good = fits.valid
        if good.sum() >= 8:
            good = good & (fits.chi2 < 4 * np.median(fits.chi2[good]))
        x, y, flux, kept = (v[good] for v in (fits.x, fits.y, fits.flux, kept))
        if len(x) == 0:
            break
        noise = estimate_noise(
            image, rms, mask, profile, noise, x, y, flux, radius=radius, gain=gain
        )
        # Floor: a profile is never known better, and the brightest stars must not rule alone.
        noise = replace(noise, mismatch=float(np.clip(noise.mismatch, 0.005, 0.3)))
        change = _residual_coefficients(image, rms, mask, noise, start, (x, y, flux), fwhm)
        profile, shift = _centered(start.coefficients[0] + change, fwhm)
        x, y = x + shift[0], y + shift[1]
    return profile, (x, y, flux), kept, noise


def vary_profile(image, rms, mask, noise, stars, profile, fwhm, shape, n_nodes):
    """Let a profile vary over the detector.

    Parameters
    ----------
    image, rms, mask, noise
        As for `fit_stars`.
    stars : (x, y, flux) tuple of (N,) ndarray
        Stars fitted with the constant profile.
    profile : Profile
        Constant profile.
    fwhm : float
        FWHM in px.
    shape : (int, int)
        Shape of the image.
    n_nodes : int
        Number of places along each axis.

    Returns
    -------
    Profile
        Profile with n_nodes x n_nodes places; each has learnt from the stars nearest to it.
    """
    x, y, _flux = stars
    x_nodes = np.linspace(0.5 / n_nodes, 1 - 0.5 / n_nodes, n_nodes) * (shape[1] - 1)
    y_nodes = np.linspace(0.5 / n_nodes, 1 - 0.5 / n_nodes, n_nodes) * (shape[0] - 1)
    reach_x, reach_y = shape[1] / n_nodes, shape[0] / n_nodes
    grids = []
    for y0 in y_nodes:
        for x0 in x_nodes:
            share = np.exp(-0.5 * (((x - x0) / reach_x) ** 2 + ((y - y0) / reach_y) ** 2) * 2.5)
            rows = share > 0.05
            near = tuple(column[rows] for column in stars)
            change = _residual_coefficients(
                image, rms, mask, noise, profile, near, fwhm, share=share[rows], prior=0.5
            )
            grids.append(_centered(profile.coefficients[0] + change, fwhm)[0].coefficients[0])
    return Profile(np.stack(grids), profile.oversampling, x_nodes, y_nodes)


def _residual_coefficients(image, rms, mask, noise, profile, stars, fwhm, *, share=None, prior=1.0):
    """Spline coefficients that take up what a profile leaves: penalised least squares."""
    x, y, flux = stars
    over, size = profile.oversampling, profile.coefficients.shape[-1]
    half = profile.radius - 1
    xc, yc = np.rint(x).astype(int), np.rint(y).astype(int)
    pixels, use = cutouts(image, xc, yc, half)
    if mask is not None:
        use &= ~cutouts(mask, xc, yc, half)[0]
    model = flux[:, None] * profile.evaluate(x - xc, y - yc, half, gradient=False)[0]
    residual = pixels - model
    weight = use / noise.variance(cutouts(rms, xc, yc, half)[0].astype(float) ** 2, model)
    weight *= np.minimum(1, _HUBER / np.maximum(np.abs(residual) * np.sqrt(weight), 1e-9)) ** 2
    if share is not None:
        weight *= share[:, None]
    weight *= flux[:, None] ** 2
    residual = residual / flux[:, None]
    center = (size - 1) // 2
    base_x, taps_x, _ = spline_taps(center - over * (x - xc))
    base_y, taps_y, _ = spline_taps(center - over * (y - yc))
    taps = (taps_y[:, :, None] * taps_x[:, None, :]).reshape(-1, 16)
    squares = (taps[:, :, None] * taps[:, None, :]).reshape(-1, 256)
    width = 4 * size + 5
    band = np.zeros((width, size * size))
    right = np.zeros(size * size)
    cell = base_y * 1000 + base_x
    step = over * np.arange(-half, half + 1)
    tap = np.arange(-1, 3)
    for value in np.unique(cell):
        k = np.flatnonzero(cell == value)
        iy = base_y[k[0]] + step[:, None] + tap
        ix = base_x[k[0]] + step[:, None] + tap
        index = (iy[:, None, :, None] * size + ix[None, :, None, :]).reshape(-1, 16)
        np.add.at(right, index, (weight[k] * residual[k]).T @ taps[k])
        normal = (weight[k].T @ squares[k]).reshape(-1, 16, 16)
        offset = index[:, :, None] - index[:, None, :]
        lower = offset >= 0
        column = np.broadcast_to(index[:, None, :], offset.shape)
        np.add.at(band, (offset[lower], column[lower]), normal[lower])
    _add_prior(band, np.abs(profile.samples()[0]), fwhm, over, prior)
    try:
        solution = solveh_banded(band, right, lower=True, overwrite_ab=True, check_finite=False)
    except LinAlgError:
        return np.zeros((size, size))
    return solution.reshape(size, size)


def _add_prior(band, samples, fwhm, over, prior):
    """Add the expectation that a difference is small and smooth to banded normal equations."""
    size = samples.shape[0]
    center = (size - 1) // 2
    radius = np.hypot(*np.meshgrid(np.arange(size) - center, np.arange(size) - center)) / over
    # A smooth envelope of the profile, with wings that stay open for spikes and haloes.
    envelope = samples.max() * (1 + (2 * radius / fwhm) ** 2 * (2**0.5 - 1)) ** -2
    sigma = fwhm * _SIGMA_PER_FWHM * over  # grid steps
    rough = (prior * _ROUGHNESS * 3 * sigma**-4 * envelope) ** -2
    own = (prior * _DEVIATION * envelope) ** -2
    # Nothing is known about the rim: the profile there is the start's.
    rim = np.abs(np.arange(size) - center) > center - over
    own[rim] *= 1e8
    own[:, rim] *= 1e8
    band[0] += own.ravel()
    difference = np.array([1.0, -4.0, 6.0, -4.0, 1.0])
    index = np.arange(size * size).reshape(size, size)
    for stride, weight, first in (
        (1, rough[:, 2:-2], index[:, :-4]),
        (size, rough[2:-2], index[:-4]),
    ):
        weight, first = weight.ravel(), first.ravel()
        for i in range(5):
            for j in range(i + 1):
                # Distinct columns: no two rows of differences add to the same place.
                band[stride * (i - j), first + stride * j] += difference[i] * difference[j] * weight


def _centered(coefficients, fwhm):
    """Profile with unit sum and its windowed centroid at the origin; also the shift (x, y)."""
    size, over = coefficients.shape[0], OVERSAMPLING
    u = (np.arange(size) - (size - 1) // 2) / over
    sigma = fwhm * _SIGMA_PER_FWHM
    shift = np.zeros(2)
    profile = Profile(coefficients[None], over, np.zeros(1), np.zeros(1))
    samples = profile.samples()[0]
    for _ in range(10):
        wx = np.exp(-0.5 * ((u - shift[0]) / sigma) ** 2)
        wy = np.exp(-0.5 * ((u - shift[1]) / sigma) ** 2)
        weighted = samples * wy[:, None] * wx
        total = weighted.sum()
        step = np.array(
            [(weighted.sum(0) * (u - shift[0])).sum(), (weighted.sum(1) * (u - shift[1])).sum()]
        )
        shift = shift + np.clip(2 * step / total, -0.2, 0.2)
        if np.abs(step / total).max() < 1e-6:
            break
    # Samples of the profile moved by -shift, through its own splines.
    matrices = []
    for s in shift:
        base, taps, _ = spline_taps(np.arange(size) + over * s)
        matrix = np.zeros((size, size + 20))
        for a in range(4):
            column = np.clip(base - 1 + a + 10, 0, size + 19)
            np.add.at(matrix, (np.arange(size), column), taps[:, a])
        matrices.append(matrix[:, 10:-10])
    moved = matrices[1] @ coefficients @ matrices[0].T
    moved *= over**2 / moved.sum()
    zero = np.zeros(1)
    return Profile(spline_coefficients(moved)[None], over, zero, zero), shift
