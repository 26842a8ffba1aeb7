"""Reading and writing of frames, headers, calibrations, solutions and tables.

::

    FITS image, FITS_LDAC, table --read_frames--> Frame ... chain ... --write--> ASDF, FITS, .head,
    ECSV
                                                  Calibration <--read--
"""

from wpdc_gwcs.io.beside import read_files
from wpdc_gwcs.io.files import OutputExistsError, atomic_path
from wpdc_gwcs.io.formats import FORMATS, read, read_wcs, write
from wpdc_gwcs.io.frames import read_frames
from wpdc_gwcs.io.simulations import Truth, read_truth, write_simulation
from wpdc_gwcs.io.tables import read_matches, read_table, write_table

__all__ = [
    "FORMATS",
    "OutputExistsError",
    "Truth",
    "atomic_path",
    "read",
    "read_files",
    "read_frames",
    "read_matches",
    "read_table",
    "read_truth",
    "read_wcs",
    "write",
    "write_simulation",
    "write_table",
]
