"""Images that belong to an image: masks, weights, errors, times.

::

    SCI, ERR, DQ | IMAGE, MSK, WGT | x.SCI, x.RMS, x.FLG | ... --pair_companions--> frames
    of each frame: mask and weight, read when they are needed (`load_mask`, `load_weight`)
"""

import logging
import re
import warnings
from dataclasses import dataclass, replace

import numpy as np

from wpdc_gwcs.exceptions import FrameError, WPDCWarning
from wpdc_gwcs.io.files import open_fits, split_extension, stem_of
from wpdc_gwcs.io.headers import find_extension, header_text
from wpdc_gwcs.io.images import pixels_of
from wpdc_gwcs.robust import robust_scatter

__all__ = [
    "SCIENCE_WORDS",
    "WCS_KEYS",
    "Companion",
    "data_section",
    "given_plane",
    "load_mask",
    "load_weight",
    "map_beside",
    "map_role",
    "words_of",
    "pair_companions",
]

log = logging.getLogger(__name__)

# Words of extension names by meaning; the first family with a match wins.
_ROLES = {
    "mask": "GOODPIX DQ DQM DQF MASK MSK BPM BAD BADPIX FLAG FLAGS FLG QUALITY QUAL DEFECTS OOD",
    "weight": "CONF CONFIDENCE CONFMAP WHT WGT WEIGHT WEIGHTS WMAP IVAR INVVAR INVERSE INV OOW",
    "error": "ERR ERROR ERRORS RMS SIGMA SIG NOISE UNC UNCERT UNCERTAINTY STD STDDEV STDEV",
    "variance": "VAR VARIANCE",
    "other": "SAMP TIME EXP EXPTIME EXPMAP EXPOSURE COV COVERAGE CON CTX CONTEXT NCOMBINE NCOMB "
    "BKG BKGD BACKGROUND SKY MODEL RESIDUAL RESID AREA PSF IMARR WCSDVARR DVARR",
}
_ROLES = {role: frozenset(words.split()) for role, words in _ROLES.items()}
# The same words for files, without those that have other meanings for exposures.
_MAP_WORDS = {
    role: names - {"STD", "SIG", "BAD"} for role, names in _ROLES.items() if role != "other"
}
# Longer words are also found inside others (BADPIXELMASK, WEIGHTMAP).
_LONGEST_PLAIN = 3
SCIENCE_WORDS = frozenset(
    ("SCI", "SCIENCE", "IMAGE", "IMG", "DATA", "PRIMARY", "COMPRESSED", "OOI")
)
# Values of the HDUCLASS convention.
_CLASSES = {"ERROR": "error", "QUALITY": "mask", "WEIGHT": "weight"}
_CLASS_VALUES = {"MSE": "variance", "RMSE": "error", "INVMSE": "weight", "INVRMSE": "other"}

# Keywords that extensions of one detector share, but different detectors do not.
_IDENTITY = ("CCDNAME", "CHIPNAME", "DETNAME", "DETECTOR", "CHIPID", "CCDNUM", "CCDCHIP", "DETSEC")
WCS_KEYS = ("CRVAL1", "CRVAL2", "CRPIX1", "CRPIX2", "CD1_1", "CD1_2", "PC1_1", "CDELT1")

# Named mask planes (Rubin and similar, MP_name) that make a pixel useless; the others mark sources
# or processing steps.
_BAD_PLANES = frozenset(
    "BAD SAT INTRP CR EDGE NO_DATA SUSPECT UNMASKEDNAN CROSSTALK VIGNETTED".split()
)
# Telescopes whose lowest bit is the logical or of the others.
_DO_NOT_USE = ("JWST", "ROMAN")

# A bit is checked if more than these fractions of the pixels have it: for marking sources, and for
# marking nothing special, which applies only to areas larger than defects.
_FEW, _SHARE = 0.001, 0.05
# Pixels are like the rest if their median agrees within this many standard deviations, and their
# scatter and fraction of outliers agree within a factor (the latter with a floor).
_MEDIAN, _SCATTER, _OUTLIERS, _OUTLIER_FLOOR = 1.0, 1.4, 2.0, 0.003
_N_SAMPLE = 200_000
# A bit marks sources if its pixels are contiguous and are most of the bright ones (in standard
# deviations), but not saturated.
_BRIGHT, _TOO_BRIGHT, _OF_SOURCES, _CONNECTED = 5.0, 50.0, 0.5, 0.7


