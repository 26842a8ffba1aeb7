"""Camera and exposure of a frame, from its headers."""

import re

import numpy as np

from wpdc_gwcs.exceptions import FrameError
from wpdc_gwcs.io.dates import header_start
from wpdc_gwcs.io.headers import header_text

__all__ = ["camera_key", "exposure_key", "has_identifier"]

_CAMERA_KEYS = ("INSTRUME", "TELESCOP")
# Identifiers that the detectors of an exposure share.  Some observatories restart the numbers every
# night, or share one in a block of exposures: `wpdc_gwcs.calibration.exposures` also checks times.
_EXPOSURE_KEYS = (
    "EXPNUM",
    "EXP-ID",
    "EXP_ID",
    "EXPID",
    "OBSID",
    "OBS-ID",
    "OBS_ID",
    "OBSNUM",
    "ROOTNAME",
)
# Placeholders in headers.
_PLACEHOLDERS = {"", "0", "-1", "NONE", "NULL", "NAN", "UNKNOWN", "UNDEFINED", "N/A", "TBD"}


def camera_key(headers):
    """Find the camera that took a frame.

    Parameters
    ----------
    headers : sequence of `~astropy.io.fits.Header`
        Searched in turn, the header of the frame first.

    Returns
    -------
    camera : str or None
        ``INSTRUME``, else ``TELESCOP``, in upper case and without what is neither letter nor digit:
        "Suprime-Cam" and "SUPRIMECAM " are one camera.  `None` if the headers do not tell.
    """
    text = _first_text(headers, _CAMERA_KEYS)
    return None if text is None else re.sub(r"[\W_]+", "", text.upper()) or text


def exposure_key(headers, *, keyword=None, name="header"):
    """Find the identifier of the exposure of a frame among those of its camera.

    Parameters
    ----------
    headers : sequence of `~astropy.io.fits.Header`
        Searched in turn, the header of the frame first.
    keyword : str, optional
        Keyword with the identifier; by default ``EXPNUM`` and similar, else the start time.
    name : str, optional
        Name of the header in messages.

    Returns
    -------
    exposure : str or None
        Value of the keyword, or time in ISO form; `None` if the headers do not tell.

    Raises
    ------
    FrameError
        If the requested keyword is missing.
    """
    if keyword is not None:
        text = _first_text(headers, (keyword,))
        if text is None:
            raise FrameError(
                f"{name}: the header must have the keyword {keyword!r} that names the exposure, "
                "has none or an empty one"
            )
        return text
    text = _first_text(headers, _EXPOSURE_KEYS)
    if text is not None:
        return text
    start = header_start(headers)
    if start is None:
        return None
    # Milliseconds: finer than the precision of headers, coarser than rounding errors of dates.
    date = np.datetime64("1858-11-17", "ms") + np.timedelta64(round(start * 86_400_000), "ms")
    return str(date)


def has_identifier(headers):
    """Return whether the headers have an identifier of the exposure, not only a time.

    Parameters
    ----------
    headers : sequence of `~astropy.io.fits.Header`
        Headers of a frame.

    Returns
    -------
    bool
        Whether one of the keywords for it is filled in.
    """
    return _first_text(headers, _EXPOSURE_KEYS) is not None


def _first_text(headers, keys):
    """Text of the first keyword that is filled in, keyword by keyword, or `None`."""
    for key in keys:
        for header in headers:
            text = header_text(header, key)
            if text.upper() not in _PLACEHOLDERS:
                return text
    return None
