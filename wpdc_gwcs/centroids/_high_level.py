"""Public functions: they check arguments, and take and return tables."""

import warnings
from dataclasses import dataclass, replace

import numpy as np

from wpdc_gwcs.centroids._build import select_stars
from wpdc_gwcs.centroids._fit import Field, Stars, star_like
from wpdc_gwcs.centroids._noise import estimate_noise, least_gain
from wpdc_gwcs.centroids._photutils import from_photutils, to_photutils
from wpdc_gwcs.centroids._psf import MIN_STARS, learn_psf
from wpdc_gwcs.centroids._residual import Residual, Scene
from wpdc_gwcs.centroids._rounds import MAX_CHI2, fit_all, judge_neighbors, near, noise_bins
from wpdc_gwcs.counts import counted
from wpdc_gwcs.exceptions import CentroidWarning
from wpdc_gwcs.flags import FLAG_FIT_FAILED
from wpdc_gwcs.selection import select_sources
from wpdc_gwcs.threads import one_blas_thread

__all__ = [
    "StarNoise",
    "build_epsf",
    "fit_centroids",
    "measure_noise",
    "measure_psf",
    "residual_of",
    "subtract_stars",
]

# Fraction of the noise in stars that must come from photons to determine the gain.
_LEAST_PHOTONS = 0.1
# Above this reduced chi square, formal errors are multiplied by the square root of the excess.
_TOLERATED_CHI2 = 1.5
# Fraction of the motion of the center of light with the pixel phase that one frame cannot
# determine: it depends by this much on the kind of profile from which the PSF is learned.
_UNKNOWN_WOBBLE = 0.3


