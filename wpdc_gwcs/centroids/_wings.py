"""The wings of a profile: light of bright stars beyond the pixels that it is learned from."""

from dataclasses import replace

import numpy as np

from wpdc_gwcs.centroids._profile import spline_coefficients

__all__ = ["with_wings"]

# Number of brightest stars that are used.
_MAX_STARS = 200
# Wings reach to this many times the radius of the profile, or this many px.  They end where they
# fall below this fraction of the noise of the sky next to the brightest star, or below this many
# times their own error.
_REACH, _MOST, _FAINTEST, _SEEN = 3, 30, 0.1, 2.0
# Error of a median divided by that of a mean.
_MEDIAN_COST = 1.25


def with_wings(field, profile, stars):
    """Extend a profile outward with the light around bright stars.

    Parameters
    ----------
    field : Field
        Pixels.
    profile : Profile
        The PSF, known out to its rim.
    stars : Stars
        Clean stars from which it was learned, as fitted.

    Returns
    -------
    Profile
        The profile with round wings; the light within its old rim is unchanged.

    Notes
    -----
    Wings are medians in rings of one pixel, which neighbors of a few stars do not change.  Seven
    pixels from a bright star, the wings of an Airy disk are a few times the noise of the sky.  If
    the model ended there, a ring of false companions would be found.
    """
    half = profile.radius - 1
    radius, light = _rings(field, stars, half, max(min(_REACH * half, _MOST), half + 1))
    if len(light) < 2:
        return profile
    grid = int(np.ceil(radius[-1])) + 1
    step = np.arange(-grid * profile.oversampling, grid * profile.oversampling + 1)
    r = np.hypot(step, step[:, None]) / profile.oversampling
    wings = np.exp(np.interp(r, radius, np.log(light)))
    wings[r > radius[-1] + 0.5] = 0
    old = profile.samples()
    pad = (len(step) - old.shape[-1]) // 2
    old = np.pad(old, ((0, 0), (pad, pad), (pad, pad)))
    # The old rim is that of the start, which was kept fixed.
    share = np.clip(r - (half - 1), 0, 1)
    return replace(profile, coefficients=spline_coefficients(old + share * (wings - old)))


def _rings(field, stars, first, last):
    """Radii in px of rings, as far as wings are visible, and the fraction of light in them."""
    stars = stars.take(np.argsort(stars.flux)[::-1][:_MAX_STARS])
    xc, yc, pixels, use, sky = field.cut(stars, last, np.inf)
    step = np.arange(-last, last + 1)
    dx, dy = step - (stars.x - xc)[:, None], step - (stars.y - yc)[:, None]
    ring = np.rint(np.hypot(dy[:, :, None], dx[:, None, :])).astype(np.int16).reshape(use.shape)
    use &= (ring >= first - 1) & (ring <= last)
    flux = np.broadcast_to(stars.flux[:, None], use.shape)[use]
    weight, share, ring = flux**2 / sky.variance[use], pixels[use] / flux, ring[use]
    # Weighted medians of all rings.
    order = np.argsort(share)
    order = order[np.argsort(ring[order], kind="stable")]
    weight, share, ring = weight[order], share[order], ring[order]
    radius, start = np.unique(ring, return_index=True)
    total = np.cumsum(weight)
    before = total[start] - weight[start]
    whole = np.diff(before, append=total[-1:])
    light = share[np.searchsorted(total, before + 0.5 * whole)]
    least = np.maximum(
        _FAINTEST * np.sqrt(np.median(sky.variance)) / stars.flux[0],
        _SEEN * _MEDIAN_COST / np.sqrt(whole),
    )
    seen = int(np.argmin(np.append(light > least, False)))
    return radius[:seen], np.minimum.accumulate(light[:seen])
