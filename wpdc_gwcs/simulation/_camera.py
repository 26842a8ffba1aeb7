"""The camera of a simulation: its noise, its PSF, and light on its pixels."""

from dataclasses import dataclass

import numpy as np

SIGMA_PER_FWHM = 1 / np.sqrt(8 * np.log(2))
# Core and wings of the PSF, as (share of the flux, width in units of the core's): about a Moffat
# profile with beta = 3.5, yet separable, so that its integral over a pixel is exact.
PSF = ((0.82, 1.0), (0.18, 2.1))
# An exponential disc of unit half-light radius as a sum of Gaussians.
DISC = ((0.18, 0.28), (0.47, 0.72), (0.35, 1.45))


@dataclass(frozen=True)
class Camera:
    """What the light falls on."""

    image_shape: tuple[int, int]
    pixel_scale: float  # arcsec
    fwhm: float  # px
    psf_variation: float
    gain: float  # e- per count
    read_noise: float  # e-
    background: float  # e-
    saturation: float  # e-
    zero_point: float  # magnitude of one electron
    exposure_time: float  # s

    def flux(self, magnitude):
        return 10 ** (-0.4 * (np.asarray(magnitude) - self.zero_point))

    def widths(self, x, y):
        """Gaussian width of the PSF's core along x and y, in px, at detector positions."""
        ny, nx = self.image_shape
        a, b = 2 * np.asarray(x) / nx - 1, 2 * np.asarray(y) / ny - 1
        s = self.fwhm * SIGMA_PER_FWHM * (1 + self.psf_variation * (a * a + b * b) / 2)
        shape = self.psf_variation * (a - b) / 2
        return s * (1 + shape), s * (1 - shape)

    def snr(self, flux):
        """Signal-to-noise ratio of a star under the PSF's noise-equivalent area."""
        area = 4 * np.pi * (self.fwhm * SIGMA_PER_FWHM) ** 2
        return flux / np.sqrt(flux + area * (self.background + self.read_noise**2))

    def peak(self, flux):
        """Electrons in the brightest pixel of a star, about."""
        return flux * 0.85 / max(2 * np.pi * (self.fwhm * SIGMA_PER_FWHM) ** 2, 1.0)


def find_zero_point(magnitude, snr, fwhm, background, read_noise):
    """Magnitude of one electron at which a star of this magnitude has this S/N."""
    area = 4 * np.pi * (fwhm * SIGMA_PER_FWHM) ** 2
    flux = (snr**2 + np.sqrt(snr**4 + 4 * snr**2 * area * (background + read_noise**2))) / 2
    return magnitude + 2.5 * np.log10(flux)


def add_gaussians(image, x, y, flux, sx, sy):
    """Add Gaussians, integrated over the pixels, to an image, in place.

    Stamps are as large as it takes to leave less than 0.02 electrons per pixel outside; stars of
    one stamp size are drawn together.
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
            # Pixels off the detector get no light and any address on it.
            px *= (cx >= 0) & (cx < nx)
            py *= ((cy >= 0) & (cy < ny)) * flux[i, None]
            address = np.clip(cy, 0, ny - 1)[:, :, None] * nx + np.clip(cx, 0, nx - 1)[:, None, :]
            np.add.at(flat, address.reshape(-1), (py[:, :, None] * px[:, None, :]).reshape(-1))
