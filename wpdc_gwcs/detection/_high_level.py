"""Public functions of the detection, which check arguments and return tables."""

import logging

import numpy as np
import sep
from astropy.table import Table, vstack
from scipy.spatial import KDTree

from wpdc_gwcs.detection._background import Background, subtract_background
from wpdc_gwcs.detection._extract import extract_peaks, is_broad, search, typical_fwhm
from wpdc_gwcs.detection._hits import mask_hits
from wpdc_gwcs.detection._saturation import plateau
from wpdc_gwcs.detection._shapes import SIGMA_PER_FWHM, measure_shapes, mode
from wpdc_gwcs.exceptions import DetectionError
from wpdc_gwcs.flags import (
    FLAG_BLENDED,
    FLAG_COSMIC,
    FLAG_EXTENDED,
    FLAG_SATURATED,
)

__all__ = ["detect_companions", "detect_sources"]

log = logging.getLogger(__name__)

# Light of a neighbor at the center of a source, relative to that of the source, above which a fit
# of both together is not as good as that of a single star.
_MAX_SHARE = 0.15

# Smallest distance of two separate sources, in FWHM.
_RESOLVED = 0.6

# Minimum signal-to-noise ratio of the sources that show what stars look like.
_STAR_SNR = 30.0

# Columns of the sources, in this order.
_COLUMNS = (
    "x",
    "y",
    "x_err",
    "y_err",
    "flux",
    "flux_err",
    "snr",
    "peak",
    "fwhm",
    "roundness",
    "sharpness",
)

# Number of sources measured at a time, which limits the memory for their cut-outs to tens of MB.
_CHUNK = 20_000


def detect_sources(
    data,
    *,
    threshold=5.0,
    mask=None,
    gain=None,
    saturation=None,
    deblend_contrast=0.002,
):
    r"""Find the sources of an image, and measure their positions, shapes and flags.

    Parameters
    ----------
    data : Background or (ny, nx) array_like
        Image without background, or a plain image.  In a plain image, cosmic-ray hits are masked
        after its background has been subtracted.
    threshold : float, optional
        Smallest significance of the peak of a source, in standard deviations of the smoothed noise.
    mask : (ny, nx) array_like of bool, optional
        True where a pixel must not be used; only for a plain image.
    gain : float, optional
        Electrons per count, for the photon noise in the errors.  Default: only the noise of the
        background is used.
    saturation : float, optional
        Saturation level in counts, including the background.  Default: the plateau of the brightest
        pixels, if there is one.
    deblend_contrast : float, optional
        Smallest fraction of the flux for a separate peak within a larger source.

    Returns
    -------
    `~astropy.table.Table`
        One row per source, in the order found: ``x``, ``y`` (windowed centroid, px, zero based),
        ``x_err``, ``y_err`` (px), ``flux``, ``flux_err`` (counts), ``snr``, ``peak`` (counts above
        background), ``fwhm`` (px), ``roundness``, ``sharpness``, ``flags``.  The metadata has
        ``fwhm`` and ``ellipticity`` of a typical star, and ``saturation``.

    Raises
    ------
    ValueError
        If an option is out of range.
    DetectionError
        If there are no sources or no usable pixels.

    Notes
    -----
    Sources are extracted by `sep` (Bertin & Arnouts 1996, A&AS 117, 393) after smoothing with a
    3 x 3 kernel, or a broader one for broad stars.  Positions are its windowed centroids, with a
    Gaussian window of the stars' FWHM.  With the window :math:`w_i` and the noise :math:`\sigma_i`
    of the pixels :math:`I_i`, the error is

    .. math::
        \sigma_x^2 = 4 \sum w_i^2 \sigma_i^2 (x_i - x)^2 / \left(\sum w_i I_i\right)^2 .

    ``fwhm`` comes from the second moments under the same window, corrected for the window.
    ``roundness`` is DAOFIND's GROUND, :math:`2 (h_x - h_y) / (h_x + h_y)`, with the heights h of
    Gaussians fitted to the marginal distributions (Stetson 1987, PASP 99, 191).  ``sharpness`` is
    that of DAOFIND.  Both are as in `photutils.detection.DAOStarFinder`.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs import detect_sources
    >>> y, x = np.mgrid[:200, :200]
    >>> image = 2000 * np.exp(-((x - 80.3) ** 2 + (y - 120.6) ** 2) / 4)
    >>> image += np.random.default_rng(1).normal(100, 5, image.shape)
    >>> sources = detect_sources(image)
    >>> float(sources["x"][0].round(1)), float(sources["y"][0].round(1)), int(sources["flags"][0])
    (80.3, 120.6, 0)
    """
    for name, value in (("threshold", threshold), ("gain", gain), ("saturation", saturation)):
        if value is not None and not value > 0:
            raise ValueError(f"{name} must be positive, got {value}")
    if not isinstance(data, Background):
        data = mask_hits(subtract_background(data, mask=mask), overwrite=True)
    elif mask is not None:
        raise ValueError("mask must be given to subtract_background when data is a Background")
    found = extract_peaks(data, threshold, deblend_contrast)
    if len(found) == 0:
        raise DetectionError(f"no source above {threshold:g} sigma on the image")
    if saturation is None:
        saturation = plateau(data)
    fwhm = typical_fwhm(data, found)
    if is_broad(fwhm):
        found = extract_peaks(data, threshold, deblend_contrast, fwhm)
    table = _table_of([_measure(data, found, fwhm, gain, saturation)], fwhm)
    table.meta.update(fwhm=fwhm, saturation=saturation)
    log.debug(
        "%d sources, %d of them clean, FWHM %.2f px",
        len(table),
        np.count_nonzero(table["flags"] == 0),
        fwhm,
    )
    return table


