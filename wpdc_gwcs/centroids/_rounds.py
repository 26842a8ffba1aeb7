"""Fits of all stars, without the light of their neighbors, and the effect of the neighbors."""

import logging
from dataclasses import replace

import numpy as np

from wpdc_gwcs.centroids._blends import judge_profiles, weigh_neighbors
from wpdc_gwcs.centroids._build import isolated
from wpdc_gwcs.centroids._fit import StarFits, Stars, fit_radius, fit_stars, star_like
from wpdc_gwcs.centroids._joint import joint_step
from wpdc_gwcs.centroids._modes import blur_modes, mode_profiles, odd_modes
from wpdc_gwcs.centroids._noise import Noise, bin_noise, bin_odd_noise, estimate_noise
from wpdc_gwcs.detector import on_detector
from wpdc_gwcs.flags import FLAG_BLENDED, FLAG_EDGE, FLAG_EXTENDED, FLAG_SATURATED
from wpdc_gwcs.threads import one_blas_thread

__all__ = ["MAX_CHI2", "fit_all", "judge_neighbors", "near", "noise_bins"]

log = logging.getLogger(__name__)

# Number of stars whose residuals show the error of the PSF.
_MAX_STARS = 1000
_ENOUGH_ALONE = 50
# Above this reduced chi square, absolute and relative to that of sources of similar brightness, a
# source is not a star.
MAX_CHI2 = 4.0
# Relative error of the light of a neighbor outside its core: at best, for any PSF; for a saturated
# star, whose flux comes from its wings; and for a source without a model.
_LEAST_ERROR, _SATURATED_ERROR, _NO_MODEL = 0.02, 0.2, 1.0
# Number of joint steps before stars are fitted again one by one.  A companion that was found in the
# residuals would otherwise lose its position next to a star that has absorbed half of its light.
_FIRST_STEPS = 2
# Least signal-to-noise ratio of stars for the search for hidden companions.
_LEAST_SNR = 15.0
# Least distance from the edge of the image, in FWHM, at which the error of a fit is correct
# although the core of the star reaches over the edge.
_INSIDE = 0.3
# A star is blended if its neighbors add more than this many times the error that it would have
# alone, and more than this many px.
_MAX_COST, _TOLERATED_COST = 1.5, 0.01


def noise_bins(field, profile, stars, quality, fwhm, gain, *, own=None):
    """Measure the noise in the brightest stars of good quality.

    Parameters
    ----------
    field, profile
        As for `fit_stars`.
    stars : Stars
        All stars.
    quality : (N,) ndarray of bool
        True for those of good quality.
    fwhm : float
        FWHM in px.
    gain : float or None
        Electrons per unit of the image.
    own : Stars, optional
        Models of these stars were subtracted from the image.

    Returns
    -------
    bins : NoiseBins or None
        As from `bin_noise`.
    clean : Stars
        Stars in the bins, as fitted.
    own : Stars or None
        Models of these stars that were subtracted.
    """
    radius = fit_radius(fwhm)
    noise = Noise(0.0 if gain is None else 1 / gain)
    good = quality & (stars.flux > 0)
    # Stars with light of neighbors are left out if there are enough others.
    alone = good & isolated(stars, fwhm)
    rows = np.flatnonzero(alone if alone.sum() >= _ENOUGH_ALONE else good)
    rows = rows[np.argsort(stars.flux[rows])[::-1][:_MAX_STARS]]
    own = None if own is None else own.take(rows)
    fits = fit_stars(field, profile, noise, stars.take(rows), radius=radius, own=own)
    alike = star_like(fits.stars.flux, fits.chi2, fits.valid)
    clean, own = fits.stars.take(alike), None if own is None else own.take(alike)
    # The position of a star is no worse if it is a little broader or sharper than others.
    blur = blur_modes(profile.coefficients.mean(axis=0), fwhm * profile.oversampling)
    modes = mode_profiles(blur[:3], profile.oversampling)
    bins = bin_noise(field, profile, noise, clean, radius=radius, modes=modes, own=own)
    return bins, clean, own


def _with_asymmetry(noise, field, profile, stars, own, fwhm):
    """Noise with the part of the error of the profile that is odd about the star."""
    odd = odd_modes(profile.coefficients.mean(axis=0), fwhm * profile.oversampling)
    modes = mode_profiles(odd, profile.oversampling)
    radius = fit_radius(fwhm)
    bins = bin_odd_noise(field, profile, noise, stars, modes, radius=radius, own=own)
    # The photons are in the units of these bins.
    return (
        noise if bins is None else replace(noise, asymmetry=estimate_noise(bins, np.inf).mismatch)
    )


