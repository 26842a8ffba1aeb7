"""Dates of FITS headers: the epoch in the middle of an exposure, and when it began.

Observatories have their own keywords.  Their meaning is derived from the words that they consist
of: a day (``MJD``, ``JD``, ``DATE``), an observation (``OBS``, ``EXP``, ``SHUT``, ...) and a
moment (``BEG``, ``START``, ``OPEN``; ``END``, ``CLOS``; ``AVG``, ``MID``), in any order and with or
without hyphens.  A keyword with any other word in it (``DATE-MAP``, ``MJDREF``) is
ignored.
"""

import re
import warnings
from dataclasses import dataclass
from functools import lru_cache

from wpdc_gwcs.exceptions import WPDCWarning
from wpdc_gwcs.io.headers import header_text, header_value
from wpdc_gwcs.io.timestamps import read_clock, read_timestamp

__all__ = ["EXPOSURE_KEYS", "header_epoch", "header_start", "julian_year", "read_epoch"]

_MJD_RANGE = (-5000.0, 105000.0)  # 1845 to 2146
# Without the word MJD, a number in a keyword like EXPSTART is a date if it is one of 1982 to 2064.
_MODERN_MJD = (45000.0, 75000.0)
_JD_FROM = 2.3e6
_JD_MINUS_MJD = 2400000.5
_YEARS = (1800.0, 2200.0)
# Maximum exposure time, d.
_LONGEST = 10.0
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
# Standard keywords (and de facto ones), best first, by moment.
_STANDARD = {
    "mid": ("MJDAVG", "DATEAVG"),
    "begin": ("MJDBEG", "DATEBEG"),
    "end": ("MJDEND", "DATEEND"),
    "start": ("MJDOBS", "DATEOBS", "MJDBEG", "DATEBEG", "MJD", "JD"),
}
_DAY = "MJD|[HB]?JD|JUL(IAN)?|DATE?"
_THING = "OB(S(ERV(ATION)?)?)?|EXP(OS(URE)?)?|SHUT(TER)?|SHTR|IMA?GE?|FRA?ME?|ACQ|INT|EPOCH"
_SCALE = "UT1?|UTC|TAI|TT|TDB|TIM(E(STAMP)?)?|GPS"
_MOMENTS = {
    "begin": "START|STRT|STA?R?|BEG(IN)?|BGN|OPE?N",
    "end": "END|STO?P|FIN(ISH)?|CLOSE?|CLS",
    "mid": "AVG|MID(DLE|P(OIN)?T)?|MEAN|CENT?|EFF",
}
_WORD = re.compile(
    f"(?:(?P<day>{_DAY})|(?P<thing>{_THING})|(?P<scale>{_SCALE})|(?P<begin>{_MOMENTS['begin']})"
    f"|(?P<end>{_MOMENTS['end']})|(?P<mid>{_MOMENTS['mid']}))"
)
_KEYWORD = re.compile(f"(?:{_DAY}|{_THING}|{_SCALE}|{'|'.join(_MOMENTS.values())})+")
# Keywords with the time of day for a date without one.
_CLOCK_KEYS = ("TIME-OBS", "UTC-OBS", "UT", "UTC", "UT-OBS", "UTSTART", "UT-STR", "UTC-BEG")
#: Keywords of the exposure time.
EXPOSURE_KEYS = (
    *("EXPTIME", "EXPOSURE", "XPOSURE", "TEXPTIME", "EFFEXPTM", "ITIME", "TELAPSE", "EXP_TIME"),
    "ELAPTIME",
)


@dataclass(frozen=True)
class _Date:
    """Content of a keyword: moment, modified Julian date and time system."""

    moment: str
    key: str
    rank: tuple
    mjd: float
    has_time: bool
    system: str | None


