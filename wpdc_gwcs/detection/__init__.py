"""Image to candidate sources: background, hits, extraction, windowed centroids, shapes and flags.

::

    image --subtract_background--> Background --mask_hits--> Background
    Background --sep.extract--> peaks --sep.winpos--> x, y
               --weighted moments, DAOFIND marginals, neighbors--> fwhm, roundness, flags
"""

from wpdc_gwcs.detection._background import Background, subtract_background
from wpdc_gwcs.detection._high_level import detect_companions, detect_sources
from wpdc_gwcs.detection._hits import mask_hits
from wpdc_gwcs.detection._saturation import saturation_problem
from wpdc_gwcs.flags import (
    FLAG_BAD_PIXEL,
    FLAG_BLENDED,
    FLAG_COSMIC,
    FLAG_EDGE,
    FLAG_EXTENDED,
    FLAG_FIT_FAILED,
    FLAG_SATURATED,
)

__all__ = [
    "FLAG_BAD_PIXEL",
    "FLAG_BLENDED",
    "FLAG_COSMIC",
    "FLAG_EDGE",
    "FLAG_EXTENDED",
    "FLAG_FIT_FAILED",
    "FLAG_SATURATED",
    "Background",
    "detect_companions",
    "detect_sources",
    "mask_hits",
    "saturation_problem",
    "subtract_background",
]
