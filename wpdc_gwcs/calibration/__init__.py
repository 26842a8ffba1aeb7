"""The chain from frames and a catalog to calibrated WCS: the only module that knows every stage.

::

    frame --measure--> sources --match--> pairs --solve--> instrument + attitudes --check--> WCS
           catalog --cone, epoch--> reference ^                 |
                                              '--- re-match ----'

A frame is the unit of work: it is measured and matched alone (`match_frame`), in a process of its
own with ``jobs > 1``.  Frames of a mosaic that cannot be matched alone are started from those of
their exposure that can (`start_from_neighbors`).  The frames of one camera are then solved
together, because they share its detectors and exposures (`solve_camera`).
"""

from wpdc_gwcs.calibration.camera import solve_camera
from wpdc_gwcs.calibration.cluster import cluster_executor
from wpdc_gwcs.calibration.matched import MatchedFrame, match_frame
from wpdc_gwcs.calibration.measure import measure_sources
from wpdc_gwcs.calibration.mosaic import start_from_neighbors
from wpdc_gwcs.calibration.run import CalibrationRun, calibrate
from wpdc_gwcs.calibration.settings import Settings

__all__ = [
    "CalibrationRun",
    "MatchedFrame",
    "Settings",
    "calibrate",
    "cluster_executor",
    "match_frame",
    "measure_sources",
    "solve_camera",
    "start_from_neighbors",
]
