"""Public functions: arguments checked, tables in and out."""

import logging
import warnings

import numpy as np
from astropy.nddata import NDData

from wpdc_gwcs.centroids._build import (
    OVERSAMPLING,
    fit_moffat,
    learn_profile,
    select_stars,
    vary_profile,
)
from wpdc_gwcs.centroids._fit import Noise, estimate_noise, fit_stars, render
from wpdc_gwcs.centroids._profile import Profile, moffat_samples, spline_coefficients
from wpdc_gwcs.exceptions import CentroidWarning

__all__ = ["build_epsf", "fit_centroids"]

log = logging.getLogger(__name__)

# The bit of the column ``flags`` for a failed fit, as in `wpdc_gwcs.detection`.
_FLAG_FIT_FAILED = 64

_MIN_STARS = 8
# Stars per place from which a PSF that varies over the detector is tried.
_STARS_PER_NODE = 15


def build_epsf(data, sources, *, gain=None, error=None, n_max=800, min_snr=30.0, vary="auto"):
    r"""Effective PSF of a frame, from its bright, clean and isolated stars.

    Parameters
    ----------
    data : Background or (ny, nx) array_like
        Image without background; of a plain array, ``error`` must be given.
    sources : `~astropy.table.Table`
        Columns ``x``, ``y``, ``flux``, ``snr``, ``flags``, ``fwhm``, as from `detect_sources`.
    gain : float, optional
        Electrons per count; estimated from the data if not given.
    error : float or (ny, nx) array_like, optional
        Standard deviation of the background; only for a plain array.
    n_max : int, optional
        Greatest number of stars used.
    min_snr : float, optional
        Least signal-to-noise ratio of a star used.
    vary : {"auto", "never"}, optional
        Whether the PSF may vary over the detector: if it then describes left-out stars better.

    Returns
    -------
    `~photutils.psf.ImagePSF`, `~photutils.psf.GriddedPSFModel` or None
        The PSF, four samples per pixel; None, with a `CentroidWarning`, where there are too few
        stars.

    Warns
    -----
    CentroidWarning
        If there are too few stars.

    Notes
    -----
    An effective PSF :math:`\psi` (Anderson & King 2000, PASP 112, 1360) gives the share of the flux
    that a pixel at an offset from the star gets, so that :math:`I_{ij} = f \psi(i - x, j - y)`
    without any integration.  It is described by cubic B-splines with knots every quarter pixel; all
    coefficients come from one penalised least-squares problem over all pixels of all stars, in
    turn with the positions and fluxes.  The penalty keeps :math:`\psi` close to a Moffat profile
    that is integrated over the pixels and fitted before, as far as noise or uneven sampling leave
    it open.  That start matters: positions off by a function of the pixel phase, together with a
    profile distorted the same way, fit a single frame as well as the truth.

    Examples
    --------
    >>> from wpdc_gwcs.detection import detect_sources, subtract_background  # doctest: +SKIP
    >>> background = subtract_background(image)  # doctest: +SKIP
    >>> sources = detect_sources(background)  # doctest: +SKIP
    >>> epsf = build_epsf(background, sources)  # doctest: +SKIP
    """
    image, rms, mask = _image_of(data, error)
    if vary not in ("auto", "never"):
        raise ValueError(f"vary must be 'auto' or 'never', got {vary!r}")
    x, y, flux, snr = (np.asarray(sources[c], dtype=float) for c in ("x", "y", "flux", "snr"))
    quality = np.asarray(sources["flags"]) == 0
    fwhm = _typical_fwhm(sources)
    rows = select_stars(x, y, flux, snr, quality, fwhm, image.shape, n_max=n_max, min_snr=min_snr)
    if len(rows) >= _MIN_STARS:
        profile = _learn(image, rms, mask, (x[rows], y[rows], flux[rows]), fwhm, gain, vary)
        if profile is not None:
            return _to_photutils(profile)
    warnings.warn(
        f"no effective PSF: {len(rows)} bright, clean, isolated stars, {_MIN_STARS} needed; "
        "positions are windowed centroids",
        CentroidWarning,
    )
    return None


