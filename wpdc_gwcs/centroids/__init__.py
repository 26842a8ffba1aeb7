"""Positions by effective-PSF fitting: the PSF from the stars of the frame, then all sources.

::

    Background, sources --build_epsf--> photutils ImagePSF or GriddedPSFModel
    Background, sources, PSF --fit_centroids--> sources with x, y, errors, flux, chi2
"""

from wpdc_gwcs.centroids._high_level import (
    StarNoise,
    build_epsf,
    fit_centroids,
    measure_noise,
    measure_psf,
    residual_of,
    subtract_stars,
)

__all__ = [
    "StarNoise",
    "build_epsf",
    "fit_centroids",
    "measure_noise",
    "measure_psf",
    "residual_of",
    "subtract_stars",
]
