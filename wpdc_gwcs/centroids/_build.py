"""The effective PSF of a frame, learned from its stars."""

from dataclasses import replace

import numpy as np
from scipy.linalg import LinAlgError, solveh_banded
from scipy.spatial import KDTree

from wpdc_gwcs.centroids._fit import fit_stars, star_like
from wpdc_gwcs.centroids._modes import reduced_normal
from wpdc_gwcs.centroids._noise import bin_noise, estimate_noise
from wpdc_gwcs.centroids._profile import (
    Profile,
    moffat_samples,
    shift_matrix,
    spline_coefficients,
    spline_taps,
)

__all__ = [
    "OVERSAMPLING",
    "center_profile",
    "fit_moffat",
    "isolated",
    "learn_profile",
    "rank_in_parts",
    "select_stars",
]

OVERSAMPLING = 4

_SIGMA_PER_FWHM = 1 / np.sqrt(8 * np.log(2))

# Expected size of the difference between the PSF and a Moffat profile, relative to the profile: of
# its fourth differences (in units of those of a Gaussian), and of the difference itself.
_ROUGHNESS = 0.4
_DEVIATION = 0.3

# Number of parts of a frame along each axis, from which stars are taken in turn.
_PARTS = 6

# If the finest structure has at least this FWHM in px, knots every half pixel are as good as knots
# every quarter: to a thousandth for a Gaussian.  They save time for wide profiles.
_HALF_PIXEL_KNOTS = 1.8

# Pixels that deviate by more than this many sigma have the weight of pixels at this limit.
_HUBER = 3.0


def select_stars(stars, snr, quality, fwhm, shape, *, n_max, min_snr):
    """Choose bright, isolated stars, spread over the frame.

    Parameters
    ----------
    stars : Stars
        All sources.
    snr : (N,) ndarray
        Their signal-to-noise ratios.
    quality : (N,) bool ndarray
        True for those that are single, clean stars.
    fwhm : float
        FWHM in px.
    shape : (int, int)
        Shape of the image.
    n_max : int
        Maximum number of stars.
    min_snr : float
        Minimum signal-to-noise ratio.

    Returns
    -------
    (n,) int ndarray
        Rows, the brightest first.
    """
    x, y, flux = stars
    candidate = quality & (snr >= min_snr) & (flux > 0) & isolated(stars, fwhm)
    rows = np.flatnonzero(candidate)
    rows = rows[np.argsort(flux[rows])[::-1]]
    if len(rows) <= n_max:
        return rows
    # The same number from each part of the frame, as far as it has that many.
    places = np.column_stack([x[rows], y[rows]])
    rank = rank_in_parts(places, np.zeros(2), np.array(shape[::-1]))
    return rows[np.sort(np.argsort(rank, kind="stable")[:n_max])]


def rank_in_parts(places, low, high):
    """Rank stars within their parts of an area, which is divided into 6 x 6.

    Parameters
    ----------
    places : (N, 2) ndarray
        Positions of the stars, the best star first.
    low, high : (2,) ndarray
        Corners of the area.

    Returns
    -------
    (N,) int ndarray
        Number of better stars in the same part, for each star.
    """
    side = (high - low) / _PARTS
    column, row = np.clip((places - low) / np.maximum(side, 1e-9), 0, _PARTS - 1).astype(int).T
    part = row * _PARTS + column
    order = np.argsort(part, kind="stable")
    rank = np.empty(len(part), int)
    rank[order] = np.arange(len(part)) - np.searchsorted(part[order], part[order])
    return rank


def isolated(stars, fwhm):
    """Mark the stars whose neighbors are too faint or too far away to matter.

    Parameters
    ----------
    stars : Stars
        All sources.
    fwhm : float
        FWHM in px.

    Returns
    -------
    (N,) bool ndarray
        True for isolated stars.
    """
    x, y, flux = stars
    alone = np.ones(len(x), bool)
    pairs = KDTree(np.column_stack([x, y])).query_pairs(4 * fwhm, output_type="ndarray")
    if len(pairs):
        i, j = np.concatenate([pairs, pairs[:, ::-1]]).T
        near = np.hypot(x[i] - x[j], y[i] - y[j]) / fwhm
        # The closer a neighbor is, the fainter it must be; what remains of it is clipped.
        limit = 0.02 * np.maximum(near - 1, 0) ** 2
        alone[i[flux[j] > limit * flux[i]]] = False
    return alone


