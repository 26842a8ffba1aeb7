"""The inner loops: compiled where there was a compiler, the same in NumPy elsewhere.

`implementation` says which of the two is at work, ``"compiled"`` or ``"numpy"``; this module is the
only one that knows.  The environment variable ``WPDC_GWCS_KERNELS=numpy`` asks for NumPy.  Both do
the same; those of the WCS do the same operations in the same order, so that their results have the
same bits, those of stars agree to rounding.
"""

import os
from importlib import import_module

from wpdc_gwcs.exceptions import InputError
from wpdc_gwcs.kernels import in_numpy
from wpdc_gwcs.kernels.plane import Plane, arrange, arranged, box_numbers, tangent_numbers

__all__ = [
    "CELL_ORDER",
    "Plane",
    "arrange",
    "arranged",
    "box_numbers",
    "evaluate",
    "from_sky",
    "implementation",
    "invert",
    "jacobian",
    "paint_stars",
    "rows_to_sky",
    "star_profiles",
    "star_steps",
    "tangent_numbers",
    "to_sky",
]


def _choose():
    """Return the name of the implementation and its module."""
    wanted = os.environ.get("WPDC_GWCS_KERNELS", "")
    if wanted not in ("", "compiled", "numpy"):
        raise InputError(f"WPDC_GWCS_KERNELS must be 'compiled' or 'numpy', not {wanted!r}")
    if wanted != "numpy":
        try:
            return "compiled", import_module("wpdc_gwcs.kernels._compiled")
        except ImportError as error:
            if wanted:
                raise InputError(
                    f"WPDC_GWCS_KERNELS asks for compiled kernels, and there are none: {error}"
                ) from None
    return "numpy", in_numpy


implementation, _kernels = _choose()

CELL_ORDER = _kernels.CELL_ORDER
evaluate = _kernels.evaluate
from_sky = _kernels.from_sky
invert = _kernels.invert
jacobian = _kernels.jacobian
paint_stars = _kernels.paint_stars
rows_to_sky = _kernels.rows_to_sky
star_profiles = _kernels.star_profiles
star_steps = _kernels.star_steps
to_sky = _kernels.to_sky