def detect_companions(residual, sources, *, threshold=5.0, gain=None, deblend_contrast=0.002):
    """Add the sources that are found after the known ones have been subtracted.

    Parameters
    ----------
    residual : Background
        Image without the known sources, with the errors of their models in its noise, as from
        `wpdc_gwcs.centroids.subtract_stars`; or any object that has its ``shape`` and returns its
        ``rows(start, stop)``, as from `wpdc_gwcs.centroids.residual_of`.
    sources : `~astropy.table.Table`
        The known sources, from `detect_sources`.
    threshold : float, optional
        Smallest significance of the peak of a source, in standard deviations of the smoothed noise.
    gain : float, optional
        Electrons per count, for the photon noise in the errors.
    deblend_contrast : float, optional
        Smallest fraction of the flux for a separate peak within a larger source.

    Returns
    -------
    `~astropy.table.Table`
        The known sources, followed by the new ones.  `FLAG_BLENDED` is set again for all of them.

    Notes
    -----
    A source on the flank of a brighter star has no peak of its own, and its light shifts the fit of
    that star.  Sources closer than 0.6 FWHM to a known one are not added, because an error of the
    PSF looks the same.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs import build_epsf, detect_sources, fit_centroids
    >>> from wpdc_gwcs.centroids import subtract_stars
    >>> from wpdc_gwcs.detection import detect_companions, subtract_background
    >>> rng = np.random.default_rng(1)
    >>> y, x = np.mgrid[:200, :200]
    >>> image = rng.normal(100, 5, x.shape)
    >>> for x0, y0 in 20 * np.mgrid[1:10, 1:10].reshape(2, -1).T + rng.uniform(-2, 2, (81, 2)):
    ...     image += 3000 * np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / 3)
    >>> image += 300 * np.exp(-((x - x0 - 2.8) ** 2 + (y - y0) ** 2) / 3)  # beside the last one
    >>> background = subtract_background(image)
    >>> sources = detect_sources(background)
    >>> epsf = build_epsf(background, sources)
    >>> residual = subtract_stars(background, fit_centroids(background, sources, epsf), epsf)
    >>> len(sources), len(detect_companions(residual, sources))
    (81, 82)
    """
    if not threshold > 0:
        raise ValueError(f"threshold must be positive, got {threshold}")
    fwhm = sources.meta["fwhm"]
    saturation, parts = sources.meta["saturation"], []
    for start, strip, found in search(residual, threshold, deblend_contrast, fwhm, sparse=True):
        if len(found):
            part = _measure(strip, found, fwhm, gain, saturation)
            part["y"] += start
            parts.append(part)
    result = sources.copy()
    if parts:
        new = _table_of(parts, fwhm)
        distance = KDTree(_places(sources)).query(_places(new))[0]
        new = new[(distance > _RESOLVED * fwhm) & (new["flags"] & FLAG_SATURATED == 0)]
        log.debug("%d more sources beside those subtracted", len(new))
        result = vstack([result, new], metadata_conflicts="silent")
        result.meta.update(sources.meta)
    blended = _blended(*(np.asarray(result[c], float) for c in ("x", "y", "flux")), fwhm)
    result["flags"] = result["flags"] & ~FLAG_BLENDED | np.where(blended, FLAG_BLENDED, 0)
    return result


def _places(table):
    return np.column_stack([table["x"], table["y"]])


