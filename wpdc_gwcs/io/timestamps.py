"""Conversion of dates and times in many spellings to modified Julian dates."""

import re
from dataclasses import dataclass
from datetime import date

__all__ = ["Timestamp", "read_clock", "read_timestamp"]


@dataclass(frozen=True)
class Timestamp:
    """A moment, or a day.

    Parameters
    ----------
    mjd : float
        Modified Julian date in the system of the text.
    has_time : bool
        Whether the time of day is known.
    system : str or None
        Time system in the text, ``UTC`` if there is a time zone; `None` if there is none.
    """

    mjd: float
    has_time: bool
    system: str | None = None


_MONTHS = "jan feb mar apr may jun jul aug sep oct nov dec".split()
_WEEKDAY = re.compile(r"(mon|tue|wed|thu|fri|sat|sun)[a-z]*[.,]*\s+", re.IGNORECASE)
_ZONE = re.compile(r"(?<=\d)\s*([+-])(\d{2}):?(\d{2})?$")
_SYSTEM = re.compile(r"\s*[(\[]?\b(utc?1?|gmt|tai|tt|tdb|z)[)\]]?$", re.IGNORECASE)
_ZULU = re.compile(r"(?<=\d)\s*(z|utc?|gmt|tai|tt|tdb)$", re.IGNORECASE)
_END = r"(?=$|[T\s:,;_]|(?<=\D))"
# Year, month and day by the names of the groups.
_DATES = tuple(
    re.compile(pattern + _END, re.IGNORECASE)
    for pattern in (
        r"(?P<y>[-+]?\d{4,5})[-/.:](?P<m>\d{1,2})[-/.:](?P<d>\d{1,2})(?![\d.])",
        r"(?P<y>\d{4})[-/ .](?P<m>[a-z]{3,9})[-/ .](?P<d>\d{1,2})(?!\d)",
        r"(?P<y>\d{4})[-:](?P<n>\d{3})(?!\d)",
        r"(?P<y>(19|20)\d{2})(?P<m>\d{2})(?P<d>\d{2})(?!\d)",
        r"(?P<d>\d{1,2})[-/.](?P<m>\d{1,2})[-/.](?P<y>\d{4}|\d{2})(?!\d)",
        r"(?P<d>\d{1,2})[-/ .,]*(?P<m>[a-z]{3,9})[-/ .,]*(?P<y>\d{4}|\d{2})(?!\d)",
        r"(?P<m>[a-z]{3,9})[-/ .,]+(?P<d>\d{1,2})(st|nd|rd|th)?[-/ ,]+(?P<y>\d{4})(?!\d)",
        # As C writes it, with the year after the time.
        r"(?P<m>[a-z]{3})\s+(?P<d>\d{1,2})\s+(?P<t>[\d:.]+)\s+(?P<y>\d{4})(?!\d)",
    )
)
_CLOCKS = tuple(
    re.compile(pattern, re.IGNORECASE)
    for pattern in (
        r"(?P<h>\d{1,2})\s*[:h]\s*(?P<m>\d{1,2})\s*([:m]\s*(?P<s>\d{1,2}(\.\d*)?)s?)?m?"
        r"\s*(?P<half>[ap]m)?",
        r"(?P<h>\d{2})(?P<m>\d{2})(?P<s>\d{2}(\.\d*)?)",
    )
)
# Two-digit years are of the 20th century (FITS), except for years in which there were no frames.
_FIRST_YEAR = 40
_UNIX_EPOCH_MJD, _UNIX_EPOCH = 40587, date(1970, 1, 1)


def read_clock(text):
    """Read a time of day.

    Parameters
    ----------
    text : str
        For example ``10:21:45.6``, ``10h21m45s``, ``102145`` or ``10:21 pm``.

    Returns
    -------
    float or None
        Fraction of a day; `None` if the text is not a time.

    Examples
    --------
    >>> from wpdc_gwcs.io.timestamps import read_clock
    >>> read_clock("18:00")
    0.75
    """
    for pattern in _CLOCKS:
        if found := pattern.fullmatch(text.strip()):
            parts = found.groupdict()
            hours, minutes, seconds = int(parts["h"]), int(parts["m"]), float(parts["s"] or 0)
            if parts.get("half"):
                hours = hours % 12 + 12 * (parts["half"].lower() == "pm")
            if hours > 24 or minutes > 59 or seconds >= 61.0:
                return None
            return (hours + (minutes + seconds / 60.0) / 60.0) / 24.0
    return None


def read_timestamp(text):
    """Read a date with an optional time of day.

    Parameters
    ----------
    text : str
        Date with the year first, the day first or the name of the month; with ``T``, blanks or
        colons before the time; with a time zone or a time system at the end.

    Returns
    -------
    Timestamp or None
        The date; `None` if the text is not a date.

    Notes
    -----
    If two numbers come before the year, the first one is the day, as in the first version of FITS,
    unless only the reverse order is a valid date.

    Examples
    --------
    >>> from wpdc_gwcs.io.timestamps import read_timestamp
    >>> read_timestamp("2020-09-24T10:21:45+00:00")
    Timestamp(mjd=59116.431770833334, has_time=True, system='UTC')
    >>> read_timestamp("24 Sep 2020").mjd
    59116.0
    """
    text = _WEEKDAY.sub("", text.strip().strip("'\"").strip(), count=1)
    system, offset = None, 0.0
    if found := _SYSTEM.search(text) or _ZULU.search(text):
        system = "UTC" if found[1].upper() in ("Z", "UT", "GMT") else found[1].upper()
        text = text[: found.start()]
    for pattern in _DATES:
        found = pattern.match(text)
        if found is None:
            continue
        parts = found.groupdict()
        day = _day(parts, day_first=bool(parts.get("d")) and found.start("d") < found.start("y"))
        if day is None:
            continue
        rest = parts.get("t") or text[found.end() :].strip(" T\tt:,;_")
        if not rest:
            return Timestamp(float(day), False, system)
        if zone := _ZONE.search(rest):
            hours, minutes = int(zone[2]), int(zone[3] or 0)
            offset = (hours + minutes / 60) / 24 * (-1 if zone[1] == "-" else 1)
            rest, system = rest[: zone.start()], "UTC"
        clock = read_clock(rest)
        if clock is None:
            return None
        return Timestamp(day + clock - offset, True, system)
    return None


def _day(parts, *, day_first):
    """Return the modified Julian date of a day, `None` if there is no such day."""
    year = int(parts["y"])
    if len(parts["y"]) == 2:
        year += 1900 if year >= _FIRST_YEAR else 2000
    try:
        if parts.get("n"):
            start = date(year, 1, 1).toordinal() - 1
            number = int(parts["n"])
            return start + number - _UNIX_EPOCH.toordinal() + _UNIX_EPOCH_MJD if number else None
        month, day = parts["m"], int(parts["d"])
        if month.isdigit():
            month = int(month)
            if month > 12 >= day and day_first:
                month, day = day, month
        else:
            month = _MONTHS.index(month[:3].lower()) + 1
        return date(year, month, day).toordinal() - _UNIX_EPOCH.toordinal() + _UNIX_EPOCH_MJD
    except ValueError:
        return None
