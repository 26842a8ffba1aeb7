"""Conversion between profiles and models of photutils, which takes half a second to import."""

import numpy as np

from wpdc_gwcs.centroids._profile import Profile, spline_coefficients

__all__ = ["from_photutils", "to_photutils"]


def to_photutils(profile):
    """Convert a profile to a model of photutils.

    Parameters
    ----------
    profile : Profile
        The PSF.

    Returns
    -------
    `~photutils.psf.ImagePSF` or `~photutils.psf.GriddedPSFModel`
        The model.
    """
    from astropy.nddata import NDData
    from photutils.psf import GriddedPSFModel, ImagePSF

    samples = profile.samples()
    if len(samples) == 1:
        return ImagePSF(samples[0], oversampling=profile.oversampling)
    places = [(x, y) for y in profile.y_nodes for x in profile.x_nodes]
    return GriddedPSFModel(
        NDData(samples, meta={"grid_xypos": places, "oversampling": profile.oversampling})
    )


def from_photutils(epsf):
    """Convert a model of photutils to a profile.

    Parameters
    ----------
    epsf : Profile, `~photutils.psf.ImagePSF` or `~photutils.psf.GriddedPSFModel`
        The PSF.

    Returns
    -------
    Profile
        The profile.

    Raises
    ------
    ValueError
        If the grid of the model is not square with odd sides, or its places do not form a grid.
    """
    if isinstance(epsf, Profile):
        return epsf
    oversampling = np.unique(epsf.oversampling)
    if len(oversampling) != 1:
        raise ValueError(f"oversampling must be the same on both axes, got {epsf.oversampling}")
    samples = np.asarray(epsf.data, dtype=float)
    if samples.shape[-1] != samples.shape[-2] or samples.shape[-1] % 2 == 0:
        raise ValueError(f"the PSF must be a square with odd sides, got {samples.shape[-2:]}")
    if samples.ndim == 2:
        return Profile.constant(samples, int(oversampling[0]))
    x, y = np.asarray(epsf.grid_xypos, dtype=float).T
    order = np.lexsort([x, y])
    nodes = np.unique(x), np.unique(y)
    if len(nodes[0]) * len(nodes[1]) != len(x):
        raise ValueError("the places of the PSFs must form a rectangular grid")
    return Profile(spline_coefficients(samples[order]), int(oversampling[0]), *nodes)
