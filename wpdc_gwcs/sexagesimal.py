"""Angles that are written as text: sexagesimal, or with a unit.

Columns of catalogs and arguments of the command line are read here.
"""

import re

import numpy as np

__all__ = ["read_angles"]

# Signs and marks of typeset text, which come along when a position is copied from a paper.
_TYPESET = str.maketrans(
    {"\u2212": "-", "\u00b0": "d", "\u2032": "m", "\u2033": "s", "\u02b0": "h", "'": "m", '"': "s"}
)
_TYPESET |= {ord("\u1d50"): "m", ord("\u02e2"): "s"}
# The first number is an integer; the last one may have decimals, the one before it may not.
_SIXTY = r"[0-5]?\d"
_LAST = rf"{_SIXTY}(?:\.\d*)?"
_FORMS = tuple(
    re.compile(rf"(?P<sign>[-+]?)\s*{form}", re.IGNORECASE)
    for form in (
        rf"(?P<a>\d{{1,3}})\s*:\s*(?P<b>{_SIXTY})\s*:\s*(?P<c>{_LAST})?",
        rf"(?P<a>\d{{1,3}})\s*:\s*(?P<b>{_LAST})",
        rf"(?P<a>\d{{1,3}})\s+(?P<b>{_SIXTY})\s+(?P<c>{_LAST})",
        rf"(?P<a>\d{{1,3}})\s+(?P<b>{_LAST})",
        rf"(?P<a>\d{{1,3}})\s*(?P<unit>h|d|deg)\s*(?P<b>{_SIXTY})\s*m\s*(?:(?P<c>{_LAST})\s*s?)?",
        rf"(?P<a>\d{{1,3}})\s*(?P<unit>h|d|deg)\s*(?P<b>{_LAST})\s*m?",
        r"(?P<a>\d{1,3}(?:\.\d*)?|\.\d+)\s*(?P<unit>h|hours?|hourangle|d|deg|degrees?)",
    )
)
_DEG_PER_HOUR = 15.0


def read_angles(text, *, hours):
    """Read angles such as ``12:34:56.7``, ``12 34 56.7``, ``12h34m56.7s``, ``-1d02m03s``, ``1.5h``.

    Parameters
    ----------
    text : (N,) array_like of str
        The angles.
    hours : bool
        Whether a sexagesimal number without a unit is in hours; otherwise it is in degrees.

    Returns
    -------
    (N,) ndarray
        Angles in deg; NaN for text of another form, plain numbers included.

    Examples
    --------
    >>> from wpdc_gwcs.sexagesimal import read_angles
    >>> read_angles(["10:30:00", "10d30m", "10.5"], hours=True).tolist()
    [157.5, 10.5, nan]
    """
    return np.array([_read_angle(one, hours) for one in text], dtype=float)


def _read_angle(text, hours):
    plain = text.strip().translate(_TYPESET).replace("mm", "s")
    found = next((f for form in _FORMS if (f := form.fullmatch(plain))), None)
    if found is None:
        return np.nan
    parts = found.groupdict()
    value = sum(float(parts.get(k) or 0) / 60.0**n for n, k in enumerate("abc"))
    in_hours = parts["unit"].lower().startswith("h") if parts.get("unit") else hours
    return (-1 if parts["sign"] == "-" else 1) * value * (_DEG_PER_HOUR if in_hours else 1.0)