@dataclass(frozen=True)
class Companion:
    """An image extension that belongs to another one.

    Parameters
    ----------
    path : str
        Path of the file.
    index : int
        Number of the extension.
    role : {"mask", "weight", "error", "variance", "other"}
        Meaning of the pixels.
    given : bool, optional
        Whether the user gave it: then everything it marks is bad.
    """

    path: str
    index: int
    role: str
    given: bool = False


def pair_companions(hdus, images, path):
    """Assign masks, weights and other companions to frames.

    Parameters
    ----------
    hdus : `~astropy.io.fits.HDUList`
        The open file.
    images : list of int
        Extensions that are images.
    path : path-like
        The file.

    Returns
    -------
    dict
        Extension of each frame to the list of its companions, in the order of the file.

    Notes
    -----
    A companion is recognized by a word of its name or by ``HDUCLASS``; without either, by having
    the same WCS as a frame with another name, which different detectors never have.
    """
    roles = {i: _role_of(hdus[i]) for i in images}
    main = [i for i in images if roles[i] is None] or list(images)
    frames = {}
    for i in main:
        twin = next((f for f in frames if _is_twin(hdus[f], hdus[i])), None)
        if twin is None:
            frames[i] = []
        else:
            roles[i] = "mask" if _looks_like_mask(hdus[i]) else "other"
    for i in images:
        near = [f for f in frames if _shape(hdus[f]) == _shape(hdus[i])]
        if i in frames or not near:
            continue
        best = max(near, key=lambda f, i=i: (*_kinship(hdus[f], hdus[i]), f < i, -abs(i - f)))
        frames[best].append(Companion(str(path), i, roles[i] or "other"))
    return frames


def _shape(hdu):
    return tuple(hdu.header.get(f"NAXIS{k}") for k in (1, 2))


def words_of(name):
    """Split the name of an extension or a file into its words and numbers.

    Parameters
    ----------
    name : str
        The name.

    Returns
    -------
    list of str
        In capitals, in order.
    """
    return re.findall(r"[A-Z]+|\d+", name.upper())


def _role_of(hdu):
    """Role by class or name; `None` for a frame."""
    for key in ("HDUCLAS3", "HDUCLAS2"):
        text = header_text(hdu.header, key).upper()
        if text in _CLASS_VALUES or text in _CLASSES:
            return _CLASS_VALUES.get(text) or _CLASSES[text]
    return _role_by(words_of(hdu.name), _ROLES)


def _role_by(words, roles):
    for role, names in roles.items():
        longer = [n for n in names if len(n) > _LONGEST_PLAIN and role != "other"]
        if any(word in names or any(n in word for n in longer) for word in words):
            return role
    return None


def map_role(words):
    """Find the meaning of the pixels of a file from words of its name.

    Parameters
    ----------
    words : sequence of str
        In capitals, in order.

    Returns
    -------
    {"mask", "weight", "error", "variance"} or None
        `None` if the words do not tell.
    """
    # Also joined words: bad_pixel_map.
    return _role_by([*words, "".join(words)], _MAP_WORDS)


def _kinship(frame, other):
    """Rank of the evidence that two extensions belong together."""
    rest = [
        [
            w
            for w in words_of(h.name)
            if w not in SCIENCE_WORDS and not any(w in n for n in _ROLES.values())
        ]
        for h in (frame, other)
    ]
    return rest[0] == rest[1], frame.ver == other.ver, _same(frame, other, WCS_KEYS)


def _same(one, other, keys):
    return all(one.header.get(k) == other.header.get(k) for k in keys)


def _is_twin(frame, other):
    """Whether an extension has the WCS of a frame and is not evidently another detector."""
    if _shape(frame) != _shape(other) or "CRVAL1" not in other.header:
        return False
    if not (_same(frame, other, WCS_KEYS) and _same(frame, other, _IDENTITY)):
        return False
    # Except for numbers, detectors of one camera have the same name.
    kind = [[w for w in words_of(h.name) if not w.isdigit()] for h in (frame, other)]
    return kind[0] != kind[1]


