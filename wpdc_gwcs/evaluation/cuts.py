"""Limits on stars and on the part of a detector, for statistics."""

from dataclasses import dataclass

import numpy as np

__all__ = ["Cuts"]

_MAGNITUDE, _SNR = "phot_g_mean_mag", "snr"


@dataclass(frozen=True)
class Cuts:
    """Limits on the stars whose residuals are used; by default there are none.

    Parameters
    ----------
    min_radius, max_radius : float, optional
        Smallest and largest distance from ``about``, px.
    about : (float, float), optional
        Point from which distances are measured, px, zero based; by default the reference point.
    min_magnitude, max_magnitude : float, optional
        Magnitudes of the brightest and of the faintest star.
    min_snr : float, optional
        Signal-to-noise ratio that stars must exceed.
    region : (float, float, float, float), optional
        Smallest and largest x, smallest and largest y, px, zero based.

    Raises
    ------
    ValueError
        If a limit is not a number, or a lower limit is not below the upper one.

    Examples
    --------
    >>> from astropy.table import Table
    >>> from wpdc_gwcs.evaluation import Cuts
    >>> stars = Table({"x": [0.0, 30.0, 90.0], "y": [0.0, 40.0, 0.0], "snr": [9.0, 50.0, 60.0]})
    >>> Cuts(min_radius=40, max_radius=80, min_snr=30).select(stars, (0.0, 0.0)).tolist()
    [False, True, False]
    """

    min_radius: float | None = None
    max_radius: float | None = None
    about: tuple[float, float] | None = None
    min_magnitude: float | None = None
    max_magnitude: float | None = None
    min_snr: float | None = None
    region: tuple[float, float, float, float] | None = None

    def __post_init__(self):
        for name, n in (("about", 2), ("region", 4)):
            value = getattr(self, name)
            if value is not None and not (len(value) == n and np.isfinite(value).all()):
                raise ValueError(f"{name} must be {n} finite numbers, got {tuple(value)}")
        for name in ("min_radius", "max_radius", "min_magnitude", "max_magnitude", "min_snr"):
            value = getattr(self, name)
            if value is not None and not np.isfinite(value):
                raise ValueError(f"{name} must be a finite number, got {value}")
        ranges = {"radius": (self.min_radius, self.max_radius)}
        ranges["magnitude"] = (self.min_magnitude, self.max_magnitude)
        if self.region is not None:
            ranges |= {"region in x": self.region[:2], "region in y": self.region[2:]}
        for name, (low, high) in ranges.items():
            if low is not None and high is not None and not low < high:
                raise ValueError(f"{name} must have its lower limit first, got {low:g} to {high:g}")

    def __bool__(self):
        """Whether there is any limit."""
        return any(value is not None for value in vars(self).values())

    def place(self, x, y, crpix):
        """Mark positions within the limits on position.

        Parameters
        ----------
        x, y : (N,) array_like
            Pixels, zero based.
        crpix : (float, float)
            Reference point, px, zero based.

        Returns
        -------
        (N,) ndarray of bool
            True for positions within.
        """
        x, y = np.asarray(x, float), np.asarray(y, float)
        inside = np.isfinite(x) & np.isfinite(y)
        x0, y0 = crpix if self.about is None else self.about
        radius = np.hypot(x - x0, y - y0)
        with np.errstate(invalid="ignore"):
            if self.min_radius is not None:
                inside &= radius > self.min_radius
            if self.max_radius is not None:
                inside &= radius < self.max_radius
            if self.region is not None:
                left, right, low, high = self.region
                inside &= (x >= left) & (x <= right) & (y >= low) & (y <= high)
        return inside

    def select(self, stars, crpix):
        """Mark stars within all limits.

        Parameters
        ----------
        stars : `~astropy.table.Table`
            Columns ``x``, ``y``, and ``phot_g_mean_mag`` and ``snr`` if these have limits.
        crpix : (float, float)
            Reference point, px, zero based.

        Returns
        -------
        (N,) ndarray of bool
            True for stars within; an unknown magnitude or ratio is outside any limit on it.

        Raises
        ------
        ValueError
            If the stars lack a column that is needed.
        """
        inside = self.place(stars["x"], stars["y"], crpix)
        limits = (
            (_MAGNITUDE, self.min_magnitude, self.max_magnitude),
            (_SNR, self.min_snr, None),
        )
        for name, low, high in limits:
            if low is None and high is None:
                continue
            if name not in stars.colnames:
                raise ValueError(
                    f"a limit on {name} needs this column, which the stars do not have"
                )
            values = np.asarray(stars[name], float)
            with np.errstate(invalid="ignore"):
                inside &= values > low if low is not None else np.isfinite(values)
                if high is not None:
                    inside &= values <= high
        return inside
