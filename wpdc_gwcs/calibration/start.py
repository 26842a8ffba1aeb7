"""The linear tangent-plane WCS about a reference point that stands in for a header's WCS."""

from dataclasses import dataclass
from functools import partial

import numpy as np

from wpdc_gwcs.detector import on_detector
from wpdc_gwcs.models import deproject, local_plane, project

__all__ = [
    "LinearWCS",
    "detector_center",
    "header_reference_point",
    "linear_wcs",
    "sky_of",
]


@dataclass(frozen=True, eq=False)
class LinearWCS:
    """Undistorted pixels to sky: reference point, matrix and tangent point.

    Parameters
    ----------
    crpix : (2,) ndarray
        Reference point, px, zero based.
    cd : (2, 2) ndarray
        Linear matrix, deg / px.
    crval : (2,) ndarray
        RA and Dec of the reference point, deg.
    """

    crpix: np.ndarray
    cd: np.ndarray
    crval: np.ndarray

    @property
    def scale(self):
        """Pixel scale, deg / px."""
        return float(np.sqrt(abs(np.linalg.det(self.cd))))

    def pixels(self, ra, dec):
        """Undistorted pixels of sky positions.

        Parameters
        ----------
        ra, dec : (N,) array_like
            ICRS, deg.

        Returns
        -------
        (2, N) ndarray
            Pixel coordinates x and y, zero based.
        """
        plane = np.array(project(np.asarray(ra, float), np.asarray(dec, float), self.crval))
        return np.linalg.solve(self.cd, plane) + self.crpix[:, None]

    def sky(self, x, y):
        """Sky positions of undistorted pixels.

        Parameters
        ----------
        x, y : (N,) array_like
            Pixel coordinates, zero based.

        Returns
        -------
        ra, dec : (N,) ndarray
            ICRS, deg.
        """
        pixels = np.array([np.ravel(x), np.ravel(y)], float)
        ra, dec = deproject(*(self.cd @ (pixels - self.crpix[:, None])), self.crval)
        return np.reshape(ra, np.shape(x)), np.reshape(dec, np.shape(x))


def sky_of(wcs, x, y):
    """Return the sky positions of pixels through the shared low-level interface of a WCS.

    Parameters
    ----------
    wcs : object
        WCS with ``pixel_to_world_values``.
    x, y : (N,) array_like
        Pixel coordinates, zero based.

    Returns
    -------
    ra, dec : (N,) ndarray
        ICRS, deg.
    """
    ra, dec = wcs.pixel_to_world_values(np.asarray(x, float), np.asarray(y, float))
    return np.asarray(ra, float), np.asarray(dec, float)


def detector_center(image_shape):
    """Return the center of a detector.

    Parameters
    ----------
    image_shape : (int, int)
        Shape ``(ny, nx)``.

    Returns
    -------
    (2,) ndarray
        Pixel coordinates x and y, zero based.
    """
    ny, nx = image_shape
    return np.array([(nx - 1) / 2, (ny - 1) / 2])


def header_reference_point(frame):
    """Return the reference point of the header, or the center if it is not on the detector.

    Parameters
    ----------
    frame : Frame
        Any frame.

    Returns
    -------
    (2,) ndarray
        Pixel coordinates x and y, zero based.
    """
    ny, nx = frame.image_shape
    center = detector_center(frame.image_shape)
    header = getattr(frame.wcs, "wcs", None)
    if header is None:
        return center
    crpix = np.asarray(header.crpix, float)[:2] - 1
    return crpix if on_detector(*crpix, frame.image_shape) else center


def linear_wcs(wcs, crpix):
    """Build the tangent-plane WCS that agrees with another WCS at a point.

    Parameters
    ----------
    wcs : object
        WCS with ``pixel_to_world_values``.
    crpix : (2,) ndarray
        The point, px, zero based.

    Returns
    -------
    LinearWCS
        WCS with the same sky position, scale and orientation at the point; it is exact for TAN.
    """
    crval, cd = local_plane(partial(sky_of, wcs), *crpix)
    return LinearWCS(crpix=crpix, cd=cd, crval=crval)
