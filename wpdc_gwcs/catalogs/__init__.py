"""Reference catalogs: read, check, cut to the sky of a frame, move to its epoch.

::

    file, table, archive --read_catalog--> checked table --fill_motions--> all stars with a motion
                                                  --select_cone--> near the frame
                                                  --propagate--> at the epoch of the frame

Missing motions are filled in from the whole catalog, before the cut, so that a star moves the same
way in all frames.

The checked table has plain float64 columns with fixed names and units, regardless of their names
and units in the input:

===================== ======== =================================================================
column                unit     meaning
===================== ======== =================================================================
``ra``, ``dec``       deg      ICRS position at ``ref_epoch``
``pmra``, ``pmdec``   mas / yr proper motion (``pmra`` includes cos Dec), NaN where unknown
``parallax``          mas      NaN where unknown
``ref_epoch``         yr       Julian year of the position
``phot_g_mean_mag``   mag      a brightness, for ordering only
``bp_rp``             mag      a color, NaN where unknown
``ra_error``, ...     mas      errors of ``ra`` (times cos Dec), ``dec``, ``pmra``, ``pmdec``,
                               ``parallax``; NaN where unknown
``ra_dec_corr``, ...  --       correlations of the errors of ``ra``, ``dec``, ``pmra`` and ``pmdec``
``radial_velocity``   km / s   NaN where unknown
``ruwe``              --       of Gaia; above 1.4 it scales the errors, see `scale_errors`
``catalog_index``     --       row of the input, zero based
``pm_from_neighbors`` --       true where `fill_motions` filled the motion
===================== ======== =================================================================
"""

from wpdc_gwcs.catalogs.cone import select_cone
from wpdc_gwcs.catalogs.files import (
    READ_ERRORS,
    is_fits,
    read_lines,
    read_table_file,
    special_file,
    split_extension,
)
from wpdc_gwcs.catalogs.gaia import GaiaArchive
from wpdc_gwcs.catalogs.hats import HatsCatalog
from wpdc_gwcs.catalogs.motions import fill_motions, propagate
from wpdc_gwcs.catalogs.quality import scale_errors
from wpdc_gwcs.catalogs.region import Region
from wpdc_gwcs.catalogs.sources import catalog_source
from wpdc_gwcs.catalogs.standard import identity_of, read_catalog, require_catalog_file

__all__ = [
    "READ_ERRORS",
    "GaiaArchive",
    "HatsCatalog",
    "Region",
    "catalog_source",
    "fill_motions",
    "identity_of",
    "is_fits",
    "propagate",
    "read_catalog",
    "read_lines",
    "read_table_file",
    "require_catalog_file",
    "scale_errors",
    "select_cone",
    "special_file",
    "split_extension",
]
