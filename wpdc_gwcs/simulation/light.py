"""Light on simulated pixels: the PSF, and Gaussians added to images."""

import numpy as np

__all__ = ["DISC", "PSF", "SIGMA_PER_FWHM", "add_gaussians", "find_zero_point"]

SIGMA_PER_FWHM = 1 / np.sqrt(8 * np.log(2))
# Core and wings of the PSF, as (share of the flux, width in units of the core's): about a Moffat
# profile with beta = 3.5, but separable, so that its integral over a pixel is exact.
PSF = ((0.82, 1.0), (0.18, 2.1))
# An exponential disc of unit half-light radius as a sum of Gaussians.
DISC = ((0.18, 0.28), (0.47, 0.72), (0.35, 1.45))


def find_zero_point(magnitude, snr, fwhm, background, read_noise):
    """Find the magnitude of one electron at which a star of this magnitude has this S/N.

    Parameters
    ----------
    magnitude, snr : float
        Magnitude of a star and its signal-to-noise ratio.
    fwhm : float
        Width of the PSF, px.
    background, read_noise : float
        Level of the background and read noise, electrons.

    Returns
    -------
    float
        The magnitude.
    """
    area = 4 * np.pi * (fwhm * SIGMA_PER_FWHM) ** 2
    flux = (snr**2 + np.sqrt(snr**4 + 4 * snr**2 * area * (background + read_noise**2))) / 2
    return magnitude + 2.5 * np.log10(flux)


def add_gaussians(image, x, y, flux, sx, sy):
    """Add Gaussians, integrated over the pixels, to an image, in place.

    Parameters
    ----------
    image : (ny, nx) ndarray
        The image, changed in place.
    x, y : (N,) ndarray
        Centers, px, zero based.
    flux : (N,) ndarray
        Electrons of each.
    sx, sy : (N,) ndarray
        Widths along the axes, px.

    Notes
    -----
    Stamps are large enough that less than 0.02 electrons per pixel are lost outside; stars with the
    same stamp size are drawn together.
    """
    from scipy.special import ndtr

    ny, nx = image.shape
    s = np.maximum(sx, sy)
    level = np.maximum(flux / (2 * np.pi * sx * sy) / 0.02, 1.01)
    half = (np.ceil(s * np.sqrt(2 * np.log(level)) / 4) * 4 + 2).astype(int)
    flat = image.reshape(-1)
    for h in np.unique(half):
        rows = np.flatnonzero(half == h)
        block = max(1, 2_000_000 // (2 * h + 1) ** 2)
        edges = np.arange(-h, h + 2) - 0.5
        for i in np.array_split(rows, -(-len(rows) // block)):
            ix, iy = np.rint(x[i]).astype(int), np.rint(y[i]).astype(int)
            px = np.diff(ndtr((edges - (x[i] - ix)[:, None]) / sx[i, None]), axis=1)
            py = np.diff(ndtr((edges - (y[i] - iy)[:, None]) / sy[i, None]), axis=1)
            cx = ix[:, None] + np.arange(-h, h + 1)
            cy = iy[:, None] + np.arange(-h, h + 1)
            # Pixels outside the detector get zero light at an arbitrary address.
            px *= (cx >= 0) & (cx < nx)
            py *= ((cy >= 0) & (cy < ny)) * flux[i, None]
            address = np.clip(cy, 0, ny - 1)[:, :, None] * nx + np.clip(cx, 0, nx - 1)[:, None, :]
            np.add.at(flat, address.reshape(-1), (py[:, :, None] * px[:, None, :]).reshape(-1))