@one_blas_thread
def fit_all(scene, profile, stars, quality, fwhm, gain, passes, refit):
    """Fit all stars, and jointly improve those that share pixels.

    Parameters
    ----------
    scene : Scene
        The pixels; on return without the stars.
    profile : Profile
        The PSF.
    stars : Stars
        Start values.
    quality : (N,) ndarray of bool
        True for stars of good quality, from which the noise is measured.
    fwhm : float
        FWHM in px.
    gain : float or None
        Electrons per unit of the image.
    passes : int
        Greatest number of rounds.
    refit : bool
        Whether neighbors are subtracted from the first round on.

    Returns
    -------
    fits : StarFits
        The fits; each has the covariance of the star alone.
    noise : Noise
        Noise of the pixels.
    """
    radius = fit_radius(fwhm)
    bins, *clean = noise_bins(scene.field, profile, stars, quality, fwhm, gain, own=scene.own)
    noise = estimate_noise(bins, gain)
    noise = _with_asymmetry(noise, scene.field, profile, *clean, fwhm)
    log.debug("noise of the fits: %s", noise)
    fits, rows = StarFits.unfitted(stars), np.arange(len(stars.x))
    if refit:
        touched = scene.draw(_modelled(fits, stars, fwhm), radius)
        for _ in range(_FIRST_STEPS):
            fits, touched = _step_together(scene, profile, noise, fits, stars, touched, fwhm)
    start = _modelled(fits, stars, fwhm) if refit else stars
    fits = _fit_again(scene, profile, noise, start, rows, radius)
    rows, moved = scene.draw(_modelled(fits, stars, fwhm), radius), []
    for k in range(1, passes):
        log.debug("round %d: the light beside %d stars has changed", k, len(rows))
        if len(rows) == 0:
            break
        moved.append(rows)
        fits, rows = _step_together(scene, profile, noise, fits, stars, rows, fwhm)
    if moved:
        rows = np.unique(np.concatenate([rows, *moved]))
        start = _modelled(fits, stars, fwhm).take(rows)
        fits = fits.updated(rows, _fit_again(scene, profile, noise, start, rows, radius))
        scene.draw(_modelled(fits, stars, fwhm), radius)
    return fits, noise


def _step_together(scene, profile, noise, fits, start, rows, fwhm):
    """Fits after a joint step of some stars, and the rows whose pixels that changes."""
    radius = fit_radius(fwhm)
    rows = rows[scene.drawn.flux[rows] > 0]
    if len(rows) == 0:
        return fits, rows
    step = joint_step(scene.field, profile, noise.of_positions, scene.drawn, rows, radius)
    fits = fits.moved(rows, step)
    return fits, scene.draw(_modelled(fits, start, fwhm), radius)


def _fit_again(scene, profile, noise, start, rows, radius):
    """Fits of some stars, with the others unchanged."""
    own = None if scene.own is None else scene.own.take(rows)
    return fit_stars(scene.field, profile, noise, start, radius=radius, own=own)


@one_blas_thread
def judge_neighbors(scene, profile, noise, fits, start, flags, fwhm):
    """Find the effect of neighbors and edges on the fits, and sources broader than a star.

    Parameters
    ----------
    scene : Scene
        The pixels without the stars.
    profile : Profile
        The PSF.
    noise : Noise
        Noise of the pixels.
    fits : StarFits
        The fits.
    start : Stars
        Start values of the fits.
    flags : (N,) ndarray of int
        Flags of the sources.
    fwhm : float
        FWHM in px.

    Returns
    -------
    fits : StarFits
        The fits with the covariance of a fit of all stars together.
    shift : (N,) ndarray
        Error of the positions in px from errors of the models of neighbors.
    flags : (N,) ndarray of int
        Flags.
    """
    radius, field, own = fit_radius(fwhm), scene.field, scene.drawn
    fitted = own.flux > 0
    clean = (flags == 0) & star_like(own.flux, fits.chi2, fitted, limit=MAX_CHI2)
    shown = own.flux > _LEAST_SNR * np.sqrt(np.where(fitted, fits.covariance[:, 2, 2], np.inf))
    judged = own._replace(flux=np.where(shown, own.flux, 0.0))
    broad, excess = judge_profiles(
        field, profile, noise, judged, clean, fwhm, radius, subtracted=True
    )
    unsure = np.where(flags & FLAG_SATURATED, _SATURATED_ERROR, max(_LEAST_ERROR, noise.mismatch))
    all_light = own._replace(flux=np.where(fitted, own.flux, np.maximum(start.flux, 0)))
    alone = np.where(fitted[:, None, None], fits.covariance, np.nan)
    joint, shift = weigh_neighbors(
        field,
        profile,
        noise.of_positions,
        all_light,
        alone,
        radius,
        np.where(fitted, unsure, _NO_MODEL),
    )
    before, after = (np.sqrt(c[:, 0, 0] + c[:, 1, 1]) for c in (alone, joint))
    error = np.hypot(after, shift)
    blended = ~(error < np.maximum(_MAX_COST * before, _TOLERATED_COST)) & fitted
    flags = np.where(fitted, flags & ~FLAG_BLENDED, flags)
    inside = fitted & on_detector(own.x, own.y, field.image.shape, margin=_INSIDE * fwhm)
    flags = np.where(inside, flags & ~FLAG_EDGE, flags)
    flags |= np.where(blended, FLAG_BLENDED, 0) | np.where(broad, FLAG_EXTENDED, 0)
    joint = np.where(np.isfinite(joint), joint, alone)
    return replace(fits, covariance=joint, chi2=fits.chi2 - excess), shift, flags


def _modelled(fits, start, fwhm):
    """Stars as fitted; those without a fit keep their positions and have no flux."""
    good = fits.valid & near(fits.stars, start, fwhm)
    x, y, flux = (np.where(good, new, old) for new, old in zip(fits.stars, start, strict=True))
    return Stars(x, y, np.where(good, flux, 0.0))


def near(stars, start, fwhm):
    """Mark the fits that stayed with the source where they began.

    Parameters
    ----------
    stars, start : Stars
        Fitted stars, and start values.
    fwhm : float
        FWHM in px.

    Returns
    -------
    (N,) ndarray of bool
        True for fits that stayed.
    """
    return np.hypot(stars.x - start.x, stars.y - start.y) < max(0.5 * fwhm, 1.0)
