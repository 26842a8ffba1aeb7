"""Transforms of the WCS as astropy models, and the one table of PV terms.

::

    detector px --DistortionCorrection--> undistorted px --TangentSky--> ICRS
                  (PVPolynomial, LookupTable)
"""

from wpdc_gwcs.models.distortion import (
    DetectorToSky,
    DistortionCorrection,
    DistortionInverse,
    SkyToDetector,
)
from wpdc_gwcs.models.lookup_table import LookupTable
from wpdc_gwcs.models.polynomial import PVInverse, PVPolynomial
from wpdc_gwcs.models.tangent import SkyTangent, TangentSky, deproject, local_plane, project
from wpdc_gwcs.models.terms import PVTerms, pv_terms

__all__ = [
    "DetectorToSky",
    "DistortionCorrection",
    "DistortionInverse",
    "LookupTable",
    "PVInverse",
    "PVPolynomial",
    "PVTerms",
    "SkyTangent",
    "SkyToDetector",
    "TangentSky",
    "deproject",
    "local_plane",
    "project",
    "pv_terms",
]
