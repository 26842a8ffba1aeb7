"""One simulated exposure: what was measured, and the truth about it."""

from dataclasses import dataclass, field

import numpy as np
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS

from wpdc_gwcs.frame import Frame
from wpdc_gwcs.simulation._camera import DISC, PSF, Camera, add_gaussians
from wpdc_gwcs.simulation.distortion import Distortion

__all__ = ["SimulatedExposure"]


@dataclass(frozen=True, eq=False)
class SimulatedExposure:
    """One exposure and the truth about it, made by `simulate`.

    Parameters
    ----------
    name : str
        Name of the exposure.
    detector : str
        Name of the detector.
    epoch : float
        Epoch of mid-exposure, Julian years.
    header : `astropy.io.fits.Header`
        The header a camera would write: nominal TAN WCS (wrong by pointing, roll, scale and all
        of the distortion), ``DATE-OBS``, ``GAIN``, ``SATURATE``, ...
    sources : `astropy.table.Table`
        What would be measured: ``x``, ``y`` (zero based), ``x_err``, ``y_err`` in px, ``flux`` in
        counts, ``snr``, ``roundness``, and the truth ``reference_index`` (row of the reference, -1
        for a spurious source or a star that is not in it).
    stars : `astropy.table.Table`
        Every star on the detector without noise: ``x``, ``y``, ``magnitude``, ``reference_index``.
    distortion : Distortion
        The distortion of the detector.
    linear_wcs : `astropy.wcs.WCS`
        The true WCS of undistorted pixels.
    """

    name: str
    detector: str
    epoch: float
    header: fits.Header
    sources: Table
    stars: Table
    distortion: Distortion
    linear_wcs: WCS
    _camera: Camera = field(repr=False)
    _seed: object = field(repr=False)

    @property
    def image_shape(self):
        """Shape of the detector ``(ny, nx)``."""
        return self.distortion.image_shape

    @property
    def wcs(self):
        """Starting WCS: the nominal one, from the header."""
        return WCS(self.header)

    def sky(self, x, y):
        """Give the true sky position of detector pixels.

        Parameters
        ----------
        x, y : array_like
            Detector pixel coordinates, zero based.

        Returns
        -------
        ra, dec : ndarray
            ICRS, degrees.
        """
        return self.linear_wcs.wcs_pix2world(*self.distortion.undistort(x, y), 0)

    def pixel(self, ra, dec):
        """Give the true detector pixel of sky positions.

        Parameters
        ----------
        ra, dec : array_like
            ICRS, degrees, of the exposure's own part of the sky.

        Returns
        -------
        x, y : ndarray
            Detector pixel coordinates, zero based, also beyond the edges of the detector.
        """
        return self.distortion.distort(*self.linear_wcs.wcs_world2pix(ra, dec, 0))

    def wcs_error(self, wcs, *, n_grid=101):
        """Error of a WCS against the truth on a regular grid over the detector.

        Parameters
        ----------
        wcs : callable or object with ``pixel_to_world_values``
            The WCS to judge: zero-based pixels to ICRS degrees.
        n_grid : int, optional
            Number of grid points per axis.

        Returns
        -------
        x, y : (n_grid**2,) ndarray
            Detector pixels of the grid.
        dx, dy : (n_grid**2,) ndarray
            Error in pixels, along the axes of undistorted pixels.
        """
        ny, nx = self.image_shape
        y, x = np.mgrid[0 : ny - 1 : n_grid * 1j, 0 : nx - 1 : n_grid * 1j].reshape(2, -1)
        to_sky = getattr(wcs, "pixel_to_world_values", wcs)
        found_x, found_y = self.linear_wcs.wcs_world2pix(*to_sky(x, y), 0)
        true_x, true_y = self.distortion.undistort(x, y)
        return x, y, found_x - true_x, found_y - true_y

    def frame(self, *, image=False):
        """Give the exposure as input of `~wpdc_gwcs.calibrate`.

        Parameters
        ----------
        image : bool, optional
            Give the rendered image instead of the source list.

        Returns
        -------
        Frame
            The frame, which knows nothing of the truth.
        """
        data = {"load_image": self.render} if image else {"load_sources": self._measured}
        return Frame(
            name=self.name,
            detector=self.detector,
            image_shape=self.image_shape,
            wcs=self.wcs,
            epoch=self.epoch,
            source=self.name,
            gain=self._camera.gain,
            saturation=self.header["SATURATE"],
            **data,
        )

    def _measured(self):
        columns = [c for c in self.sources.colnames if c != "reference_index"]
        return self.sources[columns]

    def render(self, *, noise=True, galaxies=0.0, cosmic_rays=0):
        """Render the image of the exposure.

        Parameters
        ----------
        noise : bool, optional
            Add photon and read noise.
        galaxies : float, optional
            Galaxies per square arcmin.
        cosmic_rays : int, optional
            Number of cosmic rays.

        Returns
        -------
        (ny, nx) ndarray of float32
            The image in counts; the same call gives the same image.

        Notes
        -----
        Stars are a core and wings, both Gaussian, integrated over the pixels exactly (differences
        of the error function); the widths vary over the detector.  Pixels end at the saturation
        level.
        """
        camera = self._camera
        ny, nx = self.image_shape
        rng = np.random.default_rng(self._seed)
        # The background is a little brighter towards one side, as it is in practice.
        image = np.empty((ny, nx))
        image[:] = camera.background * (1 + 0.05 * (np.arange(nx) / nx - 0.5))
        x, y = self.stars["x"].data, self.stars["y"].data
        flux = camera.flux(self.stars["magnitude"].data)
        sx, sy = camera.widths(x, y)
        for share, width in PSF:
            add_gaussians(image, x, y, share * flux, width * sx, width * sy)
        count = rng.poisson(galaxies * nx * ny * (camera.pixel_scale / 60) ** 2)
        if count:
            x, y = rng.uniform(0, nx, count), rng.uniform(0, ny, count)
            flux = camera.flux(self.stars["magnitude"].data.max() - rng.exponential(1.0, count))
            size = camera.fwhm * rng.uniform(0.4, 1.6, count)
            axis = np.exp(rng.normal(0, 0.25, count))
            sx, sy = camera.widths(x, y)
            for share, width in DISC:
                add_gaussians(
                    image,
                    x,
                    y,
                    share * flux,
                    np.hypot(sx, width * size * axis),
                    np.hypot(sy, width * size / axis),
                )
        if noise:
            image = rng.poisson(image) + rng.normal(0, camera.read_noise, (ny, nx))
        for _ in range(cosmic_rays):
            t = np.arange(0, rng.exponential(4) + 1, 0.5)
            angle = rng.uniform(0, 2 * np.pi)
            x = (rng.uniform(0, nx) + t * np.cos(angle)).astype(int)
            y = (rng.uniform(0, ny) + t * np.sin(angle)).astype(int)
            on = (x >= 0) & (x < nx) & (y >= 0) & (y < ny)
            image[y[on], x[on]] += rng.uniform(300, 6000)
        return (np.minimum(image, camera.saturation) / camera.gain).astype(np.float32)
