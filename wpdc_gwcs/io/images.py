"""Pixels of image extensions: shapes, planes of cubes, units, gain and saturation.

::

    NAXIS = 2                    --load_image--> float array, blank pixels NaN
    NAXIS = 3, three colors      --load_image--> their sum
    NAXIS = 3, path[EXT][plane]  --load_image--> one plane
"""

import re

import numpy as np
from astropy import units as u

from wpdc_gwcs.exceptions import FrameError
from wpdc_gwcs.io.dates import EXPOSURE_KEYS
from wpdc_gwcs.io.files import first_line, open_fits
from wpdc_gwcs.io.headers import header_text, positive_number

__all__ = [
    "LUMINANCE",
    "choose_plane",
    "image_gain",
    "image_read_noise",
    "image_saturation",
    "image_shape",
    "load_image",
    "pixels_of",
    "planes_of",
    "split_plane",
]

# Symbol for the sum of all planes in path[EXT][plane].
LUMINANCE = "L"

_GAIN_KEYS = ("GAIN", "EGAIN", "GAINA", "CCDGAIN", "ATODGAIN", "HIERARCH ESO DET OUT1 CONAD")
_READ_NOISE_KEYS = (
    "RDNOISE",
    "READNOIS",
    "READNOISE",
    "RON",
    "ENOISE",
    "RDNOISEA",
    "READNSEA",
    "RONOISE",
    "HIERARCH ESO DET OUT1 RON",
)
_SATURATION_KEYS = ("SATURATE", "SATURATION", "SATURAT", "SATLEVEL", "SATURATA")

# Spellings of units that count electrons or digital units, and of a rate.
_ELECTRONS = re.compile(r"(e-?|el|elec|electrons?|photo-?electrons?|photons?|ph)\b", re.IGNORECASE)
_COUNTS = re.compile(r"(adu|counts?|cts?|dn|data ?numbers?|digital ?numbers?)\b", re.IGNORECASE)
_RATE = re.compile(
    r"(/|\bper\b)\s*\(?\s*(s|sec|secs|seconds?)\b|\bs(ec(ond)?s?)?\s*(\*\*|\^)?\s*\(?-1",
    re.IGNORECASE,
)

# Cards that mark three planes as colors.
_COLOR_KEYS = re.compile(r"COLOU?R|CSPACE|BAYER|CFA")
_COLOR_TEXT = re.compile(r"\b(RGB|sRGB|BAYER|COLOU?R)\b", re.IGNORECASE)


def split_plane(path):
    """Split ``path[EXT][plane]``.

    Parameters
    ----------
    path : path-like
        What the user wrote.

    Returns
    -------
    path : str or path-like
        Without the plane.
    plane : int or str or None
        Number counted from zero, ``L`` for all planes together, `None` if none was given.
    """
    match = re.fullmatch(r"(.+\[[^\[\]]+\])\[(\d+|[Ll])\]", str(path))
    if match is None:
        return path, None
    plane = match.group(2)
    return match.group(1), int(plane) if plane.isdigit() else LUMINANCE


def image_shape(header):
    """Return the shape of an image, or of the planes of a cube.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        Header of the extension.

    Returns
    -------
    (int, int) or None
        ``(ny, nx)``; `None` if there are no pixels.
    """
    axes = _axes(header)
    if len(axes) < 2 or min(axes) < 1:
        return None
    return axes[1], axes[0]


def planes_of(header):
    """Count the planes of an image.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        Header of the extension.

    Returns
    -------
    int
        1 for an image.
    """
    return int(np.prod(_axes(header)[2:], dtype=int))


def choose_plane(header, plane, where):
    """Choose the plane of an image to measure.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        Header of the extension.
    plane : int or str or None
        Choice of the user.
    where : str
        For messages: ``path[EXT]``.

    Returns
    -------
    int or str
        Number of the plane, or ``L`` for the sum of all.

    Raises
    ------
    FrameError
        If there is no such plane, or one has to be chosen.
    """
    n = planes_of(header)
    if plane is not None:
        if plane != LUMINANCE and plane >= n:
            raise FrameError(f"{where}: plane must be 0 to {n - 1} or {LUMINANCE}, got {plane}")
        return plane
    if n == 1:
        return 0
    if n == 3 and _is_color(header):
        return LUMINANCE
    axes = " x ".join(str(a) for a in _axes(header))
    kinds = ", ".join(
        text for k in range(3, header["NAXIS"] + 1) if (text := header_text(header, f"CTYPE{k}"))
    )
    along = f" along {kinds}" if kinds else ""
    named = ", ".join(f"{where}[{k}]" for k in range(min(n, 3))) + (
        f", ... {where}[{n - 1}]" if n > 3 else ""
    )
    raise FrameError(
        f"{where}: is a cube of {n} planes{along} ({axes} px), not an image: choose one of its "
        f"planes ({named}), or their sum ({where}[{LUMINANCE}])"
    )