def header_epoch(headers, *, name="header"):
    """Find the mid-exposure epoch.

    Parameters
    ----------
    headers : sequence of `~astropy.io.fits.Header`
        Searched in turn for each keyword, the header of the image first.
    name : str, optional
        Name of the header in messages.

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
    ``EXPTIME``; then other keywords that are made of the same words, such as ``OBSMJD``,
    ``EXPSTART``, ``SHUTOPEN`` or ``DATE_OBS``.  ``TIMESYS`` is honored to the second, which is
    1e-3 mas for any star.
    """
    problems = []
    system = next((t for h in headers if (t := header_text(h, "TIMESYS"))), "UTC").upper()
    if system not in _TO_TT:
        problems.append(f"TIMESYS={system!r}")
    exposure = 0.0
    for key in EXPOSURE_KEYS:
        value = next((v for h in headers if (v := header_value(h, key)) is not None), None)
        if value is not None:
            if isinstance(value, int | float) and 0.0 <= value < 1e6:
                exposure = float(value)
                break
            problems.append(f"{key}={value!r}")
    found, broken = _dates(headers)
    chosen, used = _middle(found, exposure)
    standard = {k for keys in _STANDARD.values() for k in keys}
    # Invalid dates on the way; those of nonstandard keywords only if nothing else tells.
    problems += [
        text
        for rank, key, text in broken
        if (rank < used and key in standard) or (chosen is None and rank[0] < 2)
    ]
    if problems:
        year = None if chosen is None else 2000 + (chosen[0] - 51544.5) / 365.25
        epoch = "no epoch" if year is None else f"the epoch {year:.4f}"
        warnings.warn(
            f"{name}: dates that make no sense are ignored: {', '.join(dict.fromkeys(problems))}; "
            f"{epoch} is used",
            WPDCWarning,
        )
    if chosen is None:
        return None
    mjd, own = chosen
    return julian_year(mjd, _TO_TT.get(own or system, _TO_TT["UTC"]))


def header_start(headers):
    """Find when an exposure began, if the headers tell the time of day.

    Parameters
    ----------
    headers : sequence of `~astropy.io.fits.Header`
        Searched in turn for each keyword, the header of the image first.

    Returns
    -------
    start : float or None
        Modified Julian date as the headers give it, in whatever time system; `None` if there is no
        date or nothing but the day, which many exposures share.
    """
    found = [d for d in _dates(headers)[0] if d.has_time and d.moment in ("start", "begin")]
    first = ("DATEOBS", "DATEBEG", "MJDOBS", "MJDBEG")
    order = {key: k for k, key in enumerate(first)}
    best = min(found, key=lambda d: (order.get(d.key, len(first)), d.rank), default=None)
    return None if best is None else best.mjd


def read_epoch(text):
    """Parse an epoch that a user gives.

    Parameters
    ----------
    text : str or float
        Julian year (2016.5, ``J2016.5``), date with or without time, or (modified) Julian date.

    Returns
    -------
    float
        Julian year.

    Raises
    ------
    ValueError
        If it is none of these.

    Examples
    --------
    >>> from wpdc_gwcs.io.dates import read_epoch
    >>> read_epoch("J2016.5"), round(read_epoch("2016-07-02"), 2)
    (2016.5, 2016.5)
    """
    text = str(text).strip()
    try:
        number = float(text.lstrip("Jj"))
    except ValueError:
        found = read_timestamp(text)
        if found is not None and _MJD_RANGE[0] < found.mjd < _MJD_RANGE[1]:
            return julian_year(found.mjd, _TO_TT.get(found.system, _TO_TT["UTC"]))
    else:
        if _YEARS[0] <= number <= _YEARS[1]:
            return number
        mjd = number - _JD_MINUS_MJD if number > _JD_FROM else number
        if 1e4 < mjd < _MJD_RANGE[1]:
            return julian_year(mjd, _TO_TT["UTC"])
    raise ValueError(f"epoch must be a Julian year, a date or a Julian date, got {text!r}")


def julian_year(mjd, seconds=0.0):
    """Turn a modified Julian date into a Julian year.

    Parameters
    ----------
    mjd : float
        The date.
    seconds : float, optional
        Seconds to add, to convert to TT.

    Returns
    -------
    float
        Julian year.
    """
    return 2000.0 + (mjd + seconds / 86400.0 - 51544.5) / 365.25


def _middle(found, exposure):
    """Middle of the exposure with its time system (or None), and the rank of its source."""
    best = {}
    for date in found:
        moment = "start" if date.moment == "begin" and date.key in _STANDARD["start"] else None
        for m in {date.moment, moment} - {None}:
            rank = _rank(m, date.key, date.rank[-1])
            if m not in best or rank < best[m][0]:
                best[m] = rank, date
    if "mid" in best:
        rank, date = best["mid"]
        return (date.mjd, date.system), rank
    if "begin" in best and "end" in best:
        first, last = best["begin"][1], best["end"][1]
        if 0.0 <= last.mjd - first.mjd < _LONGEST:
            return (0.5 * (first.mjd + last.mjd), first.system), max(
                best["begin"][0], best["end"][0]
            )
    for m in ("start", "begin"):
        if m in best:
            rank, date = best[m]
            return (date.mjd + 0.5 * exposure / 86400.0, date.system), rank
    if "end" in best:
        rank, date = best["end"]
        return (date.mjd - 0.5 * exposure / 86400.0, date.system), rank
    return None, (9,)


