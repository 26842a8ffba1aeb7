"""Public functions: arguments checked, tables in and out."""

import logging
import warnings
from dataclasses import dataclass, replace

import numpy as np

from wpdc_gwcs.centroids._blends import judge_profiles, weigh_neighbors
from wpdc_gwcs.centroids._build import (
    OVERSAMPLING,
    fit_moffat,
    isolated,
    learn_profile,
    select_stars,
    vary_profile,
)
from wpdc_gwcs.centroids._fit import (
    Field,
    StarFits,
    Stars,
    fit_stars,
    render,
    star_like,
)
from wpdc_gwcs.centroids._modes import blur_modes, mode_profiles
from wpdc_gwcs.centroids._noise import Noise, bin_noise, estimate_noise, least_gain
from wpdc_gwcs.centroids._profile import Profile, moffat_samples, spline_coefficients
from wpdc_gwcs.exceptions import CentroidWarning
from wpdc_gwcs.flags import FLAG_BLENDED, FLAG_EXTENDED, FLAG_FIT_FAILED, FLAG_SATURATED
from wpdc_gwcs.selection import select_sources
from wpdc_gwcs.threads import one_blas_thread

__all__ = ["StarNoise", "build_epsf", "fit_centroids", "measure_noise", "subtract_stars"]

log = logging.getLogger(__name__)

# Pixels of an image that are worked on at a time.
_STRIP = 500_000

