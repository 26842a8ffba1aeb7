"""Pointing of cameras, and the resulting WCS of each detector."""

from dataclasses import dataclass

import numpy as np
from astropy.wcs import WCS

from wpdc_gwcs.simulation.stars import offset_positions
from wpdc_gwcs.sky import angles, directions

__all__ = ["Pointing", "aim", "tan_wcs"]


@dataclass(frozen=True)
class Pointing:
    """Pointing of a camera.

    Parameters
    ----------
    ra, dec : float
        Direction of its reference point, deg.
    roll : float
        Position angle of the y axis there, north through east, deg.
    scale : float
        Angle of a pixel, arcsec.
    """

    ra: float
    dec: float
    roll: float
    scale: float

    @property
    def matrix(self):
        """Matrix from pixels of the focal plane to the tangent plane, deg."""
        c, s = np.cos(np.deg2rad(self.roll)), np.sin(np.deg2rad(self.roll))
        return self.scale / 3600 * np.array([[-c, s], [s, c]])

    def linear_wcs(self, detector, place, *, shared_tangent):
        """Return the WCS of the undistorted pixels of a detector.

        Parameters
        ----------
        detector : SimulatedDetector
            The detector.
        place : (float, float)
            Position of its center in the focal plane, px.
        shared_tangent : bool
            Whether the tangent point is that of the camera, or the center of the detector.

        Returns
        -------
        `~astropy.wcs.WCS`
            A gnomonic WCS.

        Notes
        -----
        A detector with its own tangent point is rotated rigidly with the camera, so that all
        exposures have the same map from pixels to the sphere of the camera.
        """
        cd, crpix, crval = self.matrix, np.add(detector.distortion.center, 1), (self.ra, self.dec)
        if shared_tangent:
            crpix = crpix - np.multiply(detector.axes, place)
        else:
            crval, turn = self._carry(*(cd @ place))
            cd = cd if turn is None else turn @ cd
        return tan_wcs(crpix, crval, cd * detector.axes, detector.image_shape)

    def _carry(self, east, north):
        """Direction at an offset in the tangent plane, and the rotation of its axes there.

        East and north are carried along the great circle; `None` for a zero offset.
        """
        if east == north == 0:
            return (self.ra, self.dec), None
        p, e, n = directions(self.ra, self.dec)
        along = np.deg2rad(east) * e + np.deg2rad(north) * n
        there = p + along
        there /= np.linalg.norm(there)
        carried = [v - (v @ there) / (1 + p @ there) * (p + there) for v in (e, n)]
        ra, dec = angles(there)
        _, e, n = directions(ra, dec)
        return (ra, dec), np.array([[a @ v for v in carried] for a in (e, n)])


def aim(ra, dec, roll, scale, middle):
    """Point a camera so that a position in its focal plane maps to a direction.

    Parameters
    ----------
    ra, dec : float
        The direction, deg.
    roll : float
        Position angle of the y axis, deg.
    scale : float
        Pixel scale, arcsec.
    middle : (float, float)
        The position, px of the focal plane.

    Returns
    -------
    Pointing
        The pointing; very near a pole, where position angles change within the camera, it is
        approximate.
    """
    pointing = Pointing(float(ra), float(dec), float(roll), scale)
    east, north = pointing.matrix @ middle
    if np.hypot(east, north) == 0:
        return pointing
    return Pointing(*map(float, offset_positions(ra, dec, -east, -north)), float(roll), scale)


def tan_wcs(crpix, crval, cd, image_shape):
    """Make a linear WCS in ICRS.

    Parameters
    ----------
    crpix : (2,) array_like
        Reference point, px, counted from 1.
    crval : (2,) array_like
        Its direction, deg.
    cd : (2, 2) array_like
        Matrix, deg / px.
    image_shape : (int, int)
        Shape ``(ny, nx)`` in px.

    Returns
    -------
    `~astropy.wcs.WCS`
        Gnomonic.
    """
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.cunit = ["deg", "deg"]
    wcs.wcs.crpix, wcs.wcs.crval, wcs.wcs.cd = crpix, crval, cd
    wcs.wcs.radesys = "ICRS"
    wcs.array_shape = image_shape
    wcs.wcs.set()
    return wcs
