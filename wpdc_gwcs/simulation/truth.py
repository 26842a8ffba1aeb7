"""The truth about a frame: an exact map from its pixels to the sky and back."""

from dataclasses import dataclass, field

import numpy as np
from astropy.wcs import WCS

from wpdc_gwcs.simulation.distortion import Distortion

__all__ = ["FrameTruth"]


@dataclass(frozen=True, eq=False)
class FrameTruth:
    """The true mapping of a frame.

    Parameters
    ----------
    name : str
        Name of the frame.
    detector : str
        Name of the detector.
    epoch : float
        Epoch of mid-exposure, Julian years.
    exposure : str or None
        Name that the frames of all detectors of a mosaic exposure share; `None` for a single
        detector.
    distortion : Distortion
        The distortion of the detector.
    linear_wcs : `astropy.wcs.WCS`
        The true WCS of undistorted pixels.
    color : float, optional
        Color that the map is for, if positions depend on color.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs import simulate
    >>> truth = simulate(1, image_shape=(256, 256), distortion=5, seed=1).exposures[0]
    >>> x, y = truth.pixel(*truth.sky(10.0, 20.0))
    >>> round(float(x), 6), round(float(y), 6)
    (10.0, 20.0)
    >>> dx, dy = truth.error_at(truth.linear_wcs, 0.0, 0.0)  # the distortion is missing
    >>> float(np.hypot(dx, dy)) > 1
    True
    """

    name: str
    detector: str
    epoch: float
    exposure: str | None
    distortion: Distortion
    linear_wcs: WCS
    color: float | None = field(default=None, kw_only=True)

    @property
    def image_shape(self):
        """Shape of the detector ``(ny, nx)``."""
        return self.distortion.image_shape

    def sky(self, x, y):
        """Return the true sky position of detector pixels.

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
        """Return the true detector pixel of sky positions.

        Parameters
        ----------
        ra, dec : array_like
            ICRS, degrees, near the frame.

        Returns
        -------
        x, y : ndarray
            Detector pixel coordinates, zero based; also outside the detector.
        """
        return self.distortion.distort(*self.linear_wcs.wcs_world2pix(ra, dec, 0))

    def error_at(self, wcs, x, y):
        """Return the error of a WCS against the truth at detector positions.

        Parameters
        ----------
        wcs : callable or object with ``pixel_to_world_values``
            The WCS to judge: zero-based pixels to ICRS degrees.
        x, y : (N,) array_like
            Detector pixels.

        Returns
        -------
        dx, dy : (N,) ndarray
            Error in pixels, along the axes of undistorted pixels.
        """
        to_sky = getattr(wcs, "pixel_to_world_values", wcs)
        found_x, found_y = self.linear_wcs.wcs_world2pix(*to_sky(x, y), 0)
        true_x, true_y = self.distortion.undistort(x, y)
        return found_x - true_x, found_y - true_y

    def wcs_error(self, wcs, *, n_grid=101):
        """Return the error of a WCS against the truth on a grid over the detector.

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
        return x, y, *self.error_at(wcs, x, y)
