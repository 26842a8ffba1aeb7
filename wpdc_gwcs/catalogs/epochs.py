"""Reference epochs of catalogs, from columns, metadata or the name of a release."""

import re
import warnings

import numpy as np

from wpdc_gwcs.columns import find_name, read_numbers
from wpdc_gwcs.exceptions import CatalogError, WPDCWarning

__all__ = ["EPOCH_NAMES", "reference_epochs"]

EPOCH_NAMES = ("ref_epoch", "refepoch", "epoch", "obsdate")
# Releases that a header, a table name or a description may mention.
_GAIA_EPOCHS = (
    (re.compile(r"gaia\s*[-_/]?\s*e?dr3|I[/_]35[05]", re.IGNORECASE), 2016.0),
    (re.compile(r"gaia\s*[-_/]?\s*dr2|I[/_]345", re.IGNORECASE), 2015.5),
    (re.compile(r"gaia\s*[-_/]?\s*dr1|I[/_]337", re.IGNORECASE), 2015.0),
)
_ASSUMED_EPOCH = 2016.0
# No useful reference catalog is older than the first photographic plates.
_EPOCH_RANGE = (1800.0, 2200.0)


def reference_epochs(table, spelled, position, name, *, has_motion):
    """Find the reference epoch of every row.

    Parameters
    ----------
    table : `~astropy.table.Table`
        The input.
    spelled : dict
        Names of its columns, see `wpdc_gwcs.columns.spelled_names`.
    position : str or None
        Column whose description may contain the epoch.
    name : str
        Name of the input in messages.
    has_motion : bool
        Whether an epoch is needed.

    Returns
    -------
    (N,) ndarray or None
        Julian years; `None` if none is known and none is needed.

    Raises
    ------
    CatalogError
        If an epoch is impossible.

    Warns
    -----
    WPDCWarning
        If there are motions and nothing says at which epoch the positions are.
    """
    found = find_name(spelled, EPOCH_NAMES)
    epochs = None if found is None else _julian_years(table, found, name)
    fallback = _epoch_of_metadata(table, position)
    if epochs is None and fallback is not None:
        epochs = np.full(len(table), fallback)
    if epochs is None and has_motion:
        warnings.warn(
            f"{name}: proper motions without a reference epoch: {_ASSUMED_EPOCH} (Gaia DR3) is "
            "assumed; a column 'ref_epoch' would tell",
            WPDCWarning,
        )
        epochs = np.full(len(table), _ASSUMED_EPOCH)
    if epochs is not None and fallback is not None:
        epochs = np.where(np.isfinite(epochs), epochs, fallback)
    return epochs


def _julian_years(table, column, name):
    values = getattr(table[column], "jyear", None)
    try:
        values = read_numbers(table[column] if values is None else values)[0]
    except ValueError as problem:
        warnings.warn(f"{name}: column {column!r} {problem}: it is left out", WPDCWarning)
        return None
    known = values[np.isfinite(values)]
    if known.size == 0:
        return None
    # (Modified) Julian dates occur (Pan-STARRS); no catalog is from before the year 1000.
    if known.min() > 2.3e6:
        values = 2000.0 + (values - 2451545.0) / 365.25
    elif known.min() > 10000.0:
        values = 2000.0 + (values - 51544.5) / 365.25
    known = values[np.isfinite(values)]
    low, high = _EPOCH_RANGE
    for extreme in (known.min(), known.max()):
        if not low <= extreme <= high:
            raise CatalogError(
                f"{name}: column {column!r} must be a Julian year between {low:g} and {high:g}, "
                f"got {extreme:g}"
            )
    return values


def _epoch_of_metadata(table, position):
    meta = {str(k).lower().replace("-", "_"): v for k, v in table.meta.items()}
    for key in ("ref_epoch", "refepoch", "epoch"):
        found = re.fullmatch(r"\s*J?(\d{4}(?:\.\d*)?)\s*", str(meta.get(key, "")))
        if found and _EPOCH_RANGE[0] <= float(found[1]) <= _EPOCH_RANGE[1]:
            return float(found[1])
    column = None if position is None else table[position]
    description = str(getattr(column, "description", "") or "")
    found = re.search(r"\b[Ee]p(?:och)?\s*=?\s*J?(\d{4}(?:\.\d+)?)", description)
    if found:
        return float(found[1])
    text = " ".join(f"{k} {v}" for k, v in meta.items() if isinstance(v, str | list))
    return next((epoch for pattern, epoch in _GAIA_EPOCHS if pattern.search(text)), None)
