"""The sources of one frame: measured on its pixels, or as its list gives them."""

import logging
import warnings

import numpy as np

from wpdc_gwcs.calibration.settings import Settings
from wpdc_gwcs.centroids import fit_centroids, measure_noise, measure_psf, residual_of
from wpdc_gwcs.counts import counted
from wpdc_gwcs.detection import (
    detect_companions,
    detect_sources,
    mask_hits,
    saturation_problem,
    subtract_background,
)
from wpdc_gwcs.exceptions import CentroidWarning, DetectionError, WPDCWarning
from wpdc_gwcs.selection import judge_sources, left_out
from wpdc_gwcs.stages import announce

__all__ = ["measure_sources", "quality_of", "rules_of"]

log = logging.getLogger(__name__)

# Smaller images (px) have no measurable background.
_SMALLEST = 8

# Number of rounds after which the light of close pairs is divided correctly.
_PASSES_OF_PAIRS = 5

# Noise of the sky in electrons below which a gain cannot be correct: no detector has so little read
# noise, and the photons of the sky add to it.  If the header has the read noise, the limit is this
# fraction of it, because headers have rounded or nominal values.
_MIN_ELECTRONS, _SHARE_OF_READ_NOISE = 0.2, 0.5

# Limits of the ratio between a stated gain and the gain from the noise in stars.  Less scatter than
# that of photons is proof of a wrong gain.  More scatter may also come from an imperfect PSF: in
# frames of CFHT/WIRCam it corresponds to half of the gain that the noise of the sky confirms.
_MAX_GAIN_RATIO, _MAX_GAIN_EXCESS = 2.5, 4.0
_GOOD_MISMATCH = 0.03
# Minimum number of stars for this test.
_MIN_STARS = 20

# Ratio of the signal-to-noise ratio in an aperture with all the light of a star to that of the fit:
# 2 sigma / (1.5 FWHM) for a Gaussian and a radius of 1.5 FWHM, slightly more with photon noise.
# The limit ``min_snr`` refers to an aperture, but the value from the fit is less noisy.
_APERTURE_SHARE = 0.61


def measure_sources(frame, settings=None):
    """Measure the sources of a frame on its image, or read them from its source list.

    Parameters
    ----------
    frame : Frame
        Image or source list.
    settings : Settings, optional
        ``centroids``, ``threshold``, ``min_snr``, ``gain`` and ``saturation`` are used.

    Returns
    -------
    `~astropy.table.Table`
        Columns ``x``, ``y`` (px, zero based) and other measured columns.  For an image, the
        metadata has ``fwhm`` (px), ``ellipticity``, ``saturation`` and ``noise`` (counts),
        ``pixels`` ("zero based"), ``n_faint`` (number of sources below ``min_snr``) and, if a PSF
        was fitted, ``gain`` (electrons per count), ``gain_from`` (``given``, ``header`` or
        ``noise``) and ``mismatch`` (relative error of the PSF at its peak).

    Raises
    ------
    DetectionError
        If the image is too small or has no source above ``min_snr``, if the list has no rows, or
        if ``centroids="given"`` is set for an image.

    Warns
    -----
    WPDCWarning
        If the header's gain or saturation level contradicts the pixels and is not used.
    CentroidWarning
        If there are too few stars for a PSF, so that the centroids are windowed.

    Notes
    -----
    Sources fainter than ``min_snr`` are measured with the others, whose light they disturb, and
    left out at the end.

    Examples
    --------
    >>> from wpdc_gwcs import simulate
    >>> from wpdc_gwcs.calibration import Settings, measure_sources
    >>> sky = simulate(1, image_shape=(256, 256), density=60, distortion=3, seed=1)
    >>> image = sky.exposures[0].frame(image=True)
    >>> sources = measure_sources(image, Settings(centroids="windowed"))
    >>> len(sources), round(sources.meta["fwhm"], 1)
    (68, 2.8)
    """
    settings = Settings() if settings is None else settings
    if frame.load_sources is not None:
        sources = frame.load_sources()
        if len(sources) == 0:
            raise DetectionError(f"{frame.source}: the source list has no rows")
        return sources
    if settings.centroids == "given":
        raise DetectionError(
            f"{frame.source}: centroids='given' needs a source list, and this is an image"
        )
    if min(frame.image_shape) < _SMALLEST:
        raise DetectionError(
            f"{frame.source}: the image must be at least {_SMALLEST} x {_SMALLEST} px, has the "
            f"shape (ny, nx) {frame.image_shape}"
        )
    announce("background")
    mask = None if frame.load_mask is None else frame.load_mask()
    weight = None if frame.load_weight is None else frame.load_weight()
    # The image has no name here, so its memory is free once the background is subtracted.
    background = subtract_background(
        frame.load_image(), mask=mask, weight=weight, overwrite=frame.fresh_image
    )
    del mask, weight
    background = mask_hits(background, overwrite=True)
    gain = _first_gain(frame, settings, background)
    saturation = _saturation(frame, settings, background)
    announce("detection")
    options = {"threshold": settings.threshold, "saturation": saturation}
    detected = detect_sources(background, gain=gain, **options)
    sources = detected
    if settings.centroids == "psf":
        announce("PSF")
        epsf = measure_psf(background, detected, gain=gain, name=frame.source)
        if epsf is not None:
            noise = measure_noise(background, detected, epsf)
            wrong = settings.gain is None and _contradicts(gain, noise)
            origin = "header" if settings.gain is None else "given"
            if gain is None or wrong:
                origin = "noise"
                measured = _measure_gain(background, detected, noise)
                if wrong:
                    why = f"the noise in its stars implies a gain of {measured:.3g}"
                    _warn(frame, "gain", gain, why)
                gain = measured if measured > 0 else None
                detected = detect_sources(background, gain=gain, **options)
                if wrong:
                    epsf = measure_psf(background, detected, gain=gain, name=frame.source)
            detected, sources = _fit_psf(background, detected, epsf, gain, settings.threshold)
            sources.meta.update(
                gain=noise.gain if gain is None else gain,
                gain_from=origin,
                mismatch=noise.mismatch,
            )
    sources.meta["noise"] = background.noise
    # The table may be written to a file and read as a source list later.
    sources.meta["pixels"] = "zero based"
    if settings.min_snr == 0:
        return sources
    snr = np.asarray(sources["snr"], float)
    bright = (_APERTURE_SHARE if "chi2" in sources.colnames else 1.0) * snr >= settings.min_snr
    if not bright.any():
        raise DetectionError(
            f"{frame.source}: none of {counted(len(sources), 'source')} has a signal-to-noise "
            f"ratio above {settings.min_snr:g}"
        )
    sources.meta["n_faint"] = int(np.count_nonzero(~bright))
    return sources[bright]