def build_epsf(data, sources, *, gain=None, error=None, n_max=800, min_snr=30.0, vary="auto"):
    r"""Build the effective PSF of a frame from its bright, clean and isolated stars.

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
        Maximum number of stars used.
    min_snr : float, optional
        Minimum signal-to-noise ratio of the stars used.
    vary : {"auto", "never"}, optional
        ``auto`` lets the PSF vary over the detector if it then describes left-out stars better.

    Returns
    -------
    `~photutils.psf.ImagePSF`, `~photutils.psf.GriddedPSFModel` or None
        The PSF, with four samples per pixel; None if there are too few stars.

    Raises
    ------
    ValueError
        If ``vary`` has a wrong value, if ``error`` is missing for a plain array, invalid, or given
        with a Background, or if the sources have no FWHM.

    Warns
    -----
    CentroidWarning
        If there are too few stars.

    Notes
    -----
    An effective PSF :math:`\psi` (Anderson & King 2000, PASP 112, 1360) is the fraction of the flux
    that falls into a pixel at an offset from the star, so :math:`I_{ij} = f \psi(i - x, j - y)`
    without any integration.  It is described by cubic B-splines with knots every quarter pixel.
    All coefficients come from one penalized least-squares problem over all pixels of all stars,
    which alternates with fits of the positions and fluxes.  Where noise or uneven sampling leave
    :math:`\psi` undetermined, the penalty keeps it close to a pixel-integrated Moffat profile that
    is fitted first.  This start matters: positions that are off by a function of the pixel phase
    fit a single frame as well as the truth, if the profile is distorted correspondingly.

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
    profile = measure_psf(
        data, sources, gain=gain, error=error, n_max=n_max, min_snr=min_snr, vary=vary
    )
    return None if profile is None else to_photutils(profile)


def measure_psf(
    data, sources, *, gain=None, error=None, n_max=800, min_snr=30.0, vary="auto", name=None
):
    """Measure the effective PSF of a frame like `build_epsf`, but without photutils.

    Parameters
    ----------
    data, sources, gain, error, n_max, min_snr, vary
        As for `build_epsf`.
    name : str, optional
        Name of the frame, for the warning.

    Returns
    -------
    Profile or None
        The PSF; None if there are too few stars.

    Raises
    ------
    ValueError
        As for `build_epsf`.

    Warns
    -----
    CentroidWarning
        If there are too few stars.

    Examples
    --------
    >>> from wpdc_gwcs import detect_sources, simulate
    >>> from wpdc_gwcs.centroids import measure_psf
    >>> from wpdc_gwcs.detection import subtract_background
    >>> sky = simulate(1, image_shape=(256, 256), density=60, seed=1)
    >>> background = subtract_background(sky.exposures[0].render())
    >>> psf = measure_psf(background, detect_sources(background), vary="never")
    >>> psf.coefficients.shape, psf.oversampling
    ((1, 81, 81), 4)
    """
    field, unit = _field_of(data, error)
    if vary not in ("auto", "never"):
        raise ValueError(f"vary must be 'auto' or 'never', got {vary!r}")
    stars = _stars_of(sources, unit)
    snr = np.asarray(sources["snr"], dtype=float)
    quality = select_sources(sources)
    fwhm = _typical_fwhm(sources)
    rows = select_stars(stars, snr, quality, fwhm, field.image.shape, n_max=n_max, min_snr=min_snr)
    if len(rows) >= MIN_STARS:
        profile = learn_psf(field, stars.take(rows), fwhm, _per_unit(gain, unit), vary)
        if profile is not None:
            return profile
    where = "" if name is None else f"{name}: "
    found = counted(len(rows), "bright, clean, isolated star")
    warnings.warn(
        f"{where}no effective PSF: {found}, {MIN_STARS} needed; positions are windowed centroids",
        CentroidWarning,
    )
    return None


def fit_centroids(
    data,
    sources,
    epsf,
    *,
    gain=None,
    error=None,
    passes=3,
    refit=False,
    subtracted=None,
    overwrite=False,
    judge=True,
):
    r"""Fit an effective PSF to all sources.

    Parameters
    ----------
    data : Background or (ny, nx) array_like
        Image without background; of a plain array, ``error`` must be given.
    sources : `~astropy.table.Table`
        Columns ``x``, ``y``, ``flux`` with start values; other columns are kept.
    epsf : `~photutils.psf.ImagePSF`, `~photutils.psf.GriddedPSFModel` or Profile
        Effective PSF.
    gain : float, optional
        Electrons per count; estimated from the data if not given.
    error : float or (ny, nx) array_like, optional
        Standard deviation of the background; only for a plain array.
    passes : int, optional
        Number of rounds.  From the second one on, the models of neighbors are subtracted, and stars
        that share pixels are improved together.
    refit : bool, optional
        Whether to subtract neighbors from the first round on.  This is for sources that have been
        fitted before, or were found next to fitted ones, on the flank of a brighter source.
    subtracted : `~astropy.table.Table`, optional
        Result of an earlier call with ``overwrite`` for the first of these sources, whose models
        have been subtracted from the image.
    overwrite : bool, optional
        Whether to subtract the models of the fitted stars from the image of the Background itself
        instead of from a copy.
    judge : bool, optional
        Whether to include the effect of neighbors in the errors, and to flag sources that are
        broader than a star.  A preliminary fit does not need this.

    Returns
    -------
    `~astropy.table.Table`
        Copy of the sources with new ``x``, ``y``, ``x_err``, ``y_err``, ``flux``, ``flux_err``,
        ``snr``, and ``chi2``, the chi square per degree of freedom.  If a fit fails, the old values
        are kept, ``flags`` has `wpdc_gwcs.detection.FLAG_FIT_FAILED`, and ``chi2`` is NaN.  The
        flag is also set if a fit is far worse than those of sources of similar brightness.

    Raises
    ------
    ValueError
        If ``passes`` is less than 1, if ``error`` is missing for a plain array, invalid, or given
        with a Background, if the sources have no FWHM, or if the PSF cannot be converted.

    Notes
    -----
    :math:`(x, y, f)` are fitted by the Gauss-Newton method to the pixels within 1.25 FWHM (at least
    2.5 px).  The weights include background, photons and the error :math:`\epsilon` of the PSF,
    which is measured from the residuals of bright stars:

    .. math::
        \sigma^2 = \sigma_\mathrm{sky}^2 + f \psi / g
                   + \epsilon^2 f^2 \psi \psi_\mathrm{max} .

    For positions and their errors, :math:`\epsilon` is the part of the error that is odd about the
    star; for :math:`\chi^2`, it is the whole error.

    The errors are those of a fit of all stars together.  They come from the normal matrix with the
    neighbors eliminated, multiplied by :math:`\sqrt{\chi^2 / 1.5}` if this is more than 1.  Errors
    of the models of the neighbors are added, and so is 0.3 times the motion of the center of light
    with the pixel phase, which matters below a FWHM of 1.5 px.

    `wpdc_gwcs.detection.FLAG_BLENDED` is set if neighbors add more than half of its error, and more
    than 0.01 px, to the error of a star; otherwise it is cleared.
    `wpdc_gwcs.detection.FLAG_EXTENDED` is set if two stars describe a profile better than one.

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
    if not overwrite:
        field = replace(field, image=field.image.copy())
    profile = from_photutils(epsf)
    fwhm = _typical_fwhm(sources)
    stars = _stars_of(sources, unit)
    drawn = stars._replace(flux=np.zeros(len(stars.x)))
    if subtracted is not None:
        known = _stars_of(subtracted, unit)
        fitted = np.isfinite(np.asarray(subtracted["chi2"], dtype=float))
        for old, new in zip(drawn, known._replace(flux=np.where(fitted, known.flux, 0.0))):
            old[: len(new)] = new
    quality = select_sources(sources)
    flags = (
        np.array(sources["flags"], int)
        if "flags" in sources.colnames
        else np.zeros(len(stars.x), int)
    )
    scene, gain = Scene(field, profile, drawn), _per_unit(gain, unit)
    fits, noise = fit_all(scene, profile, stars, quality, fwhm, gain, passes, refit)
    shift = np.zeros(len(stars.x))
    if judge:
        fits, shift, flags = judge_neighbors(scene, profile, noise, fits, stars, flags, fwhm)
        shift = np.hypot(shift, _UNKNOWN_WOBBLE * profile.wobble())
    return _fitted_table(sources, fits, shift, flags, fwhm, unit)


