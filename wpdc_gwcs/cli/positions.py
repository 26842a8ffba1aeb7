"""Positions on the sky as they are typed: one reading for all commands."""

import numpy as np

from wpdc_gwcs.exceptions import InputError
from wpdc_gwcs.sexagesimal import read_angles

__all__ = ["read_position", "require_on_sphere"]

_EXAMPLES = {"ra": "12:34:56.7", "dec": "-01:02:03"}
_LIMITS = (360.0, 90.0)


def read_position(words, option=None):
    """Read right ascension and declination.

    Parameters
    ----------
    words : (str, str)
        Plain numbers in deg, or angles as text; without a unit, right ascension is in hours.
    option : str, optional
        Option that they are from, for messages.

    Returns
    -------
    [ra, dec] : list of float
        The position, deg.
    """
    values = []
    for (name, example), word in zip(_EXAMPLES.items(), words, strict=True):
        try:
            value = float(word)
        except ValueError:
            value = float(read_angles([word], hours=name == "ra")[0])
        if not np.isfinite(value):
            raise InputError(
                f"{_of(option)}{name} must be a number of deg, or an angle such as {example}, "
                f"got {word!r}"
            )
        values.append(value)
    require_on_sphere(("ra", "dec"), np.reshape(values, (2, 1)), option=option)
    return values


def require_on_sphere(names, values, *, path=None, option=None):
    """Refuse positions that are not on the sphere.

    Parameters
    ----------
    names : (str, str)
        Names of right ascension and declination in messages.
    values : (2, N) array_like
        Positions, deg; NaN counts as missing.
    path : Path, optional
        Table that they are from, for messages.
    option : str, optional
        Option that they are from, for messages.
    """
    for name, angle, limit in zip(names, values, _LIMITS):
        wrong = np.flatnonzero(np.abs(angle) > limit)
        if len(wrong):
            what, where = f"{_of(option)}{name}", ""
            if path is not None:
                what, where = f"{path}: column {name!r}", f" in row {wrong[0]}"
            raise InputError(
                f"{what} must lie in [-{limit:g}, {limit:g}] deg, got {angle[wrong[0]]:g}{where}"
            )


def _of(option):
    return "" if option is None else f"{option}: "