def quality_of(frame, sources, settings, *, counts=None):
    """Summarize the quality of a frame: its PSF and noise, and how many sources each rule excludes.

    Parameters
    ----------
    frame : Frame
        The frame.
    sources : `~astropy.table.Table` or None
        As from `measure_sources`.
    settings : Settings
        ``max_roundness`` and ``min_snr`` are used.
    counts : str, optional
        Result of `wpdc_gwcs.selection.left_out` for the sources, if it is already known.

    Returns
    -------
    dict
        ``fwhm`` (px), ``ellipticity``, ``mismatch`` (relative error of the PSF at its peak),
        ``gain`` (electrons per count, as measured) and ``noise`` (counts), each NaN if it was not
        measured, and ``left_out``.
    """
    meta = {} if sources is None else sources.meta
    result = {}
    for name in ("fwhm", "ellipticity", "mismatch", "gain", "noise"):
        value = meta.get(name)
        result[name] = float(value) if isinstance(value, int | float) else np.nan
    if counts is None:
        counts = "" if sources is None else left_out(rules_of(sources, frame, settings))
    return result | {"left_out": counts}


def rules_of(sources, frame, settings):
    """Return the sources of a frame that each rule of the settings excludes.

    Parameters
    ----------
    sources : `~astropy.table.Table`
        Measured sources.
    frame : Frame
        The frame, for its shape.
    settings : Settings
        ``max_roundness`` and ``min_snr`` are used.

    Returns
    -------
    dict
        As from `wpdc_gwcs.selection.judge_sources`.
    """
    return judge_sources(
        sources,
        image_shape=frame.image_shape,
        max_roundness=settings.max_roundness,
        min_snr=settings.min_snr,
    )


def _first_gain(frame, settings, background):
    """Gain that was given, or that of the header unless the noise of the sky rules it out."""
    if settings.gain is not None or frame.gain is None:
        return settings.gain
    electrons = frame.gain * background.noise
    read = frame.read_noise or 0.0
    if electrons > max(_MIN_ELECTRONS, _SHARE_OF_READ_NOISE * read):
        return frame.gain
    why = f"the noise of its sky would be {electrons:.2g} electrons"
    if electrons > _MIN_ELECTRONS:
        why += f", that of the readout alone is {read:g}"
    _warn(frame, "gain", frame.gain, why)
    return None


def _contradicts(gain, noise):
    """Return whether the noise in the stars rules out a stated gain."""
    if gain is None or noise.n_stars < _MIN_STARS:
        return False
    if noise.least_gain > _MAX_GAIN_RATIO * gain:
        return True
    return noise.gain < gain / _MAX_GAIN_EXCESS and noise.mismatch < _GOOD_MISMATCH


def _measure_gain(background, detected, noise):
    """Gain from the noise in one half of the stars about the PSF of the other half."""
    snr = np.asarray(detected["snr"])
    half = np.empty(len(snr), bool)
    half[np.argsort(snr)] = np.arange(len(snr)) % 2 == 0
    # All sources stay in the lists as neighbors, but those without a signal are not used for the
    # PSF or the noise.
    one, other = detected.copy(), detected.copy()
    one["snr"][~half] = 0.0
    other["snr"][half] = 0.0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CentroidWarning)
        epsf = measure_psf(background, one)
    return noise.gain if epsf is None else measure_noise(background, other, epsf).gain


def _saturation(frame, settings, background):
    """Saturation level that was given, or that of the header unless the pixels rule it out."""
    if settings.saturation is not None or frame.saturation is None:
        return settings.saturation
    problem = saturation_problem(background, frame.saturation)
    if problem is None:
        return frame.saturation
    _warn(frame, "saturation", frame.saturation, problem)
    return None


def _warn(frame, what, value, why):
    warnings.warn(
        f"{frame.source}: the header's {what} of {value:g} disagrees with the pixels and is "
        f"ignored: {why}",
        WPDCWarning,
    )


def _fit_psf(background, detected, epsf, gain, threshold):
    """Fit the PSF to all sources, and to those found after subtracting them from the image.

    Returns the sources as they were detected, companions included, and as they were fitted.
    """
    announce("fits")
    fitted = fit_centroids(background, detected, epsf, gain=gain, overwrite=True, judge=False)
    announce("companions")
    residual = residual_of(background, fitted, epsf, gain=gain, subtracted=True)
    detected = detect_companions(residual, detected, threshold=threshold, gain=gain)
    start = detected.copy()
    for name in ("x", "y", "flux"):
        start[name][: len(fitted)] = fitted[name]
    announce("fits")
    return detected, fit_centroids(
        background,
        start,
        epsf,
        gain=gain,
        refit=True,
        passes=_PASSES_OF_PAIRS,
        subtracted=fitted,
        overwrite=True,
    )