# Stars whose residuals tell the error of the PSF.
_MAX_STARS = 1000
_MIN_STARS = 8
_ENOUGH_ALONE = 50
# Share of the noise in stars that must be that of their photons to tell the gain.
_LEAST_PHOTONS = 0.1
# Reduced chi square, absolute and relative to that of sources as bright, from which a source is
# not a star.
_MAX_CHI2 = 4.0
# Reduced chi square up to which the formal errors stand; beyond, they grow with its root.
_TOLERATED_CHI2 = 1.5
# Light of neighbors, in standard deviations of the sky, that does not matter to a fit.
_NEGLIGIBLE = 0.05
_CHUNK = 10_000
# Relative error of a neighbor's light beside its core: what any PSF is known to at best, what that
# of a saturated star is, whose flux comes from its wings, and that of a source that has no model.
_LEAST_ERROR, _SATURATED_ERROR, _NO_MODEL = 0.02, 0.2, 1.0
# A star is blended where its neighbors cost it more than this many times the error it would have
# alone, and more than so many px.
_MAX_COST, _TOLERATED_COST = 1.5, 0.01
# Error of the PSF, relative, below which a residual is no sign of another star.
_MODEL_ERROR = 0.1
# Error of the PSF, relative, up to which it is as smooth as its width tells; and the FWHM in px of
# the finest structure looked for otherwise.
_FAIR_MISMATCH = 0.03
_FINEST = 1.4
# Share of broad stars that is not chance.
_BROAD_SHARE = 0.04
# Stars from which the PSF may vary as a polynomial of degree 1, 2, 3 over the detector.
_STARS_FOR_DEGREE = (30, 60, 200)


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
    >>> import numpy as np
    >>> from wpdc_gwcs import build_epsf, detect_sources
    >>> from wpdc_gwcs.detection import subtract_background
    >>> rng = np.random.default_rng(1)
    >>> y, x = np.mgrid[:200, :200]
    >>> image = rng.normal(100, 5, x.shape)
    >>> for x0, y0 in 20 * np.mgrid[1:10, 1:10].reshape(2, -1).T + rng.uniform(-2, 2, (81, 2)):
    ...     image += 3000 * np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / 3)
    >>> background = subtract_background(image)
    >>> sources = detect_sources(background)
    >>> epsf = build_epsf(background, sources)
    >>> epsf.oversampling
    array([4, 4])
    """
    field, unit = _field_of(data, error)
    if vary not in ("auto", "never"):
        raise ValueError(f"vary must be 'auto' or 'never', got {vary!r}")
    stars = _stars_of(sources, unit)
    snr = np.asarray(sources["snr"], dtype=float)
    quality = select_sources(sources)
    fwhm = _typical_fwhm(sources)
    rows = select_stars(stars, snr, quality, fwhm, field.image.shape, n_max=n_max, min_snr=min_snr)
    if len(rows) >= _MIN_STARS:
        profile = _learn(field, stars.take(rows), fwhm, _per_unit(gain, unit), vary)
        if profile is not None:
            return _to_photutils(profile)
    warnings.warn(
        f"no effective PSF: {len(rows)} bright, clean, isolated stars, {_MIN_STARS} needed; "
        "positions are windowed centroids",
        CentroidWarning,
    )
    return None


@one_blas_thread
def _learn(field, stars, fwhm, gain, vary):
    """Profile from the stars chosen, or None if the fits fail."""
    half = int(np.clip(np.ceil(3 * fwhm), 6, 20)) + 1
    radius = _fit_radius(fwhm)
    wide = radius + 0.5 * fwhm
    noise = Noise(0.0 if gain is None else 1 / gain, 0.03)
    shape = fit_moffat(field, noise, stars.take(slice(200)), fwhm, half=half, radius=wide)
    start = Profile.constant(moffat_samples(shape, half, OVERSAMPLING), OVERSAMPLING)
    options = {"fwhm": fwhm, "radius": radius, "gain": gain}
    chosen = stars
    profile, stars, noise = learn_profile(field, noise, chosen, start, iterations=4, **options)
    broad, _ = judge_profiles(field, profile, noise, stars, stars.flux > 0, fwhm, radius)
    if broad.mean() > _BROAD_SHARE and np.count_nonzero(~broad) >= _MIN_STARS:
        # Hidden companions have made the profile broader.
        chosen = stars.take(~broad)
        profile, stars, noise = learn_profile(field, noise, chosen, start, iterations=2, **options)
    finest = fwhm
    while noise.mismatch > _FAIR_MISMATCH and finest > 2 * _FINEST:
        # Rings and trails have edges that are finer than they are wide.
        finest = max(0.25 * finest, _FINEST)
        finer = options | {"iterations": 4, "finest": finest}
        found = learn_profile(field, noise, chosen, profile, **finer)
        if len(found[1].x) >= max(_MIN_STARS, len(stars.x) // 2):
            if found[2].mismatch < noise.mismatch:
                options["finest"] = finest
                profile, stars, noise = found
    n = len(stars.x)
    if n < _MIN_STARS:
        return None
    log.info("effective PSF from %d stars, own error %.3f", n, noise.mismatch)
    degree = int(np.searchsorted(_STARS_FOR_DEGREE, n))
    if vary == "never" or degree == 0:
        return profile
    # Every fifth star, by brightness, is left out to judge by.
    left_out = np.arange(n) % 5 == 2
    options["iterations"] = 2
    trial = {"radius": wide, "degree": degree}
    varying = vary_profile(field, noise, stars.take(~left_out), profile, fwhm, **trial)
    chi2 = [
        np.median(fit_stars(field, p, noise, stars.take(left_out), radius=radius).chi2)
        for p in (profile, varying)
    ]
    log.info("chi2 of left-out stars: constant PSF %.3f, varying %.3f", *chi2)
    if not chi2[1] < 0.99 * chi2[0]:
        return profile
    varying = vary_profile(field, noise, stars, profile, fwhm, **trial)
    varying, stars, noise = learn_profile(field, noise, stars, varying, **options)
    log.info("own error of the varying PSF %.3f", noise.mismatch)
    return varying if len(stars.x) >= _MIN_STARS else profile


def fit_centroids(data, sources, epsf, *, gain=None, error=None, passes=3, refit=False):
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
        Number of rounds; from the second on, the neighbors' models are subtracted.
    refit : bool, optional
        The sources have been fitted before, or found beside such: neighbors are subtracted from
        the first round on.  A source on the flank of a brighter one needs that.

    Returns
    -------
    `~astropy.table.Table`
        Copy of the sources with new ``x``, ``y``, ``x_err``, ``y_err``, ``flux``, ``flux_err``,
        ``snr``, and ``chi2``, the chi square per degree of freedom.  Where the fit failed, the
        values stay and ``flags`` has `wpdc_gwcs.detection.FLAG_FIT_FAILED`; ``chi2`` is NaN.
        The flag is also set where the fit is far worse than that of other sources as bright.

    Notes
    -----
    Gauss-Newton on :math:`(x, y, f)` over the pixels within 1.25 FWHM (at least 2.5 px), with the
    weights of background, photons and the PSF's own error :math:`\epsilon`, measured on the
    residuals of bright stars:

    .. math::
        \sigma^2 = \sigma_\mathrm{sky}^2 + f \psi / g
                   + \epsilon^2 f^2 \psi \psi_\mathrm{max} .

    The errors are those of all stars fitted together: of the normal matrix with the neighbors
    eliminated, times :math:`\sqrt{\chi^2 / 1.5}` where that is more than 1, and what is wrong in
    the models of the neighbors besides.  Where neighbors cost a star more than half of its error
    and more than 0.01 px, `wpdc_gwcs.detection.FLAG_BLENDED` is set, and it is cleared elsewhere;
    where the profile is broader than those of other stars, `wpdc_gwcs.detection.FLAG_EXTENDED`.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs import build_epsf, fit_centroids, detect_sources
    >>> from wpdc_gwcs.detection import subtract_background
    >>> rng = np.random.default_rng(1)
    >>> y, x = np.mgrid[:200, :200]
    >>> image = rng.normal(100, 5, x.shape)
    >>> for x0, y0 in 20 * np.mgrid[1:10, 1:10].reshape(2, -1).T + rng.uniform(-2, 2, (81, 2)):
    ...     image += 3000 * np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / 3)
    >>> background = subtract_background(image)
    >>> sources = detect_sources(background)
    >>> epsf = build_epsf(background, sources)
    >>> fitted = fit_centroids(background, sources, epsf)
    >>> bool(abs(fitted["x"][-1] - x0) < 0.02), bool(abs(fitted["y"][-1] - y0) < 0.02)
    (True, True)
    """
    field, unit = _field_of(data, error, saturation=sources.meta.get("saturation"))
    if passes < 1:
        raise ValueError(f"passes must be at least 1, got {passes}")
    profile = _from_photutils(epsf)
    fwhm = _typical_fwhm(sources)
    stars = _stars_of(sources, unit)
    quality = select_sources(sources)
    flags = (
        np.array(sources["flags"], int)
        if "flags" in sources.colnames
        else np.zeros(len(stars.x), int)
    )
    gain = _per_unit(gain, unit)
    fits, shift, flags = _fit(field, profile, stars, quality, flags, fwhm, gain, passes, refit)
    return _fitted_table(sources, fits, shift, flags, fwhm, unit)


