"""Image to candidate sources: background, extraction, windowed centroids, shapes and flags.

::

    image --subtract_background--> Background --sep.extract--> peaks --sep.winpos--> x, y
          --weighted moments, DAOFIND marginals, neighbours--> fwhm, roundness, flags
"""

import logging
from dataclasses import dataclass

import numpy as np
import sep
from astropy.table import Table, vstack
from scipy.spatial import KDTree

from wpdc_gwcs.exceptions import DetectionError

__all__ = [
    "FLAG_BAD_PIXEL",
    "FLAG_BLENDED",
    "FLAG_COSMIC",
    "FLAG_EDGE",
    "FLAG_EXTENDED",
    "FLAG_FIT_FAILED",
    "FLAG_SATURATED",
    "Background",
    "detect_companions",
    "detect_sources",
    "subtract_background",
]

log = logging.getLogger(__name__)

# Bits of the column ``flags``; 0 is a clean source.
FLAG_SATURATED = 1  # a pixel of the core is at the saturation level
FLAG_EDGE = 2  # the core reaches over the edge of the image
FLAG_BLENDED = 4  # a neighbour disturbs the core
FLAG_COSMIC = 8  # sharper than the PSF: cosmic ray or hot pixel
FLAG_EXTENDED = 16  # broader than the PSF: galaxy, or an unresolved blend
FLAG_BAD_PIXEL = 32  # a masked pixel within the core
FLAG_FIT_FAILED = 64  # the PSF does not fit: no star, or the windowed centroid was kept

_SIGMA_PER_FWHM = 1 / np.sqrt(8 * np.log(2))

# Smoothing before the threshold: close to a matched filter for FWHM 1.5 to 3 px, and narrow enough
# not to merge neighbours.
_KERNEL = np.outer([1.0, 2.0, 1.0], [1.0, 2.0, 1.0]) / 16
_KERNEL_NOISE = np.sqrt((_KERNEL**2).sum())

# Values beyond this are blanks of some kind; sums of their squares would overflow float32.
_HUGE = 1e15

# Pixels this many standard deviations below the background are dead: nothing on the sky is dark.
_COLD = 10.0

# A neighbour's light at the centre of a source, relative to the source's own, from which the fit
# of both together is no longer as good as that of a single star.
_MAX_SHARE = 0.15

# Nearest that two sources are told apart, in FWHM.
_RESOLVED = 0.6

# Rows searched at a time, and their overlap: every source is taken whole, from the strip that holds
# its peak.
_STRIP = 512
_OVERLAP = 64

# Sources measured at a time: bounds the memory for their cut-outs to some tens of MB.
_CHUNK = 20_000


@dataclass(frozen=True, eq=False)
class Background:
    """An image without its background, and its noise.

    Parameters
    ----------
    image : (ny, nx) float32 ndarray
        Image minus background; masked pixels are 0.
    rms : (ny, nx) float32 ndarray
        Standard deviation of the background in every pixel.
    mask : (ny, nx) bool ndarray or None
        True where a pixel must not be used; None if all are good.
    level : float
        Median of the background that was taken off.
    data : (ny, nx) ndarray
        The image as it came in, not copied.
    """

    image: np.ndarray
    rms: np.ndarray
    mask: np.ndarray | None
    level: float
    data: np.ndarray


