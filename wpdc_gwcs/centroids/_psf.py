"""The profile of a frame: constant or varying, smooth or with finer structure."""

import logging

import numpy as np

from wpdc_gwcs.centroids._blends import judge_profiles
from wpdc_gwcs.centroids._build import OVERSAMPLING, fit_moffat, learn_profile
from wpdc_gwcs.centroids._fit import fit_radius, fit_stars
from wpdc_gwcs.centroids._noise import Noise
from wpdc_gwcs.centroids._profile import Profile, moffat_samples
from wpdc_gwcs.centroids._variation import vary_profile
from wpdc_gwcs.centroids._wings import with_wings
from wpdc_gwcs.threads import one_blas_thread

__all__ = ["MIN_STARS", "learn_psf"]

log = logging.getLogger(__name__)

# Least number of stars for a profile.
MIN_STARS = 8
# Up to this relative error, the PSF is as smooth as its width suggests; otherwise, structure down
# to this FWHM in px is fitted.
_FAIR_MISMATCH = 0.03
_FINEST = 1.4
# Fraction of broad stars above which they are not due to chance.
_BROAD_SHARE = 0.04
# A varying PSF is better if the chi square of left-out stars is below this, relative to a constant.
_BETTER = 0.99
# Numbers of stars from which on the PSF may vary as a polynomial of degree 1, 2, 3.
_STARS_FOR_DEGREE = (30, 60, 200)


@one_blas_thread
def learn_psf(field, stars, fwhm, gain, vary):
    """Learn the profile of a frame from its stars.

    Parameters
    ----------
    field : Field
        Pixels.
    stars : Stars
        Bright, clean and isolated stars.
    fwhm : float
        FWHM in px.
    gain : float or None
        Electrons per unit of the image.
    vary : {"auto", "never"}
        Whether the profile may vary over the detector.

    Returns
    -------
    Profile or None
        The profile; None if the fits fail.
    """
    half = int(np.clip(np.ceil(3 * fwhm), 6, 20)) + 1
    noise = Noise(0.0 if gain is None else 1 / gain, 0.03)
    radius = fit_radius(fwhm)
    options = {"fwhm": fwhm, "radius": radius, "gain": gain}
    wide = radius + 0.5 * fwhm
    shape = fit_moffat(field, noise, stars.take(slice(200)), fwhm, half=half, radius=wide)
    start = Profile.constant(moffat_samples(shape, half, OVERSAMPLING), OVERSAMPLING)
    profile, stars, noise, finest = _learn_constant(field, noise, stars, start, options)
    if len(stars.x) < MIN_STARS:
        return None
    log.debug("effective PSF from %d stars, own error %.3f", len(stars.x), noise.mismatch)
    if vary != "never":
        options |= {"iterations": 2, "finest": finest}
        profile, stars = _learn_varying(field, noise, stars, profile, options)
    return with_wings(field, profile, stars)


def _learn_constant(field, noise, chosen, start, options):
    """Constant profile, its stars, its noise and the width in px of its structure."""
    fwhm, radius = options["fwhm"], options["radius"]
    profile, stars, noise = learn_profile(field, noise, chosen, start, iterations=4, **options)
    broad, _ = judge_profiles(field, profile, noise, stars, stars.flux > 0, fwhm, radius)
    if broad.mean() > _BROAD_SHARE and np.count_nonzero(~broad) >= MIN_STARS:
        # Hidden companions have made the profile broader.
        chosen = stars.take(~broad)
        profile, stars, noise = learn_profile(field, noise, chosen, start, iterations=2, **options)
    finest = best = fwhm
    while noise.mismatch > _FAIR_MISMATCH and finest > 2 * _FINEST:
        # Rings and trails have edges that are sharper than their width suggests.
        finest = max(0.25 * finest, _FINEST)
        finer = options | {"iterations": 4, "finest": finest}
        found = learn_profile(field, noise, chosen, profile, **finer)
        if len(found[1].x) >= max(MIN_STARS, len(stars.x) // 2):
            if found[2].mismatch < noise.mismatch:
                best = finest
                profile, stars, noise = found
    return profile, stars, noise, best


def _learn_varying(field, noise, stars, profile, options):
    """Profile, which varies over the detector if that is better, and its stars."""
    n, fwhm, radius = len(stars.x), options["fwhm"], options["radius"]
    kind = {"radius": radius + 0.5 * fwhm, "degree": int(np.searchsorted(_STARS_FOR_DEGREE, n))}
    if kind["degree"] == 0:
        return profile, stars
    # Every fifth star, by brightness, is left out for the test.
    left_out = np.arange(n) % 5 == 2
    tried = [profile, vary_profile(field, noise, stars.take(~left_out), profile, fwhm, **kind)]
    chi2 = [
        np.median(fit_stars(field, p, noise, stars.take(left_out), radius=radius).chi2)
        for p in tried
    ]
    log.debug("chi2 of left-out stars: constant PSF %.3f, varying PSF %.3f", *chi2)
    # More freedom only if it improves the fit.
    if not chi2[1] < _BETTER * chi2[0]:
        return profile, stars
    varying = vary_profile(field, noise, stars, profile, fwhm, **kind)
    varying, kept, noise = learn_profile(field, noise, stars, varying, **options)
    log.debug("own error of the varying PSF %.3f", noise.mismatch)
    return (varying, kept) if len(kept.x) >= MIN_STARS else (profile, stars)
