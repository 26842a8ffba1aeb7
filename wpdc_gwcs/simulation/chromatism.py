"""Color-dependent positions: differential refraction and lateral color of the optics."""

from dataclasses import dataclass

import numpy as np

from wpdc_gwcs.sky import angles, directions

__all__ = ["Chromatism"]


@dataclass(frozen=True, eq=False)
class Chromatism:
    """Shifts of the stars of an exposure in proportion to their color.

    Parameters
    ----------
    color : float
        Color without a shift, mag.
    refraction : (float, float)
        Shift east and north, rad per magnitude.
    center : (float, float)
        Direction of the optical axis, deg.
    stretch : float
        Shift away from the axis relative to the distance from it, per magnitude.
    """

    color: float
    refraction: tuple[float, float]
    center: tuple[float, float]
    stretch: float

    @classmethod
    def of(cls, color, *, refraction, lateral, center, rim, rng):
        """Draw the shifts of an exposure.

        Parameters
        ----------
        color : float
            Color without a shift, mag.
        refraction : float
            Shift by the atmosphere, rad per magnitude; the direction of the zenith is random.
        lateral : float
            Shift away from the axis at the rim, rad per magnitude.
        center : (float, float)
            Direction of the axis, deg.
        rim : float
            Distance of the farthest corner of the detectors, rad.
        rng : `numpy.random.Generator`
            Generator for the position angle of the zenith.

        Returns
        -------
        Chromatism
            The shifts.
        """
        angle = rng.uniform(0, 2 * np.pi)
        along = (float(refraction * np.sin(angle)), float(refraction * np.cos(angle)))
        return cls(float(color), along, center, lateral / rim)

    def move(self, ra, dec, color):
        """Return the apparent directions of stars.

        Parameters
        ----------
        ra, dec : (N,) ndarray
            Directions of the stars at the color without a shift, deg.
        color : (N,) ndarray
            Their colors, mag.

        Returns
        -------
        ra, dec : (N,) ndarray
            Directions, deg.
        """
        p, e, n = directions(ra, dec)
        axis = directions(*self.center)[0][:, None]
        along = e * self.refraction[0] + n * self.refraction[1]
        away = p - (axis * p).sum(axis=0) * axis
        return angles(p + (color - self.color) * (along + self.stretch * away))
