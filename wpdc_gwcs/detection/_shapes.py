"""Shapes of sources: windowed sizes, DAOFIND's roundness and sharpness, errors, flags."""

import numpy as np

from wpdc_gwcs.cutouts import cut_squares
from wpdc_gwcs.flags import FLAG_BAD_PIXEL, FLAG_EDGE, FLAG_SATURATED

__all__ = [
    "SIGMA_PER_FWHM",
    "daofind_shape",
    "measure_shapes",
    "mode",
    "sizes",
    "window",
]

SIGMA_PER_FWHM = 1 / np.sqrt(8 * np.log(2))


def window(x, y, xc, yc, half, sigma):
    """Compute the offsets of pixels from sources, and a Gaussian window.

    Parameters
    ----------
    x, y : (N,) ndarray
        Positions of the sources, px.
    xc, yc : (N,) ndarray of int
        Central pixels of the cut-outs.
    half : int
        The cut-outs are 2 half + 1 px wide.
    sigma : float
        Standard deviation of the window, px.

    Returns
    -------
    dx, dy : (N, n) ndarray
        Offsets, px, with n = 2 half + 1.
    weight : (N, n, n) ndarray
        Values of the window.
    """
    step = np.arange(-half, half + 1)
    dx = (xc - x)[:, None] + step
    dy = (yc - y)[:, None] + step
    weight = np.exp(-0.5 * (dy / sigma) ** 2)[:, :, None]
    return dx, dy, weight * np.exp(-0.5 * (dx / sigma) ** 2)[:, None, :]


def sizes(pixels, dx, dy, weight, sigma):
    """Measure the standard deviations of sources, as if they were Gaussians, under a window.

    Parameters
    ----------
    pixels : (N, n, n) ndarray
        Cut-outs.
    dx, dy, weight : ndarray
        As from `window`.
    sigma : float
        Standard deviation of the window, px.

    Returns
    -------
    (2, N) ndarray
        Standard deviations along the major and the minor axis, px; infinite for sources that are
        broader than the window, NaN for those without light.
    """
    weighted = pixels * weight
    total = weighted.sum((1, 2))
    rows, columns = weighted.sum(2), weighted.sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        mx, my = (columns * dx).sum(1) / total, (rows * dy).sum(1) / total
        xx = (columns * dx**2).sum(1) / total - mx**2
        yy = (rows * dy**2).sum(1) / total - my**2
        xy = np.einsum("sj,sji,si->s", dy, weighted, dx) / total - mx * my
        measured = 0.5 * (xx + yy) + np.multiply.outer([1, -1], np.hypot(0.5 * (xx - yy), xy))
        # Inverse variances subtract: 1/measured = 1/profile + 1/window.
        variance = np.where(measured > 0, measured * sigma**2 / (sigma**2 - measured), 0.0)
    variance[measured >= sigma**2] = np.inf
    variance[:, ~(total > 0)] = np.nan
    return np.sqrt(variance)


def measure_shapes(background, x, y, xpeak, ypeak, fwhm, gain, full):
    """Measure the errors, S/N, shapes and flags of sources from their pixels.

    Parameters
    ----------
    background : Background
        Image without background.
    x, y : (N,) ndarray
        Positions, px.
    xpeak, ypeak : (N,) ndarray of int
        Brightest pixels.
    fwhm : float
        FWHM of the stars, px.
    gain : float or None
        Electrons per unit of the image.
    full : (ny, nx) ndarray of bool or None
        True for saturated pixels.

    Returns
    -------
    dict
        Columns by name; ``peak`` is in units of the image.
    """
    image, bad = background.image, background.mask
    ny, nx = image.shape
    sigma = fwhm * SIGMA_PER_FWHM
    half = int(np.ceil(3 * sigma)) + 1
    xc, yc = np.rint(x).astype(int), np.rint(y).astype(int)
    pixels = cut_squares(image, xc, yc, half)
    dx, dy, weight = window(x, y, xc, yc, half, sigma)
    # Clamped cut-outs repeat the outermost pixels: they must not count twice.
    step = np.arange(-half, half + 1)
    outside_x = (xc[:, None] + step < 0) | (xc[:, None] + step >= nx)
    outside_y = (yc[:, None] + step < 0) | (yc[:, None] + step >= ny)
    weight *= ~(outside_y[:, :, None] | outside_x[:, None, :])
    core = np.hypot(dy[:, :, None], dx[:, None, :]) <= max(fwhm, 1.5)
    flags = np.where(
        (x < fwhm - 0.5) | (y < fwhm - 0.5) | (x > nx - 0.5 - fwhm) | (y > ny - 0.5 - fwhm),
        FLAG_EDGE,
        0,
    )
    if bad is not None:
        masked = cut_squares(bad, xc, yc, half)
        weight *= ~masked
        flags |= np.where((masked & core).any((1, 2)), FLAG_BAD_PIXEL, 0)
    if full is not None:
        full = cut_squares(full, xc, yc, half)
        flags |= np.where((full & core).any((1, 2)), FLAG_SATURATED, 0)
    variance = cut_squares(background.rms, xc, yc, half).astype(float) ** 2
    if gain is not None:
        photons = np.maximum(pixels, 0) / gain
        if background.photons is not None:
            photons *= cut_squares(background.photons, xc, yc, half)
        variance += photons
    signal = (weight * pixels).sum((1, 2))
    noise = weight**2 * variance
    with np.errstate(divide="ignore", invalid="ignore"):
        snr = signal / np.sqrt(noise.sum((1, 2)))
        x_err = 2 * np.sqrt((noise.sum(1) * dx**2).sum(1)) / signal
        y_err = 2 * np.sqrt((noise.sum(2) * dy**2).sum(1)) / signal
    positive = signal > 0
    major, minor = sizes(pixels, dx, dy, weight, sigma)
    # At the centroid, unless it is far from the peak: rings have no peak in the center.
    central = np.hypot(xc - xpeak, yc - ypeak) <= fwhm
    roundness, sharpness = daofind_shape(
        image, np.where(central, xc, xpeak), np.where(central, yc, ypeak), sigma
    )
    return {
        "x_err": np.where(positive, x_err, np.nan),
        "y_err": np.where(positive, y_err, np.nan),
        "snr": np.where(positive, snr, 0.0),
        "peak": np.where(core, pixels, -np.inf).max((1, 2)).astype(float),
        "fwhm": np.hypot(major, minor) / np.sqrt(2) / SIGMA_PER_FWHM,
        "roundness": roundness,
        "sharpness": sharpness,
        "minor": minor / SIGMA_PER_FWHM,
        "flags": flags,
    }