def _learn(image, rms, mask, stars, fwhm, gain, vary):
    """Profile from the stars chosen, or None if the fits fail."""
    half = int(np.clip(np.ceil(3 * fwhm), 6, 20)) + 1
    radius = _fit_radius(fwhm)
    noise = Noise(0.0 if gain is None else 1 / gain, 0.03)
    brightest = tuple(column[:200] for column in stars)
    shape, _ = fit_moffat(
        image, rms, mask, noise, brightest, fwhm, half=half, radius=radius + 0.5 * fwhm
    )
    base = moffat_samples(shape, half, OVERSAMPLING)
    profile, fitted, _kept, noise = learn_profile(
        image, rms, mask, noise, stars, base, fwhm=fwhm, radius=radius, gain=gain
    )
    n = len(fitted[0])
    if n < _MIN_STARS:
        return None
    log.info("effective PSF from %d stars, own error %.3f", n, noise.mismatch)
    n_nodes = int(min(4, np.sqrt(n / _STARS_PER_NODE)))
    if vary == "never" or n_nodes < 2:
        return profile
    # Every fifth star, by brightness, is left out to judge by.
    left_out = np.arange(n) % 5 == 2
    learn = tuple(column[~left_out] for column in fitted)
    test = tuple(column[left_out] for column in fitted)
    varying = vary_profile(image, rms, mask, noise, learn, profile, fwhm, image.shape, n_nodes)
    chi2 = [
        np.median(fit_stars(image, rms, mask, p, noise, *test, radius=radius).chi2)
        for p in (profile, varying)
    ]
    log.info("chi2 of left-out stars: constant PSF %.3f, varying %.3f", *chi2)
    if not chi2[1] < 0.99 * chi2[0]:
        return profile
    return vary_profile(image, rms, mask, noise, fitted, profile, fwhm, image.shape, n_nodes)


