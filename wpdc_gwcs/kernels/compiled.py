"""The compiled kernels; importing it fails where there was no compiler."""

from wpdc_gwcs.kernels._compiled import (
    evaluate,
    from_sky,
    invert,
    jacobian,
    paint_stars,
    rows_to_sky,
    star_profiles,
    star_steps,
    to_sky,
)

__all__ = [
    "CELL_ORDER",
    "evaluate",
    "from_sky",
    "invert",
    "jacobian",
    "paint_stars",
    "rows_to_sky",
    "star_profiles",
    "star_steps",
    "to_sky",
]

#: Cells in memory, ``[j, i, q, k, p]``: all of a cell side by side, four cache lines.
CELL_ORDER = "jiqkp"