def daofind_shape(image, xpeak, ypeak, sigma):
    """Compute DAOFIND's GROUND roundness and sharpness at peak pixels.

    Parameters
    ----------
    image : (ny, nx) ndarray
        Image without background.
    xpeak, ypeak : (N,) ndarray of int
        Peak pixels.
    sigma : float
        Standard deviation of the stars, px.

    Returns
    -------
    roundness, sharpness : (N,) ndarray
        Roundness is NaN if a marginal distribution has no height.
    """
    half = max(2, int(1.5 * sigma))
    pixels = cut_squares(image, xpeak, ypeak, half).astype(float)
    step = np.arange(-half, half + 1)
    gauss = np.exp(-0.5 * (step / sigma) ** 2)
    triangle = half + 1.0 - np.abs(step)
    # Both marginal fits are linear in the pixels: height = sum_ij heights_ij I_ij.
    marginal = gauss * (gauss * triangle).sum()
    mean = (marginal * triangle).sum() / triangle.sum()
    profile = triangle * (marginal - mean)
    profile /= (triangle * marginal**2).sum() - mean * (marginal * triangle).sum()
    height_y = np.einsum("sji,j,i->s", pixels, profile, triangle)
    height_x = np.einsum("sji,j,i->s", pixels, triangle, profile)
    # Density enhancement: the fit of a Gaussian plus constant within 1.5 sigma (at least 2 px).
    distance = np.hypot(step[:, None], step)
    inside = (distance <= 1.5 * sigma) | (distance <= 2)
    kernel = np.where(inside, gauss[:, None] * gauss, 0)
    kernel = np.where(inside, kernel - kernel.sum() / inside.sum(), 0) / (
        (kernel**2).sum() - kernel.sum() ** 2 / inside.sum()
    )
    peak = pixels[:, half, half]
    rest = ((pixels * inside).sum((1, 2)) - peak) / (inside.sum() - 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        roundness = 2 * (height_x - height_y) / (height_x + height_y)
        sharpness = (peak - rest) / (pixels * kernel).sum((1, 2))
    return np.where((height_x > 0) & (height_y > 0), roundness, np.nan), sharpness


def mode(values):
    """Return the most frequent value and the scatter about it.

    Parameters
    ----------
    values : (N,) array_like
        At least one value.

    Returns
    -------
    value, scatter : float
        Median of the shortest third of the sorted values, and their scatter as a standard
        deviation, which is 0 for one or two values.

    Notes
    -----
    More than half of the bright sources may be cosmic rays and galaxies, but only stars are similar
    to each other.
    """
    values = np.sort(values)
    n = max(2, int(np.ceil(len(values) / 3)))
    if len(values) <= n:
        return float(np.median(values)), 0.0
    width = values[n - 1 :] - values[: len(values) - n + 1]
    first = int(np.argmin(width))
    # A third of a normal distribution lies within 0.43 standard deviations.
    return float(np.median(values[first : first + n])), float(width[first] / 0.86)
