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

# Images smaller than this, px, have no background, and no stars on it.
_SMALLEST = 8

# Rounds after which close pairs have shared out their light.
_PASSES_OF_PAIRS = 5

# Noise of the sky in electrons below which a gain cannot be that of the pixels: no detector reads
# out so quietly, and the sky's own photons come on top.  Where the header has the read noise, it is
# this share of that, since headers round and nominal values differ.
_MIN_ELECTRONS, _SHARE_OF_READ_NOISE = 0.2, 0.5

# Factors between a stated gain and the one that the noise in the stars shows.  Less scatter than
# the photons' is proof; more of it may also be a PSF that does not fit, even if it fits well: in
# frames of CFHT/WIRCam it is that of half the gain that the noise of their skies bears out.
_MAX_GAIN_RATIO, _MAX_GAIN_EXCESS = 2.5, 4.0
_GOOD_MISMATCH = 0.03
# Stars that prove it.
_MIN_STARS = 20

# Signal-to-noise ratio in an aperture that holds all the light of a star, over that of the fit:
# 2 sigma / (1.5 FWHM) for a Gaussian and a radius of 1.5 FWHM, a little more with its photons.  The
# limit is about the ratio in an aperture; the fit's is the less noisy measure of it, for any PSF.
_APERTURE_SHARE = 0.61


def measure_sources(frame, settings=None):
    """Source table of a frame: measured on its image, or read from its source list.

    Parameters
    ----------
    frame : Frame
        Image or source list.
    settings : Settings, optional
        ``centroids``, ``threshold``, ``min_snr``, ``gain`` and ``saturation`` are used.

    Returns
    -------
    `~astropy.table.Table`
        Columns ``x``, ``y`` (px, zero based) and what else was measured.  Of an image, the meta
        data have ``fwhm`` (px), ``ellipticity``, ``saturation``, ``noise`` (counts), ``pixels``
        (zero based) and, if a PSF was fitted, ``gain`` (electrons per count), ``gain_from``
        (``given``, ``header`` or ``noise``) and ``mismatch`` (of the PSF, relative).

    Raises
    ------
    DetectionError
        If there are no stars on the image, or no rows in the list.

    Warns
    -----
    WPDCWarning
        If the header's gain or saturation contradicts the pixels: it is left aside.

    Notes
    -----
    Fainter stars than ``min_snr`` are measured with the others, whose light they disturb, and left
    out at the end.

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
    # Without a name here, so that the image is gone once its background is off.
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
    # Said in the file, which may be read as a list.
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
    """Tell what a frame is like: its PSF and noise, and how many sources each rule leaves out.

    Parameters
    ----------
    frame : Frame
        The frame.
    sources : `~astropy.table.Table` or None
        As from `measure_sources`.
    settings : Settings
        ``max_roundness`` and ``min_snr`` are used.
    counts : str, optional
        What `wpdc_gwcs.selection.left_out` has told of the sources, where it was asked before.

    Returns
    -------
    dict
        ``fwhm`` (px), ``ellipticity``, ``mismatch`` (error of the PSF at its peak, relative),
        ``gain`` (electrons per count, as measured), ``noise`` (counts), each NaN where it has not
        been measured, and ``left_out``.
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
    """Judge the sources of a frame by the rules of the settings.

    Parameters
    ----------
    sources : `~astropy.table.Table`
        What was measured.
    frame : Frame
        Its shape counts.
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
    """Gain by the noise in one half of the stars about the PSF of the other half."""
    snr = np.asarray(detected["snr"])
    half = np.empty(len(snr), bool)
    half[np.argsort(snr)] = np.arange(len(snr)) % 2 == 0
    # All stay in the lists, as neighbors; without a signal none makes a PSF, or tells noise.
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
    """Fit the PSF to all sources and to what shows once they are subtracted from the image.

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