def subtract_background(data, *, mask=None, mesh=64, filter_size=3):
    """Take a smooth background off an image and map its noise.

    Parameters
    ----------
    data : (ny, nx) array_like
        Image of any real type and byte order; not modified.
    mask : (ny, nx) array_like of bool, optional
        True where a pixel must not be used.  NaN and infinite pixels never are, nor those far
        below the background.
    mesh : int, optional
        Size in px of the cells within which the background is estimated.
    filter_size : int, optional
        Size in cells of the median filter over the cells.

    Returns
    -------
    Background
        Image, noise and mask.

    Raises
    ------
    TypeError
        If the image is not of a real number type.
    ValueError
        If the image is not two-dimensional, or the mask has another shape.
    DetectionError
        If the image has no finite pixels, or no noise.

    Notes
    -----
    The mode of every cell after clipping (Bertin & Arnouts 1996, A&AS 117, 393), median filtered
    and interpolated by bicubic splines, by way of `sep`.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.detection import subtract_background
    >>> background = subtract_background(np.random.default_rng(1).normal(1000, 5, (256, 256)))
    >>> round(background.level), round(float(np.median(background.rms)))
    (1000, 5)
    """
    data = np.asanyarray(data)
    if data.dtype.kind not in "iuf":
        raise TypeError(f"the image must hold real numbers, got dtype {data.dtype}")
    if data.ndim != 2 or min(data.shape) < 8:
        raise ValueError(f"the image must be 2-D and at least 8 x 8 px, got shape {data.shape}")
    if mesh < 4 or filter_size < 1:
        raise ValueError(f"mesh must be >= 4 and filter_size >= 1, got {mesh}, {filter_size}")
    bad = None
    # Most images are whole, which their extremes tell without an array of their own; NaN fails too.
    if data.dtype.kind == "f" and not (data.min() > -_HUGE and data.max() < _HUGE):
        bad = ~(np.abs(data) < _HUGE)
    if mask is not None:
        mask = np.asarray(mask, dtype=bool)
        if mask.shape != data.shape:
            raise ValueError(f"mask has shape {mask.shape}, the image {data.shape}")
        bad = mask.copy() if bad is None else bad | mask
    if bad is not None and not bad.any():
        bad = None
    # A first level, so that float32 keeps the noise of images on a high pedestal.
    stride = max(1, min(data.shape) // 500)
    sample = data[::stride, ::stride]
    if bad is not None:
        sample = sample[~bad[::stride, ::stride]]
        sample = data[~bad] if sample.size == 0 else sample
    if sample.size == 0:
        raise DetectionError("the image has no finite, unmasked pixel")
    pedestal = float(np.median(sample))
    image = np.empty(data.shape, dtype=np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        np.subtract(data, pedestal, out=image, dtype=np.float64, casting="unsafe")
    if bad is not None:
        image[bad] = 0
    size = [min(mesh, n) for n in data.shape]
    estimate = sep.Background(
        image, mask=bad, bh=size[0], bw=size[1], fh=filter_size, fw=filter_size
    )
    rms = estimate.rms(dtype=np.float32)
    noise = np.sqrt(np.median(rms[::stride, ::stride] ** 2))
    if not (np.isfinite(noise) and noise > 0):
        raise DetectionError(f"the image is flat: all pixels near {pedestal:g}, no noise, no stars")
    # Cells of constant pixels (padding, dead regions) have no noise and nothing to detect.
    dead = ~(rms > 1e-3 * noise)
    if dead.any():
        bad = dead if bad is None else bad | dead
        rms[dead] = noise
    estimate.subfrom(image)
    if image.min() < -_COLD * rms.min():
        cold = image < -_COLD * rms
        bad = cold if bad is None else bad | cold
    if bad is not None:
        image[bad] = 0
    return Background(image, rms, bad, pedestal + float(estimate.globalback), data)


def detect_sources(
    data,
    *,
    threshold=5.0,
    mask=None,
    gain=None,
    saturation=None,
    deblend_contrast=0.002,
):
    r"""Find the sources of an image and measure what tells a clean star from the rest.

    Parameters
    ----------
    data : Background or (ny, nx) array_like
        Image, with its background or already without.
    threshold : float, optional
        Least significance of a source's peak, in standard deviations of the smoothed noise.
    mask : (ny, nx) array_like of bool, optional
        True where a pixel must not be used; only for a plain image.
    gain : float, optional
        Electrons per count, for the photon noise in the errors; without it only the background's
        noise counts.
    saturation : float, optional
        Counts, background included, from which a pixel is saturated.  If not given, it is the
        plateau of the brightest pixels, if they have one.
    deblend_contrast : float, optional
        Least share of the flux that makes a peak within a larger source a source of its own.

    Returns
    -------
    `~astropy.table.Table`
        One row per source, in the order found: ``x``, ``y`` (windowed centroid, px, zero based),
        ``x_err``, ``y_err`` (px), ``flux``, ``flux_err`` (counts), ``snr``, ``peak`` (counts above
        background), ``fwhm`` (px), ``roundness``, ``sharpness``, ``flags``.  The meta data holds
        ``fwhm``, that of a typical star, and ``saturation``.

    Raises
    ------
    ValueError
        If an option is out of range.
    DetectionError
        If there are no sources, or nothing to find them on.

    Notes
    -----
    Sources are extracted by `sep` (Bertin & Arnouts 1996, A&AS 117, 393) after smoothing with a
    3 x 3 kernel; positions are its windowed centroids with a Gaussian window of the stars' FWHM.
    With window :math:`w`, pixels :math:`I_i` of noise :math:`\sigma_i`, the error is

    .. math::
        \sigma_x^2 = 4 \sum w_i^2 \sigma_i^2 (x_i - x)^2 / \left(\sum w_i I_i\right)^2 .

    ``fwhm`` comes from the second moments under the same window, with the window taken out.
    ``roundness`` is DAOFIND's GROUND, :math:`2 (h_x - h_y) / (h_x + h_y)`, with the heights of
    Gaussians fitted to the marginal distributions (Stetson 1987, PASP 99, 191), and ``sharpness``
    is DAOFIND's, both as in `photutils.detection.DAOStarFinder`.

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
        data = subtract_background(data, mask=mask)
    elif mask is not None:
        raise ValueError("mask must be given to subtract_background when data is a Background")
    found = _extract(data, threshold, deblend_contrast)
    if len(found) == 0:
        raise DetectionError(f"no source above {threshold:g} sigma on the image")
    if saturation is None:
        saturation = _plateau(data)
    fwhm = _typical_fwhm(data, found)
    table = _measure(data, found, fwhm, gain, saturation)
    table.meta.update(fwhm=fwhm, saturation=saturation)
    log.info(
        "%d sources, %d of them clean, FWHM %.2f px",
        len(table),
        np.count_nonzero(table["flags"] == 0),
        fwhm,
    )
    return table


def detect_companions(residual, sources, *, threshold=5.0, gain=None, deblend_contrast=0.002):
    """Add the sources that show once the known ones are subtracted.

    Parameters
    ----------
    residual : Background
        Image without the known sources, and the noise with their models' error, as from
        `wpdc_gwcs.centroids.subtract_stars`.
    sources : `~astropy.table.Table`
        The known sources, from `detect_sources`.
    threshold : float, optional
        Least significance of a source's peak, in standard deviations of the smoothed noise.
    gain : float, optional
        Electrons per count.
    deblend_contrast : float, optional
        Least share of the flux that makes a peak within a larger source a source of its own.

    Returns
    -------
    `~astropy.table.Table`
        The known sources, then the new ones; `FLAG_BLENDED` is set anew for all.

    Notes
    -----
    A threshold finds no peak on the flank of a brighter star, and the light there moves the centre
    of that star's fit.  What is nearer than 0.6 FWHM to a known source is not told from an error of
    the PSF and left alone.

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
    found = _extract(residual, threshold, deblend_contrast)
    fwhm = sources.meta["fwhm"]
    result = sources.copy()
    if len(found):
        new = _measure(residual, found, fwhm, gain, sources.meta["saturation"])
        distance = KDTree(_places(sources)).query(_places(new))[0]
        new = new[(distance > _RESOLVED * fwhm) & (new["flags"] & FLAG_SATURATED == 0)]
        log.info("%d more sources beside those subtracted", len(new))
        result = vstack([result, new], metadata_conflicts="silent")
        result.meta.update(sources.meta)
    blended = _blended(*(np.asarray(result[c], float) for c in ("x", "y", "flux")), fwhm)
    result["flags"] = result["flags"] & ~FLAG_BLENDED | np.where(blended, FLAG_BLENDED, 0)
    return result


def _places(table):
    return np.column_stack([table["x"], table["y"]])


def _plateau(background):
    """Level at which the brightest pixels are cut off, or None.

    Peaks of stars are the rarer the brighter they are: pixels crowded at the very top have been cut
    off there.
    """
    image = background.image
    top = float(image.max())
    if not top > 0:
        return None
    # Extremes of the image without background, which varies far less than stars' peaks.
    high = image > 0.9 * top
    values = background.data[high if background.mask is None else high & ~background.mask]
    values = values.astype(float) - background.level
    limit = 0.999 * values.max(initial=0.0)
    at_top = np.count_nonzero(values >= limit)
    if at_top < max(5, 2 * (values.size - at_top)) or top < 50 * np.median(background.rms[::99]):
        return None
    return background.level + float(limit)


def _extract(background, threshold, deblend_contrast):
    """Extract peaks with sep; returns its structured array."""
    image, rms, mask = background.image, background.rms, background.mask
    # sep's defaults are for small images: it gives up where more pixels or branches are active.
    sep.set_sub_object_limit(8192)
    threshold = threshold * _KERNEL_NOISE
    parts = []
    # In strips, because sep compares every source with every other one.
    for first in range(0, image.shape[0], _STRIP):
        last = min(first + _STRIP, image.shape[0])
        start, stop = max(first - _OVERLAP, 0), min(last + _OVERLAP, image.shape[0])
        # Room for all pixels of all sources; no more, because sep writes to all of it every time.
        active = np.count_nonzero(image[start:stop] > threshold * rms[start:stop])
        sep.set_extract_pixstack(
            min(300_000 + 3 * active, 300_000 + (stop - start) * image.shape[1])
        )
        part = sep.extract(
            image[start:stop],
            threshold,
            err=rms[start:stop],
            mask=None if mask is None else mask[start:stop],
            minarea=3,
            filter_kernel=_KERNEL,
            filter_type="conv",
            deblend_cont=deblend_contrast,
        )
        for name in ("y", "ypeak", "ycpeak"):
            part[name] += start
        parts.append(part[(part["ycpeak"] >= first) & (part["ycpeak"] < last)])
    return np.concatenate(parts)


def _cutouts(image, xc, yc, half):
    """Cut squares of 2 half + 1 px about integer centres; clamped at the edge of the image."""
    step = np.arange(-half, half + 1)
    iy = np.clip(yc[:, None] + step, 0, image.shape[0] - 1)
    ix = np.clip(xc[:, None] + step, 0, image.shape[1] - 1)
    return image[iy[:, :, None], ix[:, None, :]]


def _window(x, y, xc, yc, half, sigma):
    """Pixel offsets from (x, y) and the Gaussian window there, for cut-outs about (xc, yc)."""
    step = np.arange(-half, half + 1)
    dx = (xc - x)[:, None] + step
    dy = (yc - y)[:, None] + step
    weight = np.exp(-0.5 * (dy / sigma) ** 2)[:, :, None]
    return dx, dy, weight * np.exp(-0.5 * (dx / sigma) ** 2)[:, None, :]


def _sizes(pixels, dx, dy, weight, sigma):
    """Measure standard deviations along both axes, as for Gaussians under the window."""
    weighted = pixels * weight
    total = weighted.sum((1, 2))
    rows, columns = weighted.sum(2), weighted.sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        mx, my = (columns * dx).sum(1) / total, (rows * dy).sum(1) / total
        xx = (columns * dx**2).sum(1) / total - mx**2
        yy = (rows * dy**2).sum(1) / total - my**2
        xy = np.einsum("sj,sji,si->s", dy, weighted, dx) / total - mx * my
        measured = 0.5 * (xx + yy) + np.multiply.outer([1, -1], np.hypot(0.5 * (xx - yy), xy))
        # Inverse variances subtract: 1/measured = 1/profile + 1/window.
        variance = np.where(measured > 0, measured * sigma**2 / (sigma**2 - measured), 0.0)
    variance[measured >= sigma**2] = np.inf
    variance[:, ~(total > 0)] = np.nan
    return np.sqrt(variance)


def _typical_fwhm(background, found):
    """FWHM in px of the stars: median over the brightest sources that are not saturated."""
    good = (found["npix"] >= 5) & (found["peak"] < 0.7 * found["peak"].max())
    rows = np.flatnonzero(good if good.sum() >= 5 else np.ones(len(found), bool))
    rows = rows[np.argsort(found["cpeak"][rows])[::-1][:500]]
    x, y = found["x"][rows], found["y"][rows]
    xc, yc = np.rint(x).astype(int), np.rint(y).astype(int)
    fwhm = 2.0
    for _ in range(4):
        sigma = fwhm * _SIGMA_PER_FWHM
        half = int(np.ceil(3 * sigma)) + 1
        pixels = _cutouts(background.image, xc, yc, half)
        major, minor = _sizes(pixels, *_window(x, y, xc, yc, half, sigma), sigma)
        size = np.hypot(major, minor) / np.sqrt(2)
        size = size[np.isfinite(size) & (size > 0)]
        # Undetermined (all noise, or broader than any window): stay with the isophotal size.
        if size.size == 0:
            fwhm = 2.35 * float(np.median(np.sqrt(found["a"][rows] * found["b"][rows])))
            break
        fwhm = float(np.clip(_mode(size)[0] / _SIGMA_PER_FWHM, 0.75 * fwhm, 2 * fwhm))
    return float(np.clip(fwhm, 1.0, 0.1 * min(background.image.shape)))


def _measure(background, found, fwhm, gain, saturation):
    """Measure all sources; returns the table."""
    image, rms, bad = background.image, background.rms, background.mask
    sigma = fwhm * _SIGMA_PER_FWHM
    x, y = _windowed(background, found, sigma, fwhm)
    radius = 1.5 * fwhm
    flux, flux_err, _ = sep.sum_circle(image, x, y, radius, err=rms, mask=bad, gain=gain, subpix=5)
    parts = [
        _shapes(
            background, x[k], y[k], found["xpeak"][k], found["ypeak"][k], fwhm, gain, saturation
        )
        for k in (slice(start, start + _CHUNK) for start in range(0, len(found), _CHUNK))
    ]
    shapes = {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
    flags = shapes.pop("flags")
    minor, size = shapes.pop("minor"), shapes["fwhm"]
    flags |= _unlike_stars(minor, size, shapes["snr"], flags)
    shapes["fwhm"] = np.where(np.isfinite(size), size, np.nan)
    flags |= np.where(_blended(x, y, flux, fwhm), FLAG_BLENDED, 0)
    return Table(
        {"x": x, "y": y}
        | {name: shapes.pop(name) for name in ("x_err", "y_err")}
        | {"flux": flux, "flux_err": flux_err}
        | shapes
        | {"flags": flags},
        meta={},
    )


def _windowed(background, found, sigma, fwhm):
    """Windowed centroids; the isophotal ones where the window ran away to a neighbour."""
    x, y = found["x"].astype(float), found["y"].astype(float)
    xw, yw, _ = sep.winpos(
        background.image, found["xcpeak"], found["ycpeak"], sigma, mask=background.mask, subpix=5
    )
    moved = np.hypot(xw - found["xcpeak"], yw - found["ycpeak"])
    ran_away = ~(moved < 0.7 + 0.5 * fwhm)
    away = ~(np.hypot(x - found["xcpeak"], y - found["ycpeak"]) < 0.7 + 0.5 * fwhm)
    x[away], y[away] = found["xcpeak"][away], found["ycpeak"][away]
    return np.where(ran_away, x, xw), np.where(ran_away, y, yw)


def _shapes(background, x, y, xpeak, ypeak, fwhm, gain, saturation):
    """Errors, S/N, shape and per-pixel flags of some sources; a dict of columns."""
    image, bad = background.image, background.mask
    ny, nx = image.shape
    sigma = fwhm * _SIGMA_PER_FWHM
    half = int(np.ceil(3 * sigma)) + 1
    xc, yc = np.rint(x).astype(int), np.rint(y).astype(int)
    pixels = _cutouts(image, xc, yc, half)
    dx, dy, weight = _window(x, y, xc, yc, half, sigma)
    # Clamped cut-outs repeat the outermost pixels: they must not count twice.
    step = np.arange(-half, half + 1)
    outside_x = (xc[:, None] + step < 0) | (xc[:, None] + step >= nx)
    outside_y = (yc[:, None] + step < 0) | (yc[:, None] + step >= ny)
    weight *= ~(outside_y[:, :, None] | outside_x[:, None, :])
    core = np.hypot(dy[:, :, None], dx[:, None, :]) <= max(fwhm, 1.5)
    flags = np.where(
        (x < fwhm - 0.5) | (y < fwhm - 0.5) | (x > nx - 0.5 - fwhm) | (y > ny - 0.5 - fwhm),
        FLAG_EDGE,
        0,
    )
    if bad is not None:
        masked = _cutouts(bad, xc, yc, half)
        weight *= ~masked
        flags |= np.where((masked & core).any((1, 2)), FLAG_BAD_PIXEL, 0)
    if saturation is not None:
        full = _cutouts(background.data, xc, yc, half) >= saturation
        flags |= np.where((full & core).any((1, 2)), FLAG_SATURATED, 0)
    variance = _cutouts(background.rms, xc, yc, half).astype(float) ** 2
    if gain is not None:
        variance += np.maximum(pixels, 0) / gain
    signal = (weight * pixels).sum((1, 2))
    noise = weight**2 * variance
    with np.errstate(divide="ignore", invalid="ignore"):
        snr = signal / np.sqrt(noise.sum((1, 2)))
        x_err = 2 * np.sqrt((noise.sum(1) * dx**2).sum(1)) / signal
        y_err = 2 * np.sqrt((noise.sum(2) * dy**2).sum(1)) / signal
    positive = signal > 0
    major, minor = _sizes(pixels, dx, dy, weight, sigma)
    roundness, sharpness = _daofind_shape(image, xpeak, ypeak, sigma)
    return {
        "x_err": np.where(positive, x_err, np.nan),
        "y_err": np.where(positive, y_err, np.nan),
        "snr": np.where(positive, snr, 0.0),
        "peak": np.where(core, pixels, -np.inf).max((1, 2)).astype(float),
        "fwhm": np.hypot(major, minor) / np.sqrt(2) / _SIGMA_PER_FWHM,
        "roundness": roundness,
        "sharpness": sharpness,
        "minor": minor / _SIGMA_PER_FWHM,
        "flags": flags,
    }


def _daofind_shape(image, xpeak, ypeak, sigma):
    """DAOFIND's GROUND roundness and sharpness about the given peak pixels."""
    half = max(2, int(1.5 * sigma))
    pixels = _cutouts(image, xpeak, ypeak, half).astype(float)
    step = np.arange(-half, half + 1)
    gauss = np.exp(-0.5 * (step / sigma) ** 2)
    triangle = half + 1.0 - np.abs(step)
    # Both marginal fits are linear in the pixels: height = sum_ij heights_ij I_ij.
    marginal = gauss * (gauss * triangle).sum()
    mean = (marginal * triangle).sum() / triangle.sum()
    profile = triangle * (marginal - mean)
    profile /= (triangle * marginal**2).sum() - mean * (marginal * triangle).sum()
    height_y = np.einsum("sji,j,i->s", pixels, profile, triangle)
    height_x = np.einsum("sji,j,i->s", pixels, triangle, profile)
    # Density enhancement: the fit of a Gaussian plus constant within 1.5 sigma (at least 2 px).
    distance = np.hypot(step[:, None], step)
    inside = (distance <= 1.5 * sigma) | (distance <= 2)
    kernel = np.where(inside, gauss[:, None] * gauss, 0)
    kernel = np.where(inside, kernel - kernel.sum() / inside.sum(), 0) / (
        (kernel**2).sum() - kernel.sum() ** 2 / inside.sum()
    )
    peak = pixels[:, half, half]
    rest = ((pixels * inside).sum((1, 2)) - peak) / (inside.sum() - 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        roundness = 2 * (height_x - height_y) / (height_x + height_y)
        sharpness = (peak - rest) / (pixels * kernel).sum((1, 2))
    return np.where((height_x > 0) & (height_y > 0), roundness, np.nan), sharpness


def _unlike_stars(minor, size, snr, flags):
    """Flag what is clearly sharper or broader than the stars of this image."""
    result = np.zeros(len(size), int)
    bright = (flags == 0) & (snr > 30) & np.isfinite(size)
    if bright.sum() < 10:
        bright = (flags == 0) & np.isfinite(size)
    if bright.sum() < 10:
        return result
    typical_size, size_scatter = _mode(size[bright])
    typical_minor, minor_scatter = _mode(minor[bright])
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


def _mode(values):
    """Most crowded value and its scatter: centre and width of the shortest third of the values.

    Cosmic rays and galaxies can be more than half of the bright sources; the stars are those that
    are alike.
    """
    values = np.sort(values)
    n = max(2, int(np.ceil(len(values) / 3)))
    if len(values) <= n:
        return float(np.median(values)), 0.0
    width = values[n - 1 :] - values[: len(values) - n + 1]
    first = int(np.argmin(width))
    # A third of a normal distribution lies within 0.43 standard deviations.
    return float(np.median(values[first : first + n])), float(width[first] / 0.86)


def _blended(x, y, flux, fwhm):
    """Mark sources whose core holds more than a few per cent of a neighbour's light."""
    blended = np.zeros(len(x), bool)
    pairs = KDTree(np.column_stack([x, y])).query_pairs(4 * fwhm, output_type="ndarray")
    if len(pairs) == 0:
        return blended
    i, j = pairs.T
    distance = np.hypot(x[i] - x[j], y[i] - y[j]) / fwhm
    # Moffat profile with beta = 2.5 of unit FWHM, relative to its peak.
    light = (1 + (distance * 2) ** 2 * (2**0.4 - 1)) ** -2.5
    flux = np.maximum(flux, 1e-6 * np.max(flux, initial=1.0))
    share = np.zeros(len(x))
    np.add.at(share, i, flux[j] / flux[i] * light)
    np.add.at(share, j, flux[i] / flux[j] * light)
    close = distance < 1.2
    blended[i[close]] = blended[j[close]] = True
    return blended | (share > _MAX_SHARE)
