"""ASDF converters of the models and of the WCS; they import the classes when they are used."""

from wpdc_gwcs.converters.models import (
    DetectorToSkyConverter,
    DistortionCorrectionConverter,
    InverseConverter,
    LookupTableConverter,
    PVPolynomialConverter,
    TangentSkyConverter,
)
from wpdc_gwcs.converters.wcs import DetectorWCSConverter

__all__ = ["CONVERTERS"]

#: Every converter class of the package.
CONVERTERS = (
    PVPolynomialConverter,
    LookupTableConverter,
    TangentSkyConverter,
    DistortionCorrectionConverter,
    DetectorToSkyConverter,
    InverseConverter,
    DetectorWCSConverter,
)
