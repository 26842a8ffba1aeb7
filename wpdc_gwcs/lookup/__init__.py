"""The look-up table: residuals of the polynomial, averaged over many exposures and interpolated.

::

    residuals of a frame --ResidualMap.from_residuals--> bins --"+" over frames--> bins
    --build_lookup_table--> LookupTable
"""

from wpdc_gwcs.lookup._smoother import TableChoice
from wpdc_gwcs.lookup.choice import choose_table
from wpdc_gwcs.lookup.residual_map import N_FOLDS, ResidualMap
from wpdc_gwcs.lookup.table import TableInfo, build_lookup_table

__all__ = [
    "N_FOLDS",
    "ResidualMap",
    "TableChoice",
    "TableInfo",
    "build_lookup_table",
    "choose_table",
]