def _looks_like_mask(hdu):
    """Whether pixels are integers, most of them zero."""
    if hdu.header.get("BITPIX", -32) < 0:
        return False
    try:
        return bool(np.mean(np.asarray(pixels_of(hdu, "image")) == 0) > 0.5)
    except FrameError:
        return False


def given_plane(path, frame_index, frame_name, shape, role):
    """Find the mask or the weight for a frame in a file.

    Parameters
    ----------
    path : path-like
        FITS image, ``path`` or ``path[EXT]``; from several images, the one with the name or else
        the number of the extension of the frame.
    frame_index : int
        Extension of the frame.
    frame_name : str
        Its name.
    shape : (int, int)
        Shape of the frame.
    role : {"mask", "weight"}
        Purpose; a map with a name for errors or variances is used as such.

    Returns
    -------
    Companion
        The extension.

    Raises
    ------
    FrameError
        If there is none of the frame's shape.
    """
    plain, extension = split_extension(path)
    with open_fits(plain, error=FrameError) as hdus:
        images = [i for i, h in enumerate(hdus) if h.is_image and h.header.get("NAXIS", 0) >= 2]
        if extension is not None:
            index = find_extension(hdus, extension, plain, error=FrameError)
        elif len(images) == 1:
            index = images[0]
        else:
            named = [i for i in images if frame_name and hdus[i].name == frame_name.upper()]
            index = named[0] if len(named) == 1 else frame_index
        if index not in images:
            raise FrameError(f"{path}: has no image for extension {frame_index} of the frame")
        found = _shape(hdus[index])[::-1]
        if found != tuple(shape):
            raise FrameError(
                f"{plain}[{index}]: {role} must have the shape (ny, nx) {tuple(shape)} of the "
                f"frame, has {found}"
            )
        own = _role_of(hdus[index])
    if role == "weight" and own in ("error", "variance"):
        role = own
    return Companion(str(plain), index, role, given=True)


def map_beside(path, frame_index, frame_name, shape):
    """Find the mask or the weight for a frame in a file next to it.

    Parameters
    ----------
    path : path-like
        The file.
    frame_index : int
        Extension of the frame.
    frame_name : str
        Its name.
    shape : (int, int)
        Shape of the frame.

    Returns
    -------
    Companion
        The extension, with its role from the name of the file.
    """
    role = map_role(words_of(stem_of(path)))
    found = given_plane(path, frame_index, frame_name, shape, role)
    return replace(found, role=role, given=False)


def data_section(header, shape):
    """Return the part of an image that is exposed to the sky, from DATASEC or TRIMSEC.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        Header of the image.
    shape : (int, int)
        Its shape.

    Returns
    -------
    (slice, slice) or None
        Rows and columns; `None` if it is the whole image, or the section is in other pixels (for
        example those before a trim).
    """
    for key in ("DATASEC", "TRIMSEC"):
        match = re.fullmatch(
            r"\[\s*(\d+)\s*:\s*(\d+)\s*,\s*(\d+)\s*:\s*(\d+)\s*\]", header_text(header, key)
        )
        if match is None:
            continue
        x0, x1, y0, y1 = (int(v) for v in match.groups())
        (x0, x1), (y0, y1) = sorted((x0, x1)), sorted((y0, y1))
        ny, nx = shape
        inside = x0 >= 1 and y0 >= 1 and x1 <= nx and y1 <= ny
        area = (x1 - x0 + 1) * (y1 - y0 + 1)
        if inside and 0.5 * nx * ny <= area < nx * ny:
            return slice(y0 - 1, y1), slice(x0 - 1, x1)
    return None


def load_mask(masks, section, shape, bits, load_image):
    """Read the pixels that must not be used.

    Parameters
    ----------
    masks : sequence of Companion
        Masks.
    section : (slice, slice) or None
        Part of the image that is exposed to the sky.
    shape : (int, int)
        Shape of the image.
    bits : int or None
        Bits that mean bad; `None` for those that the header names, or else all except bits whose
        pixels are like the rest and bits that mark sources.
    load_image : callable
        Returns the image.

    Returns
    -------
    (ny, nx) ndarray of bool
        True where bad.
    """
    bad = np.zeros(shape, bool)
    for mask in masks:
        values, header = _read(mask, shape)
        values = np.where(np.isfinite(values), values, 0).astype(np.int64)
        bad |= _bad_pixels(values, header, bits, load_image, mask)
    if section is not None:
        outside = np.ones(shape, bool)
        outside[section] = False
        bad |= outside
    return bad


