"""The inner loops: compiled if there was a compiler, otherwise the same in NumPy.

`implementation` is the name of the one in use, ``"compiled"`` or ``"numpy"``.  The environment
variable ``WPDC_GWCS_KERNELS=numpy`` selects NumPy.  The kernels of the WCS, of the levels of the
sky and of peaks do the same operations in the same order, so that their results are identical to
the last bit; those of stars agree to rounding.
"""

import os
from importlib import import_module

from wpdc_gwcs.exceptions import InputError
from wpdc_gwcs.kernels import in_numpy
from wpdc_gwcs.kernels.levels_in_numpy import N_STEPS
from wpdc_gwcs.kernels.plane import Plane, arrange, arranged, box_numbers, tangent_numbers

__all__ = [
    "CELL_ORDER",
    "N_STEPS",
    "Plane",
    "arrange",
    "arranged",
    "box_numbers",
    "count_levels",
    "evaluate",
    "from_sky",
    "implementation",
    "invert",
    "jacobian",
    "mark_cells",
    "paint_stars",
    "put_cubics",
    "rows_to_sky",
    "star_profiles",
    "star_steps",
    "take_stars",
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
count_levels = _kernels.count_levels
evaluate = _kernels.evaluate
from_sky = _kernels.from_sky
invert = _kernels.invert
jacobian = _kernels.jacobian
mark_cells = _kernels.mark_cells
paint_stars = _kernels.paint_stars
put_cubics = _kernels.put_cubics
rows_to_sky = _kernels.rows_to_sky
star_profiles = _kernels.star_profiles
star_steps = _kernels.star_steps
take_stars = _kernels.take_stars
to_sky = _kernels.to_sky