@one_blas_thread
def subtract_stars(background, sources, epsf, *, gain=None):
    """Take the models of fitted stars off an image.

    Parameters
    ----------
    background : Background
        Image without background.
    sources : `~astropy.table.Table`
        Result of `fit_centroids`; rows without a fit (``chi2`` is NaN) are left in the image.
    epsf : `~photutils.psf.ImagePSF` or `~photutils.psf.GriddedPSFModel`
        Effective PSF.
    gain : float, optional
        Electrons per count.

    Returns
    -------
    Background
        The residual image.  Its ``rms`` is that of the background, of the stars' photons and of
        an error of the PSF by 10 %: what stands out of it is no residual of a known star.

    Examples
    --------
    See `wpdc_gwcs.detection.detect_companions`.
    """
    profile = _from_photutils(epsf)
    drawn = np.isfinite(np.asarray(sources["chi2"], dtype=float))
    stars = _stars_of(sources, background.unit).take(drawn)
    model = render(background.image.shape, profile, stars)
    rms = np.empty(model.shape, dtype=np.float32)
    # In strips: work space for whole images takes longer to be had than the work itself.
    step = max(1, _STRIP // model.shape[1])
    for start in range(0, len(model), step):
        rows = slice(start, start + step)
        variance = background.rms[rows].astype(np.float32) ** 2 + (_MODEL_ERROR * model[rows]) ** 2
        if gain is not None:
            photons = np.maximum(model[rows], 0) / (gain * background.unit)
            if background.photons is not None:
                photons = photons * background.photons[rows]
            variance += photons
        np.sqrt(variance, out=rms[rows])
        np.subtract(background.image[rows], model[rows], out=model[rows])
    return replace(background, image=model, rms=rms)


@dataclass(frozen=True)
class StarNoise:
    """What the residuals of bright stars tell of an image.

    Parameters
    ----------
    gain : float
        Electrons per count by which the noise grows with the stars' light; NaN where errors of the
        PSF hide it.
    least_gain : float
        Gain below which the photons alone would make more noise than there is, 0 if unknown.
    mismatch : float
        Error of the PSF at its peak, relative to its value there.
    n_stars : int
        Number of stars.
    """

    gain: float
    least_gain: float
    mismatch: float
    n_stars: int


@one_blas_thread
def measure_noise(data, sources, epsf, *, error=None):
    """Measure gain and error of the PSF on the residuals of bright stars.

    Parameters
    ----------
    data : Background or (ny, nx) array_like
        Image without background; of a plain array, ``error`` must be given.
    sources : `~astropy.table.Table`
        As for `fit_centroids`.
    epsf : `~photutils.psf.ImagePSF` or `~photutils.psf.GriddedPSFModel`
        Effective PSF.
    error : float or (ny, nx) array_like, optional
        Standard deviation of the background; only for a plain array.

    Returns
    -------
    StarNoise
        Gain, error of the PSF, number of stars.

    Notes
    -----
    A PSF that was made from the same stars has taken some of their noise into it, and the gain
    comes out up to a third too high; from one that was made from other stars it is right.

    Examples
    --------
    See `fit_centroids`.
    """
    field, unit = _field_of(data, error, saturation=sources.meta.get("saturation"))
    fwhm = _typical_fwhm(sources)
    stars = _stars_of(sources, unit)
    quality = select_sources(sources)
    bins, n = _noise_bins(field, _from_photutils(epsf), stars, quality, fwhm, None)
    noise = estimate_noise(bins)
    gain = np.nan
    if bins is not None:
        photons = np.median(noise.inverse_gain * bins.photons / bins.measured)
        gain = 1 / (noise.inverse_gain * unit) if photons > _LEAST_PHOTONS else np.nan
    return StarNoise(float(gain), least_gain(bins) / unit, noise.mismatch, n)


def _noise_bins(field, profile, stars, quality, fwhm, gain):
    """Noise in the brightest stars of good quality, and how many they are."""
    radius = _fit_radius(fwhm)
    noise = Noise(0.0 if gain is None else 1 / gain)
    good = quality & (stars.flux > 0)
    # Neighbors' light is no noise, if enough stars have none.
    alone = good & isolated(stars, fwhm)
    candidates = np.flatnonzero(alone if alone.sum() >= _ENOUGH_ALONE else good)
    candidates = candidates[np.argsort(stars.flux[candidates])[::-1][:_MAX_STARS]]
    fits = fit_stars(field, profile, noise, stars.take(candidates), radius=radius)
    clean = star_like(fits.stars.flux, fits.chi2, fits.valid)
    # A star that is a little broader or sharper than others has no worse position.
    blur = blur_modes(profile.coefficients.mean(axis=0), fwhm * profile.oversampling)
    modes = mode_profiles(blur[:3], profile.oversampling)
    bins = bin_noise(field, profile, noise, fits.stars.take(clean), radius=radius, modes=modes)
    return bins, int(clean.sum())


@one_blas_thread
def _fit(field, profile, stars, quality, flags, fwhm, gain, passes, refit):
    """Fits of all stars, errors by neighbors, flags; those of good quality tell the noise."""
    radius = _fit_radius(fwhm)
    noise = estimate_noise(_noise_bins(field, profile, stars, quality, fwhm, gain)[0], gain)
    log.info("noise of the fits: %s", noise)
    if refit:
        fits = StarFits.unfitted(stars)
    else:
        fits = fit_stars(field, profile, noise, stars, radius=radius)
    for k in range(0 if refit else 1, passes):
        model, own = _model_of(field, profile, fits, stars, fwhm)
        rows = np.arange(len(stars.x)) if k == 0 else _disturbed(field, model, profile, own, radius)
        if len(rows) == 0:
            break
        # In the memory of the model, which is as large as the image.
        work = replace(field, image=np.subtract(field.image, model, out=model))
        again = fit_stars(work, profile, noise, own.take(rows), radius=radius, own=own.take(rows))
        fits = fits.updated(rows, again)
    return _judge_neighbors(field, profile, noise, fits, stars, flags, fwhm)


def _judge_neighbors(field, profile, noise, fits, start, flags, fwhm):
    """Fits with the covariance of all stars together, errors by neighbors, flags of blends."""
    radius = _fit_radius(fwhm)
    model, own = _model_of(field, profile, fits, start, fwhm)
    residual = replace(field, image=np.subtract(field.image, model, out=model))
    fitted = own.flux > 0
    clean = (flags == 0) & star_like(own.flux, fits.chi2, fitted, limit=_MAX_CHI2)
    broad, excess = judge_profiles(
        residual, profile, noise, own, clean, fwhm, radius, subtracted=True
    )
    unsure = np.where(flags & FLAG_SATURATED, _SATURATED_ERROR, max(_LEAST_ERROR, noise.mismatch))
    all_light = own._replace(flux=np.where(fitted, own.flux, np.maximum(start.flux, 0)))
    alone = np.where(fitted[:, None, None], fits.covariance, np.nan)
    joint, shift = weigh_neighbors(
        field, profile, noise, all_light, alone, radius, np.where(fitted, unsure, _NO_MODEL)
    )
    before, after = (np.sqrt(c[:, 0, 0] + c[:, 1, 1]) for c in (alone, joint))
    error = np.hypot(after, shift)
    blended = ~(error < np.maximum(_MAX_COST * before, _TOLERATED_COST)) & fitted
    flags = np.where(fitted, flags & ~FLAG_BLENDED, flags)
    flags |= np.where(blended, FLAG_BLENDED, 0) | np.where(broad, FLAG_EXTENDED, 0)
    joint = np.where(np.isfinite(joint), joint, alone)
    return replace(fits, covariance=joint, chi2=fits.chi2 - excess), shift, flags


def _model_of(field, profile, fits, stars, fwhm):
    """Image of all stars as fitted, and the stars in it: those without a fit have no flux."""
    good = fits.valid & _near(fits.stars, stars, fwhm)
    own = Stars(*(np.where(good, new, old) for new, old in zip(fits.stars, stars)))
    step = max(1, min(field.rms.shape) // 500)
    faintest = 0.1 * float(np.median(field.rms[::step, ::step]))
    drawn = own.take(good)
    return render(field.image.shape, profile, drawn, faintest=faintest), own._replace(
        flux=np.where(good, own.flux, 0.0)
    )


def _disturbed(field, model, profile, own, radius):
    """Rows of the stars whose pixels hold light of others that is not far below the noise."""
    lit = replace(field, image=model)
    half = int(np.ceil(radius))
    result = []
    for start in range(0, len(own.x), _CHUNK):
        stars = own.take(slice(start, start + _CHUNK))
        xc, yc, pixels, use, sky = lit.cut(stars, half, radius)
        shares = profile.shares(stars.x, stars.y)
        mine = profile.evaluate(stars.x - xc, stars.y - yc, half, shares, gradient=False)[0]
        light = pixels - stars.flux[:, None] * mine
        limit = _NEGLIGIBLE * (np.sqrt(sky.variance) + 0.01 * np.abs(pixels))
        result.append(start + np.flatnonzero((use & (np.abs(light) > limit)).any(axis=1)))
    return np.concatenate(result) if result else np.zeros(0, int)


def _near(stars, start, fwhm):
    """Mark the fits that stayed with the source they began at."""
    return np.hypot(stars.x - start.x, stars.y - start.y) < max(0.5 * fwhm, 1.0)


def _fitted_table(sources, fits, shift, flags, fwhm, unit):
    """Copy of the sources with the results of the fits, in counts."""
    result = sources.copy()
    good = fits.valid & _near(fits.stars, _stars_of(sources, unit), fwhm)
    error = np.sqrt(np.where(good[:, None], np.einsum("sii->si", fits.covariance), np.nan))
    with np.errstate(divide="ignore", invalid="ignore"):
        snr = fits.stars.flux / error[:, 2]
        # Beyond chance, a high chi square is an unseen neighbor or a PSF that does not fit.
        error *= np.sqrt(np.maximum(fits.chi2 / _TOLERATED_CHI2, 1))[:, None]
    error[:, :2] = np.hypot(error[:, :2], shift[:, None] / np.sqrt(2))
    columns = {
        "x": fits.stars.x,
        "y": fits.stars.y,
        "x_err": error[:, 0],
        "y_err": error[:, 1],
        "flux": fits.stars.flux * unit,
        "flux_err": error[:, 2] * unit,
        "snr": snr,
    }
    for name, values in columns.items():
        old = np.asarray(sources[name], float) if name in sources.colnames else np.nan
        result[name] = np.where(good, values, old)
    result["chi2"] = np.where(good, fits.chi2, np.nan)
    # Neither a star nor noise: far worse than its like, which share the error of the PSF.
    alike = star_like(fits.stars.flux, fits.chi2, good, limit=_MAX_CHI2)
    poor = ~good | (~alike & (fits.chi2 > _MAX_CHI2))
    result["flags"] = flags | np.where(poor, FLAG_FIT_FAILED, 0)
    return result


def _stars_of(sources, unit):
    x, y, flux = (np.array(sources[c], dtype=float) for c in ("x", "y", "flux"))
    return Stars(x, y, flux / unit)


def _per_unit(gain, unit):
    """Electrons in one unit of the pixels fitted."""
    return None if gain is None else gain * unit


def _fit_radius(fwhm):
    return max(1.25 * fwhm, 2.5)


def _typical_fwhm(sources):
    """FWHM of the stars: from detection, else the median of the column."""
    if (fwhm := sources.meta.get("fwhm")) is not None:
        return float(fwhm)
    if "fwhm" in sources.colnames and np.isfinite(sources["fwhm"]).any():
        return float(np.nanmedian(np.asarray(sources["fwhm"], dtype=float)))
    raise ValueError("the sources have no FWHM: neither a column nor an entry in meta")


def _field_of(data, error, saturation=None):
    """Image, noise and mask of a Background, or of a plain array and its error; and the unit."""
    if hasattr(data, "rms"):
        if error is not None:
            raise ValueError("error must not be given: the Background has its own")
        if saturation is None:
            return Field(data.image, data.rms, data.mask, data.photons), data.unit
        # The wings of a saturated star still tell its flux, which matters to its neighbors.
        full = data.data >= saturation
        mask = full if data.mask is None else full | data.mask
        return Field(data.image, data.rms, mask, data.photons), data.unit
    image = np.asarray(data)
    if image.ndim != 2:
        raise ValueError(f"the image must be 2-D, got {image.ndim} dimensions")
    if error is None:
        raise ValueError("error must be given when data is a plain array")
    bad = ~np.isfinite(image)
    error = np.asarray(error, dtype=float)
    if not (error > 0).all():
        raise ValueError("error must be positive")
    unit = float(np.median(error))
    rms = np.broadcast_to(error / unit, image.shape)
    return Field(np.where(bad, 0.0, image / unit), rms, bad if bad.any() else None), unit


def _to_photutils(profile):
    from astropy.nddata import NDData
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