def _measure(background, found, fwhm, gain, saturation):
    """Measure each source by itself; returns columns, in counts."""
    image, rms, bad, unit = background.image, background.rms, background.mask, background.unit
    gain = None if gain is None else gain * unit
    full = None if saturation is None else background.saturated(saturation)
    x, y = _windowed(background, found, fwhm * SIGMA_PER_FWHM, fwhm)
    radius = 1.5 * fwhm
    flux, flux_err, _ = sep.sum_circle(image, x, y, radius, err=rms, mask=bad, gain=gain, subpix=5)
    parts = [
        measure_shapes(
            background, x[k], y[k], found["xpeak"][k], found["ypeak"][k], fwhm, gain, full
        )
        for k in (slice(start, start + _CHUNK) for start in range(0, len(found), _CHUNK))
    ]
    shapes = {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
    shapes["peak"] *= unit
    return {"x": x, "y": y, "flux": flux * unit, "flux_err": flux_err * unit} | shapes


def _table_of(parts, fwhm):
    """Table of the measured sources, with the flags that depend on the other sources."""
    shapes = {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
    x, y, flux = (shapes[name] for name in ("x", "y", "flux"))
    flags, minor, size = (shapes.pop(name) for name in ("flags", "minor", "fwhm"))
    flags |= _unlike_stars(minor, size, shapes["snr"], flags)
    ellipticity = _ellipticity(minor, size, shapes["snr"], flags)
    flags |= np.where(_blended(x, y, flux, fwhm), FLAG_BLENDED, 0)
    shapes["fwhm"] = np.where(np.isfinite(size), size, np.nan)
    columns = {name: shapes[name] for name in _COLUMNS}
    return Table(columns | {"flags": flags}, meta={"ellipticity": ellipticity})


def _windowed(background, found, sigma, fwhm):
    """Windowed centroids; the isophotal ones if the window has moved to a neighbor."""
    x, y = found["x"].astype(float), found["y"].astype(float)
    xw, yw, _ = sep.winpos(
        background.image, found["xcpeak"], found["ycpeak"], sigma, mask=background.mask, subpix=5
    )
    moved = np.hypot(xw - found["xcpeak"], yw - found["ycpeak"])
    ran_away = ~(moved < 0.7 + 0.5 * fwhm)
    away = ~(np.hypot(x - found["xcpeak"], y - found["ycpeak"]) < 0.7 + 0.5 * fwhm)
    x[away], y[away] = found["xcpeak"][away], found["ycpeak"][away]
    return np.where(ran_away, x, xw), np.where(ran_away, y, yw)


def _ellipticity(minor, size, snr, flags):
    """Find 1 - minor/major of a typical star, NaN without any."""
    with np.errstate(invalid="ignore"):
        value = 1 - minor / np.sqrt(2 * size**2 - minor**2)
    good = (flags == 0) & (snr > _STAR_SNR) & np.isfinite(value)
    return mode(value[good])[0] if good.any() else np.nan


def _unlike_stars(minor, size, snr, flags):
    """Flag sources that are clearly sharper or broader than the stars of this image."""
    result = np.zeros(len(size), int)
    bright = (flags == 0) & (snr > _STAR_SNR) & np.isfinite(size)
    if bright.sum() < 10:
        bright = (flags == 0) & np.isfinite(size)
    if bright.sum() < 10:
        return result
    typical_size, size_scatter = mode(size[bright])
    typical_minor, minor_scatter = mode(minor[bright])
    # Relative error of a size from noise alone is about 1.4 / SNR under a matched window.
    noise = 3 * 1.4 / np.maximum(snr, 1e-3)
    with np.errstate(invalid="ignore"):
        sharp = minor < typical_minor - np.maximum(
            (0.25 + noise) * typical_minor, 5 * minor_scatter
        )
        broad = size > typical_size + np.maximum((0.2 + noise) * typical_size, 5 * size_scatter)
    result[broad] = FLAG_EXTENDED
    result[sharp] = FLAG_COSMIC
    return result


def _blended(x, y, flux, fwhm):
    """Mark sources whose core has too much light of a neighbor."""
    blended = np.zeros(len(x), bool)
    pairs = KDTree(np.column_stack([x, y])).query_pairs(4 * fwhm, output_type="ndarray")
    if len(pairs) == 0:
        return blended
    i, j = pairs.T
    distance = np.hypot(x[i] - x[j], y[i] - y[j]) / fwhm
    # Moffat profile with beta = 2.5 of unit FWHM, relative to its peak.
    light = (1 + (distance * 2) ** 2 * (2**0.4 - 1)) ** -2.5
    flux = np.maximum(flux, 1e-6 * np.max(flux, initial=np.finfo(float).tiny))
    share = np.zeros(len(x))
    np.add.at(share, i, flux[j] / flux[i] * light)
    np.add.at(share, j, flux[i] / flux[j] * light)
    close = distance < 1.2
    blended[i[close]] = blended[j[close]] = True
    return blended | (share > _MAX_SHARE)