def _axes(header):
    return [int(header.get(f"NAXIS{i + 1}", 0)) for i in range(header.get("NAXIS", 0))]


def _is_color(header):
    for card in header.cards:
        if card.keyword in ("COMMENT", "HISTORY", ""):
            continue
        if _COLOR_KEYS.search(card.keyword):
            return True
        if isinstance(card.value, str) and _COLOR_TEXT.search(card.value):
            return True
    return False


def image_gain(headers):
    """Find the electrons per count of the pixels, by gain, unit and exposure time.

    Parameters
    ----------
    headers : sequence of `~astropy.io.fits.Header`
        Headers of the extension and of the file.

    Returns
    -------
    float or None
        `None` if the header does not tell.
    """
    gain = positive_number(headers, _GAIN_KEYS)
    unit = next((t for h in headers if (t := header_text(h, "BUNIT"))), "").strip()
    if not unit:
        return gain
    time = positive_number(headers, EXPOSURE_KEYS) if _RATE.search(unit) else 1.0
    if _ELECTRONS.match(unit):
        return time
    if _COUNTS.match(unit):
        return None if gain is None or time is None else gain * time
    # Fluxes and surface brightnesses do not tell counts.
    return None if _is_physical(unit) else gain


def _is_physical(text):
    try:
        unit = u.Unit(text)
    except ValueError:
        return False
    return unit != u.dimensionless_unscaled


def image_read_noise(headers):
    """Find the read noise.

    Parameters
    ----------
    headers : sequence of `~astropy.io.fits.Header`
        Headers of the extension and of the file.

    Returns
    -------
    float or None
        Read noise in electrons; `None` if the header does not tell.
    """
    return positive_number(headers, _READ_NOISE_KEYS)


def image_saturation(headers):
    """Find the counts above which pixels are saturated.

    Parameters
    ----------
    headers : sequence of `~astropy.io.fits.Header`
        Headers of the extension and of the file.

    Returns
    -------
    float or None
        `None` if the header does not tell.
    """
    return positive_number(headers, _SATURATION_KEYS)


def load_image(path, index, plane=0):
    """Read the pixels of one extension: float, native byte order, blank pixels NaN.

    Parameters
    ----------
    path : str
        FITS file.
    index : int
        Number of the extension.
    plane : int or str, optional
        Plane of a cube, ``L`` for the sum of all.

    Returns
    -------
    (ny, nx) ndarray
        float32, or float64 where the file has more digits.

    Raises
    ------
    FrameError
        If the data are damaged.
    """
    where = f"{path}[{index}]"
    with open_fits(path, error=FrameError) as hdus:
        hdu = hdus[index]
        # Taken first: astropy drops them from the header when it scales.
        blank = hdu.header.get("BLANK", hdu.header.get("ZBLANK"))
        scale, zero = hdu.header.get("BSCALE", 1.0), hdu.header.get("BZERO", 0.0)
        data = pixels_of(hdu, where)
        planes = data.reshape(-1, *data.shape[-2:])
        if plane == LUMINANCE:
            return sum(_as_float(p, blank, scale, zero) for p in planes)
        return _as_float(planes[plane], blank, scale, zero)


def pixels_of(hdu, where):
    """Read the pixels of an extension.

    Parameters
    ----------
    hdu : HDU
        Image, compressed or not.
    where : str
        For messages: ``path[EXT]``.

    Returns
    -------
    data : ndarray
        As astropy has it.

    Raises
    ------
    FrameError
        If the data are damaged.
    """
    try:
        return hdu.data
    except Exception as problem:  # noqa: BLE001  Decompression has an exception without a name.
        raise FrameError(f"{where}: damaged image: {first_line(problem)}") from problem


def _as_float(data, blank, scale, zero):
    if data.dtype.kind in "iub":
        image = data.astype(np.float32 if data.dtype.itemsize <= 2 else np.float64)
        if blank is not None:
            image[data == blank * scale + zero] = np.nan
        return image
    if data.dtype.itemsize == 8 or data.dtype.itemsize == 2 or not data.flags.writeable:
        return data.astype(np.float64 if data.dtype.itemsize == 8 else np.float32)
    # In place, because new memory for another image takes longer than the byte swap.
    return data if data.dtype.isnative else data.byteswap(inplace=True).view(np.float32)