def residual_of(background, sources, epsf, *, gain=None, subtracted=False):
    """Subtract the models of fitted stars from parts of an image on request.

    Parameters
    ----------
    background, sources, epsf, gain
        As for `subtract_stars`.
    subtracted : bool, optional
        Whether the models have already been subtracted, by `fit_centroids` with ``overwrite``.

    Returns
    -------
    Residual
        Source of rows of the residual image, for `detect_companions`.

    Examples
    --------
    >>> from wpdc_gwcs import detect_sources, fit_centroids, simulate
    >>> from wpdc_gwcs.centroids import measure_psf, residual_of
    >>> from wpdc_gwcs.detection import subtract_background
    >>> sky = simulate(1, image_shape=(256, 256), density=60, seed=1)
    >>> background = subtract_background(sky.exposures[0].render())
    >>> sources = detect_sources(background)
    >>> psf = measure_psf(background, sources)
    >>> residual = residual_of(background, fit_centroids(background, sources, psf), psf)
    >>> residual.rows(100, 150).shape  # only these rows are computed
    (50, 256)
    """
    drawn = np.isfinite(np.asarray(sources["chi2"], dtype=float))
    stars = _stars_of(sources, background.unit).take(drawn)
    gain = _per_unit(gain, background.unit)
    return Residual(background, from_photutils(epsf), stars, gain, subtracted)


def subtract_stars(background, sources, epsf, *, gain=None):
    """Subtract the models of fitted stars from an image.

    Parameters
    ----------
    background : Background
        Image without background.
    sources : `~astropy.table.Table`
        Result of `fit_centroids`; sources without a fit (``chi2`` is NaN) remain in the image.
    epsf : `~photutils.psf.ImagePSF`, `~photutils.psf.GriddedPSFModel` or Profile
        Effective PSF.
    gain : float, optional
        Electrons per count.

    Returns
    -------
    Background
        The residual image.  Its ``rms`` includes the background, the photons of the stars and an
        error of the PSF of 10 %, so what exceeds it is not a residual of a known star.

    Examples
    --------
    >>> from wpdc_gwcs import detect_sources, fit_centroids, simulate
    >>> from wpdc_gwcs.centroids import measure_psf, subtract_stars
    >>> from wpdc_gwcs.detection import subtract_background
    >>> sky = simulate(1, image_shape=(256, 256), density=60, seed=1)
    >>> background = subtract_background(sky.exposures[0].render())
    >>> sources = detect_sources(background)
    >>> psf = measure_psf(background, sources)
    >>> residual = subtract_stars(background, fit_centroids(background, sources, psf), psf)
    >>> [int((field.image > 10 * field.rms).sum()) for field in (background, residual)]
    [473, 0]
    """
    return residual_of(background, sources, epsf, gain=gain).rows(0, background.shape[0])