def fit_moffat(field, noise, stars, fwhm, *, half, radius):
    """Fit a single elliptical, pixel-integrated Moffat profile to stars.

    Parameters
    ----------
    field, noise
        As for `fit_stars`.
    stars : Stars
        Start values.
    fwhm : float
        FWHM in px to start from.
    half : int
        Half width in px of the grid of the profile.
    radius : float
        Radius in px of the pixels that are fitted.

    Returns
    -------
    (4,) ndarray
        Parameters, see `moffat_samples`.

    Notes
    -----
    An analytic profile does not depend on pixels, so positions from its fit have no error that
    depends on the pixel phase.  A free profile cannot detect such an error: positions that are off
    by any function of the phase have a corresponding profile that fits equally well.
    """
    shape = np.array([np.log(max(0.5 * np.sqrt(max(fwhm**2 - 0.7, 0.3)), 0.3)), np.log(2.0), 0, 0])
    lowest = [np.log(0.2), np.log(0.3), -0.9, -0.9]
    highest = [np.log(2 * fwhm), np.log(30.0), 0.9, 0.9]
    steps = np.diag([0.02, 0.05, 0.01, 0.01])

    def profile_of(parameters):
        return Profile.constant(moffat_samples(parameters, half, OVERSAMPLING), OVERSAMPLING)

    for _ in range(8):
        profile = profile_of(shape)
        fits = fit_stars(field, profile, noise, stars, radius=radius)
        good = star_like(fits.stars.flux, fits.chi2, fits.valid)
        if good.sum() < 3:
            break
        stars = fits.stars.take(good)
        slopes = [
            (profile_of(shape + d).coefficients - profile.coefficients) / d.sum() for d in steps
        ]
        left, right = reduced_normal(field, profile, noise, stars, slopes, radius)
        left = left.sum(axis=0)
        left[np.diag_indices(4)] *= 1.001
        change = np.linalg.lstsq(left, right.sum(axis=0), rcond=None)[0]
        shape = np.clip(shape + np.clip(change, -0.3, 0.3), lowest, highest)
        if np.abs(change).max() < 3e-3:
            break
    return shape


def learn_profile(field, noise, stars, start, *, fwhm, radius, gain, iterations, finest=None):
    """Refine a profile and the positions of its stars in turn.

    Parameters
    ----------
    field, noise
        As for `fit_stars`.
    stars : Stars
        Start values.
    start : Profile
        Profile to start from, constant or varying.  The difference from it is learned, which is the
        same for the whole detector.
    fwhm : float
        FWHM in px.
    radius : float
        Radius in px of the pixels to which positions are fitted.
    gain : float or None
        Electrons per count.
    iterations : int
        Number of rounds.
    finest : float, optional
        FWHM in px of the finest structure expected in the profile.  Default: that of the stars.

    Returns
    -------
    profile : Profile
        Profile, normalized and centered.
    stars : Stars
        Stars that were kept.
    noise : Noise
        Noise, including the error of the profile.
    """
    profile = start
    for _ in range(iterations):
        fits = fit_stars(field, profile, noise, stars, radius=radius)
        stars = fits.stars.take(star_like(fits.stars.flux, fits.chi2, fits.valid))
        if len(stars.x) == 0:
            break
        bins = bin_noise(field, profile, noise, stars, radius=radius)
        noise = estimate_noise(bins, gain)
        # No profile is known better than this, and the brightest stars alone must not decide.
        noise = replace(noise, mismatch=float(np.clip(noise.mismatch, 0.003, 0.3)))
        change = _residual_coefficients(field, noise, start, stars, fwhm, finest or fwhm)
        profile = center_profile(replace(start, coefficients=start.coefficients + change), fwhm)
    fits = fit_stars(field, profile, noise, stars, radius=radius)
    return profile, fits.stars.take(fits.valid), noise