def _bad_pixels(values, header, bits, load_image, mask):
    if bits is not None:
        return values & bits != 0
    if mask.given or not values.any():
        return values != 0
    where = f"{mask.path}[{mask.index}]"
    named = {k[3:]: v for k, v in header.items() if k.startswith("MP_") and isinstance(v, int)}
    if named:
        bits = sum(1 << v for name, v in named.items() if name in _BAD_PLANES)
        return values & bits != 0
    if header_text(header, "TELESCOP").upper() in _DO_NOT_USE:
        return values & 1 != 0
    different = np.unique(values)
    if len(different) == 2 and different[0] == 0 and np.mean(values != 0) > 0.5:
        return values == 0  # ones mean good
    present = int(np.bitwise_or.reduce(values, axis=None))
    bad = np.zeros(values.shape, bool)
    clean, image = values == 0, None
    for bit in (1 << k for k in range(63) if present >> k & 1):
        has = values & bit != 0
        if has.mean() > _FEW:
            image = load_image() if image is None else image
            alone = values == bit
            if _says_nothing(image, has, alone if alone.any() else has, clean):
                log.info("%s: bit %d is ignored: its pixels are good", where, bit)
                continue
        bad |= has
    if bad.all():
        warnings.warn(f"{where}: marks all pixels as bad and is ignored", WPDCWarning)
        return ~bad
    return bad


def _says_nothing(image, has, alone, clean):
    """Whether pixels with a bit are like those without any, or are those of sources.

    Only pixels without other bits are compared.
    """
    rest = _sample(image[clean])
    if rest.size < 100:
        return False
    middle, scatter = _spread(rest)
    own = _sample(image[alone])
    if own.size < 100 or not scatter > 0:
        return False
    level, spread = _spread(own)
    bright = (image > middle + _BRIGHT * scatter) & (image < middle + _TOO_BRIGHT * scatter)
    beside = (has[:, 1:] & has[:, :-1]).sum() / max(has.sum(), 1)
    if bright.any() and np.mean(has[bright]) > _OF_SOURCES and beside > _CONNECTED:
        return True
    if has.mean() < _SHARE:
        return False
    outliers = [np.mean(np.abs(v - middle) > _BRIGHT * scatter) for v in (own, rest)]
    return bool(
        abs(level - middle) < _MEDIAN * scatter
        and scatter / _SCATTER < spread < scatter * _SCATTER
        and outliers[0] < _OUTLIERS * outliers[1] + _OUTLIER_FLOOR
    )


def _sample(values):
    values = values[:: max(1, values.size // _N_SAMPLE)].astype(float)
    return values[np.isfinite(values)]


def _spread(values):
    return np.median(values), robust_scatter(values)


def load_weight(companion, shape):
    """Read inverse variances.

    Parameters
    ----------
    companion : Companion
        Weight, error or variance.
    shape : (int, int)
        Shape of the image.

    Returns
    -------
    (ny, nx) float32 ndarray or None
        Weights of any scale, zero where a pixel must not be used; `None`, with a warning, where
        hardly any pixel has one.
    """
    values, _ = _read(companion, shape)
    values = values.astype(np.float64)
    good = np.isfinite(values) & (values > 0)
    if good.mean() < 0.05:
        warnings.warn(
            f"{companion.path}[{companion.index}]: {companion.role} must be positive, is so for "
            f"{good.mean():.1%} of the pixels, and is ignored",
            WPDCWarning,
        )
        return None
    # Relative to the median, so that squares stay within float32 in any unit.
    values = np.where(good, values / np.median(values[good]), 0.0)
    power = {"weight": 1, "variance": -1, "error": -2}[companion.role]
    with np.errstate(divide="ignore"):
        return np.where(good, values**power, 0.0).astype(np.float32)


def _read(companion, shape):
    """Pixels and header of a companion."""
    where = f"{companion.path}[{companion.index}]"
    with open_fits(companion.path, error=FrameError) as hdus:
        hdu = hdus[companion.index]
        header = hdu.header.copy()
        if "TELESCOP" not in header and "TELESCOP" in hdus[0].header:
            header["TELESCOP"] = hdus[0].header["TELESCOP"]
        data = np.array(pixels_of(hdu, where))
    return data.reshape(shape), header