def fit_centroids(data, sources, epsf, *, gain=None, error=None, passes=3):
    r"""Fit an effective PSF to all sources.

    Parameters
    ----------
    data : Background or (ny, nx) array_like
        Image without background; of a plain array, ``error`` must be given.
    sources : `~astropy.table.Table`
        Columns ``x``, ``y``, ``flux`` to start from, and those to carry along.
    epsf : `~photutils.psf.ImagePSF` or `~photutils.psf.GriddedPSFModel`
        Effective PSF.
    gain : float, optional
        Electrons per count; estimated from the data if not given.
    error : float or (ny, nx) array_like, optional
        Standard deviation of the background; only for a plain array.
    passes : int, optional
        Number of rounds; from the second on, the neighbours' models are subtracted.

    Returns
    -------
    `~astropy.table.Table`
        Copy of the sources with new ``x``, ``y``, ``x_err``, ``y_err``, ``flux``, ``flux_err``,
        ``snr``, and ``chi2``, the chi square per degree of freedom.  Where the fit failed, the
        values stay and ``flags`` has `wpdc_gwcs.detection.FLAG_FIT_FAILED`; ``chi2`` is NaN.

    Notes
    -----
    Gauss-Newton on :math:`(x, y, f)` over the pixels within 1.25 FWHM (at least 2.5 px), with the
    weights of background, photons and the PSF's own error :math:`\epsilon`, measured on the
    residuals of bright stars:

    .. math::
        \sigma^2 = \sigma_\mathrm{sky}^2 + f \psi / g + (\epsilon f \psi)^2 .

    The errors are those of the inverse of the normal matrix.

    Examples
    --------
    >>> fit_centroids(background, sources, epsf)  # doctest: +SKIP
    """
    image, rms, mask = _image_of(data, error)
    if passes < 1:
        raise ValueError(f"passes must be at least 1, got {passes}")
    profile = _from_photutils(epsf)
    fwhm = _typical_fwhm(sources)
    radius = _fit_radius(fwhm)
    x, y, flux = (np.array(sources[c], dtype=float) for c in ("x", "y", "flux"))
    flags = (
        np.array(sources["flags"], dtype=int)
        if "flags" in sources.colnames
        else np.zeros(len(x), int)
    )
    noise = Noise(0.0 if gain is None else 1 / gain, 0.02)
    faintest = 0.1 * float(np.median(rms[:: max(1, rms.shape[0] // 500)]))
    work, own, fits = image, None, None
    for number in range(passes):
        fits = fit_stars(work, rms, mask, profile, noise, x, y, flux, radius=radius, own=own)
        near = np.hypot(fits.x - sources["x"], fits.y - sources["y"]) < max(0.5 * fwhm, 1.0)
        good = fits.valid & near
        x, y, flux = (
            np.where(good, new, old) for new, old in zip((fits.x, fits.y, fits.flux), (x, y, flux))
        )
        if number == 0:
            noise = _noise_of_frame(
                image, rms, mask, profile, noise, (x, y, flux), good & (flags == 0), radius, gain
            )
        if number < passes - 1:
            own = (x, y, np.where(good, flux, 0.0))
            work = image - render(image.shape, profile, *own, faintest=faintest)
    return _fitted_table(sources, fits, good, flags)


def _noise_of_frame(image, rms, mask, profile, noise, stars, clean, radius, gain):
    """Noise with the mismatch of the profile (and the gain) from the brightest clean stars."""
    rows = np.flatnonzero(clean)
    rows = rows[np.argsort(stars[2][rows])[::-1][:1000]]
    return estimate_noise(
        image, rms, mask, profile, noise, *(c[rows] for c in stars), radius=radius, gain=gain
    )


def _fitted_table(sources, fits, good, flags):
    """Copy of the sources with the results of the fits."""
    result = sources.copy()
    error = np.sqrt(np.where(good[:, None], np.einsum("sii->si", fits.covariance), np.nan))
    with np.errstate(divide="ignore", invalid="ignore"):
        snr = fits.flux / error[:, 2]
    columns = {
        "x": fits.x,
        "y": fits.y,
        "x_err": error[:, 0],
        "y_err": error[:, 1],
        "flux": fits.flux,
        "flux_err": error[:, 2],
        "snr": snr,
    }
    for name, values in columns.items():
        old = np.asarray(sources[name], float) if name in sources.colnames else np.nan
        result[name] = np.where(good, values, old)
    result["chi2"] = np.where(good, fits.chi2, np.nan)
    result["flags"] = flags | np.where(good, 0, _FLAG_FIT_FAILED)
    return result


def _fit_radius(fwhm):
    return max(1.25 * fwhm, 2.5)


def _typical_fwhm(sources):
    """FWHM of the stars: from detection, else the median of the column."""
    if (fwhm := sources.meta.get("fwhm")) is not None:
        return float(fwhm)
    if "fwhm" in sources.colnames and np.isfinite(sources["fwhm"]).any():
        return float(np.nanmedian(np.asarray(sources["fwhm"], dtype=float)))
    raise ValueError("the sources have no FWHM: neither a column nor an entry in meta")


def _image_of(data, error):
    """Image, noise and mask of a Background, or of a plain array and its error."""
    if hasattr(data, "rms"):
        if error is not None:
            raise ValueError("error must not be given: the Background has its own")
        return data.image, data.rms, data.mask
    image = np.asarray(data)
    if image.ndim != 2:
        raise ValueError(f"the image must be 2-D, got {image.ndim} dimensions")
    if error is None:
        raise ValueError("error must be given when data is a plain array")
    bad = ~np.isfinite(image)
    rms = np.broadcast_to(np.asarray(error, dtype=float), image.shape)
    if not (rms > 0).all():
        raise ValueError("error must be positive")
    return np.where(bad, 0.0, image), rms, bad if bad.any() else None


def _to_photutils(profile):
    from photutils.psf import GriddedPSFModel, ImagePSF

    samples = profile.samples()
    if len(samples) == 1:
        return ImagePSF(samples[0], oversampling=profile.oversampling)
    places = [(x, y) for y in profile.y_nodes for x in profile.x_nodes]
    return GriddedPSFModel(
        NDData(samples, meta={"grid_xypos": places, "oversampling": profile.oversampling})
    )


def _from_photutils(epsf):
    """Profile of an ImagePSF or GriddedPSFModel."""
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
