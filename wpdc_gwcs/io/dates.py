"""Dates of FITS headers: the epoch in the middle of an exposure."""

import re
import warnings

import numpy as np

from wpdc_gwcs.exceptions import WPDCWarning
from wpdc_gwcs.io.headers import header_text, header_value

__all__ = ["header_epoch", "header_start"]


def header_epoch(headers, *, name="header"):
    """Find the mid-exposure epoch.

    Parameters
    ----------
    headers : sequence of `~astropy.io.fits.Header`
        Looked through in turn for each keyword, the header of the image first.
    name : str, optional
        What messages call the header.

    Returns
    -------
    epoch : float or None
        Julian year; `None` if no date is to be found.

    Warns
    -----
    WPDCWarning
        If a date is there but makes no sense.

    Notes
    -----
    In this order: ``MJD-AVG``, ``DATE-AVG``, the mean of ``MJD-BEG``/``DATE-BEG`` and
    ``MJD-END``/``DATE-END``, then ``MJD-OBS``, ``DATE-OBS`` (with ``TIME-OBS``, ``UTC-OBS``, ``UT``
    where it has no time), ``MJD-BEG``, ``DATE-BEG``, ``MJD``, ``JD``, each plus half of
    ``EXPTIME``. ``TIMESYS`` is honoured to the second, which is 1e-3 mas for any star.
    """
    problems = []
    system = next((t for h in headers if (t := header_text(h, "TIMESYS"))), "UTC").upper()
    if system not in _TO_TT:
        problems.append(f"TIMESYS={system!r}")

    def date(*keys):
        for key in keys:
            for header in headers:
                if key in header:
                    mjd = _mjd(header, key)
                    if mjd is not None and _MJD_RANGE[0] < mjd < _MJD_RANGE[1]:
                        return mjd
                    problems.append(f"{key}={header_text(header, key)!r}")
        return None

    exposure = 0.0
    for key in ("EXPTIME", "EXPOSURE", "XPOSURE", "ITIME"):
        value = next((v for h in headers if (v := header_value(h, key)) is not None), None)
        if value is not None:
            if isinstance(value, int | float) and 0.0 <= value < 1e6:
                exposure = float(value)
                break
            problems.append(f"{key}={value!r}")
    mid = date("MJD-AVG", "DATE-AVG")
    if mid is None:
        start, end = date("MJD-BEG", "DATE-BEG"), date("MJD-END", "DATE-END")
        if start is not None and end is not None and 0.0 <= end - start < 10.0:
            mid = 0.5 * (start + end)
    if mid is None:
        start = date("MJD-OBS", "DATE-OBS", "MJD-BEG", "DATE-BEG", "MJD", "JD")
        if start is not None:
            mid = start + 0.5 * exposure / 86400.0
    if problems:
        found = "no epoch" if mid is None else f"the epoch {2000 + (mid - 51544.5) / 365.25:.4f}"
        warnings.warn(
            f"{name}: dates that make no sense are ignored: {', '.join(dict.fromkeys(problems))}; "
            f"{found} is used",
            WPDCWarning,
        )
    if mid is None:
        return None
    return 2000.0 + (mid + _TO_TT.get(system, _TO_TT["UTC"]) / 86400.0 - 51544.5) / 365.25


def header_start(headers):
    """Find when an exposure began, if the headers tell the time of day.

    Parameters
    ----------
    headers : sequence of `~astropy.io.fits.Header`
        Looked through in turn for each keyword, the header of the image first.

    Returns
    -------
    start : float or None
        Modified Julian date as the headers give it, in whatever time system; `None` if there is no
        date or nothing but the day, which many exposures share.
    """
    for key in ("DATE-OBS", "DATE-BEG", "MJD-OBS", "MJD-BEG"):
        for header in headers:
            mjd = _mjd(header, key, whole_days=False) if key in header else None
            if mjd is not None and _MJD_RANGE[0] < mjd < _MJD_RANGE[1]:
                return mjd
    return None


_MJD_RANGE = (-5000.0, 105000.0)  # 1845 to 2146
# Seconds to add for TT.  UTC has the leap seconds of today: a few too many for old plates.
_TO_TT = {
    "UTC": 69.184,
    "UT": 69.184,
    "UT1": 69.184,
    "GMT": 69.184,
    "TAI": 32.184,
    "IAT": 32.184,
    "GPS": 51.184,
    "TT": 0.0,
    "TDT": 0.0,
    "ET": 0.0,
    "TDB": 0.0,
    "TCB": 0.0,
    "TCG": 0.0,
}
_ISO_DATE = re.compile(r"([-+]?\d{4,5})-(\d\d)-(\d\d)(?:[T ](.+?))?Z?")
_OLD_DATE = re.compile(r"(\d\d)/(\d\d)/(\d\d)")
_CLOCK = re.compile(r"(\d{1,2}):(\d{1,2})(?::(\d{1,2}(?:\.\d*)?))?")


def _mjd(header, key, *, whole_days=True):
    """Give the modified Julian date of a keyword, `None` if it is not a date.

    Without ``whole_days`` a date needs a time of day.
    """
    value = header_value(header, key)
    if not key.startswith("DATE"):
        if isinstance(value, str):
            try:
                value = float(value)
            except ValueError:
                return None
        if isinstance(value, bool) or not isinstance(value, int | float):
            return None
        # A zero stands for a date that was not filled in.
        if value == 0 or not (whole_days or value % 1):
            return None
        return value - 2400000.5 if key == "JD" else float(value)
    if not isinstance(value, str):
        return None
    clock = None
    if found := _ISO_DATE.fullmatch(value.strip()):
        year, month, day = (int(found[i]) for i in (1, 2, 3))
        clock = found[4]
    elif found := _OLD_DATE.fullmatch(value.strip()):
        day, month, year = (int(found[i]) for i in (1, 2, 3))
        year += 1900
    else:
        return None
    if clock is None and key == "DATE-OBS":
        clock = next(
            (
                t
                for k in ("TIME-OBS", "UTC-OBS", "UT", "UTC")
                if _CLOCK.fullmatch(t := header_text(header, k))
            ),
            None,
        )
    if clock is None and not whole_days:
        return None
    try:
        days = np.datetime64(f"{year:04d}-{month:02d}-{day:02d}") - np.datetime64("1858-11-17")
    except ValueError:
        return None
    mjd = float(days.astype(int))
    if clock is not None:
        found = _CLOCK.fullmatch(clock.strip())
        if found is None:
            return None
        hours, minutes, seconds = int(found[1]), int(found[2]), float(found[3] or 0)
        if hours > 24 or minutes > 59 or seconds >= 61.0:
            return None
        mjd += (hours + (minutes + seconds / 60.0) / 60.0) / 24.0
    return mjd
