"""Regions of the sky: one or more cones."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from wpdc_gwcs.frozen import freeze_attributes
from wpdc_gwcs.sky import angles, directions

__all__ = ["Region"]

# Cones with radii within this factor are searched together, with the largest radius.
_ALIKE = 1.1


@dataclass(frozen=True, eq=False)
class Region:
    """Part of the sky: the union of cones.

    Parameters
    ----------
    ra, dec : (N,) array_like
        Centers, deg.
    radius : (N,) array_like
        Radii, deg.

    Raises
    ------
    ValueError
        If there is no cone, or a cone is invalid.

    Examples
    --------
    >>> from wpdc_gwcs.catalogs import Region
    >>> region = Region(ra=[0.0, 90.0], dec=[0.0, 0.0], radius=[1.0, 2.0])
    >>> region.contains([359.5, 91.5, 91.5], [0.0, 0.0, 2.0]).tolist()
    [True, True, False]
    """

    ra: np.ndarray
    dec: np.ndarray
    radius: np.ndarray

    def __post_init__(self):
        for name in ("ra", "dec", "radius"):
            values = np.array(getattr(self, name), float, ndmin=1)
            object.__setattr__(self, name, values)
        if not len(self.ra) == len(self.dec) == len(self.radius) > 0:
            raise ValueError("a region needs at least one cone, and as many centers as radii")
        wrong = ~(np.isfinite(self.ra) & (np.abs(self.dec) <= 90) & (self.radius >= 0))
        wrong |= ~np.isfinite(self.radius)
        if wrong.any():
            k = int(np.flatnonzero(wrong)[0])
            raise ValueError(
                "a cone needs a right ascension, a declination in [-90, 90] deg and a radius >= 0 "
                f"deg, got {self.ra[k]:g}, {self.dec[k]:g}, {self.radius[k]:g}"
            )
        freeze_attributes(self, "ra", "dec", "radius")

    @classmethod
    def box(cls, west, east, south, north):
        """Return a cone around a box in right ascension and declination.

        Parameters
        ----------
        west, east : float
            Right ascension, deg: increasing from `west` to `east`, across 0 if `east` is less.
        south, north : float
            Declination, deg.

        Returns
        -------
        Region
            Region of a single cone.

        Raises
        ------
        ValueError
            If the box is invalid.
        """
        if not (np.isfinite([west, east]).all() and -90 <= south < north <= 90):
            raise ValueError(
                "a box needs right ascensions, and declinations from south to north in [-90, 90] "
                f"deg, got {west:g}, {east:g}, {south:g}, {north:g}"
            )
        width = (east - west) % 360.0 or 360.0
        u, v = (c.ravel() for c in np.meshgrid(np.linspace(0, 1, 65), np.linspace(0, 1, 65)))
        ra, dec = west + width * u, south + (north - south) * v
        center = directions(west + width / 2, (south + north) / 2)[0]
        far = np.linalg.norm(directions(ra, dec)[0] - center[:, None], axis=0).max()
        center = angles(center)
        # Allows for the curved rim between these points.
        margin = 2 * max(width, north - south) / 64
        radius = np.degrees(2 * np.arcsin(min(far / 2, 1.0))) + margin
        return cls(center[0], center[1], min(radius, 180.0))

    def widened(self, factor, margin):
        """Return the region with every cone widened.

        Parameters
        ----------
        factor : float
            Factor on the radii.
        margin : float
            Margin added to the radii, deg.

        Returns
        -------
        Region
            Region with the same centers.
        """
        return Region(self.ra, self.dec, np.minimum(factor * self.radius + margin, 180.0))

    def contains(self, ra, dec, reach=0.0):
        """Mark positions that are in the region.

        Parameters
        ----------
        ra, dec : (N,) array_like
            Positions, deg.
        reach : float, optional
            How far outside they may be, deg.

        Returns
        -------
        (N,) ndarray of bool
            True inside; positions just outside a cone of a group of similar radii may be included.
        """
        points = directions(ra, dec)[0].reshape(3, -1).T
        inside = np.zeros(len(points), bool)
        finite = np.isfinite(points).all(axis=1)
        centers = directions(self.ra, self.dec)[0].T
        radius = np.minimum(self.radius + reach, 180.0)
        group = np.ceil(np.log(np.maximum(radius, 1e-9)) / np.log(_ALIKE))
        for one in np.unique(group):
            alike = group == one
            chord = 2 * np.sin(np.radians(radius[alike].max()) / 2)
            todo = np.flatnonzero(finite & ~inside)
            # The search excludes its bound.
            bound = chord * (1 + 1e-12) + 1e-15
            near, _ = cKDTree(centers[alike]).query(points[todo], distance_upper_bound=bound)
            inside[todo] = np.isfinite(near)
        return inside