def _residual_coefficients(field, noise, profile, stars, fwhm, finest):
    """Fit spline coefficients to the residuals of a profile by penalized least squares."""
    stride = 2 if finest >= _HALF_PIXEL_KNOTS else 1
    over, size = profile.oversampling // stride, (profile.coefficients.shape[-1] - 1) // stride + 1
    half = profile.radius - 1
    xc, yc, pixels, use, sky = field.cut(stars, half, np.inf)
    x, y, flux = stars
    shares = profile.shares(x, y)
    model = flux[:, None] * profile.evaluate(x - xc, y - yc, half, shares, gradient=False)[0]
    residual = pixels - model
    weight = use / noise.variance(sky, model)
    weight *= np.minimum(1, _HUBER / np.maximum(np.abs(residual) * np.sqrt(weight), 1e-9)) ** 2
    weight *= flux[:, None] ** 2
    residual = residual / flux[:, None]
    center = (size - 1) // 2
    base_x, taps_x, _ = spline_taps(center - over * (x - xc))
    base_y, taps_y, _ = spline_taps(center - over * (y - yc))
    taps = (taps_y[:, :, None] * taps_x[:, None, :]).reshape(-1, 16)
    # Lower half of the symmetric products.
    first, second = np.tril_indices(16)
    squares = taps[:, first] * taps[:, second]
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
        for tile in _tiles(half, over):
            right[index[tile]] += (weight[k][:, tile] * residual[k][:, tile]).T @ taps[k]
            column = index[tile][:, second]
            band[index[tile][:, first] - column, column] += weight[k][:, tile].T @ squares[k]
    prior = profile.samples().mean(axis=0)[::stride, ::stride]
    _add_prior(band, prior, fwhm, finest, over, stride**2)
    try:
        solution = solveh_banded(band, right, lower=True, overwrite_ab=True, check_finite=False)
    except LinAlgError:
        return np.zeros_like(profile.coefficients[0])
    solution = solution.reshape(size, size)
    return solution if stride == 1 else _halved(_halved(solution).T).T


def _tiles(half, over):
    """Pixels of cut-outs, in parts in which no two have a knot in common."""
    apart = 4 // over
    place = np.arange((2 * half + 1) ** 2).reshape(2 * half + 1, -1)
    return [place[i::apart, j::apart].ravel() for i in range(apart) for j in range(apart)]


def _halved(coefficients):
    """Coefficients, along the first axis, of the same splines with a knot added in each gap."""
    padded = np.pad(coefficients, ((1, 1), (0, 0)))
    finer = np.empty((2 * len(coefficients) - 1, coefficients.shape[1]))
    finer[::2] = (padded[:-2] + 6 * coefficients + padded[2:]) / 8
    finer[1::2] = (coefficients[:-1] + coefficients[1:]) / 2
    return finer


def _add_prior(band, samples, fwhm, finest, over, area):
    """Add the prior that a difference is small and smooth to banded normal equations.

    The area is that of a cell of the grid, in units of a cell of the finest grid.
    """
    size = samples.shape[0]
    center = (size - 1) // 2
    radius = np.hypot(*np.meshgrid(np.arange(size) - center, np.arange(size) - center)) / over
    # A smooth envelope of the profile, whose wings leave room for spikes and halos.
    envelope = samples.max() * (1 + (2 * radius / fwhm) ** 2 * (2**0.5 - 1)) ** -2
    sigma = finest * _SIGMA_PER_FWHM * over  # grid steps
    rough = area * (_ROUGHNESS * 3 * sigma**-4 * envelope) ** -2
    # If there is finer structure than the width suggests, the start is only an outline.
    own = area * (_DEVIATION * (fwhm / finest) * envelope) ** -2
    # Nothing is known about the rim, so the profile remains that of the start there.
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
                # The columns are distinct: no two rows of differences add to the same element.
                band[stride * (i - j), first + stride * j] += difference[i] * difference[j] * weight


def center_profile(profile, fwhm):
    """Normalize a profile to unit sum, with its windowed centroid at the origin.

    Parameters
    ----------
    profile : Profile
        Profile.
    fwhm : float
        FWHM in px of the profile and of the window.

    Returns
    -------
    Profile
        The profile, shifted and scaled at every place.
    """
    over = profile.oversampling
    size = profile.coefficients.shape[-1]
    u = (np.arange(size) - (size - 1) // 2) / over
    sigma = fwhm * _SIGMA_PER_FWHM
    moved = []
    for coefficients, samples in zip(profile.coefficients, profile.samples()):
        shift = np.zeros(2)
        for _ in range(20):
            wx = np.exp(-0.5 * ((u - shift[0]) / sigma) ** 2)
            wy = np.exp(-0.5 * ((u - shift[1]) / sigma) ** 2)
            weighted = samples * wy[:, None] * wx
            moments = [weighted.sum(0) @ (u - shift[0]), weighted.sum(1) @ (u - shift[1])]
            step = np.clip(2 * np.array(moments) / weighted.sum(), -0.2, 0.2)
            shift += step
            if np.abs(step).max() < 1e-7:
                break
        matrix_x, matrix_y = (shift_matrix(size, over * s) for s in shift)
        grid = matrix_y @ coefficients @ matrix_x.T
        moved.append(grid * over**2 / grid.sum())
    return replace(profile, coefficients=spline_coefficients(np.stack(moved)))
