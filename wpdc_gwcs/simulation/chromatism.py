"""Places that depend on color: refraction by the atmosphere and lateral color of the optics."""

from dataclasses import dataclass

import numpy as np

from wpdc_gwcs.sky import angles, directions

__all__ = ["Chromatism"]


@dataclass(frozen=True, eq=False)
class Chromatism:
    """How the stars of an exposure are moved by their color, in proportion to it.

    Parameters
    ----------
    color : float
        Color that is not moved, mag.
    refraction : (float, float)
        Shift east and north, rad per magnitude.
    center : (float, float)
        Where the optical axis points, deg.
    stretch : float
        Shift away from there over the distance, per magnitude.
    """

    color: float
    refraction: tuple[float, float]
    center: tuple[float, float]
    stretch: float

    @classmethod
    def of(cls, color, *, refraction, lateral, center, rim, rng):
        """Draw that of an exposure.

        Parameters
        ----------
        color : float
            Color that is not moved, mag.
        refraction : float
            Length of the shift by the atmosphere, rad per magnitude; where the zenith is is drawn.
        lateral : float
            Shift away from the axis at the rim, rad per magnitude.
        center : (float, float)
            Where the axis points, deg.
        rim : float
            Distance of the farthest corner of the detectors, rad.
        rng : `numpy.random.Generator`
            Source of the position angle of the zenith.

        Returns
        -------
        Chromatism
            The shifts.
        """
        angle = rng.uniform(0, 2 * np.pi)
        along = (float(refraction * np.sin(angle)), float(refraction * np.cos(angle)))
        return cls(float(color), along, center, lateral / rim)

    def move(self, ra, dec, color):
        """Give the directions in which stars are seen.

        Parameters
        ----------
        ra, dec : (N,) ndarray
            Directions of stars of the color that is not moved, deg.
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
