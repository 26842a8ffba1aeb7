"""A `gwcs.WCS` from the models of this package, and the same in stock astropy models.

::

    detector (px) --DistortionCorrection--> undistorted (px) --TangentSky--> icrs (deg)
"""

from wpdc_gwcs.wcs.detector import DetectorWCS, build_wcs
from wpdc_gwcs.wcs.image_map import sky_map
from wpdc_gwcs.wcs.stock import stock_polynomial, to_stock_wcs

__all__ = ["DetectorWCS", "build_wcs", "sky_map", "stock_polynomial", "to_stock_wcs"]
