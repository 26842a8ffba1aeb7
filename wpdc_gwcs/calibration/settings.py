"""Settings of a calibration."""

import math
from dataclasses import dataclass
from numbers import Integral

import numpy as np

from wpdc_gwcs.fitting import RadialWeight
from wpdc_gwcs.selection import MAX_ROUNDNESS, MIN_SNR

__all__ = ["Settings"]

_CHOICES = {
    "method": ("wpdc", "paper"),
    "centroids": ("psf", "windowed", "given"),
    "reference_point": ("header", "center", "nearest-source"),
    "refine": ("auto", "attitude", "field", "pv"),
    "lut": ("auto", "none"),
}


@dataclass(frozen=True)
class Settings:
    """Settings of a calibration; the defaults work for any camera.

    Parameters
    ----------
    weight : str, optional
        Radial weight of the polynomial; the table contains the rest: ``exp-sqrt`` (as in the
        paper), ``gaussian``, ``inverse``, ``inverse-square`` (``w1`` to ``w4`` in the paper) or
        ``uniform``.
    r0 : float, optional
        Radius in px within which the polynomial follows the distortion; `None` is 0.87 times half
        the shorter side.
    n_grid : int, optional
        Nodes of the look-up table along each axis.
    lut : {'auto', 'none'}, optional
        A table for the residuals of the polynomial (``auto``; it includes mean residuals if they
        predict left-out ones), or the polynomial alone (``none``).
    refine : {'auto', 'attitude', 'field', 'pv'}, optional
        What is fitted for each exposure: six linear numbers (``attitude``), also a smooth field if
        there is evidence for it (``auto``) or always (``field``), or a polynomial (``pv``, as in
        the paper).
    degree : int or 'auto', optional
        Degree of the stored polynomial and highest degree of the distortion of a detector, 1 to 7.
        ``auto``: up to 7 by evidence, stored as a cubic and a table.
    centroids : {'psf', 'windowed', 'given'}, optional
        How positions are measured on images; source lists are always used as they are.
    reference_point : {'header', 'center', 'nearest-source'}, optional
        Tangent point and origin of the polynomial.  A reference point of the header that is off
        the detector is replaced by the center.
    threshold : float, optional
        Detection threshold in standard deviations of the background.
    min_snr : float, optional
        Smallest signal-to-noise ratio of the sources that are matched.  For images, it refers to an
        aperture with a radius of 1.5 FWHM, and fainter sources are not kept.  0 keeps all.
    max_roundness : float, optional
        Largest difference between the roundness of a source that is matched and that of the stars
        of the frame.
    max_mag : float, optional
        Magnitude of the faintest reference stars used; `None`: all.
    gain, saturation : float, optional
        Electrons per count, and counts at which pixels are saturated, instead of the values in the
        headers.
    holdout : float, optional
        Fraction of the reference stars, 0 to 0.9, held out of every fit and evaluated separately.
    free_stars : bool, optional
        Fit the positions of reference stars that are in several exposures, with the errors of the
        catalog as priors; for catalogs that are less accurate than the camera.
    blind : bool, optional
        Search a wide range of pointing, orientation, parity and scale for the match.
    seed : int, optional
        Seed of the random choice of held-out stars.
    method : {'wpdc', 'paper'}, optional
        One solution of all exposures with learned priors (``wpdc``), or WPDC-2P exactly as
        published (``paper``), for comparison: a polynomial for each exposure about the tangent
        point of its header, and raw residuals in a bilinear table.

    Raises
    ------
    ValueError
        If an option has a wrong value, or does not go with the method.

    Examples
    --------
    >>> from dataclasses import replace
    >>> from wpdc_gwcs import Settings
    >>> settings = Settings(refine="attitude", holdout=0.2)
    >>> replace(settings, min_snr=20).holdout
    0.2
    """

    weight: str = "exp-sqrt"
    r0: float | None = None
    n_grid: int = 50
    lut: str = "auto"
    refine: str = "auto"
    degree: int | str = "auto"
    centroids: str = "psf"
    reference_point: str = "header"
    threshold: float = 5.0
    min_snr: float = MIN_SNR
    max_roundness: float = MAX_ROUNDNESS
    max_mag: float | None = None
    gain: float | None = None
    saturation: float | None = None
    holdout: float = 0.0
    free_stars: bool = False
    blind: bool = False
    seed: int = 0
    method: str = "wpdc"

    def __post_init__(self):
        weight = RadialWeight(self.weight, r0=1000.0 if self.r0 is None else self.r0)
        object.__setattr__(self, "weight", weight.name)
        for name, choices in _CHOICES.items():
            if getattr(self, name) not in choices:
                raise ValueError(
                    f"{name} must be one of {', '.join(choices)}, got {getattr(self, name)!r}"
                )
        if self.method == "paper" and self.refine not in ("auto", "pv"):
            raise ValueError(
                "refine must be 'auto' or 'pv' with method='paper', where every exposure has "
                f"its own polynomial, got {self.refine!r}"
            )
        if self.method == "paper" and self.free_stars:
            raise ValueError("free_stars must be False with method='paper', got True")
        if self.degree != "auto" and self.degree not in range(1, 8):
            raise ValueError(f"degree must be 'auto' or 1 to 7, got {self.degree!r}")
        if not 4 <= self.n_grid <= 1000:
            raise ValueError(f"n_grid must be between 4 and 1000, got {self.n_grid}")
        if not 0 <= self.holdout <= 0.9:
            raise ValueError(f"holdout must be between 0 and 0.9, got {self.holdout}")
        if not self.threshold > 0:
            raise ValueError(f"threshold must be positive, got {self.threshold}")
        if not (isinstance(self.seed, Integral) and 0 <= self.seed < 1 << 63):
            raise ValueError(f"seed must be an integer from 0 to 2^63 - 1, got {self.seed!r}")
        if not (self.threshold < np.inf and self.min_snr < np.inf):
            raise ValueError(
                f"threshold and min_snr must be finite, got {self.threshold} and {self.min_snr}"
            )
        if not self.min_snr >= 0:
            raise ValueError(f"min_snr must be 0 or more, got {self.min_snr}")
        if self.max_mag is not None and not math.isfinite(self.max_mag):
            raise ValueError(f"max_mag must be a magnitude, got {self.max_mag}")
        for name in ("max_roundness", "gain", "saturation"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"{name} must be positive, got {value}")

    def radial_weight(self, image_shape):
        """Return the radial weight for a detector.

        Parameters
        ----------
        image_shape : (int, int)
            Shape ``(ny, nx)`` in px.

        Returns
        -------
        RadialWeight
            Weight with the chosen radius, or the default one for the detector.
        """
        if self.r0 is None:
            return RadialWeight.for_shape(image_shape, self.weight)
        return RadialWeight(self.weight, r0=self.r0)