def _rank(moment, key, place):
    """Order of trust in keywords: standard ones, then others, by header and position."""
    group = {"mid": 0, "begin": 1, "end": 1, "start": 1}[moment]
    standard = _STANDARD[moment]
    if key in standard:
        return group, 0, standard.index(key), place
    days = ("MJD", "DATE", "JD")
    kind = next((k for k, word in enumerate(days) if word in key), len(days))
    return group, 1, kind + (not _kinds(key) & {"day", *_MOMENTS}), place


def _dates(headers):
    """All dates in headers, and the cards that look like dates but are invalid."""
    found, broken, place = [], [], 0
    for header in headers:
        for keyword in header:
            place += 1
            key = _plain(keyword)
            moment = _moment(key)
            if moment is None:
                continue
            date = _date_of(header, keyword, key, moment, place)
            if date is not None and _MJD_RANGE[0] < date.mjd < _MJD_RANGE[1]:
                found.append(date)
            elif "day" in _kinds(key):
                text = f"{keyword}={header_text(header, keyword)!r}"
                broken.append((_rank(moment, key, place), key, text))
    return found, broken


def _plain(keyword):
    """Keyword without hyphens; for a hierarchical one, its last part."""
    words = re.sub(r"[-_.]", "", keyword.upper()).split()
    for k in range(max(0, len(words) - 3), len(words)):
        if _KEYWORD.fullmatch("".join(words[k:])):
            return "".join(words[k:])
    return words[-1] if words else ""


@lru_cache(maxsize=4096)
def _moment(key):
    """Moment of a keyword: ``mid``, ``begin``, ``end``, ``start``; `None` for none."""
    if key in ("DATE", "EPOCH") or not _KEYWORD.fullmatch(key):
        # DATE is that of the file, EPOCH is the old name of the equinox.
        return None
    kinds = _kinds(key)
    return next((k for k in ("mid", "end", "begin") if k in kinds), "start")


@lru_cache(maxsize=4096)
def _kinds(key):
    """Kinds of the words of a keyword."""
    return frozenset(m.lastgroup for m in _WORD.finditer(key))


def _date_of(header, keyword, key, moment, place):
    """Read the date of a card, `None` if there is none."""
    value = header_value(header, keyword)
    rank = _rank(moment, key, place)
    if isinstance(value, str):
        text = value.strip()
        stamp = read_timestamp(text)
        if stamp is not None:
            mjd, has_time = stamp.mjd, stamp.has_time
            clock = _clock_of(header) if moment in ("start", "begin") and not has_time else None
            if clock is not None:
                mjd, has_time = mjd + clock, True
            return _Date(moment, key, rank, mjd, has_time, stamp.system)
        try:
            value = float(text.removeprefix("MJD").removeprefix("JD"))
        except ValueError:
            return None
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    number = float(value)
    # Zero means a date that was not filled in.
    if number == 0:
        return None
    if number > _JD_FROM:
        number -= _JD_MINUS_MJD
    elif "EPOCH" in key:
        return (
            _Date(moment, key, rank, 51544.5 + (number - 2000.0) * 365.25, False, "TT")
            if _YEARS[0] <= number <= _YEARS[1]
            else None
        )
    elif "JD" not in key:
        # seconds of a day, lengths and counters are no dates
        kinds = _kinds(key)
        is_moment = "thing" in kinds and kinds & set(_MOMENTS) and not kinds & {"scale", "day"}
        if not is_moment or not _MODERN_MJD[0] < number < _MODERN_MJD[1]:
            return None
    return _Date(moment, key, rank, number, bool(float(value) % 1), _system_of(key))


def _system_of(key):
    """Time system that a keyword names (TAI-OBS, MJD-TDB), or None."""
    found = re.search("TAI|TDB|GPS", key)
    return None if found is None else found[0]


def _clock_of(header):
    """Time of day in a keyword of its own, as a fraction of a day."""
    for key in _CLOCK_KEYS:
        clock = read_clock(header_text(header, key)) if ":" in header_text(header, key) else None
        if clock is not None:
            return clock
    return None