@dataclass(frozen=True)
class StarNoise:
    """Noise of an image according to the residuals of bright stars.

    Parameters
    ----------
    gain : float
        Electrons per count, from the increase of the noise with the light of the stars; NaN if
        errors of the PSF hide it.
    least_gain : float
        Gain below which photons alone would make more noise than observed; 0 if unknown.
    mismatch : float
        Error of the PSF at its peak, relative to the peak.
    n_stars : int
        Number of stars used.

    Examples
    --------
    >>> from wpdc_gwcs import detect_sources, simulate
    >>> from wpdc_gwcs.centroids import measure_noise, measure_psf
    >>> from wpdc_gwcs.detection import subtract_background
    >>> sky = simulate(1, image_shape=(300, 300), density=60, seed=1)
    >>> background = subtract_background(sky.exposures[0].render())
    >>> sources = detect_sources(background)
    >>> noise = measure_noise(background, sources, measure_psf(background, sources))
    >>> noise.n_stars > 50, noise.mismatch < 0.01
    (True, True)
    """

    gain: float
    least_gain: float
    mismatch: float
    n_stars: int


@one_blas_thread
def measure_noise(data, sources, epsf, *, error=None):
    """Measure the gain and the error of the PSF from the residuals of bright stars.

    Parameters
    ----------
    data : Background or (ny, nx) array_like
        Image without background; of a plain array, ``error`` must be given.
    sources : `~astropy.table.Table`
        As for `fit_centroids`.
    epsf : `~photutils.psf.ImagePSF`, `~photutils.psf.GriddedPSFModel` or Profile
        Effective PSF.
    error : float or (ny, nx) array_like, optional
        Standard deviation of the background; only for a plain array.

    Returns
    -------
    StarNoise
        Gain, error of the PSF, number of stars.

    Raises
    ------
    ValueError
        If ``error`` is missing for a plain array, invalid, or given with a Background, if the
        sources have no FWHM, or if the PSF cannot be converted.

    Notes
    -----
    A PSF that was made from the same stars contains some of their noise, so the gain is up to a
    third too high.  With a PSF that was made from other stars, it is correct.

    Examples
    --------
    >>> from wpdc_gwcs import detect_sources, simulate
    >>> from wpdc_gwcs.centroids import measure_noise, measure_psf
    >>> from wpdc_gwcs.detection import subtract_background
    >>> sky = simulate(1, image_shape=(400, 400), density=60, seed=1)
    >>> background = subtract_background(sky.exposures[0].render())
    >>> sources = detect_sources(background)
    >>> noise = measure_noise(background, sources, measure_psf(background, sources))
    >>> sky.camera.gain, 1.0 < noise.gain < 2.0
    (1.5, True)
    """
    field, unit = _field_of(data, error, saturation=sources.meta.get("saturation"))
    fwhm = _typical_fwhm(sources)
    stars = _stars_of(sources, unit)
    quality = select_sources(sources)
    bins, clean, _ = noise_bins(field, from_photutils(epsf), stars, quality, fwhm, None)
    noise = estimate_noise(bins)
    gain = np.nan
    if bins is not None:
        photons = np.median(noise.inverse_gain * bins.photons / bins.measured)
        gain = 1 / (noise.inverse_gain * unit) if photons > _LEAST_PHOTONS else np.nan
    return StarNoise(float(gain), least_gain(bins) / unit, noise.mismatch, len(clean.x))


def _fitted_table(sources, fits, shift, flags, fwhm, unit):
    """Copy of the sources with the results of the fits, in counts."""
    result = sources.copy()
    good = fits.valid & near(fits.stars, _stars_of(sources, unit), fwhm)
    error = np.sqrt(np.where(good[:, None], np.einsum("sii->si", fits.covariance), np.nan))
    with np.errstate(divide="ignore", invalid="ignore"):
        snr = fits.stars.flux / error[:, 2]
        # A chi square above the limit means an undetected neighbor, or a PSF that does not fit.
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
    # Not a star: the fit is far worse than those of similar stars, with the same error of the PSF.
    alike = star_like(fits.stars.flux, fits.chi2, good, limit=MAX_CHI2)
    poor = ~good | (~alike & (fits.chi2 > MAX_CHI2))
    result["flags"] = flags | np.where(poor, FLAG_FIT_FAILED, 0)
    return result


def _stars_of(sources, unit):
    x, y, flux = (np.array(sources[c], dtype=float) for c in ("x", "y", "flux"))
    return Stars(x, y, flux / unit)


def _per_unit(gain, unit):
    """Electrons per unit of the pixel values."""
    return None if gain is None else gain * unit


def _typical_fwhm(sources):
    """FWHM of the stars from the metadata, or else the median of the column."""
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
        # The wings of a saturated star still determine its flux, which matters to its neighbors.
        full = data.saturated(saturation)
        return Field(data.image, data.rms, data.mask, data.photons, full), data.unit
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
    image = np.where(bad, 0.0, image / unit).astype(np.float32)
    return Field(image, rms, bad if bad.any() else None), unit
